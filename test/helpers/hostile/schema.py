# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Messages as trees of plain values, by the definitions of their types.

Adapters read by attribute access only, so that a tree serves as a message. Every leaf keeps to its
type: what no wire could bring is not tried.
"""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
from rosbags.interfaces import Nodetype

from .. import marine

NUMBERS = {
    'bool': 'u1', 'byte': 'u1', 'char': 'u1', 'octet': 'u1',
    'int8': 'i1', 'uint8': 'u1', 'int16': 'i2', 'uint16': 'u2', 'int32': 'i4', 'uint32': 'u4',
    'int64': 'i8', 'uint64': 'u8', 'float32': 'f4', 'float64': 'f8',
}  # fmt: skip
"""The numpy type of each number on the wire."""


def fields_of(type_name):
    """The fields of a message type: (name, node)."""
    return marine.typestore().fielddefs[type_name][1]


def make(type_name, **values):
    """A message with some fields, the others zero; the factory that writers take."""
    fields = {name: _zero(node) for name, node in fields_of(type_name)}
    return SimpleNamespace(**{**fields, **values}, __msgtype__=type_name)


def clone(value):
    """A copy that shares nothing that can change."""
    if isinstance(value, SimpleNamespace):
        return SimpleNamespace(**{name: clone(member) for name, member in vars(value).items()})
    if isinstance(value, list):
        return [clone(item) for item in value]
    return value.copy() if isinstance(value, np.ndarray) else value


def leaves(message):
    """Every place that holds something: (owner, name, node), lists and arrays as one."""
    for name, node in fields_of(message.__msgtype__):
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
        return make(detail)
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
