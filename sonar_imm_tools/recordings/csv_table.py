# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""CSV files with any delimiter."""

from __future__ import annotations

import codecs
from collections.abc import Iterator, Sequence
import contextlib
import csv
from pathlib import Path
import re
from typing import Any, TextIO

from .columns import time_unit_of, unit_of
from .sources import BagError, start_of
from .tables import CsvOptions, Table

LONGEST_LINE = 1 << 20
"""Characters."""
RECORDS = 'VEMCO DATA LOG'
"""Begin of a file of records of several kinds, each with its own header, of which detections
(``DET``) are read."""


class CsvTable(Table):
    """The header of a CSV file and an iterator over its rows. Raises `BagError` for no CSV."""

    UNITS_ARE_FREE = True

    def __init__(self, path: str | Path, options: CsvOptions | None = None):
        self.path = Path(path)
        self.options = options or CsvOptions()
        self._kind = ''
        start = start_of(self.path)
        if start[:2] in (b'\xff\xfe', b'\xfe\xff') and b'\0' in start[:64]:
            raise BagError(f'{self.path} is text in UTF-16; save it as UTF-8')
        if _binary(start):
            raise BagError(f'{self.path} is no text, not a CSV file')
        self._encoding = _encoding(start)
        with self._open() as file:
            lines = (line for line in _lines(file) if line.strip() and not _is_aside(line))
            first = next(lines, '')
            if first.startswith(RECORDS):
                first = next((line for line in lines if line.startswith('DET_DESC')), first)
                self._kind = 'DET'
            second = next(lines, '')
        if not first:
            raise BagError(f'{self.path} is empty, not a CSV file')
        likely = max(',;\t|', key=first.count)
        self.delimiter = self.options.delimiter or (likely if likely in first else ' ')
        try:
            headers = [name.strip() for name in next(csv.reader([first], **self._dialect))]
        except csv.Error:
            raise self._no_table(1) from None
        super().__init__(path, options, headers)
        if not self._kind:
            with contextlib.suppress(csv.Error):
                self.units = _units_of(next(csv.reader([second], **self._dialect), []), headers)

    def _no_table(self, line: int) -> BagError:
        return BagError(
            f'{self.path}, line {line} is no line of a CSV file: it holds more than '
            f'{csv.field_size_limit()} characters in a cell, or bytes that are no text'
        )

    def rows(self) -> Iterator[tuple[int, list[str]]]:
        ended, width, header_seen, to_skip = True, 0, False, bool(self.units)

        def lines(file: TextIO) -> Iterator[str]:
            nonlocal ended
            for line in _lines(file):
                ended = line.endswith(('\n', '\r'))
                yield line

        with self._open() as file:
            reader = csv.reader(lines(file), **self._dialect)
            while True:
                try:
                    cells = next(reader)
                except StopIteration:
                    return
                except csv.Error:
                    raise self._no_table(reader.line_num) from None
                if not any(cell.strip() for cell in cells) or _is_aside(cells[0]):
                    continue
                if self._kind:
                    header_seen = cells[0] == self._kind
                if header_seen and to_skip:
                    to_skip = False
                    continue
                if header_seen:
                    if len(cells) < width and not ended:
                        self.cut_line = reader.line_num
                    width = len(cells)
                    yield reader.line_num, cells
                header_seen = not self._kind

    @property
    def _dialect(self) -> dict[str, Any]:
        return {'delimiter': self.delimiter, 'skipinitialspace': True}

    def _open(self) -> TextIO:
        return self.path.open(encoding=self._encoding, errors='replace', newline='')


def _is_aside(line: str) -> bool:
    """Whether a line is a comment, or names the delimiter, as spreadsheets write."""
    return line.startswith('#') or re.match('sep=.?$', line.strip().lower()) is not None


def _units_of(cells: Sequence[str], headers: Sequence[str]) -> list[str]:
    """The units of the columns where the row below the headers holds them, else nothing. Headers
    with a unit keep it."""
    words = [cell.strip().strip('[]()').strip() for cell in cells]
    known = [bool(unit_of(f'a [{word}]') or time_unit_of(f'a {word}')) for word in words]
    if len(cells) != len(headers) or not any(known) or any(map(re.compile(r'\d').search, words)):
        return []
    return ['' if unit_of(header) else word for word, header in zip(words, headers)]


def _lines(file: TextIO) -> Iterator[str]:
    """The lines of a file; what is longer than any line of a table comes in parts."""
    return iter(lambda: file.readline(LONGEST_LINE), '')


def _binary(start: bytes) -> bool:
    """Whether the first bytes are something else than text: control characters are among them, or
    many that are no UTF-8. A byte of another alphabet here and there is text all the same."""
    controls = sum(byte < 32 and byte not in b'\t\n\r\f\x1a' for byte in start)
    strange = start.decode('utf-8', errors='replace').count('\ufffd')
    return controls > 0 or 10 * strange > len(start)


def _encoding(start: bytes) -> str:
    """UTF-8, or else what spreadsheets of western Europe write."""
    try:
        codecs.getincrementaldecoder('utf-8')().decode(start)  # its end may be cut
    except UnicodeDecodeError:
        return 'cp1252'
    return 'utf-8-sig'
