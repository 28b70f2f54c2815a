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

"""Errors of the navigation: their motion, what obstacles tell each other of them, two
assumptions."""

from pathlib import Path

import numpy as np
from numpy.testing import assert_allclose
import pytest

from sonar_imm.trackers.obstacle import navigation_errors, unscented
from sonar_imm.trackers.obstacle.config import ObstacleConfig
from sonar_imm.trackers.obstacle.filters import Mixture
from sonar_imm.trackers.obstacle.navigation_errors import NavigationErrors
from sonar_imm.trackers.obstacle.unscented import Motion, NAV, Step

VECTORS = Path(__file__).resolve().parents[2] / 'vectors/obstacle_in_clutter'
ORDER = [0, 1, 2, 5, 6, 7, 8, 9, 3, 4]
"""Of our states in those of the vectors, (d, delta, z, e_N, e_E, s, psi, b_N, b_E, tau)."""


def vectors(name):
    return dict(np.load(VECTORS / f'{name}.npz'))


# -- motion ---------------------------------------------------------------------------------------


def moved(data, i, x, P):
    """Case i of `motion.npz` from the states x (n, 10), P (n, 10, 10)."""
    behaviour, dt = int(data['behaviour'][i]), float(data['dt'][i])
    phi = np.exp(-dt / float(data['sway_time']))
    keep, step = [(0.0, 0.0), (phi, phi - 1.0), (1.0, dt)][behaviour]
    n = len(x)
    prior = np.full(n, float(behaviour > 0))
    motion = Motion(np.full(n, keep), np.full(n, step), np.zeros(n), np.zeros(n), prior)
    names = ('v0', 'w0', 'v1', 'w1')
    places = [data[name][i] for name in ('p0', 'R0', 'p1', 'R1')]
    rates = [data[name][i] for name in names]
    step = Step(*places, np.zeros(3), False, *rates, np.zeros(5), dt)
    return unscented.advance(x[None], P[None], np.ones((1, n)), motion, step)[:2]


