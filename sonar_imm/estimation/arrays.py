# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Names for arrays by the kind of number they hold; the shapes stand in the docstrings."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, cast, TypeVar

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
IndexArray = NDArray[np.intp]

Table = TypeVar('Table', bound='tuple[Any, ...]')
"""A named tuple of arrays of one length, its columns; a column may be a table itself."""


def take(table: Table, rows: IndexArray | BoolArray) -> Table:
    """Return the `rows` of a table."""
    return _made(table, (take(c, rows) if isinstance(c, tuple) else c[rows] for c in table))


def append(table: Table, new: Table) -> Table:
    """Return a table with the rows of another one behind its own."""
    return _made(
        table,
        (
            append(ours, theirs) if isinstance(ours, tuple) else np.concatenate([ours, theirs])
            for ours, theirs in zip(table, new)
        ),
    )


def replace_rows(table: Table, rows: IndexArray, new: Table) -> Table:
    """Return a copy of a table with `new` in some of its rows."""

    def replaced(ours: Any, theirs: Any) -> Any:
        if isinstance(ours, tuple):
            return replace_rows(ours, rows, theirs)
        column = ours.copy()
        column[rows] = theirs
        return column

    return _made(table, map(replaced, table, new))


def _made(table: Table, columns: Iterable[Any]) -> Table:
    return cast(Table, cast(Any, table)._make(columns))


def with_rows(array: NDArray[Any], count: int, value: Any) -> NDArray[Any]:
    """`array` (n, ...) and behind it `count` rows with a value for all or one for each. For a few
    rows this is quicker than to make an array of the value first."""
    n = len(array)
    out = np.empty((n + count, *array.shape[1:]), array.dtype)
    out[:n], out[n:] = array, value
    return out
