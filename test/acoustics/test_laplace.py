# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Directions of an array: steering, likelihoods, coherence against definitions, closed forms."""

import math

import numpy as np
from oracles import bin_likelihood as oracle
import pytest
from scipy.integrate import quad
from scipy.special import kve

from sonar_imm.acoustics import array, coherence, interference, laplace

STEP = array.phase_step(0.5)
TILT = math.radians(30.0)
STAVES, SPACING = 8, 0.5
SINES = np.array([[0.3, -0.2], [0.1, np.nan], [0.5, 0.55]])
VARIANCES = np.array([[5.0, 2.0], [3.0, 3.0], [0.0, 4.0]])
NOISE = np.array([1.0, 0.5, 2.0])


def circular(rng, *shape):
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


@pytest.mark.parametrize('staves', [2, 3, 8, 64])
@pytest.mark.parametrize('q', [0.3, 5.0, 200.0])
def test_the_law_is_the_mixture_it_is_derived_from(staves, q):
    # The same by integrating over the power z, without any Bessel function.
    peak = 0.5 * (math.sqrt(staves**2 + 4.0 * q) - staves)
    height = -peak - q / peak - staves * math.log(peak)

    def mixture(z):
        return math.exp(-z - q / z - staves * math.log(z) - height)

    total = quad(mixture, 0.0, peak)[0] + quad(mixture, peak, np.inf, limit=200)[0]
    found = laplace.log_density(q, staves) + math.log(2.0)
    assert found == pytest.approx(math.log(total) + height, abs=1e-6)


def test_where_the_bessel_function_overflows_the_law_is_its_integral_still():
    log_u, q = np.linspace(-3.0, 8.0, 100_001), 0.3
    height = 199.0 * log_u - np.exp(log_u) - q * np.exp(-log_u)
    integral = np.exp(height - height.max()).sum() * (log_u[1] - log_u[0])
    expected = math.log(0.5 * integral) + height.max() - 199.0 * math.log(q)
    assert math.isinf(kve(199, 2.0 * math.sqrt(q)))
    assert laplace.log_density(q, 200) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize('staves', [2, 3, 8, 16])
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
    assert total(lambda q, _: -q, gaussian) == pytest.approx(1.0, abs=1e-8)
    # Snapshots 3 times as large: |Gamma| is 9^P times, the volume around each too.
    larger = staves * math.log(9.0)
    for of in (laplace.log_constant, laplace.gaussian_log_constant):
        assert of(staves, 5.0 + larger) - of(staves, 5.0) == pytest.approx(-larger)


def test_extreme_values_stay_finite_and_ordered_and_the_slope_is_the_derivative():
    q, ln_q = np.geomspace(1e-300, 1e15, 2000), np.linspace(-8.0, 15.0, 200)
    for staves in (2, 3, 8, 64):
        f, slope = laplace.log_density(q, staves), laplace.log_density_slope(q, staves)
        assert np.isfinite(f).all() and (np.diff(f) < 0.0).all()
        assert np.isfinite(slope).all() and (slope <= 0.0).all()
        ends = [laplace.log_density(np.exp(ln_q + d), staves) for d in (1e-5, -1e-5)]
        slope = laplace.log_density_slope(np.exp(ln_q), staves)
        assert np.allclose((ends[0] - ends[1]) / 2e-5, slope, rtol=1e-5)
    assert laplace.log_density(0.0, 8) == np.inf


@pytest.mark.parametrize('staves', [2, 8, 64])
def test_the_table_is_the_likelihood(staves):
    q = np.geomspace(2.0**-20, 2.0**49.99, 20_000)
    gaussian = laplace.likelihood_table(staves, 'gaussian')
    assert np.allclose(oracle.log_densities(q, gaussian), -q, 1e-12)
    out, root = oracle.log_densities(q, laplace.likelihood_table(staves)), np.sqrt(q)
    exact = np.log(kve(staves - 1, 2 * root)) - 2 * root + (1 - staves) * np.log(root)
    error = np.abs(out - exact) / np.maximum(1.0, np.abs(exact))
    finite = np.isfinite(exact)  # the Bessel function overflows in the first cells of many staves
    assert finite.mean() > 0.9 and error[finite].max() < 3e-7


