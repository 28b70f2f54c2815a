"""The Gauss-Markov step: vectors, and that steps compose."""

from helpers.sea_vectors import vectors
import pytest

from sonar_imm.estimation.gauss_markov import gauss_markov


def test_the_steps_of_the_vectors():
    v = vectors('gauss_markov')
    for dt, a, q in zip(v['dt'], v['out_a'], v['out_q']):
        assert gauss_markov(float(v['std']), float(v['time']), dt) == pytest.approx((a, q), 1e-9)


def test_steps_compose_and_keep_the_variance():
    whole, part = gauss_markov(2.0, 60.0, 10.0), gauss_markov(2.0, 60.0, 1.0)
    variance, fade = 0.0, 1.0
    for _ in range(10):
        variance, fade = part[0] ** 2 * variance + part[1], fade * part[0]
    assert (fade, variance) == pytest.approx(whole)
    assert part[0] ** 2 * 4.0 + part[1] == pytest.approx(4.0)
