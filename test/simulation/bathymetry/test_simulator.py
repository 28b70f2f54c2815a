# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Scenes of sea floor and of objects and ships: what they promise, and what the staves hear."""

import math

import numpy as np
import pytest

from benchmarks.bathymetry_paper import truth_of
from sonar_imm.acoustics import array, coherence, geometry, sounding, variances
from sonar_imm.measurements import Navigation, Snapshot
from sonar_imm.parameters import ConfigError
from sonar_imm.soundings import soundings_of
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.evaluation.bathymetry.scoring import profiles_of, score
from sonar_imm_tools.simulation.bathymetry import objects, simulator
from sonar_imm_tools.simulation.bathymetry.ship import in_outline, ship_of, Terrain
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, SCENARIOS, simulate


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
    decibels = 10.0 * np.log10(simulator.snr(config, snapshot.range))
    assert decibels[0] == 30.0 and decibels[-1] == pytest.approx(10.0, abs=0.02)
    assert (np.diff(decibels) < 0.0).all()


def test_patch_heights_have_their_deviation_and_correlation():
    smooth = [true.height[true.patch] for _, true in run('correlated', pings=200)]
    assert np.std(smooth) == pytest.approx(0.5, rel=0.1)
    # A Gaussian kernel of 1 m correlates neighbours 1 m apart by exp(-1/4).
    lag = np.mean([h[20:] * h[:-20] for h in smooth]) / np.mean(np.square(smooth))
    assert lag == pytest.approx(np.exp(-0.25), abs=0.05)


def test_slope_undulation_drift_shadows_and_the_water_column():
    _, shadow = run('shadow', pings=1)[0]
    assert shadow.valid.mean() == pytest.approx(1.0 - 8.0 / 60.0, abs=0.01)
    _, slope = run('slope')[0]
    smooth = ~slope.patch
    assert np.allclose(slope.height[smooth], 0.1 * (slope.range - 17.0)[smooth])
    _, waves = run('undulating')[0]
    assert waves.height[~waves.patch].max() == pytest.approx(0.5, abs=0.01)
    starts = [true.range[true.patch][0] for _, true in run('drifting_patch')]
    assert np.allclose(np.diff(starts), 0.2, atol=0.06)
    snapshot, true = run('water_column', pings=1)[0]
    assert (true.valid == (true.range >= 15.0)).all() and snapshot.noise_variance is None
    assert np.isnan(true.angle[~true.valid]).all() and np.isnan(true.xyz[0, 1])
    power = variances.mean_power(snapshot.iq)
    assert power[~true.valid].mean() == pytest.approx(1.0, rel=0.2)
    assert power[true.valid][:40].mean() > 100.0


def test_spikes_are_incoherent_and_surface_echoes_come_from_the_surface_and_the_mirrored_floor():
    plain, spiky = (run(name, pings=1)[0][0] for name in ('paper', 'spikes'))
    ratio = variances.mean_power(spiky.iq) / variances.mean_power(plain.iq)
    spikes = ratio > 8.0
    assert 0.06 < spikes.mean() < 0.14
    gamma = coherence.coherence(spiky.iq, 0.5)[0]
    assert np.median(gamma[spikes]) < 0.5 < 0.9 < np.median(gamma[~spikes])
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


def test_both_sides_have_names_and_one_frame_and_look_apart():
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
    moving = simulate(scenario('moving_two_sides', {'pings': 1, 'bin_width': 1.0}), 1)
    assert {item.namespace for item in moving.measurements} == {'', 'port', 'starboard'}
    sides = {true.namespace: true.xyz for true in moving.truth}
    left = np.array([-np.sin(np.radians(30.0)), np.cos(np.radians(30.0)), 0.0])
    assert (sides['port'] @ left > 0.0).all() and (sides['starboard'] @ left < 0.0).all()
    assert sum(isinstance(item.measurement, Snapshot) for item in moving.measurements) == 2


