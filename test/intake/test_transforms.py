# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Frames that are fixed to each other: the tree, and measurements turned from one into another."""

from helpers.diver_runs import arrivals
import numpy as np
import pytest

from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.intake import KnownFrames, MOST_FRAMES, moved, TransformTree
from sonar_imm.measurements import (
    Altitude,
    ArrayDepth,
    Detections,
    Fix,
    Fixes,
    Navigation,
    Rejection,
    RelativeFix,
    Start,
    StaticTransforms,
)

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
    tree.add(StaticTransforms(poses={'base': ('map', a), 'arm': ('base', b)}))
    tree.add(StaticTransforms(poses={'sonar': ('arm', c), 'keel': ('base', d)}))
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


def test_what_is_said_again_replaces_and_a_loop_ends():
    tree = TransformTree()
    near, far = (Pose(np.array([x, 0.0, 0.0]), np.eye(3)) for x in (1.0, 2.0))
    tree.add(StaticTransforms(poses={'a': ('b', near), 'b': ('a', near)}))
    assert tree.pose('nowhere', 'a') is None
    tree.add(StaticTransforms(poses={'a': ('c', far), 'b': ('c', near)}))
    assert tree.pose('c', 'a').position.tolist() == [2.0, 0.0, 0.0]


def check_turned(before, after, variance_before, variance_after):
    """Points and covariances, against the homogeneous matrix and the turn of samples."""
    whole = matrix(TURNED) @ np.append(before, 1.0)
    assert after == pytest.approx(whole[:3], abs=1e-12)
    R = np.array([[np.cos(YAW), -np.sin(YAW)], [np.sin(YAW), np.cos(YAW)]])
    assert variance_after == pytest.approx(R @ variance_before @ R.T, abs=1e-12)


def test_positions_are_turned_with_their_covariances():
    covariance = np.array([[4.0, 1.0], [1.0, 9.0]])
    for kind in (Fix, Start):
        place = kind(stamp_ns=STAMP, position=[1.0, 2.0, 3.0], covariance=covariance, frame_id='a')
        made = moved(place, 'map', TURNED)
        assert made.frame_id == 'map' and made.stamp_ns == STAMP
        check_turned(place.position, made.position, covariance, made.covariance[:2, :2])
    assert moved(Fix(stamp_ns=1, position=[0.0, 0.0, 0.0]), 'map', TURNED).covariance is None
    whole = np.array([[4.0, 1.0, 0.5], [1.0, 9.0, -0.4], [0.5, -0.4, 0.25]])
    made = moved(Fix(stamp_ns=1, position=[0.0, 0.0, 0.0], covariance=whole), 'map', TURNED)
    assert made.covariance == pytest.approx(TURNED.R @ whole @ TURNED.R.T, abs=1e-12)
    unknown = np.full((2, 2), np.nan)
    scan = Fixes(
        stamp_ns=STAMP,
        position=[[1.0, 2.0, 3.0], [5.0, 6.0, 0.0]],
        covariance=np.array([covariance, unknown]),
    )
    made = moved(scan, 'map', TURNED)
    check_turned(scan.position[0], made.position[0], covariance, made.covariance[0, :2, :2])
    assert np.isnan(made.covariance[1]).all()


def test_arrivals_are_turned_with_their_bearings():
    n = 2
    ping = arrivals(
        STAMP,
        np.array([[0.0, 0.0, 0.0], [50.0, 0.0, -2.0]]),
        np.full(n, 0.05),
        tx=np.ones((n, 3)),
        bearing=np.array([3.0, np.nan]),
        var_bearing=0.01,
    )
    made = moved(ping, 'map', TURNED)
    for k in range(n):
        check_turned(ping.rx[k], made.rx[k], np.eye(2), np.eye(2))
    assert made.bearing[0] == pytest.approx(3.0 + YAW - 2.0 * np.pi) and np.isnan(made.bearing[1])


def test_navigation_is_turned_as_its_pose_is():
    rng = np.random.default_rng(1)
    root = rng.normal(size=(6, 6))
    quaternion = rng.normal(size=4)
    navigation = Navigation(
        stamp_ns=STAMP,
        position=[1.0, 2.0, 3.0],
        orientation=quaternion / np.linalg.norm(quaternion),
        velocity=[1.0, 0.5, 0.1],
        pose_covariance=root @ root.T,
        frame_id='odom',
    )
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
    fix = Fix(stamp_ns=STAMP, position=[0.0, 0.0, 0.0], frame_id='deck')
    with pytest.raises(Rejection, match="'deck' is tilted against 'map'"):
        moved(fix, 'map', tilted)
    ping = Detections(stamp_ns=STAMP, range=[1.0], bearing=[0.0], frame_id='sonar')
    with pytest.raises(Rejection, match="'sonar'"):
        moved(ping, 'map', TURNED)


