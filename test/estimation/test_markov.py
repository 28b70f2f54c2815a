# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Chains of models, learnt and of onsets, the Gauss-Markov step, and smoothers: closed forms,
vectors, joint Gaussians, hidden Markov chains, and every sequence of models enumerated."""

import itertools
import math
from types import SimpleNamespace

from helpers.vector_files import load_vectors
from helpers.vector_files import vectors as sea_vectors
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import poisson

from sonar_imm.acoustics.envelopes import log_likelihoods, transmit_samples
from sonar_imm.estimation import imm, kalman, markov, smoothing
from sonar_imm.estimation.adaptation import AdaptiveChain
from sonar_imm.estimation.gauss_markov import gauss_markov
from sonar_imm.estimation.onset import ENTER_BELOW, LEAVE_BELOW, LEAVE_FISH, OnsetChain, OnsetState
from sonar_imm.estimation.onset_kernels import FADED, NO_FLOOR
from sonar_imm.estimation.smoothing import imm_smooth, IMMPredicted, smooth_modes

ASYMMETRIC = np.array([[0.9, 0.07, 0.03], [0.3, 0.6, 0.1], [0.1, 0.2, 0.7]])
PRIOR = np.array([[0.8, 0.15, 0.05], [0.3, 0.5, 0.2], [0.1, 0.2, 0.7]])
P = np.array([[0.9, 0.07, 0.03], [0.3, 0.6, 0.1], [0.1, 0.2, 0.7]])


def test_what_is_no_transition_matrix_is_refused():
    half = [0.5, 0.5]
    for bad in ([half], [[1.1, -0.1], half], [[np.nan, 1.0], half], [], [[[1.0]]]):
        with pytest.raises(ValueError):
            markov.check_transition_matrix(bad)
    with pytest.raises(ValueError, match='row 1 .* sums to 1.1'):
        markov.check_transition_matrix([[0.9, 0.1], [0.5, 0.6]])


def test_ten_small_steps_are_one_large_step():
    chain = markov.RateChain(ASYMMETRIC, step=1.0)
    assert chain.residual < 1e-12
    np.testing.assert_allclose(chain.transition(1.0), ASYMMETRIC, atol=1e-15)
    ten = np.linalg.matrix_power(chain.transition(0.1), 10)
    np.testing.assert_allclose(ten, ASYMMETRIC, atol=1e-13)
    np.testing.assert_allclose(chain.transition(2.0), ASYMMETRIC @ ASYMMETRIC, atol=1e-13)
    np.testing.assert_allclose(chain.transition(0.0), np.eye(3), atol=1e-15)
    # One that forgets at once keeps its matrix.
    rows = np.tile([0.7, 0.2, 0.1], (3, 1))
    np.testing.assert_allclose(markov.RateChain(rows, 1.0).transition(1.0), rows, atol=1e-6)
    for dt, why in ((-0.1, 'negative'), (np.inf, 'finite')):
        with pytest.raises(ValueError, match=why):
            chain.transition(dt)


@settings(deadline=None, max_examples=60)
@given(st.integers(2, 6), st.integers(0, 2**32 - 1), st.floats(0.0, 1e6))
def test_every_step_of_every_chain_is_a_transition_matrix(models, seed, dt):
    """Also of those without a generator, which say how far off they are."""
    matrix = np.random.default_rng(seed).dirichlet(np.full(models, 0.3), size=models)
    P = markov.RateChain(matrix, step=0.7).transition(dt)
    assert (P >= 0.0).all()
    np.testing.assert_allclose(P.sum(axis=1), 1.0, atol=1e-12)
    assert markov.RateChain([[0.1, 0.9], [0.9, 0.1]], step=1.0).residual > 0.1


@settings(deadline=None, max_examples=60)
@given(st.integers(2, 17), st.integers(0, 2**32 - 1), st.floats(-9.0, 2.0))
def test_every_step_is_the_matrix_exponential(models, seed, exponent):
    rng = np.random.default_rng(seed)
    matrix = rng.dirichlet(np.full(models, rng.uniform(0.05, 2.0)), size=models)
    stay = rng.uniform(0.3, 0.99)
    chain = markov.RateChain(stay * np.eye(models) + (1.0 - stay) * matrix, step=0.7)
    P = chain.transition(10.0**exponent)
    np.testing.assert_allclose(P, expm(chain.generator * 10.0**exponent), rtol=0, atol=1e-12)
    np.testing.assert_allclose(P.sum(axis=1), 1.0, rtol=1e-15)


@pytest.mark.parametrize('dt', [1e-6, 0.7, 40.0])
def test_a_defective_generator(dt):
    """Stages of one rate have one eigenvector; how many are passed is a Poisson number. (scipy's
    `expm` of the nearly triangular matrix is off by .03 at dt = 3: it is asked about G itself.)"""
    stages, rate = 5, 0.9
    G = rate * (np.eye(stages, k=1) - np.eye(stages))
    G[-1] = 0.0
    chain = markov.RateChain(expm(G), step=1.0)
    np.testing.assert_allclose(chain.generator, G, atol=1e-14)
    assert np.linalg.cond(np.linalg.eig(chain.generator)[1]) > 1e6
    P = chain.transition(dt)
    np.testing.assert_allclose(P, expm(G * dt), rtol=0, atol=1e-12)
    for i in range(stages - 1):
        passed = np.arange(stages - 1 - i)
        np.testing.assert_allclose(P[i, i:-1], poisson.pmf(passed, rate * dt), atol=1e-12)


@pytest.mark.parametrize('dt', [1e-9, 1.5, 1e9])
def test_slow_and_fast_rates_keep_their_digits(dt):
    """Two models in closed form; the slow way keeps its relative error beside one 1e8 faster."""
    slow, fast = 1e-8, 1.0
    total = slow + fast
    left = slow / total * -np.expm1(-total)
    back = left * fast / slow
    chain = markov.RateChain([[1.0 - left, left], [back, 1.0 - back]], 1.0)
    a, b = chain.generator[0, 1], chain.generator[1, 0]
    want = a / (a + b) * -np.expm1(-(a + b) * dt)
    np.testing.assert_allclose(chain.transition(dt)[0, 1], want, rtol=1e-12)


def test_persistent_headings_match_the_reference():
    known = load_vectors('diver/imm_reference')
    found = markov.persistent_headings(16, 0.88, 1.0)
    np.testing.assert_allclose(found, known['A4_world16/Pi'], atol=1e-14)
    found = markov.with_hover(markov.persistent_headings(16, 0.88, 2.0), 0.02, 0.9)
    np.testing.assert_allclose(found, known['A12_speedstate16_hover/Pi'], atol=1e-14)


def test_counting_a_chain_that_is_seen_recovers_it_at_any_step():
    rng = np.random.default_rng(2)
    truth = markov.RateChain([[0.6, 0.3, 0.1], [0.1, 0.8, 0.1], [0.05, 0.35, 0.6]], 1.0)
    chain = AdaptiveChain(markov.RateChain(PRIOR, 1.0), weight=2.0)
    learnt, model = chain.initial_counts(1), 0
    for dt in rng.uniform(0.4, 0.9, 8_000):
        after = rng.choice(3, p=truth.transition(dt)[model])
        seen = np.eye(3)[[model]], np.eye(3)[[after]]
        learnt = chain.learn(learnt, chain.transition(learnt, dt), *seen, dt)
        model = after
    learnt_matrix = chain.transition(learnt, 0.65)[0]
    assert np.abs(learnt_matrix - truth.transition(0.65)).max() < 0.03
    assert np.abs(PRIOR - truth.matrix).max() > 0.19


@pytest.mark.parametrize('shared', [False, True])
@pytest.mark.parametrize('M, families', [(3, 1), (6, 3), (17, 4)])
def test_what_is_learnt_is_what_the_plain_forms_say(M, families, shared):
    """Of the transitions inside of families; the others stay, and the sums over families."""
    rng = np.random.default_rng(M)
    nominal = rng.dirichlet(np.ones(M), M)
    nominal[0, 1] = 0.0
    nominal /= nominal.sum(axis=1, keepdims=True)
    family = np.arange(M) % families
    constant = SimpleNamespace(matrix=nominal, step=1.0, transition=lambda dt: nominal)
    chain = AdaptiveChain(constant, weight=2.0, family=family)
    inside = family[:, None] == family[None]
    learnt = chain.initial_counts(5)
    learnt += rng.uniform(0.0, 3.0, learnt.shape) * (nominal[inside] > 0.0)
    whole = np.zeros((5, 2, M, M))
    whole[:, :, inside] = learnt
    # Counts of transitions beside those that the nominal matrix expects, both after two of it.
    counted, expected = whole[:, 0] + 2.0 * nominal, whole[:, 1] + 2.0 * nominal
    own = np.where(inside, nominal, 0.0)
    kept = own.sum(axis=1, keepdims=True)
    want = own * np.divide(counted, expected, out=np.ones_like(counted), where=expected > 0.0)
    want = np.where(inside, want / want.sum(axis=-1, keepdims=True) * kept, nominal)
    transition = chain.transition(learnt, 1.0)
    np.testing.assert_allclose(transition, want, rtol=1e-12)
    transition = transition[:1] if shared else transition
    before, after = rng.dirichlet(np.ones(M), (2, 5))
    hit = np.array([0, 3])
    found = chain.learn(learnt, transition, before, after, 1.0, hit)
    joint = transition * before[:, :, None]
    joint = joint / joint.sum(axis=1, keepdims=True) * after[:, None]
    due = joint.sum(axis=2, keepdims=True) * nominal
    want = whole + np.stack([joint, due], axis=1)
    np.testing.assert_allclose(found[hit], want[hit][:, :, inside], rtol=1e-12)
    np.testing.assert_array_equal(found[[1, 2, 4]], learnt[[1, 2, 4]])


def test_onsets_of_the_vectors():
    floor = load_vectors('fathometer_in_the_field/floor')
    trace, step = floor['trace'], float(floor['step'])
    pulse, noise = float(floor['pulse']), floor['water_profile']
    chain = OnsetChain(step, trace.shape[1], pulse, transmit_samples(trace))
    assert chain.temper == pytest.approx(float(floor['alpha']))
    state, off = chain.start(), []
    for k, row in enumerate(trace):
        state = chain.update(state, *log_likelihoods(row, noise, float(floor['loudest'])))
        assert state.found == floor['onset'][k] and np.argmax(state.ring) == floor['ring'][k]
        if k % 6 == 0:
            off.append(0.5 * np.abs(state.onset - floor['posterior'][k // 6]).sum())
    assert max(off) < 1e-6


def onsets_of_all_paths(chain, quiet, loud, onset, prior_onset, prior_ring):
    """Posterior of onset and transmit pulse from all of their values, and all runs, by name."""
    n, h, a = chain.cells, chain.step, chain.temper
    fish, leave = chain.fish_rate * h, LEAVE_FISH * h
    begin, end = ENTER_BELOW * h, LEAVE_BELOW * h

    def runs(cells, state, enter, leave):
        """Sum over all paths of quiet (0) and loud (1) over `cells`, before which it is state."""
        total = 0.0
        for path in itertools.product((0, 1), repeat=len(cells)):
            weight, last = 1.0, state
            for z, now in zip(cells, path):
                rate = leave if last else enter
                weight *= rate if now != last else 1.0 - rate
                weight *= math.exp(a * (loud[z] if now else quiet[z]))
                last = now
            total += weight
        return total

    onsets, rings = np.zeros(n), np.zeros(len(prior_ring))
    for r, k in itertools.product(range(len(prior_ring)), range(n)):
        last = k == n - 1
        stop = n if last else k
        if stop < r:
            continue
        weight = prior_ring[r] * prior_onset[k] * math.exp(a * loud[:r].sum())
        weight *= runs(range(r, stop), 0, fish, leave)
        if last:
            weight *= math.exp(NO_FLOOR)
        else:
            m = min(k + chain.window, n)
            heard, still = (runs(range(m, n), state, begin, end) for state in (1, 0))
            heard *= (1.0 - FADED) * math.exp(a * onset[k:m].sum())
            weight *= heard + FADED * math.exp(a * quiet[k:m].sum()) * still
        onsets[k] += weight
        rings[r] += weight
    return onsets / onsets.sum(), rings / rings.sum()


@pytest.mark.parametrize('ring', [2, -1])
@pytest.mark.parametrize('seed', range(2))
def test_sums_are_those_of_all_paths(seed, ring):
    rng = np.random.default_rng(seed)
    chain = OnsetChain(0.3, 9, 0.3, ring, fish_rate=0.2)
    logs = [rng.normal(-1.0, 2.0, 9) for _ in range(3)]
    rings = rng.dirichlet(np.ones(len(chain.start().ring)))
    before = OnsetState(rng.dirichlet(np.ones(9)), rings)
    predicted = chain.predict(before)
    onset, ring = onsets_of_all_paths(chain, *logs, predicted.onset, predicted.ring)
    found = chain.update(before, *logs)
    assert found.onset == pytest.approx(onset, abs=1e-12)
    assert found.ring == pytest.approx(ring, abs=1e-12)


def test_probabilities_stay_sums_of_one_through_silence_and_nothing():
    chain = OnsetChain(0.1, 50, 0.2, 0)
    state = chain.start()
    for _ in range(200):
        state = chain.update(state, *(np.zeros(50) for _ in range(3)))
        assert state.onset.sum() == pytest.approx(1.0) and state.ring.sum() == pytest.approx(1.0)
    # All of it quiet: a faded floor could be anywhere, and none is sure.
    quiet = np.zeros(50), np.full(50, -50.0), np.full(50, -50.0)
    for _ in range(5):
        state = chain.update(state, *quiet)
    assert state.onset.max() < 0.2


def test_steps_compose_and_keep_the_variance():
    whole, part = gauss_markov(2.0, 60.0, 10.0), gauss_markov(2.0, 60.0, 1.0)
    variance, fade = 0.0, 1.0
    for _ in range(10):
        variance, fade = part[0] ** 2 * variance + part[1], fade * part[0]
    assert (fade, variance) == pytest.approx(whole)
    assert part[0] ** 2 * 4.0 + part[1] == pytest.approx(4.0)
    v = sea_vectors('gauss_markov')
    for dt, a, q in zip(v['dt'], v['out_a'], v['out_q']):
        assert gauss_markov(float(v['std']), float(v['time']), dt) == pytest.approx((a, q), 1e-9)


def covariance(rng, *shape):
    root = rng.normal(size=(*shape, shape[-1] + 1))
    return root @ np.swapaxes(root, -1, -2)


def chain(rng, models, stay=2.0):
    """An asymmetric transition matrix."""
    P = rng.dirichlet(np.ones(models), size=models) + np.diag(rng.uniform(0.2, stay, models))
    return P / P.sum(axis=1, keepdims=True)


def repeat(array, steps):
    return np.broadcast_to(array, (steps, *array.shape))


def kalman_pass(F, Q, B, H, R, x, P, Z):
    xs, Ps = [], []
    for k, z in enumerate(Z):
        if k:
            x, P, _ = kalman.predict(x, P, F[k], Q[k], B[k])
        x, P = kalman.update(x, P, z - kalman.apply(H, x), H, R)[:2]
        xs.append(x)
        Ps.append(P)
    return np.array(xs), np.array(Ps)


def imm_pass(transition, F, Q, B, H, R, x, P, mu, Z, moves_first=False):
    """Forward pass of one target; transition, F, Q and B (K, ...) are those into each step;
    moves_first: whether there is a move into the first step."""
    x, P, mu, steps = x[None], P[None], mu[None], []
    H = np.broadcast_to(H, (x.shape[1], *H.shape))
    for k, z in enumerate(Z):
        if k or moves_first:
            mixed = imm.mix(x, P, mu, transition[k][None])
            (x, P, _), mu = imm.predict(mixed.x, mixed.P, F[k], Q[k], B[k]), mixed.c
        updated = imm.update(x, P, mu, z - np.einsum('jmn,tjn->tjm', H, x), H[None], R[None])
        x, P, mu = updated.x, updated.P, updated.mu
        steps.append((x[0], P[0], mu[0]))
    return tuple(np.array(part) for part in zip(*steps))


def rts_smooth(x, P, F, Q, B):
    """The Rauch-Tung-Striebel smoother of a forward pass x (K, ..., n), P of one model."""
    x, P = x.copy(), P.copy()
    for k in range(len(x) - 2, -1, -1):
        F1 = F[k + 1]
        S = F1 @ P[k] @ np.swapaxes(F1, -1, -2) + Q[k + 1]
        gain = P[k] @ np.swapaxes(F1, -1, -2) @ np.linalg.pinv(S, hermitian=True)
        x[k] += kalman.apply(gain, x[k + 1] - kalman.apply(F1, x[k]) - B[k + 1])
        P[k] += gain @ (P[k + 1] - S) @ np.swapaxes(gain, -1, -2)
    return x, P


def joint_by_covariance(F, Q, B, H, R, x0, P0, Z):
    """All states at once: the joint covariance, which may be singular, conditioned on all data."""
    K, n = len(Z), len(x0)
    mean, C = np.zeros((K, n)), np.zeros((K, n, K, n))
    mean[0], C[0, :, 0] = x0, P0
    for k in range(1, K):
        mean[k] = F[k] @ mean[k - 1] + B[k]
        C[k, :, :k] = np.einsum('ab,bkc->akc', F[k], C[k - 1, :, :k])
        C[:k, :, k] = C[k, :, :k].transpose(1, 2, 0)
        C[k, :, k] = F[k] @ C[k - 1, :, k - 1] @ F[k].T + Q[k]
    C, big_H = C.reshape(K * n, K * n), np.kron(np.eye(K), H)
    gain = np.linalg.solve(big_H @ C @ big_H.T + np.kron(np.eye(K), R), big_H @ C).T
    after = C - gain @ big_H @ C
    x = mean.ravel() + gain @ (Z.ravel() - big_H @ mean.ravel())
    return x.reshape(K, n), np.einsum('kakb->kab', after.reshape(K, n, K, n))


@pytest.mark.parametrize('models, moves_at_all', [(1, True), (3, False)])
def test_models_that_are_all_the_same_give_the_joint_gaussian_and_the_chain(models, moves_at_all):
    """The data say nothing about the model: smoothed probabilities are those of the chain. The
    second number may be known exactly after each step: F P F' + Q is singular."""
    rng = np.random.default_rng(3)
    K, H, R = 9, np.array([[1.0, 0.0]]), np.eye(1)
    F, Q, B = rng.normal(size=(K, 2, 2)), covariance(rng, K, 2), rng.normal(size=(K, 2))
    Z, mu0 = rng.normal(size=(K, 1)), rng.dirichlet(np.ones(models))
    if not moves_at_all:
        F[:, 1] = Q[:, 1] = Q[:, :, 1] = 0.0
    transition = np.stack([chain(rng, models) for _ in range(K)])
    moves = [transition, *(np.repeat(part[:, None], models, axis=1) for part in (F, Q, B))]
    x0, P0 = np.zeros((models, 2)), repeat(np.eye(2), models)
    smoothed = imm_smooth(*imm_pass(*moves, H, R, x0, P0, mu0, Z), *moves)
    known = F, Q, B, H, R, x0[0], P0[0], Z
    due, mu = joint_by_covariance(*known), [mu0]
    for k in range(1, K):
        mu.append(mu[-1] @ transition[k])
    np.testing.assert_allclose(smoothed.mu, mu, atol=1e-9)
    alone = rts_smooth(*kalman_pass(*known), F, Q, B)
    each = [(smoothed.x[:, model], smoothed.P[:, model]) for model in range(models)]
    for found in (alone, *each, smoothed.combine(repeat(np.eye(2), models))):
        for part, right in zip(found, due):
            np.testing.assert_allclose(part, right, atol=1e-9)


