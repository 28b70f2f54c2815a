# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What measurements refuse, what they keep and what they mask."""

import contextlib

import attrs
from helpers.refusals import reason
import numpy as np
import pytest

from sonar_imm import measurements
from sonar_imm.measurements import (
    CrossSpectra,
    Fix,
    MAX_BINS,
    Pressure,
    Rejection,
    Snapshot,
    Trace,
)
from sonar_imm.measurements.variances import by_axis, check_flat, filled, UNKNOWN_VARIANCE

CLASSES = [
    kind
    for kind in vars(measurements).values()
    if isinstance(kind, type) and attrs.has(kind) and 'stamp_ns' in attrs.fields_dict(kind)
]


@pytest.mark.parametrize('kind', CLASSES)
def test_a_measurement_is_made_by_names_and_is_equal_to_itself_alone(kind):
    """Positions of arguments would mix up units, and arrays have no truth to compare by."""
    assert all(field.kw_only for field in attrs.fields(kind) if field.init)
    assert kind.__eq__ is object.__eq__ and kind.__hash__ is object.__hash__
    assert kind.__setattr__ is not object.__setattr__  # frozen


def test_a_stamp_that_is_no_time_of_ros_is_refused_by_name():
    for stamp_ns in (0, -1, 2**31 * 10**9, 2**62, 2**63, 2**80):
        with pytest.raises(Rejection, match=f'the header stamp is {stamp_ns} ns') as caught:
            measurements.check_stamp(stamp_ns)
        assert caught.value.reason == 'bad_stamp'
        with pytest.raises(Rejection, match='the header stamp is'):
            measurements.Altitude(stamp_ns=stamp_ns, altitude=1.0)
    measurements.check_stamp(2**31 * 10**9 - 1)
    measurements.check_stamp(1)


# -- positions and headings of which a single number is not finite --------------------------------

PLACE, TURN = {'position': (1.0, 2.0, 3.0)}, {'orientation': (0.0, 0.0, 0.0, 1.0)}
WHOLE = {
    Fix: PLACE,
    measurements.GeodeticFix: {'latitude': 54.0, 'longitude': 10.0},
    measurements.RelativeFix: {'offset': (1.0, 2.0, 3.0)},
    measurements.Navigation: PLACE | TURN,
    measurements.Start: {**PLACE, 'covariance': np.eye(3)},
    measurements.VesselHeading: TURN,
    measurements.VesselPose: PLACE | TURN,
}
"""What each class needs besides its stamp."""


def one_spoilt(values):
    """The same values, one number of them not finite; each in turn."""
    for name, value in values.items():
        for index in np.ndindex(np.shape(value)):
            for bad in (np.nan, np.inf):
                spoilt = np.array(value, float)
                spoilt[index] = bad
                yield {**values, name: spoilt if spoilt.shape else float(spoilt)}


def is_depth(kind, values):
    covariance = values.get('covariance', np.eye(2))[:2, :2]
    known = [*values.get('position', ())[:2], *covariance.flat]
    return kind in (Fix, measurements.Start) and np.isfinite(known).all()


@pytest.mark.parametrize('kind', WHOLE)
def test_a_single_number_that_is_not_finite_is_refused(kind):
    assert kind(stamp_ns=1, **WHOLE[kind]).stamp_ns == 1
    with pytest.raises(Rejection, match='the header stamp is 0 ns'):
        kind(stamp_ns=0, **WHOLE[kind])
    # A z that is not measured may be NaN.
    asked = [each for each in one_spoilt(WHOLE[kind]) if not is_depth(kind, each)]
    assert len(asked) >= 4
    for values in asked:
        with pytest.raises(Rejection):
            kind(stamp_ns=1, **values)


