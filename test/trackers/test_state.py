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

"""A tracker that goes on from a saved state makes the same bytes as one that was never stopped."""

from collections import Counter
import functools
import hashlib
import json
from pathlib import Path

import attrs
import numpy as np
import pytest

from msg_adapters.estimates import write_estimate
from sonar_imm.measurements import Rejection
from sonar_imm.trackers import state_file, SYSTEMS
from sonar_imm.trackers.state_file import (
    json_parameters,
    read_state,
    Saved,
    tracker_from,
    write_state,
)
from sonar_imm.trackers.state_values import freeze, frozen_state, put, restore, StateError
from sonar_imm_tools.cli.common import load_config
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.own_parameters import own_parameters
from sonar_imm_tools.recordings.reader import BagReader

BAGS = Path(__file__).resolve().parents[2] / 'bags'
RUNS = {
    'diver_table1': {},
    'diver_multistatic': {},
    'obstacle_tethers': {},
    'bathymetry_ship': {'engine': 'grid', 'smoothing': 'states', 'ping_coupling': '1.0'},
    'fathometer_drift': {'smoothing_lag': '2', 'particles': '300'},
    'fathometer_pressure': {
        'preview_seconds': '5.0',
        'processor': 'mvdr',
        'pulse': 'processor',
        'particles': '300',
    },
}


class Case:
    """A recording, the parameters for it, and what an uninterrupted run makes of it."""

    def __init__(self, name, most=120):
        self.system = SYSTEMS[name.split('_')[0]]
        bag = BAGS / name
        self.config = load_config(self.system, own_parameters(bag), RUNS[name])[0]
        with BagReader(bag) as reader:
            heard = measurements_of(reader, self.system.name, settings=self.config.as_dict())
            found = [one.measurement for one in heard]
        self.input = [m for m in found if m is not None and not isinstance(m, Rejection)][:most]
        tracker = self.system.build(self.config)
        self.whole = [made(tracker, m) for m in self.input]
        self.counts = tracker.counts

    def until(self, cut):
        tracker = self.system.build(self.config)
        for measurement in self.input[:cut]:
            tracker.process(measurement)
        return tracker

    def saved(self, tracker, **changes):
        fields = {
            'system': self.system.name,
            'parameters': json_parameters(self.config),
            'saved_ns': 5,
            'newest_ns': 7,
            'state': frozen_state(tracker),
            'extras': {},
        }
        return Saved(**(fields | changes))


def made(tracker, measurement):
    """What a tracker publishes of a measurement, as bytes."""
    messages = [write_estimate(one, ros_message) for one in tracker.process(measurement)]
    return [(one.header.stamp.sec, one.header.stamp.nanosec, bytes(one.data)) for one in messages]


case = functools.cache(Case)


@pytest.mark.parametrize('name', RUNS)
def test_what_follows_a_restart_is_bit_for_bit_the_same(name, tmp_path):
    run = case(name)
    rng = np.random.default_rng(len(name))
    for cut in [0, 1, *rng.integers(2, len(run.input), 3)]:
        stopped = run.until(cut)
        write_state(tmp_path / 'state', run.saved(stopped))
        for measurement in run.input[cut : cut + 3]:
            stopped.process(measurement)  # what it does after it was saved changes nothing
        again = tracker_from(read_state(tmp_path / 'state'), run.system, run.config)
        assert [made(again, m) for m in run.input[cut:]] == run.whole[cut:]
        assert again.counts == run.counts


@pytest.mark.parametrize('name', ['diver_table1', 'obstacle_tethers'])
def test_a_window_that_is_sent_again_changes_nothing(name, tmp_path):
    run = case(name)
    cut = 60
    write_state(tmp_path / 'state', run.saved(run.until(cut)))
    again = tracker_from(read_state(tmp_path / 'state'), run.system, run.config)
    assert not any(again.process(m) for m in run.input[cut - 5 : cut])
    assert again.counts['duplicate'] == 5
    assert [made(again, m) for m in run.input[cut:]] == run.whole[cut:]


