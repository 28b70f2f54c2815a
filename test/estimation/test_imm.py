# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The IMM filter, readable and as a bank: independent reference, closed forms, invariances."""

import json

from helpers.vector_files import load_vectors
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from sonar_imm.estimation import bank as banks
from sonar_imm.estimation import imm, kalman
from sonar_imm.estimation.adaptation import AdaptiveChain
from sonar_imm.estimation.motion import Joint, Model, Motion

CASES = [
    'A1_cv_cv', 'A2_cv_ct', 'A4_world16', 'A10_speedstate16', 'A12_speedstate16_hover',
    'A13_ref_only_missed', 'A14_ref_only_EM_N0_1',
]  # fmt: skip
EYE2 = np.eye(2)


class Bank:
    """The verbs of `bank` with the signatures of `imm`, for position fixes of one block, where the
    first two states are measured, and there are three or more."""

    @staticmethod
    def block(x, P):
        return banks.Gaussians(np.moveaxis(x, 1, -1), np.moveaxis(P, 1, -1))

    @staticmethod
    def arrays(block):
        return np.moveaxis(block.x, -1, 1), np.moveaxis(block.P, -1, 1)

    def mix(self, x, P, mu, transition):
        plain = banks.Bank(np.zeros((2, x.shape[1])))
        (block,), c = banks.mix(plain, [self.block(x, P)], mu, transition)
        return imm.Mixed(*self.arrays(block), c)

    def predict(self, x, P, F, Q, B):
        moves = banks.Moves(*(np.moveaxis(part, 0, -1) for part in (F, Q, B)))
        moved = self.arrays(banks.predict(self.block(x, P), moves))
        return imm.Predicted(*moved, np.zeros(x.shape[:2], bool))

    def update(self, x, P, c, innovation, H, R):
        T, rows = len(x), np.arange(len(x))
        np.testing.assert_array_equal(H, np.broadcast_to(np.eye(*H.shape[2:]), H.shape))
        z = innovation[:, 0] + x[:, 0, :2]
        pairs = banks.weigh(self.block(x, P), rows, z, np.broadcast_to(R, (T, 2, 2)))
        with np.errstate(divide='ignore'):
            log = np.log(c) + pairs.log
        best = log.max(axis=1, keepdims=True)
        total = best + np.log(np.exp(log - best).sum(axis=1, keepdims=True))
        ratio = np.exp(pairs.log - total)
        block, weight = banks.update(self.block(x, P), pairs, rows, ratio, np.zeros(T))
        nis, ok = np.full(T, np.nan), np.ones(T, bool)
        return imm.Updated(*self.arrays(block), c * weight, total[:, 0], nis, ok, None)

    def combine(self, x, P, mu, E):
        return banks.combine([self.block(x, P)], mu, [np.moveaxis(E, 0, -1)])


class FixedChain:
    """A chain whose matrix is the same at every step: what the reference cases assume."""

    step = 1.0

    def __init__(self, matrix):
        self.matrix = matrix

    def transition(self, dt):
        return self.matrix


def cycle(x, P, mu, transition, F, Q, B, z, H, R):
    """Mix, predict, update; z (m,) for one target, or None when missed."""
    x, P, c = imm.mix(x, P, mu, transition)
    x, P, _ = imm.predict(x, P, F, Q, B)
    if z is None:
        return x, P, c, 0.0, np.nan
    innovation = np.ascontiguousarray(z - np.einsum('jmn,tjn->tjm', H, x))
    x, P, mu, log_likelihood, nis, ok, _ = imm.update(x, P, c, innovation, H[None], R[None])
    assert ok.all()
    return x, P, mu, log_likelihood[0], nis[0]


def run_case(known):
    """Outputs of a reference case, stacked over time: x, P, mu, xj, Pj, Pi."""
    F, B, Q, E, P0, Z, R = (known[key] for key in ('F', 'B', 'Q', 'E', 'Pi', 'Z', 'R'))
    options = json.loads(str(known['opts']))
    valid = known.get('valid', np.ones(len(Z), bool))
    learns = {'em': True, None: False}[options.get('form')]
    # The reference starts its counts at N0 P0 and adds N0 P0 again: worth two N0 in all.
    chain = AdaptiveChain(FixedChain(P0), weight=2.0 * options.get('N0', 1.0), learns=learns)
    x, P, mu = (known[key][None].copy() for key in ('x0', 'P0', 'mu0'))
    learnt, H = chain.initial_counts(1), np.ascontiguousarray(E[:, :2])
    rows = []
    for k in range(len(Z)):
        transition, before = chain.transition(learnt, 1.0), mu
        x, P, mu, *_ = cycle(x, P, mu, transition, F, Q, B, Z[k] if valid[k] else None, H, R[k])
        if valid[k]:
            learnt = chain.learn(learnt, transition, before, mu, 1.0)
        mean, covariance = imm.combine(x, P, mu, E)
        rows.append((mean[0], covariance[0], mu[0], x[0], P[0], chain.transition(learnt, 1.0)[0]))
    return [np.stack(column) for column in zip(*rows)]


