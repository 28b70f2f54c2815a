# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Scenes of sea floor: what they promise, and what the staves hear."""

import math

import numpy as np
import pytest

from sonar_imm.acoustics import array, coherence, variances
from sonar_imm.measurements import Snapshot
from sonar_imm.parameters import ConfigError
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, SCENARIOS, simulate, snr


def run(name='paper', seed=1, **overrides):
    scene = simulate(scenario(name, {'pings': 4, **overrides}), seed)
    received = [item.measurement for item in scene.measurements]
    snapshots = [item for item in received if isinstance(item, Snapshot)]
    return list(zip(snapshots, scene.truth))


@pytest.mark.parametrize('name', SCENARIOS)
def test_the_truth_of_every_scenario_is_that_of_its_snapshots(name):
    for snapshot, true in run(name, seed=5):
        assert snapshot.stamp_ns == true.stamp_ns
        assert snapshot.frame_id == ('sonar' if name.startswith('moving') else true.frame_id)
        assert snapshot.usable.all() and (snapshot.range == true.range).all()
        assert np.isfinite(true.height).all() and true.valid.any()


def test_the_scene_of_the_paper():
    config = scenario('paper')
    snapshot, true = run(pings=1)[0]
    assert snapshot.iq.shape == (1200, 8) and snapshot.bin_width == pytest.approx(0.05)
    assert snapshot.range[0] == 17.0 and snapshot.range[-1] < 77.0
    assert snapshot.spacing_wavelengths == pytest.approx(0.5)
    assert (true.height[~true.patch] == 0.0).all() and true.patch.sum() == 200
    decibels = 10.0 * np.log10(snr(config, snapshot.range))
    assert decibels[0] == 30.0 and decibels[-1] == pytest.approx(10.0, abs=0.02)
    assert (np.diff(decibels) < 0.0).all()


def test_patch_heights_have_their_deviation_and_correlation():
    smooth = [true.height[true.patch] for _, true in run('correlated', pings=200)]
    assert np.std(smooth) == pytest.approx(0.5, rel=0.1)
    # A Gaussian kernel of 1 m correlates neighbours 1 m apart by exp(-1/4).
    lag = np.mean([h[20:] * h[:-20] for h in smooth]) / np.mean(np.square(smooth))
    assert lag == pytest.approx(np.exp(-0.25), abs=0.05)


def test_slope_undulation_and_drift():
    _, slope = run('slope')[0]
    smooth = ~slope.patch
    assert np.allclose(slope.height[smooth], 0.1 * (slope.range - 17.0)[smooth])
    _, waves = run('undulating')[0]
    assert waves.height[~waves.patch].max() == pytest.approx(0.5, abs=0.01)
    starts = [true.range[true.patch][0] for _, true in run('drifting_patch')]
    assert np.allclose(np.diff(starts), 0.2, atol=0.06)


def test_the_water_column_has_no_floor():
    snapshot, true = run('water_column', pings=1)[0]
    assert (true.valid == (true.range >= 15.0)).all() and snapshot.noise_variance is None
    assert np.isnan(true.angle[~true.valid]).all() and np.isnan(true.xyz[0, 1])
    power = variances.mean_power(snapshot.iq)
    assert power[~true.valid].mean() == pytest.approx(1.0, rel=0.2)
    assert power[true.valid][:40].mean() > 100.0


def test_spikes_are_strong_and_incoherent():
    plain, spiky = (run(name, pings=1)[0][0] for name in ('paper', 'spikes'))
    ratio = variances.mean_power(spiky.iq) / variances.mean_power(plain.iq)
    spikes = ratio > 8.0
    assert 0.06 < spikes.mean() < 0.14
    gamma = coherence.coherence(spiky.iq, 0.5)[0]
    assert np.median(gamma[spikes]) < 0.5 < 0.9 < np.median(gamma[~spikes])


def test_surface_echoes_come_from_the_surface_and_the_mirrored_floor():
    options = {'sonar_depth': 10.0, 'multipath_level_db': 40.0, 'patch_std': 0.0, 'pings': 30}
    pings = run('multipath', **options)
    R = np.mean([s.iq[200:201].T @ s.iq[200:201].conj() for s, _ in pings], axis=0)
    values, vectors = np.linalg.eigh(R)
    assert values[-2] > 20.0 * values[-3]
    true = pings[0][1]
    sines = array.multipath_sines(15.0, true.range[200], np.deg2rad(30.0), 10.0)
    for sine in np.atleast_1d(sines)[np.isfinite(sines)]:
        a = array.steering(sine, 8, 0.5) / np.sqrt(8.0)
        assert np.linalg.norm(vectors[:, -2:].conj().T @ a) > 0.99


