# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The IMM filter, readable, as a bank and ready to use: independent reference, FilterPy and Stone
Soup, closed forms, invariances."""

from datetime import datetime
import json
from typing import NamedTuple

from filterpy.kalman import IMMEstimator, KalmanFilter
from helpers.vector_files import load_vectors
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.stats import multivariate_normal
from stonesoup.models.measurement.nonlinear import CartesianToBearingRange
from stonesoup.types.detection import Detection
from stonesoup.types.hypothesis import SingleHypothesis
from stonesoup.types.prediction import GaussianStatePrediction
from stonesoup.updater.kalman import ExtendedKalmanUpdater

from sonar_imm import ca, ct, cv, hover, IMM, MeasurementModel, position, range_bearing
from sonar_imm.estimation import bank as banks
from sonar_imm.estimation import imm, kalman
from sonar_imm.estimation.adaptation import AdaptiveChain
from sonar_imm.estimation.markov import RateChain
from sonar_imm.estimation.motion import Joint, Model, Motion, turning, white_acceleration

CASES = 'A2_cv_ct A12_speedstate16_hover A13_ref_only_missed A14_ref_only_EM_N0_1'
T = np.array([[0.95, 0.05], [0.2, 0.8]])  # asymmetric: a transposed matrix would show
START = {'mean': [50.0, 10.0, 0.5, 1.0], 'covariance': np.diag([9.0, 9.0, 1.0, 1.0])}
MODELS = [cv(noise=0.05), ct(noise=0.2, turn_rate=0.15)]


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


class FixedChain(NamedTuple):
    """A chain whose matrix is the same at every step: what the reference cases assume."""

    matrix: np.ndarray
    step: float = 1.0

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


@pytest.mark.parametrize('case', CASES.split())
def test_matches_the_independent_reference(case):
    arrays = load_vectors('diver/imm_reference').items()
    known = {key.split('/')[1]: value for key, value in arrays if key.split('/')[0] == case}
    for key, value in zip(('x', 'P', 'mu', 'xj', 'Pj', 'Pi'), run_case(known)):
        np.testing.assert_allclose(value, known[f'out_{key}'], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize('scene', range(3))
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
        'x': rng.normal(size=(T, M, n)) * 3.0, 'P': spd(T, M, n), 'R': spd(T, m),
        'mu': rng.dirichlet(np.ones(M), T), 'innovation': rng.normal(size=(T, M, m)) * 2.0,
        'transition': rng.dirichlet(np.ones(M), (T, M)), 'F': rng.normal(size=(M, n, n)),
        'Q': spd(M, n), 'B': rng.normal(size=(M, n)), 'H': rng.normal(size=(1, M, m, n)),
        'E': rng.normal(size=(M, 4, n)),
    }  # fmt: skip


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
    # An outlier favours the wider model: both likelihoods underflow, their logarithms do not.
    x, P = np.zeros((1, 2, 1)), np.array([[[[1.0]], [[4.0]]]])
    c, one = np.full((1, 2), 0.5), np.ones((1, 2, 1, 1))
    for far in (1e2, 1e8):
        _, _, mu, _, _, ok, _ = imm.update(x, P, c, np.full((1, 2, 1), far), one, one[:, 0])
        assert ok[0] and mu[0, 1] > 0.999


def test_unequal_members_by_embedding_equal_a_filter_that_carries_both_sizes():
    """A walker beside a cruiser, written out by hand: it lends the prior velocity when mixed."""
    dt, fill = 1.0, 0.25
    F = np.array([[1.0, dt], [0.0, 1.0]])
    Q = np.array([[0.1, 0.02], [0.02, 0.05]])
    cruiser = Model('cruiser', ('p', 'v'), lambda x, dt: Motion(F, Q, np.zeros(2)))
    walker = Model('walker', ('p',), lambda x, dt: Motion([[1.0]], [[0.4]], [0.0]))
    bank = Joint([cruiser, walker]).motion(np.zeros((2, 2)), dt, 0.5, fill)
    transition = np.array([[0.8, 0.2], [0.3, 0.7]])
    H, R, mu = np.array([[[1.0, 0.0]], [[1.0, 0.0]]]), np.array([[0.3]]), np.array([0.6, 0.4])
    x, P = np.array([[0.0, 1.0], [0.2, 0.5]]), np.array([np.eye(2), np.diag([2.0, fill])])
    state, (cruiser_x, _), (cruiser_P, _) = (x[None], P[None], mu[None]), x, P
    walker_x, walker_P = 0.2, 2.0
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
        np.testing.assert_allclose(state[0][0], [cruiser_x, [walker_x, 0.5]], atol=1e-12)
        due = [cruiser_P, np.diag([walker_P, fill])]
        np.testing.assert_allclose(state[1][0], due, atol=1e-12)
    with pytest.raises(ValueError, match="model 'm' names a component twice"):
        Joint([Model('m', ('px', 'px'), lambda x, dt: None)])


def test_the_gate_is_that_of_single_pairs_and_a_sharp_turn_is_inside():
    rng = np.random.default_rng(12)
    bank = random_bank(rng, T=5, M=4)
    z = rng.normal(size=(40, 2)) * 4.0
    R = np.tile(0.3 * np.eye(2), (40, 1, 1))
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
    x, H = np.array([[[0.0, 0.0], [0.0, 10.0]]]), np.tile(np.eye(2), (1, 2, 1, 1))
    places = np.array([[0.0, 10.0], [0.0, 5.0]])
    fit = imm.gate(x, H, 0.01 * H, np.array([[0.99, 0.01]]), places, 0.01 * H[0], 9.0)
    np.testing.assert_array_equal(np.isfinite(fit), [[True, False]])
    np.testing.assert_allclose(fit[0, 0], np.log(0.01 / (2.0 * np.pi * 0.02)))
    # Without targets or detections it takes no memory: else that of a measurement squared, here
    # 80 GB for each model.
    m = 100_000
    for T, D in ((0, 3), (2, 0)):
        known = np.zeros((T, 2, m)), np.zeros((1, 2, m, 1)), np.ones((T, 2, 1, 1))
        seen = np.zeros((D, m)), np.zeros((D, 1, 1))
        assert imm.gate(*known, np.full((T, 2), 0.5), *seen, 9.0).shape == (T, D)


def walk(steps=60):
    """Positions (steps, 2) of a walker who turns half way, with the state after each."""
    x, truth = np.array(START['mean']), []
    for k in range(steps):
        x = turning(0.15 * (k >= steps // 2), 1.0) @ x
        truth.append(x)
    noise = np.random.default_rng(3).normal(0.0, 1.0, (steps, 2))
    return np.array(truth)[:, :2] + noise, np.array(truth)


def test_equals_filterpy_on_an_asymmetric_chain():
    filters = []
    for rate, noise in ((0.0, 0.05), (0.15, 0.2)):
        kf = KalmanFilter(dim_x=4, dim_z=2)
        kf.x, kf.P = np.array(START['mean']), START['covariance'].copy()
        kf.F, kf.Q = turning(rate, 1.0), white_acceleration(noise**2, rate, 1.0)
        kf.H, kf.R = np.eye(2, 4), np.eye(2)
        filters.append(kf)
    peer = IMMEstimator(filters, np.array([0.5, 0.5]), T)
    imm = IMM(MODELS, T, **START, measurement=position(1.0))
    for z in walk()[0]:
        imm.step(z)
        peer.predict()
        peer.update(z)
        assert imm.estimate.mean == pytest.approx(peer.x, rel=1e-11, abs=1e-11)
        assert imm.estimate.covariance == pytest.approx(peer.P, rel=1e-10, abs=1e-11)
        assert imm.model_probabilities == pytest.approx(peer.mu, rel=1e-10, abs=1e-12)


class StoneSoupIMM:
    """Stone Soup has no IMM: its extended filter as the members of one written with loops."""

    def __init__(self, sensor):
        self.updater, self.mu = ExtendedKalmanUpdater(sensor), np.array([0.5, 0.5])
        self.x = [np.array(START['mean'])] * 2
        self.P = [START['covariance']] * 2

    def step(self, z):
        c, mixed = self.mu @ T, []
        for j in range(2):
            w = T[:, j] * self.mu / c[j]
            x = w[0] * self.x[0] + w[1] * self.x[1]
            P = sum(w[i] * (self.P[i] + np.outer(self.x[i] - x, self.x[i] - x)) for i in range(2))
            mixed.append((x, P))
        weight = np.empty(2)
        for j, (rate, noise) in enumerate(((0.0, 0.05), (0.15, 0.2))):
            F, Q = turning(rate, 1.0), white_acceleration(noise**2, rate, 1.0)
            x, P = F @ mixed[j][0], F @ mixed[j][1] @ F.T + Q
            when = datetime(2026, 1, 1)
            predicted = GaussianStatePrediction(x[:, None], P, timestamp=when)
            seen = Detection(np.array([[z[1]], [z[0]]]), timestamp=when)
            expected = self.updater.predict_measurement(predicted)
            after = self.updater.update(SingleHypothesis(predicted, seen, expected))
            off = np.array([z[1], z[0]]) - np.ravel(expected.state_vector).astype(float)
            off[0] = (off[0] + np.pi) % (2.0 * np.pi) - np.pi
            S = np.asarray(expected.covar, float)
            weight[j] = c[j] * np.exp(-0.5 * off @ np.linalg.solve(S, off))
            weight[j] /= np.sqrt(np.linalg.det(S))
            self.x[j] = np.ravel(after.state_vector).astype(float)
            self.P[j] = np.asarray(after.covar, float)
        self.mu = weight / weight.sum()


class ExactSlopes(CartesianToBearingRange):
    """Stone Soup's Jacobian is by differences, which leave eight digits."""

    def jacobian(self, state, **_):
        dx, dy = np.ravel(state.state_vector)[:2].astype(float) - np.ravel(self.translation_offset)
        r = np.hypot(dx, dy)
        return np.array([[-dy / r**2, dx / r**2, 0.0, 0.0], [dx / r, dy / r, 0.0, 0.0]])


