# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The state of a tracker as JSON and arrays, and back.

A state has two kinds of objects. An object that *changes*, such as a tracker or a stream, lists
the attributes that it learns in ``STATE``. Loading a state replaces these attributes of an object
that already exists. A *value*, a frozen attrs class or a named tuple, is made anew from its
fields. Functions, parameters and everything that follows from them are not saved.

In JSON an object that changes is an object of its attributes. A value is an object of its fields
and of the name of its ``class``. Tuples, lists and queues are lists; mappings are lists of pairs.
A large array is an empty object: its name in the file is the path to it, such as
``tracker/_stream/_history/_base/x``.

The file may come from anybody. Annotations of attributes and fields determine which types fit; a
name in the file only selects one of the classes in ``STATE_TYPES`` that fit there. Nothing is
looked up, imported or called by name. Shapes of arrays are part of the annotation, such as
``Annotated[FloatArray, 'Tw3']``: a capital letter is a length that a value shares with the values
in its fields, a small letter is a length of this value alone, a digit is that length, and ``*``
stands for any axes before.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable, Iterator
import contextlib
from functools import cache
import math
from types import NoneType, UnionType
from typing import Annotated, Any, get_args, get_origin, get_type_hints, TypeVar, Union

import attrs
import numpy as np

from ..parameters import Config
from ..texts import in_one_line

_PLAIN = (bool, int, float, str, NoneType)
_KINDS = 'biufcU'
"""Kinds of the numbers, and of the text, of arrays."""
_SMALL = 64
"""Arrays of at most so many numbers stand in the JSON: a buffer has thousands of poses with four
arrays each, and a part of the archive takes ten times as long."""
_LONGEST = 200
"""Most characters of a file that are repeated in a sentence."""
_WORD = 1 << 63
_KEYS = 10_000
"""Most keys of one mapping that are not text: numbers can be chosen so that all of them have the
same hash, which takes time with the square of their number."""
Lengths = tuple[dict[str, int], dict[str, int]]
"""Lengths by letter: those shared with the values around, and those of one value."""


class StateError(ValueError):
    """A state that cannot be used; one sentence."""

    def __init__(self, sentence: str):
        super().__init__(in_one_line(sentence))


@contextlib.contextmanager
def understood() -> Iterator[None]:
    """Raise `StateError` in place of any exception: data can lead to many."""
    try:
        yield
    except StateError:
        raise
    except Exception as error:
        why = str(error)[:_LONGEST] or type(error).__name__
        raise StateError(f'it does not fit this version ({why})') from None


class Attributes(dict[str, Any]):
    """The state of an object that changes."""


def frozen_state(owner: Any) -> Attributes:
    """Return a copy of the state of `owner`, which does not change while the owner goes on."""
    return Attributes({name: _frozen(getattr(owner, name)) for name in owner.STATE})


def _frozen(value: Any) -> Any:
    """Copy objects, containers and arrays that can change; values need no copy."""
    if hasattr(value, 'STATE'):
        return frozen_state(value)
    if type(value) is np.ndarray:
        return value.copy('K') if value.flags.writeable else value
    if type(value) in (list, deque):
        return [_frozen(item) for item in value]
    if isinstance(value, dict):
        return {key: _frozen(item) for key, item in value.items()}
    return value