@pytest.mark.parametrize('case', CASES)
def test_matches_the_independent_reference(case):
    arrays = load_vectors('diver/imm_reference').items()
    known = {key.split('/')[1]: value for key, value in arrays if key.split('/')[0] == case}
    for key, value in zip(('x', 'P', 'mu', 'xj', 'Pj', 'Pi'), run_case(known)):
        np.testing.assert_allclose(value, known[f'out_{key}'], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize('scene', range(5))
def test_equals_full_enumeration_at_the_first_step_and_the_imm_after(scene):
    known, prefix = load_vectors('diver/exact_mode_tree'), f'cvct/{scene}/'
    F, B, Q, Pi, mu = (known[f'cvct/{key}'] for key in ('F', 'B', 'Q', 'Pi', 'mu0'))
    data = {name.split('/')[2]: known[name] for name in known if name.startswith(prefix)}
    state = data['x0'][None], data['P0'][None], mu[None]
    E = np.tile(np.eye(4), (3, 1, 1))
    H, total = np.ascontiguousarray(E[:, :2]), 0.0
    for k in range(7):
        seen = data['Z'][k], H, data['R'][k]
        *state, log_likelihood, _ = cycle(*state, Pi[None], F, Q, B, *seen)
        mean, covariance = imm.combine(*state, E)
        total += log_likelihood
        if k == 0:
            np.testing.assert_allclose(mean[0], data['exact_x'][0], atol=1e-10)
            np.testing.assert_allclose(covariance[0], data['exact_P'][0], atol=1e-10)
            np.testing.assert_allclose(state[2][0], data['exact_mu'][0], atol=1e-12)
            np.testing.assert_allclose(total, data['exact_loglik'][0], atol=1e-10)
        np.testing.assert_allclose(mean[0], data['imm_x'][k], atol=1e-9)
        np.testing.assert_allclose(covariance[0], data['imm_P'][k], atol=1e-9)
        np.testing.assert_allclose(state[2][0], data['imm_mu'][k], atol=1e-9)


def random_bank(rng, T=3, M=4, n=3, m=2):
    """Random but sane arrays of a bank of models."""

    def spd(*shape):
        A = rng.normal(size=(*shape, shape[-1]))
        return A @ np.swapaxes(A, -1, -2) + 0.1 * np.eye(shape[-1])

    return {
        'x': rng.normal(size=(T, M, n)) * 3.0,
        'P': spd(T, M, n),
        'mu': rng.dirichlet(np.ones(M), T),
        'transition': rng.dirichlet(np.ones(M), (T, M)),
        'F': rng.normal(size=(M, n, n)),
        'Q': spd(M, n),
        'B': rng.normal(size=(M, n)),
        'H': rng.normal(size=(1, M, m, n)),
        'R': spd(T, m),
        'innovation': rng.normal(size=(T, M, m)) * 2.0,
        'E': rng.normal(size=(M, 4, n)),
    }


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(1, 6), st.integers(3, 5))
def test_the_bank_is_the_readable_form(seed, T, M, n):
    bank = random_bank(np.random.default_rng(seed), T, M, n)
    bank['mu'][0] = np.eye(M)[seed % M]  # dead models too
    bank['transition'][:, :, 0] = 0.0
    bank['transition'][:, :, -1] = 1.0 - bank['transition'][:, :, :-1].sum(axis=2)
    z, H, results = bank['innovation'][:, :1], np.eye(2, n)[None, None], []
    for engine in (imm, Bank()):
        x, P, c = engine.mix(bank['x'], bank['P'], bank['mu'], bank['transition'])
        x, P, _ = engine.predict(x, P, bank['F'], bank['Q'], bank['B'])
        updated = engine.update(x, P, c, z - x[..., :2], np.tile(H, (1, M, 1, 1)), bank['R'])
        results.append((x, P, c, *updated[:4], *engine.combine(*updated[:3], bank['E'])))
    for ours, theirs in zip(*results):
        np.testing.assert_allclose(ours, theirs, rtol=1e-8, atol=1e-9)


