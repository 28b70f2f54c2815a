# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Qualities of service, and noticing when they lose data.

Inputs ask for little (best effort), so that they match any driver; outputs offer much (reliable),
so that they match any listener. Every endpoint can be overridden by the standard parameters, e.g.
``-p qos_overrides./fix.subscription.reliability:=reliable``. ``BEST_AVAILABLE`` is avoided: it is
settled when the endpoint is created, becomes reliable when the driver is not up yet, and then
refuses a best-effort driver.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
import contextlib
import time
from typing import Any, cast

from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.exceptions import InvalidParameterTypeException
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    InvalidQoSProfileException,
    qos_policy_name_from_kind,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription

from ..parameters import ConfigError, yaml_tree

_POLICIES = {
    'history': HistoryPolicy,
    'reliability': ReliabilityPolicy,
    'durability': DurabilityPolicy,
}


def input_qos(depth: int) -> QoSProfile:
    """Best effort, the last `depth` messages: what a listener to a sensor should ask for."""
    return QoSProfile(reliability=ReliabilityPolicy.BEST_EFFORT, depth=depth)


def output_qos(depth: int = 10) -> QoSProfile:
    """Reliable, the last `depth` messages."""
    return QoSProfile(reliability=ReliabilityPolicy.RELIABLE, depth=depth)


def latched_qos(depth: int = 1) -> QoSProfile:
    """Reliable, and the last `depth` messages wait for listeners that come later."""
    profile = output_qos(depth)
    profile.durability = DurabilityPolicy.TRANSIENT_LOCAL
    return profile


def transforms_qos() -> QoSProfile:
    """What tf2 offers and asks for on /tf_static: all that was ever said is kept."""
    return latched_qos(1000)


def lockstep_qos() -> QoSProfile:
    """Reliable, nothing dropped: keep-last would lose most of a fast burst without a word."""
    return QoSProfile(reliability=ReliabilityPolicy.RELIABLE, history=HistoryPolicy.KEEP_ALL)