def test_states_drawn_anew_give_the_forward_backward_algorithm():
    """With F = 0 the models are a hidden Markov chain: filter and smoother are both exact."""
    rng = np.random.default_rng(4)
    K, M = 12, 3
    F, Q, B = np.zeros((K, M, 2, 2)), covariance(rng, K, M, 2), 1.5 * rng.normal(size=(K, M, 2))
    H, R, Z = np.array([[1.0, 0.5]]), np.eye(1) * 0.3, rng.normal(size=(K, 1)) * 2
    mu0, transition = rng.dirichlet(np.ones(M)), np.stack([chain(rng, M) for _ in range(K)])
    filtered = imm_pass(transition, F, Q, B, H, R, B[0], Q[0], mu0, Z)
    smoothed = imm_smooth(*filtered, transition, F, Q, B)
    S = H @ Q @ H.T + R
    emission = np.exp(kalman.log_density(Z[:, None] - B @ H.T, np.sqrt(S))[1])
    forward, backward = np.empty((K, M)), np.ones((K, M))
    forward[0] = mu0 * emission[0]
    for k in range(1, K):
        forward[k] = (forward[k - 1] @ transition[k]) * emission[k]
    for k in range(K - 2, -1, -1):
        backward[k] = transition[k + 1] @ (emission[k + 1] * backward[k + 1])
    expected = forward * backward / (forward * backward).sum(axis=1, keepdims=True)
    np.testing.assert_allclose(smoothed.mu, expected, atol=1e-10)
    np.testing.assert_allclose(smoothed.x, filtered[0], atol=1e-10)
    np.testing.assert_allclose(smoothed.P, filtered[1], atol=1e-10)


