# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The state of a tracker in a file, and back. The tracker then goes on bit for bit as before.

A file is one line with its format and the SHA-256 of the rest. The rest is an uncompressed npz of
``header`` (JSON) and of the larger arrays, named by their path in the header, see `state_values`.
After any failure the old or the new file is there, whole.

The checksum finds damage. A forged file has a correct checksum: so sizes are compared with the
bytes that are there, and types and shapes with those of the tracker.

A tracker with a window for late measurements saves the state before the window and the
measurements in it. The states in the window are computed again, with the present parameters.
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

from attrs import evolve, field, frozen
import numpy as np

from .. import __version__, intake
from ..files import whole
from ..intake import Intake
from ..parameters import Config, ConfigError
from ..texts import in_one_line
from . import System, SYSTEMS, Tracker
from .state_values import (
    array_of,
    Attributes,
    Decoder,
    encoded,
    frozen_state,
    StateError,
    understood,
)

__all__ = [
    'FORMAT',
    'intake_from',
    'json_parameters',
    'read_state',
    'Saved',
    'state_of',
    'StateError',
    'types_of',
    'write_state',
]

FORMAT = 8
"""Counts up when a tracker keeps other numbers than before."""
_MAGIC = b'sonar_imm state '
_LARGEST = 1 << 30
"""Bytes of a state; a fathometer's may hold as much pressure."""
_LARGEST_HEADER = 1 << 25
"""Bytes of its header: JSON takes some twenty times as much when it is read."""
_MOST_ARRAYS = 20_000
_END = struct.Struct('<4s4H2LH')
"""The end of an archive: mark, disks, entries, bytes and place of its directory, comment."""
_SHORT = 200


@frozen(kw_only=True)
class Saved:
    """A state with what it takes to judge it.

    system: name; saved_ns: wall time of saving; newest_ns: stamp of the newest measurement, None
    when there was none; state: of `state_of`, or as it was read, with its arrays; extras: JSON
    that the caller keeps beside it.
    """

    system: str
    parameters: dict[str, Any]
    saved_ns: int
    newest_ns: int | None
    state: dict[str, Any]
    extras: dict[str, Any] = field(factory=dict)
    arrays: dict[str, np.ndarray] = field(factory=dict, repr=False)


def types_of(system: System) -> tuple[type, ...]:
    """Return the classes of values that a state of a tracker of `system`, and of the intake before
    it, may hold."""
    return tuple(dict.fromkeys((*intake.STATE_TYPES, *system.state_types())))


def state_of(intake: Intake) -> dict[str, Attributes]:
    """Return a copy of the state of a tracker and of the intake before it."""
    return {'intake': frozen_state(intake), 'tracker': frozen_state(intake.tracker)}


def write_state(path: Path, saved: Saved) -> int:
    """Write a state; gives the bytes written. Raises OSError; the old file is there then."""
    arrays: dict[str, Any] = {}
    header = {
        'version': __version__,
        'system': saved.system,
        'parameters': saved.parameters,
        'saved_ns': saved.saved_ns,
        'newest_ns': saved.newest_ns,
        'extras': saved.extras,
        'state': {name: encoded(part, name, arrays) for name, part in saved.state.items()},
    }
    text = np.frombuffer(json.dumps(header).encode(), np.uint8)
    size = sum(len(name) + array.nbytes + _SHORT for name, array in arrays.items())
    if len(text) > _LARGEST_HEADER or len(text) + size > _LARGEST or len(arrays) > _MOST_ARRAYS:
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG), str(path))
    buffer = io.BytesIO()
    np.savez(buffer, header=text, **arrays)
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
        form = words[0].decode(errors='replace')
        raise StateError(f'its format is {form}, of another version; this one has {FORMAT}')
    if words[1] != hashlib.sha256(body).hexdigest().encode():
        raise StateError('it is damaged: the checksum does not fit')
    with understood():
        arrays = _arrays(body)
        text = arrays.pop('header').tobytes()
        if len(text) > _LARGEST_HEADER:
            raise StateError('its header is larger than that of any state')
        return _saved(json.loads(text), arrays)


