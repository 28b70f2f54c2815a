# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.
"""What every node promises, checked alike for all systems: one process, real rclpy."""

from helpers.node_bench import Driven
from helpers.scenes import SMALL, smaller_scene
import pytest
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message
from std_srvs.srv import SetBool, Trigger

from msg_adapters.estimates import write_estimate
from msg_adapters.inputs import inputs_of
from sonar_imm.nodes.base import TrackerNode
from sonar_imm.nodes.messages import make, message_class
from sonar_imm.trackers import SYSTEMS

MESSAGES = 60


class Fed(Driven):
    """The node of a system, fed with a small scene in lock-step."""

    def __init__(self, bench, system, scenario):
        self.system = system
        config, scene = smaller_scene(system, scenario, 3)
        settings = config.instruments()
        self.config = system.config_type()(**settings)
        # On a busy machine a message may wait: here it is used all the same.
        overrides = [Parameter('max_wait', value=0.0)]
        for name, value in settings.items():
            given = list(value) if isinstance(value, tuple) else value
            overrides.append(Parameter(name, value=given))
        node = bench.start(TrackerNode, system.name, parameter_overrides=overrides)
        inputs = {topic.measurement: topic for topic in inputs_of(system.name)}
        given = [item.measurement for item in scene.measurements[:MESSAGES]]
        self.messages = [(inputs[type(m)], inputs[type(m)].write(m, make)) for m in given]
        self.publishers = {}
        for topic, message in self.messages:
            if topic.name not in self.publishers:
                made = bench.publisher(type(message), topic.full_name(system.name))
                self.publishers[topic.name] = made
        super().__init__(bench, node, f'/{system.name}')

    def send(self, messages):
        """What was published of them."""
        start = len(self.estimates)
        for topic, message in messages:
            self.publish(self.publishers[topic.name], message)
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


@pytest.mark.parametrize('name, scenario', [*SMALL.items(), ('obstacle', 'late')])
def test_live_is_offline_hostile_input_is_refused_and_services_answer(make_bench, name, scenario):
    """One start of the node, since starting takes longest."""
    driven = Fed(make_bench(), SYSTEMS[name], scenario)
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
