# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

import math

import numpy as np
from oracles.array_likelihood import gaussian_log_density, log_likelihood
from oracles.bin_likelihood import log_densities, log_likelihoods
import pytest
from scipy.integrate import quad
from scipy.special import kve

from sonar_imm.acoustics import array, laplace

STEP = array.phase_step(0.5)


def complex_normal(rng, *shape):
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / math.sqrt(2.0)


@pytest.mark.parametrize(
    'staves, q, value',
    [
        (8, 1.0, 5.7220742150),
        (8, 8.0, -9.8732948088),
        (8, 1e4, -234.5379989984),
        (4, 1.0, -0.4348135035),
    ],
)
def test_golden_values(staves, q, value):
    assert laplace.log_density(q, staves) == pytest.approx(value, abs=1e-9)


@pytest.mark.parametrize('staves', [2, 3, 4, 8, 16, 64])
@pytest.mark.parametrize('q', [0.3, 5.0, 200.0])
def test_the_law_is_the_mixture_it_is_derived_from(staves, q):
    # The same by integrating over the power z, without any Bessel function.
    peak = 0.5 * (math.sqrt(staves**2 + 4.0 * q) - staves)
    height = -peak - q / peak - staves * math.log(peak)

    def mixture(z):
        return math.exp(-z - q / z - staves * math.log(z) - height)

    total = quad(mixture, 0.0, peak)[0] + quad(mixture, peak, np.inf, limit=200)[0]
    assert laplace.log_density(q, staves) + math.log(2.0) == pytest.approx(
        math.log(total) + height, abs=1e-6
    )


@pytest.mark.parametrize('q', [0.1, 0.3])
def test_where_the_bessel_function_overflows_the_law_is_its_integral_still(q):
    log_u = np.linspace(-3.0, 8.0, 100_001)
    height = 199.0 * log_u - np.exp(log_u) - q * np.exp(-log_u)
    integral = np.exp(height - height.max()).sum() * (log_u[1] - log_u[0])
    expected = math.log(0.5 * integral) + height.max() - 199.0 * math.log(q)
    assert math.isinf(kve(199, 2.0 * math.sqrt(q)))
    assert laplace.log_density(q, 200) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize('staves', range(2, 17))
def test_both_laws_integrate_to_one(staves):
    # Over C^P in whitened coordinates: shells of area pi^P / Gamma(P) q^(P-1) dq, q = v^2.
    shell = staves * math.log(math.pi) - math.lgamma(staves) + math.log(2.0)
    constant = laplace.log_constant(staves, 0.0)
    gaussian = laplace.gaussian_log_constant(staves, 0.0)

    def total(density, rest):
        def shells(v):
            log_area = shell + (2 * staves - 1) * math.log(v)
            return math.exp(rest + float(density(v * v, staves)) + log_area)

        return quad(shells, 0.0, 10.0, limit=200)[0] + quad(shells, 10.0, 80.0, limit=200)[0]

    assert total(laplace.log_density, constant) == pytest.approx(1.0, abs=1e-8)
    assert total(gaussian_log_density, gaussian) == pytest.approx(1.0, abs=1e-8)


@pytest.mark.parametrize('constant', [laplace.log_constant, laplace.gaussian_log_constant])
def test_in_another_unit_both_laws_are_densities_too(constant):
    # Snapshots 3 times as large: |Gamma| is 9^P times, the volume around each too.
    change = constant(8, 5.0 + 8 * math.log(9.0)) - constant(8, 5.0)
    assert change == pytest.approx(-8 * math.log(9.0))


def test_extreme_values_stay_finite_and_ordered():
    q = np.geomspace(1e-300, 1e15, 2000)
    for staves in (2, 3, 8, 33, 64):
        f = laplace.log_density(q, staves)
        assert np.isfinite(f).all() and (np.diff(f) < 0.0).all()
        slope = laplace.log_density_slope(q, staves)
        assert np.isfinite(slope).all() and (slope <= 0.0).all()
    assert laplace.log_density(0.0, 8) == np.inf


