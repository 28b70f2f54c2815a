"""exp of a row."""

import numpy as np

from sonar_imm.estimation.rows import exponentials


def row(values):
    values = np.array(values, float)
    out = np.empty_like(values)
    exponentials(values, np.empty_like(values), out)
    return out


def test_exponentials_are_those_of_the_library():
    values = np.concatenate([-np.logspace(-18, np.log10(699.0), 20_001), np.linspace(-2, 0, 9999)])
    exact = np.exp(values)
    assert (np.abs(row(values) - exact) <= 4e-16 * exact).all()
    assert row([0.0])[0] == 1.0


def test_what_is_impossible_is_zero():
    assert (row([-np.inf, np.nan, -701.0, -1e300]) == 0.0).all()


def test_a_row_gives_the_same_bits_however_it_is_cut():
    values = -np.random.default_rng(1).exponential(30.0, 101)
    whole = row(values)
    assert all(row([value])[0] == one for value, one in zip(values, whole))
