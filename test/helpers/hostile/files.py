# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Damaged files: what `convert` takes in, and states of trackers.

Random bytes of a good file are changed, cut off, repeated or taken from elsewhere in it, numbers
of text are changed for odd ones. A state is also changed under a checksum that is right again.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
from pathlib import Path
import re
import shutil
import tempfile
from time import process_time

import numpy as np

from helpers.field_files import FORMATS, line
from helpers.tracked import tracked, tracker_from
from sonar_imm.trackers import state_file
from sonar_imm.trackers.state_file import read_state, StateError, write_state
from sonar_imm_tools.cli import main

SPOTS = 12
"""Moments in a file."""
LONGEST = 20.0
"""CPU seconds that a damaged file may take; a good one takes half a second."""
WORDS = [
    b'', b'nan', b'-1', b'0', b'1e308', b'1e999', b'9' * 40, b'99999999999', b'-0.0', b'x', b'"',
    b'<', b'\xff', b',,,', b'\r', b'\0', b'2024-13-45T99:99:99Z', b'90.0001', b'{', b']',
]  # fmt: skip
CUT, GOES_ON = 20, 4
"""Measurements before a state is saved, and after it is loaded."""
MOST_WORDS = 1100
"""Characters of a sentence."""
RECORDED = ('diver_table1', 'obstacle_tethers', 'bathymetry_ship', 'fathometer_drift')


def damaged(content, rng):
    """The bytes of a file, changed in one to four places."""
    content = bytearray(content)
    for _ in range(1 + rng.integers(4)):
        size = len(content)
        if not size:
            break
        at, length = int(rng.integers(size)), int(rng.integers(1, 9))
        kind = rng.integers(6)
        if kind == 0:
            content[at] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            content[at : at + length] = bytes([int(rng.choice([0, 1, 127, 128, 255]))]) * length
        elif kind == 2:
            del content[at : at + (length if rng.random() < 0.7 else size)]
        elif kind == 3:
            start = int(rng.integers(size))
            content[at:at] = content[start : start + int(rng.integers(1, 400))]
        elif kind == 4:
            start = int(rng.integers(size))
            content[at : at + length] = content[start : start + length]
        elif found := list(re.finditer(rb'-?[0-9][0-9.eE+-]*', bytes(content[at : at + 300]))):
            start, end = found[int(rng.integers(len(found)))].span()
            content[at + start : at + end] = WORDS[int(rng.integers(len(WORDS)))]
    return bytes(content)


def convert_damaged(each, draws):
    """Convert a file of a `Format`, damaged in `draws` ways: how many gave a bag, and what was
    wrong."""
    made, failures = 0, []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        source, bag = folder / each.name, folder / 'bag'
        each.make(source, line(SPOTS, each.step))
        kept = sorted(path for path in [source, *source.rglob('*')] if path.is_file())
        good = [path.read_bytes() for path in kept]
        words = [each.kind] if each.kind else []
        options = [option.format(folder) for option in each.options]
        for k in range(draws):
            rng = np.random.default_rng([k, len(each.name)])
            which = int(rng.integers(len(kept)))
            kept[which].write_bytes(damaged(good[which], rng))
            problem, code = _called(['convert', *words, str(source), str(bag), *options])
            if not problem and (code == 0) != bag.exists():
                problem = f'exit code {code}, and a bag: {bag.exists()}'
            if problem:
                failures.append(f'{each.name}, draw {k}: {problem}')
            made += code == 0
            kept[which].write_bytes(good[which])
            shutil.rmtree(bag, ignore_errors=True)
    return made, failures


def _called(words):
    """What is wrong with how the command ended, and its exit code."""
    out, start = io.StringIO(), process_time()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(out):
            code = main(words)
    except BaseException as error:
        return f'{type(error).__name__}: {error}', None
    if 'Traceback' in out.getvalue() or code not in (0, 1, 2):
        return f'exit code {code}: {out.getvalue()[-500:]}', code
    seconds = process_time() - start
    return f'{seconds:.0f} s' if seconds > LONGEST else '', code


# -- state files taken apart, and put together under a checksum that is right --------------------


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


def states_damaged(recording, draws, first=0):
    """Read states of a run, damaged in `draws` ways, and go on from those that are taken: how many
    were, and what was wrong. What a tracker raises then the node takes for a damaged state."""
    run = tracked(recording)
    taken, failures = 0, []
    with tempfile.TemporaryDirectory() as name:
        path = Path(name) / 'state'
        write_state(path, run.saved(run.until(CUT)))
        good = path.read_bytes()
        header, arrays = parts_of(path)
        text = json.dumps(header)
        for k in range(first, first + draws):
            rng, wrong = np.random.default_rng(k), []
            if k % 4:
                forge(path, *forged(text, arrays, rng))
            else:
                path.write_bytes(damaged(good, rng))
            start = process_time()
            try:
                tracker = tracker_from(read_state(path), run.system, run.config)
                taken += 1
                if not k % 4 and path.read_bytes() != good:
                    wrong.append('damaged, and taken for good')
                with contextlib.suppress(Exception):
                    for measurement in run.input[CUT : CUT + GOES_ON]:
                        tracker.process(measurement)
            except StateError as error:
                if '\n' in str(error) or len(str(error)) > MOST_WORDS:
                    wrong.append(repr(str(error)[:100]))
            except Exception as error:
                wrong.append(f'{type(error).__name__}: {error}')
            if process_time() - start > LONGEST:
                wrong.append(f'{process_time() - start:.0f} s')
            failures += [f'state of {run.system.name}, draw {k}: {each}' for each in wrong]
    return taken, failures


FILES = {each.name: each for each in FORMATS if each.kind != 'none'}
"""What is damaged: each format that is taken in."""


def file_results(name, draws):
    """What happened to `draws` damaged files, as plain values."""
    return _results(name, draws, convert_damaged, FILES[name], draws)


def state_results(recording, draws, first):
    """What happened to `draws` states of a run, from the number `first` on."""
    name = f'state of {recording.split("_")[0]}'
    return _results(name, draws, states_damaged, recording, draws, first)


def _results(name, draws, attempt, *arguments):
    start, (used, failures) = process_time(), attempt(*arguments)
    found = {'name': name, 'draws': draws, 'used': used, 'failures': failures[:5]}
    return {**found, 'cpu_seconds': round(process_time() - start, 1)}
