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

"""Detections of recorded images, the same that the live detector makes.

Between detector and tracker lies a message, live. Its columns of four bytes round; so the offline
tracker takes the detections through such a message too, and both have the same bits.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from msg_adapters.inputs import inputs_of, InputTopic
from sonar_imm.measurements import Detections
from sonar_imm.trackers.obstacle.detector import DetectorConfig, ImageDetector

from .messages import ros_message


class DetectedImages:
    """Reads images as detections, in the order in which they were recorded."""

    def __init__(self, system: str, detector: Mapping[str, Any], settings: Mapping[str, Any]):
        """detector: parameters of `DetectorConfig` that are not the default; settings: parameters
        of the tracker, by name. Raises `ConfigError`."""
        self._inputs = {entry.name: entry for entry in inputs_of(system)}
        self._settings = settings
        self._config = DetectorConfig.from_mapping(detector)

    def reader(self, entry: InputTopic, type_name: str) -> Callable[[Any], Detections | None]:
        """The reader of one topic of images: from a message to detections, None while a scanning
        sonar is at its sweep. It raises `Rejection`."""
        made = self._inputs[entry.makes]
        read = entry.reader(type_name, 'enu', self._config.as_dict())
        again = made.reader('sensor_msgs/msg/PointCloud2', 'enu', self._settings)
        detector = ImageDetector(self._config)

        def detections(message: Any) -> Detections | None:
            found = detector.process(read(message))
            return None if found is None else again(made.write(found, ros_message))

        return detections
