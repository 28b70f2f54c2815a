# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Images of a sonar, in a bag or as a folder of pictures, into another bag.

Of a forward-looking sonar to ``/detections`` for the obstacle tracker: every image gives one
message, also when nothing is found in it; of a scanning sonar every sweep does. Tracking a
recording of images does the same on the way (`DetectedImages`); here the detections are kept.

Of an interferometer, amplitude and phase or one image per stave, to array snapshots: the images of
a ping are those of one stamp, whatever the order in which they come.

Navigation and altitudes, which the trackers need too, are copied.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from functools import partial
import math
from pathlib import Path
from typing import Any

import numpy as np

from msg_adapters.detections import write_detections
from msg_adapters.headers import stamp_ns
from msg_adapters.inputs import bathymetry, inputs_of, InputTopic, made_inputs
from msg_adapters.snapshots import FIELDS, snapshot_of_phase, snapshot_of_staves, write_snapshot
from sonar_imm.measurements import MAX_IMAGE_CELLS, Rejection, Snapshot, SonarImage
from sonar_imm.trackers.obstacle.detector import detect, DetectorConfig

from ..conversion import ConversionReport, converter, new_bag
from ..convert_options import ImagesOptions, InterferometerOptions, PicturesOptions
from ..measurements import DetectedImages, made_topics, types_of
from ..messages import ros_message
from ..places import Degrees
from ..reader import BagMessage, BagReader
from ..sources import BagError
from ..table_files import CsvTable
from ..tables import Row
from ..times import BadRow
from .navigation import Message, Record, write_records

SYSTEM = 'obstacle'
FURTHER = {entry.name: entry for entry in inputs_of(SYSTEM)}
DETECTIONS = FURTHER.pop('detections')
Maker = Callable[[Any], Any]
"""From a message to one of our own, None where there is none yet. It raises `Rejection`."""


@converter(ImagesOptions)
def convert_images(path: Path, how: ImagesOptions, report: ConversionReport) -> None:
    """Find the echoes in all images of the bag at `path`."""
    config = DetectorConfig.from_mapping(how.parameters)
    report.notes['detector'] = ', '.join(f'{k} {v}' for k, v in config.as_dict().items())
    with BagReader(path) as bag:
        makers = _makers(bag, _image_topic(bag, how.topic), config)

        def make(item: BagMessage) -> Message | None:
            if (item.topic, item.type_name) not in makers:
                sentence = f'{type(item.message).__name__} is not what its topic holds otherwise'
                raise Rejection('bad_type', sentence)
            name, made = makers[item.topic, item.type_name]
            message = made(item.message)
            return None if message is None else (f'/{name}', message)

        _write_from_bag(bag, sorted({name for name, _ in makers}), make, report, how)
        report.problems += bag.problems


def _image_topic(bag: BagReader, wanted: str | None) -> str:
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


def _makers(
    bag: BagReader, images: str, config: DetectorConfig
) -> dict[tuple[str, str], tuple[str, Maker]]:
    """Name and maker of the output by topic and type: of images, and of the first topic of each
    further kind."""
    detected = DetectedImages(SYSTEM, config.as_dict(), {})
    makers: dict[tuple[str, str], tuple[str, Maker]] = {}
    described, types = made_topics(bag, SYSTEM), types_of(bag)
    image, info = made_inputs(SYSTEM)
    for topic in bag.topics:
        entry = image if topic.name == images else described.get(topic.name, image)
        if (topic.name == images or entry is info) and topic.type_name in entry.readers:
            read = detected.reader(entry, topic.type_name)
            makers[topic.name, topic.type_name] = DETECTIONS.name, partial(_detections, read)
    for topic_name, name in _companion_topics(bag, FURTHER).items():
        kind = types[topic_name]
        makers[topic_name, kind] = name, partial(_copied, FURTHER[name], kind)
    return makers


def _detections(read: Maker, message: Any) -> Any:
    measurement = read(message)
    return None if measurement is None else DETECTIONS.write(measurement, ros_message)