def test_an_axis_that_is_not_measured_or_of_which_nothing_is_said():
    for variances in ((np.inf, 1.0), (1.0, np.inf), (np.inf, np.inf)):
        with pytest.raises(Rejection, match='states that x or y is not measured') as caught:
            check_flat(np.diag(variances), 'a fix')
        assert caught.value.reason == 'not_measured'
    # A variance of z is stated up to one that says that it is not.
    for variance, stated in ((0.999 * UNKNOWN_VARIANCE, True), (UNKNOWN_VARIANCE, False)):
        made = Fix(stamp_ns=1, position=np.zeros(3), covariance=np.diag([1.0, 1.0, variance]))
        assert np.isfinite(made.covariance[2, 2]) == stated
    assumed, stated = np.diag([1.0, 2.0, 3.0]), by_axis(np.diag([4.0, -1.0, 9.0]))
    whole = np.diag([4.0, 2.0, 9.0])
    for given, wanted in ((None, assumed), (np.zeros((3, 3)), assumed), (stated, whole)):
        np.testing.assert_array_equal(filled(given, assumed), wanted)


@pytest.mark.parametrize('z', [np.nan, 1.0])
@pytest.mark.parametrize(
    'a, b, c, d, good',
    [(1.0, 0.5, 0.5, 1.0, True), (1e-4, 3e-5, 2e-5, 1e-4, False), (1.0, 2.0, 2.0, 1.0, False),
     (-1.0, 0.0, 0.0, 1.0, False), (np.nan, 0.0, 0.0, 1.0, False)],
)  # fmt: skip
def test_a_fix_and_a_scan_take_the_same_covariances_of_x_and_y(a, b, c, d, good, z):
    whole = np.array([[a, b, 0.0], [c, d, 0.0], [0.0, 0.0, z]])
    with contextlib.nullcontext() if good else pytest.raises(Rejection):
        Fix(stamp_ns=1, position=np.zeros(3), covariance=whole)
    with contextlib.nullcontext() if good else pytest.raises(Rejection):
        measurements.Fixes(stamp_ns=1, position=np.zeros((1, 3)), covariance=whole[None])


# -- snapshots of an array ------------------------------------------------------------------------


def snapshot(bins=20, staves=4, **changes):
    rng = np.random.default_rng(0)
    iq = rng.normal(size=(bins, staves)) + 1j * rng.normal(size=(bins, staves))
    values = {'stamp_ns': 10**18, 'range': 17.0 + 0.05 * np.arange(bins), 'frame_id': 'sonar'}
    return Snapshot(**{**values, 'iq': iq, **changes})


def test_what_is_fine_is_kept_as_it_came_and_read_only():
    ping = snapshot()
    assert len(ping) == 20 and ping.staves == 4 and ping.usable.all()
    assert ping.iq.dtype == np.complex128 and ping.bin_width == pytest.approx(0.05)
    single = ping.iq.astype(np.complex64)
    assert snapshot(iq=single).iq.dtype == np.complex64
    for array in (ping.range, ping.iq, ping.usable):
        assert not array.flags.writeable
    single[0] = 0.0  # the caller's array stays the caller's
    assert single.flags.writeable


BAD_SNAPSHOTS = {
    'bad_stamp': [{'stamp_ns': 0}],
    'no_staves': [{'staves': 0}],
    'bad_staves': [{'staves': 1}, {'staves': 65}],
    'too_short': [{'bins': 1}, {'bins': 0}],
    'too_large': [{'bins': MAX_BINS + 1, 'staves': 2}],
    'bad_shape': [
        {'range': np.arange(1.0, 20.0)}, {'iq': np.ones(20)}, {'noise_variance': np.ones(19)},
        {'two_way_time': np.ones(3)},
    ],
    'bad_range': [{'range': np.full(20, 5.0)}, {'range': -np.arange(20.0)}],
    'nan': [{'range': np.append(np.arange(19.0), np.nan)}, {'iq': np.full((20, 4), np.nan)}],
    'silent': [{'iq': np.zeros((20, 4))}],
    'out_of_range': [
        {'range': np.arange(20.0) - 3.0}, {'range': 1e5 + np.arange(20.0)}, {'sound_speed': 15.0},
        *({'iq': np.full((20, 4), size)} for size in (1e-150, 5e-324, 1e200)),
        {'frequency': 455.0}, {'element_spacing': -0.1}, {'sample_rate': np.nan},
        {'element_spacing': 1.0, 'frequency': 1e6, 'sound_speed': 1500.0},
    ],
}  # fmt: skip


