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

"""Repeated polls are left out, and nothing else."""

import pickle

import numpy as np
import pytest

from sonar_imm.intake import RepeatFilter
from sonar_imm.measurements import Fix, Fixes, GeodeticFix, Rejection, RelativeFix, VesselFix

SECOND = 10**9


def fix(second, x=1.0, **values):
    return Fix(
        stamp_ns=round(second * SECOND), position=(x, 0.0, 0.0), **{'frame_id': 'map', **values}
    )


def scan(second, *places, **values):
    return Fixes(
        stamp_ns=round(second * SECOND),
        position=np.reshape([(x, 0.0, 0.0) for x in places], (-1, 3)),
        **values,
    )


def passes(repeats, measurement):
    try:
        repeats.fresh(measurement)
    except Rejection as rejection:
        assert rejection.reason == 'repeated'
        return False
    return True


def test_the_same_position_a_moment_later_is_a_repeat_until_the_time_is_over():
    repeats = RepeatFilter(5.0)
    passed = [passes(repeats, fix(second)) for second in (1, 2, 3, 6, 6.5, 7, 12)]
    assert passed == [True, False, False, False, True, False, True]


def test_a_late_repeat_is_one_too_and_the_same_stamp_is_left_to_others():
    repeats = RepeatFilter(5.0)
    assert passes(repeats, fix(10)) and passes(repeats, fix(10)) and not passes(repeats, fix(8))


def test_other_numbers_names_sensors_and_frames_are_no_repeats():
    repeats = RepeatFilter(5.0)
    others = [
        fix(1),
        fix(2, x=1.0000001),
        fix(2, target_id=4),
        fix(2, sensor='usbl'),
        fix(2, frame_id='odom'),
        fix(2, covariance=np.eye(2)),
    ]
    assert all(passes(repeats, other) for other in others)


@pytest.mark.parametrize(
    'make',
    [
        lambda k: GeodeticFix(stamp_ns=k * SECOND, latitude=59.0, longitude=10.0),
        lambda k: RelativeFix(stamp_ns=k * SECOND, offset=(1.0, 2.0, 3.0)),
        lambda k: scan(k, 1.0, 2.0),
    ],
)
def test_all_kinds_of_positions(make):
    repeats = RepeatFilter(5.0)
    assert passes(repeats, make(1)) and not passes(repeats, make(2))


def test_an_empty_scan_and_a_vessel_at_rest_are_no_repeats():
    repeats = RepeatFilter(5.0)
    for k in range(1, 4):
        assert passes(repeats, scan(k))
        assert passes(repeats, VesselFix(stamp_ns=k * SECOND, latitude=59.0, longitude=10.0))


def test_of_named_positions_the_new_ones_stay():
    repeats = RepeatFilter(5.0)
    repeats.fresh(scan(1, 1.0, 2.0, target_id=[4, 5]))
    left = repeats.fresh(scan(2, 1.0, 2.5, target_id=[4, 5]))
    assert left.target_id.tolist() == [5] and left.position[:, 0].tolist() == [2.5]
    assert repeats.rows == 1
    assert not passes(repeats, scan(3, 1.0, 2.5, target_id=[4, 5]))
    repeats.reset()
    assert passes(repeats, scan(3, 1.0, 2.5, target_id=[4, 5]))


def test_zero_lets_everything_pass_and_memory_is_bounded():
    repeats = RepeatFilter(0.0)
    assert all(passes(repeats, fix(k)) for k in range(1, 5))
    repeats = RepeatFilter(5.0)
    for k in range(10_500):
        repeats.fresh(fix(1, x=float(k)))
    assert len(repeats._first) == 10_000


def test_what_is_remembered_of_a_scan_is_as_short_as_of_a_position():
    repeats = RepeatFilter(5.0)
    for k in range(1, 100):
        assert passes(repeats, scan(k, *(k + 1e-3 * np.arange(1000)), frame_id='f' * 1000))
    assert not passes(repeats, scan(101, *(99 + 1e-3 * np.arange(1000)), frame_id='f' * 1000))
    assert len(pickle.dumps(repeats)) < 10_000
