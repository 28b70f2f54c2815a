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
"""What may stand in place of a number, and is none that a tracker would have written."""
MOST = 6
"""Measurements that a tracker is given after a state was loaded."""


def places_in(value):
    """Every place in JSON, as a pair of what holds it and its key or number."""
    found, todo = [], [value]
    while todo:
        owner = todo.pop()
        keys = owner if isinstance(owner, dict) else range(len(owner))
        for key in keys:
            found.append((owner, key))
            if isinstance(owner[key], (dict, list)):
                todo.append(owner[key])
    return found


class Mutations:
    """Ways to change one state, each by its number: header and block under a new checksum."""

    def __init__(self, header, block):
        self._text, self._block = json.dumps(header), block

    def forged(self, number):
        """Header and block, changed in one or two places."""
        rng = np.random.default_rng(number)
        header, block = json.loads(self._text), self._block
        places = places_in(header)
        arrays = [(entry, 1) for entry in header['arrays']]
        for _ in range(1 + rng.integers(2)):
            if rng.random() < 0.1:
                block = block.copy()
                block[rng.integers(len(block) or 1) :][:8] = rng.integers(256, size=1)
                continue
            owner, key = (arrays if rng.random() < 0.2 else places)[
                rng.integers(len(arrays if False else places)) % len(places)
            ]
            self._change(owner, key, places, rng)
        return header, block
