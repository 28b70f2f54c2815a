# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the fathometer's measurements refuse, and what they mask."""

import numpy as np
import pytest

from sonar_imm.measurements import ArrayDepth, CrossSpectra, Pressure, Rejection, Trace

M = 5


def reason_of(make, **fields):
    with pytest.raises(Rejection) as caught:
        make(**{'stamp_ns': 1, **fields})
    assert caught.value.sentence[-1] != '.' and '\n' not in caught.value.sentence
    return caught.value.reason


def trace(**changes):
    return {'depth': np.arange(10.0), 'amplitude': np.ones(10), **changes}


def spectra(**changes):
    rng = np.random.default_rng(0)
    p = rng.standard_normal((7, M, 20)) + 1j * rng.standard_normal((7, M, 20))
    R = p @ p.conj().swapaxes(1, 2) / 20
    return {'frequency': 100.0 + np.arange(7.0), 'csdm': R, **changes}


@pytest.mark.parametrize(
    'changes, reason',
    [
        ({'depth': [1.0], 'amplitude': [1.0]}, 'too_short'),
        ({'depth': [], 'amplitude': []}, 'too_short'),
        ({'amplitude': np.ones(9)}, 'bad_shape'),
        ({'sigma': np.ones(9)}, 'bad_shape'),
        ({'depth': np.ones((10, 2))}, 'bad_shape'),
        ({'depth': np.zeros(10)}, 'bad_depth'),
        ({'depth': np.arange(10.0)[::-1]}, 'bad_depth'),
        ({'depth': np.full(10, np.nan)}, 'nan'),
        ({'amplitude': np.full(10, np.nan)}, 'nan'),
        ({'amplitude': np.zeros(10)}, 'silent'),
        ({'depth': 1e6 * np.arange(10.0)}, 'out_of_range'),
        ({'reference_depth': 1e9}, 'out_of_range'),
        ({'stamp_ns': 0}, 'bad_stamp'),
    ],
)
def test_traces_that_cannot_be_used(changes, reason):
    assert reason_of(Trace, **trace(**changes)) == reason


def test_a_trace_keeps_what_it_can():
    sigma = np.ones(10)
    sigma[:3] = np.nan, -1.0, 0.0
    item = Trace(stamp_ns=1, **trace(sigma=sigma, reference_depth=np.nan))
    assert np.isnan(item.sigma[:3]).all() and (item.sigma[3:] == 1.0).all()
    assert item.reference_depth is None
    assert item.step == 1.0
    assert Trace(stamp_ns=1, **trace(sigma=np.zeros(10))).sigma is None


def lopsided(R):
    R = R.copy()
    R[2, 0, 1] += 1j
    return R


def overcoherent(R):
    R = R.copy()
    R[:, 0, 1] *= 30.0
    R[:, 1, 0] *= 30.0
    return R


def overflowing(R):
    """Cross terms and powers at the two ends of single precision."""
    R = (R * 1e-40).astype(np.complex64)
    R[:, 0, 1] = R[:, 1, 0] = 1e38
    return R


@pytest.mark.filterwarnings('error')
def test_cross_spectra_of_any_loudness_are_taken():
    for loudness in (1e-38, 1e-20, 1.0, 3e37):
        fields = spectra()
        fields['csdm'] = (fields['csdm'] * loudness).astype(np.complex64)
        assert CrossSpectra(stamp_ns=1, **fields).alive.all()


def boundless(R, rows, columns):
    """Doubles of which two have no finite sum, at both places of a pair."""
    R = R.astype(np.complex128)
    R[:, rows, columns] = 1e308 * (1 + 1j * np.not_equal(rows, columns))
    R[:, columns, rows] = R[:, rows, columns].conj()
    return R