def test_a_model_nothing_leads_to_stays_finite():
    K, M = 5, 3
    transition = np.array([[0.7, 0.3, 0.0], [0.4, 0.6, 0.0], [0.0, 1.0, 0.0]])
    F, B = repeat(np.eye(2), M), np.zeros((M, 2))
    Q = np.stack([np.eye(2), 2 * np.eye(2), np.eye(2)])
    moves = [repeat(part, K) for part in (transition, F, Q, B)]
    x0, P0, mu0 = np.zeros((M, 2)), repeat(np.eye(2), M), np.array([0.5, 0.5, 0.0])
    Z = np.random.default_rng(0).normal(size=(K, 2))
    filtered = imm_pass(*moves, np.eye(2), np.eye(2), x0, P0, mu0, Z)
    smoothed = imm_smooth(*filtered, *moves)
    assert all(np.isfinite(part).all() for part in smoothed)
    np.testing.assert_allclose(smoothed.mu.sum(axis=1), 1.0, atol=1e-12)
    np.testing.assert_array_equal(smoothed.mu[:, 2], 0.0)


def test_nothing_to_smooth():
    for K in (0, 1):
        x, P, mu = np.ones((K, 2, 3)), repeat(repeat(np.eye(3), 2), K), np.full((K, 2), 0.5)
        smoothed = imm_smooth(x, P, mu, np.ones((K, 2, 2)) / 2, P, P)
        np.testing.assert_array_equal(smoothed.x, x)
        np.testing.assert_array_equal(smoothed.mu, mu)
    # A forward pass that contradicts itself is refused.
    x, P = np.zeros((2, 2, 1)), np.ones((2, 2, 1, 1))
    mu, transition = np.array([[1.0, 0.0], [0.0, 1.0]]), repeat(np.eye(2), 2)
    with pytest.raises(ValueError, match='no probable model leads'):
        imm_smooth(x, P, mu, transition, P, P)