def test_both_sides_have_names_and_one_frame():
    scene = simulate(scenario('two_sides', {'pings': 2}), 1)
    assert [item.namespace for item in scene.measurements] == ['port', 'starboard'] * 2
    assert [true.namespace for true in scene.truth] == ['port', 'starboard'] * 2
    alone = simulate(scenario('paper', {'pings': 1}), 1)
    assert {item.namespace for item in (*alone.measurements, *alone.truth)} == {''}
    port, starboard = scene.truth[:2]
    assert (port.xyz[:, 1] > 0.0).all() and (starboard.xyz[:, 1] < 0.0).all()
    assert port.frame_id == starboard.frame_id == scene.frame_id
    assert port.stamp_ns == starboard.stamp_ns
    # Received when the last echo is.
    assert scene.measurements[0].received_ns - port.stamp_ns == pytest.approx(102.6e6, abs=1e5)


@pytest.mark.parametrize(
    'overrides, word',
    [
        ({'last_range': 17.0}, 'last_range'),
        ({'bin_width': 0.001, 'last_range': 500.0}, 'bin_width'),
        ({'patch_start': 60.0}, 'patch_end'),
        ({'shadows': [30.0]}, 'pairs'),
        ({'shadows': [30.0, 20.0]}, 'pairs'),
        ({'staves': 1}, 'between 2 and 64'),
    ],
)
def test_mistakes_are_named(overrides, word):
    with pytest.raises(ConfigError, match=word):
        scenario('paper', overrides)


def test_noise_that_does_not_fade_is_the_same_everywhere():
    shadow = {'shadows': (17.0, 37.0), 'pings': 40}
    spread = {}
    for fades in (True, False):
        pings = [ping.iq[:400] for ping, _ in run(noise_fades=fades, **shadow)]
        power = variances.mean_power(np.concatenate(pings))
        assert power.mean() == pytest.approx(1.0, abs=0.03)
        spread[fades] = power.var()
    # z Gamma(8)/8 against Gamma(8)/8
    assert spread[True] == pytest.approx(1.25, rel=0.15)
    assert spread[False] == pytest.approx(1.0 / 8.0, rel=0.1)


def test_other_laws_of_rough_floor():
    laplace = [true.height[true.patch] for _, true in run(roughness_law='laplace', pings=60)]
    laplace = np.concatenate(laplace)
    assert laplace.std() == pytest.approx(0.5, rel=0.05)
    assert (laplace**4).mean() / laplace.var() ** 2 == pytest.approx(6.0, rel=0.25)
    everywhere = {'roughness_law': 'fractal', 'pings': 60, 'patch_end': 77, 'patch_start': 17}
    fractal = [true.height for _, true in run(**everywhere)]
    spectrum = np.mean([np.square(np.abs(np.fft.rfft(item))) for item in fractal], axis=0)
    low, high = spectrum[4:8].mean(), spectrum[40:80].mean()
    assert low / high == pytest.approx(100.0, rel=0.4)
    assert np.std(fractal) == pytest.approx(0.5, rel=0.05)
    changes = {'roughness_law': 'exponential', 'correlation_length': 1.0, 'pings': 60}
    rough = np.stack([true.height[true.patch] for _, true in run(**changes)])
    assert rough.std() == pytest.approx(0.5, rel=0.1)
    after = (rough[:, :-20] * rough[:, 20:]).mean() / rough.var()
    assert after == pytest.approx(np.exp(-1.0), abs=0.1)


@pytest.mark.parametrize('law', ['gaussian', 'laplace', 'exponential'])
def test_roughness_without_a_correlation_length_is_white(law):
    changes = {'roughness_law': law, 'correlation_length': 0.0, 'pings': 30}
    rough = np.stack([true.height[true.patch] for _, true in run(**changes)])
    assert rough.std() == pytest.approx(0.5, rel=0.05)
    assert abs((rough[:, :-1] * rough[:, 1:]).mean() / rough.var()) < 0.05


TILT, SPACING, STAVES, NOISE = 37.0, 0.37, 5, 2.5
# -- what the staves hear, by geometry and statistics that share nothing with the simulator ------

ODD = {
    'tilt_deg': TILT, 'spacing_wavelengths': SPACING, 'staves': STAVES, 'noise_variance': NOISE,
    'sonar_height': 13.0, 'snr_near_db': 9.0, 'snr_far_db': 9.0,
}  # fmt: skip
SIGNAL = NOISE * 10.0**0.9


