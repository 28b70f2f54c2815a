# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The recordings that faults are done to: for each node the first messages of a shipped bag."""

from collections.abc import Callable
import copy
import functools
from pathlib import Path
from typing import Any

from attrs import evolve, frozen
from rclpy.serialization import deserialize_message

from msg_adapters.inputs import inputs_of
from sonar_imm.nodes.messages import message_class
from sonar_imm_tools.recordings.measurements import fitting_topics
from sonar_imm_tools.recordings.reader import BagReader

BAGS = Path(__file__).parents[3] / 'bags'
SECOND = 10**9


@frozen(eq=False)
class Message:
    """One message to send. primary: whether estimates are made of such messages; origin_ns: the
    stamp of the message of the recording that it stands for."""

    topic: str
    content: Any
    primary: bool
    origin_ns: int

    @property
    def stamp_ns(self):
        stamp = self.content.header.stamp
        return stamp.sec * SECOND + stamp.nanosec

    def changed(self, change):
        """The message with a changed copy of its content."""
        content = copy.deepcopy(self.content)
        change(content)
        return evolve(self, content=content)

    def moved(self, seconds):
        """The message with a stamp that is later by `seconds`."""
        stamp_ns = self.stamp_ns + round(seconds * SECOND)

        def move(content):
            content.header.stamp.sec, content.header.stamp.nanosec = divmod(stamp_ns, SECOND)

        return self.changed(move)


Step = Message | Callable[[Any], None]
"""What is sent, or done to the rig between two messages."""


@frozen
class Case:
    """What one system is tried with. primary: the input that estimates are made of; count: how
    many messages of it; repeat: how often a recording that is short is played on, its stamps
    moved; settle: messages of the primary input within which estimates are as if nothing had been,
    after the tracker lost all it knew; window: seconds by which a message may be late."""

    system: str
    bag: str
    primary: str
    count: int
    settle: int
    window: float
    repeat: int = 1

    @property
    def period(self):
        """Seconds between two messages of the primary input."""
        first, *_, last = (each.origin_ns for each in self.messages() if each.primary)
        return (last - first) / (self.count - 1) / SECOND

    def messages(self):
        """What is sent when nothing goes wrong."""
        return _messages(self)

    def thirds(self):
        """The messages before, during and after a fault, as many of the primary input each."""
        messages = self.messages()
        places = [k for k, message in enumerate(messages) if message.primary]
        first, second = places[len(places) // 3], places[2 * len(places) // 3]
        return list(messages[:first]), list(messages[first:second]), list(messages[second:])


@functools.cache
def _messages(case):
    with BagReader(BAGS / case.bag) as bag:
        names, recorded = {entry.name for entry in inputs_of(case.system)}, []
        there = {topic.name: topic.name.lstrip('/') for topic in bag.topics}
        wanted = {topic: name for topic, name in there.items() if name in names}
        inputs = fitting_topics(bag, case.system, wanted)
        for item in bag.messages([*inputs]):
            content = deserialize_message(bytes(item.raw), message_class(item.type_name))
            name = inputs[item.topic].name
            recorded.append(Message(name, content, name == case.primary, 0))
    stamps = [item.stamp_ns for item in recorded if item.primary]
    length = stamps[-1] - stamps[0] + (stamps[-1] - stamps[0]) // (len(stamps) - 1)
    played = []
    for turn in range(case.repeat):
        for each in recorded:
            again = each.moved(turn * length / SECOND)
            played.append(evolve(again, origin_ns=again.stamp_ns))
            if sum(item.primary for item in played) == case.count:
                return tuple(played)
    raise ValueError(f'{case.bag} holds less than {case.count} messages on {case.primary}')


CASES = {
    case.system: case
    for case in (
        Case('diver', 'diver_table1', 'fix', 60, 10, 10.0),
        Case('obstacle', 'obstacle_movers', 'detections', 48, 10, 5.0),
        Case('bathymetry', 'bathymetry_paper', 'snapshot', 21, 1, 0.0, 3),
        Case('fathometer', 'fathometer_drift', 'trace', 36, 5, 0.0),
    )
}
