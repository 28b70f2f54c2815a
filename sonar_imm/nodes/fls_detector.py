# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Echoes in live sonar images: ``ros2 run sonar_imm fls_detector_node``.

Hears ``image`` and publishes ``detections``, what the obstacle node hears, one message per image
(of a scanning sonar one per sweep). Images that no package here can decode are said at the start.

Where marine_interfaces is installed, ``sonar_info`` beside the images counts in place of the
parameters that say what a sample is and how long an echo.

Every image is answered on ``~/processed``, as the trackers answer their messages; there,
`estimates` counts the messages of detections and `listeners` those who hear them.
"""

from __future__ import annotations

if __name__ == '__main__':
    from ..threads import one_blas_thread
    from .stopping import stopper

    stopper.listen()
    one_blas_thread()  # before numpy is imported

from collections.abc import Callable
import sys
from typing import Any

from msg_adapters.detections import write_detections
from msg_adapters.inputs import InputTopic

from ..intake import KnownFrames
from ..measurements import SonarInfo
from ..node_config import DetectorNodeConfig
from ..trackers.obstacle.detector import DetectorConfig, ImageDetector
from .base import BaseNode, TABLE
from .messages import make, message_class
from .qos import output_qos
from .running import run

NAME = 'fls_detector'


class FlsDetectorNode(BaseNode):
    """One message of detections for every image."""

    def __init__(self, **options: Any):
        """Raises `ConfigError` for parameters that cannot be used, and when the type of the images
        is not installed."""
        super().__init__(NAME, (DetectorConfig, DetectorNodeConfig), **options)
        self.begin()

    def prepare(self) -> None:
        """The detector, and its output."""
        self._detector = ImageDetector(self._settings[DetectorConfig])
        self._frames = KnownFrames()
        self._detections = self._endpoints.advertise(
            message_class(TABLE),
            'detections',
            output_qos(),
            matched=lambda: self._acknowledge(None),
        )

    def take(self, topic: InputTopic, reader: Callable[[Any], Any], message: Any) -> None:
        """Detect and publish."""
        image = reader(message)
        if isinstance(image, SonarInfo):
            self._detector.describe(image)
            return
        self._frames.admit(image)
        found = self._detector.process(image)
        if found is not None:
            self._detections.publish(write_detections(found, make))
            self._published += 1

    def start_afresh(self) -> None:
        """Forget the sweep of a scanning sonar."""
        before, self._detector = self._detector, ImageDetector(self._settings[DetectorConfig])
        self._detector.infos = before.infos

    def work_report(self) -> dict[str, Any]:
        """How many messages of detections there were."""
        return {
            'enabled': True,
            'counts': {'published': self._published, **self._errors},
            'health': {},
        }

    def answer(self) -> dict[str, int]:
        """The row on ``~/processed``."""
        return {**super().answer(), 'listeners': self._detections.get_subscription_count()}

    def message_words(self, name: str) -> str:
        """What a message is called in a sentence."""
        return 'an image'


def main(args: list[str] | None = None) -> int:
    """Run the node until it is told to stop; gives the exit code."""
    return run(FlsDetectorNode, args)


if __name__ == '__main__':
    sys.exit(stopper.end(main()))