def test_equals_an_imm_of_stone_soups_extended_filters():
    """Range and bearing across the cut at 180 degrees."""
    at = (110.0, 30.0)
    noise, place = np.diag([0.01**2, 1.0]), np.array(at)[:, None]
    sensor = ExactSlopes(4, (0, 1), noise, translation_offset=place)
    imm = IMM(MODELS, T, **START, measurement=range_bearing(1.0, 0.01, at))
    peer, rng = StoneSoupIMM(sensor), np.random.default_rng(1)
    bearings = []
    for x in walk()[1]:
        off = x[:2] - at
        z = [np.hypot(*off), np.arctan2(off[1], off[0])] + rng.normal(0.0, [1.0, 0.01])
        bearings.append(z[1])
        imm.step(z)
        peer.step(z)
        mean = peer.mu @ np.array(peer.x)
        assert imm.estimate.mean == pytest.approx(mean, rel=1e-10, abs=1e-10)
        assert imm.model_probabilities == pytest.approx(peer.mu, rel=1e-10)
    assert max(bearings) > 3.0 and min(bearings) < -3.0


def test_a_jacobian_by_differences_is_the_one_stated():
    sensor = range_bearing(1.0, 0.01)
    plain = MeasurementModel(sensor.h, sensor.R, angles=(1,))
    for x in np.array([[30.0, -40.0], [-50.0, 1e-7]]):
        assert plain.jacobian(x) == pytest.approx(sensor.jacobian(x), abs=1e-8)


