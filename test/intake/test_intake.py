# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What /tf_static says: the place of a sonar on its vehicle, and measurements in another frame."""

from collections import deque
import contextlib

import attrs
from attrs import evolve
from helpers.diver_runs import arrivals
from helpers.refusals import reason
import numpy as np
import pytest

from sonar_imm import measurements
from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.intake import Intake, KnownFrames, MOST_FRAMES, moved, TransformTree
from sonar_imm.measurements import Altitude, Detections, Fix, Fixes, Navigation, NOBODY, Rejection
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm.trackers.state_values import frozen_state
from sonar_imm_tools.simulation.bathymetry import simulator as swath
from sonar_imm_tools.simulation.obstacle import simulator as obstacle

LEVER, RPY = (1.5, -0.3, 0.4), (2.0, -15.0, 8.0)
MOUNT = Pose(np.array(LEVER), geometry.rotation(*np.radians(RPY)))
FRAMES = {'vehicle_frame': 'base_link', 'sonar_frame': 'sonar'}


def transforms(stamp_ns=None, **poses):
    """What is said of frames: the parent of each and its pose there."""
    stamp = {} if stamp_ns is None else {'stamp_ns': stamp_ns}
    return measurements.StaticTransforms(poses=poses, **stamp)


def shift(x, y=0.0, z=0.0):
    return Pose(np.array([x, y, z]), np.eye(3))


BRACKET = 'bracket', Pose(np.zeros(3), MOUNT.R)
TRANSFORMS = transforms(sonar=BRACKET, bracket=('base_link', shift(*LEVER)))


def scene_of(system):
    if system == 'obstacle':
        scene = obstacle.scenario('approach', {})
        return scene, obstacle.simulate(scene, 1).measurements[:200]
    scene = swath.scenario('moving', {'pings': 3})
    return scene, swath.simulate(scene, 1).measurements


def built(system, **parameters):
    return SYSTEMS[system].build(SYSTEMS[system].config_type()(**parameters))


def run(system, *transforms, **parameters):
    """The last estimate, the reasons of refusals, and the tracker."""
    scene, received = scene_of(system)
    tracker = built(system, **{**scene.instruments(), **parameters})
    intake, made, refused = Intake(tracker), [], []
    for item in (*transforms, *(item.measurement for item in received)):
        try:
            measurement = intake.admit(item)
        except Rejection as rejection:
            refused.append(rejection)
            continue
        if measurement is not None:
            made += tracker.process(measurement)
    return made[-1] if made else None, refused, tracker


@pytest.mark.parametrize('system', ['obstacle', 'bathymetry'])
def test_a_mounting_that_transforms_say_is_that_of_the_parameters(system):
    by_hand, _, _ = run(system, sonar_lever=LEVER, sonar_mount_rpy_deg=RPY)
    plain, _, _ = run(system)
    mounted, refused, tracker = run(system, TRANSFORMS, **FRAMES)
    assert not refused and tracker.config.sonar_lever == LEVER
    assert tracker.config.sonar_mount_rpy_deg == pytest.approx(RPY)
    assert mounted.state == pytest.approx(by_hand.state, rel=1e-9, abs=1e-9, nan_ok=True)
    assert mounted.xyz == pytest.approx(by_hand.xyz, rel=1e-5, abs=1e-5, nan_ok=True)
    assert not np.array_equal(plain.state, mounted.state, equal_nan=True)
    # Before it is known pings are refused by name.
    last, refused, _ = run(system, **FRAMES)
    assert last is None and {item.reason for item in refused} == {'no_mounting'}
    assert "'sonar' is on 'base_link'" in refused[0].sentence
    with pytest.raises(ConfigError, match='need each other'):
        built(system, sonar_frame='sonar')


def test_a_change_of_parameters_keeps_the_mounting():
    tracker = built('obstacle', **FRAMES)
    config, intake = tracker.config, Intake(tracker)
    intake.admit(TRANSFORMS)
    intake.reconfigure(evolve(config, detection_probability=0.5))
    assert tracker.config.detection_probability == 0.5 and tracker.config.sonar_lever == LEVER