def enumerate_sequences(F, Q, B, H, R, x, P, mu, transition, Z):
    """Exact smoothed mean, covariance and model probabilities."""
    K, M = len(Z), len(mu)
    sequences = np.array(list(itertools.product(range(M), repeat=K)))
    log_weight, x, P = (part[sequences[:, 0]] for part in (np.log(mu), x, P))
    xs, Ps = [], []
    for k in range(K):
        now = sequences[:, k]
        if k:
            log_weight = log_weight + np.log(transition[sequences[:, k - 1], now])
            x, P, _ = kalman.predict(x, P, F[now], Q[now], B[now])
        updated = kalman.update(x, P, Z[k] - x @ H.T, H, R)
        x, P, log_weight = updated.x, updated.P, log_weight + updated.log_likelihood
        xs.append(x)
        Ps.append(P)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    steps = sequences.T
    sx, sP = rts_smooth(np.array(xs), np.array(Ps), F[steps], Q[steps], B[steps])
    mean = np.einsum('s,ksa->ka', weight, sx)
    off = sx - mean[:, None]
    C = np.einsum('s,ksab->kab', weight, sP + off[..., :, None] * off[..., None, :])
    return mean, C, np.stack([weight @ (sequences == i) for i in range(M)], axis=1)


def draw(rng, F, Q, B, H, R, x0, P0, mu, transition, K):
    """Measurements (K, m) of the jumping system."""
    model = rng.choice(len(mu), p=mu)
    x, Z = rng.multivariate_normal(x0[model], P0[model]), []
    for k in range(K):
        if k:
            model = rng.choice(len(mu), p=transition[model])
            x = rng.multivariate_normal(F[model] @ x + B[model], Q[model])
        Z.append(rng.multivariate_normal(H @ x, R))
    return np.array(Z)


