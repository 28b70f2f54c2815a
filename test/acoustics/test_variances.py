# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

import numpy as np
import pytest

from sonar_imm.acoustics import variances
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate, snr


@pytest.fixture(scope='module')
def pings():
    scene = simulate(scenario('paper', {'pings': 12}), 7)
    return [(entry.measurement, true) for entry, true in zip(scene.measurements, scene.truth)]


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
    errors = [
        variances.signal_variance(variances.mean_power(ping.iq), 1.0) / snr(config, ping.range)
        for ping, _ in pings
    ]
    decibels = 10.0 * np.log10(np.concatenate(errors))
    assert abs(decibels.mean()) < 0.5 and decibels.std() < 2.0


def test_silence_leaves_a_floor_and_spoilt_bins_do_not_count(pings):
    ping, _ = pings[0]
    noise = np.full(len(ping), 1e9)
    floor = variances.signal_variance(variances.mean_power(ping.iq), noise)
    assert (floor == variances.LEAST_SNR * 1e9).all()
    power = variances.mean_power(ping.iq)
    clean = variances.signal_variance(power, 1.0)
    usable = np.ones(len(ping), bool)
    usable[500] = False
    spoilt = power.copy()
    spoilt[500] = np.nan
    found = variances.signal_variance(spoilt, 1.0, usable=usable)
    assert np.isfinite(found).all() and np.abs(10.0 * np.log10(found / clean)).max() < 6.0
    assert (found[:490] == clean[:490]).all()


def test_noise_from_the_water_column():
    config = scenario('water_column', {'pings': 1, 'noise_variance': 3.0})
    ping = simulate(config, 3).measurements[0].measurement
    assert ping.noise_variance is None
    assert variances.noise_variance(ping.iq, ping.range < 14.0) == pytest.approx(3.0, rel=0.2)
    assert np.isnan(variances.noise_variance(ping.iq, ping.range < 0.0))


def test_blind_noise_is_right_within_two_decibels(pings):
    found = [variances.blind_noise_variance(ping.iq) for ping, _ in pings]
    assert np.abs(10.0 * np.log10(found)).max() < 2.0
    assert np.isnan(variances.blind_noise_variance(pings[0][0].iq[:5]))


def test_blind_noise_is_that_beside_one_echo_which_takes_a_share_of_it():
    rng = np.random.default_rng(6)
    parts = rng.normal(size=(20_000, 7, 2)).view(np.complex128)[..., 0] / np.sqrt(2.0)
    iq = parts[:, :6] + 30.0 * parts[:, 6:] * np.exp(0.4j * np.arange(6))
    iq *= np.sqrt(rng.exponential(size=(20_000, 1)))
    for half_width in (2, 4, 7):
        assert variances.blind_noise_variance(iq, half_width) == pytest.approx(1.0, rel=0.06)


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('unit', [1e-30, 1e-9, 3.0, 1e9, 1e17])
def test_the_unit_of_samples_changes_no_decorrelation(unit):
    """Samples come in single precision, whose range their fourth powers leave."""
    rng = np.random.default_rng(5)
    echo = rng.normal(size=(60, 1)) + 1j * rng.normal(size=(60, 1))
    own = rng.normal(size=(60, 4)) + 1j * rng.normal(size=(60, 4))
    iq = echo + 0.5 * own
    iq[20:40] = 0.0  # silence says nothing
    every = np.ones(60, bool)
    known = variances.decorrelation(iq.astype(np.complex64), every)
    assert 0.05 < known < 0.5
    assert variances.decorrelation((unit * iq).astype(np.complex64), every) == pytest.approx(
        known, rel=1e-4
    )
    assert np.isnan(variances.decorrelation(0.0 * iq, every))


def test_loud_stretches_of_the_water_are_no_noise():
    rng = np.random.default_rng(3)
    noise = rng.normal(size=(400, 4, 2)).view(np.complex128)[..., 0]
    noise *= np.sqrt(rng.exponential(size=(400, 1)))
    quiet = np.arange(400) < 320
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


@pytest.mark.parametrize('staves', [2, 8])
def test_a_water_column_of_fading_noise_is_kept_whole(staves):
    rng = np.random.default_rng(4)
    for bins in (40, 150, 1500):
        for _ in range(40):
            noise = rng.normal(size=(bins, staves, 2)).view(np.complex128)[..., 0]
            noise *= np.sqrt(rng.exponential(size=(bins, 1)))
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