def encoded(value: Any, path: str, arrays: dict[str, np.ndarray]) -> Any:
    """Return a frozen state as JSON; put its large arrays into `arrays`.

    Raises TypeError for an object that is neither: an error in the tracker."""
    kind: Any = type(value)
    if kind in _PLAIN:
        return value
    if kind is np.ndarray and value.dtype.kind in _KINDS:
        if value.size > _SMALL or not value.flags.c_contiguous:
            arrays[path] = value
            return {}
        size = list(value.shape)
        return {'array': value.dtype.str, 'shape': size, 'bytes': value.tobytes().hex()}
    if isinstance(value, np.generic):
        return encoded(value.item(), path, arrays)
    if isinstance(value, Config):
        return None
    if kind is Attributes:
        return {name: encoded(item, f'{path}/{name}', arrays) for name, item in value.items()}
    if attrs.has(kind) or hasattr(kind, '_fields'):
        names = ((name, getattr(value, name)) for name in _fields(kind))
        fields = {name: encoded(item, f'{path}/{name}', arrays) for name, item in names}
        return {'class': kind.__name__, **fields}
    if kind in (tuple, list, deque):
        return [encoded(item, f'{path}/{k}', arrays) for k, item in enumerate(value)]
    if kind in (dict, Counter):
        return [
            [key, encoded(item, f'{path}/{_step(key, k)}', arrays)]
            for k, (key, item) in enumerate(value.items())
        ]
    raise TypeError(f'{kind.__qualname__} cannot be kept')


def _step(key: Any, row: int) -> Any:
    """Return the name of an item of a mapping in a path."""
    return key if isinstance(key, str) and key.isidentifier() else row


@cache
def _fields(cls: Any) -> dict[str, str]:
    """Return the names of the fields of a class of values, with the names of its arguments."""
    if attrs.has(cls):
        return {field.name: field.alias for field in attrs.fields(cls) if field.init}
    return {name: name for name in cls._fields}


@cache
def _hints(cls: Any) -> dict[str, Any]:
    return get_type_hints(cls, include_extras=True)


