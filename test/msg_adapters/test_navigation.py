# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Poses and altitudes of a vehicle."""

import math
from types import SimpleNamespace

from attrs import asdict
from helpers import marine
from helpers.refusals import reason
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from msg_adapters.inputs import inputs_of
from msg_adapters.navigation import (
    doubt_navigation,
    read_dvl,
    read_navigation,
    read_range,
    write_navigation,
    write_range,
)
from msg_adapters.transforms import read_transforms, write_transforms
from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.measurements import Altitude, Navigation, StaticTransforms
from sonar_imm_tools.recordings.messages import ros_message

TURNED = Rotation.from_euler('ZYX', [0.7, -0.2, 0.4])


def navigation(**values):
    usual = {
        'stamp_ns': 1_700_000_000_123_456_789, 'position': [1 / 3, -2e5, -20.0],
        'orientation': TURNED.as_quat(), 'velocity': [1.5, 0.1, -0.2],
        'turn_rate': [0.01, 0.02, 0.03], 'frame_id': 'odom', 'child_frame_id': 'base_link',
    }  # fmt: skip
    return Navigation(**{**usual, **values})


def odometry(**values):
    return write_navigation(navigation(**values), ros_message)


def test_writing_and_reading_gives_the_same_navigation():
    covariance = np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    covariance[0, 1] = covariance[1, 0] = 0.5
    item = navigation(pose_covariance=covariance)
    again = read_navigation(write_navigation(item, ros_message))
    np.testing.assert_equal(asdict(again), asdict(item))


def test_a_twist_in_world_axes_is_turned_into_the_vehicle():
    child, rate = np.array([1.5, 0.1, -0.2]), np.array([0.1, 0.0, 0.2])
    stated = odometry(velocity=TURNED.apply(child), turn_rate=TURNED.apply(rate))
    for world, flip in (('enu', [1, 1, 1]), ('ned', [1, -1, -1])):
        turned = read_navigation(stated, world_frame=world, nav_twist_frame='world')
        assert turned.velocity == pytest.approx(child * flip)
        assert turned.turn_rate == pytest.approx(rate * flip)
    assert read_navigation(stated).velocity != pytest.approx(child)
    # A covariance that says nothing is unknown.
    for diagonal in (0.0, -1.0, np.nan):
        stated.pose.covariance[:] = np.diag(np.full(6, diagonal)).ravel()
        assert read_navigation(stated).pose_covariance is None


def test_a_ned_frame_is_taken_only_when_it_is_expected_and_a_missing_one_doubted():
    message = odometry(frame_id='odom_ned')
    assert reason(read_navigation, message) == 'frame_ned'
    turned = read_navigation(message, world_frame='ned')
    assert turned.position[2] == 20.0 and turned.frame_id == 'odom'
    with pytest.raises(ValueError, match='enu, ned'):
        read_navigation(message, world_frame='nwu')
    message = odometry(frame_id='')
    assert doubt_navigation(message) == 'no_frame'
    message.pose.covariance = np.zeros(35)
    assert reason(read_navigation, message) == 'bad_shape'
    assert doubt_navigation(odometry()) is None


def test_an_frd_vehicle_in_ned_becomes_an_flu_vehicle_in_enu():
    """Against matrices: east is the second axis of NED, port the negative second of FRD."""
    W, B = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.diag([1, -1, -1])
    random = np.random.default_rng(3)
    for _ in range(20):
        R = Rotation.random(random_state=random)
        root = random.normal(size=(2, 6, 6))
        pose, twist = root @ np.swapaxes(root, 1, 2)
        ways = {n: random.normal(size=3) for n in ('position', 'velocity', 'turn_rate')}
        known = {'pose_covariance': pose, 'twist_covariance': twist, **ways}
        stated = navigation(orientation=R.as_quat(), child_frame_id='base_link_frd', **known)
        turned = read_navigation(write_navigation(stated, ros_message), world_frame='ned')
        expected = W @ R.as_matrix() @ B
        assert np.allclose(Rotation.from_quat(turned.orientation).as_matrix(), expected)
        assert np.array_equal(turned.position, W @ stated.position)
        assert np.array_equal(turned.velocity, B @ stated.velocity)
        assert np.array_equal(turned.turn_rate, B @ stated.turn_rate)
        both = np.kron(np.eye(2), W), np.kron(np.eye(2), B)
        assert np.allclose(turned.pose_covariance, both[0] @ pose @ both[0].T)
        assert np.allclose(turned.twist_covariance, both[1] @ twist @ both[1].T)
        assert turned.child_frame_id == 'base_link'


