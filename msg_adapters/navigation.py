# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Navigation of a vehicle: nav_msgs/Odometry, and altitudes from sensor_msgs/Range or a Doppler
log, whose velocity is not read: the pose of the navigation has it already.

The twist of an Odometry is defined in the child frame, the vehicle's own; many drivers state it in
the axes of the world instead, which `nav_twist_frame` undoes. With `world_frame` ``'ned'`` the
pose is that of an FRD body in a NED world; it is turned into that of an FLU body in an ENU world.

Of a vessel that carries a transceiver the pose is read whole, or its heading alone.
"""

from __future__ import annotations

from typing import Any

from attrs import evolve, fields
import numpy as np

from sonar_imm.acoustics.geometry import flip_quaternion
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Altitude, Navigation, Rejection, VesselHeading, VesselPose
from sonar_imm.measurements.variances import by_axis

from .headers import (
    head_of,
    Make,
    make_header,
    make_stated_pose,
    make_stated_twist,
    make_vector,
    square,
    swap_axes,
    to_enu,
)

TWIST_FRAMES = ('child', 'world')
_FRD = np.array([1.0, -1.0, -1.0])
"""Signs that turn a vector in FRD into FLU, and back."""
HIGHEST = 1.2e4
"""Metres above the sea floor: no sea is deeper."""


def read_navigation(
    message: Any, *, world_frame: str = 'enu', nav_twist_frame: str = 'child', **_: Any
) -> Navigation:
    """Read an Odometry. Raises `Rejection`."""
    if nav_twist_frame not in TWIST_FRAMES:
        raise ValueError(
            f"nav_twist_frame must be one of {', '.join(TWIST_FRAMES)}, got '{nav_twist_frame}'"
        )
    pose, twist = message.pose.pose, message.twist.twist
    q = pose.orientation
    navigation = Navigation(
        **head_of(message),
        child_frame_id=str(message.child_frame_id),
        position=_vector(pose.position),
        orientation=(float(q.x), float(q.y), float(q.z), float(q.w)),
        velocity=_vector(twist.linear),
        turn_rate=_vector(twist.angular),
        pose_covariance=_covariance(message.pose.covariance),
        twist_covariance=_covariance(message.twist.covariance),
    )
    if nav_twist_frame == 'world':
        navigation = _in_child_frame(navigation)
    return to_enu(navigation, world_frame, _turned)


def doubt_navigation(message: Any) -> str | None:
    """Give ``'no_frame'`` for navigation without a frame: its estimates cannot be displayed."""
    return None if message.header.frame_id else 'no_frame'


def read_range(message: Any, **_: Any) -> Altitude:
    """Read the Range of an altimeter. Raises `Rejection` outside the limits it states."""
    height = float(message.range)
    low, high = float(message.min_range), float(message.max_range)
    if np.isfinite(height) and high > low and not low <= height <= high:
        raise Rejection(
            'out_of_range',
            f'the altitude of {height:g} m lies outside the limits '
            f'of the sensor, {low:g} to {high:g} m',
        )
    return _altitude(message, height, float(getattr(message, 'variance', 0.0)))


def read_dvl(message: Any, **_: Any) -> Altitude:
    """Read the altitude of a marine_acoustic_msgs/Dvl or a stonefish_ros2/DVL; not positive means
    no bottom lock."""
    return _lock(message, float(message.altitude))


def read_dave_dvl(message: Any, **_: Any) -> Altitude:
    """Read the altitude of a dave_interfaces/DVL: the range of its target, unless that is the
    water."""
    if 'water' in str(message.target.type).lower():
        raise Rejection('no_bottom', 'the Doppler log tracks the water, not the bottom')
    return _lock(message, float(message.target.range))


def write_navigation(navigation: Navigation, make: Make) -> Any:
    """Write an Odometry; unknown covariances start with -1, unknown velocities are NaN."""
    pose_covariance = _written(navigation.pose_covariance)
    twist_covariance = _written(navigation.twist_covariance)
    return make(
        'nav_msgs/msg/Odometry',
        header=make_header(navigation.stamp_ns, navigation.frame_id, make),
        child_frame_id=navigation.child_frame_id,
        pose=make_stated_pose(navigation.position, pose_covariance, make, navigation.orientation),
        twist=make_stated_twist(navigation.velocity, twist_covariance, make, navigation.turn_rate),
    )


def write_range(altitude: Altitude, make: Make) -> Any:
    """Write a sensor_msgs/Range; a variance of zero means unknown there."""
    known = np.isfinite(altitude.variance)
    return make(
        'sensor_msgs/msg/Range',
        header=make_header(altitude.stamp_ns, altitude.frame_id, make),
        radiation_type=0,
        field_of_view=0.1,
        min_range=0.0,
        max_range=HIGHEST,
        range=float(altitude.altitude),
        variance=float(altitude.variance) if known else 0.0,
    )


def _lock(message: Any, height: float) -> Altitude:
    """The altitude of a Doppler log."""
    if np.isfinite(height) and height <= 0.0:
        raise Rejection('no_bottom', 'the Doppler log has no bottom lock')
    return _altitude(message, height, np.nan)


def _altitude(message: Any, height: float, variance: float) -> Altitude:
    if np.isfinite(height) and height > HIGHEST:
        raise Rejection('out_of_range', f'the altitude is {height:g} m, more than any sea is deep')
    if not (np.isfinite(variance) and variance > 1e-12):
        variance = np.nan
    return Altitude(
        **head_of(message),
        altitude=height,
        variance=variance,
    )


def _turned(navigation: Navigation) -> Navigation:
    """An FLU body in ENU, of an FRD body in NED, or the other way round."""
    world, body = ([1, 0, 2], np.array([1.0, 1.0, -1.0])), ([0, 1, 2], _FRD)
    return evolve(
        navigation,
        position=swap_axes(navigation.position),
        orientation=flip_quaternion(navigation.orientation),
        velocity=_FRD * navigation.velocity,
        turn_rate=_FRD * navigation.turn_rate,
        pose_covariance=_turned_covariance(navigation.pose_covariance, *world),
        twist_covariance=_turned_covariance(navigation.twist_covariance, *body),
        child_frame_id=navigation.child_frame_id.removesuffix('_frd'),
    )


def _turned_covariance(
    covariance: FloatArray | None, order: list[int], signs: FloatArray
) -> FloatArray | None:
    """(6, 6) of two vectors whose axes are put in another order and sign."""
    if covariance is None:
        return None
    axes = [*order, *(axis + 3 for axis in order)]
    return covariance[np.ix_(axes, axes)] * np.outer(np.tile(signs, 2), np.tile(signs, 2))


def _in_child_frame(navigation: Navigation) -> Navigation:
    """Turn a twist stated in world axes into the vehicle's."""
    x, y, z, w = navigation.orientation / np.linalg.norm(navigation.orientation)

    def back(vector: FloatArray) -> FloatArray:
        axis = -np.array([x, y, z])
        across = 2.0 * np.cross(axis, vector)
        return vector + w * across + np.cross(axis, across)

    return evolve(
        navigation,
        velocity=back(navigation.velocity),
        turn_rate=back(navigation.turn_rate),
        twist_covariance=None,
    )


