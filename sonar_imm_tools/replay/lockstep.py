# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Lock-step: send one message, wait until the node has answered it, then the next.

ROS 2 has no deterministic replay: a fast player overruns queues, and what is lost depends on the
machine. A node of this package answers every message with a row on ``~/processed`` after the
estimates it made, also when it made none. The row counts since the start of the node, so it says
how many estimates are still on their way, and that nobody else feeds the node meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
import time
from typing import Any, NamedTuple

from rclpy.publisher import Publisher
from rclpy.serialization import deserialize_message
from rclpy.subscription import Subscription
from sensor_msgs.msg import PointCloud2

from msg_adapters.estimates import read_estimate
from msg_adapters.table import decode_table
from sonar_imm.estimates import Estimate
from sonar_imm.nodes.qos import latched_qos, lockstep_qos

from .link import Link, LinkError, MATCH_LIMIT

ANSWER_LIMIT = 15.0
"""Seconds a node may take over one message. Its kernels are warm before it listens."""
_ANSWERS = '/processed'
_ASKED_AGAIN = 5.0
_SECOND_LOOK = 0.5
_OTHER_INPUTS = 4.0
"""Seconds in which further inputs of a node may be found. They become known one by one, and what
was lost of them on the way is sent again after three."""


def only_node(link: Link) -> str:
    """Find the node to keep step with where only one runs; gives its full name.

    Raises `LinkError` when there is none after 15 seconds, or more than one.
    """
    found: list[str] = []

    def look() -> int:
        found[:] = [
            topic.removesuffix(_ANSWERS)
            for topic, types in link.node.get_topic_names_and_types()
            if topic.endswith(_ANSWERS) and 'sensor_msgs/msg/PointCloud2' in types
        ]
        return len(found)

    if not link.wait_for(look, MATCH_LIMIT):
        raise LinkError('no node of this package runs in this ROS domain')
    if link.wait_for(lambda: look() > 1, _SECOND_LOOK):
        raise LinkError(f'several nodes run: say which of {", ".join(sorted(found))} to step with')
    return found[0]


class Counts(NamedTuple):
    """One row of ``~/processed``: messages taken, refused, and estimates published."""

    messages: int
    refused: int
    estimates: int


class Recorder:
    """Collects ``~/estimate`` of a node, losing nothing; decodes only when asked, to be quick."""

    def __init__(self, link: Link, node_name: str):
        self._raw: list[bytes] = []
        link.node.create_subscription(
            PointCloud2, f'{node_name}/estimate', self._raw.append, lockstep_qos(), raw=True
        )

    def __len__(self) -> int:
        return len(self._raw)

    def estimates(self, start: int = 0) -> list[Estimate]:
        """Decode what was collected, from the estimate number `start` on."""
        return [read_estimate(deserialize_message(raw, PointCloud2)) for raw in self._raw[start:]]


