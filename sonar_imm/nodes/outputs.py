# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What a node publishes: tables, the row on ``~/processed``, and displays.

A table of estimates has forty columns or more. rclpy turns each PointField into C and back into
bytes for every message, which takes longer than the numbers in it. `TablePublisher` serialises
once what does not change from one table to the next; only the stamp, the sizes and the data are
put in. The layout of the bytes is that of CDR (the XCDR1 of DDS, little-endian): strings and
sequences after their length, numbers aligned to their size. Whether it holds for a table is asked
of rclpy, once for each layout; where it does not, tables are published as any other message.
"""

from __future__ import annotations

import array
from collections.abc import Callable, Mapping
import struct
from typing import Any

from builtin_interfaces.msg import Time
import numpy as np
from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import PointCloud2

from msg_adapters.displays import Displays, Drawn
from msg_adapters.table import encode_table

from ..estimates import Estimate
from .messages import make

_STAMP = 4
"""Where the stamp stands, behind the four bytes that say how the rest is encoded."""
_TAIL = 9
"""Bytes of row_step, of the length of no data, and of is_dense."""


class TablePublisher:
    """Publishes PointCloud2 tables whose columns and frame seldom change."""

    def __init__(self, publisher: Publisher):
        self._publisher = publisher
        self._like: tuple[Any, ...] = ()
        self._start: bytes | None = None

    def publish(self, message: PointCloud2) -> None:
        """Publish a table; the same as the publisher itself would."""
        # Python looks at identity first, and the fields of a layout are always the same objects.
        if self._like != _of(message):
            self._learn(message)
        self._publisher.publish(message if self._start is None else self._serialised(message))

    def _learn(self, message: PointCloud2) -> None:
        self._like = _of(message)
        empty = PointCloud2(
            header=message.header,
            height=message.height,
            fields=message.fields,
            is_bigendian=message.is_bigendian,
            point_step=message.point_step,
        )
        self._start = serialize_message(empty)[:-_TAIL]
        try:
            same = deserialize_message(self._serialised(message), PointCloud2) == message
        except (RuntimeError, struct.error):
            same = False
        if not same:
            self._start = None

    def _serialised(self, message: PointCloud2) -> bytes:
        made, stamp = bytearray(self._start or b''), message.header.stamp
        struct.pack_into('<iI', made, _STAMP, stamp.sec, stamp.nanosec)
        # Behind the stamp the frame with its length and final zero, then height and width.
        frame = _STAMP + 8 + 4 + len(message.header.frame_id.encode()) + 1
        struct.pack_into('<I', made, (frame + 3) // 4 * 4 + 4, message.width)
        data = memoryview(message.data)
        made += struct.pack('<II', message.row_step, len(data)) + data
        made.append(message.is_dense)
        return bytes(made)


def _of(message: PointCloud2) -> tuple[Any, ...]:
    """What of a table stands before its data, but for the stamp and the width."""
    frame_id = message.header.frame_id
    return frame_id, message.height, message.is_bigendian, message.point_step, message.fields


class ProcessedPublisher:
    """Publishes the row with which a node answers each message: counts, always of the same names.

    Counts are float64, exact to 2^53: a node that runs for years does not wrap. The topic is
    latched, so the row is published whether or not somebody listens: who comes later has to find
    how things stand. The message is made once and costs a few microseconds.
    """

    def __init__(self, publisher: Publisher):
        self._publisher = TablePublisher(publisher)
        self._row: Any = None

    def publish(self, counts: Mapping[str, int], stamp: Any = None) -> None:
        """Publish `counts` since the start of the node; `stamp` is that of the message that is
        answered, None before the first message."""
        if self._row is None:
            columns = {name: np.zeros(1) for name in counts}
            self._row = encode_table(columns, stamp_ns=0, frame_id='', make=make)
        self._row.header.stamp = Time() if stamp is None else stamp
        self._row.data = array.array('B', struct.pack(f'<{len(counts)}d', *counts.values()))
        self._publisher.publish(self._row)


class DisplayPublisher:
    """Publishes what is drawn of estimates, to those who listen; `advertise` offers a topic of a
    type and gives its publisher."""

    def __init__(self, displays: Displays, advertise: Callable[[str, str], Any]):
        self._displays = displays
        self._publishers = {
            name: advertise(type_name, f'~/{name}')
            for name, type_name in self._displays.topics.items()
        }

    def publish(self, newest: Estimate) -> None:
        """Draw the newest estimate."""
        self._send(self._displays.of(newest, make, self._listeners))

    def clear(self) -> None:
        """Take away what is drawn."""
        self._send(self._displays.forget(make))

    def _listeners(self, name: str) -> int:
        count: int = self._publishers[name].get_subscription_count()
        return count

    def _send(self, drawn: Drawn) -> None:
        for name, message in drawn:
            self._publishers[name].publish(message)
