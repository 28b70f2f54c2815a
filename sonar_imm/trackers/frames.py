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

"""What stands between the reader of a message and the tracker: frames.

Every measurement has to be in one frame (`measurements.FrameGuard`). Where /tf_static is heard,
one in another frame that is fixed to it is turned into it, and the place of a sonar on its vehicle
comes from there. Live and offline use the same door.
"""

from __future__ import annotations

from typing import Any

from attrs import evolve
import numpy as np

from ..acoustics import geometry
from ..measurements import (
    Detections,
    frame_role,
    FrameGuard,
    FrameTree,
    moved,
    Rejection,
    Snapshot,
    StaticTransforms,
    VesselPose,
)
from ..parameters import Config

SEEN_FROM_THE_SONAR = (Detections, Snapshot)
"""What cannot be used before the place of the sonar is known."""


class FrameDoor:
    """Lets measurements through to a tracker.

    mounting: the parameters of the place of the sonar, as /tf_static says them, None before.
    """

    def __init__(self, tracker: Any, guard: FrameGuard, tree: FrameTree | None = None):
        """guard: the frame that was told, and those of what the tracker uses whatever its stamp.
        Of everything else the tracker says what it used, since what is refused must not decide.
        tree: what is known of frames already, as after a restart."""
        self._tracker = tracker
        self._guard = guard
        self._tree = FrameTree() if tree is None else tree
        self._frames = _sonar_frames(tracker.config)
        self.mounting: dict[str, tuple[float, ...]] | None = None
        self._mount()

    def admit(self, measurement: Any) -> Any:
        """The measurement in the frame of the tracks; None for transforms, which are kept here.
        Raises `Rejection` for one in a frame that has nothing to do with it."""
        if isinstance(measurement, StaticTransforms):
            self._tree.add(measurement)
            self._mount()
            return None
        if self._frames and not self.mounting and isinstance(measurement, SEEN_FROM_THE_SONAR):
            vehicle, sonar = self._frames
            raise Rejection(
                'no_mounting', f"/tf_static has not said where '{sonar}' is on '{vehicle}'"
            )
        measurement = self._turned(measurement)
        self._guard.check(measurement)
        known = self._tracker.frames
        if isinstance(measurement, known.kinds):
            known.guard.check(measurement)
        else:
            self._guard.settle(measurement)
        return measurement

    def reconfigure(self, config: Config) -> None:
        """Give `config` to the tracker, with the place of the sonar where that is known."""
        self._tracker.reconfigure(evolve(config, **(self.mounting or {})))

    def _turned(self, measurement: Any) -> Any:
        target = self._guard.frame_id or self._tracker.frames.guard.frame_id
        source = measurement.frame_id
        placed = frame_role(measurement) == 'world' or isinstance(measurement, VesselPose)
        if not (target and placed) or source in ('', target):
            return measurement
        pose = self._tree.pose(target, source)
        return measurement if pose is None else moved(measurement, target, pose)

    def _mount(self) -> None:
        if not self._frames:
            return
        pose = self._tree.pose(*self._frames)
        if pose is None:
            return
        self.mounting = {
            'sonar_lever': tuple(pose.position.tolist()),
            'sonar_mount_rpy_deg': tuple(np.degrees(geometry.euler_angles(pose.R)).tolist()),
        }
        self._tracker.remount(evolve(self._tracker.config, **self.mounting))


def _sonar_frames(config: Config) -> tuple[str, str] | None:
    """The frames of vehicle and sonar, where the parameters name them."""
    vehicle, sonar = (getattr(config, name, '') for name in ('vehicle_frame', 'sonar_frame'))
    return (vehicle, sonar) if vehicle and sonar else None
