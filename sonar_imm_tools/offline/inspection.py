# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What is in a recording, which tracker it suits, and what is wrong with it."""

from __future__ import annotations

from array import array
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from typing import Any

from attrs import define, field
import numpy as np

from msg_adapters.headers import stamp_ns
from msg_adapters.inputs import inputs_of, InputTopic
from sonar_imm.measurements import Fix, GeodeticFix, Rejection
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.diver.polling import BEFORE, turn_of

from .. import SECOND
from ..recordings.measurements import (
    every_input,
    fed,
    fitting_systems,
    instruments,
    is_truth,
    needed_inputs,
)
from ..recordings.reader import BagMessage, BagReader, TopicInfo

MOST_FIXES = 1000
"""Fixes of a topic by which it is told whether each has a stamp of its own."""
LONG_GAP = 10.0
"""A gap is reported when it is this many times the usual time between two messages."""


@define
class _Found:
    topic: TopicInfo
    logs: array[int] = field(factory=lambda: array('q'))
    stamps: array[int] = field(factory=lambda: array('q'))
    frames: Counter[str] = field(factory=Counter)
    no_stamp: int = 0
    good: Counter[tuple[str, str]] = field(factory=Counter)
    refused: dict[tuple[str, str], Counter[str]] = field(factory=dict)
    doubts: Counter[str] = field(factory=Counter)
    examples: dict[str, str] = field(factory=dict)
    missing: dict[str, tuple[str, ...]] = field(factory=dict)
    """By system: parameters without which it cannot use the topic."""
    fixes: list[tuple[int, float, float]] = field(factory=list)