def test_what_the_table_does_not_reach_is_held_at_its_end():
    table = laplace.likelihood_table(8)
    out = oracle.log_densities(np.array([0.0, -1.0, 1e-30, np.nan, 1e300]), table)
    assert (out[:4] == out[0]).all() and np.isfinite(out).all() and out[4] < -1e7
    for staves, likelihood in ((1, 'laplace'), (65, 'laplace'), (8, 'cauchy')):
        with pytest.raises(ValueError):
            laplace.likelihood_table(staves, likelihood)
    assert not table.flags.writeable


@pytest.mark.parametrize('likelihood', laplace.LIKELIHOODS)
@pytest.mark.parametrize('staves, spacing', [(2, 0.5), (5, 0.3), (8, -0.5)])
def test_the_likelihood_by_its_parts_is_that_of_the_definition(staves, spacing, likelihood):
    rng = np.random.default_rng(2)
    u = np.append(rng.uniform(-1.0, 1.0, 300), [np.nan, 1.0, -1.0])
    y, signal, noise = 3.0 * circular(rng, staves), 40.0, 0.7
    out = oracle.log_likelihoods(
        u, spacing, laplace.form_coefficients(y, signal, noise), 0.0, np.empty(0, complex), 0.0,
        laplace.likelihood_table(staves, likelihood),
    )  # fmt: skip
    expected = oracle.log_likelihood(u, y, signal, noise, 2.0 * math.pi * spacing, likelihood)
    assert out[300] == expected[300] == -np.inf
    fine = np.arange(len(u)) != 300
    assert np.allclose(out[fine], expected[fine], rtol=3e-7, atol=1e-6)


@pytest.mark.parametrize('tilt', [-0.4, TILT, 1.2])
def test_the_direction_sine_is_the_sine_of_the_angle(tilt):
    rng = np.random.default_rng(0)
    r = rng.uniform(5.0, 80.0, 1000)
    D = r * rng.uniform(-1.0, 1.0, 1000)
    angle = np.arcsin(D / r) - tilt
    assert np.allclose(array.direction_sine(D, r, tilt), np.sin(angle), atol=1e-14)
    assert np.allclose(array.angle_of_depth(D, r, tilt), angle, atol=1e-14)
    assert np.allclose(array.depth_of_angle(angle, r, tilt), D, atol=1e-12)
    assert np.allclose(np.hypot(array.across_track(D, r), D), r)


def test_the_phase_is_that_of_the_path_to_each_stave():
    D, r, wavelength = 15.0, 4e4, 0.01  # so far away that the wave is plane
    echo = np.array([math.sqrt(r**2 - D**2), D])  # outward, down
    staves = np.arange(8)[:, None] * 0.5 * wavelength * [-math.sin(TILT), math.cos(TILT)]
    path = np.linalg.norm(echo - staves, axis=1)
    a = array.steering(array.direction_sine(D, r, TILT), 8, 0.5)
    assert np.allclose(a, np.exp(2j * np.pi * (r - path) / wavelength), atol=1e-6)
    # The axis is orthogonal to where the array looks.
    assert staves[1] @ [math.cos(TILT), math.sin(TILT)] == pytest.approx(0.0, abs=1e-18)


def test_a_floor_beyond_the_range_is_impossible():
    D = np.array([15.0 + 1e-9, -15.1, 15.0, np.nan, np.inf])
    sine, angle = (of(D, 15.0, TILT) for of in (array.direction_sine, array.angle_of_depth))
    for values in (sine, angle, array.across_track(D, 15.0)):
        assert np.isnan(values).tolist() == [True, True, False, True, True]
    assert np.isnan(array.direction_sine(1.0, 0.0, TILT))


def test_conjugation_turns_the_phase_round():
    u = np.linspace(-0.9, 0.9, 7)
    straight, turned = (array.steering(u, 5, 0.4, conjugate=c) for c in (False, True))
    assert straight.shape == (7, 5)
    assert np.allclose(turned, straight.conj()) and np.allclose(turned, straight[::-1])
    assert array.phase_step(0.4) == -array.phase_step(0.4, conjugate=True) == 0.8 * math.pi


def test_the_mirror_of_the_surface():
    D, r, surface = np.array([15.0, 15.0]), np.array([40.0, 20.0]), 3.0
    sines = array.multipath_sines(D, r, TILT, surface)
    assert sines.shape == (2, 2)
    assert np.allclose(sines[:, 0], np.sin(np.arcsin(-surface / r) - TILT))
    # The floor appears in the mirror as far above the surface as it lies below.
    assert sines[0, 1] == pytest.approx(math.sin(math.asin(-(3.0 + 18.0) / 40.0) - TILT))
    assert np.isnan(sines[1, 1])


