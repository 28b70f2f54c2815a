# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the staves hear, by geometry and statistics that share nothing with the simulator."""

import math

import numpy as np
import pytest

from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

TILT, SPACING, STAVES, NOISE = 37.0, 0.37, 5, 2.5
ODD = {
    'tilt_deg': TILT, 'spacing_wavelengths': SPACING, 'staves': STAVES, 'noise_variance': NOISE,
    'sonar_height': 13.0, 'snr_near_db': 9.0, 'snr_far_db': 9.0,
}  # fmt: skip
SIGNAL = NOISE * 10.0**0.9


def run(pings=10, seed=1, **overrides):
    scene = simulate(scenario('paper', {**ODD, 'pings': pings, **overrides}), seed)
    return [(item.measurement, true) for item, true in zip(scene.measurements, scene.truth)]


def phases(true, wavelengths=SPACING, staves=STAVES):
    """Phase (n, staves) of each stave against stave 0 for a plane wave from the true points: by
    the lengths of its paths to points along the array."""
    outward, down = np.abs(true.xyz[:, 1]), -true.xyz[:, 2]
    axis = np.array([-math.sin(math.radians(TILT)), math.cos(math.radians(TILT))])
    place = np.arange(staves)[:, None] * wavelengths * axis
    direction = np.column_stack([outward, down]) / np.hypot(outward, down)[:, None]
    return 2.0 * math.pi * direction @ place.T


@pytest.mark.parametrize('side, conjugate', [('starboard', False), ('port', True)])
@pytest.mark.parametrize('law', ['laplace', 'gaussian'])
def test_the_covariance_of_a_snapshot_is_one_plane_wave_and_white_noise(law, side, conjugate):
    aligned = []
    for snapshot, true in run(law=law, side=side, conjugate=conjugate):
        turn = np.exp((1j if conjugate else -1j) * phases(true))
        aligned.append(snapshot.iq * turn)
    y = np.concatenate(aligned)
    assert len(y) == 12_000
    covariance = y.T @ y.conj() / len(y)
    expected = SIGNAL * np.ones((STAVES, STAVES)) + NOISE * np.eye(STAVES)
    # Sums of 12,000 products whose relative spread is sqrt(2 * 2 - 1) at most: 1.6 %.
    assert np.abs(covariance - expected).max() < 0.06 * expected[0, 0]
    # The noise alone, from differences of neighbours, in which the wave cancels.
    alone = 0.5 * np.mean(np.abs(np.diff(y, axis=1)) ** 2)
    assert alone == pytest.approx(NOISE, rel=0.04)


@pytest.mark.parametrize('law, kurtosis', [('laplace', 4.0), ('gaussian', 2.0)])
def test_the_law_of_amplitudes(law, kurtosis):
    """E |y|^4 / (E |y|^2)^2 is 2 for a circular Gaussian, times E z^2 = 2 for the Laplace law."""
    y = np.concatenate([snapshot.iq for snapshot, _ in run(pings=20, law=law)])
    power = np.abs(y[:, 2].astype(complex)) ** 2
    assert np.mean(power**2) / np.mean(power) ** 2 == pytest.approx(kurtosis, rel=0.1)
    # Circular: no phase is preferred.
    assert abs(np.mean(y[:, 2] ** 2)) < 0.05 * np.mean(power)


def test_bins_are_independent():
    y = np.concatenate([snapshot.iq[:, 0] for snapshot, _ in run()])
    assert abs(np.mean(y[1:] * y[:-1].conj())) < 0.03 * np.mean(np.abs(y) ** 2)


def test_the_signal_falls_by_decibels_over_the_logarithm_of_range():
    """From 24 dB at 17 m to 6 dB at 77 m: 15 dB at their geometric mean, 36.2 m."""
    pings = run(pings=60, snr_near_db=24.0, snr_far_db=6.0, patch_std=0.0)
    power = np.mean([np.abs(snapshot.iq) ** 2 for snapshot, _ in pings], axis=(0, 2))
    r = pings[0][0].range
    middle = np.abs(r - math.sqrt(17.0 * 77.0)) < 0.5
    assert power[middle].mean() == pytest.approx(NOISE * (1.0 + 10.0**1.5), rel=0.1)
    last = r > 76.0
    assert power[last].mean() == pytest.approx(NOISE * (1.0 + 10.0**0.6), rel=0.1)


@pytest.mark.parametrize('side, sign', [('port', 1.0), ('starboard', -1.0)])
def test_the_truth_is_one_floor_in_four_ways(side, sign):
    _, true = run(pings=1, side=side, slope=0.05)[0]
    x, y, z = true.xyz.T
    assert (x == 0.0).all() and (sign * y > 0.0).all()
    np.testing.assert_allclose(np.hypot(y, z), true.range, rtol=1e-12)
    np.testing.assert_allclose(z, true.height - 13.0, atol=1e-12)
    below_horizon = np.degrees(np.arctan2(-z, np.abs(y)))
    np.testing.assert_allclose(np.degrees(true.angle), below_horizon - TILT, atol=1e-9)


def test_stamps_and_what_the_snapshot_says_of_the_sonar():
    pings = run(pings=3, ping_rate=4.0, frequency=200e3, sound_speed=1480.0, bin_width=0.1)
    stamps = [snapshot.stamp_ns for snapshot, _ in pings]
    assert np.diff(stamps).tolist() == [250_000_000] * 2
    first = pings[0][0]
    assert first.element_spacing == pytest.approx(SPACING * 1480.0 / 200e3)
    assert first.sample_rate == pytest.approx(7400.0)  # 0.1 m there and back
    assert first.noise_variance.tolist() == [NOISE] * len(first)
    scene = simulate(scenario('paper', {**ODD, 'pings': 1, 'sound_speed': 1480.0}), 1)
    listened = scene.measurements[0].received_ns - stamps[0]
    assert listened == pytest.approx(2e9 * 76.95 / 1480.0, abs=1.0)


def test_what_the_snapshot_says_of_the_signal_is_what_it_holds():
    pings = run(pings=60, state_signal=True, shadows=[30.0, 35.0], patch_std=0.0)
    given = pings[0][0].signal_variance
    dark = (pings[0][1].range >= 30.0) & (pings[0][1].range < 35.0)
    assert np.isnan(given[dark]).all()  # no signal is none to state
    assert given[~dark] == pytest.approx(SIGNAL)
    power = np.mean([np.abs(snapshot.iq) ** 2 for snapshot, _ in pings], axis=(0, 2))
    assert power[dark].mean() == pytest.approx(NOISE, rel=0.1)
    assert power[~dark].mean() == pytest.approx(SIGNAL + NOISE, rel=0.05)


def test_the_first_pings_do_not_depend_on_how_many_follow():
    few, many = run(pings=2), run(pings=4)
    for (first, true), (other, same_true) in zip(few, many):
        assert np.array_equal(first.iq, other.iq) and np.array_equal(true.height, same_true.height)
    assert not np.array_equal(few[0][0].iq, few[1][0].iq)


@pytest.mark.parametrize('decorrelation', [0.0, 0.4])
def test_decorrelation_takes_from_the_common_wave_and_leaves_the_power(decorrelation):
    products = []
    for snapshot, true in run(40, decorrelation=decorrelation):
        echo = snapshot.iq * np.exp(-1j * phases(true))
        products.append(echo.T @ echo.conj() / len(echo))
    covariance = np.mean(products, axis=0)
    assert np.trace(covariance).real / STAVES == pytest.approx(SIGNAL + NOISE, rel=0.05)
    assert covariance[0, 1].real == pytest.approx((1.0 - decorrelation) * SIGNAL, rel=0.05)
