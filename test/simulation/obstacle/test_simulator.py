# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Obstacle scenes: the same for the same seed, and physically what they say."""

from functools import cache
import re

from helpers.scenes import smaller_scene
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.spatial.transform import Rotation, Slerp

from sonar_imm.acoustics import geometry
from sonar_imm.measurements import Altitude, Detections, Navigation
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.simulation.obstacle.simulator import (
    _sway,
    _SWAY_STEP,
    DOES,
    scenario,
    SCENARIOS,
    simulate,
)

EXACT = {
    'ideal_navigation': True, 'sound_speed_error': 0.0, 'range_std': 0.0, 'bearing_std_deg': 0.0,
    'range_step': 0.0, 'bearing_step_deg': 0.0, 'navigation_rate': 50.0,
}  # fmt: skip


def of(scene, kind):
    return [item.measurement for item in scene.measurements if isinstance(item.measurement, kind)]


@pytest.mark.parametrize('name', SCENARIOS)
def test_each_obstacle_has_its_truth_and_the_sea_another_motion_by_seed(name):
    config, first = smaller_scene(SYSTEMS['obstacle'], name, 3)
    other = simulate(config, 4)
    assert len(first.truth) == config.obstacles
    pairs = zip(of(first, Navigation), of(other, Navigation))
    assert any(not np.array_equal(a.position, b.position) for a, b in pairs)


@pytest.mark.parametrize('name', SCENARIOS)
def test_a_target_is_as_large_as_its_scene_says(name):
    for size in re.findall(r'(?:chain|wreck) of (\d+) m', SCENARIOS[name][0]):
        assert scenario(name).target_size == float(size)


def test_the_offset_is_the_one_asked_for():
    for name, offset in {'approach': 3.0, 'nearly_level': 0.5, 'above': -6.0}.items():
        truth = simulate(scenario(name), 2).truth[0]
        assert truth.vertical_offset[0] == pytest.approx(offset, abs=1e-9)
        assert truth.range[0] == pytest.approx(90.0, abs=1e-9)


def test_tethers_stand_on_the_sea_floor():
    config = scenario('tethers')
    for truth, tether in zip(simulate(config, 2).truth, (15.0, 12.0)):
        assert -truth.position[0, 2] == pytest.approx(20.0 + 15.5 - tether)
    seabed, surface = (simulate(scenario(name), 1).truth for name in ('seabed', 'surface'))
    assert all(-truth.position[0, 2] == pytest.approx(25.5) for truth in seabed)
    assert all(-truth.position[0, 2] == pytest.approx(0.5) for truth in surface)


def test_the_beam_has_the_stated_size():
    config = scenario('above', EXACT)
    scene = simulate(config, 5)
    truth = scene.truth[0]
    assert not truth.in_beam[truth.range < 40.0].any()  # sin(7.5 deg) = 6 / 46, less pitch
    assert truth.in_beam[truth.range > 70.0].all()
    echoes = {ping.stamp_ns: len(ping) for ping in of(scene, Detections)}
    assert [echoes[int(stamp)] for stamp in truth.stamp_ns] == truth.in_beam.astype(int).tolist()


@pytest.mark.statistics
def test_swings_have_the_stated_size():
    rolls = []
    for seed in range(12):
        poses = of(simulate(scenario('rolling', EXACT), seed), Navigation)
        R = geometry.rotation_of_quaternion([pose.orientation for pose in poses])
        rolls.append(np.std(geometry.euler_angles(R)[:, 0]))
    assert np.degrees(np.mean(rolls)) == pytest.approx(4.0, abs=0.4)


def test_twist_is_the_derivative_of_the_pose():
    poses = of(simulate(scenario('rolling', EXACT), 1), Navigation)
    for before, now, after in list(zip(poses, poses[1:], poses[2:]))[100:110]:
        dt = (after.stamp_ns - before.stamp_ns) * 1e-9
        R = geometry.rotation_of_quaternion(now.orientation)
        assert_allclose(R @ now.velocity, (after.position - before.position) / dt, atol=2e-3)
        R0, R1 = (geometry.rotation_of_quaternion(item.orientation) for item in (before, after))
        turned = (R.T @ R1 - R.T @ R0) / dt
        skew = 0.5 * (turned - turned.T)
        assert_allclose(now.turn_rate, [skew[2, 1], skew[0, 2], skew[1, 0]], atol=2e-3)


