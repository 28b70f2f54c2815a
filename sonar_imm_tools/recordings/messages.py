# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Messages of rosbags: the ROS 2 Jazzy types, and the factory that the adapters write with."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.serde import SerdeError
from rosbags.typesys import get_typestore, Stores
from rosbags.typesys.store import Typestore

_NUMBERS = 'bool float32 float64 int8 int16 int32 int64 uint8 uint16 uint32 uint64'.split()
_DTYPES = {name: np.dtype(name) for name in _NUMBERS}
_DTYPES |= dict.fromkeys(('octet', 'byte', 'char'), np.dtype(np.uint8))
_SCALARS: dict[str, type] = {'string': str, 'wstring': str}
_SCALARS |= {name: {'b': bool, 'f': float}.get(each.kind, int) for name, each in _DTYPES.items()}


@cache
def typestore() -> Typestore:
    """The message types of ROS 2 Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)


def ros_message(type_name: str, /, **fields: Any) -> Any:
    """Build a rosbags message; the `make` of the adapters for recordings.

    Fields left out are zero or empty. Bulk data may be bytes, arrays or lists: they are copied
    into the strict one-dimensional arrays that rosbags serializes. Raises TypeError for a field
    the type does not have.
    """
    message_class, kinds = _layout(type_name)
    if unknown := fields.keys() - kinds.keys():
        raise TypeError(f'{type_name} has no field {", ".join(sorted(unknown))}')
    values = (
        _cast(kind, fields[name]) if name in fields else _default(kind)
        for name, kind in kinds.items()
    )
    return message_class(*values)


@cache
def _layout(type_name: str) -> tuple[Any, dict[str, Any]]:
    """Look up the class of a message and the kinds of its fields, in order."""
    return typestore().types[type_name], dict(typestore().fielddefs[type_name][1])


def cdr_of(message: Any) -> bytes:
    """The bytes of a message that `ros_message` made, or that was read, as ROS 2 sends it."""
    return bytes(typestore().serialize_cdr(message, message.__msgtype__))


def decode_cdr(types: Typestore, type_name: str, raw: bytes) -> Any:
    """Decode CDR bytes into a rosbags message. Raises `SerdeError` or KeyError (unknown type).

    Fast-CDR, the usual serializer of ROS 2, reserves room to align the elements of sequences. It
    leaves that room at the end when the last sequences are empty, as in a JointState without
    velocities. rosbags takes this for damage, so up to 16 spare bytes are cut off.
    """
    for spare in (0, 4, 8, 12):
        try:
            return types.deserialize_cdr(raw[: len(raw) - spare], type_name)
        except SerdeError as error:
            if 'size mismatch' not in str(error):
                raise
    return types.deserialize_cdr(raw[:-16], type_name)


def _cast(kind: Any, value: Any) -> Any:
    """Give `value` exactly the Python type that rosbags wants for a field."""
    node, detail = kind
    if node == Nodetype.BASE:
        return _SCALARS[detail[0]](value)
    if node in (Nodetype.ARRAY, Nodetype.SEQUENCE) and _is_numeric(detail[0]):
        dtype = _DTYPES[detail[0][1][0]]
        if isinstance(value, (bytes, bytearray, memoryview)):
            return np.frombuffer(value, dtype).copy()
        return np.array(value, dtype).ravel()
    return value


def _default(kind: Any) -> Any:
    node, detail = kind
    if node == Nodetype.NAME:
        return ros_message(detail)
    if node == Nodetype.BASE:
        return _SCALARS[detail[0]]()
    element, length = detail
    if _is_numeric(element):
        return np.zeros(length if node == Nodetype.ARRAY else 0, _DTYPES[element[1][0]])
    return [_default(element) for _ in range(length)] if node == Nodetype.ARRAY else []


def _is_numeric(element: Any) -> bool:
    return element[0] == Nodetype.BASE and element[1][0] in _DTYPES
