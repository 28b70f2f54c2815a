# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Which topics of a recording feed which tracker, and their measurements, read by the same
functions that the live nodes use: the one step from messages to what a tracker takes in."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
import itertools
import re
from typing import Any, NamedTuple

from msg_adapters.inputs import DOUBTS, inputs_of, InputTopic, made_inputs, needed
from sonar_imm.measurements import Detections, Rejection, SonarInfo
from sonar_imm.parameters import did_you_mean
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.obstacle.detector import DetectorConfig, ImageDetector

from .messages import ros_message
from .reader import BagReader
from .sources import BagError, TopicInfo

TYPES_NAMED = 3
Topics = Mapping[str, str] | None
"""Input names by topic name that a user chose, as in `fitting_topics`."""


def every_input(system: str) -> tuple[InputTopic, ...]:
    """The inputs of a tracker, and those of which a node before it makes one."""
    return (*inputs_of(system), *made_inputs(system))


def needed_inputs(system: str) -> tuple[Collection[str], Collection[str]]:
    """The inputs that a tracker cannot do without by default: all of the first, one of the
    second."""
    return needed(inputs_of(system), SYSTEMS[system].config_type()().as_dict())


def is_truth(topic: str) -> bool:
    """Whether a topic holds truth, which is no input."""
    return 'truth' in topic.split('/')


def types_of(bag: BagReader) -> dict[str, str]:
    """The type of each topic of a recording."""
    return {topic.name: topic.type_name for topic in bag.topics}


def fitting_topics(bag: BagReader, system: str, topics: Topics = None) -> dict[str, InputTopic]:
    """Say which topics of `bag` feed the tracker `system`: input by topic name.

    A topic fits when its type can be read and its name ends in the input's name, or has a word
    that stands for it; where several inputs fit, the later one counts. Topics below ``/truth``
    never fit, and companions alone are not enough. An input that is needed beside what fits is
    found by its type too, where one topic alone has such a type. Where an input is missing, a
    topic fits of which a node before the tracker makes it (images of a sonar for detections).
    `topics` maps topic names to input names instead, e.g. ``{'/usbl/pose': 'fix'}``; what belongs
    beside those, and has its name, comes along. Raises `BagError` when nothing fits, with a list
    of what is there, and when several instruments fit; `instruments` tells them apart.
    """
    found = instruments(bag, system, topics)
    if len(found) > 1:
        names = [
            name for inputs in found.values() for name, entry in inputs.items() if entry.one_topic
        ]
        entry = next(iter(found.values()))[names[0]]
        raise BagError(
            f'several topics fit the {system} tracker as instruments of their own: '
            f'{", ".join(names)}; choose one, e.g. --topic {entry.name}={names[0]}'
        )
    return next(iter(found.values()))


def instruments(
    bag: BagReader, system: str, topics: Topics = None
) -> dict[str, dict[str, InputTopic]]:
    """Say which topics feed which tracker: what `fitting_topics` gives, for each instrument by its
    name.

    Where several topics fit an input that is one instrument, each namespace that has such a topic
    is an instrument with a tracker of its own, named after the namespace. It also hears what lies
    below its namespace, and from outside of all what it has not of its own. Otherwise there is one
    instrument, with the name ''. Raises `BagError` when nothing fits.
    """
    fitting = _matching(bag, system, topics)
    homes = {name: entry.namespace(name) for name, entry in fitting.items() if entry.one_topic}
    if max(Counter(fitting[name].name for name in homes).values(), default=0) < 2:
        return {'': fitting}
    for name in fitting.keys() - homes.keys():
        below = [place for place in homes.values() if place and name.startswith(f'{place}/')]
        if below:
            homes[name] = max(below, key=len)
    found: dict[str, dict[str, InputTopic]] = {}
    for place in sorted({homes[name] for name in homes if fitting[name].one_topic}):
        own = {name: entry for name, entry in fitting.items() if homes.get(name) == place}
        there = {entry.name for entry in own.values()}
        of_all = {
            name: entry
            for name, entry in fitting.items()
            if name not in homes and entry.name not in there
        }
        found[_free_name(place, own, found)] = own | of_all
    return found


def _free_name(place: str, own: Mapping[str, InputTopic], used: Collection[str]) -> str:
    """The name of an instrument, fit for a folder: of its namespace, or else of its input."""
    words = place.strip('/_') or next(entry.name for entry in own.values() if entry.one_topic)
    name = '_'.join(re.findall(r'[^\W_]+', words))
    further = (f'{name}_{k}' for k in itertools.count(2))
    return name if name not in used else next(free for free in further if free not in used)


