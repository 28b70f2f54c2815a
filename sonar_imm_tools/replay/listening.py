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

"""Hearing running nodes, for programs that show them: their tables, or any topic as it is sent."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator
import time
from typing import Any

from attrs import frozen
import numpy as np
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription
from sensor_msgs.msg import PointCloud2

from msg_adapters.headers import stamp_ns
from msg_adapters.table import decode_table
from sonar_imm.measurements import Rejection
from sonar_imm.nodes.messages import message_class
from sonar_imm.nodes.qos import input_qos, latched_qos, output_qos
from sonar_imm.parameters import did_you_mean

from ..recordings.messages import message_definition
from .link import Link, LinkError

TABLE = 'sensor_msgs/msg/PointCloud2'
TABLES_LOOK, RELAY_LOOK = 0.2, 1.0
"""Seconds between two looks at what topics there are."""
_TABLES_DEPTH, _RELAY_DEPTH = 50, 10
_PLAIN = {
    'float': 'float32',
    'double': 'float64',
    'boolean': 'bool',
    'octet': 'byte',
}


@frozen(eq=False)
class ReceivedTable:
    """One message of a table: its columns by name, (rows,) or (rows, count), or the sentence why
    it is none."""

    topic: str
    stamp_ns: int = 0
    frame_id: str = ''
    columns: dict[str, np.ndarray] | None = None
    problem: str = ''


class TableListener:
    """Hears `topics`, or, when there are none, every topic that ends in ``/estimate``."""

    def __init__(self, link: Link, topics: tuple[str, ...] = ()):
        self._link = link
        self._wanted = tuple(f'/{name.lstrip("/")}' for name in topics)
        self._received: deque[ReceivedTable] = deque()
        self._subscriptions: dict[str, object] = {}

    @property
    def topics(self) -> list[str]:
        """What is listened to."""
        return list(self._subscriptions)

    def tables(self, timeout: float) -> Iterator[ReceivedTable | None]:
        """Yield tables as they come, and None now and then while none does.

        Raises `LinkError` when none has come within `timeout` seconds from the start, and for a
        topic of another type.
        """
        end = time.monotonic() + timeout
        silent = True
        while True:
            self._look()
            if not self._link.wait_for(lambda: self._received, TABLES_LOOK):
                if silent and time.monotonic() > end:
                    raise LinkError(self._silence(timeout))
                yield None
            while self._received:
                silent = False
                yield self._received.popleft()

    def _look(self) -> None:
        """Subscribe to what is there now and was not."""
        for name, types in self._link.node.get_topic_names_and_types():
            wanted = name in self._wanted if self._wanted else self._is_meant(name, types)
            if not wanted or name in self._subscriptions:
                continue
            if TABLE not in types:
                raise LinkError(
                    f'{name} is of type {types[0]} and no table; ros2 topic echo {name} shows it'
                )
            self._subscriptions[name] = self._link.node.create_subscription(
                PointCloud2, name, self._reader(name), input_qos(_TABLES_DEPTH)
            )

    def _reader(self, name: str) -> Callable[[PointCloud2], None]:
        def take(message: PointCloud2) -> None:
            try:
                self._received.append(
                    ReceivedTable(
                        topic=name,
                        stamp_ns=stamp_ns(message),
                        frame_id=str(message.header.frame_id),
                        columns=decode_table(message),
                    )
                )
            except Rejection as rejection:
                self._received.append(ReceivedTable(topic=name, problem=rejection.sentence))

        return take

    def _silence(self, timeout: float) -> str:
        there = self._link.node.get_topic_names_and_types()
        waited = f'within {timeout:g} s'
        if silent := [name for name in self._subscriptions if self._publishers(name)]:
            return f'nothing was published on {", ".join(silent)} {waited}'
        if self._wanted:
            names = [name for name, types in there if TABLE in types and self._publishers(name)]
            missing = ', '.join(self._wanted)
            hint = ''.join(did_you_mean(name, names) for name in self._wanted[:1])
            return f'nobody publishes {missing} {waited}{hint}; is ROS_DOMAIN_ID the same?'
        return (
            f'no topic that ends in /estimate was found {waited}; is a node running, and '
            'ROS_DOMAIN_ID the same?'
        )

    def _publishers(self, name: str) -> int:
        return int(self._link.node.count_publishers(name))

    def _is_meant(self, name: str, types: list[str]) -> bool:
        parts = name.split('/')
        return parts[-1] == 'estimate' and 'truth' not in parts and TABLE in types


class Relay:
    """Hands on the messages of the topics that run in the ROS domain of `link`. A topic is
    subscribed to only while somebody watches it, and with as little as its publishers offer, so
    that looking costs the nodes nothing else.

    topics: only these, all when empty. appeared, vanished: called with name and type of a topic,
    and with its name; received: with the name, the time in nanoseconds and the CDR bytes of a
    message; watched: whether a topic is to be heard now. problems: why topics are not handed on.
    """

    def __init__(
        self,
        link: Link,
        topics: Collection[str],
        *,
        appeared: Callable[[str, str, str], None],
        vanished: Callable[[str], None],
        received: Callable[[str, int, bytes], None],
        watched: Callable[[str], bool],
    ):
        self._link = link
        self._wanted = set(topics)
        self._appeared, self._vanished = appeared, vanished
        self._received, self._watched = received, watched
        self._types: dict[str, str] = {}
        self._subscriptions: dict[str, Subscription] = {}
        self._next_look = 0.0
        self.problems: dict[str, str] = {}

    @property
    def topics(self) -> list[str]:
        """Names of the topics that are handed on when somebody watches them."""
        return sorted(self._types)

    def step(self, seconds: float) -> None:
        """Hand on what comes within `seconds`; looks at the graph now and then."""
        if time.monotonic() >= self._next_look:
            self._look()
            self._next_look = time.monotonic() + RELAY_LOOK
        self._follow_watchers()
        self._link.spin(seconds)

    def _look(self) -> None:
        """See which topics there are."""
        node = self._link.node
        here = {
            name: types[0]
            for name, types in node.get_topic_names_and_types()
            if (not self._wanted or name in self._wanted)
            and len(types) == 1
            and node.count_publishers(name)
        }
        for name in self._types.keys() - here.keys():
            self._drop(name)
            del self._types[name]
            self._vanished(name)
        for name in sorted(here.keys() - self._types.keys() - self.problems.keys()):
            try:
                definition = message_definition(here[name]) or _definition(here[name])
            except ImportError as error:
                self.problems[name] = f'topic {name} is not shown: {error}'
                continue
            self._types[name] = here[name]
            self._appeared(name, here[name], definition)

    def _follow_watchers(self) -> None:
        for name in self._types:
            if self._watched(name) and name not in self._subscriptions:
                self._subscriptions[name] = self._subscribe(name)
            elif name in self._subscriptions and not self._watched(name):
                self._drop(name)

    def _subscribe(self, name: str) -> Subscription:
        def take(raw: bytes) -> None:
            self._received(name, time.time_ns(), bytes(raw))

        return self._link.node.create_subscription(
            message_class(self._types[name]), name, take, self._qos(name), raw=True
        )

    def _qos(self, name: str) -> QoSProfile:
        """Reliable, and with what was sent before, where every publisher offers that."""
        offered = [info.qos_profile for info in self._link.node.get_publishers_info_by_topic(name)]

        def all_are(field: str, policy: Any) -> bool:
            return bool(offered) and all(getattr(profile, field) == policy for profile in offered)

        if not all_are('reliability', ReliabilityPolicy.RELIABLE):
            return input_qos(_RELAY_DEPTH)
        kept = all_are('durability', DurabilityPolicy.TRANSIENT_LOCAL)
        return latched_qos(_RELAY_DEPTH) if kept else output_qos(_RELAY_DEPTH)

    def _drop(self, name: str) -> None:
        subscription = self._subscriptions.pop(name, None)
        if subscription is not None:
            self._link.node.destroy_subscription(subscription)


def _definition(type_name: str) -> str:
    """The ``ros2msg`` text of a message type that is installed, read off its Python class.

    Raises ImportError when it is not installed.
    """
    done: dict[str, list[str]] = {}
    waiting = [type_name]
    while waiting:
        name = waiting.pop(0)
        if name in done:
            continue
        done[name] = []
        cls: Any = message_class(name)
        for field, kind in cls.get_fields_and_field_types().items():
            element, suffix = _element(kind)
            if '/' in element:
                waiting.append(element)
            done[name].append(f'{_PLAIN.get(element, element)}{suffix} {field}')
    parts = ['\n'.join(done.pop(type_name))]
    parts += [f'{"=" * 80}\nMSG: {name}\n' + '\n'.join(lines) for name, lines in done.items()]
    return '\n'.join(parts) + '\n'


def _element(kind: str) -> tuple[str, str]:
    """Split the kind of a field into its element and the brackets of an array."""
    if kind.startswith('sequence<'):
        element, _, bound = kind[len('sequence<') : -1].partition(',')
        return element.strip(), f'[<={bound.strip()}]' if bound else '[]'
    element, bracket, size = kind.partition('[')
    return element, bracket + size
