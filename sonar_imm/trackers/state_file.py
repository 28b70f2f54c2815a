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

A tracker names the attributes that change (``STATE``), and the classes that they may hold
(``STATE_TYPES``). What they are as data is in `state_values`.

A file is one line that says what it is, the SHA-256 of the rest, and the rest: an npz of
``header`` (JSON) and ``block`` (the bytes of all arrays), not compressed. Whatever happens, there
is a whole file, the old or the new one.

The checksum finds damage. Whoever makes a file on purpose makes one that fits: so nothing that
it says is looked up, called, or believed before it is compared with what is there.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import os
from pathlib import Path
import stat
import struct
from typing import Any
import zipfile

from attrs import evolve, frozen
import numpy as np

from .. import __version__, intake
from ..files import whole
from ..parameters import Config, ConfigError
from ..texts import in_one_line
from . import System, SYSTEMS, Tracker
from .state_values import (
    Decoder,
    Encoder,
    freeze,
    frozen_state,
    put,
    restore,
    StateError,
    understood,
)

__all__ = [
    'FORMAT',
    'freeze',
    'frozen_state',
    'json_parameters',
    'put',
    'read_state',
    'restore',
    'Saved',
    'StateError',
    'tracker_from',
    'types_of',
    'write_state',
]

FORMAT = 3
"""Counts up when a tracker keeps other numbers than before."""
_MAGIC = b'sonar_imm state '
_LARGEST = 1 << 30
"""Bytes of a state; a fathometer's may hold as much pressure."""
_LARGEST_HEADER = 1 << 25
"""Bytes of its header: JSON takes some twenty times as much when it is read."""
_DIRECTORY = struct.Struct('<4s4H2LH')
_SHORT = 200


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


def types_of(system: System) -> tuple[type, ...]:
    """The classes that a state of a tracker of `system`, and of the intake before it, may hold."""
    return tuple(dict.fromkeys((*intake.STATE_TYPES, *system.state_types())))


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
    block = encoder.block
    if len(text) > _LARGEST_HEADER or len(text) + len(block) > _LARGEST - _SHORT**2:
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG), str(path))
    np.savez(buffer, header=text, block=block)
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
        content = _content(path)
    except FileNotFoundError:
        raise
    except OSError as error:
        raise StateError(f'it cannot be read ({error.strerror})') from None
    line, _, body = content.partition(b'\n')
    words = line[:_SHORT].removeprefix(_MAGIC).split()
    if not line.startswith(_MAGIC) or len(words) != 2:
        raise StateError('it is no state of a tracker')
    if words[0] != str(FORMAT).encode():
        raise StateError(f'its format is {words[0].decode(errors="replace")}, not {FORMAT}')
    if words[1] != hashlib.sha256(body).hexdigest().encode():
        raise StateError('it is damaged: the checksum does not fit')
    with understood(EOFError, NotImplementedError, RuntimeError, zipfile.BadZipFile):
        text, block = _parts(body)
        if len(text) > _LARGEST_HEADER:
            raise StateError('its header is larger than that of any state')
        return _saved(json.loads(text.tobytes()), block)


def _content(path: Path) -> bytes:
    """The bytes of a regular file, as many as a state can have. Raises OSError, `StateError`."""
    # Without O_NONBLOCK to open a pipe waits for somebody who writes.
    handle = os.open(path, os.O_RDONLY | getattr(os, 'O_NONBLOCK', 0) | getattr(os, 'O_BINARY', 0))
    with os.fdopen(handle, 'rb') as stream:
        status = os.fstat(handle)
        if not stat.S_ISREG(status.st_mode):
            raise StateError('it is no regular file')
        if status.st_size > _LARGEST:
            raise StateError('it is larger than any state')
        content = stream.read(status.st_size + 1)
        if len(content) > status.st_size:
            raise StateError('it grows while it is read')
    return content