@pytest.mark.parametrize('name', RUNS)
def test_every_attribute_that_changes_is_state(name):
    """Whatever a run changes in a tracker is named in STATE, or follows from what is."""
    run = case(name)
    fresh, ran = run.system.build(run.config), run.until(60)
    for attribute in set(vars(ran)) - set(ran.STATE) - {'config', 'counts', '_filter', '_heard'}:
        before, after = (freeze(getattr(one, attribute)) for one in (fresh, ran))
        assert _same(before, after), attribute


def _same(one, other):
    if hasattr(one, 'attributes'):
        names = (one.attributes.keys() | other.attributes.keys()) - {'_cache'}
        return all(_same(one.attributes.get(n), other.attributes.get(n)) for n in names)
    if attrs.has(type(one)):
        names = {field.name for field in attrs.fields(type(one))} - {'_cache'}
        return all(_same(getattr(one, n), getattr(other, n)) for n in names)
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(_same(one[n], other[n]) for n in one)
    if isinstance(one, (list, tuple)):
        return len(one) == len(other) and all(map(_same, one, other))
    if isinstance(one, np.ndarray):
        return np.array_equal(one, other, equal_nan=one.dtype.kind == 'f')
    if hasattr(one, '__dict__') and not callable(one):
        return _same(freeze(one), freeze(other))
    return callable(one) or one == other


def test_parameters_that_may_change_are_those_of_now(tmp_path):
    run = case('diver_table1')
    changeable = attrs.evolve(run.config, max_tracks=run.config.max_tracks + 1)
    fixed = attrs.evolve(run.config, history=run.config.history + 1.0)
    write_state(tmp_path / 'state', run.saved(run.until(50)))
    saved = read_state(tmp_path / 'state')
    assert tracker_from(saved, run.system, changeable).config == changeable
    with pytest.raises(StateError, match='history was 10.0, is 11.0'):
        tracker_from(saved, run.system, fixed)
    with pytest.raises(StateError, match='of a diver tracker'):
        obstacle = SYSTEMS['obstacle']
        tracker_from(saved, obstacle, obstacle.config_type()())


def test_arrays_come_back_as_they_were(tmp_path):
    """Layout and permission to write choose among compiled kernels and orders of summation."""
    arrays = [
        np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        np.arange(4, dtype=np.complex64)[::2],
        np.array([], np.uint16),
        np.array(3.5),
        np.array([np.nan, np.inf, -0.0]),
    ]
    arrays[-1].flags.writeable = False
    run = case('diver_table1')
    odd = [np.float32(0.1), float('nan'), 1 << 70, b'x']
    extras = {'arrays': [*arrays, arrays[0]], 'odd': odd}
    write_state(tmp_path / 'state', run.saved(run.until(0), extras=extras))
    back = read_state(tmp_path / 'state').extras
    for one, other in zip(arrays, back['arrays']):
        assert (one.dtype, one.tobytes()) == (other.dtype, other.tobytes())
        assert one.flags.writeable == other.flags.writeable
        assert one.flags.f_contiguous == other.flags.f_contiguous or one.strides == (16,)
        assert other.flags.aligned
    assert back['arrays'][0] is back['arrays'][-1]
    assert back['odd'][0] == np.float32(0.1) and type(back['odd'][0]) is np.float32
    assert np.isnan(back['odd'][1]) and back['odd'][2:] == [1 << 70, b'x']


def test_counters_that_two_share_stay_shared():
    run = case('diver_table1')
    tracker = run.system.build(run.config)
    restore(tracker, frozen_state(run.until(20)))
    assert tracker.counts is tracker._stream.counts is tracker._georeferencer._counts
    target = Counter(old=3)
    assert put(target, Counter(new=1)) is target and target == Counter(new=1)


