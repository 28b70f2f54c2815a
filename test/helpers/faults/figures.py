# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the long forms find out, as JSON: docs/reliability.md is made of it.

The long form runs when ``SONAR_IMM_FIGURES`` names a folder: everything is tried on every node,
and each part writes a file there. `make reliability` does that.
"""

import json
import os
from pathlib import Path
from typing import Any

import pytest

FOLDER = os.environ.get('SONAR_IMM_FIGURES', '')
SHARE = float(os.environ.get('SONAR_IMM_SHARE', '1.0'))
"""Of the tries of the long form; below 1 every fault is tried on one node only."""


def long_form():
    """Whether everything is to be tried, not a share of it."""
    return bool(FOLDER) and SHARE >= 1.0


def count(short, long):
    """How often something is tried."""
    return max(short, round(SHARE * long)) if FOLDER else short


class Figures:
    """The rows of one part, written as they come; nothing in the short form. What is in the folder
    already is taken over: a long form that was broken off goes on."""

    def __init__(self, part):
        self._path = Path(FOLDER) / f'{part}.json' if FOLDER else None
        self.rows: list[dict[str, Any]] = []
        if self._path and self._path.is_file():
            self.rows = json.loads(self._path.read_text(encoding='utf-8'))

    def skip_if_measured(self, tries=0, **key):
        """Skip the test when its row is there, of as many `tries`."""
        if any(_is_of(row, key) and row.get('tried', tries) >= tries for row in self.rows):
            pytest.skip('measured already')

    def add(self, key, **values):
        """Add the row of `key`, instead of one that is there."""
        self.rows = [row for row in self.rows if not _is_of(row, key)] + [{**key, **values}]
        if self._path:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            text = json.dumps(self.rows, indent=1, sort_keys=True)
            whole = self._path.with_suffix('.tmp')
            whole.write_text(text + '\n', encoding='utf-8')
            whole.replace(self._path)


def _is_of(row, key):
    return all(row.get(name) == value for name, value in key.items())
