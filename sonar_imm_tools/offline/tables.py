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

"""The rows of a run as CSV and as Parquet: the same columns, in the same order."""

from __future__ import annotations

from collections.abc import Mapping
import csv
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from ..recordings.writer import naming

ROWS_IN_A_GROUP = 65536


class Table(Protocol):
    """What rows can be appended to; use it in a ``with`` statement."""

    def __enter__(self) -> Table: ...

    def __exit__(self, *_: object) -> None: ...

    def write(self, stamp_ns: int, columns: Mapping[str, Any]) -> None:
        """Append the rows (n,) of one stamp. Raises ValueError when the columns change."""
        ...


class CsvTable:
    """A table as CSV, one line per row; floats as the shortest text that reads back exactly."""

    def __init__(self, path: Path):
        self._path = path
        self._file = path.open('w', encoding='utf-8', newline='')
        self._writer = csv.writer(self._file, lineterminator='\n')
        self._names: list[str] | None = None

    def __enter__(self) -> CsvTable:
        return self

    def __exit__(self, *_: object) -> None:
        with naming(self._path):
            self._file.close()

    def write(self, stamp_ns: int, columns: Mapping[str, Any]) -> None:
        """Append the rows (n,) of one stamp. Raises ValueError when the columns change."""
        if self._names is None:
            self._names = list(columns)
            self._writer.writerow(['stamp_ns', *columns])
        elif self._names != list(columns):
            raise ValueError('the columns change from one estimate to another')
        with naming(self._path):
            for row in zip(*(column.tolist() for column in columns.values())):
                self._writer.writerow([stamp_ns, *row])


def require_parquet() -> None:
    """Raise ModuleNotFoundError when Parquet cannot be written; to say so before the work."""
    import pyarrow.parquet  # noqa: F401


class ParquetTable:
    """A table as Parquet, with the types of the columns: stamp_ns is int64.

    notes: texts kept in the metadata of the file, by name. Rows are held until there are enough
    for a row group. Raises ModuleNotFoundError without pyarrow.
    """

    def __init__(self, path: Path, notes: Mapping[str, str] | None = None):
        import pyarrow
        import pyarrow.parquet

        self._arrow = pyarrow
        self._path = path
        self._notes = dict(notes or {})
        self._writer: Any = None
        self._held: list[dict[str, np.ndarray]] = []
        self._rows_held = 0
        self._types: dict[str, np.dtype] = {}

    def __enter__(self) -> ParquetTable:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        with naming(self._path):
            if kind is None:
                self._write_group()
            if self._writer is not None:
                self._writer.close()

    def write(self, stamp_ns: int, columns: Mapping[str, Any]) -> None:
        """Append the rows (n,) of one stamp. Raises ValueError when the columns change."""
        rows = len(next(iter(columns.values()), ()))
        found = {'stamp_ns': np.full(rows, stamp_ns, np.int64)}
        found |= {name: np.array(column) for name, column in columns.items()}
        if not self._types:
            self._types = {name: column.dtype for name, column in found.items()}
        elif list(self._types) != list(found):
            raise ValueError('the columns change from one estimate to another')
        self._held.append(found)
        self._rows_held += rows
        if self._rows_held >= ROWS_IN_A_GROUP:
            self._write_group()

    def _write_group(self) -> None:
        arrow = self._arrow
        types = self._types or {'stamp_ns': np.dtype(np.int64)}
        if self._writer is None:
            fields = [(name, arrow.from_numpy_dtype(dtype)) for name, dtype in types.items()]
            schema = arrow.schema(fields, metadata=self._notes)
            self._writer = arrow.parquet.ParquetWriter(str(self._path), schema)
        if not self._held:
            return
        columns = [
            np.concatenate([rows[name] for rows in self._held]).astype(dtype, copy=False)
            for name, dtype in types.items()
        ]
        self._held, self._rows_held = [], 0
        self._writer.write_table(arrow.table(columns, schema=self._writer.schema))