def test_motion_equals_the_vectors():
    data = vectors('motion')
    for i, (x, y) in enumerate(zip(data['x'][:, ORDER], data['y'][:, ORDER])):
        got = moved(data, i, x[None], np.zeros((1, 10, 10)))[0][0, 0]
        states = 8 if data['behaviour'][i] == 0 else 10
        assert_allclose(got[:states], y[:states], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize('i', [0, 7, 21, 40])
def test_the_covariance_of_a_step_is_that_of_its_derivatives(i):
    """Where all is nearly straight; derivatives of the step of the means, which the vectors
    check."""
    data = vectors('motion')
    x, small = data['x'][i, ORDER], 1e-5
    rng = np.random.default_rng(i)
    scale = np.array([0.05, 1e-3, 0.05, 1e-3, 3e-3, 0.01, 0.01, 0.05, 0.05, 0.05])
    A = rng.normal(size=(10, 10)) * scale[:, None]
    P = A @ A.T
    if data['behaviour'][i] == 0:
        P[8:] = P[:, 8:] = 0.0
    ends = np.concatenate([x + small * np.eye(10), x - small * np.eye(10)])
    ahead, behind = np.split(moved(data, i, ends, np.zeros((20, 10, 10)))[0][0], 2)
    F = ((ahead - behind) / (2.0 * small)).T
    got = moved(data, i, x[None], P[None])[1][0, 0]
    exact = F @ P @ F.T
    width = np.sqrt(np.maximum(np.diag(exact), 1e-300))
    if data['behaviour'][i] == 0:
        got, exact, width = got[:8, :8], exact[:8, :8], width[:8]
    assert_allclose(got / np.outer(width, width), exact / np.outer(width, width), atol=0.02)


# -- messages -------------------------------------------------------------------------------------


def linear_tracks(data):
    """The three obstacles of the vectors, their private two states in place of range and azimuth;
    alone before and after their own measurement."""
    before, after = (Mixture(np.zeros((3, 1, 10)), np.zeros((3, 1, 10, 10)), np.ones((3, 1)))
                     for _ in range(2))  # fmt: skip
    states = np.array([0, 1, 3, 4, 5, 6, 7])
    for t in range(3):
        m = np.concatenate([np.zeros(2), data['common_mean']])
        C = np.zeros((7, 7))
        C[:2, :2], C[2:, 2:] = data['private_covariance'][t], data['common_covariance']
        R = data['R'][t] if data['R'].ndim == 3 else data['R']
        H = data['H'][t]
        gain = C @ H.T @ np.linalg.inv(H @ C @ H.T + R)
        for mixture, mean, cov in (
            (before, m, C),
            (after, m + gain @ (data['y'][t] - H @ m), C - gain @ H @ C),
        ):
            mixture.x[t, 0, states] = mean
            mixture.P[t, 0, states[:, None], states] = cov
    return before, after, states


def test_messages_and_what_they_tell_equal_the_joint_gaussian():
    data = vectors('messages')
    before, after, states = linear_tracks(data)
    marginals = navigation_errors.marginals
    L, eta = navigation_errors.messages(marginals(before), marginals(after), np.ones(3))
    assert_allclose(L, data['message_information'], rtol=1e-8, atol=1e-8)
    assert_allclose(eta, data['message_vector'], rtol=1e-8, atol=1e-8)
    got = navigation_errors.told(after, L.sum(axis=0) - L, eta.sum(axis=0) - eta)
    assert_allclose(got.x[:, 0][:, states], data['together_mean'], rtol=1e-9, atol=1e-9)
    block = got.P[:, 0][:, states[:, None], states]
    assert_allclose(block, data['together_cov'], rtol=1e-9, atol=1e-10)
    common = NavigationErrors(data['common_mean'], data['common_covariance']).told(L, eta)
    assert_allclose(common.mean, data['together_mean'][0, 2:], rtol=1e-9, atol=1e-9)
    assert_allclose(common.covariance, data['together_cov'][0, 2:, 2:], rtol=1e-8, atol=1e-10)


def test_weights_of_components_that_are_told_are_their_evidence():
    """Against the density of what is told, as a measurement of the five."""
    rng = np.random.default_rng(4)
    x = rng.normal(size=(1, 3, 10)) * 0.3
    A = rng.normal(size=(1, 3, 10, 10)) * 0.2
    P = A @ np.swapaxes(A, -1, -2)
    mu = np.array([[0.2, 0.5, 0.3]])
    B = rng.normal(size=(5, 5))
    R, z = B @ B.T + np.eye(5), rng.normal(size=5)
    L = np.linalg.inv(R)
    got = navigation_errors.told(Mixture(x, P, mu), L[None], (L @ z)[None])
    weight = np.empty(3)
    for k in range(3):
        S = P[0, k][NAV, NAV] + R
        v = z - x[0, k, NAV]
        gain = P[0, k][:, NAV] @ np.linalg.inv(S)
        assert_allclose(got.x[0, k], x[0, k] + gain @ v, rtol=1e-9, atol=1e-12)
        exact = P[0, k] - gain @ P[0, k][NAV]
        assert_allclose(got.P[0, k], exact, rtol=1e-8, atol=1e-12)
        weight[k] = mu[0, k] * np.exp(-0.5 * v @ np.linalg.solve(S, v)) / np.sqrt(np.linalg.det(S))
    assert_allclose(got.mu[0], weight / weight.sum(), rtol=1e-9)


def test_an_error_that_is_switched_off_is_told_by_nobody():
    data = vectors('messages')
    before, after, _ = linear_tracks(data)
    for mixture in (before, after):
        mixture.P[..., 7, :] = mixture.P[..., 7] = 0.0
    marginals = navigation_errors.marginals
    L, eta = navigation_errors.messages(marginals(before), marginals(after), np.ones(3))
    assert not L[:, 4].any() and not L[..., 4].any() and not eta[:, 4].any()
    assert L[:, :4, :4].any(axis=(1, 2)).all()


# -- two assumptions ------------------------------------------------------------------------------


@pytest.mark.parametrize('case', [0, 1, 2])
def test_both_assumptions_equal_the_vectors(case):
    data = vectors('ins_good')
    std, walk = data['stdB'], data['walkB']
    own = {name.split('/')[1]: value for name, value in data.items() if f'{case}/' in name}
    config = ObstacleConfig(
        scale_std=std[0], yaw_error_std_deg=np.degrees(std[1]), drift_std=std[2],
        navigation_delay_std=std[4], navigation_good_probability=float(data['priorA']),
    )  # fmt: skip
    assert_allclose(config.navigation_errors()[1], walk, rtol=1e-9)
    assert_allclose(navigation_errors.GOOD, data['stdA'], rtol=1e-9)
    order = np.array(ORDER)
    x = own['x'][..., order]
    P = own['P'][..., order[:, None], order]
    mixture, good = navigation_errors.under_two_assumptions(
        Mixture(x, P, own['w']), np.ones(1, np.bool_), float(own['t']), config
    )
    assert_allclose(good, own['pA'], rtol=1e-9)
    mean, covariance = unscented_moments(mixture)
    assert_allclose(mean, own['m'][0][order] if own['m'].ndim > 1 else own['m'][order], rtol=1e-8)
    assert_allclose(np.diag(covariance), np.diag(np.squeeze(own['var']))[order], rtol=1e-7)


def unscented_moments(mixture):
    x, P, mu = (part[0] for part in mixture)
    mean = mu @ x
    off = x - mean
    return mean, np.einsum('k,kab->ab', mu, P + off[:, :, None] * off[:, None])
