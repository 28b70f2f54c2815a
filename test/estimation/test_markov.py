# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Chains of models, learnt and of onsets, and the Gauss-Markov step: closed forms and vectors."""

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
from sonar_imm.estimation import markov
from sonar_imm.estimation.adaptation import AdaptiveChain
from sonar_imm.estimation.gauss_markov import gauss_markov
from sonar_imm.estimation.onset import ENTER_BELOW, LEAVE_BELOW, LEAVE_FISH, OnsetChain, OnsetState
from sonar_imm.estimation.onset_kernels import FADED, NO_FLOOR

ASYMMETRIC = np.array([[0.9, 0.07, 0.03], [0.3, 0.6, 0.1], [0.1, 0.2, 0.7]])


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
    """The matrices of the independent reference: stay .88, kappa 1; kappa 2 and hover."""
    known = load_vectors('diver/imm_reference')
    found = markov.persistent_headings(16, 0.88, 1.0)
    np.testing.assert_allclose(found, known['A4_world16/Pi'], atol=1e-14)
    found = markov.with_hover(markov.persistent_headings(16, 0.88, 2.0), 0.02, 0.9)
    np.testing.assert_allclose(found, known['A12_speedstate16_hover/Pi'], atol=1e-14)


PRIOR = np.array([[0.8, 0.15, 0.05], [0.3, 0.5, 0.2], [0.1, 0.2, 0.7]])


def test_counting_a_chain_that_is_seen_recovers_it_at_any_step():
    """Known models and irregular steps, none of them the reference step."""
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
            weight *= (1.0 - FADED) * math.exp(a * onset[k:m].sum()) * runs(
                range(m, n), 1, begin, end
            ) + FADED * math.exp(a * quiet[k:m].sum()) * runs(range(m, n), 0, begin, end)
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
