# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Measurement models against finite differences, symmetry and the joint estimate."""

from hypothesis import assume, given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose
import pytest

from sonar_imm.acoustics import multistatic
from sonar_imm.estimation.angles import wrap_angle

COORDINATE = st.floats(-300.0, 300.0)
POINT = st.tuples(COORDINATE, COORDINATE, st.floats(-40.0, 0.0)).map(np.array)
PLACE = st.tuples(COORDINATE, COORDINATE).map(np.array)
quick = settings(max_examples=60, derandomize=True, deadline=None)


def slope(function, position, step=1e-4):
    """Central differences (n, 2) of function(position) -> (n,)."""
    return np.stack(
        [
            (function(position + step * e) - function(position - step * e)) / (2 * step)
            for e in np.eye(2)
        ],
        axis=-1,
    )


def turned(points, angle, shift):
    """Points (..., 2 or 3) turned about z and moved in x, y."""
    c, s = np.cos(angle), np.sin(angle)
    out = np.array(points, float)
    out[..., :2] = out[..., :2] @ np.array([[c, s], [-s, c]]) + shift
    return out


def distance(position, points, z):
    return multistatic.slant_range(position, points, z)[0]


def direction(position, points, z):
    return multistatic.slant_range(position, points, z)[1]


def scene(n, seed):
    rng = np.random.default_rng(seed)
    rx = np.column_stack([rng.uniform(-100, 100, (n, 2)), rng.uniform(-10, 0, n)])
    tx = np.column_stack([rng.uniform(-100, 100, (n, 2)), rng.uniform(-10, 0, n)])
    return tx, rx, rng.uniform(-80, 80, 2), rng.uniform(0.5, 2.0, n) * 1e-7


@quick
@given(PLACE, POINT, POINT, st.floats(-40.0, 0.0))
def test_jacobians_equal_finite_differences(position, tx, rx, z):
    away = [np.hypot(*(position - point[:2])) for point in (tx, rx)]
    assume(min(away) > 0.5)
    tx, rx = tx[None], rx[None]
    found = multistatic.range_sum_jacobian(position, tx, rx, z)
    due = slope(lambda p: multistatic.range_sum(p, tx, rx, z), position)
    assert_allclose(found, due, atol=1e-6)
    due = slope(lambda p: distance(p, rx, z), position)
    assert_allclose(direction(position, rx, z), due, atol=1e-6)
    around = multistatic.bearing(position, rx)
    due = slope(lambda p: wrap_angle(multistatic.bearing(p, rx) - around), position)
    assert_allclose(multistatic.bearing_jacobian(position, rx), due, rtol=1e-6, atol=1e-7)


@quick
@given(PLACE, POINT, POINT, st.floats(-4.0, 4.0), PLACE)
def test_models_turn_and_move_with_the_scene(position, tx, rx, angle, shift):
    assume(np.hypot(*(position - rx[:2])) > 0.1)
    given = position, tx[None], rx[None]
    moved = [turned(each, angle, shift) for each in given]
    found, due = (multistatic.range_sum(*each, -5.0) for each in (moved, given))
    assert_allclose(found, due, rtol=1e-9)
    gain = multistatic.bearing(moved[0], moved[2]) - multistatic.bearing(position, rx[None])
    assert_allclose(wrap_angle(gain - angle), 0.0, atol=1e-9)
    found, due = (multistatic.range_sum_jacobian(*each, -5.0) for each in (moved, given))
    assert_allclose(found, turned(due, angle, 0.0), atol=1e-6)


def test_hand_worked_values():
    tx, rx = np.array([[0.0, 0.0, 0.0]]), np.array([[3.0, 4.0, 0.0]])
    position = np.array([3.0, 0.0])
    assert_allclose(multistatic.range_sum(position, tx, rx, 0.0), [7.0])
    assert_allclose(multistatic.range_sum_jacobian(position, tx, rx, 0.0), [[1.0, -1.0]])
    assert_allclose(multistatic.bearing(position, rx), [-np.pi / 2])
    assert_allclose(multistatic.bearing_jacobian(position, rx), [[0.25, 0.0]])
    assert_allclose(multistatic.range_sum(position, tx, rx, 4.0), [5.0 + np.sqrt(32.0)])


def test_leading_axes():
    tx, rx, _, _ = scene(5, seed=1)
    position = np.random.default_rng(2).uniform(-50, 50, (4, 3, 2))
    for value, shape in (
        (multistatic.range_sum(position, tx, rx, -3.0), (4, 3, 5)),
        (multistatic.range_sum_jacobian(position, tx, rx, -3.0), (4, 3, 5, 2)),
        (multistatic.bearing(position, rx), (4, 3, 5)),
        (multistatic.bearing_jacobian(position, rx), (4, 3, 5, 2)),
        (distance(position, rx, -3.0), (4, 3, 5)),
    ):
        assert value.shape == shape
        assert np.isfinite(value).all()
    assert_allclose(
        multistatic.range_sum(position, tx, rx, -3.0)[2, 1],
        multistatic.range_sum(position[2, 1], tx, rx, -3.0),
    )


@pytest.mark.parametrize('distance', [0.0, 1e-300, 1e-160, 1e-9])
def test_coincident_points_give_no_information_and_no_nan(distance):
    point = np.array([[10.0, 20.0, -5.0]])
    position = point[0, :2] + [distance, 0.0]
    for jacobian in (
        multistatic.range_sum_jacobian(position, point, point, -5.0),
        multistatic.bearing_jacobian(position, point),
    ):
        assert np.isfinite(jacobian).all() and np.abs(jacobian).max() <= 2.0
    assert_allclose(multistatic.range_sum(position, point, point, -5.0), 0.0, atol=1e-8)
    assert multistatic.bearing(point[0, :2], point)[0] == 0.0
    assert_allclose(multistatic.range_sum_jacobian(point[0, :2], point, point, -5.0), 0.0)


def test_gradient_vanishes_on_the_baseline():
    tx, rx = np.array([[-50.0, 0.0, -5.0]]), np.array([[80.0, 0.0, -5.0]])
    assert_allclose(multistatic.range_sum_jacobian([12.0, 0.0], tx, rx, -5.0), 0.0, atol=1e-15)


# -- time differences ----------------------------------------------------------------------------

SOUND_SPEED = 1480.0


def test_emission_time_and_its_variance_are_those_of_the_joint_estimate():
    n = 6
    _, rx, truth, variance = scene(n, seed=21)
    toa = distance(truth, rx, -4.0) / SOUND_SPEED + 77.25
    known = {'target_z': -4.0, 'sound_speed': SOUND_SPEED}
    time, _ = multistatic.emission_time(toa, variance, rx, truth, **known)
    assert time == pytest.approx(77.25, abs=1e-12)
    augmented = np.column_stack([direction(truth, rx, -4.0) / SOUND_SPEED, np.ones(n)])
    joint = np.linalg.inv(augmented.T @ np.diag(1.0 / variance) @ augmented)
    known['covariance'] = joint[:2, :2]
    _, stated = multistatic.emission_time(toa, variance, rx, truth, **known)
    assert stated == pytest.approx(joint[2, 2], rel=1e-9)