def remarks_on_topics(
    bag: BagReader, system: str, found: Mapping[str, Mapping[str, InputTopic]]
) -> list[str]:
    """A sentence for each topic that feeds the tracker, and for each that could and does not.

    found: as `instruments` gives it.
    """
    counts = {topic.name: topic.count for topic in bag.topics}
    sentences = [
        f'{f"{system} {instrument}".strip()} <- {topic} as {entry.name} ({counts[topic]} messages)'
        for instrument, inputs in found.items()
        for topic, entry in inputs.items()
    ]
    used = {topic for inputs in found.values() for topic in inputs}
    for topic in bag.topics:
        if topic.name in used or is_truth(topic.name):
            continue
        entries = [entry for entry in inputs_of(system) if topic.type_name in entry.readers]
        could = [e.name for e in entries if e.may_be(topic.name, topic.type_name)]
        second = any(topic.type_name in entry.second for entry in entries)
        # What has the name of an input and is not used would only help what is not there.
        if could and (second or not any(entry.is_named(topic.name) for entry in entries)):
            why = ": the ship's own position?" if second else ';'
            sentences.append(
                f'ignored: {topic.name} ({topic.count} messages){why} --topic '
                f'{could[0]}={topic.name} would take it'
            )
    return sentences


def _candidates(
    bag: BagReader, entries: Iterable[InputTopic]
) -> list[tuple[TopicInfo, InputTopic]]:
    """Return the topics that could be an input if a user says so, each with that input."""
    known = tuple(entries)
    return [
        (topic, entry)
        for topic in bag.topics
        for entry in known
        if entry.may_be(topic.name, topic.type_name) and not is_truth(topic.name)
    ]


def _nameless(bag: BagReader, system: str) -> list[tuple[TopicInfo, InputTopic]]:
    """Return the candidates of a tracker that have the name of none of its inputs."""
    entries = inputs_of(system)
    return [
        (topic, entry)
        for topic, entry in _candidates(bag, entries)
        if not any(each.is_named(topic.name) for each in entries)
    ]


def fitting_systems(bag: BagReader, topics: Topics = None) -> list[str]:
    """The trackers that find their inputs in `bag`, the one with the best evidence first.

    Evidence is, in this order: nothing that the tracker needs is missing, what it needs is not
    only what may be another instrument's, and how many different inputs there are. `topics` is as
    in `fitting_topics`; inputs it names that a tracker does not have exclude that tracker.
    """
    found: dict[str, tuple[bool, bool, int]] = {}
    for system in SYSTEMS:
        with suppress(BagError):
            inputs = instruments(bag, system, topics)
            found[system] = max(_evidence(bag, system, each) for each in inputs.values())
    return sorted(found, key=lambda system: found[system], reverse=True)


def system_in_mind(bag: BagReader) -> str:
    """The tracker for which most inputs could be there, if topics were named to it."""

    def could(system: str) -> tuple[bool, int, int]:
        candidates = _candidates(bag, every_input(system))
        entries = {entry.name: entry for _, entry in candidates if not entry.companion}.values()
        required = needed_inputs(system)[0]
        names = ' '.join(f'{topic.name} {topic.type_name}' for topic in bag.topics).lower()
        words = sum(word in names for word in SYSTEMS[system].words)
        return bool(entries) and fed(entries).issuperset(required), len(entries), words

    return max(SYSTEMS, key=could)


def ready_systems(bag: BagReader) -> list[str]:
    """Those of `fitting_systems` for which no input that the tracker needs is missing."""
    return [
        system
        for system in fitting_systems(bag)
        if any(_evidence(bag, system, each)[0] for each in instruments(bag, system).values())
    ]


def _evidence(
    bag: BagReader, system: str, fitting: Mapping[str, InputTopic]
) -> tuple[bool, bool, int]:
    types, there = types_of(bag), fed(fitting.values())
    sure = any(
        types[name] not in entry.second for name, entry in fitting.items() if not entry.companion
    )
    return there.issuperset(needed_inputs(system)[0]), sure, len(there)


