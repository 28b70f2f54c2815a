# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Estimate and truth side by side."""

import numpy as np
import pytest

from sonar_imm.estimates import Estimate
from sonar_imm_tools.evaluation.bathymetry.scoring import profile_of, profiles_of, rough_models

RANGES = np.array([20.0, 20.5, 21.0, 21.5])


def estimate(state='height', *, stamp_ns=7, ranges=RANGES, **columns):
    n = len(ranges)
    other = 'angle' if state == 'height' else 'height'
    return Estimate(
        stamp_ns=stamp_ns,
        frame_id='sonar',
        xyz=np.column_stack([np.zeros(n), np.full(n, -8.0), np.full(n, -15.0)]),
        state_names=(state,),
        state=np.full((n, 1), 0.25),
        covariance=np.full((n, 1, 1), 0.04),
        model_names=('rw_smooth', 'rw_rough'),
        probabilities=np.tile([0.9, 0.1], (n, 1)),
        extras={'range': ranges, other: np.full(n, 0.5), 'valid': np.array([1, 1, 0, 1][:n])},
    )


def truth(ranges, *, stamp_ns=7, **columns):
    n = len(ranges)
    values = {
        'range': ranges, 'height': np.arange(n) * 1.0, 'angle': np.arange(n) * 0.1,
        'patch': np.arange(n) % 2, 'valid': np.ones(n, np.uint8), **columns,
    }  # fmt: skip
    return Estimate(
        stamp_ns=stamp_ns, frame_id='sonar', xyz=np.zeros((n, 3)), state_names=(),
        state=np.empty((n, 0)), covariance=np.empty((n, 0, 0)), extras=values,
    )  # fmt: skip


def test_the_standard_deviation_of_what_is_no_state_follows_from_the_arm():
    profile = profile_of(estimate('height'), None)
    np.testing.assert_allclose(profile.height_std, 0.2)
    np.testing.assert_allclose(profile.angle_std, 0.2 / 8.0)
    profile = profile_of(estimate('angle'), None)
    np.testing.assert_allclose(profile.angle_std, 0.2)
    np.testing.assert_allclose(profile.height_std, 0.2 * 8.0)
    np.testing.assert_allclose(profile.height, 0.5)
    assert profile.valid.tolist() == [True, True, False, True]
    assert profile.truth is None


def test_truth_of_other_bins_is_taken_from_the_nearest_or_unknown():
    floor = profile_of(estimate(), truth(np.array([19.0, 20.25, 20.9, 30.0]))).truth
    np.testing.assert_array_equal(floor.height, [1.0, 1.0, 2.0, np.nan])
    assert floor.patch.tolist() == [True, True, False, False]
    assert floor.echo.tolist() == [True, True, True, False]


@pytest.mark.parametrize('ranges', [np.empty(0), np.array([20.5])])
def test_truth_with_hardly_a_bin(ranges):
    floor = profile_of(estimate(), truth(ranges)).truth
    assert np.isfinite(floor.height).sum() == len(ranges)


def test_the_truth_of_a_ping_of_one_bin_is_the_nearest_there_is():
    floor = profile_of(estimate(ranges=RANGES[:1]), truth(np.array([19.0, 30.0]))).truth
    assert floor.height.tolist() == [0.0]


def test_pings_meet_the_truth_of_their_own_stamp():
    swath = profiles_of([estimate(stamp_ns=7), estimate(stamp_ns=8)], [truth(RANGES, stamp_ns=8)])
    assert [profile.truth is None for profile in swath.profiles] == [True, False]
    assert swath.model_names == ('rw_smooth', 'rw_rough')
    np.testing.assert_allclose(swath.roughness(swath.profiles[0]), 0.1)


def test_which_models_are_rough():
    assert rough_models(('rw', 'ncs')).tolist() == [True, False]
    assert rough_models(('rw_smooth', 'rw_rough')).tolist() == [False, True]
    assert rough_models(('steady', 'winding', 'walk')).tolist() == [False, False, True]
    assert rough_models(('rw_smooth',)).tolist() == [False]
    assert rough_models(()).tolist() == []