def random_models(rng, M):
    F = np.stack([[[1.0, 1.0], [0.0, rng.uniform(0, 1)]] for _ in range(M)])
    Q, B = 0.1 * covariance(rng, M, 2), rng.normal(size=(M, 2))
    return F, Q, B, np.array([[1.0, 0.0]]), 0.5 * np.eye(1)


def headings(rng, M):
    """Fixed speed along M headings, no memory: F has rows of zeros, Q has rank two of four."""
    angle = 2 * np.pi * np.arange(M) / M
    u, G = np.stack([np.cos(angle), np.sin(angle)], axis=1), np.vstack([np.eye(2), np.eye(2)])
    F, Q = repeat(np.diag([1.0, 1.0, 0.0, 0.0]), M), repeat(0.19**2 * G @ G.T, M)
    return F, Q, np.hstack([u, u]), np.eye(2, 4), np.eye(2)


def quiet_and_agile(rng, M):
    G, F = np.array([0.5, 1.0]), repeat(np.array([[1.0, 1.0], [0.0, 1.0]]), M)
    Q = np.geomspace(0.01, 2.0, M)[:, None, None] * np.outer(G, G)
    return F, Q, np.zeros((M, 2)), np.array([[1.0, 0.0]]), 0.3 * np.eye(1)


