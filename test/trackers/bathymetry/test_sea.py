# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The tracker on a ship that moves: the vectors of motion, gaps, pings that wait for poses."""

from attrs import evolve
from helpers.bathymetry_cases import EXACT
from helpers.estimates import same
from helpers.vector_files import load_vectors
import numpy as np
from oracles.bin_likelihood import drift, sines_of
import pytest
from scipy.spatial.transform import Rotation

from sonar_imm.estimates import PLACES
from sonar_imm.measurements import Altitude, Navigation, Snapshot
from sonar_imm.soundings import soundings_of
from sonar_imm.trackers.bathymetry.likelihood import level_geometry, ship_swath
from sonar_imm.trackers.bathymetry.ping import bin_stamps
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker, PoseQueue
from sonar_imm.trackers.navigation import MOST_WAITING, NavigationBuffer
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

CASE = load_vectors('bathymetry_sea/motion_0')
START_NS = 10**18
POSES = [
    Navigation(stamp_ns=START_NS + round(t * 1e9), position=p, orientation=q, frame_id='map')
    for t, p, q in zip(CASE['tn'], CASE['pn'], CASE['qn'])
]
PINGS = [
    Snapshot(
        stamp_ns=START_NS + round(t * 1e9), frame_id='sonar', range=CASE['r'],
        iq=parts[..., 0] + 1j * parts[..., 1], sound_speed=float(CASE['c']),
        noise_variance=np.full(len(CASE['r']), float(CASE['sn2'])),
    )
    for t, parts in zip(CASE['t'], CASE['iq'].astype(np.float64))
]  # fmt: skip


def sea_config(**values):
    stated = {
        'sonar_lever': CASE['lever'].tolist(), 'sonar_mount_rpy_deg': CASE['mount_deg'].tolist(),
        'tilt_deg': float(CASE['tilt_deg']), 'side': str(CASE['side']),
    }  # fmt: skip
    return BathymetryConfig(**{**EXACT, **stated, **values})


def track(config, order='nav first'):
    given = [*PINGS, *POSES] if order == 'pings first' else [*POSES, *PINGS]
    if order == 'by stamp':
        given.sort(key=lambda each: each.stamp_ns)
    return tracked(config, given)[0]


def tracked(config, measurements):
    """The estimates, and the tracker."""
    tracker = BathymetryTracker(config)
    made = [each for measurement in measurements for each in tracker.process(measurement)]
    return made, tracker


QUICK = {'navigation': 'required', 'particles_per_model': 20}


def errors(estimates):
    """rmse of z, share inside two sigma, rms of the place, share inside two sigma."""
    off = np.array([each.xyz for each in estimates]) - CASE['X']
    aside = np.linalg.norm(off[..., :2], axis=-1)
    z = np.array([each.state[:, 0] for each in estimates]) - CASE['X'][..., 2]
    found = []
    for error, name in ((z, 'vertical'), (aside, 'horizontal')):
        variance = np.array([each.extras[f'{name}_uncertainty'] for each in estimates])
        inside = np.abs(error) < 2.0 * np.sqrt(variance)
        found += [np.sqrt(np.mean(error**2)), np.mean(inside)]
    return found


@pytest.mark.parametrize('values', [{}, {'model_set': 'height_two_rw'}], ids=str)
def test_a_rolling_ship_is_taken_out(values):
    rmse, inside, place, inside_place = errors(track(sea_config(**values)))
    assert rmse <= 0.17 and 0.93 <= inside <= 0.99
    assert place < 0.12 and inside_place > 0.95


def test_two_walks_reach_what_an_exact_filter_does():
    config = sea_config(model_set='height_two_rw', engine='gaussian')
    rmse, inside, place, _ = errors(track(config))
    assert rmse == pytest.approx(float(CASE['att_rmse_z']), abs=0.003)
    assert inside == pytest.approx(float(CASE['att_cov_z']), abs=0.01)
    assert place == pytest.approx(float(CASE['att_rms_h']), abs=0.003)


def test_the_right_swath_has_the_truth_in_it():
    """Without noise of the echoes an error of the height is one of the swath."""
    config, found = sea_config(), []
    buffer = NavigationBuffer(tuple(each.stamp_ns for each in POSES), tuple(POSES))
    for snapshot, truth in zip(PINGS, CASE['X']):
        array = snapshot.ranges(config.sound_speed), float(CASE['c']), config.side
        heard = buffer.poses(bin_stamps(snapshot, config))
        swath = ship_swath(config, *array, float(CASE['dlam']), heard)
        looks, g = swath.looks, swath.geometry
        offset = truth - looks.position
        u = np.sum(offset * looks.stave, axis=1) / np.linalg.norm(offset, axis=1)
        found.append(g.height - g.reach * np.sin(np.arcsin(u) + g.tilt) - truth[:, 2])
    # What the errors of the navigation leave; the pose of the middle for all bins makes it 0.055.
    assert np.sqrt(np.mean(np.square(found))) < 0.02


