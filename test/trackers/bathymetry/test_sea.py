# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The tracker on a ship that moves: the vectors of motion, gaps, pings that wait for poses."""

from attrs import evolve
from helpers.bathymetry_cases import (
    motion_case,
    navigation,
    sea_config,
    snapshots,
    START_NS,
    swath_of,
)
import numpy as np
from oracles.bin_likelihood import drift, sines_of
import pytest
from scipy.spatial.transform import Rotation

from sonar_imm.estimates import PLACES
from sonar_imm.measurements import Altitude, Navigation, Snapshot
from sonar_imm.soundings import soundings_of
from sonar_imm.trackers.bathymetry.likelihood import level_geometry
from sonar_imm.trackers.bathymetry.ping import bin_stamps
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker, PoseQueue
from sonar_imm.trackers.navigation import MOST_WAITING
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

CASE = motion_case()


def track(config, order='nav first'):
    tracker, estimates = BathymetryTracker(config), []
    poses, pings = navigation(CASE), list(snapshots(CASE))
    if order == 'by stamp':
        everything = sorted([*poses, *pings], key=lambda each: each.stamp_ns)
    else:
        everything = [*poses, *pings] if order == 'nav first' else [*pings, *poses]
    for measurement in everything:
        estimates += tracker.process(measurement)
    return estimates, tracker


def errors(estimates):
    """rmse of z, share inside two sigma, rms of the place, share inside two sigma."""
    z = np.array([each.state[:, 0] for each in estimates]) - CASE['X'][..., 2]
    vertical, horizontal = (
        np.array([each.extras[f'{name}_uncertainty'] for each in estimates])
        for name in ('vertical', 'horizontal')
    )
    aside = np.linalg.norm(
        np.array([each.xyz for each in estimates])[..., :2] - CASE['X'][..., :2], axis=-1
    )
    return (
        np.sqrt(np.mean(z**2)),
        np.mean(np.abs(z) < 2.0 * np.sqrt(vertical)),
        np.sqrt(np.mean(aside**2)),
        np.mean(aside < 2.0 * np.sqrt(horizontal)),
    )


@pytest.mark.parametrize(
    'values', [{}, {'smoothing': 'none'}, {'model_set': 'height_two_rw'}], ids=str
)
def test_a_rolling_ship_is_taken_out(values):
    estimates, _ = track(sea_config(CASE, **values))
    rmse, inside, place, inside_place = errors(estimates)
    assert rmse <= 0.17 and 0.93 <= inside <= 0.99
    assert place < 0.12 and inside_place > 0.95


def test_two_walks_reach_what_an_exact_filter_does():
    estimates, _ = track(sea_config(CASE, model_set='height_two_rw', engine='gaussian'))
    rmse, inside, place, _ = errors(estimates)
    assert rmse == pytest.approx(float(CASE['att_rmse_z']), abs=0.003)
    assert inside == pytest.approx(float(CASE['att_cov_z']), abs=0.01)
    assert place == pytest.approx(float(CASE['att_rms_h']), abs=0.003)


def test_the_right_swath_has_the_truth_in_it():
    """Without noise of the echoes an error of the height is one of the swath."""
    config, found = sea_config(CASE), []
    for k, snapshot in enumerate(snapshots(CASE)):
        swath = swath_of(CASE, config, snapshot)
        looks, g = swath.looks, swath.geometry
        offset = CASE['X'][k] - looks.position
        u = np.sum(offset * looks.stave, axis=1) / np.linalg.norm(offset, axis=1)
        found.append(g.height - g.reach * np.sin(np.arcsin(u) + g.tilt) - CASE['X'][k][:, 2])
    # What the errors of the navigation leave; the pose of the middle for all bins makes it 0.055.
    assert np.sqrt(np.mean(np.square(found))) < 0.02


@pytest.mark.parametrize('order', ['by stamp', 'pings first'])
def test_pings_wait_for_poses_in_whatever_order_they_come(order):
    config = sea_config(CASE, navigation='required', particles_per_model=20)
    expected, _ = track(config)
    found, _ = track(config, order)
    for a, b in zip(expected, found, strict=True):
        for name, column in a.columns().items():
            np.testing.assert_array_equal(column, b.columns()[name])


