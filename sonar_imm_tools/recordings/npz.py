# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Numpy archives (npz), a usual format of research data."""

from __future__ import annotations

from pathlib import Path
import zipfile
import zlib

import numpy as np
from numpy.typing import NDArray

from .sources import BagError


def read_npz(path: Path) -> dict[str, NDArray]:
    """Give every array of an archive by name. Raises `BagError`."""
    try:
        with path.open('rb') as file:
            if not zipfile.is_zipfile(file):
                raise BagError(f'{path} is not a numpy archive (npz)')
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except OSError as error:
        raise BagError(f'{path} cannot be read: {error.strerror or error}') from None
    except (ValueError, EOFError, zlib.error, zipfile.BadZipFile):
        raise BagError(f'{path} is damaged, or holds more than plain arrays') from None
