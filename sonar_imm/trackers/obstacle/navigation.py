"""Where the sonar sits on the vehicle, and what the axes of its navigation mean."""

from __future__ import annotations

import numpy as np

from ...acoustics import geometry
from ...acoustics.geometry import Pose
from ...estimation.arrays import FloatArray
from .config import ObstacleConfig


class Mount:
    """Where the sonar sits on the vehicle, and what the navigation's axes mean."""

    def __init__(self, config: ObstacleConfig):
        mount = geometry.rotation(*np.radians(config.sonar_mount_rpy_deg))
        self.lever = np.array(config.sonar_lever)
        self.R = mount
        self.ned = config.world_frame_convention == 'ned'

    def sonar(self, vehicle: Pose) -> Pose:
        """The sonar in NED and FRD, from a vehicle pose as the navigation states it."""
        ros = geometry.flip_pose(vehicle) if self.ned else vehicle
        return geometry.flip_pose(geometry.mounted(ros, self.lever, self.R))

    def to_navigation(self, points: FloatArray, covariance: FloatArray) -> tuple[FloatArray, ...]:
        """NED points (T, 3) and covariances (T, 3, 3) in the axes of the navigation."""
        if self.ned:
            return points, covariance
        halfway = np.swapaxes(geometry.flip_world(covariance), -1, -2)
        return geometry.flip_world(points), geometry.flip_world(halfway)
