# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

from types import SimpleNamespace

import numpy as np
import pytest

from msg_adapters.arrivals import read_arrivals, write_arrivals
from msg_adapters.fixes import read_fix, write_fix
from msg_adapters.headers import make_header, stamp_ns, to_enu
from sonar_imm.measurements import Arrivals, Fix, Rejection
from sonar_imm_tools.recordings.messages import ros_message


def fix(frame_id='map'):
    return Fix(
        stamp_ns=5, position=(1.0, 2.0, 3.0), covariance=[[4.0, 0.5], [0.5, 9.0]],
        frame_id=frame_id,
    )  # fmt: skip


def arrivals(**changes):
    return Arrivals(
        **{
            'stamp_ns': 5, 'tx_id': [1], 'rx_id': [2], 'tx': [[1.0, 2.0, 3.0]],
            'rx': [[4.0, 5.0, 6.0]], 'toa': [0.1], 'var_toa': [np.nan], 'bearing': [0.25],
            'var_bearing': [0.01], 'frame_id': 'map_ned', **changes,
        }
    )  # fmt: skip


@pytest.mark.parametrize(
    'stamp',
    [0, 7, 1_000_000_007, 2**31 * 10**9 - 1, 1700000000123456789, -1, -(2**31) * 10**9],
)
def test_stamps_round_trip_exactly(stamp):
    header = make_header(stamp, 'map', ros_message)
    assert stamp_ns(SimpleNamespace(header=header)) == stamp


def test_a_stamp_that_32_bits_of_seconds_cannot_hold_is_no_header():
    for beyond in (2**31 * 10**9, -(2**31) * 10**9 - 1):
        with pytest.raises(ValueError, match='cannot hold'):
            make_header(beyond, 'map', ros_message)


def test_a_nanosecond_field_of_a_second_is_refused():
    message = SimpleNamespace(header=SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=10**9)))
    with pytest.raises(Rejection) as caught:
        stamp_ns(message)
    assert caught.value.reason == 'bad_stamp'


def as_read(measurement, world_frame):
    """The measurement sent as a message and read again by a reader that is told `world_frame`."""
    write, read = {Fix: (write_fix, read_fix), Arrivals: (write_arrivals, read_arrivals)}[
        type(measurement)
    ]
    return read(write(measurement, ros_message), world_frame=world_frame)


def test_a_fix_turns_from_ned_to_enu_with_its_covariance():
    turned = as_read(fix('map_ned'), 'ned')
    assert turned.position.tolist() == [2.0, 1.0, -3.0]
    assert turned.covariance[:2, :2].tolist() == [[9.0, 0.5], [0.5, 4.0]]
    assert turned.frame_id == 'map'


def test_a_bearing_means_the_same_direction_after_turning():
    for bearing in (-3.0, 0.25, 1.0, 3.1):
        north, east = np.cos(bearing), np.sin(bearing)
        turned = as_read(arrivals(bearing=[bearing]), 'ned')
        assert np.cos(turned.bearing[0]) == pytest.approx(east)
        assert np.sin(turned.bearing[0]) == pytest.approx(north)
    assert turned.tx.tolist() == [[2.0, 1.0, -3.0]] and turned.rx.tolist() == [[5.0, 4.0, -6.0]]


def test_turning_twice_changes_nothing_but_the_frame():
    twice = as_read(as_read(arrivals(), 'ned'), 'ned')
    assert np.allclose(twice.bearing, [0.25]) and (twice.tx == arrivals().tx).all()
    assert twice.frame_id == 'map'


def test_a_ned_frame_is_refused_under_enu_and_read_under_ned():
    for measurement in (fix('map_ned'), arrivals()):
        with pytest.raises(Rejection, match='north-east-down') as caught:
            as_read(measurement, 'enu')
        assert caught.value.reason == 'frame_ned'
        assert as_read(measurement, 'ned').frame_id == 'map'
    assert as_read(fix(), 'enu').position.tolist() == [1.0, 2.0, 3.0]
    with pytest.raises(ValueError, match='enu, ned'):
        to_enu(fix(), 'nwu', lambda same: same)