def _matching(bag: BagReader, system: str, topics: Topics) -> dict[str, InputTopic]:
    """The inputs by topic name, those of several instruments together."""
    fitting = {
        topic.name: entry
        for topic in bag.topics
        for entry in inputs_of(system)
        if topic.type_name in entry.readers
        and entry.is_named(topic.name)
        and not is_truth(topic.name.rpartition('/')[0])
    }
    made = made_topics(bag, system)
    if topics is not None:
        chosen = {name: _mapped(bag, system, name, wanted) for name, wanted in topics.items()}
        wanted = {entry.name for entry in chosen.values()}
        beside = {
            name: entry
            for name, entry in (fitting | made).items()
            if wanted & set(entry.beside) and entry.name not in wanted and name not in chosen
        }
        return chosen | beside
    there = {entry.name for entry in fitting.values()}
    fitting |= {name: entry for name, entry in made.items() if entry.makes not in there}
    fitting |= _only_ones(bag, system, fitting)
    fitting = _of_use(bag, fitting | _sure_instead(bag, system, fitting))
    if all(entry.companion for entry in fitting.values()):
        raise BagError(_nothing_fits(bag, system))
    return fitting


def _only_ones(
    bag: BagReader, system: str, fitting: Mapping[str, InputTopic]
) -> dict[str, InputTopic]:
    """The topics without the name of an input that can be nothing but one that is missing: the
    only ones of its types."""
    there = fed(fitting.values())
    missing = set(needed_inputs(system)[0]) - there if there else set()
    found: dict[str, list[tuple[str, InputTopic]]] = {}
    for topic, entry in _nameless(bag, system):
        found.setdefault(entry.name, []).append((topic.name, entry))
    lone = (could[0] for name, could in found.items() if name in missing and len(could) == 1)
    return {name: entry for name, entry in lone if name not in fitting}


def _sure_instead(
    bag: BagReader, system: str, fitting: Mapping[str, InputTopic]
) -> dict[str, InputTopic]:
    """The one topic without the name of an input that is nobody else's instrument, where all that
    have such names may be: a pose, where the only fix is in latitude and longitude."""
    types = types_of(bag)
    primary = {name: entry for name, entry in fitting.items() if not entry.companion}
    if not all(types[name] in entry.second for name, entry in primary.items()):
        return {}
    wanted = {entry.name for entry in primary.values()}
    found = {
        topic.name: entry
        for topic, entry in _nameless(bag, system)
        if entry.name in wanted
        and topic.name not in fitting
        and topic.type_name not in entry.second
    }
    return found if len(found) == 1 else {}


def _of_use(bag: BagReader, fitting: Mapping[str, InputTopic]) -> dict[str, InputTopic]:
    """Without companions of what is not there, and without what may be another instrument's."""
    types, kept = types_of(bag), dict(fitting)
    second = [name for name, entry in fitting.items() if types[name] in entry.second]
    sure = [name for name, entry in kept.items() if name not in second and not entry.companion]
    for name in sorted(second if sure else ()):
        sentence = (
            f'topic {name} ({types[name]}) is left out, because {", ".join(sure)} says where '
            f'divers are; choose it with --topic {kept.pop(name).name}={name}'
        )
        if sentence not in bag.problems:
            bag.add_problem(sentence)
    inputs = fed(kept.values())
    return {n: entry for n, entry in kept.items() if not entry.beside or inputs & {*entry.beside}}


def fed(entries: Iterable[InputTopic]) -> set[str]:
    """The inputs of a tracker that these are, or are made into; what only describes images is made
    into nothing."""
    return {
        entry.makes or entry.name for entry in entries if not (entry.makes and entry.companion)
    }


def knows_inputs(system: str, names: Collection[str]) -> bool:
    """Whether a tracker, or a node before it, has inputs of all these names."""
    return {*names} <= {entry.name for entry in every_input(system)}


def _mapped(bag: BagReader, system: str, name: str, wanted: str) -> InputTopic:
    entries = {entry.name: entry for entry in every_input(system)}
    if wanted not in entries:
        raise BagError(
            f"the {system} tracker has no input '{wanted}'"
            f'{did_you_mean(wanted, entries)}; it has {", ".join(entries)}'
        )
    there = types_of(bag)
    if name not in there:
        raise BagError(f"{bag.path} has no topic '{name}'{did_you_mean(name, sorted(there))}")
    types = [topic.type_name for topic in bag.topics if topic.name == name]
    readers = entries[wanted].readers
    if readers.keys().isdisjoint(types):
        raise BagError(
            f'{name} is of type {types[0]}; the input {wanted} takes {", ".join(readers)}'
        )
    return entries[wanted]


def made_topics(bag: BagReader, system: str) -> dict[str, InputTopic]:
    """Topics of which a node before the tracker makes an input: by their type, or by their name
    too where the type holds other things as well."""
    return {
        topic.name: entry
        for entry in made_inputs(system)
        for topic in bag.topics
        if entry.may_be(topic.name, topic.type_name)
        and not is_truth(topic.name.rpartition('/')[0])
    }


