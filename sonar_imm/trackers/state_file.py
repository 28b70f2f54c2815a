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

"""The state of a tracker in a file, so that a restart forgets nothing.

A file is one line that says what it is, the SHA-256 of the rest, and the rest: an npz of
``header`` (JSON) and ``block`` (the bytes of all arrays). Whatever happens, there is a whole file,
the old or the new one.
"""

from __future__ import annotations

import hashlib
import io
import json
from pathlib import Path
from typing import Any
import zipfile
import zlib

from attrs import frozen
import numpy as np

from .. import __version__
from ..files import whole
from ..parameters import Config, ConfigError
from . import System, Tracker
from .state_values import Decoder, Encoder, restore, StateError, understood

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