def test_what_sensors_on_board_measure_is_turned_into_the_axes_of_the_first_one():
    echo = Detections(stamp_ns=STAMP, range=[5.0], bearing=[3.0], frame_id='skewed')
    here = Pose(np.zeros(3), TURNED.R)
    made = moved(echo, 'sonar', here)
    assert made.frame_id == 'sonar' and made.range.tolist() == [5.0]
    assert made.bearing == pytest.approx([3.0 + YAW - 2.0 * np.pi])
    with pytest.raises(Rejection, match="'skewed' is another one, at another place"):
        moved(echo, 'sonar', TURNED)

    height = Altitude(stamp_ns=STAMP, altitude=9.0, variance=0.04, frame_id='altimeter')
    made = moved(height, 'dvl', TURNED)
    assert (made.altitude, made.variance, made.frame_id) == (6.0, 0.04, 'dvl')

    tilted = Pose(np.array([2.0, 0.5, -1.0]), geometry.rotation(0.3, -0.4, 0.9))
    covariance = np.diag([1.0, 4.0, 9.0])
    fix = RelativeFix(stamp_ns=STAMP, offset=[9.0, 2.0, -4.0], covariance=covariance, frame_id='b')
    made = moved(fix, 'usbl', tilted)
    assert made.offset == pytest.approx((matrix(tilted) @ [9.0, 2.0, -4.0, 1.0])[:3])
    assert made.covariance == pytest.approx(tilted.R @ covariance @ tilted.R.T)
    level = RelativeFix(stamp_ns=STAMP, offset=[9.0, 2.0, -4.0], levelled=True, frame_id='b')
    made = moved(level, 'usbl', Pose(np.zeros(3), tilted.R))
    assert made.offset.tolist() == [9.0, 2.0, -4.0] and made.frame_id == 'usbl'
    with pytest.raises(Rejection, match='do not say how the vessel lies'):
        moved(level, 'usbl', tilted)


def test_frames_whose_names_wander_are_forgotten_and_those_said_again_are_not():
    tree, step = TransformTree(), Pose(np.ones(3), np.eye(3))
    for k in range(3 * MOST_FRAMES):
        tree.add(StaticTransforms(stamp_ns=STAMP, poses={f'f{k}': (f'f{k - 1}', step)}))
        if k % 100 == 0:
            tree.add(StaticTransforms(stamp_ns=STAMP, poses={'sonar': ('hull', step)}))
    assert len(tree._poses) == MOST_FRAMES
    assert tree.pose('hull', 'sonar') is not None
    assert tree.pose('f0', 'f1') is None
    assert tree.pose(f'f{3 * MOST_FRAMES - 2}', f'f{3 * MOST_FRAMES - 1}') is not None


# One frame for one tracker.


def fix(frame_id):
    return Fix(stamp_ns=1, position=(0.0, 0.0, 0.0), frame_id=frame_id)


def refused(frames, frame_id):
    with pytest.raises(Rejection) as caught:
        frames.admit(fix(frame_id))
    return caught.value


def test_the_first_named_frame_stays():
    frames = KnownFrames()
    frames.admit(fix(''))
    frames.admit(fix('map'))
    frames.admit(fix('map'))
    rejection = refused(frames, 'odom')
    assert rejection.reason == 'frame'
    assert rejection.sentence == "the frame 'odom' is not the frame 'map' of the tracks"
    refused(frames, '')


def test_a_required_frame_holds_before_any_is_known():
    frames = KnownFrames()
    with pytest.raises(Rejection, match="'map' is not the frame 'harbour' of the tracks"):
        frames.check(fix('map'), 'harbour')
    with pytest.raises(Rejection, match="'' is not the frame 'harbour' of the tracks"):
        frames.check(fix(''), 'harbour')
    frames.check(fix('harbour'), 'harbour')
    frames.check(Altitude(stamp_ns=1, altitude=3.0, frame_id='altimeter'), 'harbour')
    assert frames.frame_id == ''


def test_what_sensors_on_board_say_is_in_frames_of_their_own():
    frames = KnownFrames()
    echo = Detections(stamp_ns=1, range=[], bearing=[], frame_id='sonar')
    height = Altitude(stamp_ns=1, altitude=3.0, frame_id='altimeter')
    place = Navigation(stamp_ns=1, position=[0, 0, 0], orientation=[0, 0, 0, 1], frame_id='odom')
    for measurement in (echo, height, place, echo, height, place):
        frames.admit(measurement)
    for other in (
        Detections(stamp_ns=1, range=[], bearing=[], frame_id='sonar_2'),
        Navigation(stamp_ns=1, position=[0, 0, 0], orientation=[0, 0, 0, 1], frame_id='map'),
    ):
        with pytest.raises(Rejection) as caught:
            frames.admit(other)
        assert caught.value.reason == 'frame'


def test_a_depth_is_a_depth_in_any_frame():
    frames = KnownFrames()
    frames.admit(fix('map'))
    frames.admit(ArrayDepth(stamp_ns=1, depth=30.0, frame_id='buoy'))
    assert frames.frame_id == 'map'
