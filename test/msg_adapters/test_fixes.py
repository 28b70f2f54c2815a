# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

import math

from attrs import asdict
from helpers import marine
from helpers.marine import driver_message
from helpers.refusals import reason
import numpy as np
from numpy.testing import assert_equal
import pytest

from msg_adapters import fixes as adapters
from msg_adapters.fixes import doubt_geodetic, read_fix, read_geodetic, read_start, write_start
from msg_adapters.navigation import read_heading, read_vessel_pose, write_heading
from sonar_imm import measurements
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.acoustics.geometry import flip_quaternion, rotation_of_quaternion
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Fix, GeodeticFix, NOBODY, RelativeFix, Start
from sonar_imm_tools.recordings.messages import ros_message

STAMP, SEVENTH = 1_700_000_000_123_456_789, 7_000_000_000
WHOLE = [[4.0, 0.1, 0.2], [0.1, 9.0, 0.3], [0.2, 0.3, 0.25]]
ONLY_Z = np.full((3, 3), np.nan)
ONLY_Z[2, 2] = 0.25


def pose(covariance=None, x=1.0, y=2.0, z=3.0, **head):
    message = ros_message('geometry_msgs/msg/PoseWithCovarianceStamped')
    values = {'sec': 100, 'nanosec': 5, 'frame_id': 'map', **head}
    message.header.frame_id, stamp = values['frame_id'], message.header.stamp
    stamp.sec, stamp.nanosec = values['sec'], values['nanosec']
    place = message.pose.pose.position
    place.x, place.y, place.z = x, y, z
    if covariance is not None:
        message.pose.covariance = np.ravel(np.asarray(covariance, float))
    return message


def block(a, b, c, d):
    covariance = np.zeros((6, 6))
    covariance[:2, :2] = [[a, b], [c, d]]
    return covariance


def test_a_pose_and_a_point_are_read():
    fix = read_fix(pose(block(4.0, 0.5, 0.5, 9.0)))
    assert fix.stamp_ns == 100_000_000_005 and fix.frame_id == 'map'
    assert fix.position.tolist() == [1.0, 2.0, 3.0]
    assert fix.covariance[:2, :2].tolist() == [[4.0, 0.5], [0.5, 9.0]]
    assert np.isnan(fix.covariance[2]).all()
    at = {'header__stamp__sec': 7, 'point__x': 7.0, 'point__y': 8.0}
    point = driver_message('geometry_msgs/msg/PointStamped', **at)
    assert read_fix(point).position.tolist() == [7.0, 8.0, 0.0]
    assert read_fix(point).covariance is None and adapters.doubt_fix(point) is None
    # What is not used may be nonsense.
    covariance = block(4.0, 0.0, 0.0, 9.0)
    covariance[2:, 2:] = np.nan
    fix = read_fix(pose(covariance, z=math.nan))
    assert fix.covariance[:2, :2].tolist() == [[4.0, 0.0], [0.0, 9.0]]
    assert np.isnan(fix.covariance[2]).all() and fix.position[2] == 0.0


def test_what_is_no_covariance_is_unknown_and_the_position_used():
    """As in navigation and in NavSatFix; only zero is doubted."""
    nan, inf = math.nan, math.inf
    for stated in ((0, 0, 0, 0), (-1, 0, 0, 4), (4, 0, 0, -1), (nan, 0, 0, 1), (1, inf, inf, 1)):
        message = pose(block(*stated))
        fix = read_fix(message)
        assert fix.covariance is None and fix.position[0] == 1.0
        assert adapters.doubt_fix(message) == (None if any(stated) else 'zero_covariance')


def spatial(variance, *across, z=3.0, flat=((4.0, 0.0), (0.0, 9.0))):
    covariance = np.zeros((6, 6))
    covariance[:2, :2], covariance[2, 2] = flat, variance
    for axis, value in enumerate(across):
        covariance[2, axis] = covariance[axis, 2] = value
    return pose(covariance, z=z)


def test_the_height_is_read_where_its_variance_is_stated():
    message = spatial(0.25, 0.5, -0.2)
    fix = read_fix(message)
    assert fix.covariance.tolist() == [[4.0, 0.0, 0.5], [0.0, 9.0, -0.2], [0.5, -0.2, 0.25]]
    turned = read_fix(message, world_frame='ned')
    assert turned.covariance.tolist() == [[9.0, 0.0, 0.2], [0.0, 4.0, -0.5], [0.2, -0.5, 0.25]]
    assert adapters.doubt_height(message, fix) is None
    alone = read_fix(spatial(0.25, flat=-np.eye(2)))
    assert np.isnan(alone.covariance[:2]).all() and alone.covariance[2, 2] == 0.25


