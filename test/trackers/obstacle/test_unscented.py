# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The arithmetic of the filter against readable forms, brute force and sampling."""

import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.optimize import brentq
from scipy.special import ndtr

from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.trackers.obstacle import mixtures, unscented
from sonar_imm.trackers.obstacle.unscented import Motion, Step

MODELS = {'plane': False, 'cone': True}


def poses(rng):
    """Two poses a metre and a few degrees apart."""
    angles = rng.normal(0.0, 0.1, 3)
    before = Pose(rng.normal(0.0, 20.0, 3), geometry.rotation(*angles))
    after = Pose(
        before.position + rng.normal(0.0, 1.0, 3),
        geometry.rotation(*(angles + rng.normal(0.0, 0.03, 3))),
    )
    return before, after


def targets(rng, before, T=3, K=4):
    x = np.empty((T, K, 4))
    x[..., 0] = rng.uniform(30.0, 90.0, (T, K))
    x[..., 1] = rng.uniform(-0.3, 0.3, (T, K))
    x[..., 2] = before.position[2] + rng.uniform(-6.0, 6.0, (T, K))
    x[..., 3] = rng.normal(0.0, 0.003, (T, K))
    A = rng.normal(size=(T, K, 4, 4)) * np.array([0.2, 0.004, 1.5, 0.003])[:, None]
    mu = rng.dirichlet(np.ones(K), T)
    return x, A @ np.swapaxes(A, -1, -2), mu


def advanced(x, P, before, after, noise, cone=False):
    """The prediction of obstacles that are all fixed, of which no other error of the navigation
    is known than its scale."""
    weights, step = np.ones(x.shape[:2]), Step(*before, *after, noise, cone)
    whole, spread = np.zeros((*x.shape[:2], 8)), np.zeros((*x.shape[:2], 8, 8))
    whole[..., :4], spread[..., :4, :4] = x, P
    found = unscented.advance(whole, spread, weights, Motion.none(x.shape[1]), step)
    return found[0][..., :4], found[1][..., :4, :4], found[2]


def sigma_points(x, P):
    """Seven points (..., 7, 3) and their weights, by numpy."""
    columns = np.swapaxes(2.0 * np.linalg.cholesky(P), -1, -2)
    centre = x[..., None, :]
    weights = np.array([0.25] + [0.125] * 6)
    return np.concatenate([centre, centre + columns, centre - columns], axis=-2), weights


@pytest.mark.parametrize('model', MODELS)
def test_prediction_equals_numpy(model):
    rng = np.random.default_rng(1)
    before, after = poses(rng)
    x, P, _ = targets(rng, before)
    P[..., 3, :] = P[..., 3] = 0.0
    noise = np.array([1e-3, 2e-7, 3e-4])
    x1, P1, _ = advanced(x, P, before, after, noise, MODELS[model])
    points, weights = sigma_points(x[..., :3], P[..., :3, :3])
    d, delta, z = np.moveaxis(points, -1, 0)
    s = np.broadcast_to(x[..., 3:], d.shape)
    m = geometry.reconstruct(d, delta, z - before.position[2], before.R, model)
    stretch = np.stack([1.0 + s, 1.0 + s, np.ones_like(s)], axis=-1)
    moved = geometry.apply(before.R, m) + (before.position - after.position) * stretch
    echo = geometry.project(geometry.apply(after.R.T, moved), model)
    images = np.stack([*echo, z, s], axis=-1)
    mean = np.einsum('s,tksi->tki', weights, images)
    off = images - mean[..., None, :]
    covariance = np.einsum('s,tksi,tksj->tkij', weights, off, off)
    covariance[..., 0, 0] += noise[0]
    covariance[..., 1, 1] += noise[0] / mean[..., 0] ** 2 + noise[1]
    covariance[..., 2, 2] += noise[2]
    assert_allclose(x1, mean, rtol=1e-12, atol=1e-13)
    assert_allclose(P1, covariance, rtol=1e-9, atol=1e-15)
    assert np.all(P1 == np.swapaxes(P1, -1, -2))