def test_late_measurements_give_the_bits_of_sorted_ones():
    z, stamps = walk(12)[0], np.arange(12) * 0.7
    sorted_, shuffled = (
        IMM(MODELS, T, **START, measurement=position(1.0), stamp=0.0) for _ in range(2)
    )
    for k in range(12):
        assert sorted_.step(z[k], stamp=stamps[k]) == 'used'
    for k in np.random.default_rng(0).permutation(12):
        assert shuffled.step(z[k], stamp=stamps[k]) == 'used'
    assert (sorted_.estimate.mean == shuffled.estimate.mean).all()
    assert (sorted_.estimate.covariance == shuffled.estimate.covariance).all()
    assert sorted_.step(z[3], stamp=stamps[3]) == 'duplicate'
    assert sorted_.step(z[3], stamp=-1.0) == 'too_late'


def test_ten_short_steps_without_measurement_are_a_long_one():
    models = [cv(noise=0.3), cv(noise=0.3, name='same')]
    long, short = (IMM(models, T, **START) for _ in range(2))
    long.step(None)
    for _ in range(10):
        short.step(None, dt=0.1)
    assert short.stamp == long.stamp == 1.0
    assert short.estimate.covariance == pytest.approx(long.estimate.covariance, rel=1e-12)
    assert short.model_probabilities == pytest.approx(long.model_probabilities, rel=1e-12)