@pytest.mark.filterwarnings('error')
def test_a_pose_that_cannot_be_used_is_refused():
    none = [0.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0105], [0.0, 1e300, 0.0, 1e300]
    for name, values, code in (
        *(('orientation', each, 'bad_orientation') for each in none),
        ('orientation', [0.0, np.nan, 0.0, 1.0], 'nan'), ('position', [0.0, 0.0, np.inf], 'nan'),
        ('position', [0.0, 2e8, 0.0], 'out_of_range'),
    ):  # fmt: skip
        places = {f'pose__pose__{name}__{axis}': value for axis, value in zip('xyzw', values)}
        assert reason(read_navigation, marine.put(odometry(), **places)) == code


def test_an_altitude_is_written_and_read_and_one_out_of_limits_refused():
    for variance in (0.25, np.nan):
        item = Altitude(stamp_ns=12, altitude=15.5, variance=variance, frame_id='altimeter')
        message = write_range(item, ros_message)
        np.testing.assert_equal(asdict(read_range(message)), asdict(item))
    message.min_range, message.max_range = 0.5, 50.0
    for code, heights in (('nan', (np.inf, -np.inf, np.nan)), ('out_of_range', (60.0, 0.2))):
        for height in heights:
            message.range = height
            assert reason(read_range, message) == code


def plain(altitude):
    """The three fields that are read."""
    return SimpleNamespace(header=marine.header(), altitude=altitude)


def stonefish(altitude):
    values = {'header': marine.header(), 'altitude': altitude}
    return marine.driver_message('stonefish_ros2/msg/DVL', **values)


def dave(distance, target='bottom'):
    values = {'header': marine.header(), 'target__type': target, 'target__range': distance}
    return marine.driver_message('dave_interfaces/msg/DVL', **values)


@pytest.mark.parametrize('make', [plain, stonefish, dave])
def test_the_altitude_of_a_doppler_log_needs_bottom_lock(make):
    read, message = read_dvl, make(7.25)
    if make is not plain:
        message = marine.sent(message)
        (entry,) = (entry for entry in inputs_of('obstacle') if entry.name == 'altitude')
        read = entry.reader(message.__msgtype__, 'enu', {})
    found = read(message)
    assert (found.altitude, found.stamp_ns) == (7.25, 100_000_000_005)
    assert np.isnan(found.variance)
    assert reason(read, make(0.0)) == reason(read, make(-1.0)) == 'no_bottom'
    assert reason(read, make(np.nan)) == 'nan' and reason(read, make(2e4)) == 'out_of_range'
    if make is dave:  # one that tracks the water knows no altitude
        assert reason(read, dave(30.0, 'DVL_TARGET_WATER_MASS')) == 'no_bottom'


# -- Transforms as messages: TFMessage of a recording, TransformStamped where tf2 is missing --


def message(parent='base_link', child='sonar', rpy=(0.1, -0.4, 2.9)):
    pose = Pose(np.array([1.0, 0.5, -0.2]), geometry.rotation(*rpy))
    return write_transforms(StaticTransforms(poses={child: (parent, pose)}), ros_message)


def test_what_is_written_reads_back():
    rng = np.random.default_rng(0)
    for _ in range(20):
        rpy = rng.uniform(-np.pi, np.pi, size=3) * [1.0, 0.5, 1.0]
        parent, pose = read_transforms(marine.sent(message(rpy=rpy))).poses['sonar']
        assert parent == 'base_link' and pose.position.tolist() == [1.0, 0.5, -0.2]
        assert pose.R == pytest.approx(geometry.rotation(*rpy), abs=1e-12)
    # One alone is read, and none refused.
    (item,) = message(parent='/base_link', child='/sonar').transforms
    assert list(read_transforms(item).poses) == ['sonar']
    assert read_transforms(item).poses['sonar'][0] == 'base_link'
    assert reason(read_transforms, write_transforms(StaticTransforms(poses={}), ros_message))


def test_what_cannot_be_used_is_refused_with_its_reason():
    turn, way = 'transform__rotation__', 'transform__translation__'
    for name, value, code in (
        (f'{way}x', math.nan, 'nan'), (f'{turn}w', math.inf, 'nan'),
        (f'{turn}w', 7.0, 'out_of_range'), (f'{turn}x', 1e300, 'out_of_range'),
        (f'{way}y', 1e9, 'out_of_range'), ('header__frame_id', '', 'no_frame'),
        ('child_frame_id', 'base_link', 'no_frame'), ('child_frame_id', 'f' * 1001, 'too_large'),
        ('header__frame_id', 'f' * 1001, 'too_large'),
    ):  # fmt: skip
        made = message()
        marine.put(made.transforms[0], **{name: value})
        assert reason(read_transforms, made) == code
