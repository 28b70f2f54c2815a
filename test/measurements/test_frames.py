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

"""One frame for one tracker."""

import pytest

from sonar_imm.measurements import (
    Altitude,
    ArrayDepth,
    Detections,
    Fix,
    FrameGuard,
    Navigation,
    Rejection,
)


def fix(frame_id):
    return Fix(stamp_ns=1, position=(0.0, 0.0, 0.0), frame_id=frame_id)


def refused(guard, frame_id):
    with pytest.raises(Rejection) as caught:
        guard.admit(fix(frame_id))
    return caught.value


def test_the_first_named_frame_stays():
    guard = FrameGuard()
    guard.admit(fix(''))
    guard.admit(fix('map'))
    guard.admit(fix('map'))
    rejection = refused(guard, 'odom')
    assert rejection.reason == 'frame'
    assert rejection.sentence == "the frame 'odom' is not the frame 'map' of the tracks"
    refused(guard, '')


def test_reset_lets_the_next_one_decide():
    guard = FrameGuard()
    guard.admit(fix('map'))
    guard.reset()
    guard.admit(fix('odom'))
    refused(guard, 'map')


def test_a_told_frame_holds_from_the_start_and_survives_reset():
    guard = FrameGuard('harbour')
    refused(guard, 'map')
    guard.reset()
    refused(guard, '')
    guard.admit(fix('harbour'))


def test_what_sensors_on_board_say_is_in_frames_of_their_own():
    guard = FrameGuard('odom')
    echo = Detections(stamp_ns=1, range=[], bearing=[], frame_id='sonar')
    height = Altitude(stamp_ns=1, altitude=3.0, frame_id='altimeter')
    place = Navigation(stamp_ns=1, position=[0, 0, 0], orientation=[0, 0, 0, 1], frame_id='odom')
    for measurement in (echo, height, place, echo, height, place):
        guard.admit(measurement)
    for other in (
        Detections(stamp_ns=1, range=[], bearing=[], frame_id='sonar_2'),
        Navigation(stamp_ns=1, position=[0, 0, 0], orientation=[0, 0, 0, 1], frame_id='map'),
    ):
        with pytest.raises(Rejection) as caught:
            guard.admit(other)
        assert caught.value.reason == 'frame'
    guard.reset()
    guard.admit(Detections(stamp_ns=1, range=[], bearing=[], frame_id='sonar_2'))


def test_a_depth_is_a_depth_in_any_frame():
    guard = FrameGuard('map')
    guard.admit(ArrayDepth(stamp_ns=1, depth=30.0, frame_id='buoy'))
    assert guard.frame_id == 'map'
