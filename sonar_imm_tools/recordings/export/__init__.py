# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""For other programs: soundings as XYZ, LAS, LAZ and GeoTIFF; horizons as CSV, GeoJSON, SEG-Y; and
CSV whose names start no formula in a spreadsheet and steer no terminal."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
import csv
from functools import cache
import io
import re
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from sonar_imm.texts import visible

__all__ = ['horizons', 'points', 'tracks']
_FORMULA = re.compile(r'\s*[=+\-@\uff1d\uff0b\uff0d\uff20]|[\t\r\n]')
"""How a text begins that spreadsheets may compute; some read the wide forms too."""
ROWS_IN_A_BLOCK = 8192
FEW_ROWS = 1024
"""Below that, loading pyarrow takes longer than writing."""


class CsvWriter:
    """Writes rows to an open text file; each text goes through `in_cell`."""

    def __init__(self, file: TextIO):
        self._file = file
        self._writer = csv.writer(file, lineterminator='\n')

    def write(self, cells: Iterable[object]) -> None:
        self._writer.writerow([in_cell(c) if isinstance(c, str) else c for c in cells])

    def write_columns(self, columns: Sequence[NDArray]) -> None:
        """Write the rows of columns (n,) of numbers; a float as the shortest text that reads back
        exactly. pyarrow, where it is installed, writes the same bytes four times as fast."""
        rows = len(columns[0])
        plain = all(column.ndim == 1 and column.dtype.kind in 'iuf' for column in columns)
        fast = rows >= FEW_ROWS and plain and _arrow() is not None
        for start in range(0, rows, ROWS_IN_A_BLOCK):
            block = [column[start : start + ROWS_IN_A_BLOCK] for column in columns]
            if fast:
                self._file.write(_rows(block))
            else:
                self._writer.writerows(zip(*(column.tolist() for column in block)))


@cache
def _arrow() -> Any:
    """Return pyarrow; None where it is missing, or where its numbers are not those of `repr`."""
    try:
        import pyarrow
        import pyarrow.compute
        import pyarrow.csv
    except ImportError:
        return None
    powers = 10.0 ** np.arange(-30, 31)
    cases = np.concatenate([powers, -1.25 * powers, powers / 3.0, [0.0, -0.0, np.nan, -np.inf]])
    same = _texts(cases, pyarrow).to_pylist() == list(map(repr, cases.tolist()))
    return pyarrow if same else None


def _rows(columns: Sequence[NDArray]) -> str:
    arrow = _arrow()
    texts = {str(k): _texts(column, arrow) for k, column in enumerate(columns)}
    form = arrow.csv.WriteOptions(include_header=False, quoting_style='none')
    lines = io.BytesIO()
    arrow.csv.write_csv(arrow.table(texts), lines, form)
    return lines.getvalue().decode('ascii')


def _texts(column: NDArray, arrow: Any) -> Any:
    """Numbers as an array of texts. pyarrow and `repr` agree on the digits of a float; where they
    do not on their form, it becomes that of `repr`: 7.0 for 7, 1.2e-05 for 0.000012, e-07 for
    e-7."""
    if column.dtype.kind != 'f':
        return arrow.array(column).cast(arrow.string())
    numbers = column.astype(np.float64, copy=False)
    texts = arrow.array(numbers).cast(arrow.string())
    size = np.abs(numbers)
    cut, join = arrow.compute.binary_replace_slice, arrow.compute.binary_join_element_wise

    def put(where: NDArray, make: Callable[[Any], Any]) -> None:
        nonlocal texts
        if where.any():
            mask = arrow.array(where)
            texts = arrow.compute.replace_with_mask(texts, mask, make(texts.filter(mask)))

    def scientific(zeros: int, end: str) -> Callable[[Any], Any]:
        return lambda old: join(cut(cut(old, 0, zeros, ''), 1, 1, '.'), end, '')

    own = ((size >= 1e-6) & (size < 1e-4)) | ((size >= 1e10) & (size < 1e16))
    for zeros, least, end in ((6, 1e-5, 'e-05'), (7, 1e-6, 'e-06')):
        several = arrow.compute.binary_length(texts).to_numpy() > zeros + 1
        where = several & (numbers >= least) & (numbers < least * 10.0)
        put(where, scientific(zeros, end))
        own &= ~where
    put(own, lambda old: arrow.array(list(map(repr, numbers[own].tolist()))))
    put((size >= 1e-9) & (size < 1e-6), lambda old: cut(old, -1, -1, '0'))
    with np.errstate(invalid='ignore'):  # of a NaN that signals
        whole = (size < 1e10) & (numbers == np.rint(numbers))
    put(whole, lambda old: join(old, '.0', ''))
    return texts


def in_cell(text: str) -> str:
    """`text` as a cell, visible; an apostrophe stands before what may be a formula. A number that
    is text already, such as '-1.50', stays as it is."""
    shown = visible(text)
    if not _FORMULA.match(text):
        return shown
    try:
        float(text)
    except ValueError:
        return f"'{shown}"
    return shown if text.isprintable() else f"'{shown}"
