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

"""The pose of the vessel that carries a transceiver: Odometry whole, or its heading alone."""

from __future__ import annotations

from typing import Any

from attrs import evolve, fields
import numpy as np

from sonar_imm.acoustics.geometry import flip_quaternion
from sonar_imm.measurements import Rejection, VesselHeading, VesselPose

from .headers import Make, make_header, stamp_ns, swap_axes, to_enu
from .navigation import read_navigation


def read_vessel_pose(message: Any, *, world_frame: str = 'enu', **_: Any) -> VesselPose:
    """Read an Odometry. Raises `Rejection`."""
    pose = read_navigation(message, world_frame=world_frame)
    return VesselPose(**{field.name: getattr(pose, field.name) for field in fields(type(pose))})


def read_heading(message: Any, *, world_frame: str = 'enu', **_: Any) -> VesselHeading:
    """Read the orientation of a sensor_msgs/Imu or a geometry_msgs/QuaternionStamped.

    Raises `Rejection`, also for an Imu that says it has no orientation.
    """
    covariance = None
    if hasattr(message, 'orientation_covariance'):
        given = np.array(message.orientation_covariance, np.float64).ravel()
        if given.size != 9:
            raise Rejection('bad_shape', f'the covariance has {given.size} numbers, 9 are needed')
        if given[0] == -1.0:
            raise Rejection('no_orientation', 'the IMU says that it has no orientation')
        usable = np.isfinite(given).all() and (np.diag(given.reshape(3, 3)) > 0.0).all()
        covariance = given.reshape(3, 3) if usable else None
    q = message.orientation if hasattr(message, 'orientation') else message.quaternion
    heading = VesselHeading(
        stamp_ns=stamp_ns(message),
        orientation=(float(q.x), float(q.y), float(q.z), float(q.w)),
        covariance=covariance,
        frame_id=str(message.header.frame_id),
    )
    return to_enu(heading, world_frame, _turned)


def write_heading(heading: VesselHeading, make: Make) -> Any:
    """Write a sensor_msgs/Imu with an orientation and nothing else."""
    x, y, z, w = (float(value) for value in heading.orientation)
    covariance = np.zeros(9) if heading.covariance is None else np.ravel(heading.covariance)
    return make(
        'sensor_msgs/msg/Imu',
        header=make_header(heading.stamp_ns, heading.frame_id, make),
        orientation=make('geometry_msgs/msg/Quaternion', x=x, y=y, z=z, w=w),
        orientation_covariance=covariance,
        angular_velocity_covariance=np.array([-1.0] + [0.0] * 8),
        linear_acceleration_covariance=np.array([-1.0] + [0.0] * 8),
    )


def _turned(heading: VesselHeading) -> VesselHeading:
    """An FLU body in ENU, of an FRD body in NED."""
    covariance = heading.covariance
    if covariance is not None:
        covariance = swap_axes(swap_axes(covariance).T)
    return evolve(heading, orientation=flip_quaternion(heading.orientation), covariance=covariance)
