# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The file of a state: what it holds, what is refused; states of trackers with every option are
written and taken again. That a tracker goes on from it bit for bit is in test/conformance."""

from collections import deque
import contextlib
import hashlib
from importlib import import_module

import attrs
from helpers.hostile.states import forge, parts_of
from helpers.tracked import BAGS, resumed, saved, tracked, tracker_from
import numpy as np
import pytest

from sonar_imm.intake import Intake
from sonar_imm.measurements import Rejection
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers import state_file, SYSTEMS
from sonar_imm.trackers.state_file import intake_from, read_state, StateError, write_state
from sonar_imm.trackers.state_values import Decoder, encoded, frozen_state
from sonar_imm_tools.cli import main
from sonar_imm_tools.cli.common import load_config
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.own_files import own_parameters
from sonar_imm_tools.recordings.reader import BagReader


@pytest.fixture
def file(tmp_path):
    """A state of a diver tracker."""
    path, run = tmp_path / 'state', tracked('diver_table1')
    write_state(path, run.saved(run.until(50)))
    return path


def test_parameters_that_may_change_are_those_of_now(file):
    run = tracked('diver_table1')
    changeable = attrs.evolve(run.config, max_tracks=run.config.max_tracks + 1)
    fixed = attrs.evolve(run.config, history=run.config.history + 1.0)
    assert tracker_from(read_state(file), run.system, changeable).config == changeable
    with pytest.raises(StateError, match='history was 10.0, is 11.0'):
        tracker_from(read_state(file), run.system, fixed)
    with pytest.raises(StateError, match='of a diver tracker'):
        obstacle = SYSTEMS['obstacle']
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
    write_state(file, run.saved(run.until(6)))
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
    for change in (
        {'version': '9.9.9'},
        {'system': 'submarine'},
        {'system': ['diver']},
        {'parameters': []},
        {'saved_ns': 'now'},
        {'newest_ns': 1.5},
        {'extras': ['list']},
        {'state': None},
        {'state': {}},
        {'state': [[]]},
        {'state': {**state, 'tracker': 5}},
        {'state': {**state, 'tracker': {}}},
        {'state': {**state, 'intake': {}}},
        {'state': {**state, 'tracker': {**state['tracker'], 'more': 1}}},
    ):
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
        write_state(file, run.saved(run.until(6)))
    assert file.read_bytes() == before
    assert [path.name for path in file.parent.iterdir()] == ['state']


QUICK = {'fathometer': {'particles': '200'}}
SHORT = {'fathometer': ['--set', 'records=8']}
MOST = 48
BAG = {
    'bathymetry': 'bathymetry_ship',
    'diver': 'diver_multistatic',
    'fathometer': 'fathometer_pressure',
    'obstacle': 'obstacle_wreck',
}


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
            again = intake_from(read_state(path), system, config)
            write_state(path, saved(again, system))
            assert path.read_bytes() == first, (bag.name, overrides, k)


@pytest.mark.parametrize('name', SYSTEMS)
def test_states_on_every_shipped_recording(name, tmp_path):
    bags = sorted(BAGS.glob(f'{name}_*'))
    for bag, own in [*((bag, own_parameters(bag)) for bag in bags), (bags[0], None)]:
        take_again(name, bag, own, {}, tmp_path / 'state')


@pytest.mark.statistics
@pytest.mark.parametrize('name', SYSTEMS)
def test_states_with_every_option(name, tmp_path):
    bag = BAGS / BAG[name]
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
