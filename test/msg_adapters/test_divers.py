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

"""Displays of several divers at once: poses, and markers that end when their track does."""

import math

import numpy as np
import pytest

from msg_adapters.displays import displays_of
from msg_adapters.displays.diver import NAMES, write_markers, write_poses
from sonar_imm.estimates import Estimate
from sonar_imm_tools.recordings.messages import ros_message

ADD, DELETE, DELETE_ALL = 0, 2, 3


def an_estimate(ids, states=None, covariance=None):
    rows = len(ids)
    state = np.array([[10.0 * i, -5.0, 0.6, 0.8] for i in ids]).reshape(rows, 4)
    whole = np.diag([4.0, 1.0, 0.1, 0.1])
    if covariance is not None:
        whole[:2, :2] = covariance
    return Estimate(
        stamp_ns=5 * 10**9,
        frame_id='map',
        xyz=np.column_stack([state[:, :2], np.full(rows, -4.0)]).astype(np.float32),
        state_names=('px', 'py', 'vx', 'vy'),
        state=state,
        covariance=np.tile(whole, (rows, 1, 1)),
        model_names=('hover',),
        probabilities=np.ones((rows, 1)),
        extras={
            'track_id': np.array(ids, np.uint32),
            'track_state': np.array(states or [1] * rows, np.uint8),
        },
    )


def test_all_divers_are_in_one_message_each_turned_to_where_he_swims():
    message = write_poses(an_estimate([3, 7]), [0, 1], ros_message)
    assert message.header.frame_id == 'map' and message.header.stamp.sec == 5
    assert [pose.position.x for pose in message.poses] == [30.0, 70.0]
    q = message.poses[0].orientation
    assert 2.0 * math.atan2(q.z, q.w) == pytest.approx(math.atan2(0.8, 0.6))


def test_the_ellipse_holds_nine_of_ten_samples_and_lies_along_the_covariance():
    turn = np.array([[math.cos(0.5), -math.sin(0.5)], [math.sin(0.5), math.cos(0.5)]])
    covariance = turn @ np.diag([9.0, 0.25]) @ turn.T
    place, course, label = write_markers(
        an_estimate([3], covariance=covariance), [0], ros_message
    ).markers
    half = 2.0 * math.atan2(place.pose.orientation.z, place.pose.orientation.w)
    assert math.cos(half - 0.5) ** 2 == pytest.approx(1.0)
    samples = np.random.default_rng(1).multivariate_normal([0.0, 0.0], covariance, 20000)
    long, wide = (samples @ turn).T
    inside = (2.0 * long / place.scale.x) ** 2 + (2.0 * wide / place.scale.y) ** 2 <= 1.0
    assert inside.mean() == pytest.approx(0.9, abs=0.01)
    assert [(end.x, end.y) for end in course.points] == [(30.0, -5.0), (33.0, -1.0)]
    assert label.text == '3: 1.0 m/s' and label.pose.position.z == -3.0
    assert {item.id for item in (place, course, label)} == {3}


def test_a_diver_that_coasts_is_grey_and_says_so():
    seen, lost = (
        write_markers(an_estimate([3], [state]), [0], ros_message).markers for state in (1, 2)
    )
    assert seen[0].color != lost[0].color and lost[2].text.endswith('not seen')


def drawn(displays, estimate):
    return [
        [(marker.ns, marker.id, marker.action) for marker in message.markers]
        for name, message in displays.of(estimate, ros_message, lambda name: name == 'markers')
    ]


def test_markers_of_a_track_that_is_over_are_deleted_at_once():
    displays = displays_of('diver')
    assert drawn(displays, an_estimate([1, 2], [0, 1])) == [[(n, 2, ADD) for n in NAMES]]
    both = drawn(displays, an_estimate([1, 2]))
    assert both == [[(n, i, ADD) for i in (1, 2) for n in NAMES]]
    ended, left = drawn(displays, an_estimate([1]))
    assert ended == [(n, 2, DELETE) for n in NAMES] and left == [(n, 1, ADD) for n in NAMES]
    assert drawn(displays, an_estimate([])) == [[(n, 1, DELETE) for n in NAMES]]
    assert drawn(displays, an_estimate([])) == []
    ((name, message),) = displays.forget(ros_message)
    assert name == 'markers' and [marker.action for marker in message.markers] == [DELETE_ALL]
