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

"""Lock-step through two nodes: one makes an input of the other, as a detector does of images.

A message for the first node is answered there; for each message that this one published since, the
second has to answer too.
"""

from __future__ import annotations

from collections.abc import Iterable
import time
from typing import Any

from rclpy.publisher import Publisher

from msg_adapters.table import decode_table

from .link import LinkError, MATCH_LIMIT
from .lockstep import Counts, LockStep


class FirstStep(LockStep):
    """Keeps step with a node whose output another one hears. listeners: how many do."""

    listeners = 0

    def _answered(self, message: Any) -> None:
        super()._answered(message)
        self.listeners = int(decode_table(message)['listeners'][0])


class Chain:
    """Keeps step with two nodes; takes the place of a `LockStep` in the player.

    fed: names of the published topics that the first node hears.
    """

    def __init__(self, first: FirstStep, second: LockStep, fed: Iterable[str]):
        self.first, self.second = first, second
        self._fed = frozenset(fed)

    @property
    def counts(self) -> Counts:
        """Messages taken by either node, but for those that the first sent to the second; what
        both refused; estimates of the second."""
        first, second = self.first.counts, self.second.counts
        return Counts(
            first.messages + second.messages - first.estimates,
            first.refused + second.refused,
            second.estimates,
        )

    @property
    def delays(self) -> list[float]:
        return self.second.delays

    def connect(self, publishers: Iterable[Publisher], limit: float = MATCH_LIMIT) -> set[str]:
        """As `LockStep.connect`, for both nodes and for what one sends to the other."""
        publishers = list(publishers)
        connected = self.first.connect([p for p in publishers if p.topic_name in self._fed], limit)
        connected |= self.second.connect(
            [p for p in publishers if p.topic_name not in self._fed], limit
        )
        if not self.first.wait_for(lambda: self.first.listeners):
            raise LinkError('the second node does not hear what the first one makes')
        return connected

    def step(self, publisher: Publisher, message: Any) -> None:
        """Publish `message` and wait for all answers. Raises `LinkError` without one."""
        if publisher.topic_name not in self._fed:
            self.second.step(publisher, message)
            return
        sent, made = time.monotonic(), self.first.counts.estimates
        self.first.step(publisher, message)
        fresh = self.first.counts.estimates - made
        if fresh:
            self.second.follow(fresh, publisher.topic_name, sent)