def test_mistakes_are_named():
    for overrides, word in (
        ({'last_range': 17.0}, 'last_range'),
        ({'bin_width': 0.001, 'last_range': 500.0}, 'bin_width'),
        ({'patch_start': 60.0}, 'patch_end'),
        ({'shadows': [30.0]}, 'pairs'),
        ({'shadows': [30.0, 20.0]}, 'pairs'),
        ({'staves': 1}, 'between 2 and 64'),
        ({'object': 'ledge', 'multipath': True}, 'multipath'),
        ({'object': 'ledge', 'object_size': 20.0}, 'object_size'),
        ({'sound_speed_profile': [0.0, 1500.0]}, 'moving'),
        ({'moving': True, 'sound_speed_profile': [0.0]}, 'in turn'),
        ({'sonar_lever': [1.0]}, 'sonar_lever needs 3'),
        ({'patch_along': [5.0, 1.0]}, 'patch_along'),
        ({'patch_outline_length': 10001.0}, 'patch_outline_length'),
        ({'patch_along': [5.0, 5.0]}, 'patch_along needs two increasing values'),
        ({'moving': True, 'multipath': True}, 'multipath'),
    ):
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


def roughness(pings=60, **changes):
    """Heights (pings, bins) of rough floor."""
    return np.stack([true.height[true.patch] for _, true in run(pings=pings, **changes)])


def test_other_laws_of_rough_floor():
    laplace = roughness(roughness_law='laplace')
    assert laplace.std() == pytest.approx(0.5, rel=0.05)
    assert (laplace**4).mean() / laplace.var() ** 2 == pytest.approx(6.0, rel=0.25)
    fractal = roughness(roughness_law='fractal', patch_end=77, patch_start=17)
    spectrum = np.mean(np.square(np.abs(np.fft.rfft(fractal))), axis=0)
    low, high = spectrum[4:8].mean(), spectrum[40:80].mean()
    assert low / high == pytest.approx(100.0, rel=0.4)
    assert fractal.std() == pytest.approx(0.5, rel=0.05)
    rough = roughness(roughness_law='exponential', correlation_length=1.0)
    assert rough.std() == pytest.approx(0.5, rel=0.1)
    after = (rough[:, :-20] * rough[:, 20:]).mean() / rough.var()
    assert after == pytest.approx(np.exp(-1.0), abs=0.1)
    for law in ('gaussian', 'laplace', 'exponential'):  # without a correlation length it is white
        white = roughness(30, roughness_law=law, correlation_length=0.0)
        assert white.std() == pytest.approx(0.5, rel=0.05)
        assert abs((white[:, :-1] * white[:, 1:]).mean() / white.var()) < 0.05


# -- what the staves hear, by geometry and statistics that share nothing with the simulator ------

TILT, SPACING, STAVES, NOISE = 37.0, 0.37, 5, 2.5
ODD = {
    'tilt_deg': TILT, 'spacing_wavelengths': SPACING, 'staves': STAVES, 'noise_variance': NOISE,
    'sonar_height': 13.0, 'snr_near_db': 9.0, 'snr_far_db': 9.0,
}  # fmt: skip
SIGNAL = NOISE * 10.0**0.9


def odd(pings=10, seed=1, **overrides):
    return run(seed=seed, **{**ODD, 'pings': pings, **overrides})


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
    wall = {'object': 'wall', 'object_size': 4.0, 'pings': 1, 'side': side, 'sonar_height': 13.0}
    _, floor = odd(pings=1, side=side, slope=0.05)[0]
    for true in (floor, simulate(scenario('ledge', wall), 1).truth[0]):
        x, y, z = true.xyz[true.valid].T
        height, there = true.height[true.valid], true.range[true.valid]
        assert (x == 0.0).all() and (sign * y > 0.0).all()
        np.testing.assert_allclose(np.hypot(y, z), there, rtol=1e-7)
        np.testing.assert_allclose(z, height - 13.0, atol=1e-7)
    assert height.max() > 3.0
    below_horizon = np.degrees(np.arctan2(-floor.xyz[:, 2], np.abs(floor.xyz[:, 1])))
    np.testing.assert_allclose(np.degrees(floor.angle), below_horizon - TILT, atol=1e-9)


def test_stamps_and_what_the_snapshot_says_of_the_sonar_however_many_follow():
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
    few, many = odd(pings=2), odd(pings=4)
    for (first, true), (other, same_true) in zip(few, many):
        assert np.array_equal(first.iq, other.iq) and np.array_equal(true.height, same_true.height)
    assert not np.array_equal(few[0][0].iq, few[1][0].iq)


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


@pytest.mark.parametrize('decorrelation', [0.0, 0.4])
def test_decorrelation_takes_from_the_common_wave_and_leaves_the_power(decorrelation):
    products = []
    for snapshot, true in odd(40, decorrelation=decorrelation):
        echo = snapshot.iq * np.exp(-1j * phases(true))
        products.append(echo.T @ echo.conj() / len(echo))
    covariance = np.mean(products, axis=0)
    assert np.trace(covariance).real / STAVES == pytest.approx(SIGNAL + NOISE, rel=0.05)
    assert covariance[0, 1].real == pytest.approx((1.0 - decorrelation) * SIGNAL, rel=0.05)


