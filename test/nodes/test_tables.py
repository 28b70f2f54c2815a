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

"""Tables that are published as bytes arrive as the tables they are."""

import array

import numpy as np
import pytest
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2

from msg_adapters.table import encode_table
from sonar_imm.nodes.messages import make
from sonar_imm.nodes.outputs import ProcessedPublisher, TablePublisher


class Paper:
    """A publisher that keeps what it is given; `message` is what would arrive."""

    def __init__(self):
        self.sent = []

    def publish(self, message):
        self.sent.append(message)

    @property
    def message(self):
        return deserialize_message(self.sent[-1], PointCloud2)


def table(rows=3, columns=5, frame_id='map', stamp_ns=1_700_000_000_123_456_789, seed=0):
    rng = np.random.default_rng(seed)
    values = {f'column_{k}': rng.normal(size=rows) for k in range(columns)}
    values['pair'] = rng.normal(size=(rows, 2)).astype(np.float32)
    values['bad'] = np.where(np.arange(rows) % 2, np.nan, 1.0)
    return encode_table(values, stamp_ns=stamp_ns, frame_id=frame_id, make=make)


CASES = [
    {},
    {'stamp_ns': 1_800_000_000_000_000_001, 'seed': 3},
    {'rows': 0},
    {'rows': 1000},
    {'rows': 1},
    {'columns': 40},
    {'columns': 2, 'frame_id': ''},
    *({'frame_id': 'a' * n} for n in range(1, 6)),
    {'frame_id': 'Fjord_µ'},
    {},
]


@pytest.mark.parametrize('repeat', [1, 2])
def test_what_arrives_is_what_was_published_whatever_came_before(repeat):
    paper = Paper()
    publisher = TablePublisher(paper)
    for case in CASES:
        for _ in range(repeat):
            publisher.publish(table(**case))
            assert isinstance(paper.sent[-1], bytes) and paper.message == table(**case)


def test_a_table_whose_bytes_are_not_understood_is_published_as_any_other_message(monkeypatch):
    monkeypatch.setattr('sonar_imm.nodes.outputs._STAMP', 8)
    paper = Paper()
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