def test_a_required_frame_survives_a_reset_and_a_first_one_does_not():
    tracker = built('diver')
    for required in ('', 'map'):
        intake = Intake(tracker, required)
        tracker.process(intake.admit(fix('map', 1.0)))
        refused = pytest.raises(Rejection, match="'odom' is not the frame 'map' of the tracks")
        with refused:
            intake.admit(fix('odom', 2.0))
        intake.reset()
        with refused if required else contextlib.nullcontext():
            assert intake.admit(fix('odom', 2.0)).frame_id == 'odom'
    # An array keeps to its first frame too.
    scene, received = scene_of('bathymetry')
    pings = (item.measurement for item in received)
    snapshot = next(ping for ping in pings if isinstance(ping, measurements.Snapshot))
    intake = Intake(built('bathymetry', **scene.instruments()))
    first = evolve(snapshot, frame_id='array')
    assert intake.admit(first) is first
    with pytest.raises(Rejection, match="'hull' is not the frame 'array'"):
        intake.admit(evolve(snapshot, frame_id='hull'))


def fix(frame_id, x=0.0):
    return Fix(stamp_ns=10**9, position=[x, 0.0, 0.0], covariance=np.eye(2), frame_id=frame_id)


def level(frame_id, stamp_ns=1):
    place = {'position': [0.0, 0.0, 0.0], 'orientation': [0.0, 0.0, 0.0, 1.0]}
    return Navigation(stamp_ns=stamp_ns, frame_id=frame_id, **place)


def test_a_position_in_another_frame_is_turned_where_the_transform_is_known():
    intake = Intake(built('diver'), 'map')
    with pytest.raises(Rejection, match="'pier' is not the frame 'map'"):
        intake.admit(fix('pier', 1.0))
    quarter = Pose(np.array([100.0, 0.0, 0.0]), geometry.rotation(0.0, 0.0, np.pi / 2.0))
    intake.admit(transforms(pier=('map', quarter)))
    made = intake.admit(fix('pier', 1.0))
    assert made.frame_id == 'map' and made.position == pytest.approx([100.0, 1.0, 0.0])
    assert intake.admit(fix('map', 1.0)).position.tolist() == [1.0, 0.0, 0.0]
    with pytest.raises(Rejection, match="'odom' is not the frame 'map'"):
        intake.admit(fix('odom', 1.0))


def altitude(intake, frame_id, second=1):
    """The altitude of that frame, admitted and processed."""
    made = intake.admit(Altitude(stamp_ns=second * STAMP, altitude=9.0, frame_id=frame_id))
    intake.tracker.process(made)
    return made


def test_an_altimeter_in_another_frame_is_turned_where_the_transform_is_known():
    intake = Intake(built('bathymetry'))
    assert altitude(intake, 'dvl').altitude == 9.0
    with pytest.raises(Rejection, match="'altimeter' is not .* and no fixed transform joins"):
        altitude(intake, 'altimeter')
    intake.admit(transforms(altimeter=('dvl', shift(0.0, 0.0, 1.5))))
    made = altitude(intake, 'altimeter')
    assert made.altitude == 7.5 and made.frame_id == 'dvl'


def test_a_late_altitude_does_not_shut_out_the_later_ones():
    intake = Intake(built('obstacle'))
    counts = intake.tracker.counts
    for second in range(5000, 5005):
        intake.tracker.process(intake.admit(level('map', second * STAMP)))
    altitude(intake, 'another', 4000)
    assert counts['too_late'] == 1
    altitude(intake, 'altimeter', 5005)
    assert counts['used'] == 6
    with pytest.raises(Rejection, match="'another' is not the frame 'altimeter'"):
        altitude(intake, 'another', 5006)


