# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A small real system, the walker, and a bench to run its node on: one process, one executor."""

import contextlib
import threading
import time

import pytest
import rclpy

from helpers import walker
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

    def __init__(self, args=()):
        self.context = rclpy.Context()
        rclpy.init(
            args=['bench', '--ros-args', *args] if args else None,
            context=self.context,
            signal_handler_options=rclpy.signals.SignalHandlerOptions.NO,
        )
        self.executor = rclpy.executors.SingleThreadedExecutor(context=self.context)
        self.nodes = []
        self.peer = self.add(
            rclpy.node.Node('peer', context=self.context, use_global_arguments=False)
        )

    def add(self, node):
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def spin_until(self, predicate, limit=240.0):
        """Spin until `predicate()` is true; fails the test after `limit` seconds."""
        end = time.monotonic() + limit
        while not predicate():
            assert time.monotonic() < end, 'what was waited for did not happen'
            self.executor.spin_once(timeout_sec=0.02)

    def listen(self, message_type, topic, qos=10):
        """Collect what comes on `topic`."""
        received = []
        self.peer.create_subscription(message_type, topic, received.append, qos)
        return received

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
    """Make benches, each with ROS arguments as on a command line; all are closed at the end."""
    with contextlib.ExitStack() as stack:

        def make(*args):
            bench = Bench(args)
            stack.callback(bench.close)
            return bench

        yield make


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
