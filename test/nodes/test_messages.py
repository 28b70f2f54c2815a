# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The live message factory: every field cast to what its definition asks for; tables that are
published as bytes; and messages that never came, counted by the numbers of those that did."""

import array
import itertools
import time
from types import SimpleNamespace

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseWithCovarianceStamped
from helpers.node_bench import a_fix, values_of
import numpy as np
import pytest
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import Float64

from msg_adapters.table import decode_table, encode_table
from sonar_imm.nodes.base import TrackerNode
from sonar_imm.nodes.messages import make, message_class
from sonar_imm.nodes.outputs import ProcessedPublisher, TablePublisher
from sonar_imm.nodes.qos import Endpoints, input_qos, output_qos, SequenceGaps


def test_scalars_are_cast_and_squares_flattened():
    point = make('geometry_msgs/msg/Point', x=1, y=np.float32(0.5), z=np.int64(-2))
    assert (point.x, point.y, point.z) == (1.0, 0.5, -2.0)
    assert type(point.y) is float
    field = make('sensor_msgs/msg/PointField', name=np.str_('x'), offset=np.int32(4), count=True)
    assert (field.name, field.offset, type(field.count)) == ('x', 4, int)
    # A square covariance is flattened, and its size checked.
    made = make('geometry_msgs/msg/PoseWithCovariance', covariance=np.arange(36.0).reshape(6, 6))
    assert made.covariance.tolist() == list(range(36))
    with pytest.raises(ValueError, match='36 numbers are needed, got 35'):
        make('geometry_msgs/msg/PoseWithCovariance', covariance=[0.0] * 35)


def test_bulk_takes_any_form_and_messages_are_in_messages():
    strided = np.array([1, 9, 2, 9], np.uint8)[::2]
    for data in (b'\x01\x02', bytearray(b'\x01\x02'), [1, 2], strided):
        assert make('sensor_msgs/msg/PointCloud2', data=data).data == array.array('B', [1, 2])
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
    for *given, when in ((1, 2, None), (70000, 3, stamp), (1, 0, None)):
        counts = dict(zip('ab', given))
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


class Line:
    """Publishers by name, each numbering what it sends, and the counter that hears them."""

    def __init__(self, publishers=1):
        self.publishers = publishers
        self.numbers = {}
        self.gaps = SequenceGaps(lambda: self.publishers)

    def send(self, name='one', *, skip=0, received_ns=0):
        number = self.numbers.get(name, 0) + 1 + skip
        self.numbers[name] = number
        return self.gaps.count(
            {'publication_sequence_number': number, 'received_timestamp': received_ns}
        )


def test_a_gap_in_the_numbers_is_what_was_lost():
    line = Line()
    missed = [line.send(skip=skip) for skip in (7, 0, 0, 3, 0, 1)]
    assert missed == [0, 0, 0, 3, 0, 1]  # what came before the first was sent to others
    assert line.gaps.lost == 4
    line.numbers.clear()  # a publisher that starts again loses nothing
    assert sum(line.send() for _ in range(5)) == 0
    assert line.send(skip=2) == 2
    info = {'publication_sequence_number': None, 'received_timestamp': 1}
    gaps = SequenceGaps(lambda: 1)  # nor does a middleware without numbers
    assert (gaps.count(info), gaps.count(info), gaps.lost, gaps.numbered) == (0, 0, 0, False)


@pytest.mark.parametrize('seed', range(5))
def test_the_losses_of_publishers_add_up(seed):
    rng = np.random.default_rng(seed)
    line = Line(publishers=3)
    for name, start in zip('abc', (0, 10_000, 500_000), strict=True):
        line.numbers[name] = start
        line.send(name)
    lost = 0
    for name in rng.choice(list('abc'), 1000, p=(0.7, 0.25, 0.05)):
        skip = int(rng.random() < 0.1) * int(rng.integers(1, 9))
        lost += skip
        line.send(name, skip=skip)
    assert line.gaps.lost == lost


def test_a_publisher_that_left_is_not_continued_by_another():
    line = Line(publishers=2)
    line.numbers['other'] = 60
    for name in ('gone', 'other') * 20:
        line.send(name)
    line.publishers = 1
    line.gaps.publisher_left()
    queued = time.time_ns() - 10**9
    line.send('gone', received_ns=queued)  # was still in the queue
    assert sum(line.send('other', received_ns=time.time_ns()) for _ in range(5)) == 0
    assert line.send('other', skip=3, received_ns=time.time_ns()) == 3
    line.publishers = 2
    line.numbers['third'] = line.numbers['gone'] + 10
    assert line.send('third', received_ns=time.time_ns()) == 0


def test_the_real_middleware_numbers_messages_and_the_queue_is_counted(make_bench, capfd):
    bench = make_bench()
    received = []
    endpoints = Endpoints(bench.peer)
    endpoints.subscribe(Float64, 'depth', lambda m, _: received.append(m.data), input_qos(10))
    writer = bench.start(Node, 'writer', use_global_arguments=False)
    publishers = [writer.create_publisher(Float64, 'depth', 1000) for _ in range(2)]
    bench.spin_until(lambda: all(item.get_subscription_count() for item in publishers))
    sent = itertools.count()
    for publisher in publishers:
        publisher.publish(Float64(data=float(next(sent))))
    bench.spin_until(lambda: len(received) == 2)
    assert not endpoints.lost
    for publisher in publishers * 100:  # while the node is busy
        publisher.publish(Float64(data=float(next(sent))))
    bench.spin_until(lambda: 201.0 in received)
    assert endpoints.lost == {'depth': 202 - len(received)}
    assert len(received) <= 2 + 10
    assert capfd.readouterr().err.count("'depth' are lost before") == 1


def test_a_middleware_without_numbers_is_believed_what_it_says_was_lost(make_bench):
    endpoints = Endpoints(make_bench().peer)
    endpoints.subscribe(Float64, 'depth', lambda *_: None, input_qos(10))
    endpoints._lost('depth', SimpleNamespace(total_count=7))
    endpoints._gaps['depth'].count({'publication_sequence_number': None, 'received_timestamp': 1})
    assert endpoints.lost == {'depth': 7}
    for number in (1, 4):  # with numbers they count alone, since both may know of the same
        info = {'publication_sequence_number': number, 'received_timestamp': 1}
        endpoints._gaps['depth'].count(info)
    assert endpoints.lost == {'depth': 2}


@pytest.mark.usefixtures('quick')
def test_a_node_warns_of_the_share_that_it_lost(make_bench, walker):
    bench = make_bench(p=['qos_overrides./fix.subscription.depth:=5'])
    node = bench.start(TrackerNode, 'walker')
    given = bench.listen(DiagnosticArray, '/diagnostics', output_qos())
    fix, message = bench.publisher(PoseWithCovarianceStamped, 'fix', 100), a_fix(1.0)
    bench.send(node, fix, message)
    for _ in range(100):
        fix.publish(message)
    bench.spin_until(lambda: any('are lost before' in item.status[0].message for item in given))
    statuses = [item.status[0] for item in given]
    printed = next(status for status in statuses if 'are lost before' in status.message)
    assert printed.level == DiagnosticStatus.WARN
    assert '% on fix' in printed.message

    def lost():
        return int(values_of(given[-1])['lost on fix'])

    bench.spin_until(lambda: lost() == 101 - node._meter.received['fix'])
    assert lost() > 90
