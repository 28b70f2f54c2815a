# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Messages as trees of plain values by the definitions of their types, and what is done to them.

Adapters read by attribute access only, so that a tree serves as a message. A mutation takes a
message, which it may change, and a generator of random numbers; most leave one that gets past the
first checks. Every leaf keeps to its type: what no wire could bring is not tried.
"""

from __future__ import annotations

from functools import cache
from types import SimpleNamespace

import numpy as np
from rosbags.interfaces import Nodetype

from msg_adapters.table import DATATYPES

from .. import marine

SECOND = 10**9
NUMBERS = {
    'bool': 'u1', 'byte': 'u1', 'char': 'u1', 'octet': 'u1',
    'int8': 'i1', 'uint8': 'u1', 'int16': 'i2', 'uint16': 'u2', 'int32': 'i4', 'uint32': 'u4',
    'int64': 'i8', 'uint64': 'u8', 'float32': 'f4', 'float64': 'f8',
}  # fmt: skip
"""The numpy type of each number on the wire."""


@cache
def definitions():
    """The fields of every message type that an adapter reads: (name, node) by type."""
    defined = marine.typestore().fielddefs
    return {name: tuple(fields) for name, (_, fields) in defined.items()}


def blank(type_name):
    """A message of zeros."""
    return SimpleNamespace(
        **{name: _zero(node) for name, node in definitions()[type_name]}, __msgtype__=type_name
    )


def make(type_name, **values):
    """A message with some fields; the factory that writers take."""
    message = blank(type_name)
    for name, value in values.items():
        setattr(message, name, value)
    return message


def clone(value):
    """A copy that shares nothing that can change."""
    if isinstance(value, SimpleNamespace):
        return SimpleNamespace(**{name: clone(member) for name, member in vars(value).items()})
    if isinstance(value, list):
        return [clone(item) for item in value]
    return value.copy() if isinstance(value, np.ndarray) else value


def leaves(message):
    """Every place that holds something: (owner, name, node), lists and arrays as one."""
    for name, node in definitions()[message.__msgtype__]:
        kind, detail = node
        if kind == Nodetype.NAME:
            yield from leaves(getattr(message, name))
            continue
        yield message, name, node
        if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) and detail[0][0] == Nodetype.NAME:
            for item in getattr(message, name)[:3]:
                yield from leaves(item)


def number_type(node):
    """The numpy type of a leaf or of its elements; None for text and for messages."""
    kind, detail = node
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        return number_type(detail[0])
    return np.dtype(NUMBERS[detail[0]]) if kind == Nodetype.BASE and detail[0] in NUMBERS else None


def is_many(node):
    return node[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE)


def is_sequence(node):
    return node[0] == Nodetype.SEQUENCE


def is_bool(node):
    return node[0] == Nodetype.BASE and node[1][0] == 'bool'


def _zero(node):
    kind, detail = node
    if kind == Nodetype.NAME:
        return blank(detail)
    if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
        inner, count = detail
        length = count if kind == Nodetype.ARRAY else 0
        number = number_type(inner)
        if number is not None:
            return np.zeros(length, number)
        return [_zero(inner) for _ in range(length)]
    if detail[0] in NUMBERS:
        return False if detail[0] == 'bool' else np.zeros((), NUMBERS[detail[0]]).item()
    return ''


ODD = np.array([
    np.nan, np.inf, -np.inf, 0.0, -0.0, -1.0, 1.0, 5e-324, 1e-45, 1e-30, 1e-12, 1e-6, 0.5, 3.0,
    np.pi, 90.0, 360.0, 1e5, 1e12, 1e30, 3e38, 1.7e308, -1e5, -1e30, 2.0**24, 2.0**53,
])  # fmt: skip
TEXTS = [
    '', ' ', 'map', 'other', 'map_ned', '/map', '<script>alert(1)</script>', 'ü' * 200, 'a/b',
    'a\nb', '\x1b[2J', 'z' * 5000,
]  # fmt: skip
_CODES = {name: code for code, name in DATATYPES.items()}
TABLE = 'sensor_msgs/msg/PointCloud2'


def odd_field(message, rng):
    """An odd value in any field, however deep."""
    places = list(leaves(message))
    owner, name, node = places[rng.integers(len(places))]
    value = getattr(owner, name)
    if is_many(node):
        setattr(owner, name, _odd_many(value, node, rng))
    else:
        setattr(owner, name, _odd_one(value, node, rng))


def odd_table(message, rng):
    """Odd numbers, rows or columns in a table; an odd field in what is none."""
    if message.__msgtype__ != TABLE:
        return odd_field(message, rng)
    columns = _columns(message)
    for _ in range(1 + rng.integers(2)):
        _COLUMNS[rng.integers(len(_COLUMNS))](columns, rng)
    _encode(message, columns, rng)


def odd_layout(message, rng):
    """The same table, laid out in another way: byte order, padding, height, order of fields."""
    if message.__msgtype__ != TABLE:
        return odd_field(message, rng)
    _encode(message, _columns(message), rng, strange=True)


def claim(message, rng):
    """A table that claims what it does not hold."""
    if message.__msgtype__ != TABLE:
        return odd_field(message, rng)
    big = int(rng.choice([0, 1, 2, 3, 7, 255, 2**16, 2**24, 2**31 - 1, 2**31, 2**32 - 1]))
    if rng.random() < 0.4 and message.fields:
        field = message.fields[rng.integers(len(message.fields))]
        name = str(rng.choice(['offset', 'count', 'datatype']))
        setattr(field, name, big % 256 if name == 'datatype' else big)
    elif rng.random() < 0.3:
        message.data = message.data[: int(rng.integers(len(message.data) + 1))]
    else:
        setattr(message, str(rng.choice(['height', 'width', 'point_step', 'row_step'])), big)


def odd_stamp(message, rng):
    """A stamp that goes back, forward, or nowhere."""
    stamp = getattr(getattr(message, 'header', None), 'stamp', None)
    if stamp is None:
        return odd_field(message, rng)
    kind = rng.integers(6)
    if kind == 0:
        stamp.sec = int(rng.choice([0, 1, -1, -(2**31), 2**31 - 1]))
    elif kind == 1:
        stamp.nanosec = int(rng.choice([0, 1, 10**9 - 1, 10**9, 2**32 - 1]))
    else:
        shift = int(
            rng.choice([-1, 1]) * 10.0 ** rng.uniform(0.0, [9.0, 10.5, 12.0, 17.0][kind - 2])
        )
        total = min(max(stamp.sec * SECOND + stamp.nanosec + shift, 0), (2**31 - 1) * SECOND)
        stamp.sec, stamp.nanosec = divmod(total, SECOND)


def again(message, rng):
    """Nothing: the message is sent again, or on another input."""


MUTATIONS = (odd_field, odd_table, odd_table, odd_layout, claim, odd_stamp, again)


def mutated(message, mutation, rng):
    """A copy of a message, changed once or twice."""
    message = clone(message)
    mutation(message, rng)
    if rng.random() < 0.3:
        MUTATIONS[rng.integers(len(MUTATIONS))](message, rng)
    return message


def _odd_one(value, node, rng):
    number = number_type(node)
    if number is None:
        return str(rng.choice(TEXTS))
    if is_bool(node):
        return bool(rng.integers(2))
    if number.kind == 'f':
        return float(_odd_floats(np.asarray(value, number), rng))
    limits = np.iinfo(number)
    return int(
        rng.choice([limits.min, limits.max, 0, 1, 2, 3, rng.integers(limits.min, limits.max)])
    )


def _odd_floats(values, rng):
    """Values like those given, or none at all like them."""
    with np.errstate(all='ignore'):
        kind = rng.integers(4)
        if kind == 0:
            new = values * 10.0 ** rng.uniform(-40.0, 40.0)
        elif kind == 1:
            new = values + rng.normal(size=values.shape) * 10.0 ** rng.uniform(-9.0, 3.0)
        else:
            new = rng.choice(ODD, values.shape)
        return np.asarray(new).astype(values.dtype)


def _odd_numbers(values, rng):
    """An array with odd numbers in some or all places."""
    where = rng.random(values.shape) < rng.choice([0.1, 0.5, 1.0])
    if values.dtype.kind == 'f':
        return np.where(where, _odd_floats(values, rng), values)
    limits = np.iinfo(values.dtype)
    new = rng.choice([limits.min, limits.max, 0, 1, 2, 3], values.shape)
    return np.where(where, new, values).astype(values.dtype)


def _odd_many(value, node, rng):
    if isinstance(value, list):
        if not is_sequence(node):
            return value
        if not value or rng.random() < 0.2:
            return []
        picked = rng.integers(len(value), size=int(rng.integers(1, 2 * len(value) + 1)))
        return [clone(value[i]) for i in picked]
    if is_sequence(node) and rng.random() < 0.3:
        length = int(rng.choice([0, 1, max(len(value) - 1, 0), len(value) + 1, 1000]))
        return np.resize(value, length) if len(value) else np.ones(length, value.dtype)
    return _odd_numbers(value, rng)


# -- tables ---------------------------------------------------------------------------------------


def _columns(message):
    """The columns of a good table; nothing of one that is damaged already."""
    columns = {}
    rows = message.height * message.width
    for field in message.fields:
        code = DATATYPES.get(field.datatype)
        if code is None or field.count < 1 or field.count > 5000:
            continue
        dtype = np.dtype((np.dtype(code).newbyteorder('<'), (field.count,)))
        end = field.offset + dtype.itemsize
        if rows * message.point_step > len(message.data) or end > message.point_step:
            continue
        raw = np.asarray(message.data[: rows * message.point_step], 'u1')
        raw = raw.reshape(rows, message.point_step)[:, field.offset : end]
        columns[field.name] = np.ascontiguousarray(raw).view(f'<{code}').reshape(rows, field.count)
    return columns


def _one(columns, rng):
    names = list(columns)
    return names[rng.integers(len(names))] if names else None


def _odd_values(columns, rng):
    if (name := _one(columns, rng)) is not None:
        columns[name] = _odd_numbers(columns[name], rng)


def _odd_rows(columns, rng):
    rows = len(next(iter(columns.values()), ()))
    count = int(rng.choice([0, 1, 2, max(rows - 1, 0), rows, rows + 1, 3 * rows, 400]))
    if rng.random() < 0.5 and count <= rows:
        which = np.sort(rng.permutation(rows)[:count])
    else:
        which = rng.integers(max(rows, 1), size=count if rows else 0)
    for name in columns:
        columns[name] = columns[name][which]


def _fewer_columns(columns, rng):
    if (name := _one(columns, rng)) is not None:
        column = columns.pop(name)
        if rng.random() < 0.5:
            columns[str(rng.choice(TEXTS)) or 'x'] = column


def _other_count(columns, rng):
    if (name := _one(columns, rng)) is not None:
        count = int(rng.choice([1, 2, 3, 5, 8, 32, 200]))
        columns[name] = np.resize(columns[name], (len(columns[name]), count))


def _other_type(columns, rng):
    if (name := _one(columns, rng)) is not None:
        with np.errstate(all='ignore'):
            kind = str(rng.choice(list(DATATYPES.values())))
            columns[name] = columns[name].astype(f'<{kind}')


_COLUMNS = (
    _odd_values, _odd_values, _odd_values, _odd_rows, _fewer_columns, _other_count, _other_type,
)  # fmt: skip


def _encode(message, columns, rng, strange=False):
    """Write columns into a PointCloud2, with padding and byte order as it comes."""
    strange = strange or rng.random() < 0.2
    order = '>' if strange and rng.random() < 0.5 else '<'
    names = list(columns)
    if strange:
        rng.shuffle(names)
    fields, parts, offset = [], [], 0
    rows = len(next(iter(columns.values()), ()))
    for name in names:
        gap = int(rng.integers(5)) if strange else 0
        column = columns[name].astype(columns[name].dtype.newbyteorder(order))
        raw = np.ascontiguousarray(column).view('u1').reshape(rows, -1) if rows else None
        parts += [np.zeros((rows, gap), 'u1'), raw]
        fields.append(
            make(
                'sensor_msgs/msg/PointField', name=name, offset=offset + gap,
                datatype=_CODES[column.dtype.str[1:]], count=column.shape[1],
            )
        )  # fmt: skip
        offset += gap + column.dtype.itemsize * column.shape[1]
    height = int(rng.choice([h for h in range(1, 5) if rows % h == 0])) if strange else 1
    table = np.concatenate(parts, axis=1) if rows and parts else np.zeros((rows, 0), 'u1')
    width, pad = rows // height, int(rng.integers(9)) if strange else 0
    lines = table.reshape(height, width * table.shape[1]) if height else table
    lines = np.concatenate([lines, np.zeros((len(lines), pad), 'u1')], axis=1)
    message.fields, message.is_bigendian = fields, order == '>'
    message.height, message.width, message.point_step = height, width, offset
    message.row_step, message.data = lines.shape[1], np.ascontiguousarray(lines).ravel()
