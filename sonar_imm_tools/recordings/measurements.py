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

from msg_adapters.inputs import DOUBTS
from sonar_imm.measurements import Rejection

from .detected import DetectedImages
from .reader import BagReader
from .topics import fitting_topics


class Heard(NamedTuple):
    """What one message gave: a measurement, the `Rejection` that says why there is none, or None
    when it takes more messages to make one."""

    topic: str
    measurement: Any
    log_ns: int


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
