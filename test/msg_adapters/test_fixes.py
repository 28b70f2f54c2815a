# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

import math

from helpers.marine import driver_message
from helpers.refusals import reason
from hypothesis import given, HealthCheck, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from msg_adapters.fixes import (
    doubt_fix,
    doubt_geodetic,
    doubt_height,
    read_fix,
    read_geodetic,
    read_start,
    read_vessel_fix,
    write_fix,
    write_geo,
    write_geodetic,
    write_start,
)
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Fix, GeodeticFix, Rejection, Start, VesselFix
from sonar_imm_tools.recordings.messages import ros_message

POSE = 'geometry_msgs/msg/PoseWithCovarianceStamped'


WHOLE = [[4.0, 0.1, 0.2], [0.1, 9.0, 0.3], [0.2, 0.3, 0.25]]
ONLY_Z = np.full((3, 3), np.nan)
ONLY_Z[2, 2] = 0.25


def header(sec=100, nanosec=5, frame_id='map'):
    stamp = ros_message('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)
    return ros_message('std_msgs/msg/Header', stamp=stamp, frame_id=frame_id)


def pose(covariance=None, x=1.0, y=2.0, z=3.0, **head):
    message = ros_message(POSE, header=header(**head))
    message.pose.pose.position.x, message.pose.pose.position.y = x, y
    message.pose.pose.position.z = z
    if covariance is not None:
        message.pose.covariance[:] = np.ravel(covariance)
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
    point = ros_message(
        'geometry_msgs/msg/PointStamped',
        header=header(),
        point=ros_message('geometry_msgs/msg/Point', x=7.0, y=8.0),
    )
    assert read_fix(point).position.tolist() == [7.0, 8.0, 0.0]
    assert read_fix(point).covariance is None and doubt_fix(point) is None


@pytest.mark.parametrize(
    'covariance, doubt',
    [
        (block(0.0, 0.0, 0.0, 0.0), 'zero_covariance'),
        (block(-1.0, 0.0, 0.0, 4.0), None),
        (block(4.0, 0.0, 0.0, -1.0), None),
        (-np.eye(6), None),
        (block(math.nan, 0.0, 0.0, 1.0), None),
        (block(1.0, math.inf, math.inf, 1.0), None),
    ],
)
def test_what_is_no_covariance_is_unknown_and_the_position_used(covariance, doubt):
    """As in navigation and in NavSatFix; only zero is doubted."""
    fix = read_fix(pose(covariance))
    assert fix.covariance is None and fix.position[0] == 1.0
    assert doubt_fix(pose(covariance)) == doubt


def test_what_is_not_used_may_be_nonsense():
    covariance = block(4.0, 0.0, 0.0, 9.0)
    covariance[2:, 2:] = np.nan
    fix = read_fix(pose(covariance, z=math.nan))
    assert fix.covariance[:2, :2].tolist() == [[4.0, 0.0], [0.0, 9.0]]
    assert np.isnan(fix.covariance[2]).all() and fix.position[2] == 0.0


def spatial(variance, *across, z=3.0, flat=((4.0, 0.0), (0.0, 9.0))):
    covariance = np.zeros((6, 6))
    covariance[:2, :2], covariance[2, 2] = flat, variance
    for axis, value in enumerate(across):
        covariance[2, axis] = covariance[axis, 2] = value
    return pose(covariance, z=z)


def test_the_height_is_read_where_its_variance_is_stated():
    fix = read_fix(spatial(0.25, 0.5, -0.2))
    assert fix.covariance.tolist() == [[4.0, 0.0, 0.5], [0.0, 9.0, -0.2], [0.5, -0.2, 0.25]]
    turned = read_fix(spatial(0.25, 0.5, -0.2), world_frame='ned')
    assert turned.covariance.tolist() == [[9.0, 0.0, 0.2], [0.0, 4.0, -0.5], [0.2, -0.5, 0.25]]
    assert doubt_height(spatial(0.25, 0.5, -0.2), fix) is None
    alone = read_fix(spatial(0.25, flat=-np.eye(2)))
    assert np.isnan(alone.covariance[:2]).all() and alone.covariance[2, 2] == 0.25


@pytest.mark.parametrize(
    'message',
    [
        spatial(0.0),
        spatial(-1.0),
        spatial(math.nan),
        spatial(math.inf),
        spatial(1e-300),
        spatial(1e6),
        spatial(0.25, math.nan),
        spatial(0.25, 1.0, 0.0),  # as good as singular with x: the correlation is 1
        spatial(0.25, 0.9, 0.9),
        spatial(0.25, 1e300, -1e300),
        spatial(0.25, z=math.nan),
        spatial(0.25, z=1e9),
    ],
)
def test_a_height_that_is_not_stated_or_cannot_be_true_is_left_out_alone(message):
    fix = read_fix(message)
    assert fix.covariance[:2, :2].tolist() == [[4.0, 0.0], [0.0, 9.0]]
    assert np.isnan(fix.covariance[2]).all() and np.isnan(fix.covariance[:, 2]).all()
    variance, z = message.pose.covariance[14], message.pose.pose.position.z
    doubted = 1e-12 <= variance < 1e6 and math.isfinite(z)
    assert doubt_height(message, fix) == ('bad_height' if doubted else None)


@pytest.mark.parametrize(
    'message, code',
    [
        (pose(block(4.0, 1.0, 2.0, 9.0)), 'bad_covariance'),
        (pose(block(1.0, 2.0, 2.0, 1.0)), 'bad_covariance'),
        (pose(block(1e-300, 0.0, 0.0, 1e-300)), 'out_of_range'),
        (pose(block(1e300, 0.0, 0.0, 1e308)), 'not_measured'),
        (pose(x=math.nan), 'nan'),
        (pose(y=math.inf), 'nan'),
        (pose(x=1e9), 'out_of_range'),
        (pose(sec=0, nanosec=0), 'bad_stamp'),
        (pose(sec=-5), 'bad_stamp'),
        (pose(nanosec=2**32 - 1), 'bad_stamp'),
        (pose(frame_id='odom_ned'), 'frame_ned'),
    ],
)
def test_what_cannot_be_used_is_refused_with_its_reason(message, code):
    assert reason(read_fix, message) == code


def test_a_covariance_of_another_size_is_refused():
    message = pose()
    message.pose.covariance = np.zeros(35)
    assert reason(read_fix, message) == 'bad_shape'


@pytest.mark.parametrize('covariance', [None, [[4.0, 0.1], [0.1, 9.0]], WHOLE, ONLY_Z])
def test_writing_and_reading_gives_the_same_fix(covariance):
    fix = Fix(
        stamp_ns=1700000000123456789, position=(1 / 3, -2e5, 0.5), covariance=covariance,
        frame_id='map',
    )  # fmt: skip
    message = write_fix(fix, ros_message)
    again = read_fix(message)
    assert again.stamp_ns == fix.stamp_ns and again.frame_id == 'map'
    assert (again.position == fix.position).all() and doubt_fix(message) is None
    assert (
        (again.covariance is None)
        if covariance is None
        else again.covariance.tobytes() == fix.covariance.tobytes()
    )


NASTY = (
    1.0, 2.0, 4.0, 0.5, 0.0, -0.0, -1.0, 1e-300, 1e-12, 1e9, 1e300, 1e-160, math.nan, math.inf,
    -math.inf, 1 / 3, 100.0,
)  # fmt: skip


@given(
    values=st.binary(min_size=10, max_size=10),
    symmetric=st.booleans(),
    sec=st.sampled_from((1, 0, -1, 1700000000, 2**31 - 1, -(2**31))),
    nanosec=st.sampled_from((0, 5, 999999999, 10**9, 2**32 - 1)),
    frame_id=st.sampled_from(['map', '', 'x_ned']),
    world=st.sampled_from(['enu', 'ned']),
)
@settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
def test_hostile_fixes_are_refused_or_finite(values, symmetric, sec, nanosec, frame_id, world):
    x, y, z, a, b, c, d, *of_z = (NASTY[value % len(NASTY)] for value in values)
    covariance = block(a, b, b if symmetric else c, d)
    covariance[2, :3] = of_z
    if symmetric:
        covariance[:2, 2] = covariance[2, :2]
    message = pose(covariance, x, y, z, sec=sec, nanosec=nanosec, frame_id=frame_id)
    try:
        fix = read_fix(message, world_frame=world)
    except Rejection as rejection:
        assert rejection.reason and rejection.sentence
        return
    assert np.isfinite(fix.position).all() and fix.stamp_ns > 0
    if fix.covariance is not None:
        flat, z = fix.covariance[:2, :2], fix.covariance[2, 2]
        assert np.isnan(z) or 1e-12 <= z < 1e6
        if np.isfinite(z) and np.isnan(flat).all():
            return
        assert np.isfinite(flat).all()
        assert (np.linalg.eigvalsh(flat) >= 0.99e-12).all()
        assert flat.max() <= 1e16


# -- Latitude and longitude from messages, and estimates as NavSatFix --


STAMP = 1_700_000_000_123_456_789


def navsat(**changes):
    values = {
        'stamp_ns': STAMP,
        'latitude': 59.0,
        'longitude': 10.0,
        'height': 12.0,
        'covariance': np.array([[4.0, 0.5, 0.1], [0.5, 9.0, 0.2], [0.1, 0.2, 16.0]]),
        'frame_id': 'gps',
    }
    message = write_geodetic(GeodeticFix(**values), ros_message)
    for path, value in changes.items():
        *way, last = path.split('__')
        target = message
        for step in way:
            target = getattr(target, step)
        object.__setattr__(target, last, value)
    return message


def test_a_navsatfix_is_read_as_it_was_written():
    fix = read_geodetic(navsat())
    assert (fix.stamp_ns, fix.latitude, fix.longitude, fix.height) == (STAMP, 59.0, 10.0, 12.0)
    assert fix.covariance[0].tolist() == [4.0, 0.5, 0.1] and fix.frame_id == 'gps'
    assert isinstance(read_vessel_fix(navsat()), VesselFix)


def test_no_fix_is_named_and_left_out():
    assert reason(read_geodetic, navsat(status__status=-1)) == 'no_fix'
    for status in (0, 1, 2):
        assert read_geodetic(navsat(status__status=status)).latitude == 59.0


@pytest.mark.parametrize(
    'kind, expected',
    [
        (0, None),
        (1, [4.0, 0.5, 0.1]),
        (2, [4.0, 0.0, 0.0]),
        (3, [4.0, 0.5, 0.1]),
    ],
)
def test_the_type_of_a_covariance_decides(kind, expected):
    covariance = read_geodetic(navsat(position_covariance_type=kind)).covariance
    assert expected == (None if covariance is None else covariance[0].tolist())


@pytest.mark.parametrize('place', [(0.0, 0.0), (1e-7, -1e-7)])
@pytest.mark.parametrize('read', [read_geodetic, read_vessel_fix])
def test_latitude_0_longitude_0_is_no_fix(place, read):
    message = navsat(latitude=place[0], longitude=place[1])
    assert reason(read, message) == 'no_fix'


def test_a_covariance_of_nan_is_unknown_and_so_is_a_height():
    assert np.isnan(read_geodetic(navsat(altitude=float('nan'))).height)
    assert read_geodetic(navsat(position_covariance=np.full(9, np.nan))).covariance is None
    flat = np.diag([1.0, 2.0, np.nan]).ravel()
    covariance = read_geodetic(navsat(position_covariance=flat)).covariance
    assert np.diag(covariance)[:2].tolist() == [1.0, 2.0] and covariance[2, 2] > 1e5


def test_a_covariance_that_was_not_filled_in_is_unknown_and_doubted():
    zero = navsat(position_covariance=np.zeros(9))
    assert read_geodetic(zero).covariance is None
    assert doubt_geodetic(zero) == 'zero_covariance' and doubt_geodetic(navsat()) is None
    assert doubt_geodetic(navsat(position_covariance_type=0)) is None
    flat = np.diag([1.0, 1.0, 0.0]).ravel()
    assert read_geodetic(navsat(position_covariance=flat)).covariance[2, 2] > 1e5


@pytest.mark.parametrize(
    'changes, expected',
    [
        ({'latitude': float('nan')}, 'nan'),
        ({'latitude': 91.0}, 'out_of_range'),
        ({'longitude': 361.0}, 'out_of_range'),
        ({'altitude': 1e9}, 'out_of_range'),
        ({'position_covariance': np.diag([1.0, 1e-20, 1.0]).ravel()}, 'bad_covariance'),
        ({'position_covariance': np.ones(9)}, 'bad_covariance'),
        ({'position_covariance': np.ones(4)}, 'bad_shape'),
    ],
)
def test_what_is_no_position_is_refused(changes, expected):
    assert reason(read_geodetic, navsat(**changes)) == expected


@pytest.mark.parametrize(
    'name, way',
    [
        ('GeoPointStamped', 'position'),
        ('GeoPoseStamped', 'pose__position'),
        ('GeoPoseWithCovarianceStamped', 'pose__pose__position'),
    ],
)
def test_geographic_messages_are_read_by_their_fields(name, way):
    message = driver_message(
        f'geographic_msgs/msg/{name}',
        header__stamp__sec=7,
        **{f'{way}__latitude': -33.0, f'{way}__longitude': 151.0, f'{way}__altitude': -4.0},
    )
    fix = read_geodetic(message)
    assert (fix.latitude, fix.longitude, fix.height) == (-33.0, 151.0, -4.0)
    assert fix.covariance is None
    if 'Covariance' in name:
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
    origin = Origin(59.0, 10.0, 5.0)
    message = write_geo(estimate(('px', 'py', 'pz', 'vx', 'vy', 'vz')), 0, origin, ros_message)
    fix = read_geodetic(message)
    back = origin.local(fix.latitude, fix.longitude, fix.height)
    assert back == pytest.approx([1000.0, 2000.0, 3000.0], abs=1e-6)
    assert fix.frame_id == 'diver_4' and fix.stamp_ns == STAMP
    turn = origin.turn(fix.latitude, fix.longitude)
    assert turn @ fix.covariance @ turn.T == pytest.approx(np.eye(3) + 0.1, abs=1e-9)


def test_without_depth_the_altitude_is_not_a_number():
    message = write_geo(estimate(), 0, Origin(59.0, 10.0), ros_message)
    place = Origin(59.0, 10.0).at_height(np.array([1000.0, 2000.0]), estimate().xyz[0, 2])
    assert [message.latitude, message.longitude] == pytest.approx(place[:2], abs=1e-12)
    assert np.isnan(message.altitude)
    assert message.position_covariance[8] > 1e5 and message.position_covariance_type == 3
    assert message.position_covariance[0] == pytest.approx(1.1, abs=1e-3)


# -- Starts of tracks: what is read, and what is refused with a sentence --


def start_message(x=1.0, y=2.0, z=3.0, covariance=None, **values):
    start = Start(stamp_ns=STAMP, position=[1.0, 2.0, 3.0], covariance=np.eye(2), frame_id='map')
    message = write_start(start, ros_message)
    place = message.pose.pose.position
    place.x, place.y, place.z = x, y, z
    whole = np.zeros((6, 6))
    whole[:2, :2] = [[4.0, 1.0], [1.0, 9.0]] if covariance is None else covariance
    message.pose.covariance = whole.ravel()
    for name, value in values.items():
        setattr(message.header, name, value)
    return message


def test_a_start_is_read_and_written():
    start = read_start(start_message())
    assert start.stamp_ns == STAMP and start.frame_id == 'map'
    assert start.position.tolist() == [1.0, 2.0, 3.0]
    assert start.covariance[:2, :2].tolist() == [[4.0, 1.0], [1.0, 9.0]]
    again = read_start(write_start(start, ros_message))
    assert (again.position == start.position).all()
    assert np.isnan(start.covariance[2]).all() and again.key() == start.key()


def test_the_height_of_a_start_is_read_where_it_is_stated():
    covariance = np.array([[4.0, 1.0, 0.2], [1.0, 9.0, 0.3], [0.2, 0.3, 0.25]])
    start = Start(stamp_ns=STAMP, position=[1.0, 2.0, 3.0], covariance=covariance, frame_id='map')
    again = read_start(write_start(start, ros_message))
    assert again.covariance.tolist() == covariance.tolist() and again.key() == start.key()


def test_north_east_down_is_turned():
    start = read_start(start_message(), world_frame='ned')
    assert start.position.tolist() == [2.0, 1.0, -3.0]
    assert start.covariance[:2, :2].tolist() == [[9.0, 1.0], [1.0, 4.0]]


@pytest.mark.parametrize(
    'given, code',
    [
        ({'x': math.nan}, 'nan'),
        ({'y': math.inf}, 'nan'),
        ({'x': 2e8}, 'out_of_range'),
        ({'covariance': np.zeros((2, 2))}, 'no_covariance'),
        ({'covariance': [[-1.0, 0.0], [0.0, -1.0]]}, 'no_covariance'),
        ({'covariance': [[math.nan, 0.0], [0.0, 1.0]]}, 'no_covariance'),
        ({'covariance': [[1.0, 2.0], [2.0, 1.0]]}, 'bad_covariance'),
        ({'covariance': [[1.0, 0.5], [0.0, 1.0]]}, 'bad_covariance'),
        ({'covariance': np.eye(2) * 1e-20}, 'out_of_range'),
        ({'covariance': np.eye(2) * 1e20}, 'not_measured'),
        ({'frame_id': 'map_ned'}, 'frame_ned'),
        ({'stamp': ros_message('builtin_interfaces/msg/Time')}, 'bad_stamp'),
    ],
)
def test_a_start_that_cannot_be_used_is_refused(given, code):
    assert reason(read_start, start_message(**given)) == code
