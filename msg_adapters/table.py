# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""PointCloud2 as a table: one row per point, one named column per field.

PointCloud2 is the only message of common_interfaces that has a header, describes its own layout
and is not deprecated, so it carries every bulk input and output here. A field with ``count > 1``
is a vector column. Decoding trusts no header: every size is checked against the bytes that are
really there before any is read.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import lru_cache
from itertools import chain
import math
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from sonar_imm.measurements import Rejection

from .headers import Make, make_header

# sensor_msgs/PointField datatypes
DATATYPES = {1: 'i1', 2: 'u1', 3: 'i2', 4: 'u2', 5: 'i4', 6: 'u4', 7: 'f4', 8: 'f8'}
_CODES = {name: code for code, name in DATATYPES.items()}

Field = tuple[str, int, np.dtype, int]

MAX_FIELDS = 1024
MAX_ROWS = 1 << 24
MAX_BYTES = 1 << 28
"""Most bytes of decoded columns: fields may overlap and unfold a small message hugely."""


def decode_table(
    message: Any, names: Collection[str] | None = None, *, most_rows: int = MAX_ROWS
) -> dict[str, NDArray]:
    """Decode a PointCloud2 into columns, in the order of its fields.

    names: the columns to decode; the others are checked, cost nothing and are left out. None for
    all. most_rows: more rows than this are refused before a column is made.
    Each column is a fresh array in native byte order: (rows,), or (rows, count) for a vector
    field; rows = height * width, row-major. Raises `Rejection` for anything that does not fit.
    """
    height, width = int(message.height), int(message.width)
    point_step, row_step = int(message.point_step), int(message.row_step)
    if height * width > most_rows:
        raise Rejection(
            'too_large', f'the table has {height * width} rows; at most {most_rows} are read'
        )
    data = _bytes_of(message.data)
    fields = _checked_fields(message.fields, point_step)
    if names is not None:
        fields = tuple(field for field in fields if field[0] in names)
    if row_step < width * point_step:
        raise Rejection(
            'bad_layout',
            f'row_step is {row_step} bytes, too short for {width} points of {point_step} bytes',
        )
    if len(data) < row_step * height:
        raise Rejection(
            'short_data',
            f'the table holds {len(data)} bytes, its layout needs {row_step * height}',
        )
    rows = height * width
    if rows and not point_step:
        raise Rejection('bad_layout', f'point_step is 0 for {rows} points')
    if rows * sum(dtype.itemsize * count for _, _, dtype, count in fields) > MAX_BYTES:
        raise Rejection('too_large', f'the table of {rows} rows exceeds {MAX_BYTES >> 20} MiB')
    order: Literal['>', '<'] = '>' if message.is_bigendian else '<'
    columns = {}
    for name, offset, dtype, count in fields:
        shape = (rows,) if count == 1 else (rows, count)
        if not rows:
            columns[name] = np.empty(shape, dtype)
            continue
        view = np.ndarray(
            (height, width, count),
            dtype.newbyteorder(order),
            buffer=data,
            offset=offset,
            strides=(row_step, point_step, dtype.itemsize),
        )
        columns[name] = view.astype(dtype).reshape(shape)
    return columns


def encode_table(columns: Mapping[str, Any], *, stamp_ns: int, frame_id: str, make: Make) -> Any:
    """Encode columns of equal length into a PointCloud2 without padding, little-endian, height 1.

    Columns are (rows,) or (rows, count) arrays of the eight PointField datatypes or bool (sent as
    u1). x, y, z come first when present, the rest keeps its order. Raises ValueError for columns
    that no PointCloud2 can hold: a programming error, not bad input.
    """
    arrays = [np.asarray(columns[name]) for name in _xyz_first(tuple(columns))]
    layout = tuple(
        (name, array.dtype, array.shape[1:] if array.ndim else None)
        for name, array in zip(_xyz_first(tuple(columns)), arrays)
    )
    dtype, fields = layout_of(make, layout)
    rows = len(arrays[0]) if arrays else 0
    packed = np.empty(rows, dtype)
    for (name, _, _), array in zip(layout, arrays):
        if len(array) != rows:
            raise ValueError(f"column '{name}' has {len(array)} rows, '{layout[0][0]}' has {rows}")
        packed[name] = array
    header = make_header(stamp_ns, frame_id, make)
    flat = all(array.ndim == 1 for array in arrays)
    return packed_table(packed, fields, is_finite(packed, arrays, flat), header, make)


def table_of(measurement: Any, columns: Mapping[str, Any], make: Make) -> Any:
    """`encode_table` with stamp and frame of `measurement`."""
    stamp, frame_id = measurement.stamp_ns, measurement.frame_id
    return encode_table(columns, stamp_ns=stamp, frame_id=frame_id, make=make)


def packed_table(
    packed: NDArray, fields: tuple[Any, ...], is_dense: bool, header: Any, make: Make
) -> Any:
    """A PointCloud2 of rows (n,) that are packed already, with the dtype and the fields of
    `layout_of`; is_dense: whether every number is finite."""
    rows, step = len(packed), packed.dtype.itemsize if fields else 0
    return make(
        'sensor_msgs/msg/PointCloud2',
        header=header,
        height=1,
        width=rows,
        fields=list(fields),
        is_bigendian=False,
        point_step=step,
        row_step=step * rows,
        data=packed.tobytes(),
        is_dense=is_dense,
    )


