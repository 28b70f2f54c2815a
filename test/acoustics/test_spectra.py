# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Streaming cross-spectra against scipy's, whatever the blocks."""

import numpy as np
import pytest
from scipy.signal import csd

from sonar_imm.acoustics.spectra import (
    BlockAverage,
    noise_taper,
    outer_sum,
    SlidingAverage,
    SnapshotStream,
    window_of,
    window_overlap,
)


def test_averages_are_of_the_snapshots_they_say():
    """Those of blocks share no sample, those that slide are of the last ones."""
    spectra = spectra_of(pressure())
    blocks, sliding = BlockAverage(5, 1), SlidingAverage(10, 4)
    done = [made for part in np.split(spectra, [1, 8, 9]) for made in blocks.push(part)]
    assert len(done) == (len(spectra) + 1) // 6
    for k, made in enumerate(done):
        assert made.csdm == pytest.approx(outer_sum(spectra[6 * k : 6 * k + 5]) / 5, rel=1e-5)
        assert made.snapshots == 5
    done = [made for part in np.split(spectra, [3, 11]) for made in sliding.push(part)]
    assert len(done) == (len(spectra) - 10) // 4 + 1
    for k, made in enumerate(done):
        assert made.csdm == pytest.approx(outer_sum(spectra[4 * k : 4 * k + 10]) / 10, rel=1e-5)


LENGTH, HYDROPHONES = 64, 4


def pressure(samples=1000, seed=0):
    rng = np.random.default_rng(seed)
    shared = rng.standard_normal((samples, 1))
    return (shared + rng.standard_normal((samples, HYDROPHONES))).astype(np.float32)


def spectra_of(p, cuts=()):
    stream = SnapshotStream(LENGTH, LENGTH // 2, slice(3, 20))
    return np.concatenate([stream.push(block) for block in np.split(p, cuts)])


def test_the_average_is_the_cross_spectrum_scipy_finds():
    p = pressure()
    spectra = spectra_of(p)
    R = outer_sum(spectra) / len(spectra)
    for i, j in ((0, 0), (0, 2), (3, 1)):
        # scipy conjugates the first of the two, and scales to a density.
        _, expected = csd(
            p[:, j], p[:, i], nperseg=LENGTH, noverlap=LENGTH // 2, detrend=False, fs=1.0
        )
        assert R[:, i, j] * 2.0 / LENGTH == pytest.approx(expected[3:20], rel=1e-4, abs=1e-4)


@pytest.mark.parametrize('cuts', [(1,), (63, 64, 65), (500,), tuple(range(7, 1000, 7))])
def test_blocks_may_be_cut_anywhere(cuts):
    p = pressure()
    assert spectra_of(p, cuts).tobytes() == spectra_of(p).tobytes()


def test_a_restart_forgets_half_a_snapshot():
    stream = SnapshotStream(LENGTH, LENGTH, slice(0, 5), 'rectangular')
    stream.push(pressure(LENGTH - 1))
    assert stream.waiting == LENGTH - 1
    stream.restart()
    assert len(stream.push(pressure(LENGTH - 1))) == 0
    with pytest.raises(ValueError):
        stream.push(np.zeros((5, HYDROPHONES + 1)))


def test_windows_have_unit_power_and_the_autocorrelation_they_claim():
    for name in ('hann', 'rectangular'):
        window = window_of(name, 4096)
        assert np.mean(window**2) == pytest.approx(1.0)
        for share in (0.0, 0.1, 0.5, 0.9):
            lag = round(share * 4096)
            seen = np.sum(window[lag:] * window[: 4096 - lag]) / 4096
            assert window_overlap(name, lag / 4096) == pytest.approx(seen, abs=1e-3)
        assert window_overlap(name, 1.5) == pytest.approx(0.0, abs=1e-12)
    with pytest.raises(ValueError):
        window_of('kaiser', 8)


def test_spectra_of_nothing():
    assert BlockAverage(3).push(np.empty((0, 5, 4), np.complex64)) == []
    with pytest.raises(ValueError):
        SnapshotStream(8, 9, slice(0, 2))
    with pytest.raises(ValueError):
        SlidingAverage(3, 4)


@pytest.mark.statistics
@pytest.mark.parametrize('window, overlap', [('hann', 0.5), ('rectangular', 0.5), ('hann', 0.75)])
def test_the_taper_of_noise_is_that_of_correlated_noise(window, overlap):
    """Two unrelated noises, correlated by averaged cross-spectra, many times over."""
    rng = np.random.default_rng(2)
    n, total = 64, np.zeros(64)
    for _ in range(1500):
        stream = SnapshotStream(n, round(n * (1.0 - overlap)), slice(None), window)
        spectra = stream.push(rng.standard_normal((12 * n, 2)))
        total += np.fft.irfft(np.mean(spectra[:, :, 0] * spectra[:, :, 1].conj(), axis=0), n) ** 2
    lags = np.arange(4, 60, 8)
    taper = noise_taper(window, overlap, lags / n)
    assert np.sqrt(total[lags] / total[0]) == pytest.approx(taper, rel=0.12, abs=0.01)
    assert taper.min() < 0.8
