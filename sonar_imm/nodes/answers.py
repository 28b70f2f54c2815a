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

"""The row on ``~/processed`` with which a node answers every message it takes."""

from __future__ import annotations

import array
from collections.abc import Mapping
import struct
from typing import Any

from builtin_interfaces.msg import Time
import numpy as np
from rclpy.publisher import Publisher

from msg_adapters.table import encode_table

from .messages import make
from .tables import TablePublisher


class Answers:
    """Publishes one row of counts, always of the same names, after every message.

    Counts are float64, exact to 2^53: a node that runs for years does not wrap.
    It is latched, so it is published whether or not somebody listens: who comes later has to
    find how things stand. The message is made once and costs a few microseconds.
    """

    def __init__(self, publisher: Publisher):
        self._publisher = TablePublisher(publisher)
        self._row: Any = None

    def say(self, counts: Mapping[str, int], stamp: Any = None) -> None:
        """Publish `counts` since the start of the node; `stamp` is that of the message that is
        answered, None for the first word of a node."""
        if self._row is None:
            columns = {name: np.zeros(1) for name in counts}
            self._row = encode_table(columns, stamp_ns=0, frame_id='', make=make)
        self._row.header.stamp = Time() if stamp is None else stamp
        self._row.data = array.array('B', struct.pack(f'<{len(counts)}d', *counts.values()))
        self._publisher.publish(self._row)
