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

"""Measurements of a recording, read by the same functions that the live nodes use."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

from msg_adapters.inputs import DOUBTS, inputs_of, InputTopic, made_inputs

from ..measurements import Rejection
from ..parameters import did_you_mean
from .detected import DetectedImages
from .reader import BagReader
from .sources import BagError, TopicInfo


class Heard(NamedTuple):
    """What one message gave: a measurement, the `Rejection` that says why there is none, or None
    when it takes more messages to make one."""

    topic: str
    measurement: Any
    log_ns: int


def fitting_topics(
    bag: BagReader, system: str, topics: Mapping[str, str] | None = None
) -> dict[str, InputTopic]:
    """Say which topics of `bag` feed the tracker `system`: input by topic name.

    A topic fits when its type can be read and its name ends in the input's name; where several
    inputs fit, the later one counts. Topics below ``/truth`` never fit, and companions alone are
    not enough. Where an input is missing, a topic fits of which a node before the tracker makes it
    (images of a sonar for detections). `topics` maps topic names to input names instead, e.g.
    ``{'/usbl/pose': 'fix'}``; what belongs beside those, and has its name, comes along. Raises
    `BagError` when nothing fits, with a list of what is there, and when several topics fit an
    input that is one instrument.
    """
    fitting = {
        topic.name: entry
        for topic in bag.topics
        for entry in inputs_of(system)
        if _can_read(topic, entry)
        and f'/{topic.name}'.endswith(f'/{entry.name}')
        and 'truth' not in topic.name.split('/')[:-1]
    }
    if topics is not None:
        chosen = {name: _mapped(bag, system, name, wanted) for name, wanted in topics.items()}
        wanted = {entry.name for entry in chosen.values()}
        beside = {
            name: entry
            for name, entry in fitting.items()
            if wanted & set(entry.beside) and entry.name not in wanted and name not in chosen
        }
        return chosen | beside
    there = {entry.name for entry in fitting.values()}
    fitting |= {
        name: entry for name, entry in made_topics(bag, system).items() if entry.makes not in there
    }
    fitting = _of_use(bag, fitting)
    if all(entry.companion for entry in fitting.values()):
        raise BagError(_nothing_fits(bag, system))
    for entry in (*inputs_of(system), *made_inputs(system)):
        names = [name for name, its in fitting.items() if its is entry]
        if entry.one_topic and len(names) > 1:
            raise BagError(
                f'several topics fit {entry.name}: {", ".join(names)}; choose one, '
                f'e.g. --topic {entry.name}={names[0]}'
            )
    return fitting


def measurements_of(
    bag: BagReader,
    system: str,
    topics: Mapping[str, str] | None = None,
    *,
    world_frame: str = 'enu',
    order: str = 'recorded',
    settings: Mapping[str, Any] | None = None,
    detector: Mapping[str, Any] | None = None,
) -> Iterator[Heard]:
    """Yield the measurements for the tracker `system` in an open recording, in replay order.

    `topics` is as in `fitting_topics`, `world_frame` (``'enu'`` or ``'ned'``) is what the
    recording uses, `order` is as in `BagReader.messages`. `settings` holds the parameters of the
    tracker by name; readers take those that concern them. `detector` holds the parameters of the
    detector of images that are not the default. Messages that deserve a warning are
    counted in ``bag.problems`` at the end. Raises `BagError` when no topic fits.
    """
    chosen = fitting_topics(bag, system, topics)
    told = settings or {}
    images = DetectedImages(system, detector or {}, told)
    readers = {
        (name, type_name): images.reader(entry, type_name)
        if entry.makes
        else entry.reader(type_name, world_frame, told, name)
        for name, entry in chosen.items()
        for type_name in entry.readers
    }
    doubts: Counter[tuple[str, str]] = Counter()
    for item in bag.messages(list(chosen), order=order):
        entry = chosen[item.topic]
        if item.type_name not in entry.readers:  # one topic name recorded with two types
            sentence = f'{item.topic} carries {item.type_name}, not readable as {entry.name}'
            yield Heard(item.topic, Rejection('bad_type', sentence), item.log_ns)
            continue
        try:
            measurement = readers[item.topic, item.type_name](item.message)
            if (code := entry.doubt(item.message, measurement)) is not None:
                doubts[item.topic, code] += 1
        except Rejection as rejection:
            measurement = rejection
        yield Heard(item.topic, measurement, item.log_ns)
    for (topic, code), count in doubts.items():
        bag.add_problem(f'topic {topic}: {count} messages {DOUBTS.get(code, code)}')


def _of_use(bag: BagReader, fitting: Mapping[str, InputTopic]) -> dict[str, InputTopic]:
    """Without companions of what is not there, and without what may be another instrument's."""
    types = {topic.name: topic.type_name for topic in bag.topics}
    second = {name for name, entry in fitting.items() if types[name] in entry.second}
    sure = {
        name: entry
        for name, entry in fitting.items()
        if name not in second and not entry.companion
    }
    kept = dict(fitting)
    for name in sorted(second if sure else ()):
        sentence = (
            f'topic {name} ({types[name]}) is left out, because {", ".join(sure)} says where '
            f'divers are; choose it with --topic {kept.pop(name).name}={name}'
        )
        if sentence not in bag.problems:
            bag.add_problem(sentence)
    inputs = {entry.makes or entry.name for entry in kept.values()}
    return {
        name: entry
        for name, entry in kept.items()
        if not entry.beside or inputs & set(entry.beside)
    }


