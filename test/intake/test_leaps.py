# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A vessel is not where it cannot have come to."""

import pytest

from sonar_imm.intake.leaps import LeapFilter
from sonar_imm.measurements import Fix, Navigation, Rejection, VesselFix

S = 10**9


def believed(positions, kind='metres', period=0.5, filter=None):
    """Which of the positions, one each `period` s, pass."""
    filter = filter or LeapFilter()
    found = []
    for k, (x, y) in enumerate(positions):
        stamp_ns = 1000 * S + round(k * period * S)
        if kind == 'earth':
            measured = VesselFix(
                stamp_ns=stamp_ns, latitude=y, longitude=x, height=0.0, frame_id='gps'
            )
        else:
            measured = Navigation(
                stamp_ns=stamp_ns, position=(x, y, 0.0), orientation=(0.0, 0.0, 0.0, 1.0),
                frame_id='odom',
            )  # fmt: skip
        try:
            filter.check(measured)
            found.append(True)
        except Rejection as refusal:
            assert refusal.reason == 'leap'
            found.append(False)
    return found


@pytest.mark.parametrize('far', [1200.0, 4e4, 5e6])
def test_a_leap_of_a_moment_is_refused(far):
    way = [(2.0 * k, 0.0) for k in range(10)]
    way[4] = (8.0, far)
    assert believed(way) == [k != 4 for k in range(10)]


def test_a_vessel_that_stays_where_it_leapt_is_believed_after_two_seconds():
    way = [(0.0, 0.0)] * 3 + [(9e4, 0.5 * k) for k in range(10)]
    assert believed(way) == [True] * 3 + [False] * 4 + [True] * 6
    assert believed(way, period=2.0) == [True] * 3 + [False] * 2 + [True] * 8


def test_two_vessels_in_turn_are_one_and_the_other_refused():
    way = [(0.0, 0.0), (5e5, 0.0)] * 10
    assert believed(way) == [True, False] * 10


def test_fast_enough_is_no_leap():
    assert all(believed([(95.0 * k, 0.0) for k in range(50)], period=1.0))
    assert all(believed([(0.0, 0.0), (80e3, 0.0)], period=1000.0))


def test_positions_on_earth_across_the_date_line():
    way = [((179.9999 + 2e-5 * k + 180.0) % 360.0 - 180.0, -17.0) for k in range(12)]
    assert min(x for x, _ in way) < 0.0 and all(believed(way, 'earth'))
    way[5] = (0.1, 51.0)
    assert believed(way, 'earth') == [k != 5 for k in range(12)]


def test_vessels_in_other_frames_and_targets_are_not_asked():
    filter = LeapFilter()
    assert believed([(0.0, 0.0)], filter=filter) == [True]
    assert believed([(9.0, 54.0)], 'earth', filter=filter) == [True]
    for x in (0.0, 1e6):
        filter.check(Fix(stamp_ns=1000 * S, position=(x, 0.0, 0.0), frame_id='odom'))
    filter.reset()
    assert believed([(1e6, 0.0)], filter=filter) == [True]