LEFT_OUT = [
    *map(spatial, (0.0, -1.0, math.nan, math.inf, 1e-300, 1e6)),
    spatial(0.25, math.nan),
    spatial(0.25, 1.0, 0.0),  # as good as singular with x: the correlation is 1
    spatial(0.25, 0.9, 0.9),
    spatial(0.25, 1e300, -1e300),
    spatial(0.25, z=math.nan),
    spatial(0.25, z=1e9),
]


def test_a_height_that_is_not_stated_or_cannot_be_true_is_left_out_alone():
    for message in LEFT_OUT:
        fix = read_fix(message)
        assert fix.covariance[:2, :2].tolist() == [[4.0, 0.0], [0.0, 9.0]]
        assert np.isnan(fix.covariance[2]).all() and np.isnan(fix.covariance[:, 2]).all()
        variance, z = message.pose.covariance[14], message.pose.pose.position.z
        doubted = 1e-12 <= variance < 1e6 and math.isfinite(z)
        assert adapters.doubt_height(message, fix) == ('bad_height' if doubted else None)


def test_what_cannot_be_used_is_refused_with_its_reason():
    for code, messages in (
        ('bad_covariance', [pose(block(4.0, 1.0, 2.0, 9.0)), pose(block(1.0, 2.0, 2.0, 1.0))]),
        ('out_of_range', [pose(block(1e-300, 0.0, 0.0, 1e-300)), pose(x=1e9)]),
        ('not_measured', [pose(block(1e300, 0.0, 0.0, 1e308))]),
        ('bad_shape', [pose(np.zeros(35))]),
        ('nan', [pose(x=math.nan), pose(y=math.inf)]),
        ('bad_stamp', [pose(sec=0, nanosec=0), pose(sec=-5), pose(nanosec=2**32 - 1)]),
        ('frame_ned', [pose(frame_id='odom_ned')]),
    ):
        assert [reason(read_fix, message) for message in messages] == [code] * len(messages)


@pytest.mark.parametrize('covariance', [None, [[4.0, 0.1], [0.1, 9.0]], WHOLE, ONLY_Z])
def test_writing_and_reading_gives_the_same_fix(covariance):
    place = {'position': (1 / 3, -2e5, 0.5), 'frame_id': 'map'}
    fix = Fix(stamp_ns=STAMP, covariance=covariance, **place)
    message = adapters.write_fix(fix, ros_message)
    assert_equal(asdict(read_fix(message)), asdict(fix))
    assert adapters.doubt_fix(message) is None


# -- Latitude and longitude from messages, and estimates as NavSatFix --


def navsat(**changes):
    fix = GeodeticFix(
        stamp_ns=STAMP, latitude=59.0, longitude=10.0, height=12.0, frame_id='gps',
        covariance=np.array([[4.0, 0.5, 0.1], [0.5, 9.0, 0.2], [0.1, 0.2, 16.0]]),
    )  # fmt: skip
    return marine.put(adapters.write_geodetic(fix, ros_message), **changes)


def test_a_navsatfix_is_read_as_it_was_written_and_left_out_without_a_fix():
    fix = read_geodetic(navsat())
    assert (fix.stamp_ns, fix.latitude, fix.longitude, fix.height) == (STAMP, 59.0, 10.0, 12.0)
    assert fix.frame_id == 'gps'
    assert isinstance(adapters.read_vessel_fix(navsat()), measurements.VesselFix)
    assert reason(read_geodetic, navsat(status__status=-1)) == 'no_fix'
    for status in (0, 1, 2):
        assert read_geodetic(navsat(status__status=status)).latitude == 59.0
    # The type of a covariance decides.
    kinds = [None, [4.0, 0.5, 0.1], [4.0, 0.0, 0.0], [4.0, 0.5, 0.1]]
    for kind, expected in enumerate(kinds):
        covariance = read_geodetic(navsat(position_covariance_type=kind)).covariance
        assert expected == (None if covariance is None else covariance[0].tolist())


@pytest.mark.parametrize('read', [read_geodetic, adapters.read_vessel_fix])
def test_latitude_0_longitude_0_is_no_fix(read):
    for latitude, longitude in ((0.0, 0.0), (1e-7, -1e-7)):
        assert reason(read, navsat(latitude=latitude, longitude=longitude)) == 'no_fix'