BESIDE = {entry.name: entry for entry in bathymetry.TOPICS if entry.companion}
MOST_WAITING = 64
"""Pings that wait for the rest of their images; the oldest is given up for one more."""


@converter(InterferometerOptions)
def convert_interferometer(
    path: Path, how: InterferometerOptions, report: ConversionReport
) -> None:
    """Convert the bag at `path` to ``/snapshot``, or ``/<side>/snapshot``."""
    if bool(how.amplitude) != bool(how.phase) or bool(how.amplitude) == bool(how.iq):
        raise BagError('name the topics of amplitude and phase, or those of the staves (iq)')
    if len(how.iq) == 1:
        raise BagError('an array has at least two staves; name the topic of each')
    topics = list(how.iq) or [how.amplitude, how.phase]
    if unknown := [name for name in how.fields if name not in FIELDS]:
        raise BagError(f"unknown field '{unknown[0]}'; the names are {', '.join(FIELDS)}")
    reading: dict[str, Any] = {
        'fields': {**FIELDS, **how.fields},
        'side': how.side,
        'order': how.order,
        'sound_speed': how.sound_speed,
        'element_spacing': how.element_spacing,
    }

    def snapshot(images: list[Any]) -> Snapshot:
        if how.iq:
            return snapshot_of_staves(images, **reading)
        return snapshot_of_phase(*images, radians_per_count=how.radians_per_count, **reading)

    target = f'/{how.side}/snapshot' if how.side else '/snapshot'
    with BagReader(path) as bag:
        there = {topic.name for topic in bag.topics}
        if missing := [name for name in topics if name not in there]:
            raise BagError(
                f"{path} has no topic '{missing[0]}'; it has {', '.join(sorted(there))}"
            )
        beside = _companion_topics(bag, BESIDE)

        waiting: dict[int, dict[int, Any]] = {}
        given_up = 0

        def make(item: BagMessage) -> Message | None:
            nonlocal given_up
            if item.topic in beside:
                name = beside[item.topic]
                return f'/{name}', _copied(BESIDE[name], item.type_name, item.message)
            stamp = stamp_ns(item.message)
            images = waiting.setdefault(stamp, {})
            images |= {k: item.message for k, topic in enumerate(topics) if topic == item.topic}
            if len(images) == len(topics):
                ping = waiting.pop(stamp)
                made = snapshot([ping[place] for place in range(len(topics))])
                return target, write_snapshot(made, ros_message)
            if len(waiting) > MOST_WAITING:
                del waiting[next(iter(waiting))]
                given_up += 1
            return None

        _write_from_bag(bag, [*set(topics), *beside], make, report, how)
        if lonely := given_up + len(waiting):
            report.bad_rows += lonely
            report.problems.append(
                f'{lonely} pings have not all of their images: stamps have to be equal'
            )
        report.problems += bag.problems


def _write_from_bag(
    bag: BagReader,
    topics: Collection[str],
    make: Callable[[BagMessage], Message | None],
    report: ConversionReport,
    how: Any,
) -> None:
    """Write a new bag of messages of another one, in recorded order and with their times. make:
    topic and message for one of `bag`, or None where there is none yet; those for which it raises
    `Rejection` are counted and named."""
    with new_bag(report, bag.path.name, how) as made:
        for item in bag.messages(topics):
            report.rows += 1
            written = None
            with report.leaving_out(bag.path, f'{item.topic} #{item.index}'):
                written = make(item)
            if written is not None:
                made.write(*written, item.log_ns)


def _companion_topics(bag: BagReader, wanted: Mapping[str, InputTopic]) -> dict[str, str]:
    """Inputs that a tracker needs beside what is converted, such as navigation: input name by
    topic, for the first topic of `bag` of each kind in `wanted`."""
    chosen = {}
    for name, entry in wanted.items():
        for topic in [topic for topic in bag.topics if topic.type_name in entry.readers][:1]:
            chosen[topic.name] = name
    return chosen


