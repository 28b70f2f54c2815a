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

"""Soundings as messages: the PointCloud2 of ``~/soundings``, which gridders like CUBE take."""

from __future__ import annotations

from typing import Any

import numpy as np

from sonar_imm.estimates import PLACES
from sonar_imm.measurements import Rejection
from sonar_imm.soundings import COLUMNS, LATER, Soundings

from .headers import Make, stamp_ns
from .table import decode_table, encode_table, require_columns


def write_soundings(soundings: Soundings, make: Make) -> Any:
    """Write the table of ``~/soundings``, one row per bin with an echo, nothing NaN."""
    return encode_table(
        soundings.columns, stamp_ns=soundings.stamp_ns, frame_id=soundings.frame_id, make=make
    )


def read_soundings(message: Any) -> Soundings:
    """Read what `write_soundings` wrote. Raises `Rejection`."""
    columns = decode_table(message)
    later = (*PLACES, *LATER)  # which older tables lack
    require_columns(columns, tuple(n for n in COLUMNS if n not in later), 'soundings')
    for name, coarse in zip(PLACES, 'xyz'):
        columns.setdefault(name, columns[coarse].astype(np.float64))
    for name, value in LATER.items():
        columns.setdefault(name, np.full(len(columns['x']), value, COLUMNS[name]))
    for name, kind in COLUMNS.items():
        if columns[name].dtype != np.dtype(kind) or columns[name].ndim != 1:
            raise Rejection(
                'bad_field', f'column {name} of a table of soundings is not {np.dtype(kind).name}'
            )
    return Soundings(
        stamp_ns(message), str(message.header.frame_id), {name: columns[name] for name in COLUMNS}
    )
