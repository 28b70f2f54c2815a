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

"""How many messages of an input never reached the node.

A publisher numbers what it sends. A number that is left out is a message that was lost: on the
network, or in the queue of the node, where a new message pushes out the oldest. The middleware
says nothing of the latter, so that a node at its limit would look healthy.

The number comes with each message, the publisher's identity does not. So each publisher is known
by the last number that came from it, and a message belongs to the one it continues, or, after a
gap, to the one with the smallest gap. In doubt nothing is counted: the count is a lower bound.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
import time
from typing import Any


class SequenceGaps:
    """Gaps in the numbers of the messages of one topic.

    lost: messages missed so far. numbered: whether the middleware tells numbers; None before the
    first message.
    """

    def __init__(self, publisher_count: Callable[[], int]):
        """`publisher_count` tells how many publishers are heard now; asked at a gap only."""
        self.lost = 0
        self.numbered: bool | None = None
        self._publisher_count = publisher_count
        self._last: list[int] = []
        """The last number of each publisher, that of the message before last."""
        self._since_ns = 0

    def heard(self, info: Mapping[str, Any]) -> int:
        """Take the info of a message, as rclpy gives it; returns how many were lost before."""
        number = info['publication_sequence_number']
        last = self._last
        if last and last[-1] + 1 == number:
            last[-1] = number
            return 0
        self.numbered = number is not None
        if number is None or 0 < info['received_timestamp'] < self._since_ns:
            return 0  # the latter was in the queue when its publisher left, or another one did
        gap = self._continue(number)
        self.lost += gap
        return gap

    def publisher_left(self) -> None:
        """Which one is not known, so all that are left are to be known anew."""
        self._last.clear()
        self._since_ns = time.time_ns()

    def _continue(self, number: int) -> int:
        """Find the publisher of message `number`, put it last; returns how many are missing."""
        last = self._last
        before = max((one for one in last if one < number), default=None)
        if before is None or before + 1 != number:
            if len(last) < self._publisher_count():
                last.append(number)
                return 0
            if before is None:  # one of them has started again
                last[:] = [*last[1:], number]
                return 0
        last.remove(before)
        last.append(number)
        return number - before - 1
