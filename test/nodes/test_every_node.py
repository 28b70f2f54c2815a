# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""What every node promises, checked alike for all systems: one process, real rclpy."""

import importlib

from helpers.scenes import small_scene
import pytest
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import SetBool, Trigger

from msg_adapters.estimates import write_estimate
from msg_adapters.inputs import inputs_of
from msg_adapters.table import decode_table
from sonar_imm.nodes.base import TrackerNode
from sonar_imm.nodes.messages import make, message_class
from sonar_imm.nodes.qos import latched_qos, lockstep_qos
from sonar_imm.trackers import SYSTEMS

MESSAGES = 30


class Driven:
    """The node of a system, fed with a small scene in lock-step."""

    def __init__(self, bench, system):
        self.bench, self.system = bench, system
        config, scene = small_scene(system, 3)
        settings = config.instruments()
        self.config = system.config_type()(**settings)
        # On a busy machine a message may wait: here it is used all the same.
        overrides = [Parameter('max_wait', value=0.0)]
        for name, value in settings.items():
            given = list(value) if isinstance(value, tuple) else value
            overrides.append(Parameter(name, value=given))
        node = TrackerNode(system.name, context=bench.context, parameter_overrides=overrides)
        self.node = bench.add(node)
        self.estimates = bench.listen(PointCloud2, f'/{system.name}/estimate', lockstep_qos())
        self.answers = bench.listen(PointCloud2, f'/{system.name}/processed', latched_qos())
        inputs = {topic.measurement: topic for topic in inputs_of(system.name)}
        given = [item.measurement for item in scene.measurements[:MESSAGES]]
        self.messages = [(inputs[type(m)], inputs[type(m)].write(m, make)) for m in given]
        types = {topic.name: (topic, type(message)) for topic, message in self.messages}
        self.publishers = {
            name: bench.publisher(kind, topic.prefix + name)
            for name, (topic, kind) in types.items()
        }
        bench.spin_until(lambda: self.answers)

    @property
    def answer(self):
        """The last row of ~/processed: messages, refused, estimates."""
        columns = decode_table(self.answers[-1])
        return tuple(int(columns[name][0]) for name in ('messages', 'refused', 'estimates'))

    def send(self, messages):
        """Publish one after another, each when the one before was answered. Gives what was
        published of them."""
        start = len(self.estimates)
        for topic, message in messages:
            answered = self.answer[0]
            self.publishers[topic.name].publish(message)
            self.bench.spin_until(lambda before=answered: self.answer[0] > before)
        self.bench.spin_until(lambda: len(self.estimates) >= self.answer[2])
        return [bytes(message.data) for message in self.estimates[start:]]

    def offline(self):
        """What the tracker makes of the same messages, without a node."""
        tracker, made = self.system.build(self.config), []
        for topic, message in self.messages:
            type_name = next(n for n in topic.readers if message_class(n) is type(message))
            read = topic.reader(type_name, 'enu', self.config.as_dict(), topic.name)
            sent = deserialize_message(serialize_message(message), type(message))
            made += tracker.process(read(sent))
        return [bytes(write_estimate(estimate, make).data) for estimate in made]


@pytest.fixture(params=SYSTEMS)
def driven(request, make_bench):
    return Driven(make_bench(), SYSTEMS[request.param])


def test_live_is_offline_hostile_input_is_refused_and_services_answer(driven):
    """One start of the node, since starting takes longest."""
    name = driven.system.name
    live = driven.send(driven.messages)
    assert live and live == driven.offline()

    taken, refused, published = driven.answer
    assert refused == 0
    hostile = [(topic, type(message)()) for topic, message in driven.messages[:3]]
    assert driven.send(hostile) == []
    assert driven.answer == (taken + len(hostile), len(hostile), published)

    response = driven.bench.call(SetBool, f'/{name}/enable', SetBool.Request(data=False))
    assert response.success
    assert driven.send(driven.messages) == []
    driven.bench.call(SetBool, f'/{name}/enable', SetBool.Request(data=True))

    assert driven.bench.call(Trigger, f'/{name}/reset', Trigger.Request()).success
    assert driven.send(driven.messages) == live

    assert callable(importlib.import_module(driven.system.node).main)
