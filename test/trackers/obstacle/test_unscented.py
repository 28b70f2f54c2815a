# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The arithmetic of the filter and of mixing against readable forms, brute force and sampling."""

import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.optimize import brentq
from scipy.special import ndtr

from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.trackers.obstacle import mixtures, unscented
from sonar_imm.trackers.obstacle.config import ObstacleConfig
from sonar_imm.trackers.obstacle.filters import BehaviourSlices, Sonar
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


def behaving(rng, before, slices=2, T=2, errors=0.0):
    """Components of each slice: fixed, swaying, swaying farther, moving, begun to; one more is
    fixed. errors: how much is unknown of the navigation."""
    C = 5 * slices + 1
    x = np.zeros((T, C, 10))
    x[..., 0] = rng.uniform(30.0, 90.0, (T, C))
    x[..., 1] = rng.uniform(-0.3, 0.3, (T, C))
    x[..., 2] = before.position[2] + rng.uniform(-6.0, 6.0, (T, C))
    x[..., 3] = rng.normal(0.0, 0.003, (T, C))
    x[..., 8:] = rng.normal(0.0, 0.5, (T, C, 2))
    navigation = errors * np.array([0.003, 0.002, 0.01, 0.01, 0.05])
    scale = np.array([0.2, 0.004, 1.5, *navigation, 0.3, 0.3])
    A = rng.normal(size=(T, C, 10, 10)) * scale[:, None]
    P = A @ np.swapaxes(A, -1, -2)
    fixed = np.arange(C) % 5 == 0
    x[:, fixed, 8:] = 0.0
    P[:, fixed, 8:, :] = P[:, fixed, :, 8:] = 0.0
    return x, P, rng.dirichlet(np.ones(C), T)


def motion(dt=0.5, slices=2):
    config = ObstacleConfig(components=slices)
    return BehaviourSlices(config)._motion(dt)


CHAIN = np.full((5, 5), 0.02) + np.diag([0.9, 0.9, 0.88, 0.9, 0.82])
CHAIN[2, 3] += 0.02
CHAIN[4, 3] += 0.08
SAME = np.eye(5, dtype=bool)
SAME[1, 2] = SAME[2, 1] = SAME[3, 4] = SAME[4, 3] = True


def numpy_mix(x, P, mu, prior, slices, chain, same):
    """The mixing written out: sources as they look to each behaviour, then moments."""
    x1, P1, mu1, M = x.copy(), P.copy(), mu.copy(), len(chain)
    for t in range(len(x)):
        for k in range(slices):
            own = slice(k * M, (k + 1) * M)
            mu1[t, own] = mu[t, own] @ chain
            for a in range(M):
                share = mu[t, own] * chain[:, a] / mu1[t, k * M + a]
                means, covariances = x[t, own].copy(), P[t, own].copy()
                for i in range(M):
                    if not same[i, a]:
                        means[i, 8:] = 0.0
                        covariances[i, 8:, :] = covariances[i, :, 8:] = 0.0
                        covariances[i, 8:, 8:] = np.eye(2) * prior[k * M + a]
                mean = share @ means
                off = means - mean
                x1[t, k * M + a] = mean
                P1[t, k * M + a] = np.einsum('i,iab->ab', share, covariances) + np.einsum(
                    'i,ia,ib->ab', share, off, off
                )
    return x1, P1, mu1


def test_mixing_equals_numpy():
    rng = np.random.default_rng(1)
    before, _ = poses(rng)
    x, P, mu = behaving(rng, before, errors=1.0)
    prior = motion().prior
    got = mixtures.mix(x, P, mu, prior, 2, CHAIN, SAME, 0.0)
    for mine, plain in zip(got, numpy_mix(x, P, mu, prior, 2, CHAIN, SAME)):
        assert_allclose(mine, plain, rtol=1e-12, atol=1e-15)
    assert_allclose(got[2].sum(axis=1), 1.0)
    assert np.all(got[1] == np.swapaxes(got[1], -1, -2))