def test_pings_in_a_gap_are_skipped_and_counted():
    config = sea_config(CASE, navigation='required', particles_per_model=20)
    tracker, pings = BathymetryTracker(config), list(snapshots(CASE))
    middle = pings[2].stamp_ns
    for pose in navigation(CASE):
        if abs(pose.stamp_ns - middle) > 6 * 10**8:
            tracker.process(pose)
    made = [each for ping in pings for each in tracker.process(ping)]
    assert [each.stamp_ns for each in made] == [p.stamp_ns for k, p in enumerate(pings) if k != 2]
    assert tracker.counts['navigation_gap'] == 1 and tracker.counts['used'] == 5


def test_without_navigation_nothing_changes_and_with_it_the_columns_say_more():
    ping = next(snapshots(CASE))
    config = BathymetryConfig(particles_per_model=20)
    plain = BathymetryTracker(config).process(ping)[0]
    ignoring = BathymetryTracker(evolve(config, navigation='ignored'))
    for pose in navigation(CASE):
        assert ignoring.process(pose) == []
    same = ignoring.process(ping)[0]
    assert list(plain.columns()) == list(same.columns()) and soundings_of(plain) is None
    for name, column in plain.columns().items():
        np.testing.assert_array_equal(column, same.columns()[name])
    posed, _ = track(sea_config(CASE, particles_per_model=20))
    assert posed[0].frame_id == 'map' and plain.frame_id == 'sonar'
    extra = [name for name in posed[0].columns() if name not in plain.columns()]
    before = 'vertical_uncertainty horizontal_uncertainty intensity beam_angle'
    assert extra == [*before.split(), *PLACES, 'side']


@pytest.mark.parametrize('seconds, used', [(3600, 2), (3601, 1)])
def test_a_pose_from_more_than_an_hour_ahead_is_not_believed(seconds, used):
    tracker = BathymetryTracker(sea_config(CASE, navigation='required', particles_per_model=20))
    pose = next(iter(navigation(CASE)))
    tracker.process(pose)
    tracker.process(evolve(pose, stamp_ns=pose.stamp_ns + seconds * 10**9))
    assert tracker.counts['poses'] == used


def test_the_altitude_replaces_the_height_for_the_start():
    config = sea_config(
        CASE, navigation='required', sonar_height=100.0, initial_std=0.3,
        model_set='height_two_rw',
    )  # fmt: skip
    tracker = BathymetryTracker(config)
    for pose in navigation(CASE):
        tracker.process(pose)
    ping = next(snapshots(CASE))
    lost = tracker.process(ping)[0]
    tracker.process(Altitude(stamp_ns=START_NS + 10**9, altitude=15.2))
    found = tracker.process(ping)[0]
    assert abs(found.state[5, 0] + 20.0) < 0.3 < abs(lost.state[5, 0] + 20.0)


def test_angles_drift_as_a_flat_floor_turns():
    ranges = np.array([15.1, 15.15, 15.2])
    g = level_geometry(ranges, 15.0, np.radians(30.0), 0.5, of_heights=False)
    angle = np.arcsin(15.0 / ranges) - np.radians(30.0)
    out = drift(angle[:1], 1, g)
    assert out[0] == pytest.approx(angle[1], abs=1e-12)
    assert np.degrees(angle[0] - angle[1]) > 1.4
    past = np.array([np.radians(60.0) + 0.05])  # beyond straight down: it stays there
    out = drift(past, 1, g)
    assert np.pi - np.arcsin(np.sin(np.pi / 2 + 0.05) * 15.1 / 15.15) == pytest.approx(
        out[0] + np.radians(30.0)
    )


def test_drifting_poses_keep_the_height_too():
    rng = np.random.default_rng(3)
    g = level_geometry(np.array([20.0, 20.05]), 15.0, 0.5, 0.5, of_heights=False)
    g = g._replace(
        height=np.array([-5.0, -5.3]), tilt=np.array([0.5, 0.53]), reach=np.array([19.9, 20.02])
    )
    angle = rng.uniform(-0.2, 0.3, 20)
    out = drift(angle, 1, g)
    z = [g.height[t] - g.reach[t] * np.sin(a + g.tilt[t]) for t, a in ((0, angle), (1, out))]
    assert z[0] == pytest.approx(z[1], abs=1e-12)


