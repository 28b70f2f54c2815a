# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Header stamps as integer nanoseconds, and coordinate frames.

REP-103 asks for ENU world frames and FLU body frames; a frame in NED carries the suffix ``_ned``.
**From here to the estimate everything is ENU and FLU, in every system.** The reader of a message
turns what a publisher states in NED and FRD, as `world_frame` tells it (the parameter
`world_frame_convention` of nodes and commands). Every output is ENU. A tracker that computes in
other axes, as its paper does, turns them where measurements come in and estimates go out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any, cast, Protocol, TypeVar

from attrs import evolve
import numpy as np

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Rejection

Make = Callable[..., Any]


class InFrame(Protocol):
    """A measurement that says in which frame it is."""

    @property
    def frame_id(self) -> str: ...


M = TypeVar('M', bound=InFrame)

WORLD_FRAMES = ('enu', 'ned')
_NANO = 1_000_000_000


def stamp_ns(message: Any) -> int:
    """Give the header stamp of `message` in integer nanoseconds.

    Raises `Rejection` when the nanosecond field holds a second or more.
    """
    stamp = message.header.stamp
    seconds, nanoseconds = int(stamp.sec), int(stamp.nanosec)
    if not 0 <= nanoseconds < _NANO:
        raise Rejection(
            'bad_stamp', f'the header stamp has {nanoseconds} nanoseconds, a full second or more'
        )
    return seconds * _NANO + nanoseconds


def head_of(message: Any) -> dict[str, Any]:
    """`stamp_ns` and `frame_id` of a measurement, as the header of `message` says."""
    return {'stamp_ns': stamp_ns(message), 'frame_id': str(message.header.frame_id)}


def square(values: Any, n: int, what: str = 'covariance of a pose') -> FloatArray:
    """A copy of the numbers of a matrix (n, n). Raises `Rejection` where there are not as many."""
    matrix = np.array(values, np.float64)
    if matrix.size != n * n:
        raise Rejection('bad_shape', f'the {what} has {matrix.size} numbers, {n * n} are needed')
    return matrix.reshape(n, n)


def make_header(stamp: int, frame_id: str, make: Make) -> Any:
    """Build a std_msgs/Header from a stamp in integer nanoseconds.

    Raises ValueError for a stamp that the 32-bit seconds of ROS 2 cannot hold (after 2038-01-19).
    """
    seconds, nanoseconds = divmod(int(stamp), _NANO)
    if not -(2**31) <= seconds < 2**31:
        raise ValueError(f'a ROS 2 header cannot hold the stamp {stamp} ns')
    time = make('builtin_interfaces/msg/Time', sec=seconds, nanosec=nanoseconds)
    return make('std_msgs/msg/Header', stamp=time, frame_id=frame_id)


def make_vector(values: Iterable[float], make: Make, kind: str = 'Vector3') -> Any:
    """Make a Vector3 of geometry_msgs, or another `kind` with x, y, z and maybe w."""
    return make(f'geometry_msgs/msg/{kind}', **dict(zip('xyzw', map(float, values))))


def make_pose(
    position: Iterable[float], make: Make, orientation: Iterable[float] = (0.0, 0.0, 0.0, 1.0)
) -> Any:
    """Make a Pose. position: x, y, z, m; orientation: x, y, z, w, by default not turned."""
    return make(
        'geometry_msgs/msg/Pose',
        position=make_vector(position, make, 'Point'),
        orientation=make_vector(orientation, make, 'Quaternion'),
    )


def make_stated_pose(
    position: Iterable[float],
    covariance: FloatArray,
    make: Make,
    orientation: Iterable[float] = (0.0, 0.0, 0.0, 1.0),
) -> Any:
    """Make a PoseWithCovariance; covariance: of 36 numbers."""
    pose = make_pose(position, make, orientation)
    kind = 'geometry_msgs/msg/PoseWithCovariance'
    return make(kind, pose=pose, covariance=np.ravel(covariance))


def make_stated_twist(
    velocity: Iterable[float],
    covariance: FloatArray,
    make: Make,
    turn_rate: Iterable[float] = (0.0, 0.0, 0.0),
) -> Any:
    """Make a TwistWithCovariance; covariance: of 36 numbers."""
    linear, angular = make_vector(velocity, make), make_vector(turn_rate, make)
    twist = make('geometry_msgs/msg/Twist', linear=linear, angular=angular)
    kind = 'geometry_msgs/msg/TwistWithCovariance'
    return make(kind, twist=twist, covariance=np.ravel(covariance))


def places_of(points: Iterable[Any]) -> FloatArray:
    """x, y, z (n, 3) of points or vectors."""
    return np.array([[point.x, point.y, point.z] for point in points], np.float64).reshape(-1, 3)


def to_enu(measurement: M, world_frame: str, turned: Callable[[M], M]) -> M:
    """Bring a measurement into ENU; `world_frame` is what it comes in: ``'enu'`` or ``'ned'``.

    `turned` makes one in ENU of one in NED; a suffix ``_ned`` of the frame is dropped then. Raises
    `Rejection` when the frame says ``_ned`` but `world_frame` says ENU.
    """
    if world_frame == 'ned':
        frame_id = measurement.frame_id.removesuffix('_ned')
        in_enu: Any = turned(measurement)
        return cast(M, evolve(in_enu, frame_id=frame_id))
    if world_frame != 'enu':
        raise ValueError(
            f"world_frame must be one of {', '.join(WORLD_FRAMES)}, got '{world_frame}'"
        )
    if measurement.frame_id.endswith('_ned'):
        raise Rejection(
            'frame_ned',
            f"the frame '{measurement.frame_id}' is north-east-down but "
            'east-north-up is expected; set world_frame_convention: ned',
            ('world_frame_convention',),
        )
    return measurement


def swap_axes(vector: Any) -> Any:
    """Turn coordinates (..., 3) of NED into ENU or back: x and y change places, z its sign."""
    return vector[..., [1, 0, 2]] * (1.0, 1.0, -1.0)


def swap_covariance(covariance: Any) -> Any:
    """Turn covariances (..., 3, 3) as `swap_axes` turns coordinates."""
    return swap_axes(swap_axes(covariance).swapaxes(-1, -2))