def enumerated(models, M, K, seed):
    """Moves of a random scene, its forward pass, and what `enumerate_sequences` says of it."""
    rng, moves, (F, Q, B, H, R, x0, P0, mu), transition = random_scene(models, M, K, seed)
    Z = draw(rng, F, Q, B, H, R, x0, P0, mu, transition, K)
    exact = enumerate_sequences(F, Q, B, H, R, x0, P0, mu, transition, Z)
    return moves, imm_pass(*moves, H, R, x0, P0, mu, Z), exact


def random_scene(models, M, K, seed):
    """A generator of random numbers, the moves of a scene, its parts, and the chain."""
    rng = np.random.default_rng(seed)
    F, Q, B, H, R = models(rng, M)
    n = F.shape[-1]
    mu, transition = rng.dirichlet(3 * np.ones(M)), chain(rng, M)
    moves = [repeat(part, K) for part in (transition, F, Q, B)]
    start = np.zeros((M, n)), repeat(np.eye(n), M), mu
    return rng, moves, (F, Q, B, H, R, *start), transition


def distances(states, exact):
    """From what is exact, step by step: of probabilities, of the mean in sigmas, of variance."""
    mean, C, probability = exact
    x, P = imm.combine(*states, repeat(np.eye(mean.shape[-1]), probability.shape[-1]))
    squared = np.einsum('ka,kab,kb->k', x - mean, np.linalg.pinv(C), x - mean)
    spread = np.trace(P, axis1=1, axis2=2) / np.trace(C, axis1=1, axis2=2) - 1.0
    of_models = np.abs(states[2] - probability).mean(axis=1)
    return np.stack([of_models, np.sqrt(squared), np.abs(spread)])[:, :-1]


