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

"""Echoes in live sonar images: ``ros2 run sonar_imm fls_detector_node``.

Hears ``image`` and publishes ``detections``, what the obstacle node hears, one message per image
(of a scanning sonar one per sweep). Images that no package here can decode are said at the start.

Every image is answered on ``~/processed``, as the trackers answer their messages; there,
`estimates` counts the messages of detections and `listeners` those who hear them.
"""

from __future__ import annotations

if __name__ == '__main__':
    from ..threads import one_blas_thread
    from .stopping import stopper

    stopper.listen()
    one_blas_thread()  # before numpy is imported

from collections import Counter
from collections.abc import Mapping
import sys
import time
import traceback
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.node import Node

from msg_adapters.detections import write_detections
from msg_adapters.inputs import inputs_of

from ..measurements import FrameGuard, Rejection
from ..node_config import DetectorNodeConfig, type_specs
from ..parameters import ConfigError
from ..trackers.obstacle.detector import DetectorConfig, ImageDetector
from .answers import Answers
from .base import run
from .diagnostics import Announcer, Meter, Reporter
from .messages import make, message_class
from .parameters import NodeParameters
from .qos import Endpoints, input_qos, latched_qos, output_qos

NAME = 'fls_detector'


class FlsDetectorNode(Node):
    """One message of detections for every image."""

    def __init__(self, **options: Any):
        """Raises `ConfigError` for parameters that cannot be used, and when the type of the images
        is not installed."""
        super().__init__(NAME, **options)
        (topic,) = inputs_of(NAME)
        settings = NodeParameters(self, (DetectorConfig, DetectorNodeConfig), type_specs(NAME))
        self._config = settings[DetectorConfig]
        self._node_config = settings[DetectorNodeConfig]
        type_name = settings.choice('image_type')
        self._read = topic.reader(type_name, 'enu', self._config.as_dict())
        self._detector = ImageDetector(self._config)
        self._detector.warm()
        self._guard = FrameGuard()
        self._meter = Meter()
        self._errors: Counter[str] = Counter()
        self._published = 0
        try:
            image_class = message_class(type_name)
        except ImportError as error:
            raise ConfigError(str(error)) from None
        self._endpoints = Endpoints(self)
        table = message_class('sensor_msgs/msg/PointCloud2')
        self._answers = Answers(self._endpoints.advertise(table, '~/processed', latched_qos()))
        self._detections = self._endpoints.advertise(
            table, 'detections', output_qos(), matched=lambda: self._acknowledge(None)
        )
        self._announcer = Announcer(self._endpoints, self.get_fully_qualified_name().lstrip('/'))
        heard = self._endpoints.subscribe(
            image_class,
            topic.name,
            lambda image, _: self.receive(image),
            input_qos(self._node_config.queue_depth),
        )
        self._reporter = Reporter(
            self.get_fully_qualified_name().lstrip('/'),
            {topic.name: heard.topic_name},
            self._meter,
            required=(topic.name,),
        )
        self.create_timer(
            self._node_config.diagnostics_period,
            self._report,
            clock=Clock(clock_type=ClockType.STEADY_TIME),
        )
        settings.warn_of_unknown()
        self._acknowledge(None)
        self.get_logger().info(f'ready, hears {heard.topic_name} ({type_name})')

    @property
    def refused(self) -> Mapping[str, int]:
        """Images refused so far, by reason."""
        return self._meter.refused

    def receive(self, message: Any) -> None:
        """Detect and publish; an image that cannot be used is refused, said once a reason."""
        start = time.monotonic()
        self._meter.arrived('image', start)
        try:
            self._detect(message)
        except Rejection as rejection:
            if rejection.reason not in self._meter.refused:
                self.get_logger().warning(
                    f'an image is refused: {rejection.sentence} (said once; '
                    f"'{rejection.reason}' is counted in /diagnostics)"
                )
            self._meter.refused[rejection.reason] += 1
        except Exception:
            if not self.context.ok():
                raise  # the middleware went away under our feet: `run` knows
            self._errors['internal_error'] += 1
            self.get_logger().error(
                f'internal error on an image; please report this:\n{traceback.format_exc()}'
            )
            self._detector = ImageDetector(self._config)
        self._acknowledge(message.header.stamp)
        self._meter.spent(time.monotonic() - start)

    def _detect(self, message: Any) -> None:
        image = self._read(message)
        self._guard.admit(image)
        found = self._detector.process(image)
        if found is not None:
            self._detections.publish(write_detections(found, make))
            self._published += 1

    def _acknowledge(self, stamp: Any) -> None:
        counts = {
            'messages': self._meter.received.total(),
            'refused': self._meter.refused.total(),
            'estimates': self._published,
            'listeners': self._detections.get_subscription_count(),
        }
        self._answers.say(counts, stamp)

    def _report(self) -> None:
        self._announcer.publish(
            self._reporter.report(
                self.get_clock().now().to_msg(),
                time.monotonic(),
                enabled=True,
                stale_after=self._node_config.stale_after,
                counts={'published': self._published, **self._errors},
                health={},
                lost=self._endpoints.lost,
                incompatible=self._endpoints.incompatible,
            )
        )


def main(args: list[str] | None = None) -> int:
    """Run the node until it is told to stop; gives the exit code."""
    return run(FlsDetectorNode, args)


if __name__ == '__main__':
    sys.exit(stopper.end(main()))
