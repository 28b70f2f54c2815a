# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A bench to run nodes on, one process and one executor, and the walker, a small real system."""

import contextlib
import threading
import time

import numpy as np
import pytest
import rclpy
from sensor_msgs.msg import PointCloud2

from helpers import walker
from msg_adapters.estimates import read_estimate
from msg_adapters.fixes import write_fix
from msg_adapters.table import decode_table
from sonar_imm.measurements import Fix
from sonar_imm.nodes.base import TrackerNode
from sonar_imm.nodes.messages import make, message_class
from sonar_imm.nodes.qos import latched_qos, lockstep_qos
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.writer import BagWriter
from sonar_imm_tools.replay.harness import reserved_domain_id
from sonar_imm_tools.replay.link import Link


@pytest.fixture(name='walker')
def _walker(monkeypatch):
    """Make the system 'walker' known for one test."""
    walker.register(monkeypatch.setitem)


class Held:
    """What a tracker does to get warm: it begins, and ends when it is let go."""

    def __init__(self):
        self.begun, self.let_go = threading.Event(), threading.Event()

    def __call__(self, tracker=None, inputs=None):
        self.begun.set()
        assert self.let_go.wait(240.0)
        return '2 kernels loaded'


class Bench:
    """A context of its own with a peer node, and an executor to spin everything on."""

    def __init__(self, *args, p=(), domain_id=None):
        """With ROS arguments as on a command line; p: parameters, ``name:=value``."""
        self.context = rclpy.Context()
        words = [*args, *(word for each in p for word in ('-p', each))]
        rclpy.init(
            args=['bench', '--ros-args', *words] if words else None,
            context=self.context,
            domain_id=domain_id,  # None: as the environment says
            signal_handler_options=rclpy.signals.SignalHandlerOptions.NO,
        )
        self.executor = rclpy.executors.SingleThreadedExecutor(context=self.context)
        self.nodes = []
        self.peer = self.start(rclpy.node.Node, 'peer', use_global_arguments=False)

    def start(self, kind, *args, **options):
        """A node of this class, which is spun."""
        node = kind(*args, context=self.context, **options)
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def spin_until(self, predicate, limit=240.0):
        """Spin until `predicate()` is true; fails the test after `limit` seconds."""
        end = time.monotonic() + limit
        while not predicate():
            assert time.monotonic() < end, 'what was waited for did not happen'
            self.executor.spin_once(timeout_sec=0.02)

    def end(self, node):
        """Stop a node, so that it saves what it keeps."""
        self.nodes.remove(node)
        self.executor.remove_node(node)
        node.destroy_node()

    def listen(self, message_type, topic, qos=10):
        """Collect what comes on `topic`."""
        received = []
        self.peer.create_subscription(message_type, topic, received.append, qos)
        return received

    def hear(self, node, qos=10, **kinds):
        """Collect what a node publishes below its own name, a type for each topic."""
        topics = [f'{node.get_fully_qualified_name()}/{name}' for name in kinds]
        heard = [self.listen(kind, name, qos) for kind, name in zip(kinds.values(), topics)]
        self.spin_until(lambda: all(map(node.count_subscribers, topics)))
        return heard

    def publisher(self, kind, topic, qos=None):
        """A publisher of a type or its name that is heard."""
        cls = message_class(kind) if isinstance(kind, str) else kind
        made = self.peer.create_publisher(cls, topic, qos or lockstep_qos())
        self.spin_until(made.get_subscription_count)
        return made

    def send(self, node, publisher, *messages):
        """Publish one after another, each when the node has taken the one before."""
        received = node._meter.received
        for message in messages:
            before = received.total()
            publisher.publish(message)
            self.spin_until(lambda want=before: received.total() > want)

    def call(self, service_type, name, request):
        client = self.peer.create_client(service_type, name)
        self.spin_until(client.service_is_ready)
        future = client.call_async(request)
        self.spin_until(future.done)
        return future.result()

    def close(self):
        for node in self.nodes:
            node.destroy_node()
        self.executor.shutdown()
        rclpy.try_shutdown(context=self.context)