def _nothing_fits(bag: BagReader, system: str) -> str:
    """Say what was looked for, what is there, and what could be meant."""
    wanted = ' or '.join(f"'{entry.name}'" for entry in inputs_of(system))
    if not bag.topics:
        return f'{bag.path} is empty: it has no topics'
    there = ', '.join(f'{topic.name} ({topic.type_name})' for topic in bag.topics)
    candidates = _candidates(bag, inputs_of(system))
    maybe = [f'{topic.name} as {entry.name}' for topic, entry in candidates]
    hint = f'; name the topic to use {" or ".join(maybe)}' if maybe else types_heard(system)
    return (
        f'{bag.path} has no topic for the {system} tracker, which hears {wanted}; '
        f'there are {there}{hint}'
    )


def types_heard(system: str) -> str:
    """Return which types the first inputs of a tracker take."""
    entries = [entry for entry in inputs_of(system) if not entry.companion][:TYPES_NAMED]
    takes = [f'{entry.name} takes {", ".join(entry.readers)}' for entry in entries]
    return f'. None is of a type that is heard: {"; ".join(takes)}'


class Received(NamedTuple):
    """What one message gave: a measurement, the `Rejection` that says why there is none, or None
    when it takes more messages to make one."""

    topic: str
    measurement: Any
    log_ns: int


def measurements_of(
    bag: BagReader,
    system: str,
    topics: Topics = None,
    *,
    world_frame: str = 'enu',
    order: str = 'recorded',
    settings: Mapping[str, Any] | None = None,
    detector: Mapping[str, Any] | None = None,
) -> Iterator[Received]:
    """Yield the measurements for the tracker `system` in an open recording, in replay order.

    `topics` is as in `fitting_topics`, `world_frame` (``'enu'`` or ``'ned'``) is what the
    recording uses, `order` is as in `BagReader.messages`. `settings` holds the parameters of the
    tracker by name; readers take those that concern them. `detector` holds the parameters of the
    detector of images that are not the default. Messages that deserve a warning are
    counted in ``bag.problems`` at the end. Raises `BagError` when no topic fits.
    """
    chosen = fitting_topics(bag, system, topics)
    known = settings or {}
    images = DetectedImages(system, detector or {}, known)
    readers = {
        (name, type_name): images.reader(entry, type_name)
        if entry.makes
        else entry.reader(type_name, world_frame, known, name)
        for name, entry in chosen.items()
        for type_name in entry.readers
    }
    doubts: Counter[tuple[str, str]] = Counter()
    for item in bag.messages(list(chosen), order=order):
        entry = chosen[item.topic]
        if item.type_name not in entry.readers:  # one topic name recorded with two types
            sentence = f'{item.topic} carries {item.type_name}, not readable as {entry.name}'
            yield Received(item.topic, Rejection('bad_type', sentence), item.log_ns)
            continue
        try:
            measurement = readers[item.topic, item.type_name](item.message)
            if (code := entry.doubt(item.message, measurement)) is not None:
                doubts[item.topic, code] += 1
        except Rejection as rejection:
            measurement = rejection
        yield Received(item.topic, measurement, item.log_ns)
    for (topic, code), count in doubts.items():
        bag.add_problem(f'topic {topic}: {count} messages {DOUBTS.get(code, code)}')


class DetectedImages:
    """Reads recorded images as detections, in recorded order, as the live detector does.

    Live, a message lies between detector and tracker, whose columns of four bytes round. So the
    offline tracker takes the detections through such a message too, and both have the same bits.
    """

    def __init__(self, system: str, detector: Mapping[str, Any], settings: Mapping[str, Any]):
        """detector: parameters of `DetectorConfig` that are not the default; settings: parameters
        of the tracker, by name. Raises `ConfigError`."""
        self._inputs = {entry.name: entry for entry in inputs_of(system)}
        self._settings = settings
        self._config = DetectorConfig.from_mapping(detector)
        self._detector = ImageDetector(self._config)

    def reader(self, entry: InputTopic, type_name: str) -> Callable[[Any], Detections | None]:
        """The reader of one topic, of images or beside them: from a message to detections, None
        while a scanning sonar is at its sweep. It raises `Rejection`."""
        made = self._inputs[entry.makes]
        read = entry.reader(type_name, 'enu', self._config.as_dict())
        again = made.reader('sensor_msgs/msg/PointCloud2', 'enu', self._settings)

        def detections(message: Any) -> Detections | None:
            image = read(message)
            if isinstance(image, SonarInfo):
                self._detector.describe(image)
                return None
            found = self._detector.process(image)
            return None if found is None else again(made.write(found, ros_message))

        return detections
