# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""State files of a stranger: whatever they say, nothing is called, and no more is made of them
than they hold."""

from collections import Counter, deque
import io
import json
import os
from pathlib import Path
import pickle
import resource
import socket
import sys
from typing import Annotated, Any
import zipfile

import attrs
from helpers.hostile.files import RECORDED, states_damaged
from helpers.hostile.states import forge, parts_of, places_in, sealed
from helpers.tracked import tracked, tracker_from
import numpy as np
import pytest

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm.trackers.state_file import read_state, StateError, types_of, write_state
from sonar_imm.trackers.state_values import Decoder, encoded, frozen_state, understood

ENDLESS = Path('/proc/self/maps')
"""A regular file whose size, the system says, is 0."""


@pytest.fixture
def file(tmp_path):
    """A state of a diver tracker."""
    path, run = tmp_path / 'state', tracked('diver_table1')
    write_state(path, run.saved(run.until(5)))
    return path


def load(path):
    """Load a state as a node does, and give it a measurement."""
    run = tracked('diver_table1')
    tracker = tracker_from(read_state(path), run.system, run.config)
    tracker.process(run.input[5])


def refused(path):
    """Require that a state is refused in one sentence, and takes no memory."""
    before = memory()
    with pytest.raises(StateError) as error:
        load(path)
    assert len(str(error.value)) < 500 and '\n' not in str(error.value)
    assert memory() - before < 50.0


def memory():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0


GADGETS = [
    'subprocess.Popen', 'Popen', 'os.system', 'antigravity',
    'sonar_imm.trackers.diver.tracker.DiverTracker', 'DiverTracker', 'DiverConfig', 'ReplayStream',
    'KnownFrames', 'Decoder', 'Saved', 'Path', 'type', 'object', 'Trap', 'test_hostile_state.Trap',
    'Origin', '', 5, None, ['Fix'], {'class': 'Fix'},
]  # fmt: skip
"""Classes and more that modules lead to, and that do not stand in a state, or not there."""


class Trap:
    """A class that would be made if its name were followed."""

    def __new__(cls, *_, **__):
        raise AssertionError('it was made')


def test_a_name_only_chooses_from_the_table(file):
    header, arrays = parts_of(file)
    places = [owner for owner, key in places_in(header['state']) if key == 'class']
    assert {place['class'] for place in places} >= {'Fix', 'Tracks'}
    kinds = {place['class']: place for place in places}.values()
    for k, gadget in enumerate(GADGETS):
        for place in [*kinds][k % 4 :: 4]:
            whole = dict(place)
            place['class'] = gadget
            forge(file, header, arrays)
            refused(file)
            place.clear()
            place.update(whole)
    forge(file, header, arrays)
    load(file)
    assert 'antigravity' not in sys.modules


def test_a_file_runs_no_program(file, tmp_path):
    """The step that is taken when the clock was set back is Popen, and its state a command."""
    victim = tmp_path / 'made'
    popen = {'class': 'subprocess.Popen', 'args': ['touch', str(victim)]}
    for name, inside in (('_survivor', False), ('_step', False), ('_history', True)):
        header, arrays = parts_of(file)
        stream = header['state']['tracker']['_stream']
        if inside:
            stream['_history']['_base'] = popen
        else:
            stream[name] = popen
        forge(file, header, arrays)
        refused(file)
        write_state(file, tracked('diver_table1').saved(tracked('diver_table1').until(5)))
    assert not victim.exists()


def test_an_object_gets_no_attribute_that_is_no_state(file):
    header, arrays = parts_of(file)
    stream = header['state']['tracker']['_stream']
    for name in ('__class__', '__dict__', '__init__', 'admit', 'accepts', '_rules', '_step', 'x'):
        for value in (5, {'class': 'Fix'}, {}):
            stream[name] = value
            forge(file, header, arrays)
            refused(file)
        del stream[name]
    for name in list(stream):
        whole = stream.pop(name)
        forge(file, header, arrays)
        refused(file)
        stream[name] = whole


def test_what_stands_in_its_place_is_of_its_kind(file):
    header, arrays = parts_of(file)
    stream = header['state']['tracker']['_stream']
    for *path, name in (('frames',), ('_gate',), ('_history', '_stamps'), ('counts',)):
        owner = stream
        for step in path:
            owner = owner[step]
        whole = owner[name]
        for value in (None, 5, 'x', {}, [['a', 1.5]], [[1, 1]], [1, 2], 2**70, True):
            owner[name] = value
            forge(file, header, arrays)
            refused(file)
        owner[name] = whole
    scans = stream['_history']
    for name, value in (('_scans', [[]]), ('_stamps', scans['_stamps'][::-1])):
        whole, scans[name] = scans[name], value
        forge(file, header, arrays)
        refused(file)
        scans[name] = whole


SHAPES = [[1 << 40], [-1], [-1, -1], [2**70], [1.0], [True], [1] * 70, 8]
TYPES = [
    '|O', '1000000f8', '<M8[ns]', '>f8', '<i8', '|V8', 'no', '05,f8', ['<f8'], None,
]  # fmt: skip
ARRAYS = [
    *(['<f8', shape, '00' * 8] for shape in SHAPES), *([kind, [1], '00' * 8] for kind in TYPES),
    ['f8,f8', [1], '00' * 16], ['<f8', [1], 'zz' * 8], ['<f8', [1], 5],
]  # fmt: skip


def test_an_array_is_as_large_as_its_bytes(file):
    """In the header, and in the archive beside it."""
    header, arrays = parts_of(file)
    places = [owner for owner, key in places_in(header['state']) if key == 'array']
    place = next(owner for owner in places if owner['array'] == '<f8')
    for dtype, shape, content in ARRAYS:
        place.update({'array': dtype, 'shape': shape, 'bytes': content})
        forge(file, header, arrays)
        refused(file)
    run = tracked('diver_table1')
    write_state(file, run.saved(run.until(30)))
    header, arrays = parts_of(file)
    name, good = next(iter(arrays.items()))
    pickled = np.array([print, print])
    for bad in (good[:0], good[..., None], good.astype('f4'), good.astype('>f8'), pickled):
        forge(file, header, {**arrays, name: bad})
        refused(file)
    for others in ({}, {**arrays, 'tracker/more': np.zeros(1000)}):
        forge(file, header, others)
        refused(file)


def test_arrays_do_not_share_their_bytes(file):
    """A thousand that do would need a thousand times the memory."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, 'w') as archive:
        archive.writestr('header.npy', npy(1 << 20))
        archive.filelist *= 1000
    sealed(file, buffer.getvalue())
    refused(file)


