"""Chains: checks, stationary law, steps that compose, persistence."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

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


def test_stationary_law_of_an_asymmetric_chain():
    # (.8, .2) by hand: .1 * .8 = .4 * .2
    np.testing.assert_allclose(
        markov.stationary_law(np.array([[0.9, 0.1], [0.4, 0.6]])), [0.8, 0.2], atol=1e-14
    )
    law = markov.stationary_law(ASYMMETRIC)
    np.testing.assert_allclose(law @ ASYMMETRIC, law, atol=1e-14)
    np.testing.assert_allclose(law, np.linalg.matrix_power(ASYMMETRIC, 400)[0], atol=1e-12)


def test_a_chain_in_two_pieces_has_no_single_law():
    with pytest.raises(ValueError, match='not unique'):
        markov.stationary_law(np.eye(2))


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


def test_a_step_back_in_time_is_refused():
    with pytest.raises(ValueError, match='negative'):
        markov.RateChain(ASYMMETRIC, 1.0).transition(-0.1)


def test_the_cache_of_steps_is_bounded():
    chain = markov.RateChain(ASYMMETRIC, 1.0)
    for k in range(3 * markov._CACHED_STEPS):
        chain.transition(1.0 + 1e-3 * k)
    assert len(chain._cache) <= markov._CACHED_STEPS


def test_persistent_headings_match_the_reference(diver_reference):
    """The matrices of the independent reference: stay .88, kappa 1; kappa 2 and hover."""
    np.testing.assert_allclose(
        markov.persistent_headings(16, 0.88, 1.0), diver_reference('A4_world16', 'Pi'), atol=1e-14
    )
    hover = markov.with_hover(markov.persistent_headings(16, 0.88, 2.0), 0.02, 0.9)
    np.testing.assert_allclose(hover, diver_reference('A12_speedstate16_hover', 'Pi'), atol=1e-14)


def test_events_get_rarer_with_shorter_steps():
    chain = markov.EventChain([0.9, 0.07, 0.03], step=1.0)
    np.testing.assert_allclose(chain.transition(1.0), np.tile([0.9, 0.07, 0.03], (3, 1)))
    tenth = chain.transition(0.1)
    np.testing.assert_allclose(tenth[0, 0] ** 10, 0.9, atol=1e-14)
    np.testing.assert_allclose(tenth[:, 1] / tenth[:, 2], 7.0 / 3.0)
    np.testing.assert_allclose(chain.transition(0.0), np.tile([1.0, 0.0, 0.0], (3, 1)))
