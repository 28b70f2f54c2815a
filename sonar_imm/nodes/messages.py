# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Making ROS messages that are right, with the live library.

Since Jazzy a Python message does not check what is put into it: a float32 or an int in a
``double`` field, or a 6 x 6 array in a covariance, is sent as garbage. `make` casts every field to
exactly what its definition asks for, and raises where that cannot be done. Bulk data go through
``array.array``, which is hundreds of times faster than element by element.

`make` is the live half of the factory that `msg_adapters` takes; `sonar_imm_tools.recordings` has
the other half, for bags.
"""

from __future__ import annotations

import array
from collections.abc import Callable
import functools
from importlib import import_module
from typing import Any

import numpy as np

_CODES = {
    'float': 'f',
    'double': 'd',
    'int8': 'b',
    'uint8': 'B',
    'int16': 'h',
    'uint16': 'H',
    'int32': 'i',
    'uint32': 'I',
    'int64': 'q',
    'uint64': 'Q',
}


@functools.cache
def message_class(type_name: str) -> type:
    """Find the class of ``'package/msg/Name'``.

    Raises ImportError with one sentence when it is not installed.
    """
    package, _, name = type_name.replace('/msg/', '/').partition('/')
    try:
        return getattr(import_module(f'{package}.msg'), name)
    except (ImportError, AttributeError):
        raise ImportError(f'the message type {type_name} is not installed here') from None


def is_installed(type_name: str) -> bool:
    """Return whether the class of ``'package/msg/Name'`` can be had."""
    try:
        message_class(type_name)
    except ImportError:
        return False
    return True


def make(type_name: str, **fields: Any) -> Any:
    """Make a message of `type_name`; fields left out keep their defaults.

    Raises TypeError for an unknown field and ValueError for a value of the wrong size.
    """
    cls = message_class(type_name)
    casts = _casts(cls)
    if unknown := fields.keys() - casts.keys():
        raise TypeError(f'{type_name} has no field {", ".join(sorted(unknown))}')
    return cls(**{name: casts[name](value) for name, value in fields.items()})


@functools.cache
def _casts(cls: Any) -> dict[str, Callable[[Any], Any]]:
    return {name: _cast(kind) for name, kind in cls.get_fields_and_field_types().items()}


def _cast(kind: str) -> Callable[[Any], Any]:
    """Choose the function that turns a value into what a field declared as `kind` must hold."""
    if kind.startswith('sequence<'):
        element = kind[len('sequence<') : -1].split(',')[0]
        return functools.partial(_bulk, _CODES[element]) if element in _CODES else list
    if kind.endswith(']'):
        element, _, size = kind[:-1].partition('[')
        return functools.partial(_fixed, _CODES[element], int(size)) if element in _CODES else list
    if kind in ('float', 'double'):
        return float
    if kind.startswith(('int', 'uint')):
        return int
    if kind == 'boolean':
        return bool
    if kind.startswith(('string', 'wstring')):
        return str
    return lambda value: value  # a nested message, or the one-byte octet of diagnostics


def _bulk(code: str, values: Any) -> array.array:
    """Put `values` into an array.array: bytes as they are, anything else by way of numpy."""
    if not isinstance(values, (bytes, bytearray)):
        values = np.ascontiguousarray(values, dtype=np.dtype(code)).tobytes()
    return array.array(code, values)


def _fixed(code: str, size: int, values: Any) -> np.ndarray:
    """Flatten `values` to exactly `size` numbers."""
    flat = np.array(values, dtype=np.dtype(code)).ravel()
    if flat.size != size:
        raise ValueError(f'{size} numbers are needed, got {flat.size}')
    return flat
