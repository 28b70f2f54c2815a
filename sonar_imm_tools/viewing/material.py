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

"""What is shown: the topics of recordings, and what is drawn of estimates, as one stream.

    with opened(path) as (material, problems):
        for message in material.messages(from_ns): ...

The stream can begin anywhere. It then starts with the newest message of each topic before that
time, so that a display which was sent once, or rarely, is there after a jump.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
import contextlib
from heapq import merge
from pathlib import Path
from typing import NamedTuple, Protocol

from attrs import frozen

from msg_adapters.displays import displays_of
from msg_adapters.estimates import read_estimate

from ..offline.batch import run_folders
from ..offline.run_folder import BAG, RUN, RunFolder, summaries
from ..recordings.messages import cdr_of, message_definition, ros_message
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


class Part(Protocol):
    """Something with messages by log time: a recording, or what is drawn of one."""

    def channels(self) -> list[Channel]:
        """What it has to show."""

    def span(self) -> tuple[int, int] | None:
        """First and last log time, ns; None without a message."""

    def messages(self, topics: Collection[str]) -> Iterator[Shown]:
        """The messages of `topics` by log time."""

    @property
    def problems(self) -> list[str]:
        """Sentences about what cannot be shown."""


class Recording:
    """A recording as a part; `reader` is open, and `prefix` is put before the names of topics."""

    def __init__(self, reader: BagReader, prefix: str = ''):
        self._reader = reader
        self._prefix = prefix

    def channels(self) -> list[Channel]:
        found = (
            (topic, self._reader.definition(topic.type_name)) for topic in self._reader.topics
        )
        return [
            Channel(self._prefix + topic.name, topic.type_name, definition)
            for topic, definition in found
            if definition is not None  # else the reader has said so already
        ]

    def span(self) -> tuple[int, int] | None:
        return self._reader.span()

    def messages(self, topics: Collection[str]) -> Iterator[Shown]:
        own = [name.removeprefix(self._prefix) for name in topics]
        for item in self._reader.messages(own, decode=self._reader.is_ros1):
            yield Shown(self._prefix + item.topic, item.log_ns, self._reader.cdr(item))

    @property
    def problems(self) -> list[str]:
        return self._reader.problems


class Drawings:
    """What the node of `system` would draw of the estimates in a recording, as a part."""

    def __init__(self, reader: BagReader, system: str, prefix: str = ''):
        self._reader = reader
        self._system = system
        self._prefix = prefix

    def channels(self) -> list[Channel]:
        return [
            Channel(self._topic(name), type_name, message_definition(type_name) or '')
            for name, type_name in displays_of(self._system).topics.items()
        ]

    def span(self) -> tuple[int, int] | None:
        return self._reader.span()

    def messages(self, topics: Collection[str]) -> Iterator[Shown]:
        displays = displays_of(self._system)
        for item in self._reader.messages([f'/{self._system}/estimate']):
            drawn = displays.of(
                read_estimate(item.message),
                ros_message,
                lambda name: self._topic(name) in topics,
            )
            for name, message in drawn:
                yield Shown(self._topic(name), item.log_ns, cdr_of(message))

    @property
    def problems(self) -> list[str]:
        return []

    def _topic(self, name: str) -> str:
        return f'{self._prefix}/{self._system}/{name}'


class Material:
    """Parts that are shown together.

    topics: show only these, all when empty. Of a topic that is in several parts the first one
    counts. first_ns, last_ns: the span of what is shown. Raises `BagError` when a wanted topic is
    in none of the parts, or when nothing is left to show.
    """

    def __init__(self, parts: Sequence[Part], topics: Collection[str] = ()):
        self.channels: dict[str, Channel] = {}
        self._parts: list[tuple[Part, set[str]]] = []
        for part in parts:
            offered = {channel.topic: channel for channel in part.channels()}
            new = offered.keys() - self.channels.keys()
            names = new & set(topics) if topics else new
            self.channels.update((name, offered[name]) for name in sorted(names))
            self._parts.append((part, names))
        if missing := set(topics) - self.channels.keys():
            raise BagError(f"there is no topic '{sorted(missing)[0]}' that can be shown")
        spans = [span for part, names in self._parts if names and (span := part.span())]
        if not spans:
            raise BagError('there is nothing to show')
        self.first_ns = min(span[0] for span in spans)
        self.last_ns = max(span[1] for span in spans)

    @property
    def problems(self) -> list[str]:
        """What is wrong with the parts, and which topics cannot be shown."""
        return list(dict.fromkeys(text for part, _ in self._parts for text in part.problems))

    def messages(self, from_ns: int | None = None) -> Iterator[Shown]:
        """The messages by log time, those of equal time in the order of the parts.

        From `from_ns` on, and before them the newest earlier one of each topic.
        """
        streams = [part.messages(names) for part, names in self._parts if names]
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


def _runs(source: Path) -> list[Path]:
    """The folders of the runs at `source`, none when it is a recording."""
    if (source / RUN).is_file() or summaries(source):
        return run_folders(source)
    return []


@contextlib.contextmanager
def opened(source: Path, topics: Collection[str] = ()) -> Iterator[tuple[Material, list[str]]]:
    """What is to be shown of a recording or of a run, open for the ``with`` statement, and
    sentences about what is missing.

    Of a run: its estimates, what a node would have drawn of them, and the recording they were made
    of when that is still there. Of runs of several instruments in one recording: all, the name of
    the folder before the topics. Raises `BagError` for what cannot be read.
    """
    with contextlib.ExitStack() as stack:

        def reader(path: Path) -> BagReader:
            return stack.enter_context(BagReader(path))

        problems: list[str] = []
        parts: list[Part] = []
        recordings: list[Path] = []
        folders = _runs(source)
        for folder in folders:
            run = RunFolder(folder).read_run()
            estimates = reader(folder / BAG)
            prefix = f'/{folder.relative_to(source).as_posix()}' if len(folders) > 1 else ''
            parts += [Recording(estimates, prefix), Drawings(estimates, run['system'], prefix)]
            recordings.append(Path(run['bag']))
        if len(set(recordings)) > 1:
            raise BagError(
                f'{source} holds runs of {len(set(recordings))} recordings: show one of them, '
                f'e.g. {folders[0]}'
            )
        for recording in set(recordings) if folders else {source}:
            if folders and not recording.exists():
                problems.append(f'{recording} is gone: only the estimates are shown')
            else:
                parts.append(Recording(reader(recording)))
        material = Material(parts, topics)
        yield material, problems + material.problems
