"""Header stamps as integer nanoseconds, and coordinate frames.

REP-103 asks for ENU world frames; a frame in NED carries the suffix ``_ned``. Everything inside
this software is ENU.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from attrs import evolve
import numpy as np

from sonar_imm.estimation.angles import wrap_angle
from sonar_imm.measurements import Arrivals, Fix, Rejection

Make = Callable[..., Any]

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


def make_header(stamp: int, frame_id: str, make: Make) -> Any:
    """Build a std_msgs/Header from a stamp in integer nanoseconds.

    Raises ValueError for a stamp that the 32-bit seconds of ROS 2 cannot hold (after 2038-01-19).
    """
    seconds, nanoseconds = divmod(int(stamp), _NANO)
    if not -(2**31) <= seconds < 2**31:
        raise ValueError(f'a ROS 2 header cannot hold the stamp {stamp} ns')
    time = make('builtin_interfaces/msg/Time', sec=seconds, nanosec=nanoseconds)
    return make('std_msgs/msg/Header', stamp=time, frame_id=frame_id)


def to_enu(measurement: Any, world_frame: str) -> Any:
    """Bring a measurement into ENU; `world_frame` is what it comes in: ``'enu'`` or ``'ned'``.

    Raises `Rejection` when the frame says ``_ned`` but `world_frame` says ENU.
    """
    if world_frame == 'ned':
        return ned_to_enu(measurement)
    if world_frame != 'enu':
        raise ValueError(
            f"world_frame must be one of {', '.join(WORLD_FRAMES)}, got '{world_frame}'"
        )
    if measurement.frame_id.endswith('_ned'):
        raise Rejection(
            'frame_ned',
            f"the frame '{measurement.frame_id}' is north-east-down but "
            'east-north-up is expected; set the world frame to ned',
        )
    return measurement


def ned_to_enu(measurement: Any) -> Any:
    """Turn a `Fix` or `Arrivals` given in north-east-down into east-north-up.

    x and y change places and z changes sign; a bearing, clockwise from north in NED, becomes
    counter-clockwise from east. A suffix ``_ned`` of the frame is dropped.
    """
    frame_id = measurement.frame_id.removesuffix('_ned')
    if isinstance(measurement, Fix):
        covariance = measurement.covariance
        return evolve(
            measurement,
            frame_id=frame_id,
            position=_swap(measurement.position),
            covariance=None if covariance is None else covariance[::-1, ::-1],
        )
    if isinstance(measurement, Arrivals):
        return evolve(
            measurement,
            frame_id=frame_id,
            tx=_swap(measurement.tx),
            rx=_swap(measurement.rx),
            bearing=wrap_angle(np.pi / 2 - measurement.bearing),
        )
    raise TypeError(f'no north-east-down rule for {type(measurement).__name__}')


def _swap(vector: Any) -> Any:
    """Exchange the first two of three coordinates on the last axis and negate the third."""
    return vector[..., [1, 0, 2]] * (1.0, 1.0, -1.0)
