# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A node that is started again with a state file."""

import re
import time

from helpers.hostile.states import forge, parts_of
from helpers.node_bench import a_fix, Rig
import pytest
from std_srvs.srv import Trigger

from sonar_imm.files import fcntl
from sonar_imm.nodes.base import TrackerNode
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.state_file import read_state

pytestmark = pytest.mark.usefixtures('walker')


@pytest.fixture
def start(make_bench, tmp_path):
    """Start a rig whose node keeps its state in `tmp_path`, with more parameters."""
    return lambda *given: Rig(make_bench(p=[f'state_file:={tmp_path / "state"}', *given]))


def end(rig):
    """Stop the node, so that it saves."""
    rig.bench.end(rig.node)


@pytest.mark.skipif(fcntl is None, reason='there are no locks')
def test_a_second_node_with_the_same_file_leaves_it_alone(start, tmp_path, capfd):
    """As two namespaces do that share one parameter file; then the first one ends."""
    first = start()
    for fix in (a_fix(1.0, 0.0, 0.0), a_fix(2.0, 2.0, 8.0)):
        first.send(fix)
        first.node._saved_state.save(first.node._config, wait=True)
    assert not (tmp_path / 'state.refused').exists()
    written = (tmp_path / 'state').read_bytes()
    second = start()
    assert 'another node has the state_file' in capfd.readouterr().err
    assert 'another node has the state_file' in second.node.work_report()['warnings'][-1]
    second.send(a_fix(3.0, 4.0, 4.0))
    second.node._saved_state.save(second.node._config, wait=True)
    assert (tmp_path / 'state').read_bytes() == written
    end(first)
    second.send(a_fix(4.0, 4.0, 4.0))
    end(second)
    assert not capfd.readouterr().err.count('another node')
    assert read_state(tmp_path / 'state').newest_ns == 4 * 10**9
    assert read_state(tmp_path / 'state.refused').newest_ns == 2 * 10**9
    assert len(list(tmp_path.iterdir())) == 2


def test_a_node_that_is_started_again_goes_on_and_a_reset_is_kept(start, tmp_path):
    rig = start()
    rig.send(a_fix(0.5, 9.0, 9.0))
    rig.bench.call(Trigger, '/walker/reset', Trigger.Request())
    rig.send(a_fix(1.0, 0.0, 0.0), a_fix(2.0, 2.0, 8.0))
    end(rig)
    assert [path.name for path in tmp_path.iterdir()] == ['state']
    again = start()
    again.send(a_fix(2.0, 2.0, 8.0), a_fix(3.0, 4.0, 4.0), a_fix(4.0, 2.0, 0.0, 'odom'))
    assert again.means() == [(3.0, 2.0, 4.0)]
    assert again.answer == (3, 1, 1)  # the frame was not forgotten either
    assert again.node.tracker.counts['duplicate'] == 1


@pytest.mark.usefixtures('quick')
def test_states_are_saved_while_running_and_only_when_something_was_heard(start, tmp_path):
    rig = start()
    rig.bench.spin_until(lambda: rig.node._saved_state._taken == 0)
    rig.send(a_fix(1.0))
    rig.bench.spin_until((tmp_path / 'state').exists)
    rig.node._saved_state._thread.join()
    written = (tmp_path / 'state').stat().st_mtime_ns
    ticks = []
    rig.node.create_timer(0.3, lambda: ticks.append(1))
    rig.bench.spin_until(lambda: ticks)
    assert (tmp_path / 'state').stat().st_mtime_ns == written
    assert read_state(tmp_path / 'state').newest_ns == 10**9


def test_files_that_cannot_be_used_are_named_and_kept(start, tmp_path, capfd):
    (tmp_path / 'state').write_text('shopping list')
    rig = start()
    assert 'is not used: it is no state of a tracker' in capfd.readouterr().err
    assert (tmp_path / 'state').read_text() == 'shopping list'
    rig.send(a_fix(1.0))
    end(rig)
    assert (tmp_path / 'state.refused').read_text() == 'shopping list'
    assert read_state(tmp_path / 'state').system == 'walker'