def _vector(value: Any) -> tuple[float, float, float]:
    return float(value.x), float(value.y), float(value.z)


def _covariance(values: Any) -> FloatArray | None:
    """(6, 6), NaN in rows and columns of what is unknown, or None when all is."""
    return by_axis(square(values, 6, 'covariance of the navigation'))


def _written(covariance: FloatArray | None) -> FloatArray:
    """(6, 6) of a message, whose unknown variances are -1."""
    if covariance is None:
        return np.diag(np.full(6, -1.0))
    unknown = np.isnan(np.diag(covariance))
    written = np.nan_to_num(covariance)
    written[unknown, unknown] = -1.0
    return written


# -- the pose of a vessel that carries a transceiver -------------------------------------------


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
        given = square(message.orientation_covariance, 3, 'covariance of an orientation')
        if given[0, 0] == -1.0:
            raise Rejection('no_orientation', 'the IMU says that it has no orientation')
        covariance = by_axis(given)
    q = message.orientation if hasattr(message, 'orientation') else message.quaternion
    heading = VesselHeading(
        **head_of(message),
        orientation=(float(q.x), float(q.y), float(q.z), float(q.w)),
        covariance=covariance,
    )
    return to_enu(heading, world_frame, _turned_heading)


def write_heading(heading: VesselHeading, make: Make) -> Any:
    """Write a sensor_msgs/Imu with an orientation and nothing else."""
    covariance = np.zeros((3, 3))
    if heading.covariance is not None:
        unknown = np.isnan(np.diag(heading.covariance))
        covariance = np.nan_to_num(heading.covariance)
        # A first number of -1 says that there is no orientation.
        covariance[unknown, unknown] = np.nan
    return make(
        'sensor_msgs/msg/Imu',
        header=make_header(heading.stamp_ns, heading.frame_id, make),
        orientation=make_vector(heading.orientation, make, 'Quaternion'),
        orientation_covariance=np.ravel(covariance),
        angular_velocity_covariance=np.array([-1.0] + [0.0] * 8),
        linear_acceleration_covariance=np.array([-1.0] + [0.0] * 8),
    )


def _turned_heading(heading: VesselHeading) -> VesselHeading:
    """An FLU body in ENU, of an FRD body in NED."""
    covariance = heading.covariance
    if covariance is not None:
        covariance = swap_axes(swap_axes(covariance).T)
    return evolve(heading, orientation=flip_quaternion(heading.orientation), covariance=covariance)
