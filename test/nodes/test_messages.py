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

"""The live message factory: every field cast to what its definition asks for."""

import array

import numpy as np
import pytest

from sonar_imm.nodes.messages import make, message_class


def test_scalars_are_cast():
    point = make('geometry_msgs/msg/Point', x=1, y=np.float32(0.5), z=np.int64(-2))
    assert (point.x, point.y, point.z) == (1.0, 0.5, -2.0)
    assert type(point.y) is float
    field = make('sensor_msgs/msg/PointField', name=np.str_('x'), offset=np.int32(4), count=True)
    assert (field.name, field.offset, type(field.count)) == ('x', 4, int)


def test_a_square_covariance_is_flattened_and_its_size_checked():
    made = make('geometry_msgs/msg/PoseWithCovariance', covariance=np.arange(36.0).reshape(6, 6))
    assert made.covariance.tolist() == list(range(36))
    with pytest.raises(ValueError, match='36 numbers are needed, got 35'):
        make('geometry_msgs/msg/PoseWithCovariance', covariance=[0.0] * 35)


@pytest.mark.parametrize(
    'data', [b'\x01\x02', bytearray(b'\x01\x02'), [1, 2], np.array([1, 9, 2, 9], np.uint8)[::2]]
)
def test_bulk_bytes_take_any_form(data):
    made = make('sensor_msgs/msg/PointCloud2', data=data)
    assert made.data == array.array('B', [1, 2])


def test_bulk_doubles_from_float32_and_strings_from_a_tuple():
    made = make(
        'sensor_msgs/msg/JointState', name=('a', 'b'), position=np.array([0.25, 0.5], np.float32)
    )
    assert made.name == ['a', 'b']
    assert made.position == array.array('d', [0.25, 0.5])


def test_nested_messages_and_defaults():
    header = make(
        'std_msgs/msg/Header',
        frame_id='map',
        stamp=make('builtin_interfaces/msg/Time', sec=3, nanosec=4),
    )
    made = make('geometry_msgs/msg/PointStamped', header=header)
    assert made.header.stamp.sec == 3
    assert made.point.x == 0.0


def test_unknown_fields_and_types_are_named():
    with pytest.raises(TypeError, match='has no field depth'):
        make('geometry_msgs/msg/Point', depth=1.0)
    with pytest.raises(ImportError, match='nowhere_msgs/msg/Thing is not installed'):
        message_class('nowhere_msgs/msg/Thing')