@pytest.mark.parametrize('code', BAD_SNAPSHOTS)
def test_what_cannot_be_used_is_refused_with_its_reason(code):
    for changes in BAD_SNAPSHOTS[code]:
        assert reason(snapshot, **changes) == code, changes


def test_bins_that_are_spoilt_or_of_another_size_are_kept_and_marked():
    iq = np.ones((20, 4), complex)
    iq[2], iq[4], iq[3, 1], iq[7], iq[9, 0] = 1e-200, 1e200, np.nan, 0.0, np.inf
    assert np.flatnonzero(~snapshot(iq=iq).usable).tolist() == [2, 3, 4, 7, 9]
    assert len(snapshot(bins=MAX_BINS, staves=2)) == MAX_BINS


def test_variances_that_are_none_become_unknown():
    for value in (5e-324, 1e-200, 1e200, np.inf, 0.0, -1.0):
        assert snapshot(noise_variance=np.full(20, value)).noise_variance is None
    variances = np.append([0.0, -1.0, np.inf], np.full(17, 2.0))
    ping = snapshot(noise_variance=variances, signal_variance=np.zeros(20))
    assert np.isnan(ping.noise_variance[:3]).all() and (ping.noise_variance[3:] == 2.0).all()
    assert ping.signal_variance is None


def test_ranges_of_times_and_the_spacing_in_wavelengths_follow_the_sound_speed():
    """Ranges those of the sonar, where it knows it."""
    time = (17.0 + 0.05 * np.arange(20)) / 750.0
    assert np.allclose(snapshot(two_way_time=time).ranges(1480.0), 740.0 * time)
    for known in (snapshot(two_way_time=time, sound_speed=1500.0), snapshot()):
        assert (known.ranges(1480.0) == known.range).all()
    array = {'element_spacing': 0.00165, 'frequency': 455e3}
    assert snapshot(**array, sound_speed=1500.0).spacing_wavelengths == pytest.approx(0.5005)
    assert snapshot(**array).spacing_wavelengths is None


# -- records of a fathometer ----------------------------------------------------------------------

M = 5


def reason_of(make, **fields):
    return reason(make, **{'stamp_ns': 1, **fields})


def trace(**changes):
    return {'depth': np.arange(10.0), 'amplitude': np.ones(10), **changes}


def spectra(**changes):
    rng = np.random.default_rng(0)
    p = rng.standard_normal((7, M, 20)) + 1j * rng.standard_normal((7, M, 20))
    R = p @ p.conj().swapaxes(1, 2) / 20
    return {'frequency': 100.0 + np.arange(7.0), 'csdm': R, **changes}


def test_traces_that_cannot_be_used():
    for changes, code in (
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
    ):
        assert reason_of(Trace, **trace(**changes)) == code


def test_a_trace_keeps_what_it_can():
    sigma = np.ones(10)
    sigma[:3] = np.nan, -1.0, 0.0
    item = Trace(stamp_ns=1, **trace(sigma=sigma, reference_depth=np.nan))
    assert np.isnan(item.sigma[:3]).all() and (item.sigma[3:] == 1.0).all()
    assert item.reference_depth is None
    assert item.step == 1.0
    assert Trace(stamp_ns=1, **trace(sigma=np.zeros(10))).sigma is None


def changed(R, at, value):
    R = R.copy()
    R[at] = value
    return R


def overflowing(R):
    """Cross terms and powers at the two ends of single precision."""
    return changed((R * 1e-40).astype(np.complex64), np.s_[:, [0, 1], [1, 0]], 1e38)


def boundless(R, rows, columns):
    """Doubles of which two have no finite sum, at both places of a pair."""
    R = R.astype(np.complex128)
    R[:, rows, columns] = 1e308 * (1 + 1j * np.not_equal(rows, columns))
    R[:, columns, rows] = R[:, rows, columns].conj()
    return R