def test_one_model_is_the_kalman_filter():
    rng = np.random.default_rng(5)
    bank = random_bank(rng, T=1, M=1)
    x, P, F, Q, B = bank['x'][0, 0], bank['P'][0, 0], bank['F'], bank['Q'], bank['B']
    H, R, alone = bank['H'][0], bank['R'][0], np.ones((1, 1, 1))
    state = bank['x'], bank['P'], np.ones((1, 1))
    for z in rng.normal(size=(20, 2)):
        *state, log_likelihood, nis = cycle(*state, alone, F, Q, B, z, H, R)
        x, P, _ = kalman.predict(x, P, F[0], Q[0], B[0])
        expected = kalman.update(x, P, z - H[0] @ x, H[0], R)
        x, P = expected.x, expected.P
        found = [*state[0][0, 0], *state[1][0, 0].ravel(), log_likelihood, nis]
        due = [*x, *P.ravel(), expected.log_likelihood, expected.nis]
        np.testing.assert_allclose(found, due, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize('far', [1e2, 1e4, 1e8])
def test_an_outlier_favours_the_wider_model(far):
    """Both likelihoods underflow; their logarithms do not."""
    x, P = np.zeros((1, 2, 1)), np.array([[[[1.0]], [[4.0]]]])
    c, one = np.full((1, 2), 0.5), np.ones((1, 2, 1, 1))
    _, _, mu, _, _, ok, _ = imm.update(x, P, c, np.full((1, 2, 1), far), one, one[:, 0])
    assert ok[0] and mu[0, 1] > 0.999


def test_a_model_nothing_can_become_stays_finite_and_comes_back():
    bank = random_bank(np.random.default_rng(10), T=1, M=2)
    absorbing = np.array([[[1.0, 0.0], [1.0, 0.0]]])
    x, P, c = imm.mix(bank['x'], bank['P'], bank['mu'], absorbing)
    assert c[0, 1] == 0.0 and np.isfinite(x).all() and np.isfinite(P).all()
    x, P, mu, *_ = imm.update(x, P, c, np.zeros((1, 2, 2)), bank['H'], bank['R'])
    np.testing.assert_array_equal(mu[0], [1.0, 0.0])
    _, _, c = imm.mix(x, P, mu, np.array([[[0.7, 0.3], [0.4, 0.6]]]))
    np.testing.assert_allclose(c[0], [0.7, 0.3])


def test_a_measurement_that_no_model_can_use_changes_nothing():
    bank = random_bank(np.random.default_rng(11), T=2)
    bank['R'][1] = np.nan
    x, P, c = imm.mix(bank['x'], bank['P'], bank['mu'], bank['transition'][:2])
    with np.errstate(invalid='ignore'):
        out = imm.update(x, P, c, bank['innovation'], bank['H'], bank['R'])
    assert out[5].tolist() == [True, False]
    np.testing.assert_array_equal(out[0][1], x[1])
    np.testing.assert_array_equal(out[2][1], c[1])


def test_unequal_members_by_embedding_equal_a_filter_that_carries_both_sizes():
    """A walker beside a cruiser, written out by hand: it lends the prior velocity when mixed."""
    dt, fill = 1.0, 0.25
    F = np.array([[1.0, dt], [0.0, 1.0]])
    Q = np.array([[0.1, 0.02], [0.02, 0.05]])
    joint = Joint(
        [
            Model('cruiser', ('p', 'v'), lambda x, dt: Motion(F, Q, np.zeros(2))),
            Model('walker', ('p',), lambda x, dt: Motion([[1.0]], [[0.4]], [0.0])),
        ]
    )
    bank = joint.motion(np.zeros((2, 2)), dt, 0.5, fill)
    transition = np.array([[0.8, 0.2], [0.3, 0.7]])
    H, R = np.array([[[1.0, 0.0]], [[1.0, 0.0]]]), np.array([[0.3]])
    state = (
        np.array([[[0.0, 1.0], [0.2, 0.5]]]),
        np.array([[np.eye(2), np.diag([2.0, fill])]]),
        np.array([[0.6, 0.4]]),
    )
    cruiser_x, cruiser_P = state[0][0, 0], state[1][0, 0]
    walker_x, walker_P, mu = 0.2, 2.0, np.array([0.6, 0.4])
    for z in (0.7, 1.9, 2.4, 2.2):
        *state, _, _ = cycle(*state, transition[None], *bank, np.array([z]), H, R)
        c = mu @ transition
        W = transition * mu[:, None] / c
        means = np.array([cruiser_x, [walker_x, 0.5]])
        covariances = np.array([cruiser_P, np.diag([walker_P, fill])])
        mixed = W[:, 0] @ means
        off = means - mixed
        mixed_P = np.tensordot(W[:, 0], covariances + off[:, :, None] * off[:, None], 1)
        small = W[:, 1] @ means[:, 0]
        small_P = W[:, 1] @ (covariances[:, 0, 0] + (means[:, 0] - small) ** 2) + 0.4
        cruiser_x, cruiser_P = F @ mixed, F @ mixed_P @ F.T + Q
        S, at = np.array([cruiser_P[0, 0], small_P]) + 0.3, np.array([cruiser_x[0], small])
        weight = c * np.exp(-0.5 * (z - at) ** 2 / S) / np.sqrt(S)
        mu, gain = weight / weight.sum(), cruiser_P[:, 0] / S[0]
        cruiser_x = cruiser_x + gain * (z - cruiser_x[0])
        cruiser_P = cruiser_P - np.outer(gain, gain) * S[0]
        walker_x, walker_P = small + small_P / S[1] * (z - small), small_P - small_P**2 / S[1]
        np.testing.assert_allclose(state[2][0], mu, atol=1e-12)
        np.testing.assert_allclose(state[0][0, 0], cruiser_x, atol=1e-12)
        np.testing.assert_allclose(state[1][0, 0], cruiser_P, atol=1e-12)
        np.testing.assert_allclose(state[0][0, 1], [walker_x, 0.5], atol=1e-12)
        np.testing.assert_allclose(state[1][0, 1], np.diag([walker_P, fill]), atol=1e-12)


def test_a_component_that_is_named_twice_is_refused():
    with pytest.raises(ValueError, match="model 'm' names a component twice"):
        Joint([Model('m', ('px', 'px'), lambda x, dt: None)])


def test_the_gate_is_that_of_single_pairs_and_a_sharp_turn_is_inside():
    rng = np.random.default_rng(12)
    bank = random_bank(rng, T=5, M=4)
    z = rng.normal(size=(40, 2)) * 4.0
    R = np.tile(0.3 * EYE2, (40, 1, 1))
    h = np.einsum('jmn,tjn->tjm', bank['H'][0], bank['x'])
    fit = imm.gate(h, bank['H'], bank['P'], bank['mu'], z, R, 3.0)
    for t, d in np.ndindex(fit.shape):
        S = [H @ P @ H.T + R[d] for H, P in zip(bank['H'][0], bank['P'][t])]
        laws = [multivariate_normal(mean, each) for mean, each in zip(h[t], S)]
        gaps = [(z[d] - mean) @ np.linalg.solve(each, z[d] - mean) for mean, each in zip(h[t], S)]
        density = sum(mu * law.pdf(z[d]) for mu, law in zip(bank['mu'][t], laws))
        due = np.log(density) if min(gaps) <= 3.0 else -np.inf
        np.testing.assert_allclose(fit[t, d], due, rtol=1e-9)
    assert 0 < np.isfinite(fit).sum() < fit.size
    # Two models 10 m apart, the improbable one right: it opens its own gate, and no other.
    x = np.array([[[0.0, 0.0], [0.0, 10.0]]])
    P, c = np.tile(0.01 * EYE2, (1, 2, 1, 1)), np.array([[0.99, 0.01]])
    H = np.tile(EYE2, (1, 2, 1, 1))
    places = np.array([[0.0, 10.0], [0.0, 5.0]])
    fit = imm.gate(x, H, P, c, places, np.tile(0.01 * EYE2, (2, 1, 1)), 9.0)
    np.testing.assert_array_equal(np.isfinite(fit), [[True, False]])
    np.testing.assert_allclose(fit[0, 0], np.log(0.01 / (2.0 * np.pi * 0.02)))


@pytest.mark.parametrize('targets, detections', [(0, 3), (2, 0)])
def test_a_gate_without_targets_or_detections_takes_no_memory(targets, detections):
    """What it needs else is the size of a measurement squared, here 80 GB for each model."""
    m = 100_000
    known = np.zeros((targets, 2, m)), np.zeros((1, 2, m, 1)), np.ones((targets, 2, 1, 1))
    seen = np.zeros((detections, m)), np.zeros((detections, 1, 1))
    fit = imm.gate(*known, np.full((targets, 2), 0.5), *seen, 9.0)
    assert fit.shape == (targets, detections)
