# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Reading recordings: rosbag2 (sqlite3 and MCAP, plain or zstd), bare files, ROS 1 bags.

    with BagReader('dive.bag') as bag:
        for topic in bag.topics: ...
        for message in bag.messages(['/fix']): ...
        for sentence in bag.problems: ...

Messages come in recorded order: by log time, equal times in the order of the file, in live
lock-step replay as offline. ``order='stamp'`` sorts by header stamp instead, and holds the whole
selection in memory.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterator
from heapq import merge
from itertools import islice
import json
from pathlib import Path
from typing import Any

from attrs import evolve, frozen

from msg_adapters.headers import stamp_ns
from sonar_imm.measurements import Rejection

from .messages import cdr_of
from .sources import (
    BagError,
    names_of_targets,
    one_line,
    open_sources,
    RawMessage,
    Source,
    TARGET_NAMES,
    TopicInfo,
)

__all__ = ['BagError', 'BagMessage', 'BagReader', 'TopicInfo', 'ORDERS']

ORDERS = ('recorded', 'stamp')


@frozen
class BagMessage:
    """One recorded message.

    index: running number of the message in the selection it was read with, in recorded order;
    raw: as recorded (CDR); message: decoded, or None when decoding was switched off.
    """

    topic: str
    type_name: str
    log_ns: int
    index: int
    message: Any
    raw: bytes


class BagReader:
    """A recording, open for reading; use it in a ``with`` statement.

    topics: the topics in it. problems: sentences about what is wrong with it; reading messages can
    add to them. With `strict` the first problem raises `BagError` instead.
    """

    def __init__(self, path: str | Path, *, strict: bool = False):
        self.path = Path(path)
        self.strict = strict
        self.topics: list[TopicInfo] = []
        self._sources: list[Source] = []
        self._sentences: list[str] = []
        self._undecoded: dict[str, tuple[int, str]] = {}

    def __enter__(self) -> BagReader:
        try:
            self._sources, problems = open_sources(self.path)
        except OSError as error:
            raise BagError(f'{self.path} cannot be read: {error.strerror}') from None
        self.topics = _merged(self._sources)
        problems += [
            f'topic {topic.name} is of type {topic.type_name or "(none)"}, whose '
            'definition is neither in the bag nor known'
            for topic in self.topics
            if not topic.decodable
        ]
        try:
            for sentence in problems:
                self.add_problem(sentence)
        except BagError:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        while self._sources:
            self._sources.pop().close()

    @property
    def problems(self) -> list[str]:
        """Sentences about what is wrong; messages that cannot be decoded are counted by topic."""
        return self._sentences + [
            f'topic {topic}: {count} message{"s" if count > 1 else ""} could not be decoded '
            f'(the first: {reason})'
            for topic, (count, reason) in self._undecoded.items()
        ]

    def add_problem(self, sentence: str) -> None:
        """Note what is wrong; raises `BagError` when strict."""
        if self.strict:
            raise BagError(sentence)
        self._sentences.append(sentence)

    @property
    def custom_data(self) -> dict[str, str]:
        """Notes of the program that wrote the bag, empty when there are none."""
        return {
            key: value
            for source in self._sources
            for key, value in getattr(source, 'custom_data', {}).items()
        }

    @property
    def target_names(self) -> dict[str, str]:
        """The names of targets by target ID, as `convert` notes them; empty without."""
        try:
            return names_of_targets(json.loads(self.custom_data.get(TARGET_NAMES, '{}')))
        except (ValueError, RecursionError):
            return {}

    @property
    def is_ros1(self) -> bool:
        """Whether this is a ROS 1 bag, whose messages are not CDR."""
        return self.path.is_file() and self.path.suffix == '.bag'

    def cdr(self, item: BagMessage) -> bytes:
        """The decoded message `item` as ROS 2 sends it; ROS 1 bags hold another serialization."""
        return cdr_of(item.message) if self.is_ros1 else bytes(item.raw)

    def messages(
        self,
        topics: Collection[str] | None = None,
        *,
        order: str = 'recorded',
        decode: bool = True,
    ) -> Iterator[BagMessage]:
        """Yield the messages of `topics` (all when None).

        What cannot be decoded is skipped and counted in `problems`. Raises `BagError` for it when
        strict, and ValueError for an unknown `order`.
        """
        if order not in ORDERS:
            raise ValueError(f"order must be one of {', '.join(ORDERS)}, got '{order}'")
        recorded = self._recorded(topics, decode or order == 'stamp')
        if order == 'stamp':
            recorded = iter(sorted(recorded, key=lambda item: (_stamp(item), item.index)))
        for item in recorded:
            yield item if decode else evolve(item, message=None)

    def _recorded(self, topics: Collection[str] | None, decode: bool) -> Iterator[BagMessage]:
        streams = [self._guarded(source, topics) for source in self._sources]
        # a stable merge by log time: equal times keep the order of the files
        for index, (source, item) in enumerate(merge(*streams, key=lambda pair: pair[1].log_ns)):
            message = None
            if decode:
                try:
                    message = source.decode(item.type_name, item.raw)
                except Exception as error:  # garbage can raise nearly anything in a decoder
                    self._cannot_decode(item, index, error)
                    continue
            yield BagMessage(item.topic, item.type_name, item.log_ns, index, message, item.raw)

    def _guarded(
        self, source: Source, topics: Collection[str] | None
    ) -> Iterator[tuple[Source, RawMessage]]:
        """Read one source up to its end or, where nothing else helps, its first damage."""
        given: Counter[str] = Counter()
        try:
            for item in source.messages(topics):
                yield source, item
                given[item.topic] += 1
        except GeneratorExit:
            raise
        except Exception as error:  # rosbags raises nearly anything on damaged files
            rest = source.rescue()
            if rest is None:
                self.add_problem(
                    f'{self.path} is damaged: {one_line(error)}; the messages after the '
                    'damage are lost'
                )
                return
            self._sources.append(rest)
            self.add_problem(rest.damage)
            for item in islice(rest.messages(topics), given.total(), None):
                yield rest, item
            return
        stated: Counter[str] = Counter()
        for topic in source.topics():
            if topics is None or topic.name in topics:
                stated[topic.name] += topic.count
        for name, count in stated.items():
            if given[name] != count:
                index = f'the index of {self.path} says {count}'
                self.add_problem(f'topic {name} holds {given[name]} messages; {index}')

    def _cannot_decode(self, item: RawMessage, index: int, error: Exception) -> None:
        reason = f'message {index}, {one_line(error)}'
        if self.strict:
            raise BagError(f'topic {item.topic}: a message could not be decoded ({reason})')
        count, first = self._undecoded.get(item.topic, (0, reason))
        self._undecoded[item.topic] = (count + 1, first)


def _merged(sources: list[Source]) -> list[TopicInfo]:
    """Join the topics of several files, in order of their names."""
    joined: dict[tuple[str, str], TopicInfo] = {}
    for source in sources:
        for topic in source.topics():
            known = joined.setdefault((topic.name, topic.type_name), topic)
            if known is not topic:
                count, decodable = known.count + topic.count, known.decodable and topic.decodable
                both = evolve(known, count=count, decodable=decodable)
                joined[topic.name, topic.type_name] = both
    return [joined[key] for key in sorted(joined)]


def _stamp(item: BagMessage) -> tuple[int, int]:
    """Key of ``order='stamp'``: header stamp, or log time for a message without a usable one."""
    try:
        return stamp_ns(item.message), item.log_ns
    except (AttributeError, Rejection):
        return item.log_ns, item.log_ns
