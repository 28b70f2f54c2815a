# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Publishing a recording to live nodes, with the spellings of ``ros2 bag play``.

Messages go out as they were recorded, byte for byte, stamps included, in the order and at the pace
of their log times, or in lock-step with one node. What cannot be decoded, or whose type is not
installed, is left out and told.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
import time
from typing import Any

from attrs import Attribute, field, frozen
from rclpy.duration import Duration
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rosgraph_msgs.msg import Clock
from std_srvs.srv import Trigger

from sonar_imm.nodes.messages import make, message_class
from sonar_imm.nodes.qos import lockstep_qos, output_qos, transforms_qos
from sonar_imm.parameters import ConfigError, did_you_mean

from ..recordings.reader import BagError, BagReader
from .link import Link, MATCH_LIMIT
from .lockstep import Chain, LockStep, only_node

NAME = 'sonar_imm_player'
_FIRST_LISTENER, _OTHER_LISTENERS = 5.0, 0.5
_LAST_MESSAGES = 2.0
"""Seconds that listeners have in all to take what was sent last."""
_DEPTH = 100
_NANO = 10**9


def _positive(instance: PlayOptions, attribute: Attribute[Any], value: float | None) -> None:
    if value is not None and not 0.0 < value < float('inf'):
        raise ConfigError(f'the {attribute.name} must be positive, got {value:g}')


def _not_negative(instance: PlayOptions, attribute: Attribute[Any], value: float) -> None:
    if not 0.0 <= value < float('inf'):
        raise ConfigError(f'the {attribute.name} must not be negative, got {value:g}')


@frozen(kw_only=True)
class PlayOptions:
    """How to play. Raises `ConfigError` for a number that makes no sense.

    rate: speed, 2 is twice as fast; loop: start over at the end; start_offset: seconds of the
    recording to skip; playback_duration: seconds of the recording to play after that, all where
    negative; delay: seconds to wait before the first message; start_paused: wait for the service
    ``/sonar_imm_player/resume``; clock: Hz of /clock, None for none; topics: only these (recorded
    names), empty for all; exclude_topics: not these; qos: quality of service by recorded name;
    remap: recorded to published topic names; lockstep: full name
    of the node to keep step with (``/diver``), ``auto`` for the only one that runs, empty to keep
    the recorded pace.
    """

    rate: float = field(default=1.0, validator=_positive)
    loop: bool = False
    start_offset: float = field(default=0.0, validator=_not_negative)
    playback_duration: float = -1.0
    delay: float = field(default=0.0, validator=_not_negative)
    start_paused: bool = False
    clock: float | None = field(default=None, validator=_positive)
    topics: tuple[str, ...] = ()
    exclude_topics: tuple[str, ...] = ()
    qos: Mapping[str, QoSProfile] = field(factory=dict)
    remap: Mapping[str, str] = field(factory=dict)
    lockstep: str = ''


@frozen
class PlayResult:
    """What was played: messages published, sentences about what was not, and lock-step delays."""

    published: int
    problems: tuple[str, ...]
    delays: tuple[float, ...] = ()


def play(
    path: Path | str,
    options: PlayOptions,
    *,
    domain_id: int | None = None,
    progress: Callable[[int], None] = lambda count: None,
) -> PlayResult:
    """Publish the bag at `path`; ends with it, or never with ``loop``.

    `progress` is called with the number of messages just published. Raises `BagError` for a bag
    that cannot be read or has nothing to publish, `ConfigError` for topics it does not have, and
    `LinkError` when the node to step with is missing, ends or does not answer.
    """
    with BagReader(path) as bag, Link(NAME, domain_id=domain_id) as link:
        player = Player(bag, link, options)
        player.run(progress)
        return player.result()


