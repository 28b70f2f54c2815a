# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Writing CSV whose names start no formula in a spreadsheet and steer no terminal."""

from __future__ import annotations

from collections.abc import Iterable
import csv
import re
from typing import TextIO

from sonar_imm.texts import visible

_FORMULA = re.compile(r'\s*[=+\-@\uff1d\uff0b\uff0d\uff20]|[\t\r\n]')
"""How a text begins that spreadsheets may compute; some read the wide forms too."""


class CsvWriter:
    """Writes rows to an open text file; each text goes through `in_cell`."""

    def __init__(self, file: TextIO):
        self._writer = csv.writer(file, lineterminator='\n')

    def write(self, cells: Iterable[object]) -> None:
        """Write one row."""
        self._writer.writerow([in_cell(c) if isinstance(c, str) else c for c in cells])

    def write_numbers(self, rows: Iterable[Iterable[float]]) -> None:
        """Write rows without text, where there are millions."""
        self._writer.writerows(rows)


def in_cell(text: str) -> str:
    """`text` as a cell, visible; an apostrophe stands before what may be a formula. A number that
    is text already, such as '-1.50', stays as it is."""
    if not _FORMULA.match(text) or _is_number(text):
        return visible(text)
    return f"'{visible(text)}"


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return text.isprintable()