def seen(**values):
    config = scenario('ledge', values)
    ranges = config.first_range + config.bin_width * np.arange(1200)
    ratio = simulator.snr(config, ranges)
    facets = objects.facets_of(config, ranges, ratio)
    return ranges, ratio, *objects.surfaces_of(facets, len(ranges))


@pytest.mark.parametrize('kind', ['ledge', 'box', 'wall', 'boulder'])
def test_the_floor_before_an_object_has_the_ratio_of_the_scene_and_behind_it_is_a_shadow(kind):
    ranges, ratio, power, height = seen(object=kind, object_distance=50.0)
    near = (ranges > 18.0) & (ranges < 50.0)
    assert np.mean(power[near, 0] / ratio[near]) == pytest.approx(1.0, abs=0.01)
    assert np.abs(power[near, 0] / ratio[near] - 1.0).max() < 0.35  # whole facets
    assert np.abs(height[near, 0]).max() < 1e-12 and (power[near, 1:] == 0.0).all()
    if kind == 'ledge':
        return
    ranges, _, power, _ = seen(object=kind, object_distance=30.0, object_size=3.0)
    begin, end = ranges[power.sum(axis=1) == 0.0][[0, -1]]
    assert begin > 32.0
    if kind == 'wall':  # the ray over its far edge meets the floor there
        assert end == pytest.approx(math.hypot(30.2 * 15.0 / 12.0, 15.0), abs=0.1)
    assert (power[ranges > end + 0.1, 3] > 0.0).all()


def test_a_ledge_has_its_face_before_the_foot_and_its_top_with_the_floor():
    ranges, _, power, height = seen(object_distance=30.0, object_size=2.0)
    foot, edge = math.hypot(30.0, 15.0), math.hypot(30.0, 13.0)
    face = np.flatnonzero(power[:, 1])
    assert ranges[face[0]] == pytest.approx(edge, abs=0.06)
    assert ranges[face[-1]] == pytest.approx(foot, abs=0.06)
    both = (ranges > edge + 0.1) & (ranges < foot - 0.1)
    assert (power[both][:, :3] > 0.0).all()
    # The face at range r is at the height where 15 - z = sqrt(r^2 - 30^2).
    expected = 15.0 - np.sqrt(ranges[both] ** 2 - 900.0)
    assert height[both, 1] == pytest.approx(expected, abs=0.08)
    number, main, second = objects.second_of(power, height)
    assert (number[both] >= 2).mean() > 0.7 and number[ranges < 32.0].max() == 1
    beside = np.isfinite(second)
    assert (np.abs(second - main)[beside] >= 0.5).all()
    np.testing.assert_array_equal(beside, number > 1)
    config = scenario('ledge', {'object': 'wall', 'object_size': 3.0})
    ranges = config.first_range + config.bin_width * np.arange(1200)
    facets = objects.facets_of(config, ranges, np.full(1200, 100.0))
    below = ranges[facets.bin] * np.sin(math.radians(config.tilt_deg) + np.arcsin(facets.sine))
    np.testing.assert_allclose(config.sonar_height - below, facets.height, atol=1e-9)
    assert facets.height.max() == 3.0
    power = np.array([[9.0, 2.0, 4.0, 8.0], [9.0, 0.0, 0.0, 8.0], [0.0, 0.0, 0.0, 0.0]])
    height = np.array([[0.0, 3.0, 2.0, 0.1]] * 3)
    number, main, second = objects.second_of(power, height)
    assert number.tolist() == [3, 1, 0]
    assert main[:2].tolist() == [0.0, 0.0]
    np.testing.assert_array_equal(second, [2.0, np.nan, np.nan])


def tracked(config, seed, **values):
    scene = simulate(config, seed)
    values = {**config.instruments(), **values}
    tracker = BathymetryTracker(BathymetryConfig.from_mapping(values))
    return scene, [y for item in scene.measurements for y in tracker.process(item.measurement)]


def test_a_wall_is_gated_and_scored():
    """The range of heights is no limit: walls of 4 m."""
    wall = {'object': 'wall', 'object_size': 4.0, 'object_distance': 26.0, 'pings': 4}
    scene, estimates = tracked(scenario('ledge', wall), 5, layover='gated')
    metrics = score(profiles_of(estimates, truth_of(scene)))
    scores = metrics['layover']
    assert scores['bins'] > 80 and scores['found'] > 0.75
    assert scores['soundings'] < 0.2 and scores['lost'] < 0.01
    assert 0.0 < metrics['two_share'] < 0.05