@lru_cache(maxsize=64)
def _xyz_first(names: tuple[str, ...]) -> tuple[str, ...]:
    """x, y, z where they are among the names, then the others in their order."""
    first = tuple(name for name in 'xyz' if name in names)
    return first + tuple(name for name in names if name not in first)


@lru_cache(maxsize=64)
def layout_of(
    make: Make, layout: tuple[tuple[str, np.dtype, tuple[int, ...] | None], ...]
) -> tuple[np.dtype, tuple[Any, ...]]:
    """The packed dtype and the PointFields of columns (name, dtype, shape of a row): most of the
    work of a small live table, done once. Raises ValueError for what a PointField cannot name."""
    kinds = []
    for name, dtype, shape in layout:
        kind = np.dtype(np.uint8) if dtype == np.bool_ else dtype
        if kind.str[1:] not in _CODES:
            raise ValueError(
                f"column '{name}' has the dtype {dtype}, which a PointField cannot name"
            )
        if shape is None or len(shape) > 1 or 0 in shape:
            raise ValueError(
                f"column '{name}' has rows of the shape {shape}, () or (count,) is needed"
            )
        kinds.append((name, kind.newbyteorder('<'), shape))
    packed = np.dtype(kinds)
    places: Mapping[str, Any] = packed.fields or {}
    fields = tuple(
        make(
            'sensor_msgs/msg/PointField',
            name=name,
            offset=places[name][1],
            datatype=_CODES[kind.str[1:]],
            count=math.prod(shape),
        )
        for name, kind, shape in kinds
    )
    return packed, fields


def is_finite(packed: NDArray, arrays: list[NDArray], flat: bool) -> bool:
    """Whether no number of rows, packed and column by column, is NaN or infinite; flat: no column
    has several. For few rows Python is quicker than numpy."""
    if flat and len(packed) <= 4:
        return all(map(math.isfinite, chain.from_iterable(packed.tolist())))
    return all(bool(np.isfinite(array).all()) for array in arrays)


def scalar_column(columns: Mapping[str, NDArray], name: str) -> NDArray[np.float64]:
    """Give the column `name` as (rows,) float64. Raises `Rejection` when it is a vector column."""
    column = columns[name]
    if column.ndim != 1:
        raise Rejection(
            'bad_field', f"column '{name}' holds {column.shape[1]} values per row, one is needed"
        )
    if column.dtype == np.float64:
        return column
    with np.errstate(invalid='ignore'):  # bytes can be a signalling NaN, which is just a NaN
        return column.astype(np.float64)


def constant_column(
    columns: Mapping[str, NDArray], name: str, *, zero_is_known: bool = False
) -> float | None:
    """Give the one value of a column that holds for the whole message; None when it is not known.

    NaN is unknown; so is 0, which drivers leave in what they do not know, unless `zero_is_known`.
    Raises `Rejection` when the value changes from row to row.
    """
    if name not in columns:
        return None
    values = scalar_column(columns, name)
    known = values[~np.isnan(values)]
    if not len(known):
        return None
    if (known != known[0]).any():
        raise Rejection('not_constant', f'column {name} changes within the message')
    return float(known[0]) if zero_is_known else float(known[0]) or None


def require_columns(columns: Mapping[str, NDArray], names: tuple[str, ...], what: str) -> None:
    """Raise `Rejection` naming the columns that are missing from a table of `what`."""
    if missing := [name for name in names if name not in columns]:
        raise Rejection(
            'missing_column', f'a table of {what} needs the column {" and ".join(missing)}'
        )


def _bytes_of(data: Any) -> memoryview:
    """View the payload: array.array from rclpy, a read-only ndarray from rosbags, or bytes."""
    try:
        return memoryview(data).cast('B')
    except (TypeError, ValueError):
        raise Rejection(
            'bad_layout',
            f'the data of the table are a {type(data).__name__}, not contiguous bytes',
        ) from None


def _checked_fields(fields: Any, point_step: int) -> tuple[Field, ...]:
    """Check every PointField: (name, offset, native dtype, count). Overlapping fields are fine."""
    if len(fields) > MAX_FIELDS:
        raise Rejection(
            'too_large', f'the table has {len(fields)} fields, at most {MAX_FIELDS} are read'
        )
    layout = tuple((str(f.name), int(f.offset), int(f.datatype), int(f.count)) for f in fields)
    return _layout_read(layout, point_step)


@lru_cache(maxsize=64)
def _layout_read(
    layout: tuple[tuple[str, int, int, int], ...], point_step: int
) -> tuple[Field, ...]:
    """As `_checked_fields`, which is the same for message after message."""
    checked: dict[str, Field] = {}
    for name, offset, datatype, count in layout:
        if not name:
            raise Rejection('bad_field', 'the table has a field without a name')
        if name in checked:
            raise Rejection('bad_field', f"the table has two fields named '{name}'")
        if datatype not in DATATYPES:
            raise Rejection('bad_field', f"field '{name}' has the unknown datatype {datatype}")
        if count < 1:
            raise Rejection('bad_field', f"field '{name}' has a count of {count}")
        dtype = np.dtype(DATATYPES[datatype])
        end = offset + dtype.itemsize * count
        if offset < 0 or end > point_step:
            raise Rejection(
                'bad_field',
                f"field '{name}' ends at byte {end}, beyond the point_step of {point_step}",
            )
        checked[name] = (name, offset, dtype, count)
    return tuple(checked.values())
