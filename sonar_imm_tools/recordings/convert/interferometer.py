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

"""From a bag of sonar images, amplitude and phase or one per stave, to array snapshots.

The images of a ping are those of one stamp, whatever the order in which they come. Navigation and
altitudes are copied to ``/nav`` and ``/altitude``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from msg_adapters.headers import stamp_ns
from msg_adapters.inputs import inputs_of
from msg_adapters.snapshots import FIELDS, snapshot_of_phase, snapshot_of_staves, write_snapshot
from sonar_imm.measurements import Snapshot

from ..conversion import companion_topics, ConversionReport, copied, write_from_bag
from ..convert_options import InterferometerOptions
from ..messages import ros_message
from ..reader import BagMessage, BagReader
from ..sources import BagError

FURTHER = {entry.name: entry for entry in inputs_of('bathymetry') if entry.companion}
MOST_WAITING = 64
"""Pings that wait for the rest of their images; the oldest is given up for one more."""


def convert_interferometer(path: str | Path, out: str | Path, **values: Any) -> ConversionReport:
    """Convert the bag at `path` to ``/snapshot``, or ``/<side>/snapshot``.

    values: as in `InterferometerOptions`, either amplitude and phase or iq; fields are those that
    differ from `FIELDS`. Raises `BagError`.
    """
    how = InterferometerOptions(**values)
    topics = _topics(how.amplitude, how.phase, how.iq)
    if unknown := [name for name in how.fields if name not in FIELDS]:
        raise BagError(f"unknown field '{unknown[0]}'; the names are {', '.join(FIELDS)}")
    reading: dict[str, Any] = {
        'fields': {**FIELDS, **how.fields},
        'side': how.side,
        'order': how.order,
        'sound_speed': how.sound_speed,
        'element_spacing': how.element_spacing,
    }
    make: Callable[..., Snapshot]
    if how.iq:
        make = partial(_of_staves, reading)
    else:
        make = partial(snapshot_of_phase, radians_per_count=how.radians_per_count, **reading)
    target = f'/{how.side}/snapshot' if how.side else '/snapshot'
    report = ConversionReport(Path(out))
    with BagReader(path) as bag:
        there = {topic.name for topic in bag.topics}
        if missing := [name for name in topics if name not in there]:
            raise BagError(
                f"{path} has no topic '{missing[0]}'; it has {', '.join(sorted(there))}"
            )
        beside = companion_topics(bag, FURTHER)
        pings = _Pings(topics)

        def written(item: BagMessage) -> tuple[str, Any] | None:
            if item.topic in beside:
                name = beside[item.topic]
                return f'/{name}', copied(FURTHER[name], item.type_name, item.message)
            images = pings.add(item)
            return None if images is None else (target, write_snapshot(make(*images), ros_message))

        chosen = [*set(topics), *beside]
        write_from_bag(out, bag, chosen, written, report, storage=how.storage)
        if pings.lonely:
            report.bad_rows += pings.lonely
            report.problems.append(
                f'{pings.lonely} pings have not all of their images: stamps have to be equal'
            )
        report.problems += bag.problems
    return report


def _of_staves(reading: Mapping[str, Any], *images: Any) -> Snapshot:
    return snapshot_of_staves(images, **reading)


def _topics(amplitude: str, phase: str, iq: Sequence[str]) -> list[str]:
    """The topic of each image of a ping."""
    if bool(amplitude) != bool(phase) or bool(amplitude) == bool(iq):
        raise BagError('name the topics of amplitude and phase, or those of the staves (iq)')
    if len(iq) == 1:
        raise BagError('an array has at least two staves; name the topic of each')
    return list(iq) or [amplitude, phase]


class _Pings:
    """Images that wait for the others of their ping. lonely: pings that never got them."""

    def __init__(self, topics: Sequence[str]):
        self._topics = topics
        self._waiting: dict[int, dict[int, Any]] = {}
        self._given_up = 0

    @property
    def lonely(self) -> int:
        return self._given_up + len(self._waiting)

    def add(self, item: Any) -> list[Any] | None:
        """Take an image in; gives all images of its ping when it is the last of them."""
        stamp = stamp_ns(item.message)
        images = self._waiting.setdefault(stamp, {})
        for place, topic in enumerate(self._topics):
            if topic == item.topic:
                images[place] = item.message
        if len(images) == len(self._topics):
            del self._waiting[stamp]
            return [images[place] for place in range(len(self._topics))]
        if len(self._waiting) > MOST_WAITING:
            del self._waiting[next(iter(self._waiting))]
            self._given_up += 1
        return None
