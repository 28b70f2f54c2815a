# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""State files: whatever a stranger's say, nothing is called, and no more is made of them than they
hold; what a tracker and its intake hold, written and taken again, is the same."""

from collections import Counter, deque
import contextlib
import hashlib
from importlib import import_module
import io
import json
import os
from pathlib import Path
import pickle
import resource
import socket
import sys
from typing import Annotated, Any
from unittest.mock import patch
import zipfile

import attrs
from helpers.hostile.files import forge, parts_of, places_in, RECORDED, sealed, states_damaged
from helpers.tracked import BAGS, resumed, saved, tracked, tracker_from
import numpy as np
import pytest

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.intake import Intake
from sonar_imm.measurements import Rejection
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers import state_file, SYSTEMS
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm.trackers.state_file import intake_from, read_state, StateError, write_state
from sonar_imm.trackers.state_values import Decoder, encoded, frozen_state, understood
from sonar_imm_tools.cli import main
from sonar_imm_tools.cli.common import load_config
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.own_files import own_parameters
from sonar_imm_tools.recordings.reader import BagReader

ENDLESS = Path('/proc/self/maps')
"""A regular file whose size, the system says, is 0."""
CHANGES = [
    {'version': '9.9.9'}, {'system': 'submarine'}, {'system': ['diver']}, {'parameters': []},
    {'saved_ns': 'now'}, {'newest_ns': 1.5}, {'extras': ['list']},
]  # fmt: skip
QUICK = {'fathometer': {'particles': '200'}}
SHORT = {'fathometer': ['--set', 'records=8']}
MOST = 48
BAG = {'bathymetry': 'ship', 'diver': 'multistatic', 'fathometer': 'pressure', 'obstacle': 'wreck'}


@pytest.fixture
def file(tmp_path):
    path, run = tmp_path / 'state', tracked('diver_table1')
    write_state(path, run.saved(run.until(5)))
    return path


def load(path):
    """Load a state as a node does, and give it a measurement."""
    run = tracked('diver_table1')
    tracker = tracker_from(read_state(path), run.system, run.config)
    tracker.process(run.input[5])


def refuse(path, header, arrays):
    forge(path, header, arrays)
    refused(path)


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
    'KnownFrames', 'Decoder', 'Saved', 'Path', 'type', 'object', 'Trap', 'test_state.Trap',
    'Origin', '', 5, None, ['Fix'], {'class': 'Fix'},
]  # fmt: skip
"""Classes and more that modules lead to, and that do not stand in a state, or not there."""


class Trap:
    def __new__(cls, *_, **__):
        raise AssertionError('it was made')


def test_a_name_only_chooses_from_the_table(file):
    header, arrays = parts_of(file)
    places = [owner for owner, key in places_in(header['state']) if key == 'class']
    kinds = {place['class']: place for place in places}
    assert kinds.keys() >= {'Fix', 'Tracks'}
    for k, gadget in enumerate(GADGETS):
        for place in [*kinds.values()][k % 4 :: 4]:
            with patch.dict(place, {'class': gadget}):
                refuse(file, header, arrays)
    forge(file, header, arrays)
    load(file)
    assert 'antigravity' not in sys.modules


def test_a_file_runs_no_program(file, tmp_path):
    """The step that is taken when the clock was set back is Popen, and its state a command."""
    victim = tmp_path / 'made'
    popen = {'class': 'subprocess.Popen', 'args': ['touch', str(victim)]}
    header, arrays = parts_of(file)
    stream = header['state']['tracker']['_stream']
    for owner, name in ((stream, '_survivor'), (stream, '_step'), (stream['_history'], '_base')):
        with patch.dict(owner, {name: popen}):
            refuse(file, header, arrays)
    assert not victim.exists()


def test_an_object_gets_no_attribute_that_is_no_state(file):
    header, arrays = parts_of(file)
    stream = header['state']['tracker']['_stream']
    for name in ('__class__', '__dict__', '__init__', 'admit', 'accepts', '_rules', '_step', 'x'):
        for value in (5, {'class': 'Fix'}, {}):
            with patch.dict(stream, {name: value}):
                refuse(file, header, arrays)
    for name in list(stream):
        with patch.dict(stream):
            del stream[name]
            refuse(file, header, arrays)


def test_what_stands_in_its_place_is_of_its_kind(file):
    header, arrays = parts_of(file)
    stream = header['state']['tracker']['_stream']
    scans = stream['_history']
    values = None, 5, 'x', {}, [['a', 1.5]], [[1, 1]], [1, 2], 2**70, True
    places = (stream, 'frames'), (stream, '_gate'), (scans, '_stamps'), (stream, 'counts')
    wrong = [(*place, value) for place in places for value in values]
    wrong += [(scans, '_scans', [[]]), (scans, '_stamps', scans['_stamps'][::-1])]
    for owner, name, value in wrong:
        with patch.dict(owner, {name: value}):
            refuse(file, header, arrays)


SHAPES = [[1 << 40], [-1], [-1, -1], [2**70], [1.0], [True], [1] * 70, 8]
TYPES = [
    '|O', '1000000f8', '<M8[ns]', '>f8', '<i8', '|V8', 'no', '05,f8', ['<f8'], None,
]  # fmt: skip
ARRAYS = [
    *(['<f8', shape, '00' * 8] for shape in SHAPES), *([kind, [1], '00' * 8] for kind in TYPES),
    ['f8,f8', [1], '00' * 16], ['<f8', [1], 'zz' * 8], ['<f8', [1], 5],
]  # fmt: skip


def test_an_array_is_as_large_as_its_bytes(file):
    header, arrays = parts_of(file)
    places = [owner for owner, key in places_in(header['state']) if key == 'array']
    place = next(owner for owner in places if owner['array'] == '<f8')
    for dtype, shape, content in ARRAYS:
        place.update({'array': dtype, 'shape': shape, 'bytes': content})
        refuse(file, header, arrays)
    run = tracked('diver_table1')
    write_state(file, run.saved(run.until(30)))
    header, arrays = parts_of(file)
    name, good = next(iter(arrays.items()))
    bad = good[:0], good[..., None], good.astype('f4'), good.astype('>f8'), np.array([print] * 2)
    more = {**arrays, 'tracker/more': np.zeros(1000)}
    for others in (*({**arrays, name: each} for each in bad), {}, more):
        refuse(file, header, others)


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
        refuse(file, text, arrays)
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
        *(zipped([header, ('x.npy', npy(10, claim=claim))]) for claim in (99, 11)),
        *map(zipped, ([header, header], [header, ('x.npy', b'')], [('x.npy', npy(1))])),
        zipped([(f'{k}.npy', b'') for k in range(30_000)]),
        zipped([('header.npy', b'x'), ('x.npy', b'\x93NUMPY\x01\x00\xff\xff')]),
        zipped([('header.npy', pickle.dumps(5))]),
        *(zipped([header])[:-22] + b'PK\6\7' + b'\0' * 16 + end, end, b'', b'x'),
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
        types = state_file.types_of(system)
        assert len({cls.__name__ for cls in types}) == len(types)
        for cls in types:
            assert hasattr(cls, '_fields') or attrs.has(cls)
            assert not hasattr(cls, 'STATE') and not hasattr(cls, '__del__')
            if attrs.has(cls):  # frozen
                with pytest.raises(attrs.exceptions.FrozenInstanceError):
                    cls.__setattr__(cls.__new__(cls), 'stamp_ns', 5)


POSE = {
    'class': 'Pose', 'position': {'array': '<f8', 'shape': [3], 'bytes': '00' * 24},
    'R': {'array': '<f8', 'shape': [3, 3], 'bytes': '00' * 72},
}  # fmt: skip
ORIGIN = {'class': 'Origin', 'latitude': 1.0, 'longitude': 2.0, 'height': 3.0}
VECTOR = {'array': '<f8', 'shape': [2], 'bytes': '00' * 16}
GOOD = [
    (5, float), (5, int | None), (None, int | None), ([1, 2], tuple[int, ...]),
    ([1, 'a'], tuple[int, str]), ([1], list[int]), ([['a', 1]], dict[str, int]),
    ([[3, VECTOR]], dict[int, FloatArray]), (POSE, Pose | None), (POSE, Any),
    (POSE, Origin | Pose), ([POSE, ORIGIN], list[Origin | Pose]),
    ([['a', [[1, ORIGIN]]]], dict[str, tuple[tuple[int, Origin], ...]]), ([1, 2], deque[int]),
    ([['new', 1]], Counter[str]), (VECTOR, Annotated[FloatArray, 'T']),
    (VECTOR, FloatArray | float | str), ('x', FloatArray | float | str),
    (1.5, FloatArray | float | str),
]  # fmt: skip
BAD = [
    (True, float), (True, int), (5.0, int), ('5', int), (2**70, int), ([1.5], tuple[int, ...]),
    ([1], tuple[int, str]), (5, list[int]), ([[1, 1]], dict[str, int]),
    ([['a', 1, 2]], dict[str, int]), ([[k, 0] for k in range(10_001)], dict[int, int]),
    ([[[1], 0]], dict[int, int]), ('x', int | None), (POSE, int | None), (POSE, Origin),
    ({**POSE, 'class': 'Fix'}, Any), ({**POSE, 'more': 1}, Pose), ({**POSE, 'R': VECTOR}, Pose),
    (VECTOR, Annotated[FloatArray, '3']), (VECTOR, Annotated[FloatArray, 'TT']), ({}, FloatArray),
    (5, FloatArray), ([], Any),
]  # fmt: skip


def owner_of(value, hint):
    owner = type('Owner', (), {'STATE': ('x',), '__annotations__': {'x': hint}})()
    owner.x = value
    return owner


def decoded(data, hint, there=None):
    owner = owner_of(there, hint)
    Decoder((Pose, Origin), {}, DiverConfig()).put(owner, {'x': data}, '')
    return owner.x


def test_annotations_say_what_may_stand_where():
    queue, counts = deque([1], 3), Counter(old=3)
    held = ([1, 2], deque[int], queue), ([['new', 1]], Counter[str], counts)
    for data, hint, *there in (*GOOD, *held):
        value = decoded(data, hint, *there)
        assert encoded(frozen_state(owner_of(value, hint)), '', {}) == {'x': data}
    assert decoded([['new', 1]], Counter[str], counts) is counts == Counter(new=1)
    assert decoded([1, 2], deque[int], queue).maxlen == 3
    for data, hint in BAD:
        with pytest.raises(StateError), understood():
            decoded(data, hint)


def test_parameters_that_may_change_are_those_of_now(file):
    run = tracked('diver_table1')
    changeable = attrs.evolve(run.config, max_tracks=run.config.max_tracks + 1)
    fixed = attrs.evolve(run.config, history=run.config.history + 1.0)
    assert tracker_from(read_state(file), run.system, changeable).config == changeable
    obstacle = SYSTEMS['obstacle']
    with pytest.raises(StateError, match='history was 10.0, is 11.0'):
        tracker_from(read_state(file), run.system, fixed)
    with pytest.raises(StateError, match='of a diver tracker'):
        tracker_from(read_state(file), obstacle, obstacle.config_type()())


def test_the_file_is_named_arrays_and_json(tmp_path):
    run, path = tracked('fathometer_drift'), tmp_path / 'state'
    tracker = run.until(20)
    write_state(path, run.saved(tracker))
    header, arrays = parts_of(path)
    sets = header['state']['tracker']['_before']['sets']
    assert sets['class'] == 'Sets' and sets['cell'] == {}
    np.testing.assert_array_equal(arrays['tracker/_before/sets/cell'], tracker._before.sets.cell)


def test_arrays_come_back_as_they_were():
    """Layout chooses among compiled kernels and orders of summation."""

    class Owner:
        STATE = ('arrays', 'numbers')
        arrays: list[np.ndarray]
        numbers: list[float | int]

    owner, again, arrays = Owner(), Owner(), {}
    again.arrays, again.numbers = [], []
    owner.arrays = [
        np.asfortranarray(np.arange(6.0).reshape(2, 3)), np.arange(200.0).reshape(2, 100).T,
        np.arange(400, dtype=np.complex64)[::2], np.array([], np.uint16), np.zeros((0, 4)),
        np.array(['a', 'bcd']), np.array([True, False] * 50),
        np.array([np.nan, -np.nan, np.inf, -0.0]),
    ]  # fmt: skip
    owner.numbers = [float('nan'), 1 << 63, -0.0, 0.1, np.float64(0.1), np.int64(5)]
    data = encoded(frozen_state(owner), 'x', arrays)
    owner.arrays[0][:] = 9.0  # what happens afterwards changes nothing
    assert set(arrays) == {f'x/arrays/{k}' for k in (0, 1, 2, 6)}
    Decoder((), arrays, None).put(again, data, 'x')
    owner.arrays[0][:] = np.arange(6.0).reshape(2, 3)
    for first, other in zip(owner.arrays, again.arrays):
        assert (first.dtype, first.tobytes()) == (other.dtype, other.tobytes())
        assert first.flags.f_contiguous == other.flags.f_contiguous or first.strides == (16,)
        assert other.flags.aligned and other.flags.writeable
    assert not arrays and repr(again.numbers) == '[nan, 9223372036854775808, -0.0, 0.1, 0.1, 5]'


def test_what_several_hold_stays_shared_and_queues_keep_their_length(tmp_path):
    tracker = tracked('diver_table1').until(20)
    again = resumed(tmp_path / 'state', tracker, 'diver')
    assert again.counts == tracker.counts and again.counts
    assert again.counts is again._stream.counts is again._georeferencer._counts
    run = tracked('bathymetry_ship')
    again = resumed(tmp_path / 'state', run.until(60), 'bathymetry')
    assert type(again._loud) is deque and again._loud.maxlen == 100
    assert again.counts is again._queue.counts


def test_a_sound_state_under_another_checksum_is_damaged(file):
    """The npz has checksums of its own, which know nothing of each other and not of the line."""
    run = tracked('diver_table1')
    line, _, body = file.read_bytes().partition(b'\n')
    write_state(file, run.saved(run.until(8)))
    other = file.read_bytes().partition(b'\n')[2]
    file.write_bytes(line + b'\n' + body)
    read_state(file)
    file.write_bytes(line + b'\n' + other)
    with pytest.raises(StateError, match='it is damaged: the checksum does not fit'):
        read_state(file)


def test_states_of_other_formats_are_refused(file):
    good, now = file.read_bytes(), state_file.FORMAT
    for then in (*range(1, now), now + 1):
        file.write_bytes(good.replace(b'state %d ' % now, b'state %d ' % then, 1))
        with pytest.raises(StateError, match=f'its format is {then}, of another version'):
            read_state(file)


def test_a_file_larger_than_any_state_is_neither_read_nor_written(file, monkeypatch):
    run = tracked('diver_table1')
    monkeypatch.setattr(state_file, '_LARGEST', 1000)
    with pytest.raises(OSError, match='too large'):
        write_state(file, run.saved(run.until(5)))
    monkeypatch.setattr(hashlib, 'sha256', lambda body: pytest.fail('it was read'))
    with pytest.raises(StateError, match='larger than any state'):
        read_state(file)


def test_a_file_that_says_something_else_is_refused(file):
    run, (header, arrays) = tracked('diver_table1'), parts_of(file)
    state = header['state']
    more = {**state['tracker'], 'more': 1}
    inside = ({**state, 'tracker': tracker} for tracker in (5, {}, more))
    inside = (*inside, {**state, 'intake': {}})
    for change in (*CHANGES, *({'state': each} for each in (None, {}, [[]], *inside))):
        forge(file, header | change, arrays)
        with pytest.raises(StateError):
            tracker_from(read_state(file), run.system, run.config)
    forge(file, header, arrays)
    tracker_from(read_state(file), run.system, run.config)


def test_a_state_that_cannot_be_written_leaves_the_old_one(file, monkeypatch):
    run = tracked('diver_table1')
    before = file.read_bytes()

    def full(handle):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr('os.fsync', full)
    with pytest.raises(OSError, match='No space'):
        write_state(file, run.saved(run.until(8)))
    assert file.read_bytes() == before
    assert [path.name for path in file.parent.iterdir()] == ['state']


def values_of(spec):
    """Texts of `--set` that use what a parameter can switch on."""
    if spec.choices:
        return spec.choices
    if spec.kind == 'bool':
        return ('true', 'false')
    if spec.kind in ('int', 'float') and spec.default == 0:
        return (str(2 if spec.high is None else min(spec.high, 2)),)
    return ()


def take_again(name, bag, own, overrides, path):
    """Save the state of intake and tracker again and again, and load it: the same bytes."""
    system = SYSTEMS[name]
    config = load_config(system, own, QUICK.get(name, {}) | overrides)[0]
    intake = Intake(system.build(config))
    with BagReader(bag) as reader:
        read = measurements_of(reader, name, settings=config.as_dict())
        found = [item.measurement for item in read]
    found = [m for m in found if m is not None and not isinstance(m, Rejection)][:MOST]
    for k, measurement in enumerate(found):
        with contextlib.suppress(Rejection):
            admitted = intake.admit(measurement)
            if admitted is not None:
                intake.tracker.process(admitted)
        if k % 16 == 0 or k == len(found) - 1:
            write_state(path, saved(intake, system))
            first = path.read_bytes()
            write_state(path, saved(intake_from(read_state(path), system, config), system))
            assert path.read_bytes() == first, (bag.name, overrides, k)


@pytest.mark.parametrize('name', SYSTEMS)
def test_states_on_every_shipped_recording(name, tmp_path):
    bags = sorted(BAGS.glob(f'{name}_*'))
    for bag, own in [*((bag, own_parameters(bag)) for bag in bags), (bags[0], None)]:
        take_again(name, bag, own, {}, tmp_path / 'state')


@pytest.mark.statistics
@pytest.mark.parametrize('name', SYSTEMS)
def test_states_with_every_option(name, tmp_path):
    bag = BAGS / f'{name}_{BAG[name]}'
    for spec in SYSTEMS[name].config_type().specs():
        for value in values_of(spec):
            with contextlib.suppress(ConfigError):  # some need others beside them
                take_again(name, bag, own_parameters(bag), {spec.name: value}, tmp_path / 'state')


@pytest.mark.statistics
@pytest.mark.parametrize('name', SYSTEMS)
def test_states_on_every_scene(name, tmp_path, capsys):
    for scene in import_module(f'sonar_imm_tools.simulation.{name}').SCENARIOS:
        bag = tmp_path / scene
        words = ['simulate', name, str(bag), '--scenario', scene, *SHORT.get(name, [])]
        assert main(words) == 0
        take_again(name, bag, own_parameters(bag), {}, tmp_path / 'state')
