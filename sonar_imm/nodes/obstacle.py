# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The obstacle node: ``ros2 run sonar_imm obstacle_node``.

Hears ``detections``, ``nav``, ``altitude`` and ``ground``. Besides ``~/estimate`` it publishes,
for the newest state only and of confirmed obstacles (also those that have left the beam):

- ``~/obstacles``: their places in the frame of the navigation, a PoseArray;
- ``~/markers``: a bar for the 90 % band of the height, a ball at the mean, a label;
- ``~/model_probabilities``: above and below, then the behaviours that are considered, of the
  obstacle that has been tracked longest;
- ``~/map``, latched: the places of the obstacles that are remembered and not in view.
"""

from __future__ import annotations

if __name__ == '__main__':
    from ..threads import one_blas_thread
    from .stopping import stopper

    stopper.listen()
    one_blas_thread()  # before numpy is imported

import sys
from typing import Any

from msg_adapters.displays.obstacle import write_places

from ..estimates import Estimate
from .base import TrackerNode
from .messages import make, message_class
from .qos import latched_qos
from .running import run


class ObstacleNode(TrackerNode):
    """Tracks obstacles ahead and how far above or below the sonar they lie."""

    def __init__(self, **options: Any):
        super().__init__('obstacle', **options)

    def advertise_more(self) -> None:
        self._shown: tuple[Any, ...] = ()
        self._map = self._endpoints.advertise(
            message_class('geometry_msgs/msg/PoseArray'), '~/map', latched_qos()
        )

    def activated(self) -> None:
        """Hear the inputs, and show what is remembered."""
        super().activated()
        self._show_map(max((each.stamp_ns for each in self.tracker.landmarks), default=0))

    def show(self, estimates: list[Estimate]) -> None:
        super().show(estimates)
        self._show_map(estimates[-1].stamp_ns)

    def start_afresh(self) -> None:
        super().start_afresh()
        self._show_map(0)

    def _show_map(self, stamp_ns: int) -> None:
        """Publish the landmarks when they changed."""
        landmarks = self.tracker.landmarks
        if landmarks is not self._shown:
            self._shown = landmarks
            places = [each.place for each in landmarks]
            frame_id = self.tracker.frames.frame_id
            self._map.publish(write_places(places, stamp_ns, frame_id, make))


def main(args: list[str] | None = None) -> int:
    """Run the node until it is told to stop; gives the exit code."""
    return run(ObstacleNode, args)


if __name__ == '__main__':
    sys.exit(stopper.end(main()))