def test_a_covariance_that_says_nothing_is_unknown_and_so_is_a_height():
    assert np.isnan(read_geodetic(navsat(altitude=float('nan'))).height)
    assert read_geodetic(navsat(position_covariance=np.full(9, np.nan))).covariance is None
    for of_z in (np.nan, 0.0):
        flat = np.diag([1.0, 2.0, of_z]).ravel()
        covariance = read_geodetic(navsat(position_covariance=flat)).covariance
        assert np.diag(covariance)[:2].tolist() == [1.0, 2.0] and covariance[2, 2] > 1e5
    zero = navsat(position_covariance=np.zeros(9))
    assert read_geodetic(zero).covariance is None
    assert doubt_geodetic(zero) == 'zero_covariance' and doubt_geodetic(navsat()) is None
    assert doubt_geodetic(navsat(position_covariance_type=0)) is None


def test_what_is_no_position_is_refused():
    for changes, expected in (
        ({'latitude': float('nan')}, 'nan'), ({'latitude': 91.0}, 'out_of_range'),
        ({'longitude': 361.0}, 'out_of_range'), ({'altitude': 1e9}, 'out_of_range'),
        ({'position_covariance': np.diag([1.0, 1e-20, 1.0]).ravel()}, 'bad_covariance'),
        ({'position_covariance': np.ones(9)}, 'bad_covariance'),
        ({'position_covariance': np.ones(4)}, 'bad_shape'),
    ):  # fmt: skip
        assert reason(read_geodetic, navsat(**changes)) == expected


def test_geographic_messages_are_read_by_their_fields():
    for name, way in (
        ('GeoPointStamped', 'position'), ('GeoPoseStamped', 'pose__position'),
        ('GeoPoseWithCovarianceStamped', 'pose__pose__position'),
    ):  # fmt: skip
        place = {f'{way}__latitude': -33.0, f'{way}__longitude': 151.0, f'{way}__altitude': -4.0}
        message = driver_message(f'geographic_msgs/msg/{name}', header__stamp__sec=7, **place)
        fix = read_geodetic(message)
        assert (fix.latitude, fix.longitude, fix.height) == (-33.0, 151.0, -4.0)
        assert fix.covariance is None
    message.pose.covariance[:15] = np.diag(np.arange(1.0, 7.0)).ravel()[:15]
    assert np.diag(read_geodetic(message).covariance).tolist() == [1.0, 2.0, 3.0]


def estimate(names=('px', 'py', 'vx', 'vy')):
    n = len(names)
    state = np.arange(1.0, n + 1.0)[None] * 1000.0
    covariance = (np.eye(n) + 0.1)[None]
    return Estimate(
        stamp_ns=STAMP, frame_id='map', xyz=state[:, :3].astype(np.float32), state_names=names,
        state=state, covariance=covariance, extras={'track_id': np.array([4], np.uint32)},
    )  # fmt: skip


def test_an_estimate_is_written_as_navsatfix_and_read_back():
    origin, names = Origin(59.0, 10.0, 5.0), ('px', 'py', 'pz', 'vx', 'vy', 'vz')
    fix = read_geodetic(adapters.write_geo(estimate(names), 0, origin, ros_message))
    back = origin.local(fix.latitude, fix.longitude, fix.height)
    assert back == pytest.approx([1000.0, 2000.0, 3000.0], abs=1e-6)
    assert fix.frame_id == 'diver_4' and fix.stamp_ns == STAMP
    turn = origin.turn(fix.latitude, fix.longitude)
    assert turn @ fix.covariance @ turn.T == pytest.approx(np.eye(3) + 0.1, abs=1e-9)
    # Without depth the altitude is not a number.
    message = adapters.write_geo(estimate(), 0, Origin(59.0, 10.0), ros_message)
    place = Origin(59.0, 10.0).at_height(np.array([1000.0, 2000.0]), estimate().xyz[0, 2])
    assert [message.latitude, message.longitude] == pytest.approx(place[:2], abs=1e-12)
    assert np.isnan(message.altitude)
    assert message.position_covariance[8] > 1e5 and message.position_covariance_type == 3
    assert message.position_covariance[0] == pytest.approx(1.1, abs=1e-3)


# -- Starts of tracks: what is read, and what is refused with a sentence --


FLAT = [[4.0, 1.0], [1.0, 9.0]]


def start(covariance):
    place = {'position': [1.0, 2.0, 3.0], 'frame_id': 'map'}
    return Start(stamp_ns=STAMP, covariance=np.array(covariance), **place)


def start_message(covariance=FLAT, **values):
    whole = np.zeros((6, 6))
    whole[:2, :2] = covariance
    message = marine.put(write_start(start(np.eye(2)), ros_message), **values)
    message.pose.covariance = whole.ravel()
    return message


