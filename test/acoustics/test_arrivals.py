# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Paths and angles of arrivals, and the least-squares problem of one ping: vectors, derivatives,
closed form, search."""

from helpers.sea_vectors import vectors
from hypothesis import assume, given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose
import pytest

from sonar_imm.acoustics import multistatic
from sonar_imm.acoustics.arrival_fit import ArrivalFit, minimise
from sonar_imm.acoustics.arrivals_3d import (
    arrival_angles,
    arrival_paths,
    BEARING,
    ELEVATION,
    HEIGHT,
    observe,
    ONE_WAY,
    PATH,
)
from sonar_imm.estimation.angles import wrap_angle

Z = -6.0
RX = np.array(
    [
        [80.0, 5.0, -2.0], [-30.0, 70.0, -3.0], [60.0, 90.0, -1.0], [-70.0, -20.0, -4.0],
        [10.0, -60.0, -2.0],
    ]
)  # fmt: skip
TRUTH = np.array([22.0, 31.0])


def problem(active, offset=0.0, bearings=2):
    active = np.array(active)
    tx = np.where(active[:, None], [5.0, -12.0, -3.0], RX)
    path = multistatic.slant_range(TRUTH, RX, Z)[0] + np.where(
        active, multistatic.slant_range(TRUTH, tx, Z)[0], offset
    )
    seen = multistatic.bearing(TRUTH, RX[:bearings])
    return ArrivalFit(
        tx=tx, rx=RX, active=active, bearing_rx=RX[:bearings],
        observed=np.concatenate([path, seen]), weight=np.linspace(1.0, 3.0, len(RX) + bearings),
        target_z=Z, max_range=1000.0,
    )  # fmt: skip


KINDS = {'active': [True] * 5, 'passive': [False] * 5, 'mixed': [True, False, True, False, False]}


@pytest.mark.parametrize('kind', KINDS)
def test_residuals_vanish_at_the_truth_whatever_the_emission(kind):
    fit = problem(KINDS[kind], offset=-750.0)
    residual, _ = fit.residuals(TRUTH[None], fit.weight)
    assert_allclose(residual, 0.0, atol=1e-10)


@pytest.mark.parametrize('kind', KINDS)
def test_jacobian_equals_finite_differences_also_with_rows_left_out(kind):
    fit = problem(KINDS[kind], offset=40.0)
    weight = fit.weight * [1, 1, 0, 1, 1, 0, 1]
    at, h = np.array([[10.0, -15.0]]), 1e-5
    _, jacobian = fit.residuals(at, weight)
    numeric = [
        (fit.residuals(at - h * e, weight)[0] - fit.residuals(at + h * e, weight)[0]) / (2 * h)
        for e in np.eye(2)
    ]
    assert_allclose(jacobian[0], np.stack(numeric, axis=-1)[0], atol=1e-6)


@pytest.mark.parametrize('kind', KINDS)
def test_cost_is_the_sum_of_squares_with_the_best_emission(kind):
    fit = problem(KINDS[kind], offset=40.0)
    places = np.random.default_rng(1).uniform(-50, 50, (20, 2))
    residual, _ = fit.residuals(places, fit.weight)
    assert_allclose(fit.cost(places, fit.weight), np.square(residual) @ fit.weight)
    if kind != 'active':
        shift = np.append(~fit.active, [False, False])
        for offset in (-1e-3, 1e-3):
            worse = np.square(residual + offset * shift) @ fit.weight
            assert (worse > fit.cost(places, fit.weight)).all()


def test_closed_form_meets_the_truth():
    fit = problem(KINDS['passive'], offset=123.0, bearings=0)
    for rows in ([0, 1, 2], [0, 1, 2, 3, 4]):
        meeting = fit._closed_form(np.array(rows))
        assert np.linalg.norm(meeting - TRUTH, axis=-1).min() < 1e-6


@pytest.mark.parametrize('kind', KINDS)
def test_search_finds_the_lowest_point_of_a_fine_grid(kind):
    fit = problem(KINDS[kind], offset=40.0)
    fit.observed[:] += np.random.default_rng(4).normal(0.0, 3.0, 7) * [1, 1, 1, 1, 1, 0.02, 0.02]
    minima = minimise(fit, fit.starts(fit.weight), fit.weight).distinct()
    axis = np.linspace(-150, 150, 601)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    assert minima.converged.all() and (np.diff(minima.cost) >= 0.0).all()
    best = fit.cost(grid, fit.weight)
    assert minima.cost[0] <= best.min()
    assert np.linalg.norm(grid[best.argmin()] - minima.position[0]) < 1.0


# With the first seeds the grid alone misses the lowest minimum, with the others the closed form.
@pytest.mark.parametrize('seed', [333, 399, 435, 468, 570, 9, 24, 81, 117, 183, 228, 294, 297])
def test_tag_search_is_never_worse_than_one_begun_at_the_truth(seed):
    rng = np.random.default_rng(seed)
    n, sigma = 4 + seed % 2, 0.15 * (1 if seed % 3 else 60)
    rx = np.column_stack([rng.uniform(-100, 100, (n, 2)), rng.uniform(-9, -1, n)])
    truth = rng.uniform(-150, 150, 2)
    noise = sigma * np.random.default_rng(seed).standard_normal(n)
    fit = ArrivalFit(
        tx=rx, rx=rx, active=np.zeros(n, bool), bearing_rx=np.empty((0, 3)),
        observed=multistatic.slant_range(truth, rx, -5.0)[0] + noise, weight=np.full(n, 0.15**-2),
        target_z=-5.0, max_range=1e4,
    )  # fmt: skip
    found = minimise(fit, fit.starts(fit.weight), fit.weight).distinct()
    begun = minimise(fit, truth[None], fit.weight)
    assert found.cost[0] <= 1.001 * begun.cost[0] + 1e-3


def test_a_search_begins_evenly_all_round():
    """The points of an ellipse have its centre as their mean, those of a circle theirs."""
    fit = problem(KINDS['active'])
    rows = np.argsort(-fit.weight[:5], kind='stable')[:3]
    middle = 0.5 * (fit.tx + fit.rx)[rows, :2]
    assert_allclose(fit._ellipses(np.arange(5)).mean(axis=1)[:3], middle, atol=1e-9)
    fit = problem(KINDS['passive'])
    circles = fit._polar_grid().mean(axis=1)
    assert_allclose(circles, np.tile(fit.centre, (len(circles), 1)), atol=1e-9)


def test_runs_that_leave_for_infinity_end():
    fit = problem(KINDS['passive'], offset=40.0, bearings=0)
    minima = minimise(fit, np.array([TRUTH, [5e3, 8e3]]), fit.weight)
    assert minima.converged.all()
    assert_allclose(minima.position[0], TRUTH, atol=1e-6)


def test_each_start_may_have_its_own_weights():
    fit = problem(KINDS['active'], bearings=0)
    fit.observed[2] += 30.0
    starts = np.tile(TRUTH + [3.0, -2.0], (5, 1))
    without = fit.weight * (1.0 - np.eye(5))
    minima = minimise(fit, starts, without)
    assert minima.cost.argmin() == 2
    assert_allclose(minima.position[2], TRUTH, atol=1e-3)
    assert minima.cost[[0, 1, 3, 4]].min() > 1.0


def test_without_starts_there_are_no_minima():
    fit = problem(KINDS['active'])
    assert len(minimise(fit, np.empty((0, 2)), fit.weight).distinct().cost) == 0


# -- measurement models against finite differences, symmetry and the joint estimate ---------------

COORDINATE = st.floats(-300.0, 300.0)
POINT = st.tuples(COORDINATE, COORDINATE, st.floats(-40.0, 0.0)).map(np.array)
PLACE = st.tuples(COORDINATE, COORDINATE).map(np.array)
quick = settings(max_examples=60, derandomize=True, deadline=None)


def slope(function, position, step=1e-4):
    """Central differences (n, 2) of function(position) -> (n,)."""
    ends = [(function(position + e), function(position - e)) for e in step * np.eye(2)]
    return np.stack([(ahead - behind) / (2 * step) for ahead, behind in ends], axis=-1)


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
    found = multistatic.range_sum(position, tx, rx, -3.0)[2, 1]
    assert_allclose(found, multistatic.range_sum(position[2, 1], tx, rx, -3.0))


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


# -- paths and angles in three dimensions ---------------------------------------------------------


def test_the_paths_of_the_vectors():
    v = vectors('arrivals_3d')
    got, jacobian = arrival_paths(v['position'], v['tx'], v['rx']), v['out_jacobian']
    np.testing.assert_allclose(got.length, v['out_path'], atol=1e-9)
    np.testing.assert_allclose(got.by_position, jacobian[:, :3], atol=1e-9)
    for r in range(4):
        np.testing.assert_allclose(got.by_offset[r], jacobian[r, 3 + 2 * r : 5 + 2 * r], atol=1e-9)
        assert jacobian[r, 13 + r] == got.by_clock[r]
    np.testing.assert_allclose(got.by_sound_speed, jacobian[:, 17], atol=1e-9)


def test_the_angles_of_the_vectors():
    v = vectors('usbl')
    known = v['position'], v['receiver'][None]
    bearing, by_bearing, elevation, by_elevation = arrival_angles(*known)
    assert bearing[0] == pytest.approx(float(v['out_bearing']), abs=1e-9)
    assert elevation[0] == pytest.approx(float(v['out_elevation']), abs=1e-9)
    np.testing.assert_allclose(by_bearing[0], v['out_jacobian_bearing'], atol=1e-9)
    np.testing.assert_allclose(by_elevation[0], v['out_jacobian_elevation'], atol=1e-9)
    leg = arrival_paths(v['position'], None, v['receiver'][None])
    assert leg.length[0] == pytest.approx(float(v['out_range']), abs=1e-9)
    np.testing.assert_allclose(leg.by_position[0], v['out_jacobian_range'], atol=1e-9)


COLUMNS = np.array([0, 1, 3, 5, 7, 8, 9])
STATE = np.array([31.0, -12.0, 0.7, -9.0, 0.1, 0.6, -0.4, 0.8, 0.003, 4.0])


def seen(kind, states, tx, rx, columns=COLUMNS, height=0.0):
    """What one measurement of a kind expects at states (L, n): values (L,), gradients (L, n)."""
    one = np.array([kind]), columns[None], tx[None], rx[None]
    value, gradient = observe(np.atleast_2d(states).T, height, *one)
    return value[0], gradient[0].T


@pytest.mark.parametrize('kind', [PATH, ONE_WAY, BEARING, ELEVATION, HEIGHT])
def test_the_form_for_many_states_equals_the_plain_one_and_its_gradient_the_differences(kind):
    tx, rx = np.array([0.0, 0.0, -3.0]), np.array([70.0, 10.0, -5.0])
    (value,), (gradient,) = seen(kind, STATE, tx, rx)
    place = STATE[[0, 1, 3]]
    angles = arrival_angles(place, rx[None])
    errors = {'offset': STATE[5:7], 'clock': STATE[7], 'sound_speed_error': STATE[8]}
    expected = {
        PATH: arrival_paths(place, tx, rx[None], **errors).length[0],
        ONE_WAY: arrival_paths(place, None, rx[None], **errors).length[0] + STATE[9],
        BEARING: angles[0][0] + STATE[7],  # an error of all bearings has the place of a clock
        ELEVATION: angles[2][0],
        HEIGHT: STATE[3],
    }[kind]
    assert value == pytest.approx(expected, abs=1e-12)
    step = 1e-6 * np.eye(10)
    ahead, behind = seen(kind, STATE + step, tx, rx)[0], seen(kind, STATE - step, tx, rx)[0]
    # angles have no gradient by the offset of the receiver: it is metres among tens
    np.testing.assert_allclose(gradient, (ahead - behind) / 2e-6, atol=1e-7)


def test_measurements_of_all_kinds_at_once_are_those_of_each_kind():
    """Each with errors of its own receiver, or none."""
    kind = np.array([HEIGHT, PATH, BEARING, ONE_WAY, PATH, ELEVATION])
    rng = np.random.default_rng(5)
    tx, rx = rng.uniform(-80.0, 80.0, (2, 6, 3))
    columns = np.tile(COLUMNS, (6, 1))
    columns[4, 3:5] = columns[2, 4] = -1
    states = STATE + rng.normal(size=(4, 10))
    value, gradient = observe(states.T, 0.0, kind, columns, tx, rx)
    for c in range(6):
        each = seen(kind[c], states, tx[c], rx[c], columns[c])
        np.testing.assert_array_equal(value[c], each[0])
        np.testing.assert_array_equal(gradient[c].T, each[1])


def test_without_states_the_height_is_the_given_one_and_no_point_is_singular():
    columns = np.array([0, 1, -1, -1, -1, -1, -1])
    here = np.array([5.0, 5.0, -3.0])
    for kind in (PATH, ONE_WAY, BEARING, ELEVATION):
        value, gradient = seen(kind, here[:2], here, here, columns, -3.0)
        assert np.isfinite(value).all() and (gradient == 0.0).all()
    assert all(np.isfinite(part).all() for part in arrival_paths(here, here, here[None]))
    assert all(np.isfinite(part).all() for part in arrival_angles(here, here[None]))