def test_prediction_of_a_known_target_is_exact():
    """Without variance the mean is the geometry's own prediction, and nothing is spread."""
    rng = np.random.default_rng(2)
    before, after = poses(rng)
    x, _, _ = targets(rng, before)
    x[..., 3] = 0.0
    x1, P1, _ = advanced(x, np.zeros((3, 4, 4, 4)), before, after, np.zeros(3))
    m = geometry.reconstruct(x[..., 0], x[..., 1], x[..., 2] - before.position[2], before.R)
    assert_allclose(
        x1[..., :2], np.stack(geometry.project(geometry.predict(m, before, after)), -1), rtol=1e-12
    )
    assert_allclose(P1, 0.0, atol=1e-20)


def test_a_turn_through_the_back_keeps_the_spread_of_the_azimuth():
    """Azimuths on both sides of +-180 degrees are neighbours."""
    x = np.array([[[50.0, 3.0, 0.0, 0.0]]])
    P = np.diag([0.01, 1e-4, 0.01, 1e-6])[None, None]
    still = np.zeros(3)
    turned = geometry.rotation(0.0, 0.0, -(np.pi - 3.0))
    _, P1, _ = advanced(x, P, Pose(still, np.eye(3)), Pose(still, turned), np.zeros(3))
    assert_allclose(P1[0, 0, 1, 1], 1e-4, rtol=1e-3)


@pytest.mark.parametrize('model', MODELS)
def test_where_no_point_exists_the_nearest_is_taken(model):
    x = np.array([[[10.0, 0.1, 12.0, 0.0]]])
    m = unscented.points(x, np.zeros(3), np.eye(3), MODELS[model])[0, 0]
    assert np.isfinite(m).all()
    assert_allclose(np.linalg.norm(m), 10.0)


def test_places_equal_sampling():
    rng = np.random.default_rng(3)
    before, _ = poses(rng)
    x, P, mu = targets(rng, before, T=1, K=2)
    still = np.zeros(2, np.bool_)
    near = unscented.relative(x, P, mu, still, *before, False)
    mean, covariance = mixtures.moment_match(*near, mu, 3)
    which = rng.choice(2, 200_000, p=mu[0])
    draws = np.array([rng.multivariate_normal(x[0, k], P[0, k], 200_000) for k in (0, 1)])
    d, delta, z, _ = draws[which, np.arange(200_000)].T
    m = geometry.reconstruct(d, delta, z - before.position[2], before.R)
    world = geometry.apply(before.R, m)
    assert_allclose(mean[0], world.mean(axis=0), atol=0.1)
    assert_allclose(covariance[0], np.cov(world.T), rtol=0.05, atol=0.2)


