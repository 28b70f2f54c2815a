# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import gamma

from sonar_imm.acoustics import loudness, variances


def noise_power(rng, bins, staves, *, fading=True):
    """Mean power of noise bins (bins,) in noise powers."""
    power = rng.gamma(staves, size=bins) / staves
    return power * rng.exponential(size=bins) if fading else power


@pytest.mark.parametrize('staves', [1, 2, 3, 8, 64])
def test_the_law_of_fading_noise_is_that_of_its_integral(staves):
    for level in (0.01, 0.5, 2.0, 9.0):
        exact, _ = quad(
            lambda z, level=level: np.exp(-z) * gamma.sf(staves * level / z, staves), 0.0, np.inf
        )
        assert loudness.noise_exceeds(level, staves) == pytest.approx(exact, rel=1e-6, abs=1e-12)
    assert loudness.noise_exceeds(0.0, staves) == 1.0
    assert 0.0 <= loudness.noise_exceeds(1e9, staves) < 1e-300


@pytest.mark.parametrize('staves', [2, 3, 8])
def test_levels_let_pass_as_much_noise_as_asked(staves):
    rng = np.random.default_rng(1)
    power = noise_power(rng, 500_000, staves).reshape(-1, 5)
    for false_alarm in (0.05, 0.01):
        level = loudness.loud_level(staves, 5, false_alarm)
        assert (power.mean(axis=1) > level).mean() == pytest.approx(false_alarm, rel=0.12)
    level = loudness.loud_level(staves, 1, 0.01)
    assert loudness.noise_exceeds(level, staves) == pytest.approx(0.01, rel=0.01)
    steady = noise_power(rng, 100_000, staves, fading=False).reshape(-1, 5).mean(axis=1)
    assert (steady > loudness.loud_level(staves, 5, 0.01)).mean() < 1e-3


def test_a_burst_is_none_of_the_floor_and_an_edge_is_no_burst():
    rng = np.random.default_rng(2)
    power = noise_power(rng, 400, 2)
    power[200:] *= 1e4  # the floor begins
    found = loudness.bursts(power)
    assert found[190:210].sum() <= 1
    power[[60, 61, 300]] = [1e3, 1e3, 1e7]
    assert loudness.bursts(power)[[60, 61, 300]].all()
    usable = np.ones(400, bool)
    loud = loudness.loud_bins(power, 5.0, bins=5, usable=usable)
    assert loud[210:].mean() > 0.95 and not loud[[60, 61, 300]].any()
    usable[350] = False
    assert not loudness.loud_bins(power, 5.0, bins=5, usable=usable)[350]


def test_a_burst_is_one_beside_the_twenty_bins_before_it_and_after_it():
    power = np.full(200, 1e4)
    power[80:121], power[100] = 1.0, 1e3
    assert np.flatnonzero(loudness.bursts(power)).tolist() == [100]
    power[86:97] = 1e4  # most of those before it
    assert not loudness.bursts(power).any()
    for first, alone in ((80, False), (81, True)):  # ten of those before it, nine
        power = np.ones(200)
        power[first:90], power[100] = 1e4, 1e3
        assert loudness.bursts(power)[100] == alone


def test_a_loud_stretch_that_is_not_coherent_is_a_diffuse_floor_and_a_spike_is_not():
    rng = np.random.default_rng(3)
    ratio, usable = 1e4 * noise_power(rng, 600, 8), np.ones(600, bool)
    ratio[:200] = noise_power(rng, 200, 8)
    silent = np.zeros(600, bool)
    silent[:200] = True  # a shadow
    silent[200:400] = rng.random(200) < 0.8  # a diffuse floor
    silent[400:] = rng.random(200) < 0.1  # spikes on a coherent one
    found = loudness.diffuse_bins(ratio, silent, usable)
    assert not found[:200].any() and found[215:385].mean() > 0.9 and not found[415:].any()


def test_noise_is_never_very_loud_20_db_are():
    incoherent, usable = np.ones(200, bool), np.ones(200, bool)
    assert not loudness.diffuse_bins(np.full(200, 90.0), incoherent, usable).any()
    assert loudness.diffuse_bins(np.full(200, 110.0), incoherent, usable).all()


def diffuse(rng, bins, staves, share, *, snr=1e4):
    def circular(*shape):
        return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) / np.sqrt(2.0)

    wave = np.sqrt(1.0 - share) * circular(bins, 1) * np.exp(0.7j * np.arange(staves))
    wave = wave + np.sqrt(share) * circular(bins, staves)
    fading = np.sqrt(rng.exponential(size=(bins, 1)))
    return fading * (np.sqrt(snr) * wave + circular(bins, staves))


@pytest.mark.parametrize('staves', [2, 8])
def test_the_share_that_differs_from_stave_to_stave_is_measured(staves):
    rng = np.random.default_rng(4)
    for share in (0.0, 0.1, 0.3):
        iq = diffuse(rng, 2000, staves, share)
        found = variances.decorrelation(iq, np.ones(2000, bool))
        # Two staves agree by chance in windows of eleven bins: they show too little.
        assert share * (0.5 if staves == 2 else 0.85) - 0.01 < found < share + 0.02
    iq[5], iq[7] = np.nan, 0.0
    chosen = np.isfinite(iq).all(axis=1) & (np.arange(2000) != 7)
    assert np.isfinite(variances.decorrelation(iq, chosen))
    assert np.isnan(variances.decorrelation(iq, np.zeros(2000, bool)))