def test_a_start_is_read_and_written_also_its_height_and_turned():
    made = read_start(start_message())
    assert made.stamp_ns == STAMP and made.frame_id == 'map'
    assert made.position.tolist() == [1.0, 2.0, 3.0]
    assert made.covariance[:2, :2].tolist() == FLAT and np.isnan(made.covariance[2]).all()
    for item in (made, start(WHOLE)):
        assert_equal(asdict(read_start(write_start(item, ros_message))), asdict(item))
    made = read_start(start_message(), world_frame='ned')
    assert made.position.tolist() == [2.0, 1.0, -3.0]
    assert made.covariance[:2, :2].tolist() == [[9.0, 1.0], [1.0, 4.0]]


X, Y = 'pose__pose__position__x', 'pose__pose__position__y'
BAD_STARTS = [
    ('nan', X, [math.nan]), ('nan', Y, [math.inf]), ('out_of_range', X, [2e8]),
    ('no_covariance', 'covariance', [np.zeros((2, 2)), -np.eye(2), [[math.nan, 0.0], [0.0, 1.0]]]),
    ('bad_covariance', 'covariance', [[[1.0, 2.0], [2.0, 1.0]], [[1.0, 0.5], [0.0, 1.0]]]),
    ('out_of_range', 'covariance', [np.eye(2) * 1e-20]),
    ('not_measured', 'covariance', [np.eye(2) * 1e20]),
    ('frame_ned', 'header__frame_id', ['map_ned']),
    ('bad_stamp', 'header__stamp', [ros_message('builtin_interfaces/msg/Time')]),
]  # fmt: skip


def test_a_start_that_cannot_be_used_is_refused():
    for code, name, values in BAD_STARTS:
        for value in values:
            assert reason(read_start, start_message(**{name: value})) == code


# -- positions from transceivers: what each driver means, and what it flags


def modem(**values):
    given = {
        'header__stamp__sec': 7, 'header__frame_id': 'x150', 'src_id': 3, 'includes_range': True,
        'range_dist': 200, 'includes_usbl': True, 'usbl_azimuth': 900, 'usbl_elevation': -300,
    }  # fmt: skip
    return driver_message('seatrac_interfaces/msg/ModemRec', **{**given, **values})


def test_a_modem_gives_range_and_direction_or_its_position():
    read = adapters.read_modem
    fix = read(modem())
    assert (fix.stamp_ns, fix.target_id, fix.frame_id) == (SEVENTH, 3, 'x150')
    # 20 m to starboard, 30 degrees down: port is y.
    assert fix.offset == pytest.approx([0.0, -20.0 * np.cos(np.pi / 6), -10.0], abs=1e-9)
    assert not fix.levelled and fix.covariance is None
    deep = {'includes_usbl': False, 'includes_position': True, 'position_depth': 80}
    fix = read(modem(**deep, position_easting=100, position_northing=-50, depth_local=20))
    assert fix.levelled and fix.offset == pytest.approx([10.0, -5.0, -6.0])
    assert reason(read, modem(position_flt_error=True)) == 'flagged_invalid'
    for fields in ({'includes_usbl': False}, {'includes_range': False}, deep):
        assert reason(read, modem(**fields)) == 'no_position'


def usbl(**values):
    given = {'header__stamp__sec': 9, 'current_time': 102.0, 'measurement_time': 100.0}
    given |= {'remote_address': 5, 'accuracy': 0.5}
    return driver_message('acomms_msgs/msg/UsblData', **{**given, **values})


def test_usbl_data_is_as_old_as_the_device_says_and_may_be_in_its_axes():
    read = adapters.read_usbl_data
    fix = read(usbl(enu__x=3.0, enu__y=4.0, enu__z=-5.0, xyz__x=1.0))
    assert fix.stamp_ns == SEVENTH and fix.target_id == 5 and fix.levelled
    assert fix.offset.tolist() == [3.0, 4.0, -5.0]
    assert fix.covariance == pytest.approx(0.25 * np.eye(3))
    for clock in (99.0, 1e6, float('nan')):
        assert read(usbl(xyz__x=1.0, current_time=clock)).stamp_ns == 9_000_000_000
    own = usbl(xyz__x=1.0, xyz__y=2.0, xyz__z=3.0, accuracy=0.0)
    fix = read(own)
    assert not fix.levelled and fix.offset.tolist() == [1.0, 2.0, 3.0] and fix.covariance is None
    assert read(own, relative_axes='frd').offset.tolist() == [1.0, -2.0, -3.0]
    assert reason(read, usbl()) == 'no_position'


