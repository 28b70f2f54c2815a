# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Measurements of a recording, read by the same functions that the live nodes use."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from msg_adapters.inputs import DOUBTS, inputs_of, InputTopic
from sonar_imm.measurements import Detections, Rejection, SonarInfo
from sonar_imm.trackers.obstacle.detector import DetectorConfig, ImageDetector

from .messages import ros_message
from .reader import BagReader
from .topics import fitting_topics


class Received(NamedTuple):
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