@pytest.mark.parametrize('of_heights', [True, False])
def test_kernels_agree_with_the_formulas_of_the_array(of_heights):
    g = level_geometry(np.array([20.0, 25.0]), 15.0, 0.5, 0.5, of_heights=of_heights)
    g = g._replace(reach=np.array([19.0, 24.0]), tilt=np.array([0.4, 0.6]))
    g = g._replace(cos_tilt=np.cos(g.tilt), sin_tilt=np.sin(g.tilt), height=np.array([1.0, 2.0]))
    state = np.linspace(-0.9, 0.9, 7)
    out = sines_of(state, 1, g)
    s = (2.0 - state) / 24.0
    expected = np.sin(np.arcsin(s) - 0.6) if of_heights else np.sin(state)
    assert out == pytest.approx(expected, abs=1e-12)


def test_a_recording_says_whether_there_is_navigation():
    assert BathymetryConfig().for_inputs(frozenset({'snapshot'})).navigation == 'ignored'
    assert BathymetryConfig().for_inputs(frozenset({'snapshot', 'nav'})).navigation == 'required'
    stated = BathymetryConfig(navigation='ignored')
    assert stated.for_inputs(frozenset({'nav'})) == stated


def test_navigation_in_another_frame_is_counted():
    tracker = BathymetryTracker(BathymetryConfig())
    pose = {'position': np.zeros(3), 'orientation': [0.0, 0.0, 0.0, 1.0]}
    tracker.process(Navigation(stamp_ns=1, frame_id='map', **pose))
    tracker.process(Navigation(stamp_ns=2, frame_id='odom', **pose))
    assert tracker.counts['other_frame'] == 1 and tracker.counts['poses'] == 1


EXACT = {
    f'nav_{what}': 0.0
    for what in ('attitude_error_deg', 'heading_error_deg', 'heave_error', 'position_error')
}


def tracked(config, measurements):
    tracker = BathymetryTracker(config)
    return [each for measurement in measurements for each in tracker.process(measurement)]


def test_a_heading_that_passes_through_180_degrees_is_no_jump():
    """The heading of the case put to south; and quaternions that change their sign."""
    config = sea_config(CASE)
    poses, pings = navigation(CASE), list(snapshots(CASE))[:3]
    plain = tracked(config, [*poses, *pings])
    heading = np.array(
        [Rotation.from_quat(np.array(each.orientation)).as_euler('ZYX')[0] for each in poses]
    )
    turn = Rotation.from_euler('z', np.pi - np.median(heading))
    turned = []
    for k, each in enumerate(poses):
        q = (turn * Rotation.from_quat(np.array(each.orientation))).as_quat()
        turned.append(
            evolve(
                each, position=turn.apply(np.array(each.position)), orientation=q if k % 2 else -q
            )
        )
    south = np.array(
        [Rotation.from_quat(np.array(each.orientation)).as_euler('ZYX')[0] for each in turned]
    )
    assert (south > 3.0).any() and (south < -3.0).any()
    found = tracked(config, [*turned, *pings])
    for a, b in zip(plain, found, strict=True):
        assert b.state == pytest.approx(a.state, abs=1e-6)
        assert b.xyz == pytest.approx(turn.apply(np.array(a.xyz, float)), abs=2e-5)


def test_depth_in_the_profile_is_counted_from_the_surface():
    """The same sea 40 m higher: the floor is 40 m higher, and bends as before."""
    scene = scenario('moving_profile', {'pings': 2, 'ping_rate': 0.3, **EXACT})
    made = simulate(scene, 3)
    config = BathymetryConfig.from_mapping(scene.instruments())
    config = config.for_inputs(frozenset({'snapshot', 'nav'}))
    measurements = [each.measurement for each in made.measurements]
    lifted = [
        evolve(each, position=each.position + [0.0, 0.0, 40.0])
        if isinstance(each, Navigation)
        else each
        for each in measurements
    ]
    plain = tracked(config, measurements)
    higher = tracked(evolve(config, water_level=config.water_level + 40.0), lifted)
    for a, b in zip(plain, higher, strict=True):
        assert b.state[:, 0] - 40.0 == pytest.approx(a.state[:, 0], abs=1e-6)
    error = np.array([each.state[:, 0] for each in plain]) - [each.height for each in made.truth]
    assert np.sqrt(np.mean(np.square(error))) < 0.17


