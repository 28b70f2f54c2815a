# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The fathometer's processors, hydrophones that differ, envelopes of profilers, pulses and
cross-spectra: against golden values, vectors, closed forms, scipy and the mistakes of print."""

import json
import math
from pathlib import Path

from helpers.vector_files import load_vectors
import numpy as np
import pytest
from scipy.signal import csd
from scipy.stats import norm

from sonar_imm.acoustics import ambient, envelopes
from sonar_imm.acoustics import fathometer as fm
from sonar_imm.acoustics import pulse as pulses
from sonar_imm.acoustics import spectra as streams
from sonar_imm.acoustics.envelopes import from_normal, pulse_and_lead, rise, to_normal
from sonar_imm.acoustics.hydrophones import apply_response, correct_phones, fit_phones
from sonar_imm.acoustics.pulse import band_pulse

VECTORS = Path(__file__).parents[1] / 'vectors' / 'fathometer'
C, M, D = 1500.0, 32, 0.18
HEIGHTS = D * np.arange(M)
PHONES, SPACING, SPEED = 16, 0.25, 1500.0
WAVE, PLACES = SPEED / SPACING, np.arange(PHONES)
FREQUENCY = np.arange(100.0, 2801.0, 10.0)
LENGTH, HYDROPHONES = 64, 4


@pytest.fixture(scope='module')
def golden():
    return json.loads((VECTORS / 'golden.json').read_text())


@pytest.fixture(scope='module')
def band():
    """A coarse band over two layers, and what it is at every frequency."""
    frequency = np.arange(200.0, 4000.0, 4.0)
    R = ambient.surface_noise_csdm(frequency, M, D, [40.0, 52.0], [0.35, 0.1], C)
    R += 0.01 * np.eye(M) + 0.5 * ambient.horizontal_noise_csdm(frequency, M, D, 0.03, C)
    return frequency, R * (frequency[:, None, None] / 1000.0) ** -1.6


def test_noise_integrals(golden):
    for x, value in golden['I(x)=2*int_0^1 u e^{ixu}du'].items():
        assert ambient.noise_integral(float(x)) == pytest.approx(complex(*value), abs=1e-14)
    u = (np.arange(100_000) + 0.5) / 100_000
    for x in (0.0, 5e-4, 2e-3, -7.0):
        expected = np.mean(2.0 * u * np.exp(1j * x * u))
        assert ambient.noise_integral(x) == pytest.approx(expected, abs=1e-9)
    for x in (1e-7, -3e-4, 9.9e-4):
        series = sum(2.0 * (1j * x) ** n / (math.factorial(n) * (n + 2)) for n in range(8))
        assert ambient.noise_integral(x) == pytest.approx(series, abs=1e-13)


def single_layer():
    R = ambient.surface_noise_csdm([1000.0], M, D, [56.5], [0.35], C) + 0.01 * np.eye(M)
    return R, fm.steering([1000.0], HEIGHTS, C)


def test_cross_spectra_of_one_layer(golden):
    R, _ = single_layer()
    wanted = golden['R(1000Hz) one layer H=56.5 a=.35 no broadside, sens .01']
    assert R[0, 0, 0] == pytest.approx(wanted['R00'])
    for row, name in ((1, 'R10'), (31, 'R31_0')):
        assert R[0, row, 0] == pytest.approx(complex(*wanted[name]))
    assert np.allclose(R, R.conj().swapaxes(1, 2)) and np.linalg.eigvalsh(R[0])[0] > 0.0


@pytest.mark.parametrize('loading', [0.001, 0.01, 1.0])
def test_mvdr_is_the_golden_one(golden, loading):
    wanted = golden[f'MVDR eps={loading}']
    R, w = single_layer()
    C_, power = fm.mvdr(R, w, loading)
    assert C_[0] == pytest.approx(complex(*wanted['closed']), rel=1e-10)
    assert abs(C_[0] / power[0]) == pytest.approx(wanted['coherence closed'], rel=1e-10)
    # The weights, each made of the loaded matrix, around the loaded matrix: the same.
    L = R[0] + loading * np.trace(R[0]).real / M * np.eye(M)
    up, down = (np.linalg.solve(L, v) for v in (w[0], w[0].conj()))
    up, down = up / (w[0].conj() @ up), down / (w[0] @ down)
    assert down.conj() @ L @ up == pytest.approx(C_[0], rel=1e-10)


def test_conventional_is_the_golden_one(golden):
    R, w = single_layer()
    wanted = complex(*golden['conv w^T R w/M^2'])
    assert fm.conventional(R, w)[0][0] / M**2 == pytest.approx(wanted, rel=1e-10)


def response(gamma, frequency, low=20.0, high=80.0, step=1 / 32):
    depth = np.arange(low, high, step)
    spacing = frequency[1] - frequency[0]
    b = fm.depth_response(gamma, frequency[0], spacing, (low, step, len(depth)), 0.0, C)
    return depth, b


@pytest.mark.parametrize('processor', fm.PROCESSORS)
def test_the_pulse_peaks_upright_at_the_layer(band, processor):
    frequency, R = band
    depth, b = response(fm.coherence(R, fm.steering(frequency, HEIGHTS, C), processor), frequency)
    assert depth[np.argmax(b)] == pytest.approx(40.0, abs=0.04)
    assert b.max() > 2.5 * -b.min()
    near = np.abs(depth - 40.0) < 1.0
    pulse = band_pulse(frequency[0], frequency[-1], C)(depth[near] - 40.0)
    assert np.corrcoef(b[near], pulse)[0, 1] > 0.97


def test_the_echo_keeps_its_sign_as_the_loading_grows(band):
    """Upright to a loading of 3, where an unloaded matrix in the middle turned it over."""
    frequency, R = band
    w = fm.steering(frequency, HEIGHTS, C)
    for loading in (1e-3, 1e-2, 0.1, 1.0, 3.0):
        depth, b = response(fm.coherence(R, w, 'mvdr', loading=loading), frequency)
        assert b[np.argmin(np.abs(depth - 40.0))] > 0.005


def test_noise_is_as_large_as_predicted():
    frequency = 400.0 + 2.0 * np.arange(1000)
    R = np.tile(np.eye(M), (len(frequency), 1, 1)).astype(complex)
    rng, w, seen = np.random.default_rng(0), fm.steering(frequency, HEIGHTS, C), []
    for _ in range(4):
        gamma = fm.coherence(ambient.sample_csdm(R, 64, rng), w, 'conventional')
        seen.append(fm.noise_sigma(response(gamma, frequency)[1]))
    # The variance of an average of 64 snapshots and 1000 frequencies, half of it in the real part.
    assert np.mean(seen) == pytest.approx(1.0 / np.sqrt(2.0 * 64.0 * 1000.0), rel=0.06)


def test_frequencies_may_be_missing(band):
    frequency, R = band
    gamma = fm.coherence(R, fm.steering(frequency, HEIGHTS, C), 'mvdr')
    gamma[100:110] = np.nan
    depth, b = response(gamma, frequency)
    assert depth[np.argmax(b)] == pytest.approx(40.0, abs=0.04)
    with pytest.raises(ValueError):
        response(np.full(len(frequency), np.nan), frequency)


def test_depth_response_is_the_sum_it_says(band):
    frequency, rng = band[0], np.random.default_rng(2)
    gamma = rng.standard_normal(len(frequency)) + 1j * rng.standard_normal(len(frequency))
    z = 30.0 + 0.013 * np.arange(50)
    direct = np.exp(2j * np.pi * np.outer(2.0 * (z - 7.0) / C, frequency)) @ gamma
    direct /= len(frequency)
    arguments = gamma, frequency[0], 4.0, (30.0, 0.013, 50), 7.0, C
    assert np.allclose(fm.depth_response(*arguments), direct.real, atol=1e-10)
    assert np.allclose(fm.depth_response(*arguments, envelope=True), np.abs(direct), atol=1e-10)
    for N, count in ((1, 9), (13, 4)):
        values = gamma[:N]
        table = np.exp(2j * np.pi * 0.0137 * np.outer(np.arange(count), np.arange(N)))
        assert np.allclose(fm.chirp_z(values, 0.0137, count), table @ values, atol=1e-10)


def test_white_noise_gain_is_kept(band):
    frequency, R = band
    w = fm.steering(frequency, HEIGHTS, C)
    loading = fm.white_noise_loading(R, w, -3.0)
    power = np.einsum('fmm->f', R).real / M
    L = R + (loading * power)[:, None, None] * np.eye(M)
    gains = []
    for v in (w, w.conj()):
        x = np.linalg.solve(L, v[..., None])[..., 0]
        weights = x / np.einsum('fm,fm->f', v.conj(), x)[:, None]
        gains.append(1.0 / np.sum(np.abs(weights) ** 2, axis=1))
    least = np.minimum(*gains)
    assert (least >= M * 10**-0.3 * 0.999).all()
    loaded = loading > 2e-6
    assert loaded.mean() > 0.2
    assert (least[loaded] <= M * 10**-0.3 * 1.02).all()


def test_singular_matrices_are_said_so():
    w = fm.steering([1000.0], HEIGHTS, C)
    with pytest.raises(np.linalg.LinAlgError):
        fm.mvdr(np.zeros((1, M, M), complex), w, 1e-2)
    with pytest.raises(ValueError, match='processor'):
        fm.coherence(np.eye(M)[None] + 0j, w, 'capon')


def test_the_spectrum_of_an_echo_is_smooth_finite_and_of_mean_one(band):
    frequency, R = band
    w = fm.steering(frequency, HEIGHTS, C)
    gamma, power = fm.coherence_and_power(R, w, 'mvdr')
    assert gamma * power == pytest.approx(1j * fm.mvdr(R, w, 1e-2)[0])
    W = fm.echo_spectrum(R, frequency, power)
    assert W.mean() == pytest.approx(1.0) and (W > 0.0).all()
    # MVDR is sharper than a plain sum where waves are long.
    assert W[:50].mean() > 2.0 * W[-200:].mean()
    few = fm.echo_spectrum(R[:3], frequency[:3], power[:3])
    assert few.shape == (3,) and np.isfinite(few).all()
    # A row at 0 Hz counts as its neighbour.
    direct = fm.echo_spectrum(R[:40], np.append(0.0, frequency[1:40]), power[:40])
    assert direct == pytest.approx(fm.echo_spectrum(R[:40], frequency[:40], power[:40]), rel=0.1)


def test_the_share_of_the_surface_is_that_of_the_powers():
    """Noise from the horizontal and of the hydrophones themselves makes no echo."""
    frequency = np.arange(50.0, 4000.0, 10.0)
    heights = 0.18 * np.arange(16)
    surface = ambient.surface_noise_csdm(frequency, 16, 0.18, np.empty(0), np.empty(0), 1500.0)
    assert fm.surface_share(surface, frequency, heights, 1500.0) == pytest.approx(1.0)
    ships = 3.0 / (1.0 + (frequency / 200.0) ** 2)
    others = ambient.horizontal_noise_csdm(frequency, 16, 0.18, 0.03, 1500.0)
    R = surface + ships[:, None, None] * others + 0.1 * np.eye(16)
    R *= (frequency[:, None, None] / 1000.0) ** -1.6
    share = fm.surface_share(R, frequency, heights, 1500.0)
    assert share[20:-20] == pytest.approx(1.0 / (1.1 + ships[20:-20]), rel=0.1)
    # Some hydrophones are dead.
    alive = np.array([0, 1, 2, 4, 7, 8, 9, 12, 13, 15])
    some = fm.surface_share(R[:, alive[:, None], alive], frequency, heights[alive], 1500.0)
    assert some == pytest.approx(share, rel=0.05)


def test_the_phase_of_an_echo_is_that_of_the_array_and_its_distance():
    """Against what the response changes by with the amplitude of a layer, 22 m and 40 m below."""
    frequency, heights = np.arange(100.0, 2800.0, 4.0), 0.25 * np.arange(16)
    w = fm.steering(frequency, heights, C)
    for H in (22.0, 40.0):
        known = frequency, 16, 0.25, [H]
        layers = (ambient.surface_noise_csdm(*known, [a], C) for a in (0.1, -0.1))
        with_layer, without = (layer + 0.01 * np.eye(16) for layer in layers)
        changed = fm.coherence(with_layer, w, 'mvdr') - fm.coherence(without, w, 'mvdr')
        exact = np.angle(changed * np.exp(4j * np.pi * frequency * H / C))
        phase = fm.echo_phase(with_layer, frequency, heights, [H], C, 1e-2)[0]
        assert phase == pytest.approx(exact, abs=0.02)
        assert exact[:50].mean() < -0.15 * 22.0 / H * 0.8
        # Some hydrophones are dead, and the record has an end.
        alive = np.array([0, 1, 2, 4, 5, 7, 8, 9, 10, 12, 13, 15])
        R = ambient.sample_csdm(with_layer, 100, np.random.default_rng(0))
        R = R[:, alive[:, None], alive]
        some = fm.echo_phase(R, frequency, heights[alive], [H], C, 1e-2)[0]
        assert some == pytest.approx(exact, abs=0.05)


def test_the_power_of_few_snapshots_is_less_by_what_is_fitted():
    frequency, heights = np.full(32, 800.0), 0.18 * np.arange(16)
    R = ambient.surface_noise_csdm(frequency, 16, 0.18, np.empty(0), np.empty(0), 1500.0)
    R, w = R + 0.01 * np.eye(16), fm.steering(frequency, heights, 1500.0)
    rng = np.random.default_rng(0)
    sampled = [ambient.sample_csdm(R, 40, rng) for _ in range(20)]
    drawn = np.mean([fm.coherence_and_power(each, w, 'mvdr')[1] for each in sampled])
    exact, last = (fm.coherence_and_power(R, w, 'mvdr')[1], sampled[-1].astype(np.complex128))
    expected = fm.sampled_share(last, 1e-2, 40.0)
    assert expected.max() < 0.9
    assert fm.sampled_share(1e6 * last, 1e-2, 40.0) == pytest.approx(expected)
    # That of every beam together: a beam where it is quiet is fitted less.
    assert drawn / exact[0] == pytest.approx(expected.mean(), rel=0.08)


def fitted(csdm, phones=PLACES, **options):
    return correct_phones(csdm, FREQUENCY, phones, WAVE, 0.1, **options)


@pytest.fixture(scope='module')
def clean():
    R = ambient.surface_noise_csdm(FREQUENCY, PHONES, SPACING, [22.0, 36.0], [0.35, 0.2], SPEED)
    return ambient.sample_csdm(R + 0.01 * np.eye(PHONES), 100, np.random.default_rng(0))


def heard(csdm, response):
    """With the responses (PHONES,) or (F, PHONES)."""
    c = np.broadcast_to(response, (len(FREQUENCY), PHONES)).astype(np.complex64)
    return csdm * c[:, :, None] * c.conj()[:, None, :]


def late(seconds, phone=9):
    response = np.ones((len(FREQUENCY), PHONES), np.complex128)
    response[:, phone] = np.exp(-2j * np.pi * FREQUENCY * seconds)
    return response


def test_response_of_the_vectors():
    v = load_vectors('fathometer_in_the_field/phones')
    wave = float(v['sound_speed'] / v['element_spacing'])
    fit = fit_phones(v['csdm'], v['frequency'], PLACES, wave)
    assert np.abs(fit.gain / v['gain'] - 1.0).max() < 1e-6
    assert (fit.sign == v['sign']).all() and (fit.sign == v['true_sign']).all()
    assert np.abs(fit.delay - v['delay']).max() < 1e-6
    assert np.abs(fit.share - v['share']).max() < 0.02
    corrected = apply_response(v['csdm'], v['frequency'], fit)
    power = np.einsum('fmm->fm', v['csdm']).real.mean()
    assert np.abs(corrected - v['corrected']).max() < 1e-3 * power


def test_equal_hydrophones_are_left_as_they_are_and_gains_are_levelled(clean):
    corrected, keep, fit = fitted(clean)
    assert keep.all() and (fit.sign == 1).all()
    assert np.abs(fit.delay).max() < 2e-6
    assert np.abs(10.0 * np.log10(np.median(fit.gain, axis=0))).max() < 0.2
    assert np.abs(corrected - clean).max() < 0.2 * np.abs(clean).max()
    for factor in (0.1, 2.0):
        other, keep, fit = fitted(heard(clean, np.where(PLACES == 5, factor, 1.0)))
        assert keep.all() and np.median(fit.gain[:, 5]) == pytest.approx(factor**2, rel=0.05)
        assert np.abs(corrected - other).max() < 0.05 * np.abs(other).max()


def test_delays_of_all_are_found_but_for_a_tilt_which_stays(clean):
    delay = 30e-6 * np.random.default_rng(3).standard_normal(PHONES)
    _, _, fit = fitted(heard(clean, np.exp(-2j * np.pi * np.outer(FREQUENCY, delay))))
    off = fit.delay - delay
    line = np.polyfit(PLACES, off, 1)
    assert np.abs(off - np.polyval(line, PLACES)).max() < 8e-6
    assert abs(line[0]) < 4e-6
    _, _, fit = fitted(heard(clean, np.exp(-2j * np.pi * np.outer(FREQUENCY, 8e-6 * PLACES))))
    assert np.abs(fit.delay).max() < 2e-6


def alone(phones, snapshots, seed):
    """Cross-spectra (F, phones, phones) of hydrophones that have nothing in common."""
    unit = np.repeat(np.eye(phones)[None], len(FREQUENCY), axis=0)
    return ambient.sample_csdm(unit, snapshots, np.random.default_rng(seed))


@pytest.mark.parametrize('place', [0, 7])
def test_a_hydrophone_that_hears_something_else_is_left_out(clean, place):
    own, foreign = alone(PHONES, 100, 4), clean.copy()
    foreign[:, place], foreign[:, :, place] = own[:, place], own[:, :, place]
    corrected, keep, fit = fitted(foreign)
    assert keep.sum() == PHONES - 1 and not keep[place] and corrected.shape[1] == PHONES - 1
    assert abs(fit.share[place]) < 0.05 and np.delete(fit.share, place).min() > 0.95
    assert np.abs(np.delete(fit.delay, place)).max() < 2e-6


def test_where_nothing_else_can_be_told_hydrophones_are_levelled_only(clean):
    """Of those that hear nothing in common, of few, and where no more is asked for."""
    few, one = heard(clean, late(100e-6, 1)), heard(clean, late(100e-6))
    rows = (alone(8, 5, 5), True), (alone(16, 100, 5), True), (few[:, :4, :4], True), (one, False)
    for csdm, full in rows:
        _, keep, fit = fitted(csdm, np.arange(csdm.shape[1]), full=full)
        assert keep.all() and (fit.sign == 1).all() and not fit.delay.any()
        assert np.isnan(fit.share).all()


def test_dead_hydrophones_leave_gaps(clean):
    alive = np.delete(PLACES, [2, 3, 10])
    response = np.ones((len(FREQUENCY), PHONES)) * late(50e-6)
    response[:, 4] *= -1.0
    csdm = heard(clean, response)[:, alive][:, :, alive]
    _, keep, fit = fitted(csdm, alive)
    assert keep.all() and fit.sign[alive == 4] == -1 and fit.sign.sum() == len(alive) - 2
    assert fit.delay[alive == 9] == pytest.approx(50e-6, abs=6e-6)


def test_tables_of_the_vectors():
    vectors = load_vectors('fathometer_in_the_field/floor')
    trace, step = vectors['trace'], float(vectors['step'])
    assert envelopes.transmit_samples(trace) == vectors['ring_look']
    noise = envelopes.first_noise(trace)
    assert noise == pytest.approx(vectors['noise_profile'], rel=1e-6)
    pulse, _, _ = pulse_and_lead(trace, vectors['first_onset'])
    assert step * pulse == pytest.approx(float(vectors['pulse']), rel=1e-6)
    # The transmit pulse of the first pass ends at 31 in most traces.
    found = envelopes.water_noise(trace, noise, 31, vectors['first_onset'], pulse)
    assert found == pytest.approx(vectors['water_profile'], rel=1e-6)
    logs = envelopes.log_likelihoods(trace[0], found, float(vectors['loudest']))
    for log, name in zip(logs, ('log_quiet', 'log_loud', 'log_onset')):
        assert log == pytest.approx(vectors[name], abs=1e-6)


def test_normal_numbers_of_the_vectors():
    scalars = load_vectors('fathometer_in_the_field/scalars')
    x, expected = scalars['x'], scalars['gaussian']
    b = to_normal(x)
    assert b == pytest.approx(expected, abs=1e-6) and b.min() >= -3.0903
    assert np.diff(b[x > 6.0]) == pytest.approx(np.sqrt(2.0) * np.diff(x[x > 6.0]))


def test_noise_becomes_normal_and_back():
    rng = np.random.default_rng(0)
    b = to_normal(rng.rayleigh(np.sqrt(0.5), 200_000))
    assert np.mean(b) == pytest.approx(0.0, abs=0.01) and np.std(b) == pytest.approx(1.0, abs=0.01)
    for level in (0.1, 0.5, 0.99):
        assert np.mean(b < norm.ppf(level)) == pytest.approx(level, abs=0.005)
    at = np.array([-2.0, 0.0, 3.0, 7.0, 9.0, 20.0])
    x, slope = from_normal(at)
    assert to_normal(x) == pytest.approx(at)
    near, _ = from_normal(at + 1e-5)
    assert slope == pytest.approx((near - x) / 1e-5, rel=1e-3)


def test_first_maximum_and_its_rise():
    cell = np.arange(60.0)
    trace = np.exp(-0.5 * np.square((cell - 30.0) / 3.0))
    width, top = rise(trace, 20)
    assert top == 30 and width == pytest.approx(3.0, rel=0.02)
    # A ripple on the way up is no maximum, and what is louder right below counts.
    ripple = trace + 0.05 * (cell == 24)
    assert rise(ripple, 20)[1] == 30
    assert rise(np.zeros(60), 20) is None or rise(np.zeros(60), 20)[0] == 0.0
    assert rise(trace, 59) is None
    many = np.repeat(trace[None], 12, axis=0)
    assert np.isnan(pulse_and_lead(many[:9], np.full(9, 20))[0])
    pulse, lead, spread = pulse_and_lead(many, np.array([-1] * 2 + [20] * 10))
    assert (pulse, lead) == pytest.approx((3.0, 10.0), rel=0.02) and spread < 0.5


def test_scatter_begins_below_the_floor():
    rng, cell = np.random.default_rng(1), np.arange(400)
    level = 5.0 * np.exp(-(cell - 100) / 60.0) * (cell > 100)
    trace = np.hypot(*(np.sqrt(0.5) * rng.standard_normal((2, 400)))) * np.hypot(1.0, level)
    power = envelopes.scatter_power(trace, np.ones(400), 100, 2.5)
    assert (power >= 0.0).all() and (np.diff(power) <= 0.0).all()
    # Four pulses, 10 samples, below the onset; of a single trace a little less than it is.
    assert power[20] == pytest.approx(level[130] ** 2, rel=0.6)
    assert power[250] < 2.0 and power[290:].max() == 0.0
    assert not envelopes.scatter_power(trace, np.ones(400), 395, 2.5).any()


def test_missing_samples_say_nothing():
    rng = np.random.default_rng(2)
    traces = rng.rayleigh(1.0, (60, 100))
    traces[:, :10] = np.nan
    traces[::2, 80:] = np.nan
    noise = envelopes.first_noise(traces)
    assert np.isfinite(noise).all() and noise[50] == pytest.approx(np.sqrt(2.0), rel=0.5)
    logs = envelopes.log_likelihoods(traces[0], noise, 5.0)
    assert all((log[:10] == 0.0).all() and log[20] != 0.0 for log in logs)
    assert envelopes.transmit_samples(np.nan_to_num(traces, nan=9.0)) >= 10


def test_what_is_an_envelope():
    trace = np.array([0.0, 1.0, np.nan, 2.0])
    assert [envelopes.is_envelope(k * trace) for k in (1.0, -1.0, 0.0)] == [True, False, False]
    assert envelopes.quietest(trace) > 0.0


def test_band_pulse_is_the_golden_one(golden):
    wanted = golden['pulse lattice lag 4,20,100 (50-4000) vs closed form']
    pulse = pulses.band_pulse(50.0, 4000.0, 1500.0)
    assert pulse(np.array([4, 20, 100]) / 64.0) == pytest.approx(wanted[1], abs=1e-12)
    assert pulse(0.0) == 1.0
    # A band has 2 B T independent samples.
    assert pulses.independent_samples(pulse, 50.0, 0.005) == pytest.approx(527.0, rel=0.01)
    fine = np.linspace(0.0, 0.2, 20_001)
    assert fine[np.argmax(pulse(fine) < 0.0)] == pytest.approx(0.1, abs=0.01)


def test_a_gram_matrix_is_one_of_inner_products():
    for pulse in (pulses.band_pulse(200.0, 4000.0, 1500.0), pulses.gaussian_pulse(0.3)):
        G = pulses.gram(pulse, [1.0, 1.4, 2.2, 9.0])
        assert np.array_equal(G, G.T) and np.linalg.eigvalsh(G)[0] > 0.0
        assert np.diag(G) == pytest.approx(1.0)


def test_a_measured_pulse_is_even_and_scaled():
    pulse = pulses.measured_pulse([-0.2, -0.1, 0.0, 0.1, 0.2], [0.0, 2.2, 4.0, 1.8, 0.0])
    at = np.array([0.0, 0.1, -0.1, 0.15, 3.0])
    assert pulse(at) == pytest.approx([1.0, 0.5, 0.5, 0.25, 0.0])
    assert pulses.measured_pulse([0.0, 1.0], [1.0, 0.0])(0.25) == pytest.approx(0.75)


def test_what_is_no_pulse_is_refused():
    ends = [1.0, 0.0]
    for distance, value in (
        ([0.0], [1.0]), ([0.0, 1.0], [1.0]), ([0.5, 1.0], ends), ([0.0, 1.0], [-1.0, 0.0]),
        ([0.0, 1.0], [0.0, 1.0]), ([0.0, np.nan], ends),
    ):  # fmt: skip
        with pytest.raises(ValueError):
            pulses.measured_pulse(distance, value)
    for make, *values in ((pulses.band_pulse, 4000.0, 50.0, 1500.0), (pulses.gaussian_pulse, 0.0)):
        with pytest.raises(ValueError):
            make(*values)


def pressure(samples=1000, seed=0):
    rng = np.random.default_rng(seed)
    shared = rng.standard_normal((samples, 1))
    return (shared + rng.standard_normal((samples, HYDROPHONES))).astype(np.float32)


def spectra_of(p, cuts=()):
    stream = streams.SnapshotStream(LENGTH, LENGTH // 2, slice(3, 20))
    return np.concatenate([stream.push(block) for block in np.split(p, cuts)])


def test_the_average_is_the_cross_spectrum_scipy_finds():
    p = pressure()
    spectra = spectra_of(p)
    R = streams.outer_sum(spectra) / len(spectra)
    for i, j in ((0, 0), (0, 2), (3, 1)):
        # scipy conjugates the first of the two, and scales to a density.
        halves = {'nperseg': LENGTH, 'noverlap': LENGTH // 2, 'detrend': False, 'fs': 1.0}
        _, expected = csd(p[:, j], p[:, i], **halves)
        assert R[:, i, j] * 2.0 / LENGTH == pytest.approx(expected[3:20], rel=1e-4, abs=1e-4)


def test_blocks_may_be_cut_anywhere():
    p = pressure()
    for cuts in ((1,), (63, 64, 65), tuple(range(7, 1000, 7))):
        assert spectra_of(p, cuts).tobytes() == spectra_of(p).tobytes()


def test_a_restart_forgets_half_a_snapshot():
    stream = streams.SnapshotStream(LENGTH, LENGTH, slice(0, 5), 'rectangular')
    stream.push(pressure(LENGTH - 1))
    assert stream.waiting == LENGTH - 1
    stream.restart()
    assert len(stream.push(pressure(LENGTH - 1))) == 0
    with pytest.raises(ValueError):
        stream.push(np.zeros((5, HYDROPHONES + 1)))


def test_windows_have_unit_power_and_the_autocorrelation_they_claim():
    for name in ('hann', 'rectangular'):
        window = streams.window_of(name, 4096)
        assert np.mean(window**2) == pytest.approx(1.0)
        for share in (0.0, 0.1, 0.5, 0.9):
            lag = round(share * 4096)
            seen = np.sum(window[lag:] * window[: 4096 - lag]) / 4096
            assert streams.window_overlap(name, lag / 4096) == pytest.approx(seen, abs=1e-3)
        assert streams.window_overlap(name, 1.5) == pytest.approx(0.0, abs=1e-12)
    with pytest.raises(ValueError):
        streams.window_of('kaiser', 8)


@pytest.mark.statistics
@pytest.mark.parametrize('window, overlap', [('rectangular', 0.5), ('hann', 0.75)])
def test_the_taper_of_noise_is_that_of_correlated_noise(window, overlap):
    """Two unrelated noises, correlated by averaged cross-spectra, many times over."""
    rng = np.random.default_rng(2)
    n, total = 64, np.zeros(64)
    for _ in range(1500):
        stream = streams.SnapshotStream(n, round(n * (1.0 - overlap)), slice(None), window)
        spectra = stream.push(rng.standard_normal((12 * n, 2)))
        total += np.fft.irfft(np.mean(spectra[:, :, 0] * spectra[:, :, 1].conj(), axis=0), n) ** 2
    lags = np.arange(4, 60, 8)
    taper = streams.noise_taper(window, overlap, lags / n)
    assert np.sqrt(total[lags] / total[0]) == pytest.approx(taper, rel=0.12, abs=0.01)
    assert taper.min() < 0.8


def test_averages_are_of_the_snapshots_they_say():
    """Those of blocks share no sample, those that slide are of the last ones."""
    spectra = spectra_of(pressure())
    for average, cuts, step, length in (
        (streams.BlockAverage(5, 1), [1, 8, 9], 6, 5),
        (streams.SlidingAverage(10, 4), [3, 11], 4, 10),
    ):
        done = [made for part in np.split(spectra, cuts) for made in average.push(part)]
        assert len(done) == (len(spectra) - length) // step + 1
        for k, made in enumerate(done):
            due = streams.outer_sum(spectra[step * k : step * k + length]) / length
            assert made.csdm == pytest.approx(due, rel=1e-5) and made.snapshots == length
    assert streams.BlockAverage(3).push(np.empty((0, 5, 4), np.complex64)) == []
    with pytest.raises(ValueError):
        streams.SnapshotStream(8, 9, slice(0, 2))
    with pytest.raises(ValueError):
        streams.SlidingAverage(3, 4)