TWO = np.outer(np.arange(M) < 2, np.arange(M) < 2)
BAD_SPECTRA = [
    (lambda R: boundless(R, *np.diag_indices(M)), 'nan'),
    (lambda R: boundless(R, 0, 1), 'not_hermitian'),
    (lambda R: changed(R, (2, 0, 1), R[2, 0, 1] + 1j), 'not_hermitian'),
    (overflowing, 'not_positive'),
    (lambda R: changed(R, np.s_[:, [0, 1], [1, 0]], 30.0 * R[:, [0, 1], [1, 0]]), 'not_positive'),
    (lambda R: np.full_like(R, np.nan), 'nan'),
    (lambda R: np.zeros_like(R), 'silent'),
    (lambda R: R[:3], 'bad_shape'),
    (lambda R: R[:, :2], 'bad_shape'),
    (lambda R: R[:, :2, :2], 'bad_hydrophones'),
    (lambda R: R[0], 'bad_shape'),
    (lambda R: R * TWO, 'dead_hydrophones'),
]


@pytest.mark.filterwarnings('error')
def test_cross_spectra_that_cannot_be_used():
    R = spectra()['csdm']
    for change, code in BAD_SPECTRA:
        assert reason_of(CrossSpectra, **spectra(csdm=change(R))) == code
    for frequency, code in (
        (np.ones(7), 'bad_frequency'),
        (np.full(7, np.inf), 'nan'),
        (np.arange(-3.0, 4.0), 'out_of_range'),
    ):
        assert reason_of(CrossSpectra, **spectra(frequency=frequency)) == code
    one = {name: value[:1] for name, value in spectra().items()}
    assert reason_of(CrossSpectra, **one) == 'too_short'


@pytest.mark.filterwarnings('error')
def test_dead_hydrophones_and_bad_rows_are_masked_and_any_loudness_is_taken():
    R = spectra()['csdm']
    for loudness in (1e-38, 1e-20, 1.0, 3e37):
        quiet = (R * loudness).astype(np.complex64)
        assert CrossSpectra(stamp_ns=1, **spectra(csdm=quiet)).alive.all()
    dead = [changed(changed(R, np.s_[:, 2], x), np.s_[:, :, 2], x) for x in (0.0, np.nan)]
    for csdm in (*dead, boundless(R, 2, 2)):  # also one whose powers have no sum
        item = CrossSpectra(stamp_ns=1, **spectra(csdm=csdm))
        assert np.flatnonzero(~item.alive).tolist() == [2] and item.usable.all()
    item = CrossSpectra(stamp_ns=1, **spectra(csdm=changed(R, (3, 0, 1), np.nan)))
    assert item.alive.all() and np.flatnonzero(~item.usable).tolist() == [3]


def samples():
    return np.random.default_rng(0).standard_normal((50, M)).astype(np.float32)


def test_pressure_that_cannot_be_used():
    for pressure, rate, code in (
        (samples()[:1], 100.0, 'too_short'),
        (samples()[:, :2], 100.0, 'bad_hydrophones'),
        (samples()[:, 0], 100.0, 'bad_shape'),
        (samples(), np.nan, 'out_of_range'),
        (samples(), 0.0, 'out_of_range'),
        (samples() * np.nan, 100.0, 'nan'),
        (samples() * 0.0, 100.0, 'silent'),
        (samples() * (np.arange(M) < 2), 100.0, 'dead_hydrophones'),
        (samples().astype(float) * 1e300, 100.0, 'nan'),
    ):
        assert reason_of(Pressure, pressure=pressure, sample_rate=rate) == code


def test_a_hydrophone_with_a_lost_sample_is_masked():
    p = samples()
    p[7, 1], p[:, 3] = np.nan, 2.5
    item = Pressure(stamp_ns=1, pressure=p, sample_rate=100.0)
    assert item.alive.tolist() == [True, False, True, False, True]
    assert np.isfinite(item.pressure).all()
    assert item.duration_ns == 500_000_000
    assert reason_of(Pressure, pressure=p, sample_rate=100.0, stamp_ns=0) == 'bad_stamp'
    for depth, code in ((np.nan, 'nan'), (1e6, 'out_of_range')):
        assert reason_of(measurements.ArrayDepth, depth=depth) == code
