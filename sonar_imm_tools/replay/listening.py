# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The tables that running nodes publish, for programs that show them."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from functools import partial
import time

from attrs import frozen
import numpy as np
from sensor_msgs.msg import PointCloud2

from msg_adapters.headers import stamp_ns
from msg_adapters.table import decode_table
from sonar_imm.measurements import Rejection
from sonar_imm.nodes.qos import input_qos
from sonar_imm.parameters import did_you_mean

from .link import Link, LinkError

TABLE = 'sensor_msgs/msg/PointCloud2'
LOOK_SECONDS = 0.2
"""Between two looks at what topics there are."""
_DEPTH = 50


@frozen(eq=False)
class ReceivedTable:
    """One message of a table: columns by name, (rows,) or (rows, count), or why it is none."""

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
            if not self._link.wait_for(lambda: self._received, LOOK_SECONDS):
                if silent and time.monotonic() > end:
                    raise LinkError(self._silence(timeout))
                yield None
            while self._received:
                silent = False
                yield self._received.popleft()

    def _look(self) -> None:
        """Subscribe to what is there now and was not."""
        for name, types in self._link.node.get_topic_names_and_types():
            parts = name.split('/')
            ours = parts[-1] == 'estimate' and 'truth' not in parts and TABLE in types
            wanted = name in self._wanted if self._wanted else ours
            if not wanted or name in self._subscriptions:
                continue
            if TABLE not in types:
                raise LinkError(
                    f'{name} is of type {types[0]} and no table; ros2 topic echo {name} shows it'
                )
            self._subscriptions[name] = self._link.node.create_subscription(
                PointCloud2, name, partial(self._take, name), input_qos(_DEPTH)
            )

    def _take(self, name: str, message: PointCloud2) -> None:
        try:
            columns, frame_id = decode_table(message), str(message.header.frame_id)
            table = ReceivedTable(name, stamp_ns(message), frame_id, columns)
        except Rejection as rejection:
            table = ReceivedTable(topic=name, problem=rejection.sentence)
        self._received.append(table)

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