@pytest.mark.parametrize('side', ['port', 'starboard'])
def test_facets_below_a_ship_lie_where_the_geometry_of_soundings_puts_them(side):
    config = scenario('moving_ledge', {'object': 'wall', 'object_size': 3.0})
    ship = ship_of(config, config.sonar_depth, np.random.default_rng(1))
    ranges = config.first_range + config.bin_width * np.arange(1200)
    axes = sounding.array_axes(side, math.radians(config.tilt_deg), np.eye(3))
    received = ship.pose(3.0 + 2.0 * ranges / config.sound_speed)
    look = sounding.looks(axes, np.array([1.5, -0.4, -0.8]), ship.pose(np.array(3.0)), received)
    level = -config.sonar_depth - config.sonar_height
    over = objects.above(look, ship.course, side, level)
    facets = objects.facets_of(config, ranges, np.full(1200, 100.0), over)
    there = sounding.Looks(*(part[facets.bin] for part in look))
    place = there.position + ranges[facets.bin, None] * sounding.direction(there, facets.sine)
    assert np.abs(place[:, 2] - level - facets.height).max() < 0.06  # half a bin of range
    c, s = math.cos(ship.course), math.sin(ship.course)
    off = (c * place[:, 1] - s * place[:, 0]) * (1.0 if side == 'port' else -1.0)
    assert (np.abs(off - config.object_distance) < 0.2)[facets.surface == objects.FACE].all()


def test_a_ledge_below_a_ship_becomes_soundings_of_both_surfaces():
    config = scenario('moving_ledge', {'pings': 3, 'object_size': 2.5})
    _, estimates = tracked(config, 4, navigation='required')
    off, upper = [], 0
    for columns in (soundings_of(estimate).columns for estimate in estimates):
        again = columns['surface'] == 2
        upper += int(again.sum())
        across = np.abs(columns['py'] * math.cos(math.pi / 6) - columns['px'] * 0.5)
        top = np.where(across < config.object_distance, 0.0, config.object_size)
        error = (columns['pz'] + 20.0 - top) / np.sqrt(columns['vertical_uncertainty'])
        off.append(error[np.abs(across - config.object_distance) >= 2.0])  # not on the face
        assert (columns['existence'][again] >= 0.5).all()
    assert len(estimates) == 3 and upper > 40
    assert np.mean(np.abs(np.concatenate(off)) < 2.0) > 0.9


# -- below a ship that moves ----------------------------------------------------------------------


def exact(**more):
    """No errors in the navigation."""
    errors = 'attitude_error_deg', 'heading_error_deg', 'heave_error', 'position_error'
    none = {f'nav_{error}': 0.0 for error in errors}
    return scenario('moving', {'pings': 6, 'bin_width': 0.5, 'patch_std': 0.0, **none, **more})


def poses(scene):
    nav = [m.measurement for m in scene.measurements if isinstance(m.measurement, Navigation)]
    names = 'stamp_ns', 'position', 'orientation'
    return [np.array([getattr(each, name) for each in nav]) for name in names]


def test_every_point_lies_at_its_range_in_the_fan_of_the_array():
    config = exact()
    scene = simulate(config, 4)
    stamps, position, q = poses(scene)
    mount = geometry.rotation(*np.radians(config.sonar_mount_rpy_deg))
    for true in scene.truth:
        arrival = true.stamp_ns + 2e9 * true.range / config.sound_speed
        for k in (0, 60, -1):
            near = np.argmin(np.abs(stamps - arrival[k]))
            R = geometry.rotation_of_quaternion(q[near])
            array = position[near] + R @ np.array(config.sonar_lever)
            m = (R @ mount).T @ (true.xyz[k] - array)
            assert np.linalg.norm(m) == pytest.approx(true.range[k], abs=0.15)
            assert abs(m[0]) < 0.25 and m[1] < 0.0  # in the fan, to starboard
            # The stave axis of a starboard array points outward and up, with the sign turned.
            u = m @ np.array([0.0, np.sin(np.radians(30)), -np.cos(np.radians(30))])
            assert np.arcsin(u / true.range[k]) == pytest.approx(true.angle[k], abs=0.004)


