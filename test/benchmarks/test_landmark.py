# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The baseline in world coordinates: its unscented filter is exact where it must be, indifferent
to the choice of north, and never without an answer."""

import numpy as np
import pytest

from benchmarks.landmark import LandmarkTracker, unscented_transform, update
from benchmarks.obstacle_accuracy import config_of, track
from sonar_imm.estimation import kalman
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate

RANGE_BEARING = np.array([False, True])


def range_bearing(points):
    return np.stack(
        [np.hypot(points[..., 0], points[..., 1]), np.arctan2(points[..., 1], points[..., 0])],
        axis=-1,
    )


def covariance(rng, *shape):
    root = rng.normal(size=(*shape, shape[-1] + 1))
    return root @ np.swapaxes(root, -1, -2)


@pytest.mark.parametrize('n', [2, 4, 6])
def test_linear_functions_give_the_kalman_filter(n):
    rng = np.random.default_rng(n)
    x, P, F, Q = (
        rng.normal(size=(5, n)),
        covariance(rng, 5, n),
        rng.normal(size=(n, n)),
        covariance(rng, n),
    )
    H, R, z = rng.normal(size=(2, n)), covariance(rng, 2), rng.normal(size=(5, 2))
    expected = kalman.predict(x, P, F, Q, np.ones(n))
    moved = unscented_transform(lambda points: points @ F.T + 1.0, x, P)
    np.testing.assert_allclose(moved.mean, expected.x, rtol=1e-9, atol=1e-10)
    np.testing.assert_allclose(moved.covariance + Q, expected.P, rtol=1e-9, atol=1e-10)
    seen = update(x, P, z, lambda points: points @ H.T, R)
    for got, want in zip(seen, kalman.update(x, P, z - x @ H.T, H, R)):
        np.testing.assert_allclose(got, want, rtol=1e-9, atol=1e-10)


def test_filterpy_agrees_where_angles_do_not_matter():
    """FilterPy's Julier points with the same square root and kappa = 3 - n, far from the cut of
    the bearing."""
    filterpy = pytest.importorskip('filterpy.kalman')

    def principal(scaled):
        values, vectors = np.linalg.eigh(scaled)
        return (vectors * np.sqrt(values)).T

    points = filterpy.JulierSigmaPoints(2, kappa=1.0, sqrt_method=principal)
    theirs = filterpy.UnscentedKalmanFilter(
        2, 2, 1.0, hx=range_bearing, fx=lambda p, dt: p + 0.01 * p**2, points=points
    )
    theirs.x, theirs.P, theirs.Q, theirs.R = (
        np.array([30.0, 10.0]),
        np.diag([4.0, 2.0]),
        np.eye(2) * 0.1,
        np.diag([0.3, 0.01]),
    )
    theirs.predict()
    moved = unscented_transform(
        lambda p: p + 0.01 * p**2, np.array([30.0, 10.0]), np.diag([4.0, 2.0])
    )
    x, P = moved.mean, moved.covariance + theirs.Q
    np.testing.assert_allclose(x, theirs.x, rtol=1e-12)
    np.testing.assert_allclose(P, theirs.P, rtol=1e-12)
    # FilterPy measures with the propagated points, not with new ones drawn from the prediction:
    # draw them for it.
    theirs.sigmas_f = points.sigma_points(theirs.x, theirs.P)
    z = np.array([42.0, 0.35])
    theirs.update(z)
    updated = update(x, P, z, range_bearing, theirs.R, angles=RANGE_BEARING)
    np.testing.assert_allclose(updated.x, theirs.x, rtol=1e-9)
    np.testing.assert_allclose(updated.P, theirs.P, rtol=1e-7)
    np.testing.assert_allclose(updated.log_likelihood, theirs.log_likelihood, rtol=1e-8)


def test_one_gaussian_in_world_coordinates_follows_an_obstacle():
    setting = scenario('approach', {'last_range': 40.0})
    final = track(simulate(setting, 3), config_of(setting), LandmarkTracker)
    newest = final[max(final)]
    (row,) = np.flatnonzero(newest.extras['track_state'] > 0)
    error = abs(newest.state[row, 2] - 3.0)
    assert error < 4.0 * np.sqrt(newest.covariance[row, 2, 2]) + 1.0
    assert abs(newest.state[row, 0] - 40.0) < 2.0