def odd(pings=10, seed=1, **overrides):
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
    for snapshot, true in odd(law=law, side=side, conjugate=conjugate):
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


@pytest.mark.parametrize('law, kurtosis', [('laplace', 4.0), ('gaussian', 2.0), ('k', 6.0)])
def test_the_law_of_amplitudes(law, kurtosis):
    """E |y|^4 / (E |y|^2)^2 is 2 for a circular Gaussian, times E z^2 = 2 for the Laplace law,
    times 1 + 1 / shape, 3, for the K law. Bins are independent."""
    given = {'law': law, 'texture_shape': 0.5, 'snr_near_db': 30.0, 'snr_far_db': 30.0}
    y = np.concatenate([snapshot.iq[:, 2] for snapshot, _ in odd(pings=60, **given)])
    power = np.abs(y.astype(complex)) ** 2
    assert np.mean(power**2) / np.mean(power) ** 2 == pytest.approx(kurtosis, rel=0.1)
    # Circular: no phase is preferred.
    assert abs(np.mean(y**2)) < 0.05 * np.mean(power)
    assert abs(np.mean(y[1:] * y[:-1].conj())) < 0.03 * np.mean(power)


def test_the_signal_falls_by_decibels_over_the_logarithm_of_range():
    """From 24 dB at 17 m to 6 dB at 77 m: 15 dB at their geometric mean, 36.2 m."""
    pings = odd(pings=60, snr_near_db=24.0, snr_far_db=6.0, patch_std=0.0)
    power = np.mean([np.abs(snapshot.iq) ** 2 for snapshot, _ in pings], axis=(0, 2))
    r = pings[0][0].range
    middle = np.abs(r - math.sqrt(17.0 * 77.0)) < 0.5
    assert power[middle].mean() == pytest.approx(NOISE * (1.0 + 10.0**1.5), rel=0.1)
    last = r > 76.0
    assert power[last].mean() == pytest.approx(NOISE * (1.0 + 10.0**0.6), rel=0.1)


@pytest.mark.parametrize('side, sign', [('port', 1.0), ('starboard', -1.0)])
def test_the_truth_is_one_floor_in_four_ways(side, sign):
    _, true = odd(pings=1, side=side, slope=0.05)[0]
    x, y, z = true.xyz.T
    assert (x == 0.0).all() and (sign * y > 0.0).all()
    np.testing.assert_allclose(np.hypot(y, z), true.range, rtol=1e-12)
    np.testing.assert_allclose(z, true.height - 13.0, atol=1e-12)
    below_horizon = np.degrees(np.arctan2(-z, np.abs(y)))
    np.testing.assert_allclose(np.degrees(true.angle), below_horizon - TILT, atol=1e-9)


def test_stamps_and_what_the_snapshot_says_of_the_sonar():
    pings = odd(pings=3, ping_rate=4.0, frequency=200e3, sound_speed=1480.0, bin_width=0.1)
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
    pings = odd(pings=60, state_signal=True, shadows=[30.0, 35.0], patch_std=0.0)
    given = pings[0][0].signal_variance
    dark = (pings[0][1].range >= 30.0) & (pings[0][1].range < 35.0)
    assert np.isnan(given[dark]).all()  # no signal is none to state
    assert (pings[0][1].valid == ~dark).all()
    assert given[~dark] == pytest.approx(SIGNAL)
    power = np.mean([np.abs(snapshot.iq) ** 2 for snapshot, _ in pings], axis=(0, 2))
    assert power[dark].mean() == pytest.approx(NOISE, rel=0.1)
    assert power[~dark].mean() == pytest.approx(SIGNAL + NOISE, rel=0.05)


def test_the_first_pings_do_not_depend_on_how_many_follow():
    few, many = odd(pings=2), odd(pings=4)
    for (first, true), (other, same_true) in zip(few, many):
        assert np.array_equal(first.iq, other.iq) and np.array_equal(true.height, same_true.height)
    assert not np.array_equal(few[0][0].iq, few[1][0].iq)


@pytest.mark.parametrize('decorrelation', [0.0, 0.4])
def test_decorrelation_takes_from_the_common_wave_and_leaves_the_power(decorrelation):
    products = []
    for snapshot, true in odd(40, decorrelation=decorrelation):
        echo = snapshot.iq * np.exp(-1j * phases(true))
        products.append(echo.T @ echo.conj() / len(echo))
    covariance = np.mean(products, axis=0)
    assert np.trace(covariance).real / STAVES == pytest.approx(SIGNAL + NOISE, rel=0.05)
    assert covariance[0, 1].real == pytest.approx((1.0 - decorrelation) * SIGNAL, rel=0.05)
