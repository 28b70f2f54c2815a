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

from sonar_imm.intake import KnownFrames
from sonar_imm.measurements import Altitude, ArrayDepth, Detections, Fix, Navigation, Rejection


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