def test_an_update_and_its_hypotheses_put_together():
    """Of the first target one of two echoes, or none; of the third one or none."""
    rng = np.random.default_rng(4)
    before, _ = poses(rng)
    x, P, mu = targets(rng, before)
    target = np.array([0, 0, 2])
    z = x[target, 0, :2] + rng.normal(size=(3, 2)) * [0.3, 0.005]
    R = np.tile(np.diag([0.025, 2.5e-5]), (3, 1, 1))
    h = np.ascontiguousarray(x[target][..., :2])
    *given, log, _ = mixtures.update(x[target], P[target], mu[target], h, z, R)
    share = np.array([0.5, 0.2, 0.6])
    after, covariance, weight = mixtures.combine(x, P, mu, tuple(given), target, share)
    H = np.eye(2, 4)
    none = 1.0 - np.bincount(target, share, 3)
    cases = {t: [[(none[t] * mu[t, k], x[t, k], P[t, k])] for k in range(4)] for t in (0, 2)}
    for m, t in enumerate(target):
        own = np.empty(4)
        updated = []
        for k in range(4):
            S, v = H @ P[t, k] @ H.T + R[m], z[m] - x[t, k, :2]
            own[k] = mu[t, k] * np.exp(-0.5 * v @ np.linalg.solve(S, v))
            own[k] /= 2.0 * np.pi * np.sqrt(np.linalg.det(S))
            gain = P[t, k] @ H.T @ np.linalg.inv(S)
            updated.append((x[t, k] + gain @ v, (np.eye(4) - gain @ H) @ P[t, k]))
        assert_allclose(log[m], np.log(own.sum()), rtol=1e-9)
        for k in range(4):
            cases[t][k].append((share[m] * own[k] / own.sum(), *updated[k]))
        # The innovation is that of the mixture, of which the components' means are a part.
        r = z[m] - x[t, :, :2]
        mean, whole, nis = mixtures.innovations(mu[t][None], r[None], P[t][None, :, :2, :2] + R[m])
        off = r - mu[t] @ r
        S = np.einsum('k,kij->ij', mu[t], P[t, :, :2, :2] + R[m] + off[:, :, None] * off[:, None])
        assert_allclose(mean[0], mu[t] @ r)
        assert_allclose(whole[0], S)
        assert_allclose(nis[0], mu[t] @ r @ np.linalg.solve(S, mu[t] @ r), rtol=1e-9)
    for t in (0, 2):
        for k in range(4):
            total = sum(w for w, _, _ in cases[t][k])
            mean = sum(w * m for w, m, _ in cases[t][k]) / total
            spread = sum(w * (C + np.outer(m - mean, m - mean)) for w, m, C in cases[t][k]) / total
            assert_allclose(weight[t, k], total, rtol=1e-9)
            assert_allclose(after[t, k], mean, rtol=1e-9)
            assert_allclose(covariance[t, k], spread, rtol=1e-7, atol=1e-12)
    assert_allclose(after[1], x[1])
    assert_allclose(weight[1], mu[1])


def test_an_update_that_no_component_explains_keeps_finite_weights():
    x, P = np.zeros((1, 2, 4)), np.tile(np.eye(4) * 1e-6, (1, 2, 1, 1))
    mu, z = np.array([[0.3, 0.7]]), np.full((1, 2), 1e3)
    R = np.eye(2)[None] * 1e-6
    *_, weight, log, _ = mixtures.update(x, P, mu, x[..., :2].copy(), z, R)
    assert_allclose(weight, mu, rtol=1e-4)
    assert log[0] < -1e6


def test_only_echoes_near_some_component_are_in_the_gate():
    h = np.array([[[0.0, 0.0], [5.0, 0.0]], [[9.0, 0.0], [9.0, 0.0]], [[3.0, 0.0], [3.0, 0.0]]])
    C, mu = np.tile(np.eye(2), (3, 2, 1, 1)), np.array([[1.0, 0.5], [0.5, 0.0], [0.0, 0.0]])
    z, R = np.array([[0.5, 0.0], [7.0, 0.0], [60.0, 0.0]]), np.tile(np.eye(2), (3, 1, 1))
    near = mixtures.gate(h, C, mu, z, R, 3.0)
    assert near.tolist() == [[True, True, False], [False, True, False], [False] * 3]


def test_quantiles_of_mixtures():
    rng = np.random.default_rng(5)
    mean, std = rng.normal(0.0, 5.0, (6, 3)), rng.uniform(0.1, 3.0, (6, 3))
    mu = rng.dirichlet(np.ones(3), 6)
    mu[0] = [1.0, 0.0, 0.0]
    mean[1], std[1], mu[1] = [-500.0, 0.0, 500.0], 1e-3, [0.05 - 1e-9, 0.9, 0.05 + 1e-9]
    low, high, negative = mixtures.bands(mean, std, mu, 0.05)

    def beyond(value, t, probability):
        return float(mu[t] @ ndtr((value - mean[t]) / std[t])) - probability

    for t in range(6):
        assert_allclose(negative[t], beyond(0.0, t, 0.0), atol=1e-12)
        for quantile, probability in ((low[t], 0.05), (high[t], 0.95)):
            exact = brentq(beyond, -1e3, 1e3, args=(t, probability), xtol=1e-12)
            assert_allclose(quantile, exact, atol=1e-6)