def wandering(k, rng):
    """What comes in a second when every sensor has another name, and all it sees too."""
    stamp_ns, place = k * 10**9, np.append(rng.normal(scale=50.0, size=2), -5.0)
    rx = np.column_stack([rng.normal(scale=80.0, size=(4, 2)), np.full(4, -3.0)])
    yield transforms(**{f'sonar_{k}': ('map', shift(0.0))})
    yield evolve(fix('map', place[0]), stamp_ns=stamp_ns, target_id=k, sensor=f'usbl_{k}')
    yield evolve(fix(f'sonar_{k}', place[1]), stamp_ns=stamp_ns)
    yield Fixes(
        stamp_ns=stamp_ns, frame_id=f'sonar_{k}', sensor=f'sonar_{k}',
        position=place + rng.normal(size=(3, 3)), target_id=[k, 10**6 + k, NOBODY],
    )  # fmt: skip
    time = np.linalg.norm(rx - place, axis=1) / 1500.0
    names = {'tx_id': np.full(4, k), 'rx_id': 4 * k + np.arange(4), 'var_toa': 1e-07}
    yield arrivals(stamp_ns, rx, 2.0 * time, tx=rx[[0, 0, 0, 0]], **names)
    yield arrivals(stamp_ns, rx, time, tx=np.full((4, 3), np.nan), **names)


def entries(value):
    """How many values a frozen state has, an array being one."""
    if attrs.has(type(value)):
        value = attrs.asdict(value, recurse=False)
    if isinstance(value, dict):
        value = list(value.values())
    return sum(map(entries, value)) if isinstance(value, (list, tuple, deque)) else 1


def test_a_tracker_does_not_grow_with_names_that_wander():
    parameters = {'fix_bias_std': 0.5, 'max_coast': 2.0, 'history': 0.0}
    intake = Intake(DiverTracker(DiverConfig(model_set='heading_speed', **parameters)))
    rng, sizes = np.random.default_rng(1), []
    for k in range(1, 61):
        for admitted in map(intake.admit, wandering(k, rng)):
            if admitted is not None:
                intake.tracker.process(admitted)
        sizes.append(entries(frozen_state(intake.tracker)))
    assert max(sizes[30:]) <= max(sizes[:30])


# -- the tree of frames, and measurements turned from one into another ----------------------------

STAMP = 10**9
YAW = 0.7
TURNED = Pose(np.array([10.0, -20.0, 3.0]), geometry.rotation(0.0, 0.0, YAW))


def a_pose(rng):
    return Pose(rng.normal(size=3), geometry.rotation(*rng.uniform(-1.5, 1.5, size=3)))


def matrix(pose):
    """Homogeneous: an independent way to write the same."""
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = pose.R, pose.position
    return whole


def test_a_chain_of_transforms_is_the_product_of_its_matrices():
    rng = np.random.default_rng(3)
    a, b, c, d = (a_pose(rng) for _ in range(4))
    tree = TransformTree()
    tree.add(transforms(base=('map', a), arm=('base', b)))
    tree.add(transforms(sonar=('arm', c), keel=('base', d)))
    A, B, C, D = (matrix(pose) for pose in (a, b, c, d))
    for target, source, expected in (
        ('map', 'sonar', A @ B @ C),
        ('sonar', 'map', np.linalg.inv(A @ B @ C)),
        ('keel', 'sonar', np.linalg.inv(D) @ B @ C),
        ('base', 'sonar', B @ C),
        ('base', 'base', np.eye(4)),
    ):
        assert matrix(tree.pose(target, source)) == pytest.approx(expected, abs=1e-12)
    assert tree.pose('map', 'elsewhere') is None and tree.pose('elsewhere', 'map') is None
    # What is said again replaces, and a loop ends.
    tree = TransformTree()
    tree.add(transforms(a=('b', shift(1.0)), b=('a', shift(1.0))))
    assert tree.pose('nowhere', 'a') is None
    tree.add(transforms(a=('c', shift(2.0)), b=('c', shift(1.0))))
    assert tree.pose('c', 'a').position.tolist() == [2.0, 0.0, 0.0]


def check_turned(before, after, variance_before, variance_after):
    """Points and covariances, against the homogeneous matrix and the turn of samples."""
    assert after == pytest.approx((matrix(TURNED) @ [*before, 1.0])[:3], abs=1e-12)
    R = np.array([[np.cos(YAW), -np.sin(YAW)], [np.sin(YAW), np.cos(YAW)]])
    assert variance_after == pytest.approx(R @ variance_before @ R.T, abs=1e-12)


