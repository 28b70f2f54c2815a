# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

import numpy as np
import pytest

from sonar_imm.acoustics import array, coherence, interference, laplace, wave_kernels


def noise(rng, *shape):
    return rng.normal(size=shape) + 1j * rng.normal(size=shape)


def test_it_is_the_maximum_over_all_directions():
    iq = noise(np.random.default_rng(0), 400, 8)
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
    iq = noise(np.random.default_rng(1), 4, 8)
    iq[0], iq[1, 3], iq[2, 0] = 0.0, np.nan, np.inf
    gamma, sine = coherence.coherence(iq, 0.5)
    assert np.isnan(gamma).tolist() == np.isnan(sine).tolist() == [True, True, True, False]
    assert coherence.silent_bins(gamma, 8)[:3].all()


@pytest.mark.parametrize('staves, spacing', [(2, 0.5), (3, 0.5), (8, 0.5), (8, 0.3), (24, 0.5)])
def test_noise_passes_as_often_as_the_formula_says(staves, spacing):
    gamma, _ = coherence.coherence(noise(np.random.default_rng(2), 60_000, staves), spacing)
    for probability in (0.05, 0.01):
        level = coherence.coherence_threshold(staves, 1, probability, spacing)
        assert coherence.false_alarm_probability(level, staves, spacing) == pytest.approx(
            probability
        )
        assert (gamma > level).mean() == pytest.approx(probability, rel=0.15, abs=2e-3)


@pytest.mark.parametrize('staves', [2, 4, 8, 32])
def test_means_of_bins_pass_at_most_as_often(staves):
    gamma, _ = coherence.coherence(noise(np.random.default_rng(3), 100_000, staves), 0.5)
    means = gamma.reshape(-1, coherence.GATE_BINS).mean(axis=1)
    level = coherence.coherence_threshold(staves, coherence.GATE_BINS, 0.01)
    assert 0.003 < (means > level).mean() < 0.013


def test_thresholds_for_eight_staves():
    assert coherence.coherence_threshold(8) == pytest.approx(0.782, abs=0.002)
    assert coherence.coherence_threshold(8, coherence.GATE_BINS) == pytest.approx(0.563, abs=0.002)


def test_the_law_for_two_staves_is_exact():
    # gamma = 1/2 + |x0 x1| with |x0|^2 uniform: Pr(gamma > t) = 2 sqrt(t (1 - t)).
    t = np.linspace(0.51, 1.0, 50)
    expected = 2.0 * np.sqrt(t * (1.0 - t))
    assert np.allclose(coherence.false_alarm_probability(t, 2), expected)


def test_a_shadow_is_silent_and_an_echo_is_not():
    rng = np.random.default_rng(4)
    signal = np.where((np.arange(2000) // 200) % 2 == 0, 10.0, 0.0)  # 10 dB, shadows between
    fading = rng.exponential(size=2000)
    iq = noise(rng, 2000, 8) / np.sqrt(2.0)
    iq += np.sqrt(signal / 2)[:, None] * noise(rng, 2000, 1) * array.steering(0.3, 8, 0.5)
    silent = coherence.silent_bins(coherence.coherence(np.sqrt(fading)[:, None] * iq, 0.5)[0], 8)
    assert silent[signal == 0.0].mean() > 0.99
    # A coherent echo fades below the noise now and then.
    assert silent[signal > 0.0].mean() < 0.3


def test_for_two_staves_the_mean_decides():
    iq = noise(np.random.default_rng(5), 3000, 2)
    silent = coherence.silent_bins(coherence.coherence(iq, 0.5)[0], 2)
    assert silent.mean() > 0.99
    iq += 20.0 * noise(np.random.default_rng(6), 3000, 1) * array.steering(0.3, 2, 0.5)
    silent = coherence.silent_bins(coherence.coherence(iq, 0.5)[0], 2)
    assert silent.mean() < 0.3


def test_the_compiled_peaks_are_those_of_numpy():
    iq = noise(np.random.default_rng(7), 300, 8)
    gamma, sine = coherence.coherence(iq, 0.5)
    form = laplace.autocorrelation(iq)
    form[:, 1:] *= 2.0
    grid = array.direction_grid(8, 0.5)
    cosine, sines = np.cos(np.pi * grid), np.sin(np.pi * grid)
    height, place = np.empty(300), np.empty(300)
    wave_kernels.beam_peaks(
        form, cosine, sines, np.empty(len(grid)), np.empty(len(grid)), height, place
    )
    power = np.square(np.abs(iq)).sum(axis=1)
    assert np.allclose(height / (8.0 * power), gamma, atol=1e-12)
    assert np.allclose(grid[0] + place * (grid[1] - grid[0]), sine, atol=1e-9)


def test_coherence_beside_an_interferer_is_that_of_what_it_leaves():
    rng = np.random.default_rng(8)
    iq = noise(rng, 4000, 8) + 30.0 * noise(rng, 4000, 1) * array.steering(-0.6, 8, 0.5)
    assert not coherence.silent_bins(coherence.coherence(iq, 0.5)[0], 8)[10:].all()
    step = array.phase_step(0.5)

    def silent(samples):
        R = interference.noise_covariance(
            np.full((4000, 1), -0.6), 1800.0, np.full(4000, 2.0), 8, step
        )
        form = interference.interference_form(samples, R)
        return coherence.silent_bins(interference.coherence_beside(form, 0.5), 8)

    assert silent(iq).mean() > 0.98
    iq += 20.0 * noise(rng, 4000, 1) * array.steering(0.2, 8, 0.5)
    assert silent(iq).mean() < 0.1
    assert np.isnan(
        interference.coherence_beside(
            interference.interference_form(np.zeros((1, 8)), np.eye(8)[None]), 0.5
        )
    ).all()


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
