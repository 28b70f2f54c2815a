# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Learning transitions: irregular steps, and that it learns what is true."""

import numpy as np
from oracles.adaptation import (
    adapt_counts,
    corrected,
    counts_correction,
    transition_posterior,
)
import pytest

from sonar_imm.estimation import markov
from sonar_imm.estimation.adaptation import AdaptiveChain

PRIOR = np.array([[0.8, 0.15, 0.05], [0.3, 0.5, 0.2], [0.1, 0.2, 0.7]])


class Constant:
    """A chain with the same matrix at every step."""

    step = 1.0

    def __init__(self, matrix):
        self.matrix = matrix

    def transition(self, dt):
        return self.matrix


def simplex(rng, *shape):
    return rng.dirichlet(np.ones(3), size=shape)


def test_counts_at_a_constant_step_are_the_dirichlet_posterior_mean():
    rng = np.random.default_rng(1)
    chain = AdaptiveChain(markov.RateChain(PRIOR, 1.0), weight=3.0)
    learnt, counts, P = chain.initial_counts(1), np.zeros((3, 3)), PRIOR
    for _ in range(20):
        before, after = simplex(rng, 1), simplex(rng, 1)
        joint = P * before[0][:, None]
        counts += joint / joint.sum(axis=0) * after[0]
        learnt = chain.learn(learnt, P[None], before, after, 1.0)
        P = counts + 3.0 * PRIOR
        P /= P.sum(axis=1, keepdims=True)
        np.testing.assert_allclose(chain.transition(learnt, 1.0)[0], P, atol=1e-13)


def test_counting_a_chain_that_is_seen_recovers_it_at_any_step():
    """Known models and irregular steps, none of them the reference step."""
    rng = np.random.default_rng(2)
    truth = markov.RateChain([[0.6, 0.3, 0.1], [0.1, 0.8, 0.1], [0.05, 0.35, 0.6]], 1.0)
    chain = AdaptiveChain(markov.RateChain(PRIOR, 1.0), weight=2.0)
    learnt, model = chain.initial_counts(1), 0
    for dt in rng.uniform(0.4, 0.9, 20_000):
        after = rng.choice(3, p=truth.transition(dt)[model])
        learnt = chain.learn(
            learnt, chain.transition(learnt, dt), np.eye(3)[[model]], np.eye(3)[[after]], dt
        )
        model = after
    learnt_matrix = chain.transition(learnt, 0.65)[0]
    assert np.abs(learnt_matrix - truth.transition(0.65)).max() < 0.03
    assert np.abs(PRIOR - truth.matrix).max() > 0.19


def test_fixed_learns_nothing():
    chain = AdaptiveChain(markov.RateChain(PRIOR, 1.0), learns=False)
    learnt = chain.learn(
        chain.initial_counts(4), PRIOR[None], np.ones((4, 3)) / 3, np.ones((4, 3)) / 3, 1.0
    )
    np.testing.assert_array_equal(chain.transition(learnt, 1.0), PRIOR[None])


def test_impossible_transitions_stay_impossible():
    prior = np.array([[0.9, 0.1, 0.0], [0.0, 0.9, 0.1], [0.1, 0.0, 0.9]])
    chain = AdaptiveChain(Constant(prior))
    rng = np.random.default_rng(3)
    learnt = chain.initial_counts(2)
    for _ in range(10):
        before, after = simplex(rng, 2), simplex(rng, 2)
        learnt = chain.learn(learnt, chain.transition(learnt, 1.0), before, after, 1.0)
    P = chain.transition(learnt, 1.0)
    assert (P[:, prior == 0.0] == 0.0).all()
    np.testing.assert_allclose(P.sum(axis=-1), 1.0)


@pytest.mark.parametrize('shared', [False, True])
@pytest.mark.parametrize('M, families', [(3, 1), (8, 1), (17, 1), (6, 3), (17, 4)])
def test_what_is_learnt_is_what_the_plain_forms_say(M, families, shared):
    """Of the transitions inside of families; the others stay, and the sums over families."""
    rng = np.random.default_rng(M)
    nominal = rng.dirichlet(np.ones(M), M)
    nominal[0, 1] = 0.0
    nominal /= nominal.sum(axis=1, keepdims=True)
    family = np.arange(M) % families
    chain = AdaptiveChain(Constant(nominal), weight=2.0, family=family)
    inside = family[:, None] == family[None]
    learnt = chain.initial_counts(5)
    learnt += rng.uniform(0.0, 3.0, learnt.shape) * (nominal[inside] > 0.0)
    whole = np.zeros((5, 2, M, M))
    whole[:, :, inside] = learnt
    factor = counts_correction(whole[:, 0], whole[:, 1], nominal, 2.0)
    own = np.where(inside, nominal, 0.0)
    kept = own.sum(axis=1, keepdims=True)
    want = np.where(inside, corrected(own / kept, factor) * kept, nominal)
    transition = chain.transition(learnt, 1.0)
    np.testing.assert_allclose(transition, want, rtol=1e-12)
    transition = transition[:1] if shared else transition
    before, after = rng.dirichlet(np.ones(M), (2, 5))
    hit = np.array([0, 3])
    found = chain.learn(learnt, transition, before, after, 1.0, hit)
    posterior = transition_posterior(transition, before, after)
    want = np.stack(adapt_counts(whole[:, 0], whole[:, 1], posterior, nominal), axis=1)
    np.testing.assert_allclose(found[hit], want[hit][:, :, inside], rtol=1e-12)
    np.testing.assert_array_equal(found[[1, 2, 4]], learnt[[1, 2, 4]])