def test_positions_are_turned_with_their_covariances():
    covariance = np.array([[4.0, 1.0], [1.0, 9.0]])
    for kind in (Fix, measurements.Start):
        place = kind(stamp_ns=STAMP, position=[1.0, 2.0, 3.0], covariance=covariance, frame_id='a')
        made = moved(place, 'map', TURNED)
        assert made.frame_id == 'map' and made.stamp_ns == STAMP
        check_turned(place.position, made.position, covariance, made.covariance[:2, :2])
    whole = np.array([[4.0, 1.0, 0.5], [1.0, 9.0, -0.4], [0.5, -0.4, 0.25]])
    place = evolve(fix('a'), covariance=whole)
    turned = moved(place, 'map', TURNED).covariance
    assert turned == pytest.approx(TURNED.R @ whole @ TURNED.R.T, abs=1e-12)
    assert moved(evolve(place, covariance=None), 'map', TURNED).covariance is None
    scan = Fixes(
        stamp_ns=STAMP, position=[[1.0, 2.0, 3.0], [5.0, 6.0, 0.0]],
        covariance=np.array([covariance, np.full((2, 2), np.nan)]),
    )  # fmt: skip
    made = moved(scan, 'map', TURNED)
    check_turned(scan.position[0], made.position[0], covariance, made.covariance[0, :2, :2])
    assert np.isnan(made.covariance[1]).all()


def test_arrivals_are_turned_with_their_bearings():
    rx, seen = np.array([[0.0, 0.0, 0.0], [50.0, 0.0, -2.0]]), np.array([3.0, np.nan])
    more = {'tx': np.ones((2, 3)), 'bearing': seen, 'var_bearing': 0.01}
    ping = arrivals(STAMP, rx, np.full(2, 0.05), **more)
    made = moved(ping, 'map', TURNED)
    for before, after in zip(ping.rx, made.rx):
        check_turned(before, after, np.eye(2), np.eye(2))
    assert made.bearing == pytest.approx([3.0 + YAW - 2.0 * np.pi, np.nan], nan_ok=True)


def test_navigation_is_turned_as_its_pose_is():
    rng = np.random.default_rng(1)
    root, quaternion = rng.normal(size=(6, 6)), rng.normal(size=4)
    turn = {'orientation': quaternion / np.linalg.norm(quaternion), 'velocity': [1.0, 0.5, 0.1]}
    place = {'position': [1.0, 2.0, 3.0], 'pose_covariance': root @ root.T, 'frame_id': 'odom'}
    navigation = Navigation(stamp_ns=STAMP, **place, **turn)
    made = moved(navigation, 'map', TURNED)
    before = geometry.rotation_of_quaternion(navigation.orientation)
    after = geometry.rotation_of_quaternion(made.orientation)
    assert after == pytest.approx(TURNED.R @ before, abs=1e-12)
    assert made.velocity.tolist() == [1.0, 0.5, 0.1]
    for part in (slice(0, 3), slice(3, 6)):
        block = TURNED.R @ navigation.pose_covariance[part, part] @ TURNED.R.T
        assert made.pose_covariance[part, part] == pytest.approx(block, abs=1e-9)
    assert made.position == pytest.approx((matrix(TURNED) @ [1.0, 2.0, 3.0, 1.0])[:3])


def test_a_tilted_frame_and_what_a_sonar_sees_are_refused_with_both_names():
    tilted = Pose(np.zeros(3), geometry.rotation(0.1, 0.0, 0.0))
    with pytest.raises(Rejection, match="'deck' is tilted against 'map'"):
        moved(fix('deck'), 'map', tilted)
    ping = Detections(stamp_ns=STAMP, range=[1.0], bearing=[0.0], frame_id='sonar')
    with pytest.raises(Rejection, match="'sonar'"):
        moved(ping, 'map', TURNED)