def _copied(entry: InputTopic, type_name: str, message: Any) -> Any:
    """The message of a bag as our own. Raises `Rejection`."""
    # A frame that calls itself NED is turned into ENU; others stay as they are, and whoever tracks
    # the new bag states their convention.
    ned = str(message.header.frame_id).endswith('_ned')
    measurement = entry.readers[type_name](message, world_frame='ned' if ned else 'enu')
    return entry.write(measurement, ros_message)


@converter(PicturesOptions)
def convert_pictures(path: Path, how: PicturesOptions, report: ConversionReport) -> None:
    """Convert a folder of PNG and JPEG, with a CSV of their stamps, to ``/detections``."""
    config = DetectorConfig.from_mapping(how.parameters)
    table = CsvTable(_table_of(path, how.table), how.options)
    table.require('stamp', 'file')
    degrees = Degrees(table) if table.has('latitude', 'longitude') else None

    def rows() -> Iterator[Record]:
        for row, record in report.read_rows(table, lambda row: _picture_row(row, degrees, how)):
            yield {**record, 'where': f'line {row.line}'}

    def messages(record: Record) -> Iterator[Message]:
        image = _picture(path, record, how.frame_id)
        yield '/detections', write_detections(detect(image, config), ros_message)

    write_records(path, rows(), report, how, messages)


def _table_of(folder: Path, named: Path | str | None) -> Path:
    if named is not None:
        return Path(named)
    found = sorted(folder.glob('*.csv'))
    if len(found) != 1:
        raise BagError(
            f'{folder} holds {len(found)} CSV files; name the one with the stamps by --table'
        )
    return found[0]


def _picture_row(row: Row, degrees: Degrees | None, how: PicturesOptions) -> Record:
    """What the table says of a picture. Raises `BadRow`."""
    usual = {'near_range': how.near_range, 'far_range': how.far_range, 'fov': how.fov}
    given = {name: row.optional(name) for name in usual}
    near, far, fov = (
        (default or 0.0) if math.isnan(given[name]) else given[name]
        for name, default in usual.items()
    )
    if not (0.0 <= near < far and 0.0 < fov <= 360.0):
        raise BadRow('does not say its ranges and directions: --far-range and --fov', 'geometry')
    place = row.optional('x'), row.optional('y')
    if degrees is not None:
        place = (math.nan, math.nan)
        if not row.empty('latitude', 'longitude'):
            place = degrees.unchecked(row)[::-1]
    return {
        'stamp_ns': row.stamp_ns(),
        'file': row.text('file'),
        'grid': (near, far, math.radians(fov)),
        'units': 'metres' if degrees is None else 'degrees',
        'place': place,
        'heading': row.optional('heading'),
        'depth': -row.height(),
    }


def _picture(folder: Path, record: Record, frame_id: str) -> SonarImage:
    """The image in a file: rows from near to far, columns from port to starboard."""
    try:
        from PIL import Image, UnidentifiedImageError
    except ImportError:
        raise BagError("pictures need Pillow: pip install 'sonar_imm[pictures]'") from None
    path = folder / record['file']
    if folder.resolve() not in path.resolve().parents:
        raise BadRow(f"'{record['file']}' lies outside of the folder", 'no picture')
    try:
        # By these names alone: other formats are read by programs that Pillow starts.
        with Image.open(path, formats=('PNG', 'JPEG')) as picture:
            if picture.width * picture.height > MAX_IMAGE_CELLS:
                raise BadRow(f"'{record['file']}' has too many pixels", 'no picture')
            pixels = np.asarray(picture.convert('F'), np.float64)
    except (OSError, UnidentifiedImageError, Image.DecompressionBombError, SyntaxError) as error:
        raise BadRow(f"'{record['file']}' cannot be read: {error}", 'no picture') from None
    near, far, fov = record['grid']
    rows, beams = pixels.shape
    return SonarImage(
        stamp_ns=record['stamp_ns'],
        range=near + (far - near) * (np.arange(rows) + 0.5) / rows,
        bearing=fov * (0.5 - (np.arange(beams) + 0.5) / beams),
        amplitude=pixels,
        frame_id=frame_id,
    )
