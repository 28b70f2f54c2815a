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

"""State files of a stranger: whatever they say, nothing is called, and no more is made of them
than they hold."""

import importlib
import io
import json
import os
from pathlib import Path
import resource
import socket
import zipfile

from helpers.hostile.files import states_damaged
from helpers.hostile.states import forge, parts_of, sealed
from helpers.tracked import RUNS, tracked
import numpy as np
import pytest

from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.state_file import (
    read_state,
    StateError,
    tracker_from,
    types_of,
    write_state,
)
from sonar_imm.trackers.state_values import fits, is_value

ENDLESS = Path('/proc/self/maps')
"""A regular file whose size, the system says, is 0."""


@pytest.fixture
def file(tmp_path):
    """A state of a diver tracker."""
    path, run = tmp_path / 'state', tracked('diver_table1')
    write_state(path, run.saved(run.until(5)))
    return path


def number_of(header, *cls):
    """The number of a class in a header that has it from now on."""
    header['classes'].append([*cls, []])
    return len(header['classes']) - 1


def attributes(state, *path):
    """The attributes of an object in a state, by their names, and where they are."""
    for name in path:
        names = state[2]
        state = state[3 + names.index(name)]
    return state


def set_attribute(state, name, value):
    if name not in state[2]:
        state[2].append(name)
        state.append(value)
    state[3 + state[2].index(name)] = value


def stream_of(header):
    return next(pair[1] for pair in header['state'][1:] if pair[0] == '_stream')


def run_all_the_way(path):
    """Load a state as a node does, and give it a measurement."""
    run = tracked('diver_table1')
    tracker = tracker_from(read_state(path), run.system, run.config)
    tracker.process(run.input[5])


def test_a_file_runs_no_program(file, tmp_path):
    """The step that is taken when the clock was set back is Popen, and its state a command."""
    header, block = parts_of(file)
    stream, victim = stream_of(header), tmp_path / 'made'
    popen = number_of(header, 'subprocess', 'Popen')
    set_attribute(stream, '_survivor', ['class', popen])
    command = ['list', 'touch', str(victim)]
    set_attribute(attributes(stream, '_history'), '_states', ['list', command])
    gate = attributes(stream, '_gate')
    set_attribute(gate, '_newest', ['list', 10**18])
    set_attribute(gate, 'restart_after', 1)
    forge(file, header, block)
    with pytest.raises(StateError):
        run_all_the_way(file)
    assert not victim.exists()


GADGETS = [
    ('subprocess', 'Popen'),
    ('sonar_imm.files', 'os._wrap_close'),
    ('sonar_imm.files', 'tempfile._TemporaryFileCloser'),
    ('sonar_imm.files', 'tempfile.TemporaryDirectory'),
    ('sonar_imm.files', 'Path'),
    ('sonar_imm.trackers.state_file', 'Saved'),
    ('sonar_imm.trackers.state_file', 'zipfile.ZipFile'),
    ('sonar_imm.trackers.state_values', 'FrozenObject'),
    ('sonar_imm.trackers.state_values', 'np.memmap'),
    ('sonar_imm.trackers.state_values', 'np.lib.format.np.memmap'),
    ('sonar_imm.trackers.diver.tracker', 'DiverTracker'),
    ('sonar_imm.trackers.diver.tracker', 'DiverTracker.__class__'),
    ('sonar_imm.trackers.bathymetry.tracker', 'Alone'),
    ('sonar_imm.trackers.fathometer.tracker', 'FathometerTracker'),
    ('sonar_imm.trackers', 'System'),
    ('sonar_imm.measurements', 'Fix'),
    ('sonar_imm.intake', 'Any.__class__'),
    ('builtins', 'type'),
    ('os', 'system'),
    ('test_hostile_state', 'Trap'),
    ('sonar_imm', ''),
    ('', ''),
    ('sonar_imm.trackers.diver.state', ['DiverState']),
    (5, None),
]
"""Classes and more that the modules of the package lead to, and that are no part of a state."""


@pytest.mark.parametrize('gadget', GADGETS)
@pytest.mark.parametrize('kind', ['class', 'object', 'value', 'named', 'kept', 'same', 'call'])
def test_a_name_only_chooses_from_the_table(file, gadget, kind, monkeypatch):
    header, block = parts_of(file)
    number = number_of(header, *gadget)
    made = {'class': ['class', number], 'object': ['object', number, ['name'], 'made']}
    made = made.get(kind, [kind, number, 5])
    header['values'].append(made)
    set_attribute(stream_of(header), 'more', made)
    forge(file, header, block)
    imported = []
    monkeypatch.setattr(importlib, 'import_module', lambda *name: imported.append(name))
    with pytest.raises(StateError) as error:
        read_state(file)
    assert len(str(error.value)) < 500 and '\n' not in str(error.value) and not imported


