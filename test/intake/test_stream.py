# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The streams that every tracker stands on, with measurements of three lines; repeats, leaps."""

import pickle

from attrs import evolve, frozen
import numpy as np
import pytest

from sonar_imm import measurements
from sonar_imm.intake import RepeatFilter
from sonar_imm.intake.leaps import LeapFilter
from sonar_imm.intake.stream import Admitted, OnceStream, ReplayStream, StreamRules
from sonar_imm.measurements import Fix, Fixes, GeodeticFix, Navigation, Rejection, RelativeFix
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


STREAMS = pytest.mark.parametrize('make, take', [(replay, 'revise'), (once, 'admit')])


@STREAMS
def test_strangers_and_other_frames_are_counted(make, take):
    stream, nothing = make(), Admitted() if take == 'admit' else []
    take = getattr(stream, take)
    assert stream.frame_id == ''
    take(Number(S))
    assert take('a word') == nothing
    assert take(Number(2 * S, frame_id='odom')) == nothing
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
    assert stream.admit(Number(5 * S, 1)) == stream.admit(Number(4 * S)) == Admitted()
    assert stream.counts == {'duplicate': 1, 'too_late': 1, 'doubted': 0}
    # Also after a restart.
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


@STREAMS
def test_only_what_is_used_decides_on_the_frame_of_a_sensor(make, take):
    stream, nothing = make(), ([], Admitted())
    stream.accepts, take = (Number, Echo), getattr(stream, take)
    for second in range(5000, 5010):
        take(Number(second * S))
    take(Echo(4000 * S, frame_id='bow_1'))  # late
    take(Echo(9000 * S, frame_id='bow_2'))  # ahead of its time
    assert take(Echo(5010 * S, frame_id='bow')) not in nothing
    assert stream.counts['too_late'] == 1 and not stream.counts['other_frame']
    assert take(Echo(5011 * S, frame_id='stern')) in nothing
    assert stream.counts['other_frame'] == 1


def test_what_was_held_is_in_one_frame_after_a_restart():
    stream = once()
    stream.accepts = (Number, Echo)
    for item in (*at(5000, 5001), Echo(10 * S, frame_id='bow'), Echo(11 * S, frame_id='stern')):
        stream.admit(item)
    admitted = stream.admit(Echo(12 * S, frame_id='bow'))
    assert [number.stamp_ns for number in admitted.items] == [10 * S, 12 * S]
    assert stream.counts['other_frame'] == 1


# Repeated polls are left out, and nothing else.


def fix(second, x=1.0, **values):
    values = {'frame_id': 'map', **values}
    return Fix(stamp_ns=round(second * S), position=(x, 0.0, 0.0), **values)


def scan(second, *places, **values):
    position = np.reshape([(x, 0.0, 0.0) for x in places], (-1, 3))
    return Fixes(stamp_ns=round(second * S), position=position, **values)


def on_earth(second, longitude=10.0, kind=GeodeticFix, **values):
    return kind(stamp_ns=round(second * S), **{'latitude': 59.0, **values}, longitude=longitude)


def passes(repeats, measurement):
    try:
        repeats.fresh(measurement)
    except Rejection as rejection:
        assert rejection.reason == 'repeated'
        return False
    return True


def test_the_same_position_a_moment_later_is_a_repeat_until_the_time_is_over():
    """A late one too; the same stamp is left to others."""
    repeats = RepeatFilter(5.0)
    passed = [passes(repeats, fix(second)) for second in (1, 2, 3, 6, 6.5, 7, 12)]
    assert passed == [True, False, False, False, True, False, True]
    repeats = RepeatFilter(5.0)
    assert passes(repeats, fix(10)) and passes(repeats, fix(10)) and not passes(repeats, fix(8))


def test_other_numbers_names_sensors_and_frames_are_no_repeats():
    repeats = RepeatFilter(5.0)
    others = {'x': 1.0000001, 'target_id': 4, 'sensor': 'usbl', 'frame_id': 'odom'}
    assert passes(repeats, fix(1)) and passes(repeats, fix(2, covariance=np.eye(2)))
    assert all(passes(repeats, fix(2, **{name: value})) for name, value in others.items())


