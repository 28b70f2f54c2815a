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

"""State files taken apart, and put together under a checksum that is right."""

import hashlib
import io
import json

import numpy as np

from sonar_imm.trackers import state_file


def parts_of(path):
    """Header and block of a state file."""
    body = path.read_bytes().partition(b'\n')[2]
    with np.load(io.BytesIO(body), allow_pickle=False) as parts:
        return json.loads(parts['header'].tobytes()), parts['block']


def forge(path, header, block):
    """Write a state file that says what `header`, a text or what JSON has, and `block` say."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    buffer = io.BytesIO()
    np.savez(buffer, header=np.frombuffer(text, np.uint8), block=block)
    sealed(path, buffer.getvalue())


def sealed(path, body):
    """Write `body` under its checksum."""
    line = f'sonar_imm state {state_file.FORMAT} {hashlib.sha256(body).hexdigest()}\n'
    path.write_bytes(line.encode() + body)


ODD = [None, -1, 0, 1, 2**31, 2**63 - 1, 2**70, 1.5, float('nan'), 1e308, '', 'os', [], {}, True]
"""What may stand where a tracker would have written something else."""


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


def forged(text, block, rng):
    """A header, given as text, and its block, changed in one or two places."""
    header = json.loads(text)
    for _ in range(1 + int(rng.integers(2))):
        kind = rng.random()
        if kind < 0.15 and len(block):
            block = block.copy()
            at = int(rng.integers(len(block)))
            block[at : at + 8] = rng.choice([0, 1, 127, 240, 255], size=1)
            continue
        part = 'arrays' if kind < 0.3 else 'values' if kind < 0.6 else ''
        places = places_in(header.get(part, header)) or places_in(header)
        if not places:
            break
        owner, key = places[int(rng.integers(len(places)))]
        value = ODD[int(rng.integers(len(ODD)))]
        how = rng.random()
        if how < 0.3 and type(owner[key]) in (int, float):
            value = owner[key] + int(rng.choice([-1, 1]))
        elif how < 0.5:  # something from elsewhere in it
            other, place = places[int(rng.integers(len(places)))]
            value = json.loads(json.dumps(other[place]))
        elif how < 0.6 and type(owner) is list and len(owner) > 1:
            del owner[key]
            continue
        owner[key] = value
    return header, block