class LockStep:
    """Keeps step with one node.

    delays: seconds from sending a message to the last estimate made of it, as seen from here, for
    the messages that brought an estimate.
    """

    def __init__(
        self,
        link: Link,
        node_name: str,
        *,
        recorder: Recorder | None = None,
        trouble: Callable[[], str | None] = lambda: None,
    ):
        """Listen to the node `node_name` (full name, e.g. ``/diver``).

        With a `recorder` a step also waits for the estimates to arrive there. `trouble` gives a
        sentence when the node is known to have ended.
        """
        self._link = link
        self._name = node_name
        self._recorder = recorder
        self._trouble = trouble
        self._counts: Counts | None = None
        self._start = Counts(0, 0, 0)
        self._sent = 0
        self._estimates_before = 0
        self.delays: list[float] = []
        self._answers = self._subscribe()

    @property
    def counts(self) -> Counts:
        """What the node did since `connect`."""
        now = self._counts or self._start
        return Counts(*(after - before for after, before in zip(now, self._start)))

    def connect(self, publishers: Iterable[Publisher], limit: float = MATCH_LIMIT) -> set[str]:
        """Wait until the node is there and hears; gives the topics of `publishers` it hears.

        The node may take `limit` seconds to appear, a new node has to compile its kernels first.
        Where it hears some only, four seconds are given to find the others: a message that is not
        waited for could be taken for somebody else's. Raises `LinkError` saying what is missing.
        """
        publishers = list(publishers)
        if not self._answered_within(limit):
            raise LinkError(
                f"no answer from a node '{self._name}': is it running, in this ROS "
                'domain, and one of this package?'
            )
        node, topics = self._link.node, {p.topic_name for p in publishers}
        hearing: set[str] = set()
        last = time.monotonic()

        def connected() -> object:
            nonlocal last
            if fresh := self._subscribed(publishers) - hearing:
                hearing.update(fresh)
                last = time.monotonic()
            return (
                bool(hearing)
                and (hearing == topics or time.monotonic() - last > _OTHER_INPUTS)
                and all(p.get_subscription_count() for p in publishers if p.topic_name in hearing)
                and (self._recorder is None or node.count_publishers(f'{self._name}/estimate'))
            )

        if not self._link.wait_for(connected, MATCH_LIMIT, self._trouble):
            raise LinkError(self._silence(publishers, hearing))
        self._start = self._counts or self._start
        self._estimates_before = 0
        return hearing

    def step(self, publisher: Publisher, message: Any) -> None:
        """Publish `message` and wait for its answer. Raises `LinkError` when there is none."""
        sent = time.monotonic()
        publisher.publish(message)
        self.follow(1, publisher.topic_name, sent)

    def follow(self, messages: int, topic: str, sent: float) -> None:
        """Wait for the answers to so many `messages`, published for the node because of what went
        out on `topic` at `sent`, s of `time.monotonic`. Raises `LinkError` without one."""
        self._sent += messages
        if not self.wait_for(self._caught_up, ANSWER_LIMIT):
            raise LinkError(
                f"node '{self._name}' did not answer message {self._sent} on "
                f'{topic} within {ANSWER_LIMIT:g} s'
            )
        estimates = self.counts.estimates
        if estimates > self._estimates_before:
            self.delays.append(time.monotonic() - sent)
        self._estimates_before = estimates
        if self.counts.messages > self._sent:
            raise LinkError(
                f"something else publishes to the node '{self._name}': it took "
                f'{self.counts.messages} messages and {self._sent} were sent'
            )

    def wait_for(self, predicate: Callable[[], Any], limit: float = MATCH_LIMIT) -> bool:
        """Serve the link until `predicate` holds: True, or False after `limit` seconds. Raises
        `LinkError` when the node ends."""
        return self._link.wait_for(predicate, limit, self._lost)

    def _subscribe(self) -> Subscription:
        return self._link.node.create_subscription(
            PointCloud2, self._name + _ANSWERS, self._answered, latched_qos()
        )

    def _answered_within(self, limit: float) -> bool:
        """Wait for the row that a node keeps for who comes late. It is sent once to each
        subscription and can be lost on a busy machine: ask for it anew now and then."""
        end = time.monotonic() + limit
        while not self._link.wait_for(
            lambda: self._counts is not None,
            min(_ASKED_AGAIN, end - time.monotonic()),
            self._trouble,
        ):
            if time.monotonic() >= end:
                return False
            self._link.node.destroy_subscription(self._answers)
            self._answers = self._subscribe()
        return True

    def _answered(self, message: PointCloud2) -> None:
        columns = decode_table(message)
        self._counts = Counts(*(int(columns[name][0]) for name in Counts._fields))

    def _caught_up(self) -> bool:
        return self.counts.messages >= self._sent and (
            self._recorder is None or len(self._recorder) >= self.counts.estimates
        )

    def _lost(self) -> str | None:
        if sentence := self._trouble():
            return sentence
        if not self._link.node.count_publishers(self._name + _ANSWERS):
            return f"node '{self._name}' has gone"
        return None

    def _subscribed(self, publishers: list[Publisher]) -> set[str]:
        """Topics among those of `publishers` that the node itself subscribes to."""
        return {
            p.topic_name
            for p in publishers
            for info in self._link.node.get_subscriptions_info_by_topic(p.topic_name)
            if _full_name(info) == self._name
        }

    def _silence(self, publishers: list[Publisher], hearing: set[str]) -> str:
        """Say why no topic of the bag reaches the node."""
        for publisher in publishers:
            for info in self._link.node.get_subscriptions_info_by_topic(publisher.topic_name):
                kind: Any = publisher.msg_type
                offered = f'{kind.__module__.partition(".")[0]}/msg/{kind.__name__}'
                wanted = info.topic_type
                if _full_name(info) == self._name and wanted != offered:
                    return (
                        f"node '{self._name}' expects {wanted} on {publisher.topic_name}, the "
                        f'bag holds {offered}; change the type parameter of the node'
                    )
        if hearing:
            return f"node '{self._name}' does not take what is published on {', '.join(hearing)}"
        names = ', '.join(p.topic_name for p in publishers) or 'no topics'
        return (
            f"node '{self._name}' listens to none of the topics of the bag ({names}); remap them"
        )


class FirstStep(LockStep):
    """Keeps step with a node whose output another one hears, as that of a detector of images.
    listeners: how many do."""

    listeners = 0

    def _answered(self, message: Any) -> None:
        super()._answered(message)
        self.listeners = int(decode_table(message)['listeners'][0])


class Chain:
    """Keeps step with two nodes; takes the place of a `LockStep` in the player. A message for the
    first node is answered there; for each message that this one published since, the second has to
    answer too.

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
        fed = [p for p in publishers if p.topic_name in self._fed]
        connected = self.first.connect(fed, limit)
        rest = [p for p in publishers if p.topic_name not in self._fed]
        connected |= self.second.connect(rest, limit)
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


def _full_name(info: Any) -> str:
    return f'{info.node_namespace.rstrip("/")}/{info.node_name}'