@pytest.mark.parametrize('models, M, K, mean_errors, worst_errors', [
    (random_models, 3, 5, (0.0012, 0.005, 0.003), (0.035, 0.025)),
    (headings, 4, 4, (0.0005, 0.003, 0.002), (0.010, 0.010)),
    (quiet_and_agile, 2, 9, (0.003, 0.008, 0.015), (0.05, 0.12)),
])  # fmt: skip
def test_close_to_the_enumeration_of_all_sequences(models, M, K, mean_errors, worst_errors):
    """Mean and worst errors of twelve scenes; the filter is twenty times as far off, or more."""
    smoothed, filtered = [], []
    for seed in range(12):
        moves, states, exact = enumerated(models, M, K, seed)
        smoothed.append(distances(imm_smooth(*states, *moves)[:3], exact))
        filtered.append(distances(states, exact))
    mean = np.mean(smoothed, axis=(0, 2))
    assert (mean < mean_errors).all()
    assert (np.max(smoothed, axis=(0, 2))[1:] < worst_errors).all()
    assert (np.mean(filtered, axis=(0, 2)) > 20.0 * mean).all()


def test_more_gaussians_end_at_the_exact_answer(monkeypatch):
    """With 64 per model hardly any two of the 512 sequences are merged."""
    moves, states, exact = enumerated(quiet_and_agile, 2, 9, 2)
    errors = []
    for halvings in (1, 2, 6):
        monkeypatch.setattr(smoothing, 'HALVINGS', halvings)
        monkeypatch.setattr(smoothing, 'GAUSSIANS', 2**halvings)
        errors.append(distances(imm_smooth(*states, *moves)[:3], exact).max(axis=1))
    assert (errors[0] > 2.0 * errors[1]).all() and (errors[1] > 10.0 * errors[2]).all()


