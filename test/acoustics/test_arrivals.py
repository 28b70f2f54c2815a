# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Paths and angles of arrivals, and the least-squares problem of one ping: vectors, derivatives,
closed form, search."""

from helpers.vector_files import vectors
from hypothesis import assume, given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose
import pytest

from sonar_imm.acoustics import arrivals_3d as arrivals
from sonar_imm.acoustics import multistatic
from sonar_imm.acoustics.arrival_fit import ArrivalFit, minimise
from sonar_imm.estimation.angles import wrap_angle

Z = -6.0
RX = np.array(
    [
        [80.0, 5.0, -2.0], [-30.0, 70.0, -3.0], [60.0, 90.0, -1.0], [-70.0, -20.0, -4.0],
        [10.0, -60.0, -2.0],
    ]
)  # fmt: skip
TRUTH = np.array([22.0, 31.0])
KINDS = {'active': [True] * 5, 'passive': [False] * 5, 'mixed': [True, False, True, False, False]}
COORDINATE = st.floats(-300.0, 300.0)
POINT = st.tuples(COORDINATE, COORDINATE, st.floats(-40.0, 0.0)).map(np.array)
PLACE = st.tuples(COORDINATE, COORDINATE).map(np.array)
quick = settings(max_examples=60, derandomize=True, deadline=None)
COLUMNS = np.array([0, 1, 3, 5, 7, 8, 9])
STATE = np.array([31.0, -12.0, 0.7, -9.0, 0.1, 0.6, -0.4, 0.8, 0.003, 4.0])
DIRECTED = arrivals.PATH, arrivals.ONE_WAY, arrivals.BEARING, arrivals.ELEVATION


def problem(active, offset=0.0, bearings=2):
    active = np.array(active)
    tx = np.where(active[:, None], [5.0, -12.0, -3.0], RX)
    sent, path = (multistatic.slant_range(TRUTH, place, Z)[0] for place in (tx, RX))
    path = path + np.where(active, sent, offset)
    seen = multistatic.bearing(TRUTH, RX[:bearings])
    return ArrivalFit(
        tx=tx, rx=RX, active=active, bearing_rx=RX[:bearings],
        observed=np.concatenate([path, seen]), weight=np.linspace(1.0, 3.0, len(RX) + bearings),
        target_z=Z, max_range=1000.0,
    )  # fmt: skip


@pytest.mark.parametrize('kind', KINDS)
def test_residuals_vanish_at_the_truth_and_have_the_gradient_of_their_differences(kind):
    """Whatever the emission, also with rows left out."""
    fit = problem(KINDS[kind], offset=-750.0)
    assert_allclose(fit.residuals(TRUTH[None], fit.weight)[0], 0.0, atol=1e-10)
    weight = fit.weight * [1, 1, 0, 1, 1, 0, 1]
    due = slope(lambda p: -fit.residuals(p[None], weight)[0][0], np.array([10.0, -15.0]))
    _, jacobian = fit.residuals(np.array([[10.0, -15.0]]), weight)
    assert_allclose(jacobian[0], due, atol=1e-6)


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
@pytest.mark.parametrize('seed', [333, 399, 435, 9, 24, 81])
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
    assert found.cost[0] <= 1.001 * minimise(fit, truth[None], fit.weight).cost[0] + 1e-3


def test_runs_that_leave_for_infinity_end():
    fit = problem(KINDS['passive'], offset=40.0, bearings=0)
    minima = minimise(fit, np.array([TRUTH, [5e3, 8e3]]), fit.weight)
    assert minima.converged.all()
    assert_allclose(minima.position[0], TRUTH, atol=1e-6)
    assert len(minimise(fit, np.empty((0, 2)), fit.weight).distinct().cost) == 0


def test_each_start_may_have_its_own_weights():
    fit = problem(KINDS['active'], bearings=0)
    fit.observed[2] += 30.0
    starts = np.tile(TRUTH + [3.0, -2.0], (5, 1))
    without = fit.weight * (1.0 - np.eye(5))
    minima = minimise(fit, starts, without)
    assert minima.cost.argmin() == 2
    assert_allclose(minima.position[2], TRUTH, atol=1e-3)
    assert minima.cost[[0, 1, 3, 4]].min() > 1.0


def slope(function, position, step=1e-4):
    """Central differences (n, 2) of function(position) -> (n,)."""
    ends = [(function(position + e), function(position - e)) for e in step * np.eye(2)]
    return np.stack([(ahead - behind) / (2 * step) for ahead, behind in ends], axis=-1)


@quick
@given(PLACE, POINT, POINT, st.floats(-40.0, 0.0))
def test_ranges_and_bearings_are_those_of_the_definition_with_their_slopes(position, tx, rx, z):
    assume(min(np.hypot(*(position - point[:2])) for point in (tx, rx)) > 0.5)
    legs = [np.linalg.norm(np.append(position, z) - point) for point in (tx, rx)]
    tx, rx = tx[None], rx[None]
    assert_allclose(multistatic.range_sum(position, tx, rx, z), sum(legs), rtol=1e-12)
    found = multistatic.range_sum_jacobian(position, tx, rx, z)
    due = slope(lambda p: multistatic.range_sum(p, tx, rx, z), position)
    assert_allclose(found, due, atol=1e-6)
    length, direction = multistatic.slant_range(position, rx, z)
    assert_allclose(length, legs[1], rtol=1e-12)
    due = slope(lambda p: multistatic.slant_range(p, rx, z)[0], position)
    assert_allclose(direction, due, atol=1e-6)
    around = multistatic.bearing(position, rx)
    east, north = position - rx[0, :2]
    assert_allclose(around, np.arctan2(north, east), atol=1e-12)
    due = slope(lambda p: wrap_angle(multistatic.bearing(p, rx) - around), position)
    assert_allclose(multistatic.bearing_jacobian(position, rx), due, rtol=1e-6, atol=1e-7)


def test_hand_worked_values():
    tx, rx, position = np.zeros((1, 3)), np.array([[3.0, 4.0, 0.0]]), np.array([3.0, 0.0])
    assert_allclose(multistatic.range_sum(position, tx, rx, 0.0), [7.0])
    assert_allclose(multistatic.range_sum_jacobian(position, tx, rx, 0.0), [[1.0, -1.0]])
    assert_allclose(multistatic.bearing(position, rx), [-np.pi / 2])
    assert_allclose(multistatic.bearing_jacobian(position, rx), [[0.25, 0.0]])
    assert_allclose(multistatic.range_sum(position, tx, rx, 4.0), [5.0 + np.sqrt(32.0)])
    many = np.tile(position, (4, 3, 1))
    assert_allclose(multistatic.range_sum(many, tx, rx, 0.0), np.full((4, 3, 1), 7.0))
    assert multistatic.bearing_jacobian(many, rx).shape == (4, 3, 1, 2)


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


def test_emission_time_and_its_variance_are_those_of_the_joint_estimate():
    speed = 1480.0
    variance = np.linspace(0.5, 2.0, len(RX)) * 1e-7
    length, direction = multistatic.slant_range(TRUTH, RX, -4.0)
    known = {'target_z': -4.0, 'sound_speed': speed}
    seen = length / speed + 77.25, variance, RX, TRUTH
    assert multistatic.emission_time(*seen, **known)[0] == pytest.approx(77.25, abs=1e-12)
    augmented = np.column_stack([direction / speed, np.ones(len(RX))])
    joint = np.linalg.inv(augmented.T @ np.diag(1.0 / variance) @ augmented)
    _, stated = multistatic.emission_time(*seen, **known, covariance=joint[:2, :2])
    assert stated == pytest.approx(joint[2, 2], rel=1e-9)


def test_the_paths_of_the_vectors():
    v = vectors('arrivals_3d')
    got, jacobian = arrivals.arrival_paths(v['position'], v['tx'], v['rx']), v['out_jacobian']
    assert_allclose(got.length, v['out_path'], atol=1e-9)
    assert_allclose(got.by_position, jacobian[:, :3], atol=1e-9)
    for r in range(4):
        assert_allclose(got.by_offset[r], jacobian[r, 3 + 2 * r : 5 + 2 * r], atol=1e-9)
        assert jacobian[r, 13 + r] == got.by_clock[r]
    assert_allclose(got.by_sound_speed, jacobian[:, 17], atol=1e-9)


def test_the_angles_of_the_vectors():
    v = vectors('usbl')
    known = v['position'], v['receiver'][None]
    bearing, by_bearing, elevation, by_elevation = arrivals.arrival_angles(*known)
    assert bearing[0] == pytest.approx(float(v['out_bearing']), abs=1e-9)
    assert elevation[0] == pytest.approx(float(v['out_elevation']), abs=1e-9)
    assert_allclose(by_bearing[0], v['out_jacobian_bearing'], atol=1e-9)
    assert_allclose(by_elevation[0], v['out_jacobian_elevation'], atol=1e-9)
    leg = arrivals.arrival_paths(v['position'], None, v['receiver'][None])
    assert leg.length[0] == pytest.approx(float(v['out_range']), abs=1e-9)
    assert_allclose(leg.by_position[0], v['out_jacobian_range'], atol=1e-9)


def seen(kind, states, tx, rx, columns=COLUMNS, height=0.0):
    """What one measurement of a kind expects at states (L, n): values (L,), gradients (L, n)."""
    one = np.array([kind]), columns[None], tx[None], rx[None]
    value, gradient = arrivals.observe(np.atleast_2d(states).T, height, *one)
    return value[0], gradient[0].T


@pytest.mark.parametrize('kind', [*DIRECTED, arrivals.HEIGHT])
def test_the_form_for_many_states_equals_the_plain_one_and_its_gradient_the_differences(kind):
    tx, rx = np.array([0.0, 0.0, -3.0]), np.array([70.0, 10.0, -5.0])
    (value,), (gradient,) = seen(kind, STATE, tx, rx)
    place = STATE[[0, 1, 3]]
    angles = arrivals.arrival_angles(place, rx[None])
    errors = {'offset': STATE[5:7], 'clock': STATE[7], 'sound_speed_error': STATE[8]}
    both, one = (arrivals.arrival_paths(place, t, rx[None], **errors) for t in (tx, None))
    # An error of all bearings has the place of a clock.
    due = both.length[0], one.length[0] + STATE[9], angles[0][0] + STATE[7], angles[2][0], STATE[3]
    expected = dict(zip((*DIRECTED, arrivals.HEIGHT), due))[kind]
    assert value == pytest.approx(expected, abs=1e-12)
    step = 1e-6 * np.eye(10)
    ahead, behind = seen(kind, STATE + step, tx, rx)[0], seen(kind, STATE - step, tx, rx)[0]
    # angles have no gradient by the offset of the receiver: it is metres among tens
    assert_allclose(gradient, (ahead - behind) / 2e-6, atol=1e-7)


def test_measurements_of_all_kinds_at_once_are_those_of_each_kind():
    kind = np.array([arrivals.HEIGHT, *DIRECTED, arrivals.PATH])
    rng = np.random.default_rng(5)
    tx, rx = rng.uniform(-80.0, 80.0, (2, 6, 3))
    columns = np.tile(COLUMNS, (6, 1))
    columns[5, 3:5] = columns[3, 4] = -1
    states = STATE + rng.normal(size=(4, 10))
    value, gradient = arrivals.observe(states.T, 0.0, kind, columns, tx, rx)
    for c in range(6):
        each = seen(kind[c], states, tx[c], rx[c], columns[c])
        np.testing.assert_array_equal(value[c], each[0])
        np.testing.assert_array_equal(gradient[c].T, each[1])


def test_without_states_the_height_is_the_given_one_and_no_point_is_singular():
    columns, here = np.array([0, 1, -1, -1, -1, -1, -1]), np.array([5.0, 5.0, -3.0])
    for kind in DIRECTED:
        value, gradient = seen(kind, here[:2], here, here, columns, -3.0)
        assert np.isfinite(value).all() and (gradient == 0.0).all()
    found = arrivals.arrival_paths(here, here, here[None])
    angles = arrivals.arrival_angles(here, here[None])
    assert all(np.isfinite(part).all() for part in (*found, *angles))
