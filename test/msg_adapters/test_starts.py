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

"""Starts of tracks: what is read, and what is refused with a sentence."""

import math

import numpy as np
import pytest

from msg_adapters.fixes import read_start, write_start
from sonar_imm.measurements import Rejection, Start
from sonar_imm_tools.recordings.messages import ros_message

STAMP = 1_700_000_000_123_456_789


def pose(x=1.0, y=2.0, z=3.0, covariance=None, **values):
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


def reason(message):
    with pytest.raises(Rejection) as caught:
        read_start(message)
    assert caught.value.sentence
    return caught.value.reason


def test_a_start_is_read_and_written():
    start = read_start(pose())
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
    start = read_start(pose(), world_frame='ned')
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
        ({'covariance': [[math.nan, 0.0], [0.0, 1.0]]}, 'nan'),
        ({'covariance': [[1.0, 2.0], [2.0, 1.0]]}, 'bad_covariance'),
        ({'covariance': [[1.0, 0.5], [0.0, 1.0]]}, 'bad_covariance'),
        ({'covariance': np.eye(2) * 1e-20}, 'out_of_range'),
        ({'covariance': np.eye(2) * 1e20}, 'out_of_range'),
        ({'frame_id': 'map_ned'}, 'frame_ned'),
    ],
)
def test_what_cannot_be_used_is_refused_with_its_reason(given, code):
    assert reason(pose(**given)) == code


def test_a_start_without_a_stamp_is_refused():
    message = pose()
    message.header.stamp.sec = message.header.stamp.nanosec = 0
    assert reason(message) == 'bad_stamp'
