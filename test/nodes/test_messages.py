# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The live message factory: every field cast to what its definition asks for."""

import array

import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2

from msg_adapters.table import decode_table, encode_table
from sonar_imm.nodes.messages import make, message_class
from sonar_imm.nodes.outputs import ProcessedPublisher, TablePublisher


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
    assert make('sensor_msgs/msg/PointCloud2', data=data).data == array.array('B', [1, 2])


def test_bulk_doubles_from_float32_strings_from_a_tuple_and_messages_in_messages():
    position, stamp = np.array([0.25, 0.5], np.float32), make('builtin_interfaces/msg/Time', sec=3)
    header = make('std_msgs/msg/Header', frame_id='map', stamp=stamp)
    made = make('sensor_msgs/msg/JointState', name=('a', 'b'), position=position, header=header)
    assert made.name == ['a', 'b'] and made.position == array.array('d', [0.25, 0.5])
    assert made.header.stamp.sec == 3 and made.header.stamp.nanosec == 0


def test_unknown_fields_and_types_are_named():
    with pytest.raises(TypeError, match='has no field depth'):
        make('geometry_msgs/msg/Point', depth=1.0)
    with pytest.raises(ImportError, match='nowhere_msgs/msg/Thing is not installed'):
        message_class('nowhere_msgs/msg/Thing')


# -- Tables that are published as bytes arrive as the tables they are --


class Paper:
    """A publisher that keeps what it is given; `message` is what would arrive."""

    msg_type = PointCloud2

    def __init__(self):
        self.sent = []

    def publish(self, message):
        self.sent.append(message)

    @property
    def message(self):
        sent = self.sent[-1]
        return deserialize_message(sent, PointCloud2) if isinstance(sent, bytes) else sent


def table(rows=3, columns=5, frame_id='map', stamp_ns=1_700_000_000_123_456_789, seed=0):
    rng = np.random.default_rng(seed)
    values = {f'column_{k}': rng.normal(size=rows) for k in range(columns)}
    values['pair'] = rng.normal(size=(rows, 2)).astype(np.float32)
    values['bad'] = np.where(np.arange(rows) % 2, np.nan, 1.0)
    return encode_table(values, stamp_ns=stamp_ns, frame_id=frame_id, make=make)


CASES = [
    {}, {'stamp_ns': 1_800_000_000_000_000_001, 'seed': 3}, {'rows': 0}, {'rows': 1000},
    {'rows': 1}, {'columns': 40}, {'columns': 2, 'frame_id': ''},
    *({'frame_id': 'a' * n} for n in range(1, 6)), {'frame_id': 'Fjord_µ'}, {},
]  # fmt: skip


@pytest.mark.parametrize('repeat', [1, 2])
def test_what_arrives_is_what_was_published_whatever_came_before(repeat, monkeypatch):
    paper = Paper()
    publisher = TablePublisher(paper)
    for case in CASES:
        for _ in range(repeat):
            publisher.publish(table(**case))
            assert isinstance(paper.sent[-1], bytes) and paper.message == table(**case)
    # A table whose bytes are not understood is published as any other message.
    monkeypatch.setattr('sonar_imm.nodes.outputs._STAMP', 8)
    publisher = TablePublisher(paper)
    for case in CASES:
        publisher.publish(table(**case))
        assert paper.sent[-1] == table(**case)


def test_every_answer_has_its_counts_and_its_stamp():
    paper = Paper()
    answers = ProcessedPublisher(paper)
    stamp = table().header.stamp
    for counts, when in (
        ({'a': 1, 'b': 2}, None),
        ({'a': 70000, 'b': 3}, stamp),
        ({'a': 1, 'b': 0}, None),
    ):
        answers.publish(counts, when)
        message = paper.message
        assert message.data == array.array('B', np.array([*counts.values()], '<f8').tobytes())
        assert [field.name for field in message.fields] == ['a', 'b']
        assert message.header.stamp == (type(stamp)() if when is None else when)
    # Counts beyond 32 bits do not wrap.
    answers = ProcessedPublisher(paper)
    for messages in (1, 2**32 + 7, 2**53 - 1):
        answers.publish({'messages': messages, 'refused': 0, 'estimates': messages - 1})
        row = {name: int(column[0]) for name, column in decode_table(paper.message).items()}
        assert row == {'messages': messages, 'refused': 0, 'estimates': messages - 1}