def test_the_grid_covers_all_that_can_be_told_apart():
    assert array.largest_sine(0.25) == 1.0 and array.largest_sine(2.0) == 0.25
    for staves, spacing in ((2, 0.5), (8, 0.5), (64, 0.5), (8, 0.2), (2, 3.66)):
        grid = array.direction_grid(staves, spacing)
        assert grid[-1] == -grid[0] == array.largest_sine(spacing)
        assert np.diff(grid).max() <= 1.0 / (8 * staves * spacing) + 1e-12


@pytest.fixture
def scene():
    y = circular(np.random.default_rng(0), 3, STAVES)
    return y, interference.noise_covariance(SINES, VARIANCES, NOISE, STAVES, STEP)


def test_the_covariance_is_the_sum_of_its_parts(scene):
    y, covariance = scene
    a, b = (array.steering(u, STAVES, SPACING) for u in (0.3, -0.2))
    first = 5.0 * np.outer(a, a.conj()) + 2.0 * np.outer(b, b.conj()) + np.eye(STAVES)
    assert np.allclose(covariance[0], first)
    a, b = (array.steering(u, STAVES, SPACING) for u in (0.1, 0.55))
    assert np.allclose(covariance[1], 3.0 * np.outer(a, a.conj()) + 0.5 * np.eye(STAVES))
    assert np.allclose(covariance[2], 4.0 * np.outer(b, b.conj()) + 2.0 * np.eye(STAVES))
    form = interference.interference_form(y, covariance)
    assert np.allclose(form.log_determinant, np.linalg.slogdet(covariance)[1])


@pytest.mark.parametrize('likelihood', laplace.LIKELIHOODS)
def test_the_likelihood_by_its_parts_is_that_of_linear_algebra(scene, likelihood):
    y, covariance = scene
    form = interference.interference_form(y, covariance)
    u, signal = np.append(np.linspace(-1.0, 1.0, 41), np.nan), 7.0
    for n in range(3):
        out = oracle.log_likelihoods(
            u, SPACING, -signal * form.beam[n], form.base[n], form.spread[n], signal,
            laplace.likelihood_table(STAVES, likelihood),
        )  # fmt: skip
        known = u, y[n], signal, covariance[n], STEP, likelihood
        expected = oracle.interfered_log_likelihood(*known)
        assert out[-1] == expected[-1] == -np.inf
        assert np.allclose(out[:-1], expected[:-1], rtol=3e-7, atol=1e-6)


def test_it_is_the_maximum_over_all_directions():
    iq = circular(np.random.default_rng(0), 400, 8)
    gamma, sine = coherence.coherence(iq, 0.5)
    grid = np.linspace(-1.0, 1.0, 4001)
    beams = np.abs(iq @ array.steering(grid, 8, 0.5).conj().T) ** 2
    exact = beams.max(axis=1) / (8.0 * np.square(np.abs(iq)).sum(axis=1))
    assert np.abs(gamma - exact).max() < 0.01
    inside = np.abs(grid[beams.argmax(axis=1)]) < 0.95
    assert np.median(np.abs(sine - grid[beams.argmax(axis=1)])[inside]) < 1e-3


def test_a_plane_wave_is_fully_coherent_whatever_its_level():
    u = np.linspace(-0.95, 0.95, 101)
    iq = np.geomspace(1e-9, 1e9, 101)[:, None] * array.steering(u, 8, 0.5)
    gamma, sine = coherence.coherence(iq.astype(np.complex64), 0.5)
    assert gamma.min() > 0.999 and gamma.max() <= 1.0
    assert np.abs(sine - u).max() < 2e-3
    turned = coherence.coherence(iq, 0.5, conjugate=True)[1]
    assert np.abs(turned + u).max() < 2e-3


def test_silent_and_broken_bins_have_none():
    iq = circular(np.random.default_rng(1), 4, 8)
    iq[0], iq[1, 3], iq[2, 0] = 0.0, np.nan, np.inf
    gamma, sine = coherence.coherence(iq, 0.5)
    assert np.isnan(gamma).tolist() == np.isnan(sine).tolist() == [True, True, True, False]
    assert coherence.silent_bins(gamma, 8)[:3].all()


