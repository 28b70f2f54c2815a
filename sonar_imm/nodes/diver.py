# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The diver node: ``ros2 run sonar_imm diver_node``, or ``python -m sonar_imm.nodes.diver``.

Hears ``fix``, ``fixes``, ``relative``, ``arrivals``, and for ``relative`` the vessel's ``nav`` or
``nav_fix`` and ``heading``. Besides ``~/estimate`` it publishes, for the newest state only:

- ``~/odometry``: one message per confirmed diver (coasting ones too), whose ``child_frame_id`` is
  ``diver_<track_id>``;
- ``~/geo``: the same as NavSatFix, when it is known where the frame of the tracks lies on Earth;
- ``~/model_probabilities``: those of the diver that has been tracked longest.
"""

from __future__ import annotations

if __name__ == '__main__':
    from ..threads import one_blas_thread
    from .stopping import stopper

    stopper.listen()
    one_blas_thread()  # before numpy is imported

import sys
from typing import Any

from msg_adapters.displays.tracks import confirmed_rows
from msg_adapters.fixes import write_geo

from ..acoustics.geodesy import Origin
from ..estimates import Estimate
from .base import TrackerNode
from .messages import make
from .running import run


class DiverNode(TrackerNode):
    """Tracks divers from position fixes or raw arrival times."""

    def __init__(self, **options: Any):
        super().__init__('diver', **options)

    def advertise_more(self) -> None:
        self._geo = self.advertise('sensor_msgs/msg/NavSatFix', '~/geo')

    def origin(self) -> Origin | None:
        """Return the origin of the frame of the tracks, None while it is not known.

        It is set by the parameters or by the first position in latitude and longitude.
        """
        known: Origin | None = self.tracker.origin
        return known

    def show(self, estimates: list[Estimate]) -> None:
        super().show(estimates)
        newest, origin = estimates[-1], self.origin()
        if origin is not None and self._geo.get_subscription_count():
            for row in confirmed_rows(newest):
                self._geo.publish(write_geo(newest, row, origin, make))


def main(args: list[str] | None = None) -> int:
    """Run the node until it is told to stop; gives the exit code."""
    return run(DiverNode, args)


if __name__ == '__main__':
    sys.exit(stopper.end(main()))
