# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The Snapshot measurement: what it refuses and what it keeps."""

import numpy as np
import pytest

from sonar_imm.measurements import MAX_BINS, Rejection, Snapshot


def snapshot(bins=20, staves=4, **changes):
    rng = np.random.default_rng(0)
    values = {
        'stamp_ns': 10**18,
        'range': 17.0 + 0.05 * np.arange(bins),
        'iq': rng.normal(size=(bins, staves)) + 1j * rng.normal(size=(bins, staves)),
        'frame_id': 'sonar',
    }
    return Snapshot(**{**values, **changes})


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


@pytest.mark.parametrize(
    'reason, changes',
    [
        ('bad_stamp', {'stamp_ns': 0}),
        ('no_staves', {'staves': 0}),
        ('bad_staves', {'staves': 1}),
        ('bad_staves', {'staves': 65}),
        ('too_short', {'bins': 1}),
        ('too_short', {'bins': 0}),
        ('bad_shape', {'range': np.arange(1.0, 20.0)}),
        ('bad_shape', {'iq': np.ones(20)}),
        ('bad_shape', {'noise_variance': np.ones(19)}),
        ('bad_shape', {'two_way_time': np.ones(3)}),
        ('bad_range', {'range': np.full(20, 5.0)}),
        ('bad_range', {'range': -np.arange(20.0)}),
        ('out_of_range', {'range': np.arange(20.0) - 3.0}),
        ('out_of_range', {'range': 1e5 + np.arange(20.0)}),
        ('nan', {'range': np.append(np.arange(19.0), np.nan)}),
        ('nan', {'iq': np.full((20, 4), np.nan)}),
        ('silent', {'iq': np.zeros((20, 4))}),
        ('out_of_range', {'iq': np.full((20, 4), 1e-150)}),
        ('out_of_range', {'iq': np.full((20, 4), 5e-324)}),
        ('out_of_range', {'iq': np.full((20, 4), 1e200)}),
        ('out_of_range', {'sound_speed': 15.0}),
        ('out_of_range', {'frequency': 455.0}),
        ('out_of_range', {'element_spacing': -0.1}),
        ('out_of_range', {'sample_rate': np.nan}),
        ('out_of_range', {'element_spacing': 1.0, 'frequency': 1e6, 'sound_speed': 1500.0}),
    ],
)
def test_what_cannot_be_used_is_refused_with_its_reason(reason, changes):
    with pytest.raises(Rejection) as caught:
        snapshot(**changes)
    assert caught.value.reason == reason and caught.value.sentence


@pytest.mark.parametrize('value', [5e-324, 1e-200, 1e200, np.inf, 0.0, -1.0])
def test_a_variance_that_is_none_is_not_known(value):
    assert snapshot(noise_variance=np.full(20, value)).noise_variance is None


def test_bins_of_another_size_are_left_out():
    iq = np.ones((20, 4), complex)
    iq[3], iq[4] = 1e-200, 1e200
    assert (~snapshot(iq=iq).usable).nonzero()[0].tolist() == [3, 4]


def test_a_storm_of_bins_is_refused():
    with pytest.raises(Rejection) as caught:
        snapshot(bins=MAX_BINS + 1, staves=2)
    assert caught.value.reason == 'too_large'
    assert len(snapshot(bins=MAX_BINS, staves=2)) == MAX_BINS


def test_spoilt_bins_are_kept_and_marked():
    iq = np.array(snapshot().iq)
    iq[3, 1], iq[7], iq[9, 0] = np.nan, 0.0, np.inf
    ping = snapshot(iq=iq)
    assert np.flatnonzero(~ping.usable).tolist() == [3, 7, 9]


def test_variances_that_are_none_become_unknown():
    variances = np.full(20, 2.0)
    variances[:3] = [0.0, -1.0, np.inf]
    ping = snapshot(noise_variance=variances, signal_variance=np.zeros(20))
    assert np.isnan(ping.noise_variance[:3]).all() and (ping.noise_variance[3:] == 2.0).all()
    assert ping.signal_variance is None


def test_spacing_in_wavelengths_when_all_is_known():
    ping = snapshot(element_spacing=0.00165, frequency=455e3, sound_speed=1500.0)
    assert ping.spacing_wavelengths == pytest.approx(0.5005)
    assert snapshot(element_spacing=0.00165, frequency=455e3).spacing_wavelengths is None


def test_ranges_of_times_follow_the_sound_speed_unless_the_sonar_knows_it():
    time = (17.0 + 0.05 * np.arange(20)) / 750.0
    assert np.allclose(snapshot(two_way_time=time).ranges(1480.0), 740.0 * time)
    known = snapshot(two_way_time=time, sound_speed=1500.0)
    assert (known.ranges(1480.0) == known.range).all()
    assert (snapshot().ranges(1480.0) == snapshot().range).all()
