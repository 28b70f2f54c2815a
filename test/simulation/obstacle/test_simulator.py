# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Obstacle scenes: the same for the same seed, physically what they say; and images, whose
speckle, reverberation, sea floor and targets are what they claim to be."""

from functools import cache
import re

from helpers.scenes import smaller_scene
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.signal.windows import taylor
from scipy.spatial.transform import Rotation, Slerp

from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.measurements import Altitude, Detections, Navigation, SonarImage
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.simulation.obstacle import simulator
from sonar_imm_tools.simulation.obstacle.images import ImageSonar, vertical_pattern
from sonar_imm_tools.simulation.obstacle.simulator import scenario, SCENARIOS, simulate

EXACT = {
    'ideal_navigation': True, 'sound_speed_error': 0.0, 'range_std': 0.0, 'bearing_std_deg': 0.0,
    'range_step': 0.0, 'bearing_step_deg': 0.0, 'navigation_rate': 50.0,
}  # fmt: skip


def of(scene, kind):
    return [item.measurement for item in scene.measurements if isinstance(item.measurement, kind)]


def run(name='approach', seed=1, **overrides):
    return simulate(scenario(name, overrides), seed)


@pytest.mark.parametrize('name', SCENARIOS)
def test_each_obstacle_has_its_truth_and_size_and_the_sea_another_motion_by_seed(name):
    config, first = smaller_scene(SYSTEMS['obstacle'], name, 3)
    assert len(first.truth) == config.obstacles
    poses = (
        [pose.position for pose in of(scene, Navigation)] for scene in (first, simulate(config, 4))
    )
    assert not np.array_equal(*poses)
    for size in re.findall(r'(?:chain|wreck) of (\d+) m', SCENARIOS[name][0]):
        assert scenario(name).target_size == float(size)


def test_the_offset_is_the_one_asked_for_and_tethers_stand_on_the_sea_floor():
    for name, offset in {'approach': 3.0, 'nearly_level': 0.5, 'above': -6.0}.items():
        truth = run(name, 2).truth[0]
        assert truth.vertical_offset[0] == pytest.approx(offset, abs=1e-9)
        assert truth.range[0] == pytest.approx(90.0, abs=1e-9)
    depths = {'tethers': [35.5 - 15.0, 35.5 - 12.0], 'seabed': [25.5], 'surface': [0.5]}
    for name, depth in depths.items():
        found = [-truth.position[0, 2] for truth in run(name, 2).truth]
        assert found == pytest.approx(depth * (len(found) // len(depth)))


def test_the_beam_has_the_stated_size_pings_are_lost_and_navigation_has_gaps():
    scene = run('above', 5, **EXACT)
    truth = scene.truth[0]
    assert not truth.in_beam[truth.range < 40.0].any()  # sin(7.5 deg) = 6 / 46, less pitch
    assert truth.in_beam[truth.range > 70.0].all()
    echoes = {ping.stamp_ns: len(ping) for ping in of(scene, Detections)}
    assert [echoes[int(stamp)] for stamp in truth.stamp_ns] == truth.in_beam.astype(int).tolist()
    assert len(of(run('stress', 2), Detections)) < 112
    poses = of(run('stress', navigation_gaps=4.0), Navigation)
    assert np.diff([pose.stamp_ns for pose in poses]).max() > 2.9e9


@pytest.mark.statistics
def test_swings_have_the_stated_size():
    rolls = []
    for seed in range(12):
        poses = of(run('rolling', seed, **EXACT), Navigation)
        R = geometry.rotation_of_quaternion([pose.orientation for pose in poses])
        rolls.append(np.std(geometry.euler_angles(R)[:, 0]))
    assert np.degrees(np.mean(rolls)) == pytest.approx(4.0, abs=0.4)


def test_twist_is_the_derivative_of_the_pose():
    poses = of(run('rolling', **EXACT), Navigation)[100:112]
    for before, now, after in zip(poses, poses[1:], poses[2:]):
        dt = (after.stamp_ns - before.stamp_ns) * 1e-9
        R0, R, R1 = (geometry.rotation_of_quaternion(p.orientation) for p in (before, now, after))
        assert_allclose(R @ now.velocity, (after.position - before.position) / dt, atol=2e-3)
        turned = (R.T @ R1 - R.T @ R0) / dt
        skew = 0.5 * (turned - turned.T)
        assert_allclose(now.turn_rate, [skew[2, 1], skew[0, 2], skew[1, 0]], atol=2e-3)


def test_the_altimeter_measures_the_sea_floor():
    level, relief = (
        [item.altitude for item in of(run(name), Altitude)]
        for name in ('approach', 'rough_seabed')
    )
    assert np.mean(level) == pytest.approx(15.0, abs=0.3)
    assert np.std(relief) > np.std(level) + 0.1
    assert not of(run(altimeter=False), Altitude)
    scene = run(**{**TURNED, 'depth': 30.0, 'altitude': 12.0}, dive=2.0)
    heights = {pose.stamp_ns: pose.position[2] for pose in of(scene, Navigation)}
    pairs = [(item.altitude, heights[item.stamp_ns]) for item in of(scene, Altitude)]
    altitude, z = np.transpose(pairs)
    assert len(z) > 50 and np.ptp(z) > 2.0
    assert_allclose(altitude, z + 42.0, atol=1e-9)


# -- what sonar and navigation say, from the definitions of ENU, FLU and scipy's rotations --------


LEVER, MOUNT = np.array([1.3, -0.4, 0.7]), (4.0, -3.0, 6.0)
TURNED = {
    **EXACT, 'altitude_std': 0.0, 'sonar_lever': tuple(LEVER), 'sonar_mount_rpy_deg': MOUNT,
    'course_deg': 70.0, 'roll_rms_deg': 4.0, 'vertical_offset': -4.0,
}  # fmt: skip


class Vehicle:
    """The vehicle between its poses, and a point as its sonar sees it, FLU."""

    def __init__(self, scene):
        poses = of(scene, Navigation)
        self.first = poses[0].stamp_ns
        self.t = np.array([(pose.stamp_ns - self.first) * 1e-9 for pose in poses])
        self.place = np.array([pose.position for pose in poses])
        self.turn = Slerp(self.t, Rotation.from_quat([pose.orientation for pose in poses]))
        # Extrinsic x, y, z: roll first, yaw last, about axes that stand still.
        self.mount = Rotation.from_euler('xyz', MOUNT, degrees=True)

    def sees(self, point, seconds):
        turn = self.turn(seconds)
        sonar = np.array([np.interp(seconds, self.t, axis) for axis in self.place.T])
        sonar = sonar + turn.apply(LEVER)
        return (turn * self.mount).inv().apply(point - sonar), sonar


def bearing_of(m, model):
    """To port: of the vertical plane through the point, or of the cone around the array."""
    return np.arctan2(m[1], m[0]) if model == 'plane' else np.arcsin(m[1] / np.linalg.norm(m))


@pytest.mark.parametrize('model', ['plane', 'cone'])
@pytest.mark.parametrize('timing', ['instant', 'two_way'])
def test_an_echo_is_where_the_navigation_says_the_obstacle_is(model, timing):
    scene = run(**TURNED, azimuth_model=model, ping_timing=timing)
    vehicle, truth, checked = Vehicle(scene), scene.truth[0], 0
    for ping in of(scene, Detections):
        seconds = (ping.stamp_ns - vehicle.first) * 1e-9
        out, sonar = vehicle.sees(truth.position[0], seconds)
        k = int(np.searchsorted(truth.stamp_ns, ping.stamp_ns))
        assert truth.range[k] == pytest.approx(np.linalg.norm(out), abs=1e-3)
        assert truth.vertical_offset[k] == pytest.approx(sonar[2] - truth.position[0, 2], abs=1e-3)
        if not len(ping):
            continue
        d, bearing = np.linalg.norm(out), bearing_of(out, model)
        if timing == 'two_way':
            for _ in range(4):  # the echo comes back to where the sonar is by then
                back, _ = vehicle.sees(truth.position[0], seconds + 2.0 * d / 1500.0)
                d = 0.5 * (np.linalg.norm(out) + np.linalg.norm(back))
                bearing = bearing_of(back, model)
        assert ping.range[0] == pytest.approx(d, abs=1e-3)
        assert ping.bearing[0] == pytest.approx(bearing, abs=1e-4)
        checked += 1
    assert checked > 40


def test_the_two_ways_to_time_a_ping_differ_by_half_the_way_travelled():
    """At 1.5 m/s an echo from 75 m takes 0.1 s: the sonar is 0.15 m nearer when it comes back."""
    still = dict.fromkeys(
        ('roll_rms_deg', 'pitch_rms_deg', 'yaw_rms_deg', 'heave_rms', 'sway_rms'), 0.0
    )
    at_once, later = (
        of(run(**{**TURNED, **still, 'ping_timing': timing}), Detections)
        for timing in ('instant', 'two_way')
    )
    for ping, other in zip(at_once, later):
        if len(ping) and len(other) and ping.range[0] > 40.0:
            shorter = ping.range[0] - other.range[0]
            assert shorter == pytest.approx(1.5 * ping.range[0] / 1500.0, rel=0.05)


def test_a_beam_is_a_box_of_elevation_azimuth_and_range():
    scene = run('six', **{**TURNED, 'max_range': 80.0}, clutter=0.0)
    vehicle, inside = Vehicle(scene), 0
    for truth in scene.truth:
        for stamp, seen in zip(truth.stamp_ns, truth.in_beam):
            m, _ = vehicle.sees(truth.position[0], (int(stamp) - vehicle.first) * 1e-9)
            d = np.linalg.norm(m)
            margins = np.array([
                np.radians(7.5) - abs(np.arcsin(m[2] / d)),
                np.radians(22.5) - abs(np.arctan2(m[1], m[0])),
                (80.0 - d) / 100.0,
            ])  # fmt: skip
            if np.abs(margins).min() > 1e-4:  # not just on the edge
                assert seen == (margins > 0.0).all()
            inside += seen
    assert inside > 100


@pytest.mark.statistics
def test_errors_of_echoes_are_as_large_as_told():
    errors, level = [], {**TURNED, 'roll_rms_deg': 0.0}
    for seed in range(12):
        exact = of(run(seed=seed, **level), Detections)
        told = run(seed=seed, **{**level, 'range_std': 0.2, 'bearing_std_deg': 0.4})
        for ping, other in zip(exact, of(told, Detections), strict=True):
            if len(ping):
                off = np.degrees(other.bearing[0] - ping.bearing[0])
                errors.append([other.range[0] - ping.range[0], off])
    stds, n = np.array([0.2, 0.4]), len(errors)
    assert n > 400 and np.std(errors, axis=0) == pytest.approx(stds, rel=0.1)
    assert (np.abs(np.mean(errors, axis=0)) < 4.0 * stds / np.sqrt(n)).all()


def test_ranges_and_bearings_come_in_steps():
    pings = of(run(range_step=0.5, bearing_step_deg=1.5), Detections)
    ranges = np.concatenate([ping.range for ping in pings]) / 0.5
    bearings = np.degrees(np.concatenate([ping.bearing for ping in pings])) / 1.5
    for steps in (ranges, bearings):
        assert_allclose(steps, np.round(steps), atol=1e-9)
    assert len(set(np.round(ranges))) > 20


@pytest.mark.statistics
def test_a_wrong_sound_speed_scales_all_ranges_of_a_run_alike():
    scales = []
    for seed in range(60):
        right, wrong = (
            of(run(seed=seed, **{**TURNED, 'sound_speed_error': e}, last_range=80.0), Detections)
            for e in (0.0, 0.02)
        )
        ratio = [b.range[0] / a.range[0] for a, b in zip(right, wrong) if len(a) and len(b)]
        assert np.ptp(ratio) < 1e-12
        scales.append(ratio[0] - 1.0)
    assert np.std(scales) == pytest.approx(0.02, rel=0.3)
    assert abs(np.mean(scales)) < 4.0 * 0.02 / np.sqrt(60)


@pytest.mark.statistics
def test_echoes_from_elsewhere_and_misses_come_as_often_as_told():
    lost = wild = n = 0
    for seed in range(12):
        seen = run(seed=seed, **TURNED, detection_probability=0.7, outlier_probability=0.25)
        truth = seen.truth[0]
        for ping, d, there in zip(of(seen, Detections), truth.range, truth.in_beam):
            n += there
            lost += there and not len(ping)
            if len(ping):
                off = abs(ping.range[0] - d)
                assert off <= 8.0 + 1e-9
                wild += off > 1e-6
    assert n > 400
    assert lost / n == pytest.approx(0.3, abs=0.07)
    assert wild / (n - lost) == pytest.approx(0.25, abs=0.08)


def test_false_echoes_fill_the_sector_evenly():
    scene = run(detection_probability=0.0, clutter=20.0)
    pings = of(scene, Detections)
    ranges = np.concatenate([ping.range for ping in pings])
    bearings = np.degrees(np.concatenate([ping.bearing for ping in pings]))
    assert len(ranges) / len(pings) == pytest.approx(20.0, rel=0.1)
    for values, low, high in ((ranges, 1.0, 100.0), (bearings, -22.5, 22.5)):
        counts, _ = np.histogram(values, 10, (low, high))
        assert counts.sum() == pytest.approx(len(values), abs=20)
        assert ((counts - counts.mean()) ** 2 / counts.mean()).sum() < 27.9  # 99.9 % of 9


# -- navigation -----------------------------------------------------------------------------------

SILENT = {
    'log_scale_error': 0.0, 'log_bias': 0.0, 'log_noise': 0.0, 'attitude_std_deg': 0.0,
    'attitude_bias_deg': 0.0, 'yaw_bias_deg': 0.0, 'depth_std': 0.0,
}  # fmt: skip


def path(seed, **errors):
    """Positions (n, 3) that the navigation states along a course of 70 degrees."""
    scene = run(seed=seed, course_deg=70.0, navigation_rate=4.0, **errors)
    return np.array([pose.position for pose in of(scene, Navigation)])


@cache
def true_path(seed):
    return path(seed, ideal_navigation=True)


def ends(seeds, **errors):
    """Along and across the course, how far the last pose is off (seeds, 2), m; and the way."""
    ahead = np.array([np.sin(np.radians(70.0)), np.cos(np.radians(70.0))])  # east, north
    axes = np.column_stack([ahead, [-ahead[1], ahead[0]]])
    values = {**SILENT, **errors}
    off = [(path(seed, **values)[-1] - true_path(seed)[-1])[:2] @ axes for seed in range(seeds)]
    return np.array(off), float(np.linalg.norm((true_path(0)[-1] - true_path(0)[0])[:2]))


def test_without_errors_dead_reckoning_is_the_path_and_white_errors_of_the_attitude_are_normal():
    off, way = ends(3)
    assert way > 80.0 and np.abs(off).max() < 0.03
    noisy, ideal = run(**{**SILENT, 'attitude_std_deg': 0.3}), run(ideal_navigation=True)
    off = turned(list(zip(of(noisy, Navigation), of(ideal, Navigation)))) / 0.3
    assert off.mean(axis=0) == pytest.approx(0.0, abs=0.15)
    assert off.std(axis=0) == pytest.approx(1.0, rel=0.1) and np.abs(off).max() < 4.5


@pytest.mark.statistics
@pytest.mark.parametrize(
    'errors, along, across',
    [
        ({'log_scale_error': 0.01}, lambda way: 0.01 * way, lambda way: 0.0),
        ({'yaw_bias_deg': 1.0}, lambda way: 0.0, lambda way: np.radians(1.0) * way),
        ({'log_bias': 0.02}, lambda way: 0.02 * way / 1.5, lambda way: 0.02 * way / 1.5),
        ({'log_noise': 0.05}, lambda way: 0.05 * (way / 1.5) ** 0.5,
         lambda way: 0.05 * (way / 1.5) ** 0.5),
    ],
    ids=lambda value: next(iter(value)) if isinstance(value, dict) else '',
)  # fmt: skip
def test_errors_of_the_navigation_grow_as_their_kind_does(errors, along, across):
    """A scale error along the way, a yaw bias across it, a bias with time, noise with its root."""
    off, way = ends(100, **errors)
    for found, expected in zip(off.std(axis=0), (along(way), across(way))):
        assert found == pytest.approx(expected, rel=0.28, abs=0.05)


def turned(pairs):
    """By what angles (n, 3), in degrees, the first pose of each pair is off the second."""
    first, second = (
        Rotation.from_quat([pose.orientation for pose in each]) for each in zip(*pairs)
    )
    return first.as_euler('xyz', degrees=True) - second.as_euler('xyz', degrees=True)


@pytest.mark.statistics
def test_attitudes_and_depths_have_the_errors_told():
    angles, depths = [], []
    for seed in range(30):
        values = {**SILENT, 'attitude_bias_deg': 0.5, 'yaw_bias_deg': 0.8, 'depth_std': 0.1}
        noisy, ideal = run(seed=seed, **values), run(seed=seed, ideal_navigation=True)
        pairs = list(zip(of(noisy, Navigation), of(ideal, Navigation)))
        off = turned(pairs[::20])
        assert np.ptp(off, axis=0).max() < 1e-6  # a bias stays
        angles.append(off[0])
        depths += [pair.position[2] - other.position[2] for pair, other in pairs]
    assert np.std(angles, axis=0) == pytest.approx([0.5, 0.5, 0.8], rel=0.4)
    assert np.std(depths) == pytest.approx(0.1, rel=0.05)


def test_poses_may_be_late_by_stamp_and_by_radio():
    first, other = (
        [
            m
            for m in run(ideal_navigation=True, **late).measurements
            if isinstance(m.measurement, Navigation)
        ]
        for late in ({}, {'navigation_delay': 0.2, 'navigation_latency': 0.7})
    )
    for a, b in zip(first, other, strict=True):
        assert np.array_equal(a.measurement.position, b.measurement.position)
        assert b.measurement.stamp_ns - a.measurement.stamp_ns == 200_000_000
        assert b.received_ns - b.measurement.stamp_ns == 700_000_000
        assert a.received_ns == a.measurement.stamp_ns


def test_a_swaying_obstacle_stays_about_its_place_and_forgets_in_its_time():
    moved = []
    for seed in range(6):
        truth, place = (run(name, seed).truth[0] for name in ('swaying', 'approach'))
        moved.append((truth.position - place.position)[:, :2])
        assert_allclose(truth.position[:, 2], place.position[:, 2])
        assert_allclose(truth.velocity, 0.0)
    assert np.std(moved) == pytest.approx(0.5, rel=0.3)
    config = scenario('swaying', {'obstacle_sway': 0.5, 'obstacle_sway_time': 2.0})
    ways = np.stack([simulator._sway(config, np.random.default_rng(seed)) for seed in range(200)])
    assert ways.std(axis=(0, 2)) == pytest.approx(0.5, rel=0.25)
    assert ways.std() == pytest.approx(0.5, rel=0.03)
    lag = round(2.0 / simulator._SWAY_STEP)
    assert np.mean(ways[:, lag:] * ways[:, :-lag]) / 0.25 == pytest.approx(np.exp(-1.0), abs=0.05)


def test_a_mover_moves_as_its_velocity_says_and_is_seen():
    seen, ways = [], []
    for seed in range(12):
        truth = run('mover', seed).truth[0]
        dt = np.diff(truth.stamp_ns) * 1e-9
        step = np.diff(truth.position, axis=0)[:, :2] / dt[:, None]
        assert_allclose(step, truth.velocity[1:], atol=1e-5)
        columns = next(iter(truth.tables('odom'))).columns
        assert_allclose([columns['vx'][0], columns['vy'][0]], truth.velocity[0])
        assert 0.3 <= np.linalg.norm(truth.velocity[0]) <= 1.5
        seen.append(truth.in_beam.mean())
        ways.append(truth.velocity[0] / np.linalg.norm(truth.velocity[0]))
    assert np.mean(seen) > 0.5
    assert (np.ptp(ways, axis=0) > 1.0).all()  # they go any way


@pytest.mark.statistics
def test_a_swinging_obstacle_goes_in_smooth_waves():
    moved = []
    for seed in range(20):
        there = run('swaying', seed, obstacle_motion='swinging').truth[0].position
        moved.append((there - run('approach', seed).truth[0].position)[:, :2])
    assert np.std(moved) == pytest.approx(0.5, rel=0.1)
    # A swing of 15 s has a turning point every 7.5 s; a random sway has one at every other ping.
    turns = np.mean(np.diff(np.sign(np.diff(moved, axis=1)), axis=1) != 0)
    assert turns == pytest.approx(0.5 / 7.5, rel=0.2)


@pytest.mark.parametrize('change, moving', [('starts', (False, True)), ('stops', (True, False))])
def test_a_mover_starts_and_stops(change, moving):
    truth = run('mover', 3, **{f'obstacle_{change}': 20.0}).truth[0]
    t = (truth.stamp_ns - truth.stamp_ns[0]) * 1e-9
    step = np.linalg.norm(np.diff(truth.position, axis=0)[:, :2], axis=1) > 1e-6
    assert np.array_equal(step, np.where(t[1:] <= 20.0, *moving))
    does = simulator.DOES.index('moving')
    assert np.array_equal(truth.does == does, np.where(t < 20.0, *moving))
    last = list(truth.tables('odom'))[-1].columns
    told = [last[f'prob_{name}'][0] for name in ('fixed', 'moving')]
    assert told == [float(not moving[1]), float(moving[1])]
    for name, wrong in (
        ('obstacle_speed', [2.0, 1.0]),
        ('last_range', 95.0),
    ):  # in the wrong order
        with pytest.raises(ConfigError, match=name):
            scenario('mover', {name: wrong})


def test_the_vehicle_sways_across_its_course_and_dives_as_asked():
    still = {'heave_rms': 0.0, 'roll_rms_deg': 0.0, 'pitch_rms_deg': 0.0, 'yaw_rms_deg': 0.0}
    poses = of(run(seed=3, **EXACT, **still, sway_rms=2.0, course_deg=40.0, dive=3.0), Navigation)
    t = np.array([pose.stamp_ns for pose in poses]) * 1e-9
    t -= t[0]
    east, north, up = (np.array([pose.position for pose in poses]) - poses[0].position).T
    s, c = np.sin(np.radians(40.0)), np.cos(np.radians(40.0))
    assert_allclose(north * c + east * s, 1.5 * t, atol=1e-6)
    across = east * c - north * s
    assert 0.5 < np.std(across) < 6.0
    dive = np.sin(2.0 * np.pi * t / 60.0)  # pings begin a little later than navigation
    assert_allclose(up, -3.0 * dive, atol=0.7)


LEVEL = Pose(np.array([0.0, 0.0, 20.0]), np.eye(3))
NOWHERE = {'reverberation': 0.0, 'altitude': 5000.0, 'image_gain': 40.0}
SMALL = {**NOWHERE, 'image_bins': 240, 'image_beams': 128, 'horizontal_fov_deg': 22.5}


def sonar(seed=0, **values):
    config = scenario('approach', {'images': True, **values})
    return ImageSonar(config, np.random.default_rng(seed))


def powers(imager, count, places=(), pose=LEVEL):
    """Mean power over images, in units of the noise."""
    gain = imager.config.image_gain
    images = [imager.image(pose, list(places), 1.0) / gain for _ in range(count)]
    return np.mean(np.square(images), axis=0)


def correlation(power, axis, lag):
    """Of the power at places `lag` cells apart."""
    first = np.take(power, np.arange(power.shape[axis] - lag), axis)
    second = np.take(power, np.arange(lag, power.shape[axis]), axis)
    return np.corrcoef(first.ravel(), second.ravel())[0, 1]


def beams_correlate(lag):
    """Correlation of the power of beams `lag` times 45 / 256 degrees apart, 1 degree wide."""
    weight = taylor(400, nbar=6, sll=20.0)
    place = np.arange(400) - 199.5
    u = np.linspace(0.0, 0.01, 5001)
    pattern = np.abs(np.exp(2j * np.pi * np.multiply.outer(u, place)) @ weight) / weight.sum()
    half = u[np.argmax(pattern < np.sqrt(0.5))]
    off = lag * (45.0 / 256.0) * 2.0 * half
    together = np.exp(2j * np.pi * off * place) @ np.square(weight)
    return np.square(np.abs(together / np.square(weight).sum()))


def test_bins_and_beams_fill_range_and_sector():
    it = sonar()
    left, far = 0.5 * it.config.horizontal_fov_deg, it.config.max_range
    for cells, first, last in ((it.range, 0.0, far), (np.rad2deg(it.bearing), left, -left)):
        half = 0.5 * (last - first) / len(cells)
        assert_allclose(cells[[0, -1]], [first + half, last - half])


def test_noise_is_rayleigh_speckle_as_wide_as_a_beam_and_as_long_as_the_pulse():
    imager = sonar(**NOWHERE)
    images = [np.square(imager.image(LEVEL, [], 1.0) / 40.0) for _ in range(6)]
    assert np.mean(images) == pytest.approx(1.0, abs=0.01)
    assert np.std(images) == pytest.approx(1.0, abs=0.03)  # exponential
    # Speckle of an array correlates as the transform of its squared weights, to the second power.
    for axis, lag, share, abs_ in (
        (1, 2, beams_correlate(2), 0.06), (1, 4, beams_correlate(4), 0.06), (1, 12, 0.0, 0.06),
        (0, 1, 0.65, 0.06), (0, 4, 0.0, 0.05),
    ):  # fmt: skip
        assert correlation(images[0], axis, lag) == pytest.approx(share, abs=abs_)


def test_water_scatters_back_by_the_square_of_the_range():
    imager = sonar(**{**NOWHERE, 'reverberation': 30.0, 'image_gain': 20.0})
    mean = powers(imager, 30).mean(axis=1)
    wanted = 1.0 + 30.0 * np.square(10.0 / imager.range)
    far = imager.range > 15.0
    assert mean[far] / wanted[far] == pytest.approx(1.0, abs=0.12)


def test_a_point_is_as_strong_wide_and_long_as_told():
    imager = sonar(**{**NOWHERE, 'target_snr_db': 26.0, 'image_gain': 8.0})
    d, b = imager.range[300], -imager.bearing[100]
    place = np.array([d * np.cos(b), d * np.sin(b), 20.0])
    power = powers(imager, 20, [place])
    row, beam = np.unravel_index(np.argmax(power), power.shape)
    assert abs(imager.range[row] - d) < 0.1 and beam == 100
    peak = power[row, beam] - 1.0
    assert 10.0 * np.log10(peak) == pytest.approx(26.0, abs=0.6)
    step = np.degrees(imager.bearing[0] - imager.bearing[1])
    wide = step * np.count_nonzero(power[row] > 0.5 * peak)
    assert wide == pytest.approx(1.0, abs=0.2)
    beyond = np.abs(np.arange(256) - 100) * step > 1.6
    sidelobes = power[row, beyond].max() - 1.0
    assert -24.0 < 10.0 * np.log10(sidelobes / peak) < -17.0


@pytest.mark.parametrize('stretch', [0.96, 1.04])
def test_an_error_of_the_sound_speed_stretches_all_ranges(stretch):
    imager = sonar(**{**NOWHERE, 'target_snr_db': 30.0, 'image_gain': 4.0})
    d = imager.range[300]
    image = imager.image(LEVEL, [LEVEL.position + np.array([d, 0.0, 0.0])], stretch)
    assert imager.range[image.max(axis=1).argmax()] == pytest.approx(stretch * d, abs=0.1)


def test_what_lies_above_or_below_the_axis_is_fainter():
    assert vertical_pattern(np.array([0.0, 0.13]), 0.26) == pytest.approx([1.0, 0.25], rel=0.01)
    imager = sonar(**{**NOWHERE, 'target_snr_db': 30.0, 'image_gain': 4.0})
    level, low = (
        powers(imager, 8, [LEVEL.position + imager.range[300] * np.array(way)]).max()
        for way in ([1.0, 0.0, 0.0], [np.cos(0.1309), 0.0, np.sin(0.1309)])
    )
    assert 10.0 * np.log10(level / low) == pytest.approx(6.0, abs=1.0)


@pytest.mark.statistics
def test_a_fading_point_is_rayleigh_and_glints_wander():
    imager = sonar(**{**SMALL, 'target_fading': 'rayleigh', 'image_gain': 4.0})
    place = [np.array([50.0, 0.0, 20.0])]
    peaks = np.array([powers(imager, 1, place)[116:124, 56:72].max() for _ in range(60)])
    assert 0.6 < peaks.std() / peaks.mean() < 1.4
    chain = sonar(**{**SMALL, 'target': 'chain', 'target_size': 10.0})
    images = [powers(chain, 1, place) for _ in range(30)]
    weights = [np.where(image > 8.0, image, 0.0).sum(axis=0) for image in images]
    centres = [np.average(chain.bearing, weights=weight) for weight in weights if weight.any()]
    assert np.std(centres) > 0.005


def test_a_wreck_is_the_outline_of_a_hull():
    wreck = {'target': 'wreck', 'target_size': 12.0, 'target_snr_db': 30.0}
    imager = sonar(**{**SMALL, **wreck, 'image_gain': 4.0})
    imager.heading = 0.0  # bow away from the sonar
    power = powers(imager, 12, [np.array([40.0, 0.0, 20.0])])
    row = np.searchsorted(imager.range, 40.0)
    beams = [np.argmin(np.abs(imager.bearing - side / 40.0)) for side in (-1.44, 0.0, 1.44)]
    port, inside, starboard = power[row - 2 : row + 3][:, beams].mean(axis=0)
    assert min(port, starboard) > 4.0 * inside
    # As long as asked for: 7 m from the middle, beyond bow and stern, there is nothing.
    along = power.max(axis=1)
    near, far = (np.abs(imager.range - 40.0) < limit for limit in (5.0, 7.0))
    assert along[near].min() > 3.0 * along[~far].max()


def test_the_sea_floor_is_patchy_and_its_patches_stay_in_the_world():
    imager = sonar(**{**NOWHERE, 'altitude': 6.0, 'seabed_shape': 0.5, 'image_gain': 8.0})
    moved = Pose(np.array([3.0, 0.0, 20.0]), np.eye(3))
    here, there = powers(imager, 25), powers(imager, 25, pose=moved)
    shift = round(3.0 / (imager.range[1] - imager.range[0]))
    # Straight ahead a patch comes nearer by 3 m.
    first = here[350:500, 118:138].ravel()
    nearer, unmoved = (there[350 - s : 500 - s, 118:138].ravel() for s in (shift, 0))
    assert np.corrcoef(first, nearer)[0, 1] > 0.5 and np.corrcoef(first, unmoved)[0, 1] < 0.3
    assert here[:30].mean() == pytest.approx(1.0, abs=0.05)  # nearer than the floor


def test_images_take_the_place_of_detections_and_the_rest_stays():
    values = {'last_range': 80.0, 'image_bins': 200, 'image_beams': 64}
    plain, scene = (
        simulate(scenario('approach', {**values, 'images': images}), seed=3)
        for images in (False, True)
    )
    measured = [item.measurement for item in scene.measurements]
    images = [item for item in measured if isinstance(item, SonarImage)]
    assert len(images) == 14 and images[0].amplitude.shape == (200, 64)
    np.testing.assert_array_equal(scene.truth[0].vertical_offset, plain.truth[0].vertical_offset)
    assert len(measured) == len(plain.measurements)
    with pytest.raises(ConfigError, match='instant'):
        scenario('approach', {'images': True, 'ping_timing': 'two_way'})