def test_all_kinds_of_positions_but_an_empty_scan_and_a_vessel_at_rest():
    repeats, places = RepeatFilter(5.0), {'offset': (1.0, 2.0, 3.0)}
    for k in range(1, 4):
        assert passes(repeats, on_earth(k)) == (k == 1)
        assert passes(repeats, RelativeFix(stamp_ns=k * S, **places)) == (k == 1)
        assert passes(repeats, scan(k, 1.0, 2.0)) == (k == 1)
        assert passes(repeats, scan(k)) and passes(
            repeats, on_earth(k, kind=measurements.VesselFix)
        )


def test_of_named_positions_the_new_ones_stay():
    repeats = RepeatFilter(5.0)
    repeats.fresh(scan(1, 1.0, 2.0, target_id=[4, 5]))
    left = repeats.fresh(scan(2, 1.0, 2.5, target_id=[4, 5]))
    assert left.target_id.tolist() == [5] and left.position[:, 0].tolist() == [2.5]
    assert repeats.rows == 1
    assert not passes(repeats, scan(3, 1.0, 2.5, target_id=[4, 5]))
    repeats.reset()
    assert passes(repeats, scan(3, 1.0, 2.5, target_id=[4, 5]))
    # Named rows and latitudes are held too.
    repeats, geodetic = RepeatFilter(5.0), RepeatFilter(5.0)
    for k, (item, new) in enumerate(held(60, 10, 1.5, 3)):
        x, y = item.position[:2].tolist()
        rows = repeats.fresh(scan(1 + k, x, float(k), target_id=[4, 5])).target_id.tolist()
        used = passes(geodetic, on_earth(1 + k, 10.0 + 1e-5 * y, latitude=59.0 + 1e-5 * x))
        assert k < 10 or (used == new and rows == ([4, 5] if new else [5]))


def held(count, period, std, digits, seed=1, speed=0.4):
    """Fixes at 1 Hz of a sensor that measures every `period` seconds; whether each is new."""
    rng, place = np.random.default_rng(seed), None
    for k in range(count):
        new = k % period == 0
        if new:
            place = np.round((speed * k, 3.0) + std * rng.normal(size=2), digits)
        known = {'position': (*place, 0.0), 'covariance': std**2 * np.eye(2)}
        yield Fix(stamp_ns=(1 + k) * S, **known), new


@pytest.mark.parametrize('period', [2, 7, 10, 12])
def test_a_value_that_is_held_counts_once(period):
    for speed in (0.0, 0.4, 5.0):
        repeats, values = RepeatFilter(5.0), held(200, period, 1.5, 3, speed=speed)
        found = [(passes(repeats, item), new) for item, new in values]
        # Of the first value it cannot be known.
        assert all(used == new for used, new in found[period:])
        assert sum(used for used, _ in found[:period]) <= 1 + (period > 6)


