"""Learning transitions: the printed formulas, irregular steps, and that it learns what is true."""

import numpy as np
import pytest

from sonar_imm.estimation import markov
from sonar_imm.estimation.adaptation import AdaptiveChain, transition_posterior

PRIOR = np.array([[0.8, 0.15, 0.05], [0.3, 0.5, 0.2], [0.1, 0.2, 0.7]])


def simplex(rng, *shape):
    return rng.dirichlet(np.ones(3), size=shape)


def test_counts_at_a_constant_step_are_the_dirichlet_posterior_mean():
    rng = np.random.default_rng(1)
    chain = AdaptiveChain(markov.RateChain(PRIOR, 1.0), 'counts', weight=3.0)
    learnt, counts, P = chain.fresh(1), np.zeros((3, 3)), PRIOR
    for _ in range(20):
        before, after = simplex(rng, 1), simplex(rng, 1)
        joint = P * before[0][:, None]
        counts += joint / joint.sum(axis=0) * after[0]
        learnt = chain.learn(learnt, P[None], before, after, 1.0)
        P = counts + 3.0 * PRIOR
        P /= P.sum(axis=1, keepdims=True)
        np.testing.assert_allclose(chain.transition(learnt, 1.0)[0], P, atol=1e-13)


def test_counting_a_chain_that_is_seen_recovers_it_at_any_step():
    """Known models and irregular steps: the corrected matrix of the reference step approaches the
    true one though not one transition was seen over that step."""
    rng = np.random.default_rng(2)
    truth = markov.RateChain([[0.6, 0.3, 0.1], [0.1, 0.8, 0.1], [0.05, 0.35, 0.6]], 1.0)
    chain = AdaptiveChain(markov.RateChain(PRIOR, 1.0), 'counts', weight=2.0)
    learnt, model = chain.fresh(1), 0
    for dt in rng.uniform(0.4, 0.9, 20_000):
        after = rng.choice(3, p=truth.transition(dt)[model])
        learnt = chain.learn(
            learnt, chain.transition(learnt, dt), np.eye(3)[[model]], np.eye(3)[[after]], dt
        )
        model = after
    learnt_matrix = chain.transition(learnt, 0.65)[0]
    assert np.abs(learnt_matrix - truth.transition(0.65)).max() < 0.03
    assert np.abs(PRIOR - truth.matrix).max() > 0.19


def test_the_paper_form_keeps_its_guard():
    chain = AdaptiveChain(markov.RateChain(PRIOR, 1.0), 'paper', guard=0.7)
    learnt = chain.fresh(1)
    mu = np.array([[0.98, 0.01, 0.01]])
    for _ in range(50):
        learnt = chain.learn(learnt, chain.transition(learnt, 1.0), mu, mu, 1.0)
    P = chain.transition(learnt, 1.0)[0]
    assert (P >= 0.7 * PRIOR - 1e-12).all()
    np.testing.assert_allclose(P.sum(axis=1), 1.0, atol=1e-12)


def test_the_paper_form_unguarded_degenerates_as_the_docs_say():
    """Rows are one-hot within five steps: the exponent of mu doubles each time."""
    chain = AdaptiveChain(markov.RateChain(PRIOR, 1.0), 'paper', guard=0.0)
    learnt, mu = chain.fresh(1), np.array([[0.7, 0.2, 0.1]])
    for _ in range(5):
        learnt = chain.learn(learnt, chain.transition(learnt, 1.0), mu, mu, 1.0)
    assert chain.transition(learnt, 1.0)[0].max(axis=1).min() > 0.97


def test_fixed_learns_nothing():
    chain = AdaptiveChain(markov.RateChain(PRIOR, 1.0), 'fixed')
    learnt = chain.learn(
        chain.fresh(4), PRIOR[None], np.ones((4, 3)) / 3, np.ones((4, 3)) / 3, 1.0
    )
    np.testing.assert_array_equal(chain.transition(learnt, 1.0), PRIOR[None])


def test_impossible_transitions_stay_impossible():
    prior = np.array([[0.9, 0.1, 0.0], [0.0, 0.9, 0.1], [0.1, 0.0, 0.9]])
    for form in ('counts', 'paper'):
        chain = AdaptiveChain(markov.EventChain([1.0], 1.0), form)
        chain.chain.matrix = prior
        chain.chain.transition = lambda dt: prior
        rng = np.random.default_rng(3)
        learnt = chain.fresh(2)
        for _ in range(10):
            before, after = simplex(rng, 2), simplex(rng, 2)
            learnt = chain.learn(learnt, chain.transition(learnt, 1.0), before, after, 1.0)
        P = chain.transition(learnt, 1.0)
        assert (P[:, prior == 0.0] == 0.0).all()
        np.testing.assert_allclose(P.sum(axis=-1), 1.0)


def test_the_posterior_of_transitions_has_the_right_margins():
    rng = np.random.default_rng(4)
    after = simplex(rng, 5)
    posterior = transition_posterior(PRIOR[None], simplex(rng, 5), after)
    np.testing.assert_allclose(posterior.sum(axis=1), after, atol=1e-14)


def test_an_unknown_form_is_named():
    with pytest.raises(ValueError, match='sticky'):
        AdaptiveChain(markov.RateChain(PRIOR, 1.0), 'sticky')
