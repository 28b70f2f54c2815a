# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Which topics of a recording feed which tracker."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Mapping
import itertools
import re

from msg_adapters.inputs import inputs_of, InputTopic, made_inputs, needed
from sonar_imm.parameters import did_you_mean
from sonar_imm.trackers import SYSTEMS

from .reader import BagReader
from .sources import BagError, TopicInfo


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


def fitting_topics(
    bag: BagReader, system: str, topics: Mapping[str, str] | None = None
) -> dict[str, InputTopic]:
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
    bag: BagReader, system: str, topics: Mapping[str, str] | None = None
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
    sentences = []
    for instrument, inputs in found.items():
        name = f'{system} {instrument}'.strip()
        sentences += [
            f'{name} <- {topic} as {entry.name} ({counts[topic]} messages)'
            for topic, entry in inputs.items()
        ]
    used = {topic for inputs in found.values() for topic in inputs}
    for topic in bag.topics:
        if topic.name in used or is_truth(topic.name):
            continue
        entries = [entry for entry in inputs_of(system) if _can_read(topic, entry)]
        could = [e.name for e in entries if e.may_be(topic.name, topic.type_name)]
        seconds = [entry for entry in entries if topic.type_name in entry.second]
        # What has the name of an input and is not used would only help what is not there.
        if could and (seconds or not any(entry.is_named(topic.name) for entry in entries)):
            why = ": the ship's own position?" if seconds else ';'
            sentences.append(
                f'ignored: {topic.name} ({topic.count} messages){why} --topic '
                f'{could[0]}={topic.name} would take it'
            )
    return sentences


TYPES_NAMED = 3


def fitting_systems(bag: BagReader, topics: Mapping[str, str] | None = None) -> list[str]:
    """The trackers that find their inputs in `bag`, the one with the best evidence first.

    Evidence is, in this order: nothing that the tracker needs is missing, what it needs is not
    only what may be another instrument's, and how many different inputs there are. `topics` is as
    in `fitting_topics`; inputs it names that a tracker does not have exclude that tracker.
    """
    found: dict[str, tuple[bool, bool, int]] = {}
    for system in SYSTEMS:
        try:
            inputs = instruments(bag, system, topics)
        except BagError:
            continue
        found[system] = max(_evidence(bag, system, each) for each in inputs.values())
    return sorted(found, key=lambda system: found[system], reverse=True)


def system_in_mind(bag: BagReader) -> str:
    """The tracker for which most inputs could be there, if topics were named to it."""

    def could(system: str) -> tuple[bool, int, int]:
        entries = [
            entry
            for entry in every_input(system)
            if not entry.companion
            and any(
                entry.may_be(topic.name, topic.type_name) and not is_truth(topic.name)
                for topic in bag.topics
            )
        ]
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
    types = types_of(bag)
    there = fed(fitting.values())
    required = needed_inputs(system)[0]
    sure = any(
        types[name] not in entry.second for name, entry in fitting.items() if not entry.companion
    )
    return there.issuperset(required), sure, len(there)


def _matching(
    bag: BagReader, system: str, topics: Mapping[str, str] | None
) -> dict[str, InputTopic]:
    """The inputs by topic name, those of several instruments together."""
    fitting = {
        topic.name: entry
        for topic in bag.topics
        for entry in inputs_of(system)
        if _can_read(topic, entry)
        and entry.is_named(topic.name)
        and not is_truth(topic.name.rpartition('/')[0])
    }
    if topics is not None:
        chosen = {name: _mapped(bag, system, name, wanted) for name, wanted in topics.items()}
        wanted = {entry.name for entry in chosen.values()}
        beside = {
            name: entry
            for name, entry in (fitting | made_topics(bag, system)).items()
            if wanted & set(entry.beside) and entry.name not in wanted and name not in chosen
        }
        return chosen | beside
    there = {entry.name for entry in fitting.values()}
    fitting |= {
        name: entry for name, entry in made_topics(bag, system).items() if entry.makes not in there
    }
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
    if not there:
        return {}
    missing = set(needed_inputs(system)[0]) - there
    found = {}
    for entry in inputs_of(system):
        could = [
            topic.name
            for topic in bag.topics
            if entry.may_be(topic.name, topic.type_name)
            and not is_truth(topic.name)
            and not any(each.is_named(topic.name) for each in inputs_of(system))
        ]
        if entry.name in missing and len(could) == 1 and could[0] not in fitting:
            found[could[0]] = entry
    return found


def _sure_instead(
    bag: BagReader, system: str, fitting: Mapping[str, InputTopic]
) -> dict[str, InputTopic]:
    """The one topic without the name of an input that is nobody else's instrument, where all that
    have such names may be: a pose, where the only fix is in latitude and longitude."""
    types = types_of(bag)
    primary = {name: entry for name, entry in fitting.items() if not entry.companion}
    if not primary or not all(types[name] in entry.second for name, entry in primary.items()):
        return {}
    wanted = {entry.name: entry for entry in primary.values()}
    found = {
        topic.name: entry
        for topic in bag.topics
        for entry in wanted.values()
        if topic.name not in fitting
        and topic.type_name not in entry.second
        and entry.may_be(topic.name, topic.type_name)
        and not any(each.is_named(topic.name) for each in inputs_of(system))
        and not is_truth(topic.name)
    }
    return found if len(found) == 1 else {}


def _of_use(bag: BagReader, fitting: Mapping[str, InputTopic]) -> dict[str, InputTopic]:
    """Without companions of what is not there, and without what may be another instrument's."""
    types = types_of(bag)
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
    inputs = fed(kept.values())
    return {
        name: entry
        for name, entry in kept.items()
        if not entry.beside or inputs & set(entry.beside)
    }


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
    """Check one entry of a topic map."""
    entries = {entry.name: entry for entry in every_input(system)}
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
        if entry.may_be(topic.name, topic.type_name)
        and not is_truth(topic.name.rpartition('/')[0])
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
        if entry.may_be(topic.name, topic.type_name) and not is_truth(topic.name)
    ]
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