def test_what_begins_to_move_leaves_the_velocity_of_what_moves_alone():
    slices = BehaviourSlices(ObstacleConfig(components=1))
    chain, prior = slices._transition(0.5), slices._motion(0.5).prior
    assert_allclose(chain.sum(axis=1), 1.0)
    fixed, _, _, moves, begun = range(5)
    assert chain[fixed, moves] == chain[moves, begun] == 0.0 < chain[fixed, begun]
    assert chain[begun, moves] == pytest.approx(-np.expm1(-0.1), rel=1e-3)
    rng = np.random.default_rng(3)
    before, _ = poses(rng)
    x, P, mu = behaving(rng, before, slices=1, T=1)
    x[:, moves, 8:], P[:, moves, 8:] = 0.1, 0.0
    P[:, moves, :, 8:] = 0.0
    P[:, moves, 8, 8] = P[:, moves, 9, 9] = 0.03**2
    x[:, begun, 8:], P[:, begun] = 0.1, P[:, moves]
    mu[:] = [0.97, 0.0, 0.0, 0.01, 0.01, 0.01]
    x1, P1 = x, P
    for _ in range(100):
        x1, P1, _ = mixtures.mix(x1, P1, mu, prior, 1, chain, slices._same, 0.0)
        # What settles has the velocity that it had as what has just begun, unlike what begins.
        x1[:, begun, 8:], P1[:, begun] = 0.1, P[:, moves]
    assert_allclose(x1[0, moves, 8:], 0.1, rtol=1e-9)
    assert_allclose(np.diagonal(P1[0, moves])[8:], 0.03**2, rtol=1e-9)
    x1, P1, _ = mixtures.mix(x, P, mu, prior, 1, chain, slices._same, 0.0)
    share = mu[0, fixed] * chain[fixed, begun]
    share /= share + mu[0, begun] * chain[begun, begun]
    assert_allclose(x1[0, begun, 8:], (1.0 - share) * x[0, begun, 8:])


def test_mixing_leaves_depth_slices_alone_and_drops_the_improbable():
    rng = np.random.default_rng(2)
    before, _ = poses(rng)
    x, P, mu = behaving(rng, before)
    mu[:, 5:10] *= 1e-9
    mu /= mu.sum(axis=1, keepdims=True)
    x1, P1, mu1 = mixtures.mix(x, P, mu, motion().prior, 2, CHAIN, SAME, 1e-6)
    assert np.all(mu1[:, 5:10] == 0.0)
    assert_allclose(mu1[:, :5].sum(axis=1) / mu1[:, 10], mu[:, :5].sum(axis=1) / mu[:, 10])
    assert np.all(x1[:, 10] == x[:, 10]) and np.all(P1[:, 10] == P[:, 10])


@pytest.mark.parametrize('kind', ['swaying', 'moving'])
def test_covariance_of_a_step_equals_sampling(kind):
    """The cross covariance of position and e, and the sign of ``step``, show here only."""
    rng = np.random.default_rng(5)
    filter_ = BehaviourSlices(
        ObstacleConfig(
            components=1, behaviours=(kind,), navigation_noise=(0.0, 0.0, 0.0),
            speed_noise=0.3, scale_std=0.0,
        )
    )  # fmt: skip
    sonar = Sonar(Pose(np.array([0.0, 0.0, 20.0]), np.eye(3)))
    dt, draws = 5.0, 400_000
    how = filter_._motion(dt)
    # An obstacle whose place is known, level with the sonar.
    x, P = np.zeros((1, 1, 10)), np.zeros((1, 1, 10, 10))
    x[0, 0, :3] = 50.0, 0.2, 20.0
    P[0, 0, 8:, 8:] = how.prior[0] * np.eye(2)
    step = unscented.Step(*sonar.pose, *sonar.pose, np.zeros(3), False)
    x1, P1, _ = unscented.advance(x, P, np.ones((1, 1)), how, step)
    e = rng.normal(0.0, np.sqrt(how.prior[0]), (draws, 2))
    place = 50.0 * np.array([np.cos(0.2), np.sin(0.2)])
    if kind == 'swaying':
        phi = np.exp(-dt / 20.0)
        after = phi * e + rng.normal(0.0, 0.5 * np.sqrt(1.0 - phi**2), (draws, 2))
        place = place + after - e
    else:  # velocity is a random walk in small steps, place its integral over the whole step
        w = rng.normal(0.0, 0.3 * np.sqrt(dt), (draws, 2))
        place, after = place + dt * e + 0.5 * dt * w, e + w
    sample = np.column_stack([np.hypot(*place.T), np.arctan2(place[:, 1], place[:, 0]), after])
    pick = [0, 1, 8, 9]
    got = P1[0, 0][np.ix_(pick, pick)]
    scale = np.sqrt(np.outer(np.diag(got), np.diag(got)))
    assert_allclose(got / scale, np.cov(sample.T) / scale, atol=0.04)


def test_dropped_components_stay_finite():
    rng = np.random.default_rng(6)
    before, after = poses(rng)
    x, P, mu = behaving(rng, before)
    mu[:, 0], x[:, 0] = 0.0, np.nan
    step = unscented.Step(*before, *after, np.zeros(3), False)
    x1, P1, _ = unscented.advance(x, P, mu, motion(), step)
    assert np.isfinite(x1).all() and np.isfinite(P1).all()