def test_a_simulated_beacon_is_forward_starboard_down_and_an_offset_that_cannot_be_none():
    name, place = 'stonefish_ros2/msg/BeaconInfo', zip('xyz', (30.0, 4.0, 5.0))
    values = {f'relative_position__{axis}': value for axis, value in place}
    fix = adapters.read_beacon(driver_message(name, header__stamp__sec=7, beacon_id=8, **values))
    assert fix.offset.tolist() == [30.0, -4.0, -5.0] and fix.target_id == 8
    nothing = driver_message(name, header__stamp__sec=7)
    assert reason(adapters.read_beacon, nothing) == 'no_position'
    for offset, why in (
        ((np.nan, 0, 0), 'nan'), ((2e5, 0, 0), 'out_of_range'), ((1, 2), 'bad_shape')
    ):  # fmt: skip
        assert reason(RelativeFix, stamp_ns=SEVENTH, offset=offset) == why


NED = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
AXES = {'flu': np.eye(3), 'frd': np.diag([1.0, -1.0, -1.0]), 'enu': np.eye(3), 'ned': NED}


@pytest.mark.parametrize('axes', AXES)
def test_axes_are_as_told(axes):
    turn, levelled = AXES[axes], axes in ('enu', 'ned')
    there = ros_message('geometry_msgs/msg/Vector3', x=1.0, y=2.0, z=3.0)
    vector = ros_message('geometry_msgs/msg/Vector3Stamped', vector=there)
    vector.header.stamp.sec = 7
    fix = adapters.read_relative(vector, relative_axes=axes)
    assert fix.offset == pytest.approx(turn @ [1.0, 2.0, 3.0]) and fix.levelled == levelled
    assert fix.target_id == NOBODY and fix.covariance is None
    C = np.array([[4.0, 1.0, 0.5], [1.0, 9.0, 0.2], [0.5, 0.2, 16.0]])
    fix = RelativeFix(stamp_ns=SEVENTH, offset=(1.0, 2.0, 3.0), covariance=C, frame_id='usbl')
    message = adapters.write_relative(fix, ros_message)
    turned = adapters.read_relative(message, relative_axes=axes)
    assert turned.frame_id == 'usbl' and turned.offset == pytest.approx(turn @ [1.0, 2.0, 3.0])
    # The variance along any direction is that along the turned direction.
    assert turned.covariance == pytest.approx(turn @ C @ turn.T)


# -- the vessel ----------------------------------------------------------------------------------


def heading(**values):
    item = measurements.VesselHeading(stamp_ns=SEVENTH, **values)
    return write_heading(item, ros_message)


def test_a_heading_is_read_as_it_was_written_and_turned_from_ned():
    q = np.array([0.1, -0.2, 0.5, 0.8])
    q /= np.linalg.norm(q)
    C = np.diag([1e-4, 2e-4, 3e-4])
    message = heading(orientation=q, covariance=C, frame_id='imu')
    back = read_heading(message)
    assert back.orientation == pytest.approx(q) and back.covariance == pytest.approx(C)
    ned = read_heading(message, world_frame='ned')
    turned = rotation_of_quaternion(flip_quaternion(q))
    assert rotation_of_quaternion(ned.orientation) == pytest.approx(turned)
    assert np.diag(ned.covariance) == pytest.approx([2e-4, 1e-4, 3e-4])


@pytest.mark.filterwarnings('error')
def test_an_imu_without_orientation_is_refused_and_a_quaternion_alone_is_a_heading():
    message = heading(orientation=(0.0, 0.0, 0.0, 1.0))
    assert read_heading(message).covariance is None
    message.orientation_covariance[0] = -1.0
    assert reason(read_heading, message) == 'no_orientation'
    message.orientation_covariance[0] = 0.0
    for w in (0.0, 1e300):
        message.orientation.w = w
        assert reason(read_heading, message) == 'bad_orientation'
    message = ros_message('geometry_msgs/msg/QuaternionStamped')
    message.header.stamp.sec, message.quaternion.w = 7, 1.0
    assert read_heading(message).orientation.tolist() == [0.0, 0.0, 0.0, 1.0]
    # The pose of an odometry is that of the vessel.
    message = ros_message('nav_msgs/msg/Odometry')
    message.header.stamp.sec, message.pose.pose.orientation.w = 7, 1.0
    message.pose.pose.position.x = 4.0
    pose = read_vessel_pose(message)
    assert isinstance(pose, measurements.VesselPose) and pose.position[0] == 4.0
    assert read_vessel_pose(message, world_frame='ned').position.tolist() == [0.0, 4.0, 0.0]
