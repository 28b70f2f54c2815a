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
"""State files of a stranger: whatever they say, nothing is called, and no more is made of them
than they hold."""

from helpers.hostile.states import forge, parts_of
from helpers.tracked import tracked
import pytest

from sonar_imm.trackers.state_file import read_state, StateError, tracker_from, write_state


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
    popen = number_of(header, 'sonar_imm.estimation.jit', 'subprocess.Popen')
    set_attribute(stream, '_survivor', ['class', popen])
    set_attribute(
        attributes(stream, '_history'), '_states', ['list', ['list', 'touch', str(victim)]]
    )
    gate = attributes(stream, '_gate')
    set_attribute(gate, '_newest', ['list', 10**18])
    set_attribute(gate, 'restart_after', 1)
    forge(file, header, block)
    with pytest.raises(StateError):
        run_all_the_way(file)
    assert not victim.exists()