def test_the_slope_is_the_derivative():
    ln_q = np.linspace(-8.0, 15.0, 200)
    for staves in (2, 5, 16, 64):
        ends = [laplace.log_density(np.exp(ln_q + d), staves) for d in (1e-5, -1e-5)]
        slope = laplace.log_density_slope(np.exp(ln_q), staves)
        assert np.allclose((ends[0] - ends[1]) / 2e-5, slope, rtol=1e-5)


@pytest.mark.parametrize('staves', [2, 3, 8, 17])
def test_the_form_is_that_of_the_covariance(staves):
    rng = np.random.default_rng(staves)
    y = complex_normal(rng, 4, staves)
    signal, noise = rng.uniform(0.1, 100.0, 4), rng.uniform(0.1, 10.0, 4)
    g = laplace.form_coefficients(y, signal, noise)
    for u in (-0.8, 0.0, 0.37):
        q = (g * np.exp(-1j * STEP * u * np.arange(staves))).sum(axis=1).real
        for n in range(4):
            a = array.steering(u, staves, 0.5)
            gamma = signal[n] * np.outer(a, a.conj()) + noise[n] * np.eye(staves)
            assert q[n] == pytest.approx((y[n].conj() @ np.linalg.solve(gamma, y[n])).real)
            determinant = staves * np.log(noise[n]) + np.log1p(staves * signal[n] / noise[n])
            assert determinant == pytest.approx(np.linalg.slogdet(gamma)[1])


@pytest.mark.parametrize('likelihood', laplace.LIKELIHOODS)
@pytest.mark.parametrize('staves', [2, 3, 4, 8, 16, 64])
def test_the_table_is_the_likelihood(staves, likelihood):
    q = np.geomspace(2.0**-20, 2.0**49.99, 20_000)
    out = log_densities(q, laplace.likelihood_table(staves, likelihood))
    if likelihood == 'gaussian':
        assert np.allclose(out, -q, rtol=1e-12)
        return
    root = np.sqrt(q)
    exact = np.log(kve(staves - 1, 2 * root)) - 2 * root + (1 - staves) * np.log(root)
    error = np.abs(out - exact) / np.maximum(1.0, np.abs(exact))
    finite = np.isfinite(exact)  # the Bessel function overflows in the first cells of many staves
    assert finite.mean() > 0.9 and error[finite].max() < 3e-7


def test_what_the_table_does_not_reach_is_held_at_its_end():
    table = laplace.likelihood_table(8)
    out = log_densities(np.array([0.0, -1.0, 1e-30, np.nan, 1e300]), table)
    assert (out[:4] == out[0]).all() and np.isfinite(out).all() and out[4] < -1e7
    for staves, likelihood in ((1, 'laplace'), (65, 'laplace'), (8, 'cauchy')):
        with pytest.raises(ValueError):
            laplace.likelihood_table(staves, likelihood)
    assert not table.flags.writeable


@pytest.mark.parametrize('likelihood', laplace.LIKELIHOODS)
@pytest.mark.parametrize('staves, spacing', [(2, 0.5), (5, 0.3), (8, 0.5), (8, -0.5), (64, 0.5)])
def test_the_likelihood_by_its_parts_is_that_of_the_definition(staves, spacing, likelihood):
    rng = np.random.default_rng(2)
    u = np.append(rng.uniform(-1.0, 1.0, 300), [np.nan, 1.0, -1.0])
    y, signal, noise = 3.0 * complex_normal(rng, staves), 40.0, 0.7
    out = log_likelihoods(
        u, spacing, laplace.form_coefficients(y, signal, noise), 0.0, np.empty(0, complex), 0.0,
        laplace.likelihood_table(staves, likelihood),
    )  # fmt: skip
    expected = log_likelihood(u, y, signal, noise, 2.0 * math.pi * spacing, likelihood)
    assert out[300] == expected[300] == -np.inf
    fine = np.arange(len(u)) != 300
    assert np.allclose(out[fine], expected[fine], rtol=3e-7, atol=1e-6)