SECOND = 10**9
START = 10**6
CONFIG = BathymetryConfig(sound_speed=1500.0, max_gap=2.0)


def ping(seconds, **changes):
    """Bins that are heard 0.01 s and 0.5 s after the ping, at 1500 m/s."""
    values = {'range': [7.5, 375.0], 'iq': np.ones((2, 4), np.complex64)}
    return Snapshot(stamp_ns=round((START + seconds) * SECOND), **{**values, **changes})


def pose(seconds):
    return Navigation(
        stamp_ns=round((START + seconds) * SECOND),
        position=(float(seconds), (seconds % 100.0) ** 2, 0.0),
        orientation=(0.0, 0.0, 0.0, 1.0),
        frame_id='odom',
    )


@pytest.fixture
def queue():
    """A queue that knows poses of every second from 0 to 40 s."""
    queue = PoseQueue()
    for second in range(41):
        queue.add_pose(pose(second))
    return queue


def test_a_bin_is_heard_when_sound_has_gone_there_and_back():
    delays = bin_stamps(ping(0.0), CONFIG) - START * SECOND
    assert delays.tolist() == [0, SECOND // 100, SECOND // 2]
    faster = bin_stamps(ping(0.0, sound_speed=1600.0), CONFIG) - START * SECOND
    assert faster.tolist() == [0, 9_375_000, 468_750_000]


def test_the_ship_is_where_it_was_when_each_bin_was_heard(queue):
    queue.add_ping(ping(10.0))
    queue.add_ping(ping(39.5))
    first, last = (ping.posed for ping in queue.ready(CONFIG))
    assert first.poses.position[:, 0] == pytest.approx([10.0, 10.01, 10.5])
    assert first.poses.position[:, 1] == pytest.approx([100.0, 100.21, 110.5])  # 21 m/s
    assert last.poses.position[:, 0] == pytest.approx([39.5, 39.51, 40.0])
    assert first.frame_id == 'odom' and not len(queue)
    queue.add_ping(ping(39.6))  # its last bin is heard after the last pose
    assert queue.ready(CONFIG) == [] and len(queue) == 1
    queue.add_pose(pose(41.0))
    assert len(queue.ready(CONFIG)) == 1


@pytest.mark.parametrize(
    'seconds, altitude', [(9.0, None), (9.6, 30.0), (12.0, 31.0), (18.0, 32.0), (18.6, None)]
)
def test_the_newest_altitude_before_the_end_of_a_ping_counts_for_five_seconds(
    queue, seconds, altitude
):
    for second, height in ((13.5, 32.0), (10.0, 30.0), (30.0, 50.0), (12.0, 31.0)):
        stamp_ns = round((START + second) * SECOND)
        queue.add_altitude(Altitude(stamp_ns=stamp_ns, altitude=height))
    queue.add_ping(ping(seconds))
    (ready,) = queue.ready(CONFIG)
    assert ready.posed.altitude == altitude


def test_what_waits_too_long_is_given_up_the_oldest_first_and_counted(queue):
    for k in range(MOST_WAITING + 3):
        queue.add_ping(ping(50.0 + 0.01 * k))
    assert len(queue) == MOST_WAITING
    assert queue.counts['navigation_missing'] == 3
    for second in range(41, 60):
        queue.add_pose(pose(second))
    ready = queue.ready(CONFIG)
    assert [each.snapshot.stamp_ns for each in (ready[0], ready[-1])] == [
        ping(50.03).stamp_ns,
        ping(52.02).stamp_ns,
    ]


def test_a_clock_that_was_set_back_takes_the_waiting_pings_with_it(queue):
    queue.add_ping(ping(50.0))
    queue.add_ping(ping(51.0))
    for second in range(5):
        queue.add_pose(pose(second - 500_000.0))
    assert queue.counts['restarts'] == 1
    assert queue.counts['navigation_gap'] == 2 and not len(queue)
    queue.add_ping(ping(2.0 - 500_000.0))
    assert len(queue.ready(CONFIG)) == 1