@cache
def _form(hint: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return the kind of an annotation and its arguments; `object` for any value."""
    if isinstance(hint, TypeVar) or hint is Any:
        return object, ()
    origin = get_origin(hint) or hint
    return Union if origin is UnionType else origin, get_args(hint)


class Decoder:
    """The inverse of `encoded`. Raises ValueError and others, see `understood`, for data that
    `encoded` has not written.

    types: classes of values. arrays: by path; each is taken out when it is read. config: stands
    for all parameters in the state.
    """

    def __init__(self, types: Iterable[type], arrays: dict[str, np.ndarray], config: Config):
        self._types = {cls.__name__: cls for cls in types}
        self._arrays, self._config = arrays, config

    def put(self, owner: Any, data: Any, path: str) -> None:
        """Replace the state of an object that is there."""
        if type(data) is not dict or set(data) != set(owner.STATE):
            raise StateError('it belongs to another tracker, or to another version')
        cls: Any = type(owner)
        hints = _hints(cls)
        for name in owner.STATE:
            there, hint = getattr(owner, name), hints.get(name, Any)
            setattr(owner, name, self._read(data[name], hint, f'{path}/{name}', there))

    def _read(
        self, data: Any, hint: Any, path: str, there: Any = None, lengths: Lengths | None = None
    ) -> Any:
        """Return the value at a path, of an annotated kind; there: the value that it replaces."""
        kind, arguments = _form(hint)
        if hasattr(there, 'STATE'):
            self.put(there, data, path)
            return there
        if kind is Annotated:
            array = self._read(data, arguments[0], path, there, lengths)
            _check_shape(array.shape, arguments[1], path, lengths or ({}, {}))
            return array
        if kind is Union:
            for choice in arguments:
                with contextlib.suppress(Exception):
                    return self._read(data, choice, path, there, lengths)
            raise ValueError(f'{path} cannot be like that')
        if kind in _PLAIN or (kind is object and type(data) in _PLAIN):
            return _plain(data, kind, path)
        if kind is np.ndarray or (kind is object and 'class' not in data):
            return self._array(data, arguments, path)
        if kind in (list, tuple, deque):
            return self._items(data, kind, arguments, path, there)
        if kind in (dict, Counter):
            return self._mapping(data, kind, arguments, path, there)
        if issubclass(kind, Config):
            return self._config
        return self._value(data, kind, path, lengths)

    def _items(
        self, data: Any, kind: Any, arguments: tuple[Any, ...], path: str, there: Any
    ) -> Any:
        if type(data) is not list:
            raise ValueError(f'{path} is no list')
        if kind is not tuple or arguments[-1] is Ellipsis:
            arguments = arguments[:1] * len(data)
        both = enumerate(zip(data, arguments, strict=True))
        items = [self._read(item, hint, f'{path}/{k}') for k, (item, hint) in both]
        # The length of a queue follows from the parameters.
        return deque(items, getattr(there, 'maxlen', None)) if kind is deque else kind(items)

    def _mapping(
        self, data: Any, kind: Any, arguments: tuple[Any, ...], path: str, there: Any
    ) -> Any:
        of_key, of_item = arguments if kind is dict else (*arguments, int)
        if type(data) is not list or (of_key is not str and len(data) > _KEYS):
            raise ValueError(f'{path} is no mapping like that')
        pairs = {
            _plain(key, of_key, path): self._read(item, of_item, f'{path}/{_step(key, k)}')
            for k, (key, item) in enumerate(data)
        }
        if kind is dict or there is None:
            return kind(pairs)
        there.clear()  # other objects may count with it, too
        there.update(pairs)
        return there

    def _value(self, data: Any, kind: type, path: str, lengths: Lengths | None) -> Any:
        """Make a value by its class, which may have checks of its own."""
        cls: Any = self._types.get(data['class'])
        if cls is None or not issubclass(cls, kind):
            raise ValueError(f'{path} is of no class that fits')
        names, hints = _fields(cls), _hints(cls)
        if set(data) != {'class', *names}:
            raise ValueError(f'{path} has other fields')
        own: Lengths = (lengths[0] if lengths else {}, {})
        return cls(
            **{
                alias: self._read(data[name], hints[name], f'{path}/{name}', None, own)
                for name, alias in names.items()
            }
        )

    def _array(self, data: Any, arguments: tuple[Any, ...], path: str) -> np.ndarray:
        if data == {}:
            array = self._arrays.pop(path)
        else:
            dtype, shape, content = data['array'], data['shape'], bytes.fromhex(data['bytes'])
            if type(dtype) is not str or not all(type(length) is int for length in shape):
                raise ValueError(f'{path} is no array')
            array = array_of(content, np.dtype(dtype), shape, 'C')
        kind = get_args(arguments[1])[0] if arguments else np.generic
        if isinstance(kind, type) and not np.issubdtype(array.dtype, kind):
            raise ValueError(f'{path} is an array of {array.dtype}')
        return array


def array_of(content: bytes, dtype: Any, shape: Any, order: Any) -> np.ndarray:
    """Return an array in memory of its own. Raises ValueError where it would be of other kinds
    than numbers and text, or larger than its bytes."""
    if dtype.kind not in _KINDS or not dtype.isnative or min(shape, default=0) < 0:
        raise ValueError('an array of no numbers')
    if math.prod(shape) * dtype.itemsize != len(content):
        raise ValueError('an array is not as large as its bytes')
    return np.ndarray(tuple(shape), dtype, content, order=order).copy('K')


def _plain(data: Any, kind: Any, path: str) -> Any:
    """Return a text, a truth value or a number; a whole number fits a float, too."""
    fits = type(data) is kind or kind is object or (kind is float and type(data) is int)
    if not fits or (type(data) is int and not -_WORD <= data < 2 * _WORD):
        raise ValueError(f'{path} cannot be a {type(data).__name__} like that')
    return data


def _check_shape(shape: tuple[int, ...], axes: str, path: str, lengths: Lengths) -> None:
    """Raise ValueError for another shape than that of the annotation."""
    if axes[0] == '*':
        axes = axes[1:]
        shape = shape[-len(axes) :]
    shared, own = lengths
    wanted = [
        int(axis)
        if axis.isdigit()
        else (shared if axis.isupper() else own).setdefault(axis, length)
        for axis, length in zip(axes, shape)
    ]
    if len(shape) != len(axes) or list(shape) != wanted:
        raise ValueError(f'{path} has another shape')