def test_the_floor_is_level_below_the_water_line_also_at_the_end_of_bent_rays():
    true = simulate(exact(water_level=3.0), 4).truth[0]
    assert true.height == pytest.approx(np.full(len(true.range), 3.0 - 5.0 - 15.0))
    assert true.xyz[:, 2] == pytest.approx(true.height)
    summer = list(simulator.SUMMER)
    scene = simulate(exact(sound_speed_profile=summer), 4)
    true, other = scene.truth[2], simulate(exact(), 4).truth[2]
    ship = scene.measurements[0].measurement.position
    assert np.linalg.norm(true.xyz[-1] - other.xyz[-1]) < 1.0  # the place hardly moves
    assert np.degrees(abs(true.angle[-1] - other.angle[-1])) > 2.0  # the direction does
    assert 60.0 < np.hypot(*(true.xyz[-1] - ship)[:2]) < 90.0
    # What is nearer than the floor is no echo.
    level = {'roll_deg': 0.0, 'pitch_deg': 0.0, 'yaw_deg': 0.0, 'sonar_mount_rpy_deg': (0.0,) * 3}
    for profile in ([], summer):
        config = exact(first_range=8.0, sound_speed_profile=profile, pings=1, **level)
        (true,) = simulate(config, 4).truth
        echoes = true.range > config.sonar_height + 0.5
        assert np.isfinite(true.angle[echoes]).all() and true.valid[echoes].any()
        early = true.range < config.sonar_height - 0.5
        assert early.sum() > 10 and not true.valid[early].any()
        assert np.isnan(true.angle[early]).all()


def test_the_patch_has_an_outline_that_waves_by_its_length_and_height():
    outline = {'patch_outline': 2.0, 'patch_outline_length': 8.0, 'patch_along': []}
    along, off = np.meshgrid(np.arange(0.0, 24.0, 0.25), np.arange(0.0, 40.0, 0.25))
    inside = in_outline(scenario('moving', outline), along, off, 10.0, 20.0)
    alike = [(inside[:, :-shift] == inside[:, shift:]).mean() for shift in (32, 16)]
    assert alike[0] > 0.995 and alike[1] < 0.95
    inner = off[inside.argmax(axis=0), 0]
    assert (inner.min(), inner.max()) == pytest.approx((8.0, 12.0), abs=0.25)
    assert (inside[60:72].all(), inside[:30].any(), inside[90:].any()) == (True, False, False)
    scene = simulate(scenario('moving', {'pings': 40, 'bin_width': 0.25}), 1)
    share = np.array([true.patch.mean() for true in scene.truth])
    assert share[0] == share[-1] == 0.0 and share.max() > 0.1  # begins and ends
    begin = [true.range[true.patch].min() for true in scene.truth if true.patch.any()]
    assert np.ptp(begin) > 1.0


def test_what_the_navigation_says_differs_from_the_truth_by_its_errors():
    small, names = {'pings': 200, 'bin_width': 10.0}, ('nav_heave_error', 'nav_attitude_error_deg')
    right, wrong = (
        poses(simulate(exact(**small, **dict(zip(names, values))), 5))
        for values in ((0.0, 0.0), (0.05, 0.5))
    )
    off = wrong[1] - right[1]
    assert np.std(off[:, 2]) == pytest.approx(0.05, rel=0.25) and (off[:, :2] == 0.0).all()
    a, b = (geometry.euler_angles(geometry.rotation_of_quaternion(q)) for *_, q in (right, wrong))
    assert np.degrees(np.std(b - a, axis=0)[:2]) == pytest.approx([0.5, 0.5], rel=0.3)
    # They last seconds: within a ping of 0.1 s they hardly change.
    assert np.abs(off[5:, 2] - off[:-5, 2]).max() < 0.02


def test_the_floor_is_known_by_places_along_the_track_and_off_it():
    terrain = Terrain(-9.0, np.radians(30.0), lambda a, off: a + 100.0 * off, lambda a, off: a > 4)
    ahead, port = 0.5 * np.array([[np.sqrt(3.0), 1.0, 0.0], [-1.0, np.sqrt(3.0), 0.0]])
    places = np.array([5.0 * ahead + 2.0 * port, 3.0 * ahead - 2.0 * port, 3.0 * ahead])
    z, rough = terrain.at(places + [0.0, 0.0, 7.0], np.array([0.5, 0.5, 0.5]))
    assert z == pytest.approx([-9.0 + 5.0 + 200.0 + 0.5, -9.0 + 3.0 + 200.0, -9.0 + 3.0])
    assert rough.tolist() == [True, False, False]