def test_a_header_that_is_none_is_refused(file, monkeypatch):
    _, arrays = parts_of(file)
    deep = b'[' * 1_000_000, b'{"version":' * 100_000
    for text in (*deep, b'5', b'null', b'[]', b'', b'\xff', b'9' * 10**6):
        forge(file, text, arrays)
        refused(file)
    forge(file, b' ' * ((1 << 25) + 1), arrays)
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
def test_an_archive_holds_what_it_says(file):
    header, end = ('header.npy', npy(1)), b'PK\x05\x06' + b'\0' * 18
    for body in (
        zipped([header, ('x.npy', npy(1 << 26))], zipfile.ZIP_DEFLATED),
        zipped([header, ('x.npy', npy(1))], claim=1 << 31),
        zipped([header, ('x.npy', npy(10, claim=99))]),
        zipped([header, ('x.npy', npy(10, claim=11))]),
        zipped([header, header]),
        zipped([header, ('x.npy', b'')]),
        zipped([('x.npy', npy(1))]),
        zipped([(f'{k}.npy', b'') for k in range(30_000)]),
        zipped([('header.npy', b'x'), ('x.npy', b'\x93NUMPY\x01\x00\xff\xff')]),
        zipped([('header.npy', pickle.dumps(5))]),
        zipped([header])[:-22] + b'PK\6\7' + b'\0' * 16 + end,
        end,
        b'',
        b'x',
    ):
        sealed(file, body)
        refused(file)


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


