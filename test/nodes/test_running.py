# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The executor of the nodes: what it leaves for later still comes; how the process of a node ends;
robots in domains of their own."""

import os
import subprocess
import sys
import time

from helpers.node_bench import a_fix, Rig
import pytest
import rclpy
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Empty

from sonar_imm.nodes.qos import Endpoints, lockstep_qos, output_qos
from sonar_imm.nodes.running import EVENT_PERIOD, help_text, MessagesFirst
from sonar_imm.parameters import ConfigError
from sonar_imm_tools.replay.harness import reserved_domain_id
from sonar_imm_tools.replay.link import Link


def test_messages_come_at_once_and_events_within_their_period(make_bench):
    bench = make_bench()
    node = rclpy.node.Node('hearer', context=bench.context, use_global_arguments=False)
    bench.nodes.append(node)
    endpoints, received, ticks = Endpoints(node), [], []
    for name, qos in (('good', output_qos()), ('bad', lockstep_qos())):
        endpoints.subscribe(Empty, name, lambda message, info: received.append(message), qos)
    node.create_timer(0.05, lambda: ticks.append(time.monotonic()))
    best_effort = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
    bench.peer.create_publisher(Empty, 'bad', best_effort)
    good = bench.peer.create_publisher(Empty, 'good', lockstep_qos())
    with MessagesFirst(context=bench.context) as executor:
        executor.add_node(node)
        end = time.monotonic() + 240.0
        while not (received and endpoints.incompatible and len(ticks) > 3):
            assert time.monotonic() < end, (received, endpoints.incompatible, ticks)
            good.publish(Empty())
            executor.spin_once(timeout_sec=0.02)
        assert endpoints.incompatible == {'bad': 'RELIABILITY'}


def test_events_are_asked_a_few_times_a_second_only(make_bench, monkeypatch):
    bench = make_bench()
    node = rclpy.node.Node('hearer', context=bench.context, use_global_arguments=False)
    bench.nodes.append(node)
    Endpoints(node).subscribe(Empty, 'good', lambda message: None, output_qos())
    with MessagesFirst(context=bench.context) as executor:
        executor.add_node(node)
        looks, begin = [], time.monotonic()
        monkeypatch.setattr(executor, '_look_at_events', lambda: looks.append(time.monotonic()))
        while time.monotonic() < begin + 3 * EVENT_PERIOD or len(looks) < 2:
            executor.spin_once(timeout_sec=0.01)
    assert len(looks) <= 1 + (time.monotonic() - begin) / EVENT_PERIOD
    asked = [waitable for waitable in node.waitables if executor.can_execute(waitable)]
    assert len(list(node.waitables)) >= 3 and not asked


# -- How the process of a node ends --


@pytest.mark.parametrize(
    'words, said', [(['-p', 'a:=1.0'], "'-p' has to follow --ros-args"), (['on'], 'see --help')]
)
def test_words_that_are_no_ros_arguments_are_told(words, said):
    with pytest.raises(ConfigError, match=said):
        help_text(['diver', *words])


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


START = """
import sys
from rclpy.node import Node
from sonar_imm.nodes.running import run
sys.argv = ['diver_node']
sys.exit(run(lambda: Node('walker')))
"""
LINK = f'from {Link.__module__} import Link; Link("peer")'


@pytest.mark.parametrize(
    'folders', [{}, {'HOME': '/dev/null'}, {'ROS_LOG_DIR': '/dev/null/log'}], ids=str
)
def test_without_a_folder_for_its_log_a_node_says_what_to_set(folders):
    usual = {k: v for k, v in os.environ.items() if k not in ('HOME', 'ROS_LOG_DIR', 'ROS_HOME')}
    done = subprocess.run(
        [sys.executable, '-c', START], env={**usual, **folders}, capture_output=True, text=True
    )
    assert done.returncode == 2 and 'Traceback' not in done.stderr
    said = done.stderr.splitlines()[-1]
    assert said.startswith('diver_node: ROS cannot keep its log')
    assert said.endswith('set ROS_LOG_DIR to a folder that can be written to')
    if 'ROS_LOG_DIR' in folders:  # a link says the same; logging is set up once for a process
        link = subprocess.run(
            [sys.executable, '-c', LINK], env={**usual, **folders}, capture_output=True, text=True
        )
        assert 'LinkError: ROS cannot keep its log' in link.stderr


@pytest.mark.usefixtures('walker')
def test_robots_in_domains_of_their_own_do_not_hear_each_other(make_bench, monkeypatch):
    """With the same names on one machine: only the domain is another one."""
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    with reserved_domain_id() as one, reserved_domain_id() as other:
        rigs = [Rig(make_bench(domain_id=domain)) for domain in (one, other)]
        rigs[0].send(*map(a_fix, range(1, 6)))
        assert rigs[0].answer == (5, 0, 5) and not rigs[1].node._meter.received
        for rig in rigs:  # and not two each
            assert rig.fix.get_subscription_count() == rig.node.count_publishers('/fix') == 1