def test_a_chain_of_rates_is_its_matrix():
    for chain in (RateChain(T, 1.0), RateChain(RateChain(T, 1.0).transition(0.5), 0.5)):
        imm, plain = (IMM(MODELS, each, **START, measurement=position(1.0)) for each in (chain, T))
        for z, dt in zip(walk(10)[0], (None, 0.3, 1.0, 0.7, None, 2.0, 0.0, 1.0, 1.0, 0.1)):
            imm.step(z, dt)
            plain.step(z, dt)
        assert imm.transition == pytest.approx(T, abs=1e-12)
        assert imm.estimate.mean == pytest.approx(plain.estimate.mean, rel=1e-11)
    # One without a generator takes its own step only.
    imm = IMM(MODELS, [[0.1, 0.9], [0.9, 0.1]], **START)
    assert imm.step(None) == 'used'
    with pytest.raises(ValueError, match='no generator'):
        imm.step(None, dt=0.5)


@pytest.mark.parametrize('rate', [0.0, 1e-6, -0.2])
def test_an_unknown_turn_is_linearised_rightly(rate):
    model, x = ct(noise=0.1), np.array([1.0, 2.0, 0.7, -0.4, rate])
    F, _, B = model.motion(x, 1.3)

    def f(x):
        return np.append(turning(x[4], 1.3) @ x[:4], x[4])

    slopes = [(f(x + h) - f(x - h)) / 2e-6 for h in 1e-6 * np.eye(5)]
    assert F == pytest.approx(np.transpose(slopes), abs=1e-8)
    assert F @ x + B == pytest.approx(f(x), abs=1e-12)


def test_constant_acceleration_composes():
    F1, Q1, _ = ca(noise=0.1).motion(np.zeros(6), 0.4)
    F2, Q2, _ = ca(noise=0.1).motion(np.zeros(6), 0.8)
    assert F1 @ F1 == pytest.approx(F2) and F1 @ Q1 @ F1.T + Q1 == pytest.approx(Q2)


