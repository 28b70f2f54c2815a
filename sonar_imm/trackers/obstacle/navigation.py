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

"""Where the sonar sits on the vehicle, and what the axes of its navigation mean."""

from __future__ import annotations

import numpy as np

from ...acoustics import geometry
from ...acoustics.geometry import Pose
from ...estimation.arrays import FloatArray
from .config import ObstacleConfig


class Mount:
    """Where the sonar sits on the vehicle.

    Here, and only here, the tracker changes between the axes of ROS and those of the papers: poses
    come in as ENU and FLU, the filters work in NED and FRD (`acoustics.geometry`), places go out
    as ENU.
    """

    def __init__(self, config: ObstacleConfig):
        self.lever = np.array(config.sonar_lever)
        self.R = geometry.rotation(*np.radians(config.sonar_mount_rpy_deg))

    def sonar(self, vehicle: Pose) -> Pose:
        """The sonar in NED and FRD, from a vehicle in ENU and FLU."""
        there = geometry.mounted(vehicle, self.lever, self.R)
        return Pose(geometry.flip_world(there.position), geometry.flip_rotation(there.R))

    @staticmethod
    def to_enu(points: FloatArray, covariance: FloatArray) -> tuple[FloatArray, ...]:
        """Points (T, 3) and covariances (T, 3, 3) in ENU, from NED."""
        return geometry.flip_world(points), geometry.flip_covariance(covariance)
