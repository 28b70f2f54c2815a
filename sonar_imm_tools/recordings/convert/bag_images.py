# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""From a bag with images of a sonar to another bag.

Of a forward-looking sonar to ``/detections`` for the obstacle tracker: every image gives one
message, also when nothing is found in it; of a scanning sonar every sweep does. Tracking a
recording of images does the same on the way (`DetectedImages`); here the detections are kept.

Of an interferometer, amplitude and phase or one image per stave, to array snapshots: the images of
a ping are those of one stamp, whatever the order in which they come.

Navigation and altitudes, which the trackers need too, are copied.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from msg_adapters.headers import stamp_ns
from msg_adapters.inputs import bathymetry, inputs_of, InputTopic, made_inputs
from msg_adapters.snapshots import FIELDS, snapshot_of_phase, snapshot_of_staves, write_snapshot
from sonar_imm.measurements import Rejection, Snapshot
from sonar_imm.trackers.obstacle.detector import DetectorConfig

from ..conversion import ConversionReport, converter, provenance
from ..convert_options import ImagesOptions, InterferometerOptions
from ..measurements import DetectedImages
from ..messages import ros_message
from ..reader import BagMessage, BagReader
from ..sources import BagError
from ..topics import made_topics, types_of
from ..writer import BagWriter

SYSTEM = 'obstacle'
FURTHER = {entry.name: entry for entry in inputs_of(SYSTEM) if entry.name != 'detections'}


@converter(ImagesOptions)
def convert_images(path: Path, how: ImagesOptions, report: ConversionReport) -> None:
    """Find the echoes in all images of the bag at `path`."""
    config = DetectorConfig.from_mapping(how.parameters)
    report.notes['detector'] = ', '.join(f'{k} {v}' for k, v in config.as_dict().items())
    with BagReader(path) as bag:
        images = _image_topic(bag, how.topic)
        readers = _readers(bag, images, config)

        def make(item: BagMessage) -> tuple[str, Any] | None:
            name, read = readers.get((item.topic, item.type_name), ('', _wrong_type))
            message = read(item.message)
            return None if message is None else (f'/{name}', message)

        topics = sorted({name for name, _ in readers})
        _write_from_bag(bag, topics, make, report, how.storage)
        report.problems += bag.problems


def _image_topic(bag: BagReader, wanted: str | None) -> str:
    """The topic with the images."""
    entry = made_inputs(SYSTEM)[0]
    if wanted is not None:
        if not any(t.name == wanted and t.type_name in entry.readers for t in bag.topics):
            raise BagError(f'{bag.path} has no topic {wanted} with {" or ".join(entry.readers)}')
        return wanted
    found = [name for name, each in made_topics(bag, SYSTEM).items() if each is entry]
    if not found:
        raise BagError(f'{bag.path} has no topic with {" or ".join(entry.readers)}')
    if len(found) > 1:
        raise BagError(
            f'several topics of {bag.path} hold images: {", ".join(found)}; choose one with '
            f'--topic {found[0]}'
        )
    return found[0]


def _readers(
    bag: BagReader, images: str, config: DetectorConfig
) -> dict[tuple[str, str], tuple[str, Callable[[Any], Any]]]:
    """Name of the output, and what makes a message of a message, by topic and type: of images, and
    of the first topic of each further kind."""
    detected = DetectedImages(SYSTEM, config.as_dict(), {})
    detections = next(entry for entry in inputs_of(SYSTEM) if entry.name == 'detections')
    readers: dict[tuple[str, str], tuple[str, Callable[[Any], Any]]] = {}
    described = made_topics(bag, SYSTEM)
    image, info = made_inputs(SYSTEM)
    for topic in bag.topics:
        entry = image if topic.name == images else described.get(topic.name, image)
        if (topic.name == images or entry is info) and topic.type_name in entry.readers:
            read = detected.reader(entry, topic.type_name)
            readers[topic.name, topic.type_name] = (
                detections.name,
                partial(_detections, detections, read),
            )
    types = types_of(bag)
    for topic_name, name in _companion_topics(bag, FURTHER).items():
        kind = types[topic_name]
        readers[topic_name, kind] = name, partial(_copied, FURTHER[name], kind)
    return readers


def _detections(entry: InputTopic, read: Callable[[Any], Any], message: Any) -> Any:
    measurement = read(message)
    return None if measurement is None else entry.write(measurement, ros_message)


def _wrong_type(message: Any) -> Any:
    raise Rejection('bad_type', f'{type(message).__name__} is not what its topic holds otherwise')


BESIDE = {entry.name: entry for entry in bathymetry.TOPICS if entry.companion}
MOST_WAITING = 64
"""Pings that wait for the rest of their images; the oldest is given up for one more."""


@converter(InterferometerOptions)
def convert_interferometer(
    path: Path, how: InterferometerOptions, report: ConversionReport
) -> None:
    """Convert the bag at `path` to ``/snapshot``, or ``/<side>/snapshot``."""
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
    with BagReader(path) as bag:
        there = {topic.name for topic in bag.topics}
        if missing := [name for name in topics if name not in there]:
            raise BagError(
                f"{path} has no topic '{missing[0]}'; it has {', '.join(sorted(there))}"
            )
        beside = _companion_topics(bag, BESIDE)
        pings = _Pings(topics)

        def written(item: BagMessage) -> tuple[str, Any] | None:
            if item.topic in beside:
                name = beside[item.topic]
                return f'/{name}', _copied(BESIDE[name], item.type_name, item.message)
            images = pings.add(item)
            return None if images is None else (target, write_snapshot(make(*images), ros_message))

        _write_from_bag(bag, [*set(topics), *beside], written, report, how.storage)
        if pings.lonely:
            report.bad_rows += pings.lonely
            report.problems.append(
                f'{pings.lonely} pings have not all of their images: stamps have to be equal'
            )
        report.problems += bag.problems


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


def _write_from_bag(
    bag: BagReader,
    topics: Collection[str],
    make: Callable[[BagMessage], tuple[str, Any] | None],
    report: ConversionReport,
    storage: str,
) -> None:
    """Write a new bag of messages of another one, in recorded order and with their times. make:
    topic and message for one of `bag`, or None where there is none yet; those for which it raises
    `Rejection` are counted and named."""
    notes = provenance(bag.path.name, report.notes)
    with BagWriter(report.path, storage=storage, custom_data=notes) as made:
        for item in bag.messages(topics):
            report.rows += 1
            written = None
            with report.leaving_out(bag.path, f'{item.topic} #{item.index}'):
                written = make(item)
            if written is not None:
                topic, message = written
                made.write(topic, message, item.log_ns)
                report.messages[topic] += 1


def _companion_topics(bag: BagReader, wanted: Mapping[str, InputTopic]) -> dict[str, str]:
    """Inputs that a tracker needs beside what is converted, such as navigation: input name by
    topic, for the first topic of `bag` of each kind in `wanted`."""
    chosen = {}
    for name, entry in wanted.items():
        fitting = [topic.name for topic in bag.topics if topic.type_name in entry.readers]
        if fitting:
            chosen[fitting[0]] = name
    return chosen


def _copied(entry: InputTopic, type_name: str, message: Any) -> Any:
    """The message of a bag as our own. Raises `Rejection`."""
    # A frame that calls itself NED is turned into ENU; others stay as they are, and whoever tracks
    # the new bag states their convention.
    ned = str(message.header.frame_id).endswith('_ned')
    measurement = entry.readers[type_name](message, world_frame='ned' if ned else 'enu')
    return entry.write(measurement, ros_message)