@pytest.mark.parametrize('order', ['by stamp', 'pings first'])
def test_pings_wait_for_poses_in_whatever_order_they_come(order):
    config = sea_config(**QUICK)
    for a, b in zip(track(config), track(config, order), strict=True):
        assert same(a, b)


def test_pings_in_a_gap_are_skipped_and_counted():
    poses = [each for each in POSES if abs(each.stamp_ns - PINGS[2].stamp_ns) > 6 * 10**8]
    made, tracker = tracked(sea_config(**QUICK), [*poses, *PINGS])
    assert [each.stamp_ns for each in made] == [p.stamp_ns for p in (*PINGS[:2], *PINGS[3:])]
    assert tracker.counts['navigation_gap'] == 1 and tracker.counts['used'] == 5


def test_without_navigation_nothing_changes_and_with_it_the_columns_say_more():
    config = BathymetryConfig(particles_per_model=20)
    (plain,), _ = tracked(config, PINGS[:1])
    (ignoring,), _ = tracked(evolve(config, navigation='ignored'), [*POSES, PINGS[0]])
    assert same(plain, ignoring)
    assert soundings_of(plain) is None and plain.frame_id == 'sonar'
    posed = track(sea_config(particles_per_model=20))[0]
    extra = [name for name in posed.columns() if name not in plain.columns()]
    before = 'vertical_uncertainty horizontal_uncertainty intensity beam_angle'
    assert posed.frame_id == 'map' and extra == [*before.split(), *PLACES, 'side']


@pytest.mark.parametrize('seconds, used', [(3600, 2), (3601, 1)])
def test_a_pose_from_more_than_an_hour_ahead_is_not_believed(seconds, used):
    later = evolve(POSES[0], stamp_ns=POSES[0].stamp_ns + seconds * SECOND)
    assert tracked(sea_config(**QUICK), [POSES[0], later])[1].counts['poses'] == used


def test_the_altitude_replaces_the_height_for_the_start():
    wrong = {'sonar_height': 100.0, 'initial_std': 0.3, 'model_set': 'height_two_rw'}
    altitude = Altitude(stamp_ns=START_NS + SECOND, altitude=15.2)
    given = [*POSES, PINGS[0], altitude, PINGS[0]]
    (lost, found), _ = tracked(sea_config(navigation='required', **wrong), given)
    assert abs(found.state[5, 0] + 20.0) < 0.3 < abs(lost.state[5, 0] + 20.0)


def geometry_of(ranges, looks=0.5, of_heights=False, **changes):
    g = level_geometry(np.array(ranges), 15.0, looks, 0.5, of_heights=of_heights)
    return g._replace(**{name: np.array(value) for name, value in changes.items()})


def test_angles_drift_as_a_flat_floor_turns_and_poses_keep_its_height():
    ranges = [15.1, 15.15, 15.2]
    g = geometry_of(ranges, looks=np.radians(30.0))
    angle = np.arcsin(15.0 / np.array(ranges)) - np.radians(30.0)
    assert drift(angle[:1], 1, g)[0] == pytest.approx(angle[1], abs=1e-12)
    assert np.degrees(angle[0] - angle[1]) > 1.4
    out = drift(np.array([np.radians(60.0) + 0.05]), 1, g)  # beyond straight down: it stays there
    still = np.pi - np.arcsin(np.cos(0.05) * 15.1 / 15.15)
    assert out[0] + np.radians(30.0) == pytest.approx(still)

    g = geometry_of([20.0, 20.05], height=[-5.0, -5.3], tilt=[0.5, 0.53], reach=[19.9, 20.02])
    angle = np.random.default_rng(3).uniform(-0.2, 0.3, 20)
    out = drift(angle, 1, g)
    z = [g.height[t] - g.reach[t] * np.sin(a + g.tilt[t]) for t, a in ((0, angle), (1, out))]
    assert z[0] == pytest.approx(z[1], abs=1e-12)


@pytest.mark.parametrize('of_heights', [True, False])
def test_kernels_agree_with_the_formulas_of_the_array(of_heights):
    turned = {'tilt': [0.4, 0.6], 'cos_tilt': np.cos([0.4, 0.6]), 'sin_tilt': np.sin([0.4, 0.6])}
    placed = {'reach': [19.0, 24.0], 'height': [1.0, 2.0], **turned}
    g = geometry_of([20.0, 25.0], of_heights=of_heights, **placed)
    state = np.linspace(-0.9, 0.9, 7)
    angle = np.arcsin((2.0 - state) / 24.0) - 0.6 if of_heights else state
    assert sines_of(state, 1, g) == pytest.approx(np.sin(angle), abs=1e-12)


