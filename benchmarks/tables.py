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

"""How benchmarks tell their numbers: a table to read, and a file."""

from __future__ import annotations

from collections.abc import Mapping
import json
from pathlib import Path
from typing import Any


def markdown(table: Mapping[str, Mapping[str, float]], digits: int = 3) -> str:
    """A row for each entry, a column for each number of the first one."""
    columns = list(next(iter(table.values())))
    lines = ['| | ' + ' | '.join(columns) + ' |', '|---' * (len(columns) + 1) + '|']
    lines += [
        f'| {row} | ' + ' | '.join(f'{values[column]:.{digits}f}' for column in columns) + ' |'
        for row, values in table.items()
    ]
    return '\n'.join(lines)


def write_json(path: Path | None, content: Mapping[str, Any]) -> None:
    """Write `content`, and the folders to it; nothing without a path."""
    if path:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(json.dumps(content, indent=1) + '\n')