@pytest.mark.parametrize('name', RECORDED)
def test_damaged_and_forged_states_are_a_sentence_or_are_lived_with(name):
    """A share of what `make fuzz` tries; a kernel that took an index from a file would crash."""
    _, failures = states_damaged(name, 60)
    assert not failures


def test_the_tables_hold_values_and_no_name_twice():
    for system in SYSTEMS.values():
        types = types_of(system)
        assert len({cls.__name__ for cls in types}) == len(types)
        for cls in types:
            assert hasattr(cls, '_fields') or attrs.has(cls)
            assert not hasattr(cls, 'STATE') and not hasattr(cls, '__del__')
            if attrs.has(cls):  # frozen
                with pytest.raises(attrs.exceptions.FrozenInstanceError):
                    cls.__setattr__(cls.__new__(cls), 'stamp_ns', 5)


POSE = {
    'class': 'Pose',
    'position': {'array': '<f8', 'shape': [3], 'bytes': '00' * 24},
    'R': {'array': '<f8', 'shape': [3, 3], 'bytes': '00' * 72},
}
ORIGIN = {'class': 'Origin', 'latitude': 1.0, 'longitude': 2.0, 'height': 3.0}
VECTOR = {'array': '<f8', 'shape': [2], 'bytes': '00' * 16}


def owner_of(value, hint):
    """An object whose state is a value of an annotated kind."""
    cls = type('Owner', (), {'STATE': ('x',), '__annotations__': {'x': hint}})
    owner = cls()
    owner.x = value
    return owner


def decoded(data, hint, there=None):
    owner = owner_of(there, hint)
    Decoder((Pose, Origin), {}, DiverConfig()).put(owner, {'x': data}, '')
    return owner.x


def test_annotations_say_what_may_stand_where():
    queue, counts = deque([1], 3), Counter(old=3)
    good = [
        (5, float, None),
        (5, int | None, None),
        (None, int | None, None),
        ([1, 2], tuple[int, ...], None),
        ([1, 'a'], tuple[int, str], None),
        ([1], list[int], None),
        ([['a', 1]], dict[str, int], None),
        ([[3, VECTOR]], dict[int, FloatArray], None),
        ([1, 2], deque[int], queue),
        ([['new', 1]], Counter[str], counts),
        (POSE, Pose | None, None),
        (POSE, Any, None),
        (POSE, Origin | Pose, None),
        ([POSE, ORIGIN], list[Origin | Pose], None),
        ([['a', [[1, ORIGIN]]]], dict[str, tuple[tuple[int, Origin], ...]], None),
        ([1, 2], deque[int], None),
        ([['new', 1]], Counter[str], None),
        (VECTOR, Annotated[FloatArray, 'T'], None),
        (VECTOR, FloatArray | float | str, None),
        ('x', FloatArray | float | str, None),
        (1.5, FloatArray | float | str, None),
    ]
    for data, hint, there in good:
        value = decoded(data, hint, there)
        assert encoded(frozen_state(owner_of(value, hint)), '', {}) == {'x': data}
    assert decoded([['new', 1]], Counter[str], counts) is counts == Counter(new=1)
    assert decoded([1, 2], deque[int], queue).maxlen == 3
    bad = [
        (True, float),
        (True, int),
        (5.0, int),
        ('5', int),
        (2**70, int),
        ([1.5], tuple[int, ...]),
        ([1], tuple[int, str]),
        (5, list[int]),
        ([[1, 1]], dict[str, int]),
        ([['a', 1, 2]], dict[str, int]),
        ([[k, 0] for k in range(10_001)], dict[int, int]),
        ([[[1], 0]], dict[int, int]),
        ('x', int | None),
        (POSE, int | None),
        (POSE, Origin),
        ({**POSE, 'class': 'Fix'}, Any),
        ({**POSE, 'more': 1}, Pose),
        ({**POSE, 'R': VECTOR}, Pose),
        (VECTOR, Annotated[FloatArray, '3']),
        (VECTOR, Annotated[FloatArray, 'TT']),
        ({}, FloatArray),
        (5, FloatArray),
        ([], Any),
    ]
    for data, hint in bad:
        with pytest.raises(StateError), understood():
            decoded(data, hint)