class SequenceGaps:
    """Gaps in the numbers of the messages of one topic: how many never reached the node.

    A publisher numbers what it sends. A number that is left out is a message that was lost: on the
    network, or in the queue of the node, where a new message pushes out the oldest. The middleware
    says nothing of the latter, so that a node at its limit would look healthy.

    The number comes with each message, the publisher's identity does not. So each publisher is
    known by the last number that came from it, and a message belongs to the one it continues, or,
    after a gap, to the one with the smallest gap. In doubt nothing is counted: the count is a
    lower bound.

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

    def count(self, info: Mapping[str, Any]) -> int:
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
        before = max((known for known in last if known < number), default=None)
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


class Endpoints:
    """Makes the publishers and subscriptions of a node and remembers what they lost.

    incompatible: the policy in question, by topic, of peers that cannot talk to this node.
    """

    def __init__(self, node: Node):
        self._node = node
        self._gaps: dict[str, SequenceGaps] = {}
        self._subscriptions: list[Subscription] = []
        self._reported_lost: Counter[str] = Counter()
        self._warned: set[str] = set()
        self.incompatible: dict[str, str] = {}

    @property
    def lost(self) -> dict[str, int]:
        """Messages that never reached the node, by topic; those without a loss are left out."""
        counts = {
            topic: gaps.lost if gaps.numbered else self._reported_lost[topic]
            for topic, gaps in self._gaps.items()
        }
        return {topic: n for topic, n in counts.items() if n}

    def subscribe(
        self,
        message_type: type,
        topic: str,
        callback: Callable[[Any, Mapping[str, Any]], None],
        qos: QoSProfile,
    ) -> Subscription:
        """Subscribe, counting what is lost and naming peers that cannot be heard.

        `callback` takes a message and its info, as rclpy gives it."""

        def receive(message: Any, info: Mapping[str, Any]) -> None:
            if gaps.count(info):
                self._warn_of_loss(topic)
            callback(message, info)

        events = SubscriptionEventCallbacks(
            incompatible_qos=lambda event: self._mismatch(
                topic, event, 'cannot be heard', 'subscription'
            ),
            message_lost=lambda event: self._lost(topic, event),
            matched=lambda event: self._matched(topic, event),
        )
        subscription = self._node.create_subscription(
            message_type,
            topic,
            cast(Any, receive),  # rclpy's types know callbacks without the info only
            qos,
            event_callbacks=events,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )
        before = self._gaps.get(topic)
        gaps = self._gaps[topic] = SequenceGaps(subscription.get_publisher_count)
        gaps.lost = before.lost if before else 0
        self._subscriptions.append(subscription)
        return subscription

    def unsubscribe(self) -> None:
        """End all subscriptions; what they lost stays counted."""
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions.clear()

    def advertise(
        self,
        message_type: type,
        topic: str,
        qos: QoSProfile,
        matched: Callable[[], None] | None = None,
    ) -> Publisher:
        """Offer a topic, naming listeners that cannot be reached; `matched` is called when a
        listener comes or goes."""
        events = PublisherEventCallbacks(
            incompatible_qos=lambda event: self._mismatch(
                topic, event, 'cannot be reached', 'publisher'
            ),
            matched=(lambda event: matched()) if matched else None,
        )
        return self._node.create_publisher(
            message_type,
            topic,
            qos,
            event_callbacks=events,
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )

    def _mismatch(self, topic: str, event: Any, effect: str, side: str) -> None:
        policy = qos_policy_name_from_kind(event.last_policy_kind)
        if topic not in self.incompatible:
            name = self._node.resolve_topic_name(topic)
            self._node.get_logger().warning(
                f"a peer on '{name}' {effect}: its {policy} quality of service does not fit; "
                f'change it there, or here with -p qos_overrides.{name}.{side}.{policy.lower()}'
            )
        self.incompatible[topic] = policy

    def _matched(self, topic: str, event: Any) -> None:
        if event.current_count_change < 0:
            self._gaps[topic].publisher_left()

    def _lost(self, topic: str, event: Any) -> None:
        self._reported_lost[topic] = event.total_count
        self._warn_of_loss(topic)

    def _warn_of_loss(self, topic: str) -> None:
        if topic not in self._warned:
            self._warned.add(topic)
            name = self._node.resolve_topic_name(topic)
            self._node.get_logger().warning(
                f"messages on '{topic}' are lost before the node can read them: set -p "
                f'qos_overrides.{name}.subscription.depth:=1000 or slow the sender down (said '
                'once, counted in /diagnostics)'
            )


def profiles_of(text: str) -> dict[str, QoSProfile]:
    """Qualities of service by topic, from a file as ``ros2 bag play`` takes it.

    A topic has ``history``, ``depth``, ``reliability`` and ``durability``, each may be left out.
    Raises `ConfigError` for anything else.
    """
    tree = yaml_tree(text)
    if not isinstance(tree, dict) or not all(isinstance(item, dict) for item in tree.values()):
        raise ConfigError('it must hold a mapping of policies for each topic')
    return {str(topic): _profile(str(topic), policies) for topic, policies in tree.items()}


def _profile(topic: str, policies: dict[str, Any]) -> QoSProfile:
    profile = output_qos()
    for name, value in policies.items():
        if name == 'depth':
            if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 10**6:
                raise ConfigError(f"{topic}: depth must be a whole number, got '{value}'")
            profile.depth = value
            continue
        if name not in _POLICIES:
            raise ConfigError(f"{topic}: '{name}' is none of depth, {', '.join(_POLICIES)}")
        try:
            setattr(profile, name, _POLICIES[name].get_from_short_key(str(value)))
        except KeyError:
            known = ', '.join(_POLICIES[name].short_keys())
            raise ConfigError(f"{topic}: {name} is one of {known}, got '{value}'") from None
    return profile


@contextlib.contextmanager
def explained_overrides(node: Node) -> Iterator[None]:
    """Turn what is raised for a bad qos_overrides or type parameter into a `ConfigError`."""
    try:
        yield
    except (ImportError, InvalidParameterTypeException, InvalidQoSProfileException) as error:
        raise ConfigError(str(error)) from None
    except RuntimeError as error:
        if not node.context.ok():
            raise
        raise ConfigError(str(error)) from None
