"""Echoes in live sonar images: ``ros2 run sonar_imm fls_detector_node``.

Hears ``image`` (marine_acoustic_msgs, which has to be installed) and publishes ``detections``,
what the obstacle node hears. It is a convenience: a detector that knows the sonar is better.
"""

from __future__ import annotations

if __name__ == '__main__':
    from ..threads import one_blas_thread
    from .stopping import stopper

    stopper.listen()
    one_blas_thread()  # before numpy is imported

from collections import Counter
import sys
from typing import Any

from attrs import frozen
from rclpy.node import Node

from msg_adapters.detections import write_detections
from msg_adapters.sonar_images import IMAGE_TYPES, read_sonar_image

from ..measurements import Rejection
from ..parameters import Config, ConfigError, parameter
from ..trackers.obstacle.detector import detect, DetectorConfig
from .base import run
from .messages import make, message_class
from .parameters import NodeParameters
from .qos import input_qos, output_qos


@frozen(kw_only=True)
class ImageInput(Config):
    """What the node hears."""

    image_type: str = parameter(IMAGE_TYPES[0], 'message type of the images', choices=IMAGE_TYPES)
    queue_depth: int = parameter(10, 'images held while the node is busy', low=1, high=1000)


class FlsDetectorNode(Node):
    """One message of detections for every image."""

    def __init__(self, **options: Any):
        super().__init__('fls_detector', **options)
        settings = NodeParameters(self, (DetectorConfig, ImageInput))
        self._config, heard = settings[DetectorConfig], settings[ImageInput]
        self.refused: Counter[str] = Counter()
        try:
            image_class = message_class(heard.image_type)
        except ImportError as error:
            raise ConfigError(str(error)) from None
        self._detections = self.create_publisher(
            message_class('sensor_msgs/msg/PointCloud2'), 'detections', output_qos()
        )
        self.create_subscription(image_class, 'image', self.receive, input_qos(heard.queue_depth))
        settings.warn_of_unknown()
        self.get_logger().info('ready')

    def receive(self, message: Any) -> None:
        """Detect and publish; an image that cannot be used is refused, said once a reason."""
        try:
            image = read_sonar_image(message, **self._config.reading())
            detections = detect(image, self._config)
        except Rejection as rejection:
            if rejection.reason not in self.refused:
                self.get_logger().warning(f'an image is refused: {rejection.sentence} (said once)')
            self.refused[rejection.reason] += 1
            return
        self._detections.publish(write_detections(detections, make))


def main(args: list[str] | None = None) -> int:
    """Run the node until it is told to stop; gives the exit code."""
    return run(FlsDetectorNode, args)


if __name__ == '__main__':
    sys.exit(main())