def test_the_prediction_is_that_of_an_imm_filter_unless_it_is_given():
    K, M = 6, 3
    rng, moves, (F, Q, B, *known), transition = random_scene(random_models, M, K, 6)
    filtered = imm_pass(*moves, *known, rng.normal(size=(K, 1)))
    parts = [[np.zeros((M, 2))], [np.zeros((M, 2, 2))], [np.zeros(M)]]
    for x, P, mu in zip(*(part[:-1] for part in filtered)):
        mixed = imm.mix(x[None], P[None], mu[None], transition[None])
        x, P, _ = imm.predict(mixed.x, mixed.P, F, Q, B)
        for part, value in zip(parts, (x, P, mixed.c)):
            part.append(value[0])
    given = imm_smooth(*filtered, *moves, IMMPredicted(*map(np.array, parts)))
    for one, other in zip(given, imm_smooth(*filtered, *moves)):
        np.testing.assert_allclose(one, other, atol=1e-9)


def test_after_a_step_that_no_measurement_explains_the_filtered_states_count():
    """An update that widens: it and what follows are smoothed as if the pass began there."""
    K, M = 5, 3
    rng, moves, (_, _, _, H, R, *start), _ = random_scene(quiet_and_agile, M, K, 7)
    Z = rng.normal(size=(K, 1))
    before = imm_pass(*moves, H, R, *start, Z[:3])
    before[1][2] *= 30.0
    begin = [part[2] for part in before]
    after = imm_pass(*moves, H, R, *begin, Z[3:], moves_first=True)
    wide = [np.concatenate(parts) for parts in zip(before, after)]
    whole = imm_smooth(*wide, *moves)
    end = imm_smooth(*(part[2:] for part in wide), *(part[2:] for part in moves))
    for one, other in zip(whole, end):
        np.testing.assert_allclose(one[2:], other, atol=1e-9)


def filtered(likelihood, mu):
    out = []
    for row in likelihood:
        mu = (mu @ P) * row
        mu = mu / mu.sum()
        out.append(mu)
    return np.array(out)


def test_a_hidden_markov_chain_is_smoothed_exactly():
    rng = np.random.default_rng(1)
    likelihood, mu0 = rng.random((6, 3)), np.array([0.2, 0.5, 0.3])
    paths = np.array(list(np.ndindex(*(3,) * 7)))
    weight = mu0[paths[:, 0]] * P[paths[:, :-1], paths[:, 1:]].prod(axis=1)
    weight *= likelihood[np.arange(6), paths[:, 1:]].prod(axis=1)
    exact = np.array([np.bincount(column, weight) for column in paths[:, 1:].T]) / weight.sum()
    assert smooth_modes(filtered(likelihood, mu0), P) == pytest.approx(exact)


def test_a_chain_at_rest_knows_what_it_will_know():
    mu = filtered(np.random.default_rng(2).random((5, 3)), np.full(3, 1 / 3))
    mu[2] = mu[1]
    smoothed = smooth_modes(mu, P, np.array([True, True, False, True, True]))
    assert smoothed[1] == pytest.approx(smoothed[2])
    assert smoothed == pytest.approx(smooth_modes(np.delete(mu, 2, 0), P)[[0, 1, 1, 2, 3]])


def test_impossible_models_and_short_rows_are_no_trouble():
    mu = np.array([[1.0, 0.0], [0.0, 1.0]])
    assert np.isfinite(smooth_modes(mu, np.eye(2))).all()
    assert smooth_modes(mu[:1], np.eye(2)) == pytest.approx(mu[:1])
    assert smooth_modes(mu[:0], np.eye(2)).shape == (0, 2)