def _mapped(bag: BagReader, system: str, name: str, wanted: str) -> InputTopic:
    """Check one entry of a topic map."""
    entries = {entry.name: entry for entry in (*inputs_of(system), *made_inputs(system))}
    if wanted not in entries:
        raise BagError(
            f"the {system} tracker has no input '{wanted}'"
            f'{did_you_mean(wanted, entries)}; it has {", ".join(entries)}'
        )
    found = [topic for topic in bag.topics if topic.name == name]
    if not found:
        names = sorted({topic.name for topic in bag.topics})
        raise BagError(f"{bag.path} has no topic '{name}'{did_you_mean(name, names)}")
    if not any(_can_read(topic, entries[wanted]) for topic in found):
        raise BagError(
            f'{name} is of type {found[0].type_name}; the input {wanted} takes '
            f'{", ".join(entries[wanted].readers)}'
        )
    return entries[wanted]


def _can_read(topic: TopicInfo, entry: InputTopic) -> bool:
    return topic.type_name in entry.readers


def made_topics(bag: BagReader, system: str) -> dict[str, InputTopic]:
    """Topics of which a node before the tracker makes an input: by their type, or by their name
    too where the type holds other things as well."""
    return {
        topic.name: entry
        for entry in made_inputs(system)
        for topic in bag.topics
        if entry.may_be(topic.name, topic.type_name) and 'truth' not in topic.name.split('/')[:-1]
    }


def _nothing_fits(bag: BagReader, system: str) -> str:
    """Say what was looked for, what is there, and what could be meant."""
    wanted = ' or '.join(f"'{entry.name}'" for entry in inputs_of(system))
    if not bag.topics:
        return f'{bag.path} is empty: it has no topics'
    there = ', '.join(f'{topic.name} ({topic.type_name})' for topic in bag.topics)
    maybe = [
        f'{topic.name} as {entry.name}'
        for topic in bag.topics
        for entry in inputs_of(system)
        if entry.may_be(topic.name, topic.type_name) and 'truth' not in topic.name.split('/')
    ]
    hint = f'; name the topic to use {" or ".join(maybe)}' if maybe else ''
    return (
        f'{bag.path} has no topic for the {system} tracker, which hears {wanted}; '
        f'there are {there}{hint}'
    )