def _content(path: Path) -> bytes:
    """Read a regular file, as large as a state can be. Raises OSError, `StateError`."""
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


def _arrays(body: bytes) -> dict[str, np.ndarray]:
    """Return the arrays of an npz by name. Raises ValueError where its sizes are not those of the
    bytes that are there."""
    # The end first: zipfile reads the whole directory, however long it is.
    if len(body) < _END.size:
        raise ValueError('it has no end')
    mark, _, _, _, count, length, _, _ = _END.unpack(body[-_END.size :])
    wide = body[-_END.size - 20 :].startswith(b'PK\6\7')
    if mark != b'PK\5\6' or wide or count > _MOST_ARRAYS + 1 or length > 2 * _SHORT * count:
        raise ValueError('it has no such end')
    arrays, size = {}, 0
    with zipfile.ZipFile(io.BytesIO(body)) as parts:
        if len(parts.infolist()) != count:
            raise ValueError('it has other parts')
        for info in parts.infolist():
            size += info.file_size
            if info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size:
                raise ValueError('a part is compressed')
            if size > len(body):
                raise ValueError('a part is not there')
            arrays[info.filename.removesuffix('.npy')] = _array(parts.read(info))
    return arrays


def _array(content: bytes) -> np.ndarray:
    """Return the array of an npy file."""
    stream = io.BytesIO(content)
    if np.lib.format.read_magic(stream) != (1, 0):
        raise ValueError('a part of another form')
    shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
    return array_of(content[stream.tell() :], dtype, shape, 'F' if fortran else 'C')


def _saved(header: Any, arrays: dict[str, np.ndarray]) -> Saved:
    """Return the contents of a header. Raises ValueError and others, see `understood`."""
    if header['version'] != __version__:
        version = str(header['version'])[:_SHORT]
        raise StateError(f'it was saved by version {version}, not {__version__}')
    system, newest_ns = SYSTEMS.get(header['system']), header['newest_ns']
    if system is None:
        raise ValueError('it is of no system')
    if type(header['saved_ns']) is not int or type(newest_ns) not in (int, type(None)):
        raise ValueError('a stamp is no number')
    for name in ('parameters', 'extras', 'state'):
        if type(header[name]) is not dict:
            raise ValueError(f'its {name} are none')
    return Saved(
        system=system.name,
        parameters=header['parameters'],
        saved_ns=header['saved_ns'],
        newest_ns=newest_ns,
        state=header['state'],
        extras=header['extras'],
        arrays=arrays,
    )


def intake_from(saved: Saved, system: System, config: Config, frame_id: str = '') -> Intake:
    """Return the intake of a tracker of `config` that goes on from a state of `read_state`, which
    cannot be used twice. Raises `StateError` when the state is of another system, or of
    other parameters than those that may change while a tracker runs."""
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
    intake = Intake(system.build(then), frame_id)
    tracker = intake.tracker
    # Odd numbers are refused, or lived with: numpy need not warn of them.
    with understood(), np.errstate(all='ignore'):
        types = types_of(system)
        Decoder(types, saved.arrays, then).put(intake, saved.state['intake'], 'intake')
        intake.restored()  # now the tracker knows where the sonar is
        Decoder(types, saved.arrays, tracker.config).put(
            tracker, saved.state['tracker'], 'tracker'
        )
        if saved.arrays:
            raise ValueError('it holds more than its state')
        getattr(tracker, 'restored', lambda: None)()
        if then != config:
            intake.reconfigure(config)
        _require_usable(tracker)
    return intake


def _require_usable(tracker: Tracker) -> None:
    """Raise ValueError or TypeError for a tracker that cannot report on itself."""
    numbers = [*tracker.health().values(), *tracker.counts.values()]
    if not all(isinstance(float(number), float) for number in numbers):
        raise ValueError('its health is no number')
    for sentence in getattr(tracker, 'warnings', list)():
        in_one_line(sentence)


def json_parameters(config: Config) -> dict[str, Any]:
    """The parameters as JSON gives them back."""
    return {name: _json(value) for name, value in config.as_dict().items()}


def _json(value: Any) -> Any:
    return json.loads(json.dumps(value))
