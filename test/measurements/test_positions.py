# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Positions and headings of which a single number is not finite."""

import contextlib

import numpy as np
import pytest

from sonar_imm.measurements import (
    Fix,
    Fixes,
    GeodeticFix,
    Navigation,
    Rejection,
    RelativeFix,
    Start,
    VesselHeading,
    VesselPose,
)
from sonar_imm.measurements.variances import by_axis, check_flat, filled, UNKNOWN_VARIANCE

WHOLE = {
    Fix: {'position': (1.0, 2.0, 3.0)},
    GeodeticFix: {'latitude': 54.0, 'longitude': 10.0},
    RelativeFix: {'offset': (1.0, 2.0, 3.0)},
    Navigation: {'position': (1.0, 2.0, 3.0), 'orientation': (0.0, 0.0, 0.0, 1.0)},
    Start: {'position': (1.0, 2.0, 3.0), 'covariance': np.eye(3)},
    VesselHeading: {'orientation': (0.0, 0.0, 0.0, 1.0)},
    VesselPose: {'position': (1.0, 2.0, 3.0), 'orientation': (0.0, 0.0, 0.0, 1.0)},
}
"""What each class needs besides its stamp."""


def one_spoilt(values):
    """The same values, one number of them not finite; each in turn."""
    for name, value in values.items():
        for index in np.ndindex(np.shape(value)):
            for bad in (np.nan, np.inf):
                spoilt = np.array(value, float)
                spoilt[index] = bad
                yield {**values, name: spoilt if spoilt.shape else float(spoilt)}


@pytest.mark.parametrize('kind', WHOLE)
def test_a_single_number_that_is_not_finite_is_refused(kind):
    assert kind(stamp_ns=1, **WHOLE[kind]).stamp_ns == 1
    with pytest.raises(Rejection, match='the header stamp is 0 ns'):
        kind(stamp_ns=0, **WHOLE[kind])
    # A z that is not measured may be NaN.
    asked = [each for each in one_spoilt(WHOLE[kind]) if not _is_depth(kind, each)]
    assert len(asked) >= 4
    for values in asked:
        with pytest.raises(Rejection):
            kind(stamp_ns=1, **values)


@pytest.mark.parametrize('variances', [(np.inf, 1.0), (1.0, np.inf), (np.inf, np.inf)])
def test_one_axis_that_is_not_measured_is_enough(variances):
    with pytest.raises(Rejection, match='states that x or y is not measured') as caught:
        check_flat(np.diag(variances), 'a fix')
    assert caught.value.reason == 'not_measured'


@pytest.mark.parametrize('z', [np.nan, 1.0])
@pytest.mark.parametrize(
    'block, good',
    [
        ([[1.0, 0.5], [0.5, 1.0]], True),
        ([[1e-4, 3e-5], [2e-5, 1e-4]], False),
        ([[1.0, 2.0], [2.0, 1.0]], False),
        ([[-1.0, 0.0], [0.0, 1.0]], False),
        ([[np.nan, 0.0], [0.0, 1.0]], False),
    ],
)
def test_a_fix_and_a_scan_take_the_same_covariances_of_x_and_y(block, good, z):
    whole = np.pad(np.array(block), ((0, 1), (0, 1)))
    whole[2, 2] = z
    with contextlib.nullcontext() if good else pytest.raises(Rejection):
        Fix(stamp_ns=1, position=np.zeros(3), covariance=whole)
    with contextlib.nullcontext() if good else pytest.raises(Rejection):
        Fixes(stamp_ns=1, position=np.zeros((1, 3)), covariance=whole[None])


def test_a_variance_of_z_is_stated_up_to_one_that_says_that_it_is_not():
    for variance, stated in ((0.999 * UNKNOWN_VARIANCE, True), (UNKNOWN_VARIANCE, False)):
        made = Fix(stamp_ns=1, position=np.zeros(3), covariance=np.diag([1.0, 1.0, variance]))
        assert np.isfinite(made.covariance[2, 2]) == stated


def test_an_axis_of_which_nothing_is_said_gets_what_is_assumed():
    assumed = np.diag([1.0, 2.0, 3.0])
    np.testing.assert_array_equal(filled(None, assumed), assumed)
    np.testing.assert_array_equal(filled(np.zeros((3, 3)), assumed), assumed)
    stated = by_axis(np.diag([4.0, -1.0, 9.0]))
    np.testing.assert_array_equal(filled(stated, assumed), np.diag([4.0, 2.0, 9.0]))


def _is_depth(kind, values):
    covariance = values.get('covariance', np.eye(2))[:2, :2]
    return kind in (Fix, Start) and np.isfinite([*values['position'][:2], *covariance.flat]).all()
