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

"""Transforms as messages: TFMessage of a recording, TransformStamped where tf2 is missing."""

import math

import numpy as np
import pytest

from msg_adapters.transforms import read_transforms, write_transforms
from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.measurements import Rejection, StaticTransforms
from sonar_imm_tools.recordings.messages import ros_message, typestore


def message(parent='base_link', child='sonar', rpy=(0.1, -0.4, 2.9)):
    pose = Pose(np.array([1.0, 0.5, -0.2]), geometry.rotation(*rpy))
    return write_transforms(StaticTransforms(poses={child: (parent, pose)}), ros_message)


@pytest.mark.parametrize('seed', range(20))
def test_what_is_written_reads_back(seed):
    rng = np.random.default_rng(seed)
    rpy = rng.uniform(-np.pi, np.pi, size=3)
    rpy[1] /= 2.0
    made = message(rpy=rpy)
    name = made.__msgtype__
    again = typestore().deserialize_cdr(typestore().serialize_cdr(made, name), name)
    parent, pose = read_transforms(again).poses['sonar']
    assert parent == 'base_link' and pose.position.tolist() == [1.0, 0.5, -0.2]
    assert pose.R == pytest.approx(geometry.rotation(*rpy), abs=1e-12)


def test_one_transform_alone_is_read_and_a_leading_slash_dropped():
    (item,) = message(parent='/base_link', child='/sonar').transforms
    assert list(read_transforms(item).poses) == ['sonar']
    assert read_transforms(item).poses['sonar'][0] == 'base_link'


@pytest.mark.parametrize(
    'spoil, code',
    [
        (lambda item: setattr(item.transform.translation, 'x', math.nan), 'nan'),
        (lambda item: setattr(item.transform.rotation, 'w', math.inf), 'nan'),
        (lambda item: setattr(item.transform.rotation, 'w', 7.0), 'out_of_range'),
        (lambda item: setattr(item.transform.rotation, 'x', 1e300), 'out_of_range'),
        (lambda item: setattr(item.transform.translation, 'y', 1e9), 'out_of_range'),
        (lambda item: setattr(item.header, 'frame_id', ''), 'no_frame'),
        (lambda item: setattr(item, 'child_frame_id', 'base_link'), 'no_frame'),
        (lambda item: setattr(item, 'child_frame_id', 'f' * 1001), 'too_large'),
        (lambda item: setattr(item.header, 'frame_id', 'f' * 1001), 'too_large'),
    ],
)
def test_what_cannot_be_used_is_refused_with_its_reason(spoil, code):
    made = message()
    spoil(made.transforms[0])
    with pytest.raises(Rejection) as caught:
        read_transforms(made)
    assert caught.value.reason == code


def test_a_message_without_any_is_refused():
    with pytest.raises(Rejection):
        read_transforms(write_transforms(StaticTransforms(poses={}), ros_message))
