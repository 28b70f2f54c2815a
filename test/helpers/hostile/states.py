# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""State files taken apart, and put together under a checksum that is right."""

import hashlib
import io
import json

import numpy as np

from sonar_imm.trackers import state_file


def parts_of(path):
    """Header and arrays of a state file."""
    body = path.read_bytes().partition(b'\n')[2]
    with np.load(io.BytesIO(body), allow_pickle=False) as parts:
        arrays = dict(parts)
    return json.loads(arrays.pop('header').tobytes()), arrays


def forge(path, header, arrays):
    """Write a state file of `header`, a text or what JSON has, and `arrays`."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    buffer = io.BytesIO()
    np.savez(buffer, header=np.frombuffer(text, np.uint8), **arrays)
    sealed(path, buffer.getvalue())


def sealed(path, body):
    """Write `body` under its checksum."""
    line = f'sonar_imm state {state_file.FORMAT} {hashlib.sha256(body).hexdigest()}\n'
    path.write_bytes(line.encode() + body)


ODD = [None, -1, 0, 1, 2**31, 2**63 - 1, 2**70, 1.5, float('nan'), 1e308, '', 'os', [], {}, True]
"""What may stand where a tracker would have written something else."""
BYTES = '00', '01', '7f', 'f0', 'ff'
SHAPED = (
    lambda array: array[..., None],
    lambda array: array[1:],
    lambda array: np.concatenate([array, array]),
    lambda array: array.astype(np.float32),
    lambda array: array.astype(np.int64) if array.dtype.kind == 'f' else array.astype(float),
)


def places_in(value):
    """Every place in JSON: what holds it, and its key or number there."""
    found, todo = [], [value] if isinstance(value, (dict, list)) else []
    while todo:
        owner = todo.pop()
        for key in owner if isinstance(owner, dict) else range(len(owner)):
            found.append((owner, key))
            if isinstance(owner[key], (dict, list)):
                todo.append(owner[key])
    return found


def forged(text, arrays, rng):
    """A header, given as text, and its arrays, changed in one or two places."""
    header, arrays = json.loads(text), dict(arrays)
    for _ in range(1 + int(rng.integers(2))):
        names, kind = list(arrays), rng.random()
        if kind < 0.2 and names:
            name = names[int(rng.integers(len(names)))]
            arrays[name] = hurt(arrays[name], rng)
            if kind < 0.02:
                arrays[names[int(rng.integers(len(names)))] + 'x'] = arrays.pop(name)
            continue
        places = places_in(header['state'] if kind < 0.9 else header)
        if not places:
            break
        owner, key = places[int(rng.integers(len(places)))]
        value = ODD[int(rng.integers(len(ODD)))]
        how = rng.random()
        if how < 0.3 and type(owner[key]) in (int, float):
            value = owner[key] + int(rng.choice([-1, 1]))
        elif how < 0.6 and key == 'bytes' and owner[key]:  # the numbers of an array
            at = 2 * int(rng.integers(len(owner[key]) // 2))
            value = BYTES[int(rng.integers(len(BYTES)))] * 8
            value = (owner[key][:at] + value + owner[key][at + 16 :])[: len(owner[key])]
        elif how < 0.5:  # something from elsewhere in it
            other, place = places[int(rng.integers(len(places)))]
            value = json.loads(json.dumps(other[place]))
        elif how < 0.6 and len(owner) > 1:
            del owner[key]
            continue
        owner[key] = value
    return header, arrays


def hurt(array, rng):
    """An array with other numbers in eight bytes, or of another shape or kind."""
    if rng.random() < 0.4 and array.ndim:
        return SHAPED[int(rng.integers(len(SHAPED)))](array)
    flat = np.frombuffer(array.tobytes(), np.uint8).copy()
    if len(flat):
        at = int(rng.integers(len(flat)))
        flat[at : at + 8] = rng.choice([0, 1, 127, 240, 255], size=1)
    return flat.view(array.dtype).reshape(array.shape)