@pytest.mark.parametrize('staves, spacing', [(2, 0.5), (8, 0.3), (24, 0.5)])
def test_noise_passes_as_often_as_the_formula_says(staves, spacing):
    gamma, _ = coherence.coherence(circular(np.random.default_rng(2), 60_000, staves), spacing)
    for probability in (0.05, 0.01):
        level = coherence.coherence_threshold(staves, 1, probability, spacing)
        rate = coherence.false_alarm_probability(level, staves, spacing)
        assert rate == pytest.approx(probability)
        assert (gamma > level).mean() == pytest.approx(probability, rel=0.15, abs=2e-3)
    # With |x0|^2 uniform, gamma of two is 1/2 + |x0 x1|: Pr(gamma > t) = 2 sqrt(t (1 - t)).
    t = np.linspace(0.51, 1.0, 50)
    expected = 2.0 * np.sqrt(t * (1.0 - t))
    assert np.allclose(coherence.false_alarm_probability(t, 2), expected)


@pytest.mark.parametrize('staves', [2, 8])
def test_means_of_bins_pass_at_most_as_often(staves):
    gamma, _ = coherence.coherence(circular(np.random.default_rng(3), 100_000, staves), 0.5)
    means = gamma.reshape(-1, coherence.GATE_BINS).mean(axis=1)
    level = coherence.coherence_threshold(staves, coherence.GATE_BINS, 0.01)
    assert 0.003 < (means > level).mean() < 0.013


def test_a_shadow_is_silent_and_an_echo_is_not():
    rng = np.random.default_rng(4)
    signal = np.where((np.arange(2000) // 200) % 2 == 0, 10.0, 0.0)  # 10 dB, shadows between
    fading = rng.exponential(size=2000)
    iq = circular(rng, 2000, 8) / np.sqrt(2.0)
    iq += np.sqrt(signal / 2)[:, None] * circular(rng, 2000, 1) * array.steering(0.3, 8, 0.5)
    silent = coherence.silent_bins(coherence.coherence(np.sqrt(fading)[:, None] * iq, 0.5)[0], 8)
    assert silent[signal == 0.0].mean() > 0.99
    # A coherent echo fades below the noise now and then.
    assert silent[signal > 0.0].mean() < 0.3


def test_for_two_staves_the_mean_decides():
    iq = circular(np.random.default_rng(5), 3000, 2)
    wave = 20.0 * circular(np.random.default_rng(6), 3000, 1) * array.steering(0.3, 2, 0.5)
    gammas = (coherence.coherence(each, 0.5)[0] for each in (iq, iq + wave))
    silent, heard = (coherence.silent_bins(gamma, 2).mean() for gamma in gammas)
    assert silent > 0.99 and heard < 0.3


def test_coherence_beside_an_interferer_is_that_of_what_it_leaves():
    rng = np.random.default_rng(8)
    iq = circular(rng, 4000, 8) + 30.0 * circular(rng, 4000, 1) * array.steering(-0.6, 8, 0.5)
    assert not coherence.silent_bins(coherence.coherence(iq, 0.5)[0], 8)[10:].all()
    known = np.full((4000, 1), -0.6), 1800.0, np.full(4000, 2.0), 8, array.phase_step(0.5)
    R = interference.noise_covariance(*known)

    def silent(samples):
        form = interference.interference_form(samples, R)
        return coherence.silent_bins(interference.coherence_beside(form, 0.5), 8)

    assert silent(iq).mean() > 0.98
    iq += 20.0 * circular(rng, 4000, 1) * array.steering(0.2, 8, 0.5)
    assert silent(iq).mean() < 0.1
    nothing = interference.interference_form(np.zeros((1, 8)), np.eye(8)[None])
    assert np.isnan(interference.coherence_beside(nothing, 0.5)).all()


def test_a_peak_is_refined_where_the_spectrum_bends_down_and_nowhere_else():
    grid = np.linspace(-1.0, 1.0, 17)  # its steps are exact in binary
    at = np.array([-0.31, 0.0, 0.27])
    peak, place = coherence.refined_peak(0.9 - (grid - at[:, None]) ** 2, grid)
    np.testing.assert_allclose(peak, 0.9, rtol=1e-12)
    np.testing.assert_allclose(place, at, atol=1e-12)
    slope, level, hollow = 0.5 + 0.25 * grid, np.full(17, 0.5), 0.1 + grid**2
    peak, place = coherence.refined_peak(np.array([slope, level, hollow]), grid)
    inside = [grid[-2], grid[1], grid[1]]
    np.testing.assert_array_equal(place, inside)
    np.testing.assert_allclose(peak, [slope[-2], 0.5, hollow[1]])
