# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The bathymetry node: ``ros2 run sonar_imm bathymetry_node``, or
``python -m sonar_imm.nodes.bathymetry``.

Hears ``snapshot``, one message per ping, and publishes one ``~/estimate`` per ping, one row per
range bin. The points are the floor in the frame of the sonar; the column ``label`` is the number
of the most probable terrain model, by which RViz2 and Foxglove colour them
(config/bathymetry.rviz, config/foxglove_bathymetry.json), ``label_probability`` how probable it
is.

Also published, for each ping: ``~/model_probabilities``, the share of the bins that each terrain
model holds, and with navigation on ``nav`` ``~/soundings``, what goes into a chart: a row for each
bin with an echo, in the frame of the navigation, with its uncertainties (`sonar_imm.soundings`).

A sonar with two sides has one node, which hears ``port/snapshot`` and ``starboard/snapshot``, or
two, in namespaces, each with a core of its own if there is one::

    ros2 run sonar_imm bathymetry_node --ros-args -r __ns:=/port -p side:=port -r nav:=/nav
    ros2 run sonar_imm bathymetry_node --ros-args -r __ns:=/starboard -r nav:=/nav

No ping needs the one before. So a node that cannot keep up drops whole pings, those that waited
longer than ``max_wait``, and says so in /diagnostics, rather than show the floor of a while ago.
"""

from __future__ import annotations

if __name__ == '__main__':
    from ..threads import one_blas_thread
    from .stopping import stopper

    stopper.listen()
    one_blas_thread()  # before numpy is imported

import sys
from typing import Any

from msg_adapters.soundings import write_soundings

from ..estimates import Estimate
from ..soundings import soundings_of
from .base import TrackerNode
from .messages import make
from .running import run


class BathymetryNode(TrackerNode):
    """Finds the sea floor along each ping of a side-scan array."""

    def __init__(self, **options: Any):
        super().__init__('bathymetry', **options)

    def advertise_more(self) -> None:
        self._soundings = self.advertise('sensor_msgs/msg/PointCloud2', '~/soundings')

    def show(self, estimates: list[Estimate]) -> None:
        for estimate in estimates:
            super().show([estimate])
            soundings = soundings_of(estimate)
            if soundings is not None and self._soundings.get_subscription_count():
                self._soundings.publish(write_soundings(soundings, make))


def main(args: list[str] | None = None) -> int:
    """Run the node until it is told to stop; gives the exit code."""
    return run(BathymetryNode, args)


if __name__ == '__main__':
    sys.exit(stopper.end(main()))