@pytest.mark.parametrize(
    'name', ['__class__', '__dict__', '__init__', 'admit', 'state', 'revise', '_in_time', '_step']
)
def test_an_object_gets_no_attribute_that_its_class_has(file, name):
    """Nor another function for one that it has, nor a class, which could be called."""
    header, block = parts_of(file)
    frames = attributes(stream_of(header), 'frames')
    set_attribute(stream_of(header), name, ['class', frames[1]])
    forge(file, header, block)
    with pytest.raises(StateError):
        run_all_the_way(file)


@pytest.mark.parametrize('path', [('frames',), ('_gate',), ('_history', '_stamps'), ('counts',)])
@pytest.mark.parametrize('value', [None, 5, 'x', ['list'], ['tuple'], ['dict', ['a', 1]]])
def test_what_stands_in_its_place_is_of_its_kind(file, path, value):
    header, block = parts_of(file)
    owner = attributes(stream_of(header), *path[:-1])
    if attributes(owner, path[-1])[0] == value:
        return
    set_attribute(owner, path[-1], value)
    forge(file, header, block)
    if path[-1] == '_stamps' and value == ['list']:
        return  # a list of nothing is one
    with pytest.raises(StateError):
        run_all_the_way(file)


def memory():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


@pytest.mark.parametrize(
    'array',
    [
        ['<f8', [1 << 40], 'C', True],
        ['<f8', [-1], 'C', True],
        ['<f8', [-1, -8], 'C', True],
        ['<f8', [2**70], 'C', True],
        ['<f8', [0, 2**62], 'C', True],
        ['<f8', [1.0], 'C', True],
        ['<f8', [True], 'C', True],
        ['<f8', [1] * 70, 'C', True],
        ['<f8', 8, 'C', True],
        ['|O', [1], 'C', True],
        ['1000000f8', [1], 'C', True],
        ['<M8[ns]', [1], 'C', True],
        ['>f8', [1], 'C', True],
        ['<f8', [1], 'Z', True],
        ['<f8', [1], 'C', 1],
        [['<f8'], [1], 'C', True],
    ],
)
def test_an_array_is_as_large_as_its_bytes(file, array):
    header, block = parts_of(file)
    header['arrays'].append([*array, len(block)])
    forge(file, header, np.concatenate([block, np.zeros(8, np.uint8)]))
    before = memory()
    with pytest.raises(StateError):
        read_state(file)
    assert memory() - before < 50.0


def test_arrays_do_not_share_their_bytes(file):
    """A thousand that do would need a thousand times the memory."""
    header, block = parts_of(file)
    header['arrays'] += [['|u1', [len(block)], 'C', True, 0]] * 1000
    forge(file, header, block)
    with pytest.raises(StateError, match='an array is not there'):
        read_state(file)


def test_values_that_hold_each_other_are_refused(file):
    header, block = parts_of(file)
    count = len(header['values'])
    header['values'] += [['value', 0, ['same', count + 1]], ['value', 0, ['same', count]]]
    forge(file, header, block)
    with pytest.raises(StateError):
        read_state(file)


def test_values_that_are_there_twice_each_do_not_multiply(file):
    """Sixty tuples of twice the one before would be 2**60 values to look at."""
    header, block = parts_of(file)
    count = len(header['values'])
    header['values'].append(['tuple'])
    header['values'] += [['tuple', ['same', count + k], ['same', count + k]] for k in range(60)]
    header['extras'] = ['dict', [['same', count + 60], 1]]
    forge(file, header, block)
    with pytest.raises(StateError):
        read_state(file)


@pytest.mark.parametrize(
    'extra',
    [
        ['deque', -1],
        ['deque', 2**70, 1],
        ['deque', 1, 1, 2],
        ['deque', 1.0],
        ['bytes', 'zz'],
        ['bytes', 5],
        ['slice', -1, None, None],
        ['number', 0],
        ['array', -1],
        ['array', 10**9],
        ['same', -1],
        ['Counter', ['a', 'b']],
        ['dict', [['list'], 1]],
        ['dict', 5],
        ['eval', '1'],
        [],
        [[]],
        {},
        2**70,
    ],
)
def test_data_that_no_tracker_writes_are_refused(file, extra):
    header, block = parts_of(file)
    header['extras'] = ['dict', ['a', extra]]
    forge(file, header, block)
    with pytest.raises(StateError):
        read_state(file)


@pytest.mark.parametrize(
    'text',
    [b'[' * 1_000_000, b'{"version":' * 100_000, b'5', b'null', b'[]', b'', b'\xff', b'9' * 10**6],
)
def test_a_header_that_is_none_is_refused(file, text):
    _, block = parts_of(file)
    forge(file, text, block)
    with pytest.raises(StateError):
        read_state(file)


def test_a_header_larger_than_any_is_not_read(file, monkeypatch):
    _, block = parts_of(file)
    forge(file, b' ' * ((1 << 25) + 1), block)
    monkeypatch.setattr(json, 'loads', lambda text: pytest.fail('it was read'))
    with pytest.raises(StateError, match='its header is larger'):
        read_state(file)