def test_damaged_files_are_one_sentence(tmp_path):
    run = case('diver_table1')
    path = tmp_path / 'state'
    write_state(path, run.saved(run.until(30)))
    good = path.read_bytes()
    rng = np.random.default_rng(1)
    for k in range(200):
        content = bytearray(good)
        if k % 2:
            content[rng.integers(len(good))] ^= 1 << rng.integers(8)
        else:
            del content[rng.integers(len(good)) :]
        path.write_bytes(content)
        with pytest.raises(StateError):
            read_state(path)


def test_a_sound_state_under_another_checksum_is_damaged(tmp_path):
    """The npz has checksums of its own, which know nothing of each other and not of the line."""
    run, path = case('diver_table1'), tmp_path / 'state'
    lines, bodies = [], []
    for count in (5, 6):
        write_state(path, run.saved(run.until(count)))
        line, _, body = path.read_bytes().partition(b'\n')
        lines.append(line)
        bodies.append(body)
    path.write_bytes(lines[0] + b'\n' + bodies[0])
    read_state(path)
    path.write_bytes(lines[0] + b'\n' + bodies[1])
    with pytest.raises(StateError, match='it is damaged: the checksum does not fit'):
        read_state(path)


def test_a_file_larger_than_any_state_is_not_read(tmp_path, monkeypatch):
    path = tmp_path / 'state'
    path.write_bytes(b'x' * 1001)
    monkeypatch.setattr(state_file, '_LARGEST', 1000)
    monkeypatch.setattr(Path, 'read_bytes', lambda path: pytest.fail('it was read'))
    with pytest.raises(StateError, match='larger than any state'):
        read_state(path)


def rewrite(path, change):
    """Change the header of a state and make its checksum right again."""
    _, _, body = path.read_bytes().partition(b'\n')
    raw = path.with_suffix('.npz')
    raw.write_bytes(body)
    with np.load(raw) as parts:
        header, block = json.loads(parts['header'].tobytes()), parts['block']
    change(header)
    np.savez(raw, header=np.frombuffer(json.dumps(header).encode(), np.uint8), block=block)
    body = raw.read_bytes()
    path.write_bytes(b'sonar_imm state 1 %s\n' % hashlib.sha256(body).hexdigest().encode() + body)


@pytest.mark.parametrize(
    'change',
    [
        lambda header: header.update(version='9.9.9'),
        lambda header: header.pop('state'),
        lambda header: header.update(state=['object', 0, ['a']]),
        lambda header: header.update(state=['kept', 0, 1]),
        lambda header: header.update(state=[[]]),
        lambda header: header['classes'].append(['os', 'system', []]),
        lambda header: header['classes'].append([state_file.__name__, 'os.system', []]),
        lambda header: header['classes'].append(['sonar_imm.nowhere', 'Thing', []]),
        lambda header: header['arrays'].append(['|O', [1], 'C', True, 0]),
        lambda header: header['arrays'].append(['<f8', [1 << 40], 'C', True, 0]),
        lambda header: header['arrays'].append(['<f8', [-1], 'C', True, 0]),
        lambda header: header['arrays'].append(['<f8', [1], 'C', True, -8]),
        lambda header: header['values'].append(['same', 10**6]),
    ],
)
def test_a_file_that_says_something_else_is_refused(change, tmp_path):
    run = case('diver_table1')
    path = tmp_path / 'state'
    write_state(path, run.saved(run.until(5)))
    rewrite(path, lambda header: None)
    read_state(path)
    rewrite(path, change)
    with pytest.raises(StateError):
        read_state(path)


def test_a_state_that_cannot_be_written_leaves_the_old_one(tmp_path, monkeypatch):
    run = case('diver_table1')
    path = tmp_path / 'state'
    write_state(path, run.saved(run.until(5)))
    before = path.read_bytes()

    def full(handle):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr('os.fsync', full)
    with pytest.raises(OSError, match='No space'):
        write_state(path, run.saved(run.until(6)))
    assert path.read_bytes() == before
    assert [one.name for one in tmp_path.iterdir()] == ['state']
