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

"""What the long forms find out, as JSON: docs/reliability.md is made of it.

The long form runs when ``SONAR_IMM_FIGURES`` names a folder: everything is tried on every node,
and each part writes a file there. `make reliability` does that.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

FOLDER = os.environ.get('SONAR_IMM_FIGURES', '')
SHARE = float(os.environ.get('SONAR_IMM_SHARE', '1.0'))
"""Of the tries of the long form, for a machine that has no hours."""


def long_form() -> bool:
    """Whether everything is to be tried, not a share of it."""
    return bool(FOLDER)


def count(short: int, long: int) -> int:
    """How often something is tried."""
    return max(short, round(SHARE * long)) if long_form() else short


class Figures:
    """The rows of one part, written as they come; nothing in the short form."""

    def __init__(self, part: str):
        self.part = part
        self.rows: list[dict[str, Any]] = []

    def add(self, **row: Any) -> None:
        self.rows.append(row)
        if FOLDER:
            folder = Path(FOLDER)
            folder.mkdir(parents=True, exist_ok=True)
            told = json.dumps(self.rows, indent=1, sort_keys=True)
            (folder / f'{self.part}.json').write_text(told + '\n', encoding='utf-8')