def zipped(parts, compression=zipfile.ZIP_STORED, claim=None):
    """An archive, whose directory may claim another size of its parts."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, 'w', compression) as archive:
        for name, content in parts:
            archive.writestr(name, content)
        for info in archive.infolist() if claim else ():
            info.file_size = info.compress_size = claim
    return buffer.getvalue()


def npy(count, claim=None):
    buffer = io.BytesIO()
    np.save(buffer, np.zeros(count, np.uint8))
    return buffer.getvalue().replace(b'(%d,)' % count, b'(%d,)' % (claim or count))


@pytest.mark.filterwarnings('ignore:Duplicate name')
@pytest.mark.parametrize(
    'body',
    [
        zipped([('header.npy', npy(1)), ('block.npy', npy(1 << 26))], zipfile.ZIP_DEFLATED),
        zipped([('header.npy', npy(1)), ('block.npy', npy(1))], claim=1 << 31),
        zipped([('header.npy', npy(1)), ('block.npy', npy(10, claim=99))]),
        zipped([('header.npy', npy(1)), ('block.npy', npy(10, claim=11))]),
        zipped([('header.npy', npy(1)), ('header.npy', npy(1))]),
        zipped([('header.npy', npy(1)), ('block.npy', npy(1)), ('more.npy', b'')]),
        zipped([(f'{k}.npy', b'') for k in range(10_000)]),
        zipped([('header.npy', b'x'), ('block.npy', b'\x93NUMPY\x01\x00\xff\xff')]),
        b'PK\x05\x06' + b'\0' * 18,
        b'',
        b'x',
    ],
)
def test_an_archive_holds_what_it_says(file, body):
    sealed(file, body)
    before = memory()
    with pytest.raises(StateError):
        read_state(file)
    assert memory() - before < 50.0


@pytest.mark.skipif(not hasattr(os, 'mkfifo'), reason='there are no pipes')
def test_only_a_regular_file_is_read(tmp_path):
    """To open a pipe would wait for somebody who writes; a device has no end."""
    os.mkfifo(tmp_path / 'pipe')
    (tmp_path / 'folder').mkdir()
    (tmp_path / 'zero').symlink_to('/dev/zero')
    with socket.socket(socket.AF_UNIX) as door:
        door.bind(str(tmp_path / 'socket'))
        for name in ('pipe', 'folder', 'zero', 'socket'):
            with pytest.raises(StateError, match='it is no regular file|it cannot be read'):
                read_state(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        read_state(tmp_path / 'nothing')


@pytest.mark.skipif(not ENDLESS.exists(), reason='there is no /proc')
def test_a_file_that_grows_is_not_read_to_its_end():
    with pytest.raises(StateError, match='it grows while it is read'):
        read_state(ENDLESS)


@pytest.mark.parametrize(
    'name', ['diver_table1', 'obstacle_tethers', 'bathymetry_ship', 'fathometer_drift']
)
def test_damaged_and_forged_states_are_a_sentence_or_are_lived_with(name):
    """A share of what `make fuzz` tries; a kernel that took an index from a file would crash."""
    _, failures = states_damaged(name, 150)
    assert not failures


@pytest.mark.parametrize('name', RUNS)
def test_the_table_has_what_states_hold(name, tmp_path):
    """`write_state` of a class that is not in the table makes a file that is refused."""
    run = tracked(name)
    tracker = run.build()
    for k, measurement in enumerate(run.input):
        tracker.process(measurement)
        if k % 7 == 0 or k == len(run.input) - 1:
            write_state(tmp_path / 'state', run.saved(tracker))
            tracker_from(read_state(tmp_path / 'state'), run.system, run.config)


def test_the_table_holds_classes_and_none_twice():
    for system in SYSTEMS.values():
        types = types_of(system)
        assert all(isinstance(cls, type) for cls in types) and len({*types}) == len(types)
        names = [(cls.__module__, cls.__qualname__) for cls in types]
        assert len({*names}) == len(names)
        for cls in types:
            # An object that changes is made without a call, and its attributes are set plainly.
            assert is_value(cls) or cls.__new__ is object.__new__
            assert cls.__setattr__ is object.__setattr__ or is_value(cls)
            assert not hasattr(cls, '__del__')


def test_types_of_fields_are_compared():
    assert fits(5, float) and fits(np.float32(5), float) and fits(np.int64(5), int)
    assert not fits(True, float) and not fits(True, int) and not fits(5.0, int)
    assert fits((), tuple[int, ...]) and not fits((1.5,), tuple[int, ...])
    assert fits((1, 'a'), tuple[int, str]) and not fits((1,), tuple[int, str])
    assert fits([1], list[int]) and not fits((1,), list[int])
    assert fits({'a': 1}, dict[str, int]) and not fits({1: 1}, dict[str, int])
    assert fits(None, int | None) and not fits('x', int | None)


class Trap:
    """A class that would be made if its name were followed."""

    def __new__(cls):
        raise AssertionError('it was made')