@pytest.fixture
def make_bench():
    """Make benches; all are closed at the end."""
    with contextlib.ExitStack() as stack:

        def begin(*args, **options):
            bench = Bench(*args, **options)
            stack.callback(bench.close)
            return bench

        yield begin


def values_of(report):
    """The values of a message of /diagnostics, by key."""
    return {pair.key: pair.value for status in report.status for pair in status.values}


@pytest.fixture
def domain(monkeypatch):
    """A ROS domain of this test's own: a player brings a context of its own."""
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    with reserved_domain_id() as domain_id:
        yield domain_id


@pytest.fixture
def link(domain):
    with Link('listener', domain_id=domain) as link:
        yield link


# -- the node of the walker with everything connected to it, and fixes to send to it --

FIX = 'geometry_msgs/msg/PoseWithCovarianceStamped'
SECOND = 10**9


def a_fix(seconds, x=1.0, y=2.0, frame_id='map'):
    place = {'position': (x, y, 0.0), 'covariance': np.diag([4.0, 9.0]), 'frame_id': frame_id}
    return write_fix(Fix(stamp_ns=round(seconds * SECOND), **place), make)


class Driven:
    """A node that is active, what it publishes, and what sends to it in lock-step."""

    def __init__(self, bench, node, name):
        self.bench, self.node, self.name = bench, node, name
        self.estimates = bench.listen(PointCloud2, f'{name}/estimate', lockstep_qos())
        self.answers = bench.listen(PointCloud2, f'{name}/processed', latched_qos())
        bench.spin_until(lambda: self.answers)

    @property
    def answer(self):
        """The last row of ~/processed: messages, refused, estimates."""
        columns = decode_table(self.answers[-1])
        return tuple(int(columns[name][0]) for name in ('messages', 'refused', 'estimates'))

    def publish(self, publisher, *messages):
        """Publish one after another, each when the one before has been answered."""
        for message in messages:
            answered = self.answer[0]
            publisher.publish(message)
            self.bench.spin_until(lambda before=answered: self.answer[0] > before)
        self.bench.spin_until(lambda: len(self.estimates) >= self.answer[2])


class Rig(Driven):
    """A walker node with everything connected to it."""

    def __init__(self, bench, *, publish=FIX, qos=10, topic='/fix', name='/walker'):
        super().__init__(bench, bench.start(TrackerNode, 'walker'), name)
        self.fix = bench.publisher(publish, topic, qos)

    def send(self, *messages):
        self.publish(self.fix, *messages)

    def end(self):
        self.bench.end(self.node)

    def means(self):
        return [(e.stamp_ns / SECOND, *e.state[0, :2]) for e in map(read_estimate, self.estimates)]


# -- a small recording for what plays and steps, and an ear for what is played --

START = 1_700_000_000 * 10**9
STEP = 10**7
COUNT = 20


def write_fixes(path):
    """Twenty fixes 10 ms apart, the fourth not a number, and a second topic with one message."""
    with BagWriter(path) as writer:
        for k in range(COUNT):
            place = {'position': (float(k), 0.0, 0.0), 'covariance': np.eye(2)}
            fix = Fix(stamp_ns=START + k * STEP, frame_id='map', **place)
            message = write_fix(fix, ros_message)
            if k == 3:
                message.pose.pose.position.x = float('nan')
            writer.write('/fix', message, fix.stamp_ns)
        writer.write('/other', ros_message('std_msgs/msg/Float64', data=1.5), START)
    return path


class Ear:
    """Hears everything on a topic, though it only listens when asked."""

    def __init__(self, link, message_type, topic):
        self.link, self.received = link, []
        self.subscription = link.node.create_subscription(
            message_type, topic, self.received.append, lockstep_qos()
        )

    def positions(self, count):
        assert self.link.wait_for(lambda: len(self.received) >= count, 60.0)
        return [message.pose.pose.position.x for message in self.received]