def test_unequal_states_are_mixed_by_their_components():
    models, chain = [hover(noise=0.05), cv(noise=0.02), ct(noise=0.02)], 0.02 + 0.94 * np.eye(3)
    start = [50.0, 10.0, 0.0, 0.0, 0.0], np.diag([9.0, 9.0, 1.0, 1.0, 0.04])
    imm = IMM(models, chain, *start, position(0.2))
    assert imm.components == imm.outputs == ('px', 'py', 'vx', 'vy', 'turn')
    rng, x, won = np.random.default_rng(5), np.array([50.0, 10.0, 0.6, 0.8]), []
    for k in range(120):
        if k >= 40:
            x = turning(0.15 * (k >= 80), 1.0) @ x
        imm.step(x[:2] + rng.normal(0.0, 0.2, 2))
        if k in (39, 79, 119):
            won.append(imm.names[int(imm.model_probabilities.argmax())])
            speed = np.hypot(*imm.estimate.mean[2:4])
            assert speed == pytest.approx(0.0 if k == 39 else 1.0, abs=0.15)
    assert won == ['hover', 'cv', 'ct']
    assert imm.estimate.mean[4] == pytest.approx(0.15, abs=0.05)
    smoothed = imm.smooth()
    assert smoothed.stamps[-1] == 120.0 and smoothed.mean.shape == (120, 5)
    assert smoothed.mean[-1] == pytest.approx(imm.estimate.mean)
    assert smoothed.model_probabilities[60:75, 1].min() > 0.9


def test_a_model_with_outputs_of_its_own_is_the_same_model():
    """East at a speed that is a state: a velocity is no component, and may be measured."""

    def motion(x, dt):
        F = np.eye(3)
        F[0, 2] = dt
        return Motion(F, 0.01 * dt * np.eye(3), np.zeros(3))

    east = Model('east', ('px', 'py', 'speed'), motion, {'vx': (0, 0, 1), 'vy': (0, 0, 0)})
    doppler = MeasurementModel(lambda v: v, [[0.01]], components=('vx',))
    imm = IMM([east, hover(noise=0.1)], T, [0.0, 0.0, 0.5], np.eye(3), position(0.5))
    assert imm.outputs == ('px', 'py', 'speed', 'vx', 'vy')
    for k in range(1, 20):
        imm.step([0.9 * k, 0.0])
        assert imm.step([0.9], stamp=k, measurement=doppler) == 'used'
    assert imm.estimate.mean[[0, 3]] == pytest.approx([17.1, 0.9], abs=0.1)
    assert imm.model_probabilities[0] > 0.99


@pytest.mark.parametrize('values, problem', [
    ({'mean': [0.0, 0.0]}, 'mean and covariance need 4 and 4 x 4 values, for px, py, vx, vy'),
    ({'covariance': -np.eye(4)}, 'positive definite'),
    ({'transition': np.eye(3)}, '2 x 2 and 2 probabilities'),
    ({'transition': [[0.5, 0.4], [0.0, 1.0]]}, 'row 0 of the transition matrix sums to 0.9'),
    ({'models': [cv(noise=0.1)] * 2}, 'names of their own'),
    ({'initial': [0.5, 0.6]}, '2 probabilities'),
    ({'initial': [1.5, -0.5]}, '2 probabilities'), ({'dt': 0.0}, 'dt has to be positive'),
])  # fmt: skip
def test_what_does_not_fit_is_refused(values, problem):
    with pytest.raises(ValueError, match=problem):
        IMM(**{'models': MODELS, 'transition': T, **START, **values})


def test_measurements_that_do_not_fit_are_refused():
    imm = IMM(MODELS, T, **START, measurement=position(1.0))
    with pytest.raises(ValueError, match='2 finite values, or None'):
        imm.step([1.0, np.nan])
    with pytest.raises(ValueError, match="'turn' is measured, but no model has it"):
        imm.step([0.1], measurement=MeasurementModel(lambda x: x, 1.0, ('turn',)))
    with pytest.raises(ValueError, match='not both'):
        imm.step(None, 1.0, stamp=3.0)
    with pytest.raises(ValueError, match='needs a measurement model'):
        IMM(MODELS, T, **START).step([1.0, 2.0])
    with pytest.raises(ValueError, match='nothing to smooth'):
        imm.smooth()