class Player:
    """One playing of one open bag over one link."""

    def __init__(
        self,
        bag: BagReader,
        link: Link,
        options: PlayOptions,
        lockstep: LockStep | Chain | None = None,
    ):
        """Advertise the topics. `lockstep` replaces the one that `options` would make."""
        self._bag = bag
        self._link = link
        self._options = options
        self._problems: list[str] = []
        self._publishers = self._advertise()
        self._lockstep = lockstep
        if options.lockstep and not lockstep:
            name = only_node(link) if options.lockstep == 'auto' else options.lockstep
            self._lockstep = LockStep(link, name)
        self._clock = Ticker(link, options.clock) if options.clock else None
        self._pause = Pause(link, options.start_paused)
        self._published = 0

    def run(
        self,
        progress: Callable[[int], None] = lambda count: None,
        start_limit: float = MATCH_LIMIT,
    ) -> None:
        """Play to the end, once or for ever; a node to step with has `start_limit` s to come."""
        stepped = self._meet(start_limit)
        self._link.wait_for(lambda: False, self._options.delay)
        while True:
            before = self._published
            self._play_once(stepped, progress)
            if not self._options.loop or self._published == before:
                break
        end = time.monotonic() + _LAST_MESSAGES
        for publisher in self._publishers.values():
            # With the end of its publisher a message that is still on its way is lost.
            publisher.wait_for_all_acked(Duration(seconds=max(end - time.monotonic(), 0.0)))

    def result(self) -> PlayResult:
        """Sum up."""
        return PlayResult(
            self._published,
            (*self._problems, *self._bag.problems),
            tuple(self._lockstep.delays) if self._lockstep else (),
        )

    def _advertise(self) -> dict[str, Publisher]:
        """Make a publisher for each topic to play: {recorded name: publisher}."""
        recorded = {topic.name: topic.type_name for topic in self._bag.topics}
        options = self._options
        named = (*options.topics, *options.exclude_topics, *options.remap, *options.qos)
        for name in named:
            if name not in recorded:
                meant = did_you_mean(name, recorded)
                raise ConfigError(f"{self._bag.path} has no topic '{name}'{meant}")
        # Reliable, which every listener accepts; in lock-step nothing may be dropped at all.
        qos = lockstep_qos() if self._options.lockstep else output_qos(_DEPTH)
        publishers = {}
        for name in self._options.topics or recorded:
            if name in options.exclude_topics or (name == '/clock' and options.clock):
                continue  # our clock replaces the recorded one
            try:
                cls = message_class(recorded[name])
            except ImportError as error:
                self._problems.append(f'topic {name} is not published: {error}')
                continue
            # Of /tf_static all messages are kept, for listeners that come later.
            usual = transforms_qos() if name.rpartition('/')[2] == 'tf_static' else qos
            publishers[name] = self._link.node.create_publisher(
                cls, options.remap.get(name, name), options.qos.get(name) or usual
            )
        if not publishers:
            raise BagError(f'{self._bag.path} has nothing to publish')
        return publishers

    def _meet(self, limit: float) -> set[str]:
        """Wait for listeners; gives the published names that go in lock-step.

        Without lock-step it waits a few seconds for the first listener at most, and then a moment
        for the others: rightly, there may be none on some topics.
        """
        publishers = self._publishers.values()
        if self._lockstep:
            return self._lockstep.connect(publishers, limit)

        def heard() -> list[bool]:
            return [p.get_subscription_count() > 0 for p in publishers]

        if not self._link.wait_for(lambda: any(heard()), _FIRST_LISTENER):
            self._problems.append('nobody was listening when playing began')
        self._link.wait_for(lambda: all(heard()), _OTHER_LISTENERS)
        return set()

    def _play_once(self, stepped: set[str], progress: Callable[[int], None]) -> None:
        first: int | None = None
        skipped = round(self._options.start_offset * _NANO)
        length = self._options.playback_duration
        pace: Pace | None = None
        for item in self._bag.messages(list(self._publishers)):
            first = item.log_ns if first is None else first
            if item.log_ns - first < skipped:
                continue
            if 0.0 <= length * _NANO < item.log_ns - first - skipped:
                return
            pace = pace or Pace(item.log_ns, self._options.rate)
            self._wait(pace, item.log_ns, paced=not stepped)
            publisher = self._publishers[item.topic]
            if self._lockstep and publisher.topic_name in stepped:
                self._lockstep.step(publisher, self._bag.cdr(item))
            else:
                publisher.publish(self._bag.cdr(item))
            self._published += 1
            progress(1)

    def _wait(self, pace: Pace, log_ns: int, *, paced: bool) -> None:
        """Serve the link until `log_ns` is due; in lock-step only a pause makes it wait."""
        while True:
            if self._pause.paused:
                start = time.monotonic()
                self._link.wait_for(lambda: not self._pause.paused, 0.5)
                pace.postpone(time.monotonic() - start)
                continue
            wait = pace.seconds_until(log_ns) if paced else 0.0
            if self._clock:
                self._clock.tick(pace.now_ns() if wait > 0.0 else log_ns, always=not paced)
            if wait <= 0.0:
                return
            self._link.spin(min(wait, self._clock.until_next() if self._clock else 0.1, 0.1))


class Pace:
    """Maps log times to the steady clock."""

    def __init__(self, first_ns: int, rate: float):
        self._first_ns = first_ns
        self._rate = rate
        self._start = time.monotonic()

    def postpone(self, seconds: float) -> None:
        """Account for a pause."""
        self._start += seconds

    def seconds_until(self, log_ns: int) -> float:
        """How long until `log_ns` is due; negative when it is late."""
        due = self._start + (log_ns - self._first_ns) / _NANO / self._rate
        return due - time.monotonic()

    def now_ns(self) -> int:
        """The log time that is due now."""
        elapsed = time.monotonic() - self._start
        return self._first_ns + round(elapsed * self._rate * _NANO)


class Ticker:
    """Publishes /clock at a steady rate of real time."""

    def __init__(self, link: Link, hertz: float):
        self._publisher = link.node.create_publisher(Clock, '/clock', 10)
        self._period = 1.0 / hertz
        self._next = 0.0

    def until_next(self) -> float:
        """Seconds until the next tick is due."""
        return max(self._next - time.monotonic(), 0.0)

    def tick(self, now_ns: int, *, always: bool = False) -> None:
        """Publish `now_ns` when a tick is due, or in any case."""
        if self.until_next() > 0.0 and not always:
            return
        self._next = time.monotonic() + self._period
        seconds, rest = divmod(now_ns, _NANO)
        clock = make('builtin_interfaces/msg/Time', sec=seconds, nanosec=rest)
        self._publisher.publish(Clock(clock=clock))


class Pause:
    """The services ``~/pause`` and ``~/resume`` (std_srvs/Trigger)."""

    def __init__(self, link: Link, paused: bool):
        self.paused = paused
        link.node.create_service(Trigger, '~/pause', lambda q, a: self._set(True, a))
        link.node.create_service(Trigger, '~/resume', lambda q, a: self._set(False, a))

    def _set(self, paused: bool, answer: Trigger.Response) -> Trigger.Response:
        self.paused = paused
        answer.success, answer.message = True, 'paused' if paused else 'playing'
        return answer
