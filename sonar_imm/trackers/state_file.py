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

"""The state of a tracker in a file, and back: what goes on afterwards is bit for bit the same.

A tracker names the attributes that change (``STATE``). Everything they hold is data: numbers,
text, arrays, containers, frozen values (attrs classes and named tuples) and a few objects of this
package. `frozen_state` takes them out of the tracker in a moment, since values need no copy;
`encode` turns them into JSON and one block of bytes, which may take longer and happen elsewhere;
`decode` and `restore` put them into a tracker that was just built. Functions, and what is made of
the parameters, are not state: the fresh tracker has its own.

Nothing is executed that a file says: only classes of this package are made, without a call, and
arrays have number types only.

A file is one line that says what it is, the SHA-256 of the rest, and the rest: an npz of
``header`` (JSON) and ``block`` (the bytes of all arrays). Whatever happens, there is a whole file,
the old or the new one.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterator
import contextlib
import hashlib
from importlib import import_module
import io
import json
from pathlib import Path
from types import FunctionType, MethodType
from typing import Any
import zipfile
import zlib

import attrs
from attrs import frozen
import numpy as np

from .. import __version__
from ..files import whole
from ..parameters import Config, ConfigError
from . import System, Tracker

_PLAIN = (type(None), bool, int, float, str)
_PACKAGE = __name__.split('.')[0]
_NUMBERS = 'biufc'
_SKIPPED = object()


UNFIT = (
    ArithmeticError,
    AttributeError,
    ImportError,
    LookupError,
    MemoryError,
    RecursionError,
    TypeError,
    ValueError,
)
"""What a file that says something else than a tracker would have written raises."""


class StateError(ValueError):
    """A state that cannot be used; one sentence."""


@contextlib.contextmanager
def understood(*more: type[Exception]) -> Iterator[None]:
    """Raises `StateError` in place of what a file raises that does not fit, `more` included."""
    try:
        yield
    except StateError:
        raise
    except UNFIT + more as error:
        raise StateError(f'it does not fit this version ({error})') from None


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
    if not _ours(kind):
        return value  # a slice, or what `encode` does not know and refuses
    items = {name: freeze(item) for name, item in vars(value).items() if name[:2] != '__'}
    return FrozenObject(kind, {k: value for k, value in items.items() if value is not _SKIPPED})


def put(there: Any, value: Any) -> Any:
    """What stands for `value` in a tracker that has `there` in its place: objects and counters are
    changed where they are, since others may hold them too."""
    if value is _SKIPPED:
        return there
    if isinstance(value, FrozenObject):
        cls: Any = value.cls
        target = there if type(there) is cls else cls.__new__(cls)
        for name, item in value.attributes.items():
            setattr(target, name, put(getattr(target, name, None), item))
        return target
    if isinstance(value, Counter) and isinstance(there, Counter):
        there.clear()
        there.update(value)
        return there
    if isinstance(value, (list, deque)):
        whole = [put(None, item) for item in value]
        return whole if isinstance(value, list) else deque(whole, value.maxlen)
    if type(value) is dict:
        return {key: put(None, item) for key, item in value.items()}
    return value


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
        kind = type(value)
        if hasattr(kind, 'from_kept'):
            return ['kept', self._class(kind, []), self.encode(value.kept())]
        if attrs.has(kind):
            names = [field.name for field in attrs.fields(kind)]
            return ['value', self._class(kind, names), *map(self.encode, _fields(value))]
        return ['named', self._class(kind, list(kind._fields)), *map(self.encode, value)]

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
    """The way back. Raises `StateError` for what `Encoder` did not write."""

    def __init__(
        self,
        classes: list[list[Any]],
        arrays: list[list[Any]],
        values: list[Any],
        block: np.ndarray,
    ):
        with understood():
            self._classes = [_class_of(*cls) for cls in classes]
            self._arrays = [_array_of(block, *array) for array in arrays]
            self._values: list[Any] = []
            for value in values:
                self._values.append(self.decode(value))

    def decode(self, value: Any) -> Any:
        """The data that `Encoder.encode` made a JSON value of, objects as `FrozenObject`."""
        if type(value) is not list:
            return value
        with understood():
            return self._decode(*value)

    def _decode(self, kind: str, *parts: Any) -> Any:
        if kind in ('array', 'number'):
            array = self._arrays[parts[0]]
            return array if kind == 'array' else array[()]
        if kind == 'slice':
            return slice(*parts)
        if kind == 'same':
            return self._values[parts[0]]
        if kind == 'bytes':
            return bytes.fromhex(parts[0])
        if kind in ('tuple', 'list'):
            whole = [self.decode(part) for part in parts]
            return tuple(whole) if kind == 'tuple' else whole
        if kind == 'deque':
            return deque((self.decode(part) for part in parts[1:]), parts[0])
        if kind in ('dict', 'Counter'):
            pairs = {self.decode(key): self.decode(item) for key, item in parts}
            return pairs if kind == 'dict' else Counter(pairs)
        cls = self._classes[parts[0]]
        if kind == 'class':
            return cls
        if kind == 'kept':
            return cls.from_kept(self.decode(parts[1]))
        values = [self.decode(part) for part in parts[2 if kind == 'object' else 1 :]]
        if kind == 'object':
            return FrozenObject(cls, dict(zip(parts[1], values, strict=True)))
        if kind == 'named':
            return tuple.__new__(cls, values)
        if kind != 'value':
            raise ValueError(f'unknown kind {kind!r}')
        made = cls.__new__(cls)
        for field, value in zip(attrs.fields(cls), values, strict=True):
            object.__setattr__(made, field.name, value)
        return made


def _fields(value: Any) -> list[Any]:
    return [getattr(value, field.name) for field in attrs.fields(type(value))]


def _ours(cls: type) -> bool:
    return cls.__module__.split('.')[0] == _PACKAGE


def _class_of(module: str, name: str, names: list[str]) -> Any:
    """A class of this package, with the fields it had."""
    if module.split('.')[0] != _PACKAGE:
        raise ValueError(f'{module}.{name} is no class of {_PACKAGE}')
    cls: Any = import_module(module)
    for part in name.split('.'):
        cls = getattr(cls, part)
    if not isinstance(cls, type):
        raise ValueError(f'{module}.{name} is no class')
    now = list(getattr(cls, '_fields', ()))
    now = [field.name for field in attrs.fields(cls)] if attrs.has(cls) else now
    if names and names != now:
        raise ValueError(f'{name} has other fields')
    return cls


def _array_of(
    block: np.ndarray, dtype: str, shape: list[int], order: Any, writeable: bool, first: int
) -> np.ndarray:
    """An array in memory of its own, laid out as the one that was kept."""
    kind = np.dtype(dtype)
    if kind.kind not in _NUMBERS:
        raise ValueError(f'an array of {dtype}')
    size = int(np.prod(shape, dtype=np.int64)) * kind.itemsize
    if first < 0 or first + size > len(block):
        raise ValueError('an array is not there')
    array = np.frombuffer(block[first : first + size].tobytes(), kind).reshape(shape, order=order)
    array = array.copy('K')
    array.flags.writeable = bool(writeable)
    return array


FORMAT = 2
"""Counts up when a tracker keeps other numbers than before."""
_MAGIC = b'sonar_imm state '
_LARGEST = 1 << 30


@frozen(kw_only=True)
class Saved:
    """A state with what it takes to judge it.

    system: name; saved_ns: wall time of saving; newest_ns: stamp of the newest measurement, None
    when there was none; extras: what the caller keeps beside the tracker.
    """

    system: str
    parameters: dict[str, Any]
    saved_ns: int
    newest_ns: int | None
    state: dict[str, Any]
    extras: dict[str, Any]


def write_state(path: Path, saved: Saved) -> int:
    """Write a state; gives the bytes written. Raises OSError; the old file is there then."""
    encoder = Encoder()
    header = {
        'version': __version__,
        'system': saved.system,
        'parameters': saved.parameters,
        'saved_ns': saved.saved_ns,
        'newest_ns': saved.newest_ns,
        'state': encoder.encode(saved.state),
        'extras': encoder.encode(saved.extras),
        'classes': encoder.classes,
        'arrays': encoder.arrays,
        'values': encoder.values,
    }
    buffer = io.BytesIO()
    text = np.frombuffer(json.dumps(header).encode(), np.uint8)
    np.savez(buffer, header=text, block=encoder.block)
    body = buffer.getvalue()
    line = _MAGIC + f'{FORMAT} {hashlib.sha256(body).hexdigest()}\n'.encode()
    with whole(path) as place, place.open('wb') as stream:
        stream.write(line)
        stream.write(body)
    return len(line) + len(body)


def read_state(path: Path) -> Saved:
    """Read a state. Raises FileNotFoundError without a file, and `StateError` with one sentence
    for one that cannot be used."""
    try:
        if path.stat().st_size > _LARGEST:
            raise StateError('it is larger than any state')
        content = path.read_bytes()
    except FileNotFoundError:
        raise
    except OSError as error:
        raise StateError(f'it cannot be read ({error.strerror})') from None
    line, _, body = content.partition(b'\n')
    words = line.removeprefix(_MAGIC).split()
    if not line.startswith(_MAGIC) or len(words) != 2:
        raise StateError('it is no state of a tracker')
    if words[0] != str(FORMAT).encode():
        raise StateError(f'its format is {words[0].decode(errors="replace")}, not {FORMAT}')
    if words[1] != hashlib.sha256(body).hexdigest().encode():
        raise StateError('it is damaged: the checksum does not fit')
    with understood(EOFError, zipfile.BadZipFile, zlib.error):
        with np.load(io.BytesIO(body), allow_pickle=False) as parts:
            header, block = json.loads(parts['header'].tobytes()), parts['block']
        if header['version'] != __version__:
            raise StateError(f'it was saved by version {header["version"]}, not {__version__}')
        decoder = Decoder(header['classes'], header['arrays'], header['values'], block)
        return Saved(
            system=header['system'],
            parameters=header['parameters'],
            saved_ns=header['saved_ns'],
            newest_ns=header['newest_ns'],
            state=decoder.decode(header['state']),
            extras=decoder.decode(header['extras']),
        )


def tracker_from(saved: Saved, system: System, config: Config) -> Tracker:
    """A tracker of `config` that goes on from `saved`. Raises `StateError` when the state is of
    another system, or of other parameters than those that may change while a tracker runs."""
    if saved.system != system.name:
        raise StateError(f'it is of a {saved.system} tracker')
    kind = system.config_type()
    parameters = config.as_dict()
    known = {spec.name: spec for spec in kind.specs()}
    if set(saved.parameters) != set(parameters):
        raise StateError('it was saved with other parameters')
    differ = [
        f'{name} was {saved.parameters[name]}, is {_json(parameters[name])}'
        for name in parameters
        if saved.parameters[name] != _json(parameters[name]) and known[name].read_only
    ]
    if differ:
        raise StateError(f'it was saved with other parameters: {"; ".join(differ[:3])}')
    try:
        then = kind.from_mapping(saved.parameters)
    except ConfigError as error:
        raise StateError(f'it was saved with other parameters: {error}') from None
    tracker = system.build(then)
    restore(tracker, saved.state)
    if then != config:
        tracker.reconfigure(config)
    return tracker


def json_parameters(config: Config) -> dict[str, Any]:
    """The parameters as JSON gives them back."""
    return {name: _json(value) for name, value in config.as_dict().items()}


def _json(value: Any) -> Any:
    return json.loads(json.dumps(value))
