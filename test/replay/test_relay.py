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

"""Handing on what running nodes publish: only what is watched, as it was sent."""

import pytest
from rclpy.serialization import serialize_message
from std_msgs.msg import String

from sonar_imm.nodes.qos import input_qos, latched_qos
from sonar_imm_tools.recordings.messages import message_definition
from sonar_imm_tools.replay import listening
from sonar_imm_tools.replay.harness import reserved_domain_id
from sonar_imm_tools.replay.link import Link
from sonar_imm_tools.replay.listening import Relay

LIMIT = 300  # steps of 50 ms


class Rig:
    """A relay and a talker, each with a link of its own in one domain."""

    def __init__(self, talker, link, topics=()):
        self.talker = talker.node
        self.offered, self.gone, self.arrived, self.watching = {}, [], [], set()
        self.relay = Relay(
            link,
            topics,
            appeared=lambda name, kind, text: self.offered.update({name: (kind, text)}),
            vanished=self.gone.append,
            received=lambda *message: self.arrived.append(message),
            watched=self.watching.__contains__,
        )

    def until(self, predicate):
        for _ in range(LIMIT):
            if predicate():
                return
            self.relay.step(0.05)
        pytest.fail('what was waited for did not happen')


@pytest.fixture
def make_rig(monkeypatch):
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    monkeypatch.setattr(listening, 'RELAY_LOOK', 0.05)
    with (
        reserved_domain_id() as domain,
        Link('talker', domain_id=domain) as talker,
        Link('viewer', domain_id=domain) as link,
    ):
        yield lambda *topics: Rig(talker, link, topics)


def test_a_topic_is_heard_only_while_it_is_watched(make_rig):
    rig = make_rig()
    publisher = rig.talker.create_publisher(String, '/talk', input_qos(10))
    rig.until(lambda: '/talk' in rig.offered)
    assert rig.offered['/talk'] == (
        'std_msgs/msg/String',
        message_definition('std_msgs/msg/String'),
    )
    assert publisher.get_subscription_count() == 0
    rig.watching.add('/talk')
    rig.until(publisher.get_subscription_count)
    message = String(data='hello')
    publisher.publish(message)
    rig.until(lambda: rig.arrived)
    ((name, _, raw),) = rig.arrived
    assert (name, raw) == ('/talk', serialize_message(message))
    rig.watching.clear()
    rig.until(lambda: not publisher.get_subscription_count())
    rig.talker.destroy_publisher(publisher)
    rig.until(lambda: '/talk' in rig.gone)
    assert '/talk' not in rig.relay.topics


def test_what_was_sent_before_and_is_kept_is_heard(make_rig):
    rig = make_rig('/kept')
    rig.talker.create_publisher(String, '/kept', latched_qos()).publish(String(data='early'))
    rig.watching.add('/kept')
    rig.until(lambda: rig.arrived)
    assert list(rig.offered) == ['/kept']  # nothing but what was asked for


def test_a_type_that_is_not_installed_is_said_once(make_rig, monkeypatch):
    rig = make_rig('/alien')
    rig.talker.create_publisher(String, '/alien', 10)
    names = [('/alien', ['alien_msgs/msg/Ship'])]
    monkeypatch.setattr(rig.relay._link.node, 'get_topic_names_and_types', lambda: names)
    rig.until(lambda: rig.relay.problems)
    assert rig.relay.problems == {
        '/alien': 'topic /alien is not shown: the message type alien_msgs/msg/Ship is not '
        'installed here'
    }
    assert rig.relay.topics == []


@pytest.mark.parametrize(
    'name',
    [
        'diagnostic_msgs/msg/DiagnosticArray',
        'nav_msgs/msg/Odometry',
        'sensor_msgs/msg/PointCloud2',
        'shape_msgs/msg/SolidPrimitive',
    ],
)
def test_a_definition_read_off_a_class_is_that_of_the_msg_files(name):
    assert blocks(listening._definition(name)) == blocks(message_definition(name))


def blocks(text):
    """The fields of each type, {type name or '': ['kind name', ...]}, without constants."""
    found = {}
    for part in text.split('=' * 80 + '\n'):
        head, _, rest = part.partition('\n') if part.startswith('MSG: ') else ('', '', part)
        lines = [line for line in rest.splitlines() if line.strip() and '=' not in line]
        found[head.removeprefix('MSG: ')] = [line.replace('/msg/', '/') for line in lines]
    return found
