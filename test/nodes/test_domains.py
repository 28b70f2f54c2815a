# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Robots in domains of their own, on one machine."""

from helpers.rig import a_fix, FIX
import pytest
import rclpy

from sonar_imm.nodes.base import TrackerNode
from sonar_imm.nodes.messages import message_class
from sonar_imm.nodes.qos import output_qos
from sonar_imm_tools.replay.harness import reserved_domain_id


@pytest.mark.usefixtures('walker')
def test_robots_in_domains_of_their_own_do_not_hear_each_other(monkeypatch):
    """With the same names on one machine: only the domain is another one."""
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    no_signals = rclpy.signals.SignalHandlerOptions.NO
    with reserved_domain_id() as item, reserved_domain_id() as another:
        assert item != another
        contexts = [rclpy.Context(), rclpy.Context()]
        for context, domain in zip(contexts, (item, another)):
            rclpy.init(context=context, domain_id=domain, signal_handler_options=no_signals)
        executors = [rclpy.executors.SingleThreadedExecutor(context=each) for each in contexts]
        trackers = [TrackerNode('walker', context=each) for each in contexts]
        peers = [rclpy.node.Node('peer', context=each) for each in contexts]
        fixes = [each.create_publisher(message_class(FIX), '/fix', output_qos()) for each in peers]
        for executor, *nodes in zip(executors, trackers, peers):
            for node in nodes:
                executor.add_node(node)
        try:
            for second in range(1, 600):
                for executor in executors:
                    executor.spin_once(timeout_sec=0.02)
                counts = [each.get_subscription_count() for each in fixes]
                if counts == [1, 1]:
                    fixes[0].publish(a_fix(float(second)))
                if trackers[0]._meter.received['fix'] >= 5:
                    break
            assert counts == [1, 1]  # and not two each
            assert trackers[0]._meter.received['fix'] >= 5
            assert not trackers[1]._meter.received
            assert [each.count_publishers('/fix') for each in trackers] == [1, 1]
        finally:
            for node in (*trackers, *peers):
                node.destroy_node()
            for context in contexts:
                rclpy.try_shutdown(context=context)