def _parts(body: bytes) -> tuple[np.ndarray, np.ndarray]:
    """Header and block of an npz, (bytes,) uint8, that holds these two, and as they are. What it
    says of its sizes is compared with the bytes that are there."""
    # The directory at its end first: zipfile reads it whole, however long it is.
    if len(body) < _DIRECTORY.size:
        raise ValueError('it has no end')
    mark, _, _, _, count, length, _, _ = _DIRECTORY.unpack(body[-_DIRECTORY.size :])
    if mark != b'PK\5\6' or count != 2 or length > _SHORT:
        raise ValueError('it holds other parts')
    with zipfile.ZipFile(io.BytesIO(body)) as parts:
        if parts.namelist() != ['header.npy', 'block.npy']:
            raise ValueError('it holds other parts')
        for info in parts.infolist():
            if info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size:
                raise ValueError('a part is compressed')
            if info.file_size > len(body):
                raise ValueError('a part is not there')
        first, second = (_bytes_of(parts.read(name)) for name in parts.namelist())
    return first, second


def _bytes_of(content: bytes) -> np.ndarray:
    """The bytes (n,) of an npy file of uint8."""
    stream = io.BytesIO(content)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError('a part of another form')
    shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    if dtype != np.uint8 or shape != (len(content) - stream.tell(),):
        raise ValueError('a part is not as long as it says')
    return np.frombuffer(content, np.uint8, offset=stream.tell())


def _saved(header: Any, block: np.ndarray) -> Saved:
    """What a header and its block say. Raises what `understood` takes."""
    if header['version'] != __version__:
        version = str(header['version'])[:_SHORT]
        raise StateError(f'it was saved by version {version}, not {__version__}')
    system, newest_ns = SYSTEMS.get(header['system']), header['newest_ns']
    if system is None:
        raise ValueError('it is of no system')
    if type(header['saved_ns']) is not int or type(newest_ns) not in (int, type(None)):
        raise ValueError('a stamp is no number')
    if not isinstance(header['parameters'], dict):
        raise ValueError('its parameters are none')
    arrays, values = header['arrays'], header['values']
    decoder = Decoder(types_of(system), header['classes'], arrays, values, block)
    extras = decoder.decode(header['extras'])
    if not isinstance(extras, dict):
        raise ValueError('its extras are none')
    return Saved(
        system=system.name,
        parameters=header['parameters'],
        saved_ns=header['saved_ns'],
        newest_ns=newest_ns,
        state=decoder.decode(header['state']),
        extras=extras,
    )


def tracker_from(saved: Saved, system: System, config: Config) -> Tracker:
    """A tracker of `config` that goes on from `saved`. Raises `StateError` when the state is of
    another system, or of other parameters than those that may change while a tracker runs."""
    if saved.system != system.name:
        raise StateError(f'it is of a {saved.system} tracker')
    kind = system.config_type()
    parameters = config.as_dict()
    known = {spec.name: spec for spec in kind.specs_with(parameters)}
    if set(saved.parameters) != set(parameters):
        raise StateError('it was saved with other parameters')
    differ = [
        f'{name} was {str(saved.parameters[name])[:_SHORT]}, is {_json(parameters[name])}'
        for name in parameters
        if saved.parameters[name] != _json(parameters[name]) and known[name].read_only
    ]
    if differ:
        raise StateError(f'it was saved with other parameters: {"; ".join(differ[:3])}')
    try:
        then = evolve(
            config, **kind.attributes(saved.parameters)
        )  # with the constants of `config`
    except ConfigError as error:
        raise StateError(f'it was saved with other parameters: {error}') from None
    # Odd numbers are refused, or lived with: numpy need not warn of them.
    with understood(), np.errstate(all='ignore'):
        tracker = system.build(then)
        restore(tracker, saved.state)
        if then != config:
            tracker.reconfigure(config)
        require_usable(tracker)
    return tracker


def require_usable(tracker: Tracker) -> None:
    """Raise ValueError or TypeError for a tracker that cannot report on itself, or whose state
    cannot be saved."""
    numbers = [*tracker.health().values(), *tracker.counts.values()]
    if not all(isinstance(float(number), float) for number in numbers):
        raise ValueError('its health is no number')
    for sentence in getattr(tracker, 'warnings', list)():
        in_one_line(sentence)
    Encoder().encode(frozen_state(tracker))


def json_parameters(config: Config) -> dict[str, Any]:
    """The parameters as JSON gives them back."""
    return {name: _json(value) for name, value in config.as_dict().items()}


def _json(value: Any) -> Any:
    return json.loads(json.dumps(value))
