# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Mixing and prediction of obstacles that move, against plain numpy and sampling."""

import numpy as np
from numpy.testing import assert_allclose
import pytest

from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.trackers.obstacle import mixtures
from sonar_imm.trackers.obstacle import unscented as behave
from sonar_imm.trackers.obstacle.config import ObstacleConfig
from sonar_imm.trackers.obstacle.filters import BehaviourSlices, Sonar

"""The states of the obstacle itself."""


def poses(rng):
    angles = rng.normal(0.0, 0.1, 3)
    before = Pose(rng.normal(0.0, 20.0, 3), geometry.rotation(*angles))
    turned = angles + rng.normal(0.0, 0.03, 3)
    after = Pose(before.position + rng.normal(0.0, 1.0, 3), geometry.rotation(*turned))
    return before, after


def targets(rng, before, slices=2, T=2, errors=0.0):
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
    x, P, mu = targets(rng, before, errors=1.0)
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
    x, P, mu = targets(rng, before, slices=1, T=1)
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
    x, P, mu = targets(rng, before)
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
    step = behave.Step(*sonar.pose, *sonar.pose, np.zeros(3), False)
    x1, P1, _ = behave.advance(x, P, np.ones((1, 1)), how, step)
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
    x, P, mu = targets(rng, before)
    mu[:, 0], x[:, 0] = 0.0, np.nan
    step = behave.Step(*before, *after, np.zeros(3), False)
    x1, P1, _ = behave.advance(x, P, mu, motion(), step)
    assert np.isfinite(x1).all() and np.isfinite(P1).all()
