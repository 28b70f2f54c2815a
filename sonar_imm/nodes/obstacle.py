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

"""The obstacle node: ``ros2 run sonar_imm obstacle_node``.

Hears ``detections``, ``nav`` and ``altitude``. Besides ``~/estimate`` it publishes, for the newest
state only and of confirmed obstacles (also those that have left the beam):

- ``~/obstacles``: their places in the frame of the navigation, a PoseArray;
- ``~/markers``: a bar for the 90 % band of the height, a ball at the mean, a label;
- ``~/model_probabilities``: above and below, of the obstacle that has been tracked longest.
"""

from __future__ import annotations

if __name__ == '__main__':
    from ..threads import one_blas_thread
    from .stopping import stopper

    stopper.listen()
    one_blas_thread()  # before numpy is imported

import sys
from typing import Any

import numpy as np

from msg_adapters.estimates import write_model_probabilities
from msg_adapters.obstacles import write_ended, write_markers, write_no_markers, write_poses

from ..estimates import Estimate
from .base import run, TrackerNode
from .messages import make

CONFIRMED = 1
"""Least `track_state` of a confirmed track: 0 tentative, 1 confirmed, 2 coasting."""


class ObstacleNode(TrackerNode):
    """Tracks obstacles ahead and how far above or below the sonar they lie."""

    def __init__(self, **options: Any):
        self._frame_id = ''
        self._shown: set[int] = set()
        super().__init__('obstacle', **options)

    def advertise_displays(self) -> None:
        self._obstacles = self.advertise('geometry_msgs/msg/PoseArray', '~/obstacles')
        self._markers = self.advertise('visualization_msgs/msg/MarkerArray', '~/markers')
        self._probabilities = self.advertise('sensor_msgs/msg/JointState', '~/model_probabilities')

    def show(self, newest: Estimate) -> None:
        self._frame_id = newest.frame_id
        confirmed = np.flatnonzero(newest.extras['track_state'] >= CONFIRMED)
        if self._obstacles.get_subscription_count():
            self._obstacles.publish(write_poses(newest, confirmed, make))
        ids = set(newest.extras['track_id'][confirmed].tolist())
        ended, self._shown = sorted(self._shown - ids), ids
        if ended and self._markers.get_subscription_count():
            self._markers.publish(write_ended(self._frame_id, ended, make))
        if not len(confirmed):
            return
        if self._markers.get_subscription_count():
            self._markers.publish(write_markers(newest, confirmed, make))
        if self._probabilities.get_subscription_count():
            oldest = confirmed[np.argmin(newest.extras['track_id'][confirmed])]
            self._probabilities.publish(write_model_probabilities(newest, oldest, make))

    def forget(self) -> None:
        self._shown = set()
        self._markers.publish(write_no_markers(self._frame_id, make))


def main(args: list[str] | None = None) -> int:
    """Run the node until it is told to stop; gives the exit code."""
    return run(ObstacleNode, args)


if __name__ == '__main__':
    sys.exit(main())