@pytest.mark.filterwarnings('error')
def test_a_hydrophone_whose_powers_have_no_sum_is_dead():
    fields = spectra()
    fields['csdm'] = boundless(fields['csdm'], 3, 3)
    record = CrossSpectra(stamp_ns=1, **fields)
    assert np.flatnonzero(~record.alive).tolist() == [3] and record.usable.all()


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize(
    'change, reason',
    [
        (lambda R: boundless(R, *np.diag_indices(M)), 'nan'),
        (lambda R: boundless(R, 0, 1), 'not_hermitian'),
        (lambda R: lopsided(R), 'not_hermitian'),
        (lambda R: overflowing(R), 'not_positive'),
        (lambda R: overcoherent(R), 'not_positive'),
        (lambda R: np.full_like(R, np.nan), 'nan'),
        (lambda R: np.zeros_like(R), 'silent'),
        (lambda R: R[:3], 'bad_shape'),
        (lambda R: R[:, :2], 'bad_shape'),
        (lambda R: R[:, :2, :2], 'bad_hydrophones'),
        (lambda R: R[0], 'bad_shape'),
        (lambda R: R * (np.arange(M) < 2)[:, None] * (np.arange(M) < 2), 'dead_hydrophones'),
    ],
)
def test_cross_spectra_that_cannot_be_used(change, reason):
    fields = spectra()
    fields['csdm'] = change(fields['csdm'])
    assert reason_of(CrossSpectra, **fields) == reason


@pytest.mark.parametrize(
    'frequency, reason',
    [
        (np.ones(7), 'bad_frequency'),
        (np.full(7, np.inf), 'nan'),
        (np.arange(-3.0, 4.0), 'out_of_range'),
    ],
)
def test_frequencies_that_cannot_be(frequency, reason):
    assert reason_of(CrossSpectra, **spectra(frequency=frequency)) == reason


def test_one_frequency_is_too_few():
    fields = spectra()
    fields = {name: value[:1] for name, value in fields.items()}
    assert reason_of(CrossSpectra, **fields) == 'too_short'


@pytest.mark.parametrize('value', [0.0, np.nan])
def test_a_dead_hydrophone_is_masked(value):
    fields = spectra()
    fields['csdm'][:, 2] = value
    fields['csdm'][:, :, 2] = value
    item = CrossSpectra(stamp_ns=1, **fields)
    assert item.alive.tolist() == [True, True, False, True, True]
    assert item.usable.all()


def test_a_bad_row_is_masked():
    fields = spectra()
    fields['csdm'][3, 0, 1] = np.nan
    item = CrossSpectra(stamp_ns=1, **fields)
    assert item.alive.all()
    assert np.flatnonzero(~item.usable).tolist() == [3]


def samples():
    return np.random.default_rng(0).standard_normal((50, M)).astype(np.float32)


@pytest.mark.parametrize(
    'pressure, rate, reason',
    [
        (samples()[:1], 100.0, 'too_short'),
        (samples()[:, :2], 100.0, 'bad_hydrophones'),
        (samples()[:, 0], 100.0, 'bad_shape'),
        (samples(), np.nan, 'out_of_range'),
        (samples(), 0.0, 'out_of_range'),
        (samples() * np.nan, 100.0, 'nan'),
        (samples() * 0.0, 100.0, 'silent'),
        (samples() * (np.arange(M) < 2), 100.0, 'dead_hydrophones'),
        (samples().astype(float) * 1e300, 100.0, 'nan'),
    ],
)
def test_pressure_that_cannot_be_used(pressure, rate, reason):
    assert reason_of(Pressure, pressure=pressure, sample_rate=rate) == reason


@pytest.mark.parametrize(
    'make, fields',
    [
        (Pressure, {'pressure': samples(), 'sample_rate': 100.0}),
        (Trace, {'depth': np.arange(9.0), 'amplitude': np.ones(9)}),
    ],
)
def test_a_record_without_a_time_is_refused(make, fields):
    assert make(stamp_ns=1, **fields).stamp_ns == 1
    with pytest.raises(Rejection, match='the header stamp is 0 ns'):
        make(stamp_ns=0, **fields)


def test_a_hydrophone_with_a_lost_sample_is_masked():
    p = samples()
    p[7, 1] = np.nan
    p[:, 3] = 2.5
    item = Pressure(stamp_ns=1, pressure=p, sample_rate=100.0)
    assert item.alive.tolist() == [True, False, True, False, True]
    assert np.isfinite(item.pressure).all()
    assert item.duration_ns == 500_000_000


def test_depths_of_the_array():
    assert ArrayDepth(stamp_ns=1, depth=73.5).depth == 73.5
    assert reason_of(ArrayDepth, depth=np.nan) == 'nan'
    assert reason_of(ArrayDepth, depth=1e6) == 'out_of_range'
