# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Positions from transceivers: what each driver means, and what it flags."""

from helpers.marine import driver_message
from helpers.refusals import reason
import numpy as np
import pytest

from msg_adapters.fixes import (
    read_beacon,
    read_modem,
    read_relative,
    read_usbl_data,
    write_relative,
)
from msg_adapters.navigation import read_heading, read_vessel_pose, write_heading
from sonar_imm.acoustics.geometry import flip_quaternion, rotation_of_quaternion
from sonar_imm.measurements import NOBODY, Rejection, RelativeFix, VesselHeading, VesselPose
from sonar_imm_tools.recordings.messages import ros_message

STAMP = 7_000_000_000


def modem(**values):
    given = {
        'header__stamp__sec': 7, 'header__frame_id': 'x150', 'src_id': 3, 'includes_range': True,
        'range_dist': 200, 'includes_usbl': True, 'usbl_azimuth': 900, 'usbl_elevation': -300,
    }  # fmt: skip
    return driver_message('seatrac_interfaces/msg/ModemRec', **{**given, **values})


def test_a_modem_gives_range_and_direction_clockwise_and_up():
    fix = read_modem(modem())
    assert (fix.stamp_ns, fix.target_id, fix.frame_id) == (STAMP, 3, 'x150')
    # 20 m to starboard, 30 degrees down: port is y.
    assert fix.offset == pytest.approx([0.0, -20.0 * np.cos(np.pi / 6), -10.0], abs=1e-9)
    assert not fix.levelled and fix.covariance is None


def test_a_modem_without_direction_gives_its_position():
    fix = read_modem(
        modem(
            includes_usbl=False, includes_position=True, position_easting=100,
            position_northing=-50, position_depth=80, depth_local=20,
        )
    )  # fmt: skip
    assert fix.levelled and fix.offset == pytest.approx([10.0, -5.0, -6.0])


def test_what_a_modem_flags_or_does_not_know_is_refused():
    assert reason(read_modem, modem(position_flt_error=True)) == 'flagged_invalid'
    assert reason(read_modem, modem(includes_usbl=False)) == 'no_position'
    assert reason(read_modem, modem(includes_range=False)) == 'no_position'
    depth_only = modem(includes_usbl=False, includes_position=True, position_depth=80)
    assert reason(read_modem, depth_only) == 'no_position'


def usbl(**values):
    given = {'header__stamp__sec': 9, 'current_time': 102.0, 'measurement_time': 100.0}
    return driver_message(
        'acomms_msgs/msg/UsblData', **{**given, 'remote_address': 5, 'accuracy': 0.5, **values}
    )


def test_usbl_data_is_as_old_as_the_device_says():
    fix = read_usbl_data(usbl(enu__x=3.0, enu__y=4.0, enu__z=-5.0, xyz__x=1.0))
    assert fix.stamp_ns == 7_000_000_000 and fix.target_id == 5 and fix.levelled
    assert fix.offset.tolist() == [3.0, 4.0, -5.0]
    assert fix.covariance == pytest.approx(0.25 * np.eye(3))
    for clock in (99.0, 1e6, float('nan')):
        assert read_usbl_data(usbl(xyz__x=1.0, current_time=clock)).stamp_ns == 9_000_000_000


def test_usbl_data_without_attitude_is_in_axes_of_the_device():
    fix = read_usbl_data(usbl(xyz__x=1.0, xyz__y=2.0, xyz__z=3.0, accuracy=0.0))
    assert not fix.levelled and fix.offset.tolist() == [1.0, 2.0, 3.0] and fix.covariance is None
    frd = read_usbl_data(usbl(xyz__x=1.0, xyz__y=2.0, xyz__z=3.0), relative_axes='frd')
    assert frd.offset.tolist() == [1.0, -2.0, -3.0]
    assert reason(read_usbl_data, usbl()) == 'no_position'


def test_a_simulated_beacon_is_forward_starboard_down():
    message = driver_message(
        'stonefish_ros2/msg/BeaconInfo', header__stamp__sec=7, beacon_id=8,
        relative_position__x=30.0, relative_position__y=4.0, relative_position__z=5.0,
    )  # fmt: skip
    fix = read_beacon(message)
    assert fix.offset.tolist() == [30.0, -4.0, -5.0] and fix.target_id == 8
    nothing = driver_message('stonefish_ros2/msg/BeaconInfo', header__stamp__sec=7)
    assert reason(read_beacon, nothing) == 'no_position'