def test_the_altimeter_measures_the_sea_floor():
    altitudes = [item.altitude for item in of(simulate(scenario('approach'), 1), Altitude)]
    assert np.mean(altitudes) == pytest.approx(15.0, abs=0.3)
    relief = [item.altitude for item in of(simulate(scenario('rough_seabed'), 1), Altitude)]
    assert np.std(relief) > np.std(altitudes) + 0.1
    assert not of(simulate(scenario('approach', {'altimeter': False}), 1), Altitude)


def test_pings_are_lost_and_navigation_has_gaps():
    stress = simulate(scenario('stress'), 2)
    assert len(of(stress, Detections)) < 112
    config = scenario('stress', {'navigation_gaps': 4.0})
    steps = np.diff([pose.stamp_ns for pose in of(simulate(config, 1), Navigation)]) * 1e-9
    assert steps.max() > 2.9


# -- what sonar and navigation say, from the definitions of ENU, FLU and scipy's rotations --------


LEVER, MOUNT = np.array([1.3, -0.4, 0.7]), (4.0, -3.0, 6.0)
TURNED = {
    **EXACT, 'altitude_std': 0.0, 'sonar_lever': tuple(LEVER), 'sonar_mount_rpy_deg': MOUNT,
    'course_deg': 70.0, 'roll_rms_deg': 4.0, 'vertical_offset': -4.0,
}  # fmt: skip


def run(name='approach', seed=1, **overrides):
    return simulate(scenario(name, overrides), seed)


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
    at_once, later = (
        run(**{**TURNED, 'ping_timing': timing, 'roll_rms_deg': 0.0, 'pitch_rms_deg': 0.0,
               'yaw_rms_deg': 0.0, 'heave_rms': 0.0, 'sway_rms': 0.0})
        for timing in ('instant', 'two_way')
    )  # fmt: skip
    for ping, other in zip(of(at_once, Detections), of(later, Detections)):
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
    values = {**TURNED, 'range_std': 0.2, 'bearing_std_deg': 0.4, 'roll_rms_deg': 0.0}
    range_errors, bearing_errors = [], []
    for seed in range(12):
        exact, noisy = run(seed=seed, **{**TURNED, 'roll_rms_deg': 0.0}), run(seed=seed, **values)
        for ping, other in zip(of(exact, Detections), of(noisy, Detections), strict=True):
            if len(ping):
                range_errors.append(other.range[0] - ping.range[0])
                bearing_errors.append(np.degrees(other.bearing[0] - ping.bearing[0]))
    n = len(range_errors)
    assert n > 400
    assert np.std(range_errors) == pytest.approx(0.2, rel=0.1)
    assert np.std(bearing_errors) == pytest.approx(0.4, rel=0.1)
    assert abs(np.mean(range_errors)) < 4.0 * 0.2 / np.sqrt(n)
    assert abs(np.mean(bearing_errors)) < 4.0 * 0.4 / np.sqrt(n)


def test_ranges_and_bearings_come_in_steps():
    pings = of(run(range_step=0.5, bearing_step_deg=1.5), Detections)
    ranges = np.concatenate([ping.range for ping in pings]) / 0.5
    bearings = np.degrees(np.concatenate([ping.bearing for ping in pings])) / 1.5
    np.testing.assert_allclose(ranges, np.round(ranges), atol=1e-9)
    np.testing.assert_allclose(bearings, np.round(bearings), atol=1e-9)
    assert len(set(np.round(ranges))) > 20


@pytest.mark.statistics
def test_a_wrong_sound_speed_scales_all_ranges_of_a_run_alike():
    scales = []
    for seed in range(60):
        right = run(seed=seed, **TURNED, last_range=80.0)
        wrong = run(seed=seed, **{**TURNED, 'sound_speed_error': 0.02}, last_range=80.0)
        ratio = [
            other.range[0] / ping.range[0]
            for ping, other in zip(of(right, Detections), of(wrong, Detections))
            if len(ping) and len(other)
        ]
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


def test_without_errors_dead_reckoning_is_the_path():
    off, way = ends(3)
    assert way > 80.0 and np.abs(off).max() < 0.03


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


