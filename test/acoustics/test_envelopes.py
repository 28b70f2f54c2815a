# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Envelopes of profilers, pulses, cross-spectra against vectors, closed forms and scipy."""

import json
from pathlib import Path

from helpers.vector_files import load_vectors
import numpy as np
import pytest
from scipy.signal import csd
from scipy.stats import norm

from sonar_imm.acoustics import envelopes
from sonar_imm.acoustics import pulse as pulses
from sonar_imm.acoustics import spectra as streams
from sonar_imm.acoustics.envelopes import from_normal, pulse_and_lead, rise, to_normal


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
    few = np.repeat(trace[None], 9, axis=0)
    assert np.isnan(pulse_and_lead(few, np.full(9, 20))[0])
    many = np.repeat(trace[None], 12, axis=0)
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


# -- pulses and what follows from them ------------------------------------------------------------

GOLDEN = Path(__file__).parents[1] / 'vectors' / 'fathometer' / 'golden.json'


def test_band_pulse_is_the_golden_one():
    wanted = json.loads(GOLDEN.read_text())['pulse lattice lag 4,20,100 (50-4000) vs closed form']
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


# -- streaming cross-spectra against scipy's, whatever the blocks ---------------------------------

LENGTH, HYDROPHONES = 64, 4


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
    for make, *values in (
        (streams.SnapshotStream, 8, 9, slice(0, 2)),
        (streams.SlidingAverage, 3, 4),
    ):
        with pytest.raises(ValueError):
            make(*values)