@pytest.mark.parametrize(
    'axes, offset, levelled',
    [
        ('flu', [1.0, 2.0, 3.0], False),
        ('frd', [1.0, -2.0, -3.0], False),
        ('enu', [1.0, 2.0, 3.0], True),
        ('ned', [2.0, 1.0, -3.0], True),
    ],
)
def test_axes_are_as_told(axes, offset, levelled):
    vector = ros_message(
        'geometry_msgs/msg/Vector3Stamped',
        vector=ros_message('geometry_msgs/msg/Vector3', x=1.0, y=2.0, z=3.0),
    )
    vector.header.stamp.sec = 7
    fix = read_relative(vector, relative_axes=axes)
    assert fix.offset.tolist() == offset and fix.levelled == levelled
    assert fix.target_id == NOBODY
    C = np.array([[4.0, 1.0, 0.5], [1.0, 9.0, 0.2], [0.5, 0.2, 16.0]])
    fix = RelativeFix(stamp_ns=STAMP, offset=(1.0, 2.0, 3.0), covariance=C, frame_id='usbl')
    turned = read_relative(write_relative(fix, ros_message), relative_axes=axes)
    assert turned.frame_id == 'usbl' and read_relative(vector).covariance is None
    # The variance along any direction is that along the turned direction.
    to = {
        'flu': np.eye(3),
        'frd': np.diag([1.0, -1.0, -1.0]),
        'enu': np.eye(3),
        'ned': np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
    }[axes]
    assert turned.covariance == pytest.approx(to @ C @ to.T)
    assert turned.offset == pytest.approx(to @ [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    'offset, why', [((np.nan, 0, 0), 'nan'), ((2e5, 0, 0), 'out_of_range'), ((1, 2), 'bad_shape')]
)
def test_an_offset_that_cannot_be_is_refused(offset, why):
    with pytest.raises(Rejection) as caught:
        RelativeFix(stamp_ns=STAMP, offset=offset)
    assert caught.value.reason == why


# -- the vessel ----------------------------------------------------------------------------------


def test_a_heading_is_read_as_it_was_written_and_turned_from_ned():
    q = np.array([0.1, -0.2, 0.5, 0.8])
    q /= np.linalg.norm(q)
    C = np.diag([1e-4, 2e-4, 3e-4])
    heading = VesselHeading(stamp_ns=STAMP, orientation=q, covariance=C, frame_id='imu')
    message = write_heading(heading, ros_message)
    back = read_heading(message)
    assert back.orientation == pytest.approx(q) and back.covariance == pytest.approx(C)
    ned = read_heading(message, world_frame='ned')
    assert rotation_of_quaternion(ned.orientation) == pytest.approx(
        rotation_of_quaternion(flip_quaternion(q))
    )
    assert np.diag(ned.covariance) == pytest.approx([2e-4, 1e-4, 3e-4])


@pytest.mark.filterwarnings('error')
def test_an_imu_without_orientation_is_refused():
    message = write_heading(
        VesselHeading(stamp_ns=STAMP, orientation=(0.0, 0.0, 0.0, 1.0)), ros_message
    )
    assert read_heading(message).covariance is None
    message.orientation_covariance[0] = -1.0
    assert reason(read_heading, message) == 'no_orientation'
    message.orientation_covariance[0] = 0.0
    for w in (0.0, 1e300):
        message.orientation.w = w
        assert reason(read_heading, message) == 'bad_orientation'


def test_a_quaternion_alone_is_a_heading():
    message = ros_message('geometry_msgs/msg/QuaternionStamped')
    message.header.stamp.sec, message.quaternion.w = 7, 1.0
    assert read_heading(message).orientation.tolist() == [0.0, 0.0, 0.0, 1.0]


def test_a_pose_of_the_vessel_is_that_of_an_odometry():
    message = ros_message('nav_msgs/msg/Odometry')
    message.header.stamp.sec, message.pose.pose.orientation.w = 7, 1.0
    message.pose.pose.position.x = 4.0
    pose = read_vessel_pose(message)
    assert isinstance(pose, VesselPose) and pose.position[0] == 4.0
    assert read_vessel_pose(message, world_frame='ned').position.tolist() == [0.0, 4.0, 0.0]