def inspect(
    bag: BagReader,
    advance: Callable[[int], None] = lambda count: None,
    detector: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Read a whole open recording. Gives plain values, fit for JSON.

    detector: what readers of images have to be told, by the names of its parameters.
    topics: one entry per topic with count, rate, frames, scans, the tracker inputs it suits and
    its problems. problems: of the recording as a whole. systems: topics by input for each tracker,
    the best fitting one first. topic_options: topic by input that has to be named to the tracker;
    nothing where the names say enough. missing: parameters that have to be told to each tracker.
    """
    found = {topic.name: _Found(topic) for topic in bag.topics}
    for item in bag.messages():
        advance(1)
        _look_at(item, found[item.topic], detector or {})
    topics = [_topic_entry(entry) for entry in found.values()]
    first = min((entry.logs[0] for entry in found.values() if entry.logs), default=0)
    last = max((entry.logs[-1] for entry in found.values() if entry.logs), default=0)
    systems, options = _systems(bag, list(found.values()))
    missing = {
        system: sorted({n for each in found.values() for n in each.missing.get(system, ())})
        for system in systems
    }
    return {
        'bag': str(bag.path),
        'duration_s': (last - first) / SECOND,
        'messages': sum(len(entry.logs) for entry in found.values()),
        'topics': topics,
        'systems': systems,
        'topic_options': options,
        'missing': missing,
        'problems': list(bag.problems),
    }


def _look_at(item: BagMessage, found: _Found, detector: Mapping[str, Any]) -> None:
    found.logs.append(item.log_ns)
    header = getattr(item.message, 'header', None)
    if header is not None:
        found.frames[str(header.frame_id)] += 1
        try:
            stamp = stamp_ns(item.message)
        except Rejection:
            stamp = 0
        if stamp > 0:
            found.stamps.append(stamp)
        else:
            found.no_stamp += 1
    for system, entry in [] if is_truth(item.topic) else _readers(item):
        try:
            settings = detector if entry.makes else {}
            made = entry.reader(item.type_name, 'enu', settings)(item.message)
            found.good[system, entry.name] += 1
            if isinstance(made, (Fix, GeodeticFix)) and len(found.fixes) < MOST_FIXES:
                if isinstance(made, Fix):
                    place = made.position[:2].tolist()
                else:  # metres east and north nearly
                    place = [111e3 * made.longitude * np.cos(np.radians(made.latitude))]
                    place.append(111e3 * made.latitude)
                found.fixes.append((made.stamp_ns, *place))
            if (code := entry.doubt(item.message, made)) is not None:
                found.doubts[code] += 1
        except Rejection as rejection:
            found.refused.setdefault((system, entry.name), Counter())[rejection.reason] += 1
            found.examples.setdefault(rejection.reason, rejection.sentence)
            if rejection.missing:
                found.good[system, entry.name] += 1
                found.missing[system] = rejection.missing


def _readers(item: BagMessage) -> list[tuple[str, InputTopic]]:
    """The tracker inputs that a message could be for."""
    found = []
    for system in SYSTEMS:
        fitting = [each for each in every_input(system) if each.may_be(item.topic, item.type_name)]
        # Of several inputs that a name says, the later one counts, as in `fitting_topics`.
        named = [entry for entry in fitting if entry.is_named(item.topic)][-1:]
        found += [(system, entry) for entry in named or fitting]
    return found


def _topic_entry(found: _Found) -> dict[str, Any]:
    span = (found.logs[-1] - found.logs[0]) / SECOND if found.logs else 0.0
    scans = None  # of a topic of scans: how many stamps, and the most messages that share one
    if found.stamps and _holds_scans(found):
        counts = np.unique(np.array(found.stamps, np.int64), return_counts=True)[1]
        scans = {'count': len(counts), 'most': int(counts.max())}
    return {
        'name': found.topic.name,
        'type': found.topic.type_name,
        'count': found.topic.count,
        'rate_hz': (len(found.logs) - 1) / span if span > 0 else None,
        'frames': list(found.frames),
        'suits': [f'{system} {name}' for system, name in found.good],
        'scans': scans,
        'problems': _stamp_problems(found) + _content_problems(found) + _scan_hint(found),
    }


def _scan_hint(found: _Found) -> list[str]:
    """What to do about fixes of several divers, each with a stamp of its own."""
    if len(found.fixes) <= BEFORE:
        return []
    stamps = np.array([stamp for stamp, _, _ in found.fixes], np.int64)
    order = np.argsort(stamps, kind='stable')
    turn = turn_of(stamps[order], np.array([place for _, *place in found.fixes])[order])
    if turn is None:
        return []
    period = turn.seconds
    if turn.offset is not None:
        return [
            f'two groups of fixes take turns and lie {turn.offset:.2g} m apart, always the same '
            'way: two sensors of one target with an offset need a frame each; of two divers, '
            f'--set scan_period={period:.3g} makes scans'
        ]
    return [
        f'every fix has a stamp of its own, and each diver comes again after {period:.3g} s: '
        f'where the sensor rotates or polls, --set scan_period={period:.3g} makes scans of them'
    ]


def _holds_scans(found: _Found) -> bool:
    """Whether messages with equal stamps are one scan of several targets, not repetitions."""
    return is_truth(found.topic.name) or any(
        entry.scans
        for system, name in found.good
        for entry in inputs_of(system)
        if entry.name == name
    )


def _stamp_problems(found: _Found) -> list[str]:
    problems = []
    if found.no_stamp:
        problems.append(f'{found.no_stamp} messages without a usable stamp')
    steps = np.diff(np.array(found.stamps, np.int64))
    if backward := int(np.count_nonzero(steps < 0)):
        problems.append(
            f'{backward} stamps older than the one before, by up to {-steps.min() / SECOND:.3g} s'
        )
    repeated = int(np.count_nonzero(steps == 0))
    if repeated and not _holds_scans(found):
        problems.append(f'{repeated} stamps equal to the one before')
    forward = steps[steps > 0]
    if len(forward) > 2 and forward.max() > LONG_GAP * np.median(forward):
        gaps = int(np.count_nonzero(forward > LONG_GAP * np.median(forward)))
        problems.append(
            f'{gaps} gaps in the stamps, the longest {forward.max() / SECOND:.3g} s '
            f'against {np.median(forward) / SECOND:.3g} s usually'
        )
    return problems


def _content_problems(found: _Found) -> list[str]:
    """Problems of messages; refusals only for the input that the topic suits or is named after."""
    problems = []
    if len(found.frames) > 1 and ('diver', 'relative') not in found.good:  # there names of targets
        problems.append(f'several frames: {", ".join(map(repr, found.frames))}')
    for key, reasons in found.refused.items():
        if key in found.good or found.topic.name.split('/')[-1] == key[1]:
            problems += [
                f'{count} messages refused as {key[1]} ({reason}): {found.examples[reason]}'
                for reason, count in reasons.items()
            ]
    problems += [
        f'{count} messages with {code.replace("_", " ")}' for code, count in found.doubts.items()
    ]
    return problems


Inputs = dict[str, list[str]]
"""Topics by input."""


def _systems(
    bag: BagReader, topics: list[_Found]
) -> tuple[dict[str, Inputs], dict[str, dict[str, str]]]:
    """Topics by input for each tracker that can use the recording, the best fitting one first, and
    what has to be named to it.

    First come trackers whose inputs have their names, in the order of `fitting_systems`. Others
    follow, by the number of their inputs, unless they would only take what is named after an
    input of those.
    """
    found: dict[str, Inputs] = {}
    good: Counter[tuple[str, str, str]] = Counter()
    for topic in topics:
        for (system, name), count in topic.good.items():
            found.setdefault(system, {}).setdefault(name, []).append(topic.topic.name)
            good[system, name, topic.topic.name] = count
    systems: dict[str, Inputs] = {}
    options: dict[str, dict[str, str]] = {}
    for system in fitting_systems(bag):
        every = instruments(bag, system).values()
        named = {entry.name for inputs in every for entry in inputs.values()}
        if _enough(system, named & found.get(system, {}).keys()):
            systems[system], options[system] = found[system], {}
    taken = {
        recorded.name
        for system in systems
        for each in instruments(bag, system).values()
        for recorded in bag.topics
        if recorded.name in each
    }
    for system in sorted(found.keys() - systems.keys(), key=lambda name: -len(found[name])):
        chosen: dict[str, str] = {}
        for key, _ in good.most_common():
            if key[0] == system and key[1] not in chosen and key[2] not in chosen.values():
                chosen[key[1]] = key[2]
        primary = {_entry(system, name).companion for name in chosen}
        free = any(t not in taken and not _entry(system, n).companion for n, t in chosen.items())
        if False in primary and free and _enough(system, chosen.keys()):
            systems[system], options[system] = found[system], chosen
    return systems, options


def _entry(system: str, name: str) -> InputTopic:
    return next(entry for entry in every_input(system) if entry.name == name)


def _enough(system: str, names: Collection[str]) -> bool:
    """Whether a tracker with the default parameters can do something with these inputs."""
    there = fed(_entry(system, name) for name in names)
    required, one_of = needed_inputs(system)
    return there.issuperset(required) and (not one_of or not there.isdisjoint(one_of))
