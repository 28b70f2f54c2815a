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

"""The file of a state: what it holds, and what is refused. That a tracker goes on from it bit for
bit is in test/conformance."""

from collections import Counter
import hashlib

import attrs
from helpers.hostile.states import forge, parts_of
from helpers.tracked import tracked
import numpy as np
import pytest

from sonar_imm.trackers import state_file, SYSTEMS
from sonar_imm.trackers.state_file import (
    frozen_state,
    put,
    read_state,
    restore,
    StateError,
    tracker_from,
    write_state,
)


def test_parameters_that_may_change_are_those_of_now(tmp_path):
    run = tracked('diver_table1')
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
    run = tracked('diver_table1')
    odd = [np.float32(0.1), float('nan'), 1 << 63, b'x']
    extras = {'arrays': [*arrays, arrays[0]], 'odd': odd}
    write_state(tmp_path / 'state', run.saved(run.until(0), extras=extras))
    back = read_state(tmp_path / 'state').extras
    for first, other in zip(arrays, back['arrays']):
        assert (first.dtype, first.tobytes()) == (other.dtype, other.tobytes())
        assert first.flags.writeable == other.flags.writeable
        assert first.flags.f_contiguous == other.flags.f_contiguous or first.strides == (16,)
        assert other.flags.aligned
    assert back['arrays'][0] is back['arrays'][-1]
    assert back['odd'][0] == np.float32(0.1) and type(back['odd'][0]) is np.float32
    assert np.isnan(back['odd'][1]) and back['odd'][2:] == [1 << 63, b'x']


def test_counters_that_two_share_stay_shared():
    run = tracked('diver_table1')
    tracker = run.system.build(run.config)
    restore(tracker, frozen_state(run.until(20)))
    assert tracker.counts is tracker._stream.counts is tracker._georeferencer._counts
    target = Counter(old=3)
    assert put(target, Counter(new=1)) is target and target == Counter(new=1)


def test_damaged_files_are_one_sentence(tmp_path):
    run = tracked('diver_table1')
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
    run, path = tracked('diver_table1'), tmp_path / 'state'
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


def test_a_state_of_another_format_is_refused(tmp_path):
    run, path = tracked('diver_table1'), tmp_path / 'state'
    write_state(path, run.saved(run.until(5)))
    now = state_file.FORMAT
    line = path.read_bytes().replace(b'state %d ' % now, b'state %d ' % (now - 1), 1)
    path.write_bytes(line)
    with pytest.raises(StateError, match=f'its format is {now - 1}, not {now}'):
        read_state(path)


def test_a_file_larger_than_any_state_is_not_read(tmp_path, monkeypatch):
    path = tmp_path / 'state'
    path.write_bytes(b'x' * 1001)
    monkeypatch.setattr(state_file, '_LARGEST', 1000)
    monkeypatch.setattr(hashlib, 'sha256', lambda body: pytest.fail('it was read'))
    with pytest.raises(StateError, match='larger than any state'):
        read_state(path)


@pytest.mark.parametrize(
    'change',
    [
        lambda header: header.update(version='9.9.9'),
        lambda header: header.update(system='submarine'),
        lambda header: header.update(system=['diver']),
        lambda header: header.update(parameters=[]),
        lambda header: header.update(saved_ns='now'),
        lambda header: header.update(newest_ns=1.5),
        lambda header: header.update(extras=['list']),
        lambda header: header.pop('state'),
        lambda header: header.update(state=['object', 0, ['a']]),
        lambda header: header.update(state=[[]]),
        lambda header: header['classes'][0].append(1),
    ],
)
def test_a_file_that_says_something_else_is_refused(change, tmp_path):
    run = tracked('diver_table1')
    path = tmp_path / 'state'
    write_state(path, run.saved(run.until(5)))
    header, block = parts_of(path)
    forge(path, header, block)
    read_state(path)
    change(header)
    forge(path, header, block)
    with pytest.raises(StateError):
        read_state(path)


def test_an_attribute_without_a_name_is_refused():
    run = tracked('diver_table1')
    state = frozen_state(run.until(5))
    state['_stream'].attributes[5] = 6
    with pytest.raises(StateError, match='does not fit'):
        restore(run.build(), state)
    with pytest.raises(StateError, match='another tracker'):
        restore(run.build(), 5)


def test_a_state_that_cannot_be_written_leaves_the_old_one(tmp_path, monkeypatch):
    run = tracked('diver_table1')
    path = tmp_path / 'state'
    write_state(path, run.saved(run.until(5)))
    before = path.read_bytes()

    def full(handle):
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr('os.fsync', full)
    with pytest.raises(OSError, match='No space'):
        write_state(path, run.saved(run.until(6)))
    assert path.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ['state']