@pytest.mark.parametrize(
    'latitude, std, fine', [(80.0, 0.9, True), (80.0, 0.5, False), (0.0, 0.9, False)]
)
def test_a_degree_of_longitude_is_short_in_the_north(latitude, std, fine):
    """Steps of 0.19 m are fine digits beside a deviation of 0.9 m, those of 1.1 m are coarse."""
    repeats, place = RepeatFilter(5.0), {'latitude': latitude, 'covariance': std**2 * np.eye(3)}
    for k in range(60):
        passes(repeats, on_earth(1 + k, 10.0 + 1e-5 * (k // 5), **place))
    frozen = [passes(repeats, on_earth(61 + k, 10.0 + 11e-5, **place)) for k in range(60)]
    assert any(frozen) != fine


def test_a_frozen_value_of_fine_digits_is_no_fix_however_old():
    """Of coarse digits a diver may rest where he is."""
    for digits, std, due in ((3, 1.5, 0), (0, 0.5, 3)):
        repeats, last = RepeatFilter(5.0), None
        for last, _ in held(60, 5, std, digits, speed=0.2):
            passes(repeats, last)
        used = [passes(repeats, evolve(last, stamp_ns=(61 + k) * S)) for k in range(60)]
        assert sum(used) >= due and (due or not any(used))
    # A vehicle of a simulator without noise that stops: its fixes count after a while.
    repeats = RepeatFilter(5.0)
    assert all(passes(repeats, fix(1 + k, x=0.1 * k)) for k in range(30))
    assert sum(passes(repeats, fix(31 + k, x=5.0)) for k in range(30)) == 5


def test_zero_lets_everything_pass_and_memory_is_bounded():
    repeats = RepeatFilter(0.0)
    assert all(passes(repeats, fix(k)) for k in range(1, 5))
    repeats = RepeatFilter(5.0)
    for k in range(10_500):
        repeats.fresh(fix(1, x=float(k)))
    assert len(repeats._first) == 10_000
    # What is remembered of a scan is as short as of a position.
    repeats, rows = RepeatFilter(5.0), 1e-3 * np.arange(1000)
    for k in range(1, 100):
        assert passes(repeats, scan(k, *(k + rows), frame_id='f' * 1000))
    assert not passes(repeats, scan(101, *(99 + rows), frame_id='f' * 1000))
    assert len(pickle.dumps(repeats)) < 10_000


# -- a vessel is not where it cannot have come to -------------------------------------------------


def believed(positions, kind='metres', period=0.5, filter=None):
    """Which of the positions, one each `period` s, pass."""
    filter = filter or LeapFilter()
    found = []
    for k, (x, y) in enumerate(positions):
        stamp = 1000.0 + k * period
        if kind == 'earth':
            facts = {'latitude': y, 'height': 0.0, 'frame_id': 'gps'}
            measured = on_earth(stamp, x, measurements.VesselFix, **facts)
        else:
            place = {'position': (x, y, 0.0), 'orientation': (0.0, 0.0, 0.0, 1.0)}
            measured = Navigation(stamp_ns=round(stamp * S), frame_id='odom', **place)
        try:
            filter.check(measured)
            found.append(True)
        except Rejection as refusal:
            assert refusal.reason == 'leap'
            found.append(False)
    return found


def test_a_leap_of_a_moment_is_refused():
    for far in (1200.0, 4e4, 5e6):
        way = [(2.0 * k, far * (k == 4)) for k in range(10)]
        assert believed(way) == [k != 4 for k in range(10)]
    # One that stays is believed after two seconds; of two vessels in turn one is refused.
    way = [(0.0, 0.0)] * 3 + [(9e4, 0.5 * k) for k in range(10)]
    assert believed(way) == [True] * 3 + [False] * 4 + [True] * 6
    assert believed(way, period=2.0) == [True] * 3 + [False] * 2 + [True] * 8
    assert believed([(0.0, 0.0), (5e5, 0.0)] * 10) == [True, False] * 10
    # Fast enough is no leap.
    assert all(believed([(95.0 * k, 0.0) for k in range(50)], period=1.0))
    assert all(believed([(0.0, 0.0), (80e3, 0.0)], period=1000.0))


def test_positions_on_earth_across_the_date_line_and_vessels_in_other_frames():
    way = [((179.9999 + 2e-5 * k + 180.0) % 360.0 - 180.0, -17.0) for k in range(12)]
    assert min(x for x, _ in way) < 0.0 and all(believed(way, 'earth'))
    way[5] = (0.1, 51.0)
    assert believed(way, 'earth') == [k != 5 for k in range(12)]
    filter = LeapFilter()
    assert believed([(0.0, 0.0)], filter=filter) == [True]
    assert believed([(9.0, 54.0)], 'earth', filter=filter) == [True]
    for x in (0.0, 1e6):  # targets are not asked
        filter.check(fix(1000, x, frame_id='odom'))
    filter.reset()
    assert believed([(1e6, 0.0)], filter=filter) == [True]
