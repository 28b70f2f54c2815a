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

"""What is shown: the topics of one or several recordings as one stream, by log time.

    with Material([bag, estimates]) as material:
        for message in material.messages(from_ns): ...

The stream can begin anywhere. It then starts with the newest message of each topic before that
time, so that a display which was sent once, or rarely, is there after a jump.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack
from heapq import merge
from pathlib import Path
from typing import NamedTuple

from attrs import frozen

from ..recordings.reader import BagError, BagReader


@frozen
class Channel:
    """A topic to show. `definition` is the text of its message type, as ``ros2msg``."""

    topic: str
    type_name: str
    definition: str


class Shown(NamedTuple):
    """A message to show; `raw` is CDR."""

    topic: str
    log_ns: int
    raw: bytes


class Material:
    """Recordings to show together, open while in a ``with`` statement.

    topics: show only these, all when empty. Of a topic that is in several recordings the first one
    counts. problems: sentences about what cannot be shown.
    """

    def __init__(self, paths: Sequence[Path], topics: Collection[str] = ()):
        self._paths = paths
        self._wanted = set(topics)
        self._stack = ExitStack()
        self._parts: list[tuple[BagReader, list[str]]] = []
        self._sentences: list[str] = []
        self.channels: dict[str, Channel] = {}

    def __enter__(self) -> Material:
        """Open the recordings. Raises `BagError` when one cannot be read, when a wanted topic is
        in none of them, or when nothing is left to show."""
        with ExitStack() as stack:
            for path in self._paths:
                reader = stack.enter_context(BagReader(path))
                self._parts.append((reader, self._take(reader)))
            if missing := self._wanted - self.channels.keys():
                raise BagError(f"there is no topic '{sorted(missing)[0]}' that can be shown")
            if not self.channels:
                raise BagError(f'{self._paths[0]} has nothing to show')
            self.first_ns, self.last_ns = self._span()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def problems(self) -> list[str]:
        """What is wrong with the recordings, and which topics cannot be shown."""
        found = [sentence for reader, _ in self._parts for sentence in reader.problems]
        return list(dict.fromkeys(self._sentences + found))

    def messages(self, from_ns: int | None = None) -> Iterator[Shown]:
        """The messages by log time, those of equal time in the order of the recordings.

        From `from_ns` on, and before them the newest earlier one of each topic.
        """
        streams = [self._of(reader, names) for reader, names in self._parts if names]
        earlier: dict[str, Shown] = {}
        for shown in merge(*streams, key=lambda item: item.log_ns):
            if from_ns is not None and shown.log_ns < from_ns:
                earlier[shown.topic] = shown
                continue
            if earlier:
                yield from sorted(earlier.values(), key=lambda item: item.log_ns)
                earlier = {}
            yield shown
        yield from sorted(earlier.values(), key=lambda item: item.log_ns)

    def _take(self, reader: BagReader) -> list[str]:
        """Choose the topics of one recording; gives their names."""
        names = []
        for topic in reader.topics:
            if topic.name in self.channels or (self._wanted and topic.name not in self._wanted):
                continue
            definition = reader.definition(topic.type_name)
            if definition is None:
                continue  # the reader has said so already
            self.channels[topic.name] = Channel(topic.name, topic.type_name, definition)
            names.append(topic.name)
        return names

    def _span(self) -> tuple[int, int]:
        """First and last log time of what is shown."""
        spans = [span for reader, names in self._parts if names and (span := reader.span())]
        if not spans:
            raise BagError(f'{self._paths[0]} has no message to show')
        return min(span[0] for span in spans), max(span[1] for span in spans)

    def _of(self, reader: BagReader, names: list[str]) -> Iterator[Shown]:
        for item in reader.messages(names, decode=reader.is_ros1):
            yield Shown(item.topic, item.log_ns, reader.cdr(item))
