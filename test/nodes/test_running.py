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

"""The executor of the nodes: what it leaves for later still comes."""

from collections import Counter
import subprocess
import sys
import time

import pytest
import rclpy
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Empty
from std_srvs.srv import Trigger

from sonar_imm.nodes.qos import Endpoints, lockstep_qos, output_qos
from sonar_imm.nodes.running import EVENT_PERIOD, MessagesFirst


def test_messages_come_at_once_and_events_within_their_period(make_bench):
    bench = make_bench()
    node = rclpy.node.Node('hearer', context=bench.context, use_global_arguments=False)
    bench.nodes.append(node)
    endpoints, received, ticks = Endpoints(node), [], []
    endpoints.subscribe(
        Empty, 'good', lambda message, info: received.append(message), output_qos()
    )
    endpoints.subscribe(
        Empty, 'bad', lambda message, info: received.append(message), lockstep_qos()
    )
    node.create_timer(0.05, lambda: ticks.append(time.monotonic()))
    best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    bench.peer.create_publisher(Empty, 'bad', best_effort)
    good = bench.peer.create_publisher(Empty, 'good', lockstep_qos())
    executor = MessagesFirst(context=bench.context)
    executor.add_node(node)
    try:
        end = time.monotonic() + 120.0
        while not (received and endpoints.incompatible and len(ticks) > 3):
            assert time.monotonic() < end, (received, endpoints.incompatible, ticks)
            good.publish(Empty())
            executor.spin_once(timeout_sec=0.02)
        assert endpoints.incompatible == {'bad': 'RELIABILITY'}
    finally:
        executor.shutdown()


def test_events_are_asked_a_few_times_a_second_only(make_bench, monkeypatch):
    bench = make_bench()
    node = rclpy.node.Node('hearer', context=bench.context, use_global_arguments=False)
    bench.nodes.append(node)
    Endpoints(node).subscribe(Empty, 'good', lambda message: None, output_qos())
    executor = MessagesFirst(context=bench.context)
    executor.add_node(node)
    looks = []
    monkeypatch.setattr(executor, '_look_at_events', lambda: looks.append(time.monotonic()))
    try:
        begin = time.monotonic()
        while time.monotonic() < begin + 3 * EVENT_PERIOD:
            executor.spin_once(timeout_sec=0.01)
    finally:
        executor.shutdown()
    assert 2 <= len(looks) <= 4
    asked = [waitable for waitable in node.waitables if executor.can_execute(waitable)]
    assert len(list(node.waitables)) >= 3 and not asked


@pytest.mark.parametrize('by_itself', [True, False])
def test_a_flood_on_one_topic_leaves_room_for_all_else(make_bench, by_itself):
    """Other topics, timers, services, also those that wait, guards, and what is made meanwhile;
    with what is not public in rclpy, and without."""
    bench = make_bench()
    node = rclpy.node.Node('hearer', context=bench.context, use_global_arguments=False)
    bench.nodes.append(node)
    came, ends = Counter(), []
    executor = MessagesFirst(context=bench.context)
    executor._by_itself = by_itself and executor._by_itself
    group = ReentrantCallbackGroup()

    def first(message):
        came['flood'] += 1
        if came['flood'] == 5:
            ends.append(node.create_subscription(Empty, 'new', hear('new'), lockstep_qos()))
            node.destroy_subscription(old)
            guard.trigger()

    def hear(name):
        return lambda message: came.update([name])

    async def slowly(request, response):
        waiting = rclpy.task.Future(executor=executor)
        timer = node.create_timer(0.1, lambda: waiting.set_result(None), callback_group=group)
        await waiting
        node.destroy_timer(timer)
        came['slow'] += 1
        return response

    node.create_subscription(Empty, 'flood', first, lockstep_qos())
    node.create_subscription(Empty, 'quiet', hear('quiet'), lockstep_qos())
    old = node.create_subscription(Empty, 'old', hear('old'), lockstep_qos())
    node.create_timer(0.05, lambda: came.update(['timer']))
    guard = node.create_guard_condition(lambda: came.update(['guard']))
    node.create_service(Trigger, 'slow', slowly, callback_group=group)
    client = bench.peer.create_client(Trigger, 'slow')
    flood, quiet, new = (
        bench.peer.create_publisher(Empty, name, lockstep_qos())
        for name in ('flood', 'quiet', 'new')
    )
    executor.add_node(node)
    wanted = {'flood', 'quiet', 'new', 'timer', 'guard', 'slow'}
    try:
        end = time.monotonic() + 120.0
        while not client.service_is_ready():
            assert time.monotonic() < end
            executor.spin_once(timeout_sec=0.02)
        client.call_async(Trigger.Request())
        while wanted - came.keys() or came['timer'] < 5:
            assert time.monotonic() < end, came
            for _ in range(5):
                flood.publish(Empty())
            quiet.publish(Empty())
            new.publish(Empty())
            executor.spin_once(timeout_sec=0.02)
    finally:
        executor.shutdown()
    assert came['guard'] == 1 and not came['old']


# -- How the process of a node ends --


PROGRAM = """
import atexit, sys
from sonar_imm.nodes.stopping import Stopper
atexit.register(print, 'modules are taken down')
stopper = Stopper()
stopper.asked = {asked}
print('said')
sys.exit(stopper.end(3))
"""


@pytest.mark.parametrize('asked', [True, False])
def test_a_process_that_was_told_to_stop_does_not_take_its_modules_down(asked):
    """That takes seconds on a busy machine, in which no watchdog lives."""
    command = [sys.executable, '-c', PROGRAM.format(asked=asked)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 3 and done.stdout.startswith('said\n') and not done.stderr
    assert ('taken down' in done.stdout) != asked
