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

"""The streams that every tracker stands on, with measurements of three lines."""

from attrs import frozen
import pytest

from sonar_imm.intake.stream import Admitted, OnceStream, ReplayStream, StreamRules
from sonar_imm.trackers.shared_parameters import StampParameters, StreamParameters

S = 10**9
RULES = StreamRules(window_ns=10 * S, max_gap_ns=600 * S, restart_after=5)


@frozen
class Number:
    """A measurement that is a number."""

    stamp_ns: int
    value: int = 0
    frame_id: str = 'map'

    def key(self):
        return self.value.to_bytes(4, 'big')


def at(*seconds, **values):
    return [Number(round(second * S), **values) for second in seconds]


def total(state, stamp_ns, items):
    return state + sum(item.value for item in items)


def replay():
    return ReplayStream((Number,), RULES, step=total, initial=0, survivor=lambda state: -1000)


def once(window_ns=0):
    return OnceStream((Number,), StreamRules(window_ns, 600 * S, 3))


@pytest.mark.parametrize('make, take', [(replay, 'revise'), (once, 'admit')])
def test_strangers_and_other_frames_are_counted(make, take):
    stream = make()
    assert stream.frame_id == ''
    getattr(stream, take)(Number(S))
    nothing = Admitted() if take == 'admit' else []
    assert getattr(stream, take)('a word') == nothing
    assert getattr(stream, take)(Number(2 * S, frame_id='odom')) == nothing
    assert stream.counts['unknown_type'] == stream.counts['other_frame'] == 1
    assert stream.frame_id == 'map'


def test_what_is_late_revises_what_comes_after():
    stream = replay()
    for number in (Number(S, 1), Number(3 * S, 4), Number(5 * S, 16)):
        stream.revise(number)
    assert stream.revise(Number(2 * S, 2)) == [(2 * S, 3), (3 * S, 7), (5 * S, 23)]
    assert stream.revise(Number(2 * S, 2)) == []
    assert stream.revise(Number(5 * S, 32)) == [(5 * S, 55)]
    assert stream.state == 55
    assert stream.counts == {'used': 5, 'late': 1, 'duplicate': 1, 'doubted': 0}


def test_a_restart_keeps_what_survives_and_hands_everything_out():
    stream = replay()
    for number in at(*range(5000, 5020), value=1):
        stream.revise(number)
    held = [stream.revise(number) for number in at(*range(1, 6), value=1)]
    assert held[:4] == [[]] * 4
    assert held[4] == [(second * S, -1000 + second) for second in range(1, 6)]
    assert stream.counts['restarts'] == 1 and stream.counts['too_late'] == 0


def test_a_stream_without_history_takes_each_stamp_once_and_in_order():
    stream = once()
    assert stream.admit(Number(5 * S)).items == (Number(5 * S),)
    assert stream.admit(Number(5 * S, 1)) == Admitted()
    assert stream.admit(Number(4 * S)) == Admitted()
    assert stream.counts == {'duplicate': 1, 'too_late': 1, 'doubted': 0}


def test_a_restart_without_history_is_in_order_too():
    stream = once(window_ns=S)
    for number in at(5000, 5001):
        stream.admit(number)
    admitted = [stream.admit(number) for number in at(10, 9.5, 9.5, 11)]
    assert admitted[:3] == [Admitted()] * 3
    assert admitted[3] == Admitted(tuple(at(9.5, 10, 11)), restarted=True)
    assert stream.counts['duplicate'] == 1


def test_rules_come_from_a_config():
    config = StreamParameters(history=2.5, max_gap=60.0, restart_after=4)
    assert StreamRules.of(config) == StreamRules(2_500_000_000, 60 * S, 4)
    # Without `history` nothing late is used.
    assert StreamRules.of(StampParameters(max_gap=60.0)) == StreamRules(0, 60 * S, 5)


@frozen
class Echo(Number):
    """What a sensor on board says, in a frame of its own."""

    FRAME = 'own'


@pytest.mark.parametrize('make, take', [(replay, 'revise'), (once, 'admit')])
def test_only_what_is_used_decides_on_the_frame_of_a_sensor(make, take):
    stream = make()
    stream.accepts = (Number, Echo)
    for second in range(5000, 5010):
        getattr(stream, take)(Number(second * S))
    getattr(stream, take)(Echo(4000 * S, frame_id='bow_1'))  # late
    getattr(stream, take)(Echo(9000 * S, frame_id='bow_2'))  # ahead of its time
    assert getattr(stream, take)(Echo(5010 * S, frame_id='bow')) not in ([], Admitted())
    assert stream.counts['too_late'] == 1 and not stream.counts['other_frame']
    assert getattr(stream, take)(Echo(5011 * S, frame_id='stern')) in ([], Admitted())
    assert stream.counts['other_frame'] == 1


def test_what_was_held_is_in_one_frame_after_a_restart():
    stream = once()
    stream.accepts = (Number, Echo)
    for number in at(5000, 5001):
        stream.admit(number)
    for second, frame in ((10, 'bow'), (11, 'stern')):
        stream.admit(Echo(second * S, frame_id=frame))
    admitted = stream.admit(Echo(12 * S, frame_id='bow'))
    assert [number.stamp_ns for number in admitted.items] == [10 * S, 12 * S]
    assert stream.counts['other_frame'] == 1