def test_what_sensors_on_board_measure_is_turned_into_the_axes_of_the_first_one():
    echo = Detections(stamp_ns=STAMP, range=[5.0], bearing=[3.0], frame_id='skewed')
    made = moved(echo, 'sonar', Pose(np.zeros(3), TURNED.R))
    assert made.frame_id == 'sonar' and made.range.tolist() == [5.0]
    assert made.bearing == pytest.approx([3.0 + YAW - 2.0 * np.pi])
    with pytest.raises(Rejection, match="'skewed' is another one, at another place"):
        moved(echo, 'sonar', TURNED)

    height = Altitude(stamp_ns=STAMP, altitude=9.0, variance=0.04, frame_id='altimeter')
    made = moved(height, 'dvl', TURNED)
    assert (made.altitude, made.variance, made.frame_id) == (6.0, 0.04, 'dvl')

    tilted = Pose(np.array([2.0, 0.5, -1.0]), geometry.rotation(0.3, -0.4, 0.9))
    covariance = np.diag([1.0, 4.0, 9.0])
    there = {'stamp_ns': STAMP, 'offset': [9.0, 2.0, -4.0], 'frame_id': 'b'}
    made = moved(measurements.RelativeFix(covariance=covariance, **there), 'usbl', tilted)
    assert made.offset == pytest.approx((matrix(tilted) @ [9.0, 2.0, -4.0, 1.0])[:3])
    assert made.covariance == pytest.approx(tilted.R @ covariance @ tilted.R.T)
    level = measurements.RelativeFix(levelled=True, **there)
    made = moved(level, 'usbl', Pose(np.zeros(3), tilted.R))
    assert made.offset.tolist() == [9.0, 2.0, -4.0] and made.frame_id == 'usbl'
    with pytest.raises(Rejection, match='do not say how the vessel lies'):
        moved(level, 'usbl', tilted)


def test_frames_whose_names_wander_are_forgotten_and_those_said_again_are_not():
    tree, step = TransformTree(), shift(1.0, 1.0, 1.0)
    for k in range(3 * MOST_FRAMES):
        tree.add(transforms(STAMP, **{f'f{k}': (f'f{k - 1}', step)}))
        if k % 100 == 0:
            tree.add(transforms(STAMP, sonar=('hull', step)))
    assert len(tree._poses) == MOST_FRAMES
    assert tree.pose('hull', 'sonar') is not None
    assert tree.pose('f0', 'f1') is None
    assert tree.pose(f'f{3 * MOST_FRAMES - 2}', f'f{3 * MOST_FRAMES - 1}') is not None


# One frame for one tracker.


def test_the_first_named_frame_stays_and_a_required_one_holds_before_any_is_known():
    frames, of_tracks = KnownFrames(), measurements.ArrayDepth
    for frame_id in ('map', ''):
        with pytest.raises(Rejection, match=f"'{frame_id}' is not the frame 'harbour' of the tr"):
            frames.check(fix(frame_id), 'harbour')
    frames.check(fix('harbour'), 'harbour')
    frames.check(Altitude(stamp_ns=1, altitude=3.0, frame_id='altimeter'), 'harbour')
    assert frames.frame_id == ''
    for frame_id in ('', 'map', 'map'):
        frames.admit(fix(frame_id))
    with pytest.raises(Rejection) as caught:
        frames.admit(fix('odom'))
    assert caught.value.sentence == "the frame 'odom' is not the frame 'map' of the tracks"
    assert caught.value.reason == reason(frames.admit, fix('')) == 'frame'
    frames.admit(of_tracks(stamp_ns=1, depth=30.0, frame_id='buoy'))  # one in any frame
    assert frames.frame_id == 'map'


def test_what_sensors_on_board_say_is_in_frames_of_their_own():
    frames, nothing = KnownFrames(), {'stamp_ns': 1, 'range': [], 'bearing': []}
    height = Altitude(stamp_ns=1, altitude=3.0, frame_id='altimeter')
    for measurement in (Detections(frame_id='sonar', **nothing), height, level('odom')) * 2:
        frames.admit(measurement)
    for other in (Detections(frame_id='sonar_2', **nothing), level('map')):
        assert reason(frames.admit, other) == 'frame'