def test_white_errors_of_the_attitude_are_normal_and_as_large_as_told():
    noisy, ideal = run(**{**SILENT, 'attitude_std_deg': 0.3}), run(ideal_navigation=True)
    off = turned(list(zip(of(noisy, Navigation), of(ideal, Navigation)))) / 0.3
    assert off.mean(axis=0) == pytest.approx(0.0, abs=0.15)
    assert off.std(axis=0) == pytest.approx(1.0, rel=0.1) and np.abs(off).max() < 4.5


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
    plain = run(ideal_navigation=True)
    late = run(ideal_navigation=True, navigation_delay=0.2, navigation_latency=0.7)
    first, other = (
        [each for each in scene.measurements if isinstance(each.measurement, Navigation)]
        for scene in (plain, late)
    )
    for a, b in zip(first, other, strict=True):
        assert np.array_equal(a.measurement.position, b.measurement.position)
        assert b.measurement.stamp_ns - a.measurement.stamp_ns == 200_000_000
        assert b.received_ns - b.measurement.stamp_ns == 700_000_000
        assert a.received_ns == a.measurement.stamp_ns


def test_the_altitude_is_that_above_the_floor_below():
    scene = run(**{**TURNED, 'depth': 30.0, 'altitude': 12.0}, dive=2.0)
    heights = {pose.stamp_ns: pose.position[2] for pose in of(scene, Navigation)}
    pairs = [(item.altitude, heights[item.stamp_ns]) for item in of(scene, Altitude)]
    assert len(pairs) > 50 and np.ptp([z for _, z in pairs]) > 2.0
    for altitude, z in pairs:
        assert altitude == pytest.approx(z + 42.0, abs=1e-9)


def test_a_swaying_obstacle_stays_about_its_place():
    moved = []
    for seed in range(6):
        truth, place = (run(name, seed).truth[0] for name in ('swaying', 'approach'))
        moved.append((truth.position - place.position)[:, :2])
        assert_allclose(truth.position[:, 2], place.position[:, 2])
        assert_allclose(truth.velocity, 0.0)
    assert np.std(moved) == pytest.approx(0.5, rel=0.3)


def test_a_mover_moves_as_its_velocity_says_and_is_seen():
    seen, ways = [], []
    for seed in range(12):
        truth = simulate(scenario('mover'), seed).truth[0]
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
        scene = simulate(scenario('swaying', {'obstacle_motion': 'swinging'}), seed)
        place = simulate(scenario('approach'), seed).truth[0].position
        moved.append((scene.truth[0].position - place)[:, :2])
    moved = np.array(moved)
    assert moved.std() == pytest.approx(0.5, rel=0.1)
    # A swing of 15 s has a turning point every 7.5 s; a random sway has one at every other ping.
    turns = np.mean(np.diff(np.sign(np.diff(moved, axis=1)), axis=1) != 0)
    assert turns == pytest.approx(0.5 / 7.5, rel=0.2)


@pytest.mark.parametrize(
    'changes, moving',
    [({'obstacle_starts': 20.0}, (False, True)), ({'obstacle_stops': 20.0}, (True, False))],
)
def test_a_mover_starts_and_stops(changes, moving):
    truth = simulate(scenario('mover', changes), 3).truth[0]
    t = (truth.stamp_ns - truth.stamp_ns[0]) * 1e-9
    step = np.linalg.norm(np.diff(truth.position, axis=0)[:, :2], axis=1) > 1e-6
    assert np.array_equal(step, np.where(t[1:] <= 20.0, *moving))
    assert np.array_equal(truth.does == DOES.index('moving'), np.where(t < 20.0, *moving))
    table = list(truth.tables('odom'))[-1]
    assert [table.columns[f'prob_{name}'][0] for name in ('fixed', 'moving')] == [
        float(not moving[1]), float(moving[1])
    ]  # fmt: skip


@pytest.mark.parametrize('name, wrong', [('obstacle_speed', [2.0, 1.0]), ('last_range', 95.0)])
def test_limits_in_the_wrong_order_are_refused(name, wrong):
    with pytest.raises(ConfigError, match=name):
        scenario('mover', {name: wrong})


def test_what_sways_has_its_deviation_and_forgets_in_its_time():
    config = scenario('swaying', {'obstacle_sway': 0.5, 'obstacle_sway_time': 2.0})
    ways = np.stack([_sway(config, np.random.default_rng(seed)) for seed in range(200)])
    assert ways.std(axis=(0, 2)) == pytest.approx(0.5, rel=0.25)
    assert ways.std() == pytest.approx(0.5, rel=0.03)
    lag = round(2.0 / _SWAY_STEP)
    assert np.mean(ways[:, lag:] * ways[:, :-lag]) / 0.25 == pytest.approx(np.exp(-1.0), abs=0.05)


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
