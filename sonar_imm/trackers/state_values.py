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

"""The state of a tracker as data, and back.

`frozen_state` takes what changes out of a tracker in a moment, since values need no copy.
`Encoder` makes JSON and one block of bytes of it, `Decoder` the way back, `restore` puts it into
a tracker that was just built. Functions are not state: the fresh tracker has its own.

What is decoded may come from anybody. So the decoder makes only classes that it is given, and a
name in the data does no more than choose among them. Nothing is looked up, imported or called by
name. Values with checks of their own are checked by them, all others against the types of their
fields. Arrays have number types, and fill the block one after another: their sizes are those of
the bytes that are there.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
import contextlib
from functools import cache
import math
from types import FunctionType, MethodType, UnionType
from typing import Any, get_args, get_origin, get_type_hints, TypeVar, Union

import attrs
import numpy as np

from ..parameters import Config
from ..texts import in_one_line

_PLAIN = (type(None), bool, int, float, str)
_NUMBERS = 'biufc'
_KINDS = 'b1 i1 i2 i4 i8 u1 u2 u4 u8 f2 f4 f8 c8 c16'.split()
_DTYPES = {order + kind for order in (np.dtype(np.int64).str[0], '|') for kind in _KINDS}
_SKIPPED = object()
_LONGEST = 200
"""Characters of what a file says that are repeated in a sentence."""
_WORD = 1 << 63
_KEYS = 10_000
"""Keys of one mapping that are no text or bytes: whoever chooses these can make all of them fall
into one place of the table, which takes the square of their number."""

_SHAPES = {
    'Bodies': 'number:T std:T2',
    'Cells': 'key:C number:C height:C variance:C stamp_ns:C',
    'DiverState': 'x:TMn P:TMnn mu:TM learnt:TaLL nis:T nis_dof:T score:T white:T2 existence:T '
    'evidence:T target_id:T near_to:T near_for:T refused:T6 refused_z:T3 spreads:T looks:T '
    'life.age:T',
    'Existence': 'log_odds:T pings:T held:T silence:T',
    'Landmark': 'which:k x:kn P:knn mu:k place:3 covariance:33',
    'Looks': 'seen:T due:T missed:T silent:T shown.mu:TK',
    'Mixture': 'x:TKn P:TKnn mu:TK',
    'Offsets': 'score:s variance:ss length:p',
    'PingState': 'life.age:T mixture.x:TKn nis:T bodies.number:T looks.seen:T '
    'existence.pings:T looks.shown.x:TKn',
    'Pose': 'position:*3 R:*33',
    'RecentPairs': 'tx:p3 rx:p3 variance:p age:p',
    'Response': 'depth:D amplitude:D sigma:D',
    'SampledPulse': 'distance:d value:d',
    'Seen': 'track_id:m depth:m variance:m sign:m',
    'SetStep': 'sets.cell:NJ w:N amplitude:NJ source:N after.log_weight:N',
    'Sets': 'order:N cell:NJ prior_mean:Na prior_variance:Na sign:NJ shift:N',
    'ShiftPath': 'pull:N',
    'Sonar': 'course:3',
    'Tracks': 'track_id:T status:T age:T seen:Tw misses:T last_hit_ns:T',
    'Weighted': 'sets.order:N log_weight:N path.pull:N',
}
"""Shapes of the arrays of values without checks of their own, by the name of the class: a letter
is a length, the same for all of one value, a digit that length; ``*`` any number of axes. Compiled
kernels rely on them."""

UNFIT = (
    ArithmeticError,
    AttributeError,
    LookupError,
    MemoryError,
    RecursionError,
    TypeError,
    ValueError,
)
"""What data that say something else than a tracker would have written raise."""


class StateError(ValueError):
    """A state that cannot be used; one sentence."""

    def __init__(self, sentence: str):
        super().__init__(in_one_line(sentence))


@contextlib.contextmanager
def understood(*more: type[Exception]) -> Iterator[None]:
    """Raises `StateError` in place of what data raise that do not fit, `more` included."""
    try:
        yield
    except StateError:
        raise
    except UNFIT + more as error:
        why = str(error)[:_LONGEST] or type(error).__name__
        raise StateError(f'it does not fit this version ({why})') from None


@attrs.frozen
class FrozenObject:
    """The class and the attributes of an object that changes."""

    cls: type
    attributes: dict[str, Any]


def frozen_state(tracker: Any) -> dict[str, Any]:
    """What `tracker` knows now; it stays as it is while the tracker goes on."""
    return {name: freeze(getattr(tracker, name)) for name in tracker.STATE}


def restore(tracker: Any, state: dict[str, Any]) -> None:
    """Put a state into a tracker of the same parameters that was just built or reset.

    Raises `StateError` when it is the state of another tracker; the tracker is of no use then."""
    if not isinstance(state, dict) or set(state) != set(tracker.STATE):
        raise StateError('it belongs to another tracker, or to another version')
    with understood():
        for name, value in state.items():
            setattr(tracker, name, put(getattr(tracker, name), value))
        getattr(tracker, 'restored', lambda: None)()


def freeze(value: Any) -> Any:
    """`value` as it is now, a copy where it can change. Attrs classes and tuples are values."""
    kind = type(value)
    if kind in _PLAIN or attrs.has(kind) or isinstance(value, (bytes, tuple, type, np.generic)):
        return value
    if kind is np.ndarray:
        return value.copy() if value.flags.writeable else value
    if kind is list:
        return [freeze(item) for item in value]
    if kind in (dict, Counter):
        return kind({key: freeze(item) for key, item in value.items()})
    if kind is deque:
        return deque((freeze(item) for item in value), value.maxlen)
    if isinstance(value, (FunctionType, MethodType)):
        return _SKIPPED
    if kind is slice or not hasattr(value, '__dict__'):
        return value  # what `Encoder` does not know it refuses
    items = {name: freeze(item) for name, item in vars(value).items() if name[:2] != '__'}
    return FrozenObject(kind, {k: value for k, value in items.items() if value is not _SKIPPED})


def put(there: Any, value: Any) -> Any:
    """What stands for `value` in a tracker that has `there` in its place: objects and counters are
    changed where they are, since others may hold them too. Raises ValueError for a value that
    cannot stand there."""
    if value is _SKIPPED:
        return there
    if isinstance(value, FrozenObject):
        return _put_object(there, value)
    if there is not None and _sort(there) is not _sort(value):
        raise ValueError(f'{type(value).__name__} in place of {type(there).__name__}')
    if isinstance(there, Config):
        there.require_changeable(value)
    if isinstance(value, Counter):
        if not isinstance(there, Counter):
            raise ValueError('a counter in place of nothing')
        there.clear()
        there.update(value)
        return there
    if isinstance(value, list):
        return [put(None, item) for item in value]
    if isinstance(value, deque):
        if there is not None and there.maxlen != value.maxlen:
            raise ValueError('a queue of another length')
        return deque((put(None, item) for item in value), value.maxlen)
    if type(value) is dict:
        return {key: put(None, item) for key, item in value.items()}
    return value


def _put_object(there: Any, value: FrozenObject) -> Any:
    """`put` of an object: with the attributes that there are, and more that it may have got since
    it was built, none of which may hide what its class has."""
    cls: Any = value.cls
    if there is not None and type(there) is not cls:
        raise ValueError(f'{cls.__name__} in place of {type(there).__name__}')
    target = cls.__new__(cls) if there is None else there
    known = {} if there is None else dict(vars(there))
    needed = {
        name
        for name, item in known.items()
        if name[:2] != '__' and not isinstance(item, (FunctionType, MethodType))
    }
    for name in value.attributes:
        if name not in needed and (name in known or name[:2] == '__' or hasattr(cls, name)):
            raise ValueError(f'{cls.__name__}.{name} is no state')
    if missing := needed - set(value.attributes):
        raise ValueError(f'{cls.__name__} has no {missing.pop()}')
    for name, item in value.attributes.items():
        if isinstance(item, type):
            raise ValueError(f'{cls.__name__}.{name} is no class')
        setattr(target, name, put(known.get(name), item))
    return target


def _sort(value: Any) -> type:
    """What a value can be taken in place of: numbers for each other, all else for its kind."""
    if isinstance(value, (int, float, np.number)) and not isinstance(value, bool):
        return float
    return type(value)


class Encoder:
    """Turns data into JSON values, with all arrays in one block of bytes."""

    def __init__(self) -> None:
        self.classes: list[list[Any]] = []
        self.arrays: list[list[Any]] = []
        self.values: list[Any] = []
        """Frozen values, each after those it holds; one that several hold is there once."""
        self._numbers: dict[type, int] = {}
        self._places: dict[int, int] = {}
        self._seen: dict[int, int] = {}
        self._held: list[Any] = []
        self._blocks: list[np.ndarray] = []
        self._size = 0

    @property
    def types(self) -> set[type]:
        """The classes that were met."""
        return set(self._numbers)

    @property
    def block(self) -> np.ndarray:
        """All arrays, one after another, (bytes,) uint8."""
        parts = [np.frombuffer(block.tobytes('A'), np.uint8) for block in self._blocks]
        return np.concatenate([np.empty(0, np.uint8), *parts])

    def encode(self, value: Any) -> Any:
        """Plain values stand for themselves, anything else is a list that begins with its kind.

        Raises TypeError for what is no data: a fault of the tracker that holds it."""
        kind = type(value)
        if kind in _PLAIN:
            return value
        if kind is np.ndarray:
            return ['array', self._array(value)]
        if isinstance(value, np.generic):
            return ['number', self._array(np.asarray(value))]
        if isinstance(value, type):
            return ['class', self._class(value, [])]
        if kind is bytes:
            return ['bytes', value.hex()]
        if kind is slice:
            return ['slice', value.start, value.stop, value.step]
        if isinstance(value, FrozenObject):
            names = list(value.attributes)
            return ['object', self._class(value.cls, []), names, *self._all(value.attributes)]
        if kind in (tuple, list):
            return [kind.__name__, *map(self.encode, value)]
        if attrs.has(kind) or isinstance(value, tuple):
            if id(value) not in self._seen:
                self.values.append(self._value(value))
                self._seen[id(value)] = len(self.values) - 1
                self._held.append(value)  # so that no other one gets its identity
            return ['same', self._seen[id(value)]]
        if kind is deque:
            return ['deque', value.maxlen, *map(self.encode, value)]
        if kind in (dict, Counter):
            pairs = [[self.encode(key), self.encode(item)] for key, item in value.items()]
            return [kind.__name__, *pairs]
        raise TypeError(f'{kind.__qualname__} cannot be kept')

    def _value(self, value: Any) -> list[Any]:
        names = fields_of(type(value))
        parts = [self.encode(getattr(value, name)) for name in names]
        return ['value', self._class(type(value), names), *parts]

    def _all(self, items: dict[str, Any]) -> list[Any]:
        return [self.encode(item) for item in items.values()]

    def _class(self, cls: type, names: list[str]) -> int:
        if cls not in self._numbers:
            self._numbers[cls] = len(self.classes)
            self.classes.append([cls.__module__, cls.__qualname__, names])
        return self._numbers[cls]

    def _array(self, array: np.ndarray) -> int:
        """Its place among the arrays; one that several values share is written once."""
        if id(array) in self._places:
            return self._places[id(array)]
        if array.dtype.kind not in _NUMBERS:
            raise TypeError(f'an array of {array.dtype} cannot be kept')
        order = 'F' if array.flags.f_contiguous and not array.flags.c_contiguous else 'C'
        self.arrays.append(
            [array.dtype.str, list(array.shape), order, bool(array.flags.writeable), self._size]
        )
        self._held.append(array)
        self._blocks.append(array)
        self._size += array.nbytes
        self._places[id(array)] = len(self.arrays) - 1
        return len(self.arrays) - 1


class Decoder:
    """The way back. Raises `StateError` for what `Encoder` did not write, or wrote of classes that
    are not among `types`."""

    def __init__(
        self,
        types: Iterable[type],
        classes: list[list[Any]],
        arrays: list[list[Any]],
        values: list[Any],
        block: np.ndarray,
    ):
        known = {(cls.__module__, cls.__qualname__): cls for cls in types}
        with understood():
            self._classes = [_class_of(known, *cls) for cls in classes]
            self._arrays = list(_arrays_of(block, arrays))
            self._values: list[Any] = []
            for value in values:
                self._values.append(self._value(*value))

    def decode(self, value: Any) -> Any:
        """The data that `Encoder.encode` made a JSON value of, objects as `FrozenObject`."""
        if type(value) is int and not -_WORD <= value < 2 * _WORD:
            raise StateError('a whole number is larger than any stamp')
        if type(value) is not list:
            if type(value) is dict:
                raise StateError('a mapping is no state')
            return value
        with understood():
            return self._decode(*value)

    def _value(self, kind: str, number: int, *parts: Any) -> Any:
        """A frozen value."""
        if kind != 'value':
            raise ValueError(f'unknown kind of value {kind!r}')
        cls = self._classes[_index(number)]
        if not is_value(cls):
            raise ValueError(f'{cls.__name__} is no value')
        names = fields_of(cls)
        return made(cls, dict(zip(names, map(self.decode, parts), strict=True)))

    def _decode(self, kind: str, *parts: Any) -> Any:
        if kind in ('array', 'number'):
            array = self._arrays[_index(*parts)]
            if kind == 'number' and array.ndim:
                raise ValueError('a number of several')
            return array if kind == 'array' else array[()]
        if kind == 'slice':
            start, stop, step = (None if part is None else _index(part) for part in parts)
            return slice(start, stop, step)
        if kind == 'same':
            return self._values[_index(*parts)]
        if kind == 'bytes':
            return bytes.fromhex(*parts)
        if kind in ('tuple', 'list'):
            whole = [self.decode(part) for part in parts]
            return tuple(whole) if kind == 'tuple' else whole
        if kind == 'deque':
            length = parts[0] if parts[0] is None else _index(parts[0])
            if length is not None and length < len(parts) - 1:
                raise ValueError('a queue holds more than it can')
            return deque((self.decode(part) for part in parts[1:]), length)
        if kind in ('dict', 'Counter'):
            return self._mapping(kind, parts)
        if kind == 'class':
            return self._classes[_index(*parts)]
        if kind == 'object':
            return self._object(*parts)
        raise ValueError(f'unknown kind {kind!r}')

    def _mapping(self, kind: str, parts: Any) -> Any:
        pairs = {_key(self.decode(key)): self.decode(item) for key, item in parts}
        if sum(not isinstance(key, (str, bytes)) for key in pairs) > _KEYS:
            raise ValueError('a mapping of more than any state has')
        if kind == 'dict':
            return pairs
        if not all(isinstance(k, str) and type(v) is int for k, v in pairs.items()):
            raise ValueError('a counter counts something else')
        return Counter(pairs)

    def _object(self, number: int, names: list[str], *parts: Any) -> FrozenObject:
        cls = self._classes[_index(number)]
        if is_value(cls):
            raise ValueError(f'{cls.__name__} is no object that changes')
        if len(set(names)) != len(names) or not all(type(name) is str for name in names):
            raise ValueError(f'{cls.__name__} with names that are none')
        values = map(self.decode, parts)
        return FrozenObject(cls, dict(zip(names, values, strict=True)))


def is_value(cls: type) -> bool:
    """Whether the objects of a class are values, which do not change."""
    return attrs.has(cls) or issubclass(cls, tuple)


def fields_of(cls: type) -> list[str]:
    """The names of the fields of a class of values."""
    if attrs.has(cls):
        return [field.name for field in attrs.fields(cls)]
    return list(cls._fields)  # type: ignore[attr-defined]


def made(cls: Any, values: dict[str, Any]) -> Any:
    """A value of a class of the table. One whose class checks what it is given is built by it;
    another has its fields put in. Each has to be of the type that the class says. Raises
    ValueError."""
    if hasattr(cls, '__attrs_post_init__'):
        fields = attrs.fields(cls)
        whole = cls(**{field.alias: values[field.name] for field in fields if field.init})
        values = {name: getattr(whole, name) for name in values}
    elif attrs.has(cls):
        whole = cls.__new__(cls)
        for name, value in values.items():
            object.__setattr__(whole, name, value)
    else:
        whole = tuple.__new__(cls, values.values())
    for name, hint in _hints(cls).items():
        if name in values and not fits(values[name], hint):
            kind = type(values[name]).__name__
            raise ValueError(f'{cls.__name__}.{name} cannot be a {kind} like that')
    _check_shapes(whole)
    return whole


def _check_shapes(value: Any) -> None:
    """Raise ValueError where the arrays of a value are not as `_SHAPES` has them."""
    known: dict[str, int] = {}
    for entry in _SHAPES.get(type(value).__name__, '').split():
        path, _, axes = entry.partition(':')
        array = value
        for name in path.split('.'):
            array = None if array is None else getattr(array, name)
        if array is None:
            continue
        shape = array.shape
        if axes[0] == '*':
            axes = axes[1:]
            shape = shape[-len(axes) :]
        wanted = [
            int(axis) if axis.isdigit() else known.setdefault(axis, length)
            for axis, length in zip(axes, shape)
        ]
        if len(shape) != len(axes) or list(shape) != wanted:
            raise ValueError(f'{type(value).__name__}.{path} has another shape')


@cache
def _hints(cls: type) -> dict[str, Any]:
    return get_type_hints(cls)


def fits(value: Any, hint: Any) -> bool:
    """Whether a value is of an annotated type; numbers of numpy are numbers, and a whole number is
    one that may have a fraction. A value inside that has fields was checked when it was made."""
    origin, arguments = get_origin(hint), get_args(hint)
    if hint is Any or isinstance(hint, TypeVar):
        return True
    if origin in (Union, UnionType):
        return any(fits(value, choice) for choice in arguments)
    if hint is None or hint is type(None):
        return value is None
    if hint is np.ndarray or origin is np.ndarray:
        kind = get_args(arguments[1])[0] if arguments else np.generic
        return type(value) is np.ndarray and (
            not isinstance(kind, type) or np.issubdtype(value.dtype, kind)
        )
    if origin is tuple:
        if type(value) is not tuple:
            return False
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            return all(fits(item, arguments[0]) for item in value)
        return len(value) == len(arguments) and all(map(fits, value, arguments))
    if origin is list:
        return type(value) is list and all(fits(item, arguments[0]) for item in value)
    if origin in (dict, Mapping):
        return type(value) is dict and all(
            fits(key, arguments[0]) and fits(item, arguments[1]) for key, item in value.items()
        )
    if origin is Callable:
        return is_value(type(value)) and callable(value)
    if hint is float:
        return isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
    if hint is int:
        return isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if hint is bool:
        return isinstance(value, (bool, np.bool_))
    return isinstance(value, origin or hint)


def _class_of(known: Mapping[tuple[str, str], type], module: str, name: str, names: Any) -> type:
    """The class of the table with that name, with the fields it had."""
    cls = known.get((module, name))
    if cls is None:
        raise ValueError(f'{module}.{name} is no part of a state')
    if names and names != fields_of(cls):
        raise ValueError(f'{name} has other fields')
    return cls


def _index(value: Any) -> int:
    """A number that is not negative."""
    if type(value) is not int or value < 0:
        raise ValueError('a place that is none')
    return value


def _key(value: Any) -> Any:
    """What can be a key of a mapping."""
    parts = value if type(value) is tuple else (value,)
    if not all(isinstance(part, (str, bytes, int, type, type(None))) for part in parts):
        raise ValueError('a key that is none')
    return value


def _arrays_of(block: np.ndarray, arrays: list[list[Any]]) -> Iterator[np.ndarray]:
    """The arrays, each in memory of its own, laid out as the one that was kept. They have to fill
    the block."""
    end = 0
    for dtype, shape, order, writeable, first in arrays:
        if dtype not in _DTYPES:
            raise ValueError('an array of no numbers')
        kind = np.dtype(dtype)
        size = math.prod(map(_index, shape)) * kind.itemsize
        if _index(first) != end or first + size > len(block):
            raise ValueError('an array is not there')
        end += size
        if order not in ('C', 'F') or type(writeable) is not bool:
            raise ValueError('an array is laid out in no way')
        flat = np.frombuffer(block[first:end].tobytes(), kind)
        array = flat.reshape(shape, order=order).copy('K')
        array.flags.writeable = writeable
        yield array
    if end != len(block):
        raise ValueError('there is more than its arrays')
