# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Powers of echoes and noise, and the staves of an array from its echoes: against vectors made
independently, the scene of the paper, and errors that are put in."""

from itertools import product
import math

from attrs import evolve
from helpers.vector_files import load_vectors
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import gamma

from sonar_imm.acoustics import array, loudness, variances
from sonar_imm.acoustics.calibration import calibrate, Calibration
from sonar_imm.acoustics.coherence import coherence
from sonar_imm.acoustics.laplace import form_coefficients
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate, snr


@pytest.fixture(scope='module')
def pings():
    scene = simulate(scenario('paper', {'pings': 12}), 7)
    return [entry.measurement for entry in scene.measurements]


def test_moving_mean_over_usable_rows_only():
    values = np.array([1.0, 2.0, np.nan, 4.0, 100.0, 6.0])
    usable = np.array([True, True, False, True, False, True])
    assert variances.moving_mean(values, 1, usable).tolist() == [1.5, 1.5, 3.0, 4.0, 5.0, 6.0]
    assert np.isnan(variances.moving_mean(values, 0, usable)).tolist() == (~usable).tolist()
    square = np.arange(12.0).reshape(4, 3)
    expected = [square[max(k - 2, 0) : k + 3].mean(axis=0) for k in range(4)]
    assert np.allclose(variances.moving_mean(square, 2), expected)
    assert variances.moving_mean(1j * values[:2], 5).tolist() == [1.5j, 1.5j]


def test_which_bins_are_usable():
    iq = np.ones((5, 4), np.complex64)
    iq[0, 1], iq[1, 3], iq[2], iq[3] = np.nan, complex(0.0, np.inf), 0.0, 1e30
    assert variances.usable_bins(iq).tolist() == [False, False, False, False, True]


def test_the_signal_is_known_to_two_decibels(pings):
    config = scenario('paper')
    found = [
        variances.signal_variance(variances.mean_power(ping.iq), 1.0) / snr(config, ping.range)
        for ping in pings
    ]
    decibels = 10.0 * np.log10(np.concatenate(found))
    assert abs(decibels.mean()) < 0.5 and decibels.std() < 2.0
    blind = [variances.blind_noise_variance(ping.iq) for ping in pings]
    assert np.abs(10.0 * np.log10(blind)).max() < 2.0
    assert np.isnan(variances.blind_noise_variance(pings[0].iq[:5]))


def test_silence_leaves_a_floor_and_spoilt_bins_do_not_count(pings):
    power = variances.mean_power(pings[0].iq)
    floor = variances.signal_variance(power, np.full(len(power), 1e9))
    assert (floor == variances.LEAST_SNR * 1e9).all()
    clean, spoilt, usable = variances.signal_variance(power, 1.0), power.copy(), power > 0.0
    spoilt[500], usable[500] = np.nan, False
    found = variances.signal_variance(spoilt, 1.0, usable=usable)
    assert np.isfinite(found).all() and np.abs(10.0 * np.log10(found / clean)).max() < 6.0
    assert (found[:490] == clean[:490]).all()


def test_noise_from_the_water_column():
    config = scenario('water_column', {'pings': 1, 'noise_variance': 3.0})
    ping = simulate(config, 3).measurements[0].measurement
    assert ping.noise_variance is None
    assert variances.noise_variance(ping.iq, ping.range < 14.0) == pytest.approx(3.0, rel=0.2)
    assert np.isnan(variances.noise_variance(ping.iq, ping.range < 0.0))


def test_blind_noise_is_that_beside_one_echo_which_takes_a_share_of_it():
    rng = np.random.default_rng(6)
    iq = circular(rng, 20_000, 6)
    iq += 30.0 * circular(rng, 20_000, 1) * np.exp(0.4j * np.arange(6))
    iq *= np.sqrt(rng.exponential(size=(20_000, 1)))
    for half_width in (2, 7):
        assert variances.blind_noise_variance(iq, half_width) == pytest.approx(1.0, rel=0.06)


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('unit', [1e-30, 3.0, 1e17])
def test_the_unit_of_samples_changes_no_decorrelation(unit):
    """Samples come in single precision, whose range their fourth powers leave."""
    rng, every = np.random.default_rng(5), np.ones(60, bool)
    iq = np.sqrt(2.0) * (circular(rng, 60, 1) + 0.5 * circular(rng, 60, 4))
    iq[20:40] = 0.0  # silence says nothing
    known, found = (
        variances.decorrelation((each * iq).astype(np.complex64), every) for each in (1.0, unit)
    )
    assert 0.05 < known < 0.5 and found == pytest.approx(known, rel=1e-4)
    assert np.isnan(variances.decorrelation(0.0 * iq, every))


def fading_noise(rng, bins, staves):
    noise = rng.normal(size=(bins, staves, 2)).view(np.complex128)[..., 0]
    return noise * np.sqrt(rng.exponential(size=(bins, 1)))


def test_loud_stretches_of_the_water_are_no_noise():
    noise, quiet = fading_noise(np.random.default_rng(3), 400, 4), np.arange(400) < 320
    assert (variances.quiet_stretches(noise, quiet) == quiet).all()
    spoilt = noise.copy()
    spoilt[:60] *= 1e3  # the transmit pulse
    spoilt[200:205] *= 30.0  # a target
    kept = variances.quiet_stretches(spoilt, quiet)
    assert not kept[:60].any() and not kept[200:205].any() and not kept[320:].any()
    assert kept.sum() > 200
    level = variances.noise_variance(spoilt, kept)
    assert level == pytest.approx(variances.noise_variance(noise, quiet), rel=0.15)
    spoilt[:224] *= 30.0  # what rings for most of the column
    kept = variances.quiet_stretches(spoilt, quiet)
    assert not kept[:224].any() and kept[224:320].all()


def test_a_water_column_of_fading_noise_is_kept_whole():
    rng = np.random.default_rng(4)
    for _, bins, staves in product(range(30), (40, 150, 1500), (2, 8)):
        noise = fading_noise(rng, bins, staves)
        assert variances.quiet_stretches(noise, np.ones(bins, bool)).all()


@pytest.mark.parametrize('apart, differ', [(5, True), (6, False)])
def test_a_bin_is_compared_with_the_five_on_either_side_of_it(apart, differ):
    """One bin by itself agrees with itself; two of other directions do not agree."""
    chosen = np.zeros(30, bool)
    chosen[[10, 10 + apart]] = True
    iq = np.ones((30, 4), complex)
    iq[10] = np.exp(2.0j * np.arange(4))
    found = variances.decorrelation(iq, chosen)
    assert found > 0.1 if differ else found == pytest.approx(0.0, abs=1e-9)


def noise_power(rng, bins, staves, *, fading=True):
    """Mean power of noise bins (bins,) in noise powers."""
    power = rng.gamma(staves, size=bins) / staves
    return power * rng.exponential(size=bins) if fading else power


@pytest.mark.parametrize('staves', [1, 8, 64])
def test_the_law_of_fading_noise_is_that_of_its_integral(staves):
    for level in (0.01, 0.5, 2.0, 9.0):
        exact, _ = quad(
            lambda z, level=level: np.exp(-z) * gamma.sf(staves * level / z, staves), 0.0, np.inf
        )
        assert loudness.noise_exceeds(level, staves) == pytest.approx(exact, rel=1e-6, abs=1e-12)
    assert loudness.noise_exceeds(0.0, staves) == 1.0
    assert 0.0 <= loudness.noise_exceeds(1e9, staves) < 1e-300


@pytest.mark.parametrize('staves', [2, 8])
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
    # A shadow, a diffuse floor, and spikes on a coherent one.
    silent = rng.random(600) < np.repeat([1.0, 0.8, 0.1], 200)
    found = loudness.diffuse_bins(ratio, silent, usable)
    assert not found[:200].any() and found[215:385].mean() > 0.9 and not found[415:].any()
    # Noise is never very loud, 20 dB are.
    for level, loud in ((90.0, False), (110.0, True)):
        found = loudness.diffuse_bins(np.full(200, level), np.ones(200, bool), np.ones(200, bool))
        assert (found == loud).all()


def diffuse(rng, bins, staves, share, *, snr=1e4):
    wave = np.sqrt(1.0 - share) * circular(rng, bins, 1) * np.exp(0.7j * np.arange(staves))
    wave = wave + np.sqrt(share) * circular(rng, bins, staves)
    fading = np.sqrt(rng.exponential(size=(bins, 1)))
    return fading * (np.sqrt(snr) * wave + circular(rng, bins, staves))


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


def test_gain_phase_and_what_is_live_are_those_of_the_vectors():
    case = load_vectors('bathymetry_by_default/array')
    live, phase = case['live'], case['phase']
    true = case['gain_true'] / np.median(case['gain_true'][live])
    found = [measured(ping) for ping in case['iq'].astype(float) @ [1.0, 1j]]
    for each in found:
        assert (each.live == live).all() and each.bins > 700
        assert np.degrees(np.abs(each.phase - phase)[live]).max() < 0.6
        assert each.gain[live] == pytest.approx(true[live], rel=0.025)
        assert each.coherence[live].min() > 0.97 and each.coherence[~live].max() < 0.35
        # The vectors have the root mean square, here it is that of phases beside a line.
        tilt = float(case['phase_tilt']) * math.sqrt(7.0 / 3.0)
        assert each.sine_std == pytest.approx(tilt, rel=0.03)
    # To the reach of the vectors, of three pings.
    gain, mean = (np.mean([getattr(c, name) for c in found], axis=0) for name in ('gain', 'phase'))
    assert gain[live] == pytest.approx(true[live], rel=0.01)
    assert np.degrees(np.abs((mean - phase)[live])).max() < 0.3


@pytest.mark.parametrize('staves, spacing', [(4, 0.5), (8, 2.0), (8, 0.2), (17, 0.5)])
@pytest.mark.parametrize('noise', [1.0, None])
def test_an_exact_array_stays_as_it_is_to_the_bit(staves, spacing, noise):
    for seed in range(2):
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
    rest, place = found.phase - phase, np.arange(8)
    rest -= np.polyval(np.polyfit(place, rest, 1), place)  # a tilt
    assert np.abs(rest).max() < math.radians(0.7)
    turned = np.median(np.abs(found.apply(iq * gain * np.exp(1j * phase))) / np.abs(iq), axis=0)
    assert turned == pytest.approx(1.0, rel=0.02)
    wide = 2.0 * math.pi * 0.5 * math.sqrt(42.0)
    assert found.sine_std == pytest.approx(math.sqrt(np.sum(found.phase**2) / 4.0) / wide)
    # A phase that grows evenly is a tilt and stays.
    assert measured(iq * np.exp(0.1j * np.arange(8))).is_exact


@pytest.mark.parametrize('stave', [0, 3])
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


@pytest.mark.parametrize('order', [[0, 6, 2, 3, 4, 5, 1, 7], [1, 0, 2, 3, 4, 7, 6, 5]])
def test_exchanged_staves_are_put_back(order):
    iq = echoes()
    found = measured(iq[:, order])
    assert (found.order == order).all() and not found.no_wave.any()
    assert (found.apply(iq[:, order]) == iq).all()


def test_a_stave_at_another_place_is_named_and_not_exchanged():
    iq = echoes()
    iq[:, 4] *= np.exp(0.9j * np.random.default_rng(2).normal(size=len(iq)))
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
    assert measured(noise, noise=None).is_exact


@pytest.mark.parametrize('dead', [(), (0, 5)])
def test_the_form_with_weights_is_that_of_the_covariance(dead):
    rng = np.random.default_rng(6)
    staves, signal = 7, 3.7
    live = ~np.isin(np.arange(staves), dead)
    noise = np.where(live, rng.uniform(0.3, 4.0, staves), 1.0)
    one = evolve(Calibration.exact(staves), live=live, noise=noise)
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