def test_a_recording_says_whether_there_is_navigation():
    assert BathymetryConfig().for_inputs(frozenset({'snapshot'})).navigation == 'ignored'
    assert BathymetryConfig().for_inputs(frozenset({'snapshot', 'nav'})).navigation == 'required'
    stated = BathymetryConfig(navigation='ignored')
    assert stated.for_inputs(frozenset({'nav'})) == stated


def test_navigation_in_another_frame_is_counted():
    poses = [evolve(pose(k), frame_id=name) for k, name in enumerate(('map', 'odom'))]
    _, tracker = tracked(BathymetryConfig(), poses)
    assert tracker.counts['other_frame'] == 1 and tracker.counts['poses'] == 1


def test_a_heading_that_passes_through_180_degrees_is_no_jump():
    """The heading of the case put to south; and quaternions that change their sign."""
    plain, _ = tracked(sea_config(), [*POSES, *PINGS[:3]])
    attitude = Rotation.from_quat([each.orientation for each in POSES])
    turn = Rotation.from_euler('z', np.pi - np.median(attitude.as_euler('ZYX')[:, 0]))
    south = (turn * attitude).as_euler('ZYX')[:, 0]
    assert (south > 3.0).any() and (south < -3.0).any()
    turned = []
    for k, (each, q) in enumerate(zip(POSES, (turn * attitude).as_quat())):
        place = turn.apply(np.array(each.position))
        turned.append(evolve(each, position=place, orientation=q if k % 2 else -q))
    for a, b in zip(plain, tracked(sea_config(), [*turned, *PINGS[:3]])[0], strict=True):
        assert b.state == pytest.approx(a.state, abs=1e-6)
        assert b.xyz == pytest.approx(turn.apply(np.array(a.xyz, float)), abs=2e-5)


def test_depth_in_the_profile_is_counted_from_the_surface():
    """The same sea 40 m higher: the floor is 40 m higher, and bends as before."""
    wrong = ('attitude_error_deg', 'heading_error_deg', 'heave_error', 'position_error')
    exact = {f'nav_{name}': 0.0 for name in wrong}
    scene = scenario('moving_profile', {'pings': 2, 'ping_rate': 0.3, **exact})
    made, config = simulate(scene, 3), BathymetryConfig.from_mapping(scene.instruments())
    config = config.for_inputs(frozenset({'snapshot', 'nav'}))
    given = [each.measurement for each in made.measurements]
    plain, _ = tracked(config, given)
    for k, each in enumerate(given):
        if isinstance(each, Navigation):
            given[k] = evolve(each, position=each.position + [0.0, 0.0, 40.0])
    higher, _ = tracked(evolve(config, water_level=config.water_level + 40.0), given)
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
    place = (float(seconds), (seconds % 100.0) ** 2, 0.0)
    return Navigation(
        stamp_ns=round((START + seconds) * SECOND), position=place, orientation=(0, 0, 0, 1),
        frame_id='odom',
    )  # fmt: skip


@pytest.fixture
def queue():
    """A queue that knows poses of every second from 0 to 40 s."""
    queue = PoseQueue()
    add_poses(queue, range(41))
    return queue


def add_poses(queue, seconds):
    for second in seconds:
        queue.add_pose(pose(second))


@pytest.mark.parametrize('speed, delays', [(1500, [0.01, 0.5]), (1600, [0.009375, 0.46875])])
def test_a_bin_is_heard_when_sound_has_gone_there_and_back(speed, delays):
    stamps = bin_stamps(ping(0.0, sound_speed=float(speed)), CONFIG) - START * SECOND
    assert stamps.tolist() == [0, *(round(delay * SECOND) for delay in delays)]


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
    assert [ready.posed.altitude for ready in queue.ready(CONFIG)] == [altitude]


def test_what_waits_too_long_is_given_up_the_oldest_first_and_counted(queue):
    for k in range(MOST_WAITING + 3):
        queue.add_ping(ping(50.0 + 0.01 * k))
    assert len(queue) == MOST_WAITING and queue.counts['navigation_missing'] == 3
    add_poses(queue, range(41, 60))
    stamps = [each.snapshot.stamp_ns for each in queue.ready(CONFIG)]
    assert (stamps[0], stamps[-1]) == (ping(50.03).stamp_ns, ping(52.02).stamp_ns)


def test_a_clock_that_was_set_back_takes_the_waiting_pings_with_it(queue):
    for second in (50.0, 51.0):
        queue.add_ping(ping(second))
    add_poses(queue, np.arange(5) - 500_000.0)
    assert queue.counts['restarts'] == 1
    assert queue.counts['navigation_gap'] == 2 and not len(queue)
    queue.add_ping(ping(2.0 - 500_000.0))
    assert len(queue.ready(CONFIG)) == 1
