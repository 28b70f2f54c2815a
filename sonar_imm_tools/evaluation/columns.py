# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Estimates and truth as typed arrays: a class says of each field which columns it is read from.

A run is a list of `Estimate`, one per stamp, each a table with one row per target, range bin or
reflector. Scoring needs arrays over the whole run: a subclass of `Rows` declares them by `column`
and `covariance_of`, and `read_rows` fills them. `read_columns` reads a single table.

A name that ends in ``?`` is NaN where a table has no such column. A name that ends in ``*`` stands
for all columns that begin like it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import product
from typing import Any, TypeVar

from attrs import evolve, field, fields, frozen
import numpy as np
from numpy.typing import NDArray

from sonar_imm.estimates import Estimate
from sonar_imm.estimation.arrays import FloatArray, IndexArray, IntArray

from ..recordings.sources import BagError

_COLUMNS = 'columns'
R = TypeVar('R', bound='Rows')


class MissingColumn(BagError, ValueError):
    """A table without a column that is needed."""


@frozen
class _Columns:
    names: tuple[str, ...]
    dtype: type = np.float64
    default: float = np.nan
    prefix: str = ''

    def read(self, table: dict[str, NDArray[Any]], rows: int, missing: str) -> NDArray[Any]:
        """What one table holds: (rows,), (rows, names), or (rows, names, names) by `prefix`."""

        def values(name: str) -> NDArray[Any]:
            plain = name.rstrip('?')
            if rows and name == plain and plain not in table and np.isnan(self.default):
                raise MissingColumn(missing.format(name))
            return np.asarray(table.get(plain, np.full(rows, self.default)), self.dtype)

        if self.prefix:
            order = {name: place for place, name in enumerate(self.names)}
            pairs = (sorted(pair, key=order.__getitem__) for pair in product(self.names, repeat=2))
            flat = [values(f'{self.prefix}_{a}_{b}?') for a, b in pairs]
            return np.column_stack(flat).reshape(rows, len(order), len(order))
        if self.names[0].endswith('*'):
            found = [values(name) for name in table if name.startswith(self.names[0][:-1])]
            return np.column_stack(found or [np.empty((rows, 0))])
        found = [values(name) for name in self.names]
        return np.column_stack(found) if len(found) > 1 else found[0]


def column(*names: str, dtype: type = np.float64, default: float = np.nan) -> Any:
    """A field read from the column `names` (n,), or from several (n, len(names)); `default`: what
    stands for a column that is not there, NaN if that is an error."""
    return field(metadata={_COLUMNS: _Columns(names, dtype, default)})


def covariance_of(*names: str, prefix: str = 'cov') -> Any:
    """A field (n, k, k) of the upper triangle ``<prefix>_<a>_<b>`` of `names`; NaN if missing."""
    return field(metadata={_COLUMNS: _Columns(names, prefix=prefix)})


@frozen(eq=False, kw_only=True)
class Rows:
    """Rows of many estimates, sorted by stamp; rows of one stamp stay together.

    scan_ns: (scans,) stamps of all estimates, also of those without rows. stamp_ns: (n,).
    """

    scan_ns: IntArray
    stamp_ns: IntArray

    def __len__(self) -> int:
        return len(self.stamp_ns)

    def pick(self: R, rows: Any) -> R:
        """The same run with some of its rows (a mask, indices or a slice); `scan_ns` is kept."""
        names = ('stamp_ns', *_declared(type(self)))
        return evolve(self, **{name: getattr(self, name)[rows] for name in names})

    def spans(self, stamp_ns: IntArray) -> tuple[IndexArray, IndexArray]:
        """First row (m,) of each stamp (m,), and one behind the last (m,)."""
        first = np.searchsorted(self.stamp_ns, stamp_ns, side='left')
        return first, np.searchsorted(self.stamp_ns, stamp_ns, side='right')

    def by_track(self: R) -> Iterator[tuple[int, R]]:
        """The rows of each ``track_id``; of several with one stamp the last counts."""
        track_id = getattr(self, 'track_id')  # noqa: B009
        for number in np.unique(track_id).tolist():
            own = self.pick(track_id == number)
            yield number, own.pick(np.append(np.diff(own.stamp_ns) > 0, True))


def read_rows(kind: type[R], estimates: Iterable[Estimate], missing: str, **further: Any) -> R:
    """The rows of `estimates` as an object of class `kind`; further: its fields that are no
    columns. Raises `MissingColumn` with the sentence `missing`, in which ``{}`` stands for the
    name of a column that is needed and not there."""
    ordered = sorted(estimates, key=lambda estimate: estimate.stamp_ns)
    filled = [estimate for estimate in ordered if len(estimate)]
    tables = [(estimate.columns(), len(estimate)) for estimate in filled] or [({}, 0)]
    columns = {
        name: np.concatenate([spec.read(table, rows, missing) for table, rows in tables])
        for name, spec in _declared(kind).items()
    }
    stamps = np.array([estimate.stamp_ns for estimate in filled], np.int64)
    return kind(
        scan_ns=np.array([estimate.stamp_ns for estimate in ordered], np.int64),
        stamp_ns=np.repeat(stamps, [len(estimate) for estimate in filled]),
        **columns,
        **further,
    )


def read_columns(table: Estimate, names: Iterable[str], missing: str) -> dict[str, FloatArray]:
    """The columns `names` of one table, each (n,). Raises `MissingColumn` as `read_rows` does."""
    columns = table.columns()
    read = {name.rstrip('?'): _Columns((name,)).read for name in names}
    return {name: values(columns, len(table), missing) for name, values in read.items()}


def _declared(kind: type[Rows]) -> dict[str, _Columns]:
    declared = (entry for entry in fields(kind) if _COLUMNS in entry.metadata)
    return {entry.name: entry.metadata[_COLUMNS] for entry in declared}
