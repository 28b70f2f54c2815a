# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Chains: checks, stationary distribution, steps that compose, persistence."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.stats import poisson

from sonar_imm.estimation import markov

ASYMMETRIC = np.array([[0.9, 0.07, 0.03], [0.3, 0.6, 0.1], [0.1, 0.2, 0.7]])


@pytest.mark.parametrize(
    'bad',
    [
        [[0.5, 0.5]],
        [[0.9, 0.2], [0.5, 0.5]],
        [[1.1, -0.1], [0.5, 0.5]],
        [[np.nan, 1.0], [0.5, 0.5]],
        [],
        [[[1.0]]],
    ],
)
def test_what_is_no_transition_matrix_is_refused(bad):
    with pytest.raises(ValueError):
        markov.check_transition_matrix(bad)


def test_a_bad_row_is_named():
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


@settings(deadline=None, max_examples=60)
@given(st.integers(2, 6), st.integers(0, 2**32 - 1), st.floats(0.0, 1e6))
def test_every_step_of_every_chain_is_a_transition_matrix(models, seed, dt):
    matrix = np.random.default_rng(seed).dirichlet(np.full(models, 0.3), size=models)
    P = markov.RateChain(matrix, step=0.7).transition(dt)
    assert (P >= 0.0).all()
    np.testing.assert_allclose(P.sum(axis=1), 1.0, atol=1e-12)


def test_a_chain_without_generator_says_how_far_off_it_is():
    swap = np.array([[0.1, 0.9], [0.9, 0.1]])  # negative eigenvalue: no real generator
    chain = markov.RateChain(swap, step=1.0)
    assert chain.residual > 0.1
    np.testing.assert_allclose(chain.transition(1.0).sum(axis=1), 1.0)


def test_a_chain_that_forgets_at_once_keeps_its_matrix():
    rows = np.tile([0.7, 0.2, 0.1], (3, 1))
    chain = markov.RateChain(rows, step=1.0)
    np.testing.assert_allclose(chain.transition(1.0), rows, atol=1e-6)


@settings(deadline=None, max_examples=150)
@given(st.integers(2, 17), st.integers(0, 2**32 - 1), st.floats(-9.0, 2.0))
def test_every_step_is_the_matrix_exponential(models, seed, exponent):
    rng = np.random.default_rng(seed)
    matrix = rng.dirichlet(np.full(models, rng.uniform(0.05, 2.0)), size=models)
    stay = rng.uniform(0.3, 0.99)
    chain = markov.RateChain(stay * np.eye(models) + (1.0 - stay) * matrix, step=0.7)
    P = chain.transition(10.0**exponent)
    np.testing.assert_allclose(P, expm(chain.generator * 10.0**exponent), rtol=0, atol=1e-12)
    assert (P >= 0.0).all()
    np.testing.assert_allclose(P.sum(axis=1), 1.0, rtol=1e-15)


@pytest.mark.parametrize('dt', [1e-6, 0.1, 0.7, 3.0, 40.0])
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


@pytest.mark.parametrize('dt', [1e-9, 1e-3, 1.5, 1e3, 1e9])
def test_slow_and_fast_rates_keep_their_digits(dt):
    """Two models in closed form; the slow way keeps its relative error beside one 1e8 faster."""
    slow, fast = 1e-8, 1.0
    total = slow + fast
    left = slow / total * -np.expm1(-total)
    chain = markov.RateChain(
        [[1.0 - left, left], [left * fast / slow, 1.0 - left * fast / slow]], 1.0
    )
    a, b = chain.generator[0, 1], chain.generator[1, 0]
    want = a / (a + b) * -np.expm1(-(a + b) * dt)
    np.testing.assert_allclose(chain.transition(dt)[0, 1], want, rtol=1e-12)


def test_a_step_back_in_time_is_refused():
    with pytest.raises(ValueError, match='negative'):
        markov.RateChain(ASYMMETRIC, 1.0).transition(-0.1)
    with pytest.raises(ValueError, match='finite'):
        markov.RateChain(ASYMMETRIC, 1.0).transition(np.inf)


def test_persistent_headings_match_the_reference(diver_reference):
    """The matrices of the independent reference: stay .88, kappa 1; kappa 2 and hover."""
    np.testing.assert_allclose(
        markov.persistent_headings(16, 0.88, 1.0), diver_reference('A4_world16', 'Pi'), atol=1e-14
    )
    hover = markov.with_hover(markov.persistent_headings(16, 0.88, 2.0), 0.02, 0.9)
    np.testing.assert_allclose(hover, diver_reference('A12_speedstate16_hover', 'Pi'), atol=1e-14)