def test_a_state_that_does_not_go_with_what_is_measured_is_given_up(start, tmp_path, capfd):
    """It loads, and the tracker raises at the first measurement: the node goes on without it."""
    rig = start()
    rig.send(a_fix(1.0))
    end(rig)
    header, arrays = parts_of(tmp_path / 'state')
    header['state']['tracker']['fixes'] = [[1, 'a fix']]
    forge(tmp_path / 'state', header, arrays)
    again = start()
    again.send(a_fix(2.0), a_fix(3.0, 3.0, 3.0), a_fix(4.0, 3.0, 3.0))
    said = capfd.readouterr().err
    assert said.count('does not go with what is measured (AttributeError)') == 1
    assert 'Traceback' not in said and 'internal error' not in said
    assert sorted(again.node.tracker.fixes) == [3 * 10**9, 4 * 10**9]
    end(again)
    assert read_state(tmp_path / 'state').newest_ns == 4 * 10**9
    assert (tmp_path / 'state.refused').exists()


def test_other_parameters_and_old_states_are_not_used(start, tmp_path, capfd, monkeypatch):
    rig = start()
    rig.send(a_fix(1.0))
    end(rig)
    end(start('steps:=4'))
    assert 'other parameters: steps was 3, is 4' in capfd.readouterr().err
    end(start('frame_id:=map'))
    assert 'another frame_id or world_frame_convention' in capfd.readouterr().err
    now = time.time_ns()
    with monkeypatch.context() as clock:
        clock.setattr('time.time_ns', lambda: now + 400 * 10**9)
        end(start())
        assert re.search('saved 4.. s ago, state_max_age is 300 s', capfd.readouterr().err)
        clock.setattr('time.time_ns', lambda: now - 500 * 10**9)
        end(start())
        assert 's ahead of the clock' in capfd.readouterr().err
    start('slow_share:=0.5', 'fast_share:=0.5')
    assert 'goes on from the state' in capfd.readouterr().err


def test_measurements_of_another_time_end_the_state_and_one_outlier_does_not(start, capfd):
    rig = start()
    rig.send(a_fix(1000.0, 9.0, 9.0))
    end(rig)
    again = start()
    again.send(a_fix(5000.0), a_fix(1001.0, 1.0, 1.0))
    assert again.node._saved_state._loaded_ns is None
    assert again.means()[-1][0] == 5000.0 and len(again.node.tracker.fixes) == 3
    again.node._saved_state.close()  # what the file sees of a process that is killed
    capfd.readouterr()
    other = start()
    other.send(*[a_fix(5000.0 + k, 1.0, 1.0) for k in range(4)])
    assert 'are +4002 s from the last one of the state' in capfd.readouterr().err
    assert sorted(other.node.tracker.fixes) == [5002 * 10**9, 5003 * 10**9]
    end(other)
    earlier = start()
    earlier.send(*[a_fix(100.0 + k, 1.0, 1.0) for k in range(3)])
    assert 'are -4901 s from the last one of the state' in capfd.readouterr().err
    assert sorted(earlier.node.tracker.fixes) == [102 * 10**9]


def test_a_disk_that_is_full_is_said(start, monkeypatch, capfd):
    def full(path, saved):
        raise OSError(28, 'No space left on device')

    rig = start()

    def save(seconds):
        rig.send(a_fix(seconds))
        rig.node._saved_state.save(rig.node.tracker.config, wait=True)

    with monkeypatch.context() as disk:
        disk.setattr('sonar_imm.nodes.saved_state.write_state', full)
        save(1.0)
        save(2.0)
        assert 'No space left on device' in rig.node._saved_state.trouble
        assert capfd.readouterr().err.count('the state cannot be saved') == 1
    save(3.0)  # somebody made room
    assert rig.node._saved_state.trouble == ''


@pytest.mark.parametrize(
    'file, sentence',
    [('/nowhere/state', 'there is no folder'), ('~nobody-here/state', 'stands for no folder')],
)
def test_a_folder_that_is_not_there_ends_the_node(make_bench, file, sentence):
    with pytest.raises(ConfigError, match=sentence):
        make_bench(p=[f'state_file:={file}']).start(TrackerNode, 'walker')
