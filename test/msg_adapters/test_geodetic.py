# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Latitude and longitude from messages, and estimates as NavSatFix."""

from helpers.marine import driver_message
import numpy as np
import pytest

from msg_adapters.fixes import (
    doubt_geodetic,
    read_geodetic,
    read_vessel_fix,
    write_geo,
    write_geodetic,
)
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import GeodeticFix, Rejection, VesselFix
from sonar_imm_tools.recordings.messages import ros_message

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


def reason(message, read=read_geodetic):
    with pytest.raises(Rejection) as caught:
        read(message)
    return caught.value.reason


def test_a_navsatfix_is_read_as_it_was_written():
    fix = read_geodetic(navsat())
    assert (fix.stamp_ns, fix.latitude, fix.longitude, fix.height) == (STAMP, 59.0, 10.0, 12.0)
    assert fix.covariance[0].tolist() == [4.0, 0.5, 0.1] and fix.frame_id == 'gps'
    assert isinstance(read_vessel_fix(navsat()), VesselFix)


def test_no_fix_is_named_and_left_out():
    assert reason(navsat(status__status=-1)) == 'no_fix'
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
        ({'position_covariance': np.full(9, np.nan)}, 'nan'),
        ({'position_covariance': np.diag([1.0, 1.0, 1e-20]).ravel()}, 'out_of_range'),
        ({'position_covariance': np.ones(9)}, 'out_of_range'),
        ({'position_covariance': np.ones(4)}, 'bad_shape'),
    ],
)
def test_what_is_no_position_is_refused(changes, expected):
    assert reason(navsat(**changes)) == expected


def test_height_may_be_unknown():
    assert np.isnan(read_geodetic(navsat(altitude=float('nan'))).height)


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
        stamp_ns=STAMP,
        frame_id='map',
        xyz=state[:, :3].astype(np.float32),
        state_names=names,
        state=state,
        covariance=covariance,
        extras={'track_id': np.array([4], np.uint32)},
    )


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
    assert np.isnan(message.altitude)
    assert message.position_covariance[8] > 1e5 and message.position_covariance_type == 3
    assert message.position_covariance[0] == pytest.approx(1.1, abs=1e-3)
