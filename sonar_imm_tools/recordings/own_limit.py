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


"""The largest error that `check` allows on a recording, in a file that it may have beside it.

A simulated recording is one draw of many: what its error may be follows from the errors of the
same scene under other seeds, and not from the system.
"""

from __future__ import annotations

import math
from pathlib import Path

import yaml

from sonar_imm.files import whole

from .sources import BagError

NAME = 'check.yaml'
_HEAD = '# The largest error that `sonar-imm check` allows on this recording; see README.md.\n'


def own_limit(bag: Path) -> float | None:
    """The limit in the folder of a recording; None when it states none.

    Raises `BagError` for a file that states something else.
    """
    path = bag / NAME
    if not path.is_file():
        return None
    try:
        told = yaml.safe_load(path.read_text(encoding='utf-8'))
    except (yaml.YAMLError, UnicodeDecodeError):
        raise BagError(f'{path} is not YAML') from None
    limit = told.get('limit') if isinstance(told, dict) else None
    if isinstance(limit, bool) or not isinstance(limit, (int, float)):
        raise BagError(f'{path} states no number as limit')
    if not (math.isfinite(limit) and limit >= 0.0):
        raise BagError(f'{path}: the limit of an error is finite and not negative, got {limit}')
    return float(limit)


def write_own_limit(bag: Path, limit: float) -> None:
    """Write the limit into the folder of a recording."""
    with whole(bag / NAME) as unfinished:
        text = _HEAD + yaml.safe_dump({'limit': limit})
        unfinished.write_text(text, encoding='utf-8')
