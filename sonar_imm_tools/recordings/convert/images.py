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

"""From images of a forward-looking sonar to detections for the obstacle tracker, bag to bag.

Every image gives one message on ``/detections``, also when nothing is found in it; of a scanning
sonar every sweep does. Navigation and altitudes, which the tracker needs too, are copied to
``/nav`` and ``/altitude``. Tracking a recording of images does the same on the way
(`DetectedImages`); here the detections are kept.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from msg_adapters.inputs import inputs_of, InputTopic, made_inputs
from sonar_imm.measurements import Rejection
from sonar_imm.trackers.obstacle.detector import DetectorConfig

from ..conversion import companion_topics, ConversionReport, copied, write_from_bag
from ..convert_options import ImagesOptions
from ..measurements import DetectedImages
from ..messages import ros_message
from ..reader import BagMessage, BagReader
from ..sources import BagError
from ..topics import made_topics

SYSTEM = 'obstacle'
FURTHER = {entry.name: entry for entry in inputs_of(SYSTEM) if entry.name != 'detections'}


def convert_images(path: str | Path, out: str | Path, **values: Any) -> ConversionReport:
    """Find the echoes in all images of the bag at `path`.

    values: as in `ImagesOptions`; parameters are those of `DetectorConfig` by name. Messages that
    cannot be used are counted and named. Raises `ConfigError`, and `BagError` when the bag has no
    images.
    """
    how = ImagesOptions(**values)
    config = DetectorConfig.from_mapping(how.parameters)
    report = ConversionReport(Path(out))
    report.notes['detector'] = ', '.join(f'{k} {v}' for k, v in config.as_dict().items())
    with BagReader(path) as bag:
        images = _image_topic(bag, how.topic)
        readers = _readers(bag, images, config)

        def make(item: BagMessage) -> tuple[str, Any] | None:
            name, read = readers.get((item.topic, item.type_name), ('', _wrong_type))
            message = read(item.message)
            return None if message is None else (f'/{name}', message)

        topics = sorted({name for name, _ in readers})
        write_from_bag(out, bag, topics, make, report, storage=how.storage)
        report.problems += bag.problems
    return report


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
    types = {topic.name: topic.type_name for topic in bag.topics}
    for topic_name, name in companion_topics(bag, FURTHER).items():
        kind = types[topic_name]
        readers[topic_name, kind] = name, partial(copied, FURTHER[name], kind)
    return readers


def _detections(entry: InputTopic, read: Callable[[Any], Any], message: Any) -> Any:
    measurement = read(message)
    return None if measurement is None else entry.write(measurement, ros_message)


def _wrong_type(message: Any) -> Any:
    raise Rejection('bad_type', f'{type(message).__name__} is not what its topic holds otherwise')
