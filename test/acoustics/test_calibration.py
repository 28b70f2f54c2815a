# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The staves of an array from its echoes: against vectors made independently, against errors that
are put in, and the law of the echoes with a noise for each stave against its covariance."""

import math
from pathlib import Path

import numpy as np
import pytest

from sonar_imm.acoustics import array
from sonar_imm.acoustics.calibration import calibrate, Calibration
from sonar_imm.acoustics.coherence import coherence
from sonar_imm.acoustics.laplace import form_coefficients

VECTORS = Path(__file__).parents[1] / 'vectors' / 'bathymetry_by_default' / 'array.npz'
EVERY = np.ones(1200, bool)


def circular(rng, *shape):
    return (rng.normal(size=shape) + 1j * rng.normal(size=shape)) * math.sqrt(0.5)


def echoes(staves=8, *, seed=1, bins=1200, spacing=0.5, decibels=(30.0, 10.0), noise=1.0):
    """Plane waves from directions that wander, and noise of 1, or of `noise` (P,)."""
    rng = np.random.default_rng(seed)
    sine = 0.6 * np.sin(np.linspace(0.0, 4.0, bins)) + 0.05 * rng.normal(size=bins)
    level = 10.0 ** (np.linspace(*decibels, bins) / 20.0)[:, None]
    y = level * circular(rng, bins, 1) * array.steering(sine, staves, spacing)
    y += np.sqrt(noise) * circular(rng, bins, staves)
    return y * np.sqrt(rng.exponential(size=(bins, 1)))


def measured(iq, spacing=0.5, noise=1.0):
    known = None if noise is None else np.full(len(iq), noise)
    return calibrate(iq, np.ones(len(iq), bool), spacing, known)


def without_line(phase, live):
    place = np.arange(len(phase))
    return phase - np.polyval(np.polyfit(place[live], phase[live], 1), place)


def test_gain_phase_and_what_is_live_are_those_of_the_vectors():
    with np.load(VECTORS) as case:
        live, phase = case['live'], case['phase']
        true = case['gain_true'] / np.median(case['gain_true'][live])
        iq = case['iq'][..., 0].astype(float) + 1j * case['iq'][..., 1].astype(float)
        found = [measured(ping) for ping in iq]
        for each in found:
            assert (each.live == live).all() and each.bins > 700
            assert np.degrees(np.abs(each.phase - phase)[live]).max() < 0.6
            assert each.gain[live] == pytest.approx(true[live], rel=0.025)
            assert each.coherence[live].min() > 0.97 and each.coherence[~live].max() < 0.35
            # The vectors have the root mean square, here it is that of phases beside a line.
            tilt = float(case['phase_tilt']) * math.sqrt(7.0 / 3.0)
            assert each.sine_std == pytest.approx(tilt, rel=0.03)
        # To the reach of the vectors, of three pings.
        assert np.mean([c.gain[live] for c in found], axis=0) == pytest.approx(
            true[live], rel=0.01
        )
        off = np.mean([c.phase for c in found], axis=0) - phase
        assert np.degrees(np.abs(off[live])).max() < 0.3


@pytest.mark.parametrize('staves, spacing', [(4, 0.5), (8, 2.0), (8, 0.2), (17, 0.5)])
@pytest.mark.parametrize('noise', [1.0, None])
def test_an_exact_array_stays_as_it_is_to_the_bit(staves, spacing, noise):
    for seed in range(4):
        iq = echoes(staves, seed=seed, spacing=spacing)
        found = measured(iq, spacing, noise)
        assert found.is_exact and found.apply(iq) is iq and found.weights is None
        assert found.level == found.mean_noise == 1.0 and found.sine_std == found.log_volume == 0.0
        assert not found.no_wave.any() and found.bins > 0


def test_gains_and_phases_are_measured_and_taken_off():
    rng = np.random.default_rng(3)
    gain, phase = np.exp(0.3 * rng.normal(size=8)), 0.3 * rng.normal(size=8)
    gain /= np.median(gain)
    iq = echoes()
    found = measured(iq * gain * np.exp(1j * phase))
    assert found.live.all() and found.gain == pytest.approx(gain, rel=0.02)
    rest = without_line(found.phase - phase, found.live)
    assert np.abs(rest).max() < math.radians(0.7)
    turned = np.median(np.abs(found.apply(iq * gain * np.exp(1j * phase))) / np.abs(iq), axis=0)
    assert turned == pytest.approx(1.0, rel=0.02)
    wide = 2.0 * math.pi * 0.5 * math.sqrt(42.0)
    assert found.sine_std == pytest.approx(math.sqrt(np.sum(found.phase**2) / 4.0) / wide)


def test_a_phase_that_grows_evenly_is_a_tilt_and_stays():
    iq = echoes() * np.exp(0.1j * np.arange(8))
    assert measured(iq).is_exact


@pytest.mark.parametrize('stave', [0, 3, 7])
def test_dead_deaf_and_inverted_staves_are_found(stave):
    iq, others = echoes(), np.arange(8) != stave
    dead, deaf, inverted = iq.copy(), iq.copy(), iq.copy()
    dead[:, stave] = 0.0
    deaf[:, stave] = 10.0 * circular(np.random.default_rng(5), len(iq))
    inverted[:, stave] *= -1.0
    for broken in (dead, deaf):
        found = measured(broken)
        assert (found.live == others).all() and (found.apply(broken)[:, stave] == 0.0).all()
        assert found.count == 7 and found.weights.sum() == pytest.approx(7.0)
        assert found.power(broken)[0] == pytest.approx(np.mean(np.abs(broken[0, others]) ** 2))
    found = measured(inverted)
    assert found.live.all() and abs(found.phase[stave]) > math.radians(179.0)
    assert np.abs(found.phase[others]).max() < math.radians(1.0)
    assert found.apply(inverted) == pytest.approx(iq, rel=0.1, abs=0.1)


@pytest.mark.parametrize('pairs', [((2, 3),), ((1, 6),), ((0, 1), (5, 7))])
def test_exchanged_staves_are_put_back(pairs):
    order = np.arange(8)
    for a, b in pairs:
        order[[a, b]] = order[[b, a]]
    iq = echoes()
    found = measured(iq[:, order])
    assert (found.order == order).all() and not found.no_wave.any()
    assert (found.apply(iq[:, order]) == iq).all()


def test_a_stave_at_another_place_is_named_and_not_exchanged():
    iq = echoes()
    rng = np.random.default_rng(2)
    iq[:, 4] *= np.exp(0.9j * rng.normal(size=len(iq)))
    found = measured(iq)
    assert np.flatnonzero(found.no_wave).tolist() == [4]
    assert (found.order == np.arange(8)).all() and found.live.all()


def test_the_noise_of_each_stave_is_measured():
    true = np.array([1.0, 1.0, 4.0, 1.0, 1.0, 1.0, 10.0, 1.0])
    found = [measured(echoes(seed=seed, noise=true)) for seed in range(4)]
    noise = np.exp(np.mean([np.log(each.noise) for each in found], axis=0))
    assert noise == pytest.approx(true, rel=0.15)
    quiet = np.flatnonzero(true == 1.0)
    assert all(each.noise[quiet] == pytest.approx(1.0, rel=2e-3) for each in found)
    one = found[0]
    assert one.weights.sum() == pytest.approx(8.0)
    assert one.level == pytest.approx(8.0 / np.sum(1.0 / one.noise))
    assert one.log_volume == pytest.approx(-np.log(one.weights).sum())


def test_gains_before_a_common_noise_leave_the_stated_noise_to_the_median_stave():
    gain = np.array([1.0, 1.0, 0.4, 1.0, 1.0, 1.0, 1.0, 2.0])
    noise = 1.0 / gain**2
    found = measured(echoes(noise=noise, seed=4) * gain)
    assert found.noise == pytest.approx(noise, rel=0.3) and found.gain == pytest.approx(gain, 0.03)
    assert np.median(found.noise * found.gain**2) == pytest.approx(1.0, rel=2e-3)


def test_what_shows_no_array_leaves_it_alone():
    rng = np.random.default_rng(8)
    noise = 10.0 * circular(rng, 1200, 8)
    few = echoes()
    few[45:] = 0.0
    turn = np.exp(1.5j * np.arange(8))
    many_ways = echoes() + turn * echoes(seed=2) + turn.conj() * echoes(seed=3)
    for iq in (noise, few, many_ways, echoes(3)):
        assert measured(iq).is_exact and measured(iq).weights is None
    assert calibrate(noise, EVERY, 0.5, None).is_exact


@pytest.mark.parametrize('dead', [(), (2,), (0, 5)])
def test_the_form_with_weights_is_that_of_the_covariance(dead):
    rng = np.random.default_rng(6)
    staves, signal = 7, 3.7
    live = ~np.isin(np.arange(staves), dead)
    noise = np.where(live, rng.uniform(0.3, 4.0, staves), 1.0)
    exact = Calibration.exact(staves)
    one = Calibration(
        live, exact.gain, exact.phase, exact.coherence, noise, exact.order, exact.no_wave
    )
    y = np.where(live, circular(rng, 5, staves), 0.0)
    step = array.phase_step(0.5)
    level = np.full(5, one.level)
    g = form_coefficients(y, np.full(5, signal), level, one.weights)
    for u in (-0.8, 0.1, 0.6):
        a = np.exp(1j * step * u * np.arange(staves))[live]
        gamma = signal * np.outer(a, a.conj()) + np.diag(noise[live])
        q = np.einsum('tp,pq,tq->t', y[:, live].conj(), np.linalg.inv(gamma), y[:, live]).real
        found = (g * np.exp(-1j * step * u * np.arange(staves))).sum(axis=1).real
        assert found == pytest.approx(q, rel=1e-10)
        size = one.count * math.log(one.level) + math.log1p(one.count * signal / one.level)
        assert size + one.log_volume == pytest.approx(np.linalg.slogdet(gamma)[1])


def test_coherence_with_weights_is_that_of_the_live_staves():
    iq = echoes(bins=300)
    gamma, sine = coherence(iq[:, :6], 0.5)
    iq[:, 6:] = 0.0
    weights = np.array([1.0] * 6 + [0.0] * 2)
    other, there = coherence(iq, 0.5, weights=weights)
    # The grid of eight staves is finer than that of six.
    assert other == pytest.approx(gamma, abs=2e-3) and there == pytest.approx(sine, abs=0.02)
