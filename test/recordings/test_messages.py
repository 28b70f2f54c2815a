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

import numpy as np
import pytest

from sonar_imm_tools.recordings.messages import decode_cdr, ros_message, typestore


def test_every_common_message_can_be_made_empty_and_survives_cdr():
    for name in typestore().types:
        if '/msg/' not in name:
            continue
        message = ros_message(name)
        raw = bytes(typestore().serialize_cdr(message, name))
        again = decode_cdr(typestore(), name, raw)
        assert bytes(typestore().serialize_cdr(again, name)) == raw, name


def test_fields_are_cast_strictly():
    message = ros_message(
        'sensor_msgs/msg/JointState', name=('a',), position=[1, 2], velocity=np.float32([0.5])
    )
    assert message.position.dtype == np.float64 and message.velocity.dtype == np.float64
    cloud = ros_message('sensor_msgs/msg/PointCloud2', data=b'\x01\x02', height=np.int64(3))
    assert cloud.data.tolist() == [1, 2] and type(cloud.height) is int
    pose = ros_message('geometry_msgs/msg/PoseWithCovariance', covariance=np.eye(6))
    assert pose.covariance.shape == (36,)


def test_an_unknown_field_is_named():
    with pytest.raises(TypeError, match='sek'):
        ros_message('builtin_interfaces/msg/Time', sek=1)


def test_spare_alignment_bytes_are_no_damage_but_damage_is():
    name = 'sensor_msgs/msg/JointState'
    raw = bytes(typestore().serialize_cdr(ros_message(name, position=[2.5]), name))
    for spare in (0, 4, 8, 12):
        assert decode_cdr(typestore(), name, raw + bytes(spare)).position.tolist() == [2.5]
    with pytest.raises(Exception, match='size mismatch'):
        decode_cdr(typestore(), name, raw + bytes(100))
    with pytest.raises(Exception, match='JointState'):
        decode_cdr(typestore(), name, raw[:20])
