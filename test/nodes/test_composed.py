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

"""Several nodes in one process: two robots in namespaces, and robots in domains of their own."""

from helpers.rig import a_fix, FIX
from helpers.scenes import small_scene
import pytest
import rclpy
from rclpy.parameter import Parameter
from sensor_msgs.msg import PointCloud2

from msg_adapters.estimates import write_estimate
from msg_adapters.inputs import inputs_of
from sonar_imm.intake import Intake
from sonar_imm.nodes import composed
from sonar_imm.nodes.base import TrackerNode
from sonar_imm.nodes.diver import DiverNode
from sonar_imm.nodes.messages import make, message_class
from sonar_imm.nodes.qos import latched_qos, lockstep_qos, output_qos
from sonar_imm.nodes.running import MessagesFirst
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.replay.harness import reserved_domain_id

MESSAGES = 25


class Robot:
    """A diver node in a namespace, what is sent to it, and what it has to answer."""

    def __init__(self, bench, namespace, seed):
        self.bench = bench
        config, scene = small_scene(SYSTEMS['diver'], seed)
        settings = config.instruments()
        self.config = SYSTEMS['diver'].config_type()(**settings)
        overrides = [
            Parameter(name, value=list(value) if isinstance(value, tuple) else value)
            for name, value in settings.items()
        ]
        name = f'{namespace}/diver'
        self.node = composed.make(name, context=bench.context, parameter_overrides=overrides)
        bench.add(self.node)
        self.estimates = bench.listen(PointCloud2, f'{name}/estimate', lockstep_qos())
        self.answers = bench.listen(PointCloud2, f'{name}/processed', latched_qos())
        entries = {topic.measurement: topic for topic in inputs_of('diver')}
        self.messages = [
            (entries[type(item.measurement)], item.measurement)
            for item in scene.measurements[:MESSAGES]
        ]
        self.publishers = {
            entry.name: bench.peer.create_publisher(
                message_class(next(iter(entry.readers))), f'{namespace}/{entry.name}', output_qos()
            )
            for entry, _ in self.messages
        }

    def ready(self):
        counts = [each.get_subscription_count() for each in self.publishers.values()]
        return bool(self.answers) and all(counts)

    def send(self, k):
        entry, measurement = self.messages[k]
        before = self.node._meter.received.total()
        self.publishers[entry.name].publish(entry.write(measurement, make))
        self.bench.spin_until(lambda: self.node._meter.received.total() > before)

    def expected(self):
        intake = Intake(SYSTEMS['diver'].build(self.config))
        made = []
        for entry, measurement in self.messages:
            reader = next(iter(entry.readers.values()))
            admitted = intake.admit(reader(entry.write(measurement, make)))
            made += intake.tracker.process(admitted)
        return [write_estimate(each, make) for each in made]


def test_two_robots_in_one_executor_have_the_bytes_of_each_alone(make_bench):
    bench = make_bench()
    bench.executor = MessagesFirst(context=bench.context)
    bench.executor.add_node(bench.peer)
    robots = [Robot(bench, f'/auv{k}', k) for k in (1, 2)]
    bench.spin_until(lambda: all(robot.ready() for robot in robots))
    for k in range(MESSAGES):
        for robot in robots:
            robot.send(k)
    expected = [robot.expected() for robot in robots]
    assert expected[0] and expected[0] != expected[1]
    for robot, wanted in zip(robots, expected):
        bench.spin_until(lambda robot=robot, wanted=wanted: len(robot.estimates) >= len(wanted))
        assert robot.estimates == wanted


def test_a_name_says_namespace_and_kind_of_a_node(make_bench):
    bench = make_bench()
    node = bench.add(composed.make('/harbour/north/diver', context=bench.context))
    assert isinstance(node, DiverNode)
    assert node.get_fully_qualified_name() == '/harbour/north/diver'
    alone = bench.add(composed.make('diver', context=bench.context))
    assert alone.get_fully_qualified_name() == '/diver'
    with pytest.raises(ConfigError, match=r"there is no node 'divers' \(did you mean 'diver'"):
        composed.make('/auv1/divers', context=bench.context)
    with pytest.raises(ConfigError, match="'/auv-1/diver': .*namespace"):
        composed.make('/auv-1/diver', context=bench.context)
    wrong = [Parameter('sound_speed', value=-1.0)]
    with pytest.raises(ConfigError, match="/auv2/diver: .*'sound_speed'"):
        composed.make('/auv2/diver', context=bench.context, parameter_overrides=wrong)


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
