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

"""Positions that a transceiver on a vessel has measured from itself (USBL).

Read by field names, so that the packages of the drivers need not be installed:

- geometry_msgs/PointStamped, Vector3Stamped, PoseWithCovarianceStamped: x y z, in the axes that
  `relative_axes` names;
- seatrac_interfaces/ModemRec: range, azimuth and elevation in the axes of the beacon, clockwise
  and up, tenths of a metre and a degree; without those its position east and north, by the compass
  of the beacon. ``src_id`` says whose it is;
- acomms_msgs/UsblData (EvoLogics): east, north, up where the device knows its attitude, else x y
  z; ``accuracy`` is taken as the standard deviation on each axis, ``remote_address`` says whose it
  is. The stamp is that of reception: the age of the measurement by the clock of the device,
  ``current_time - measurement_time``, is taken off;
- stonefish_ros2/BeaconInfo: ``relative_position`` in the axes of the simulated transceiver,
  forward, starboard, down; ``beacon_id`` says whose it is.

What a driver flags as invalid is refused.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from sonar_imm.measurements import nanoseconds, NOBODY, Rejection, RelativeFix

from .fixes import make_position
from .headers import Make, stamp_ns, swap_axes, swap_covariance

AXES = ('flu', 'frd', 'enu', 'ned')
_FRD = np.array([1.0, -1.0, -1.0])
LONGEST_AGE = 60.0
"""Seconds by which a USBL measurement may be older than its message."""


def read_relative(message: Any, *, relative_axes: str = 'flu', **_: Any) -> RelativeFix:
    """Read x y z from a transceiver. Raises `Rejection`."""
    covariance = None
    if hasattr(message, 'vector'):
        at = message.vector
    elif hasattr(message, 'point'):
        at = message.point
    else:
        at = message.pose.pose.position
        covariance = _covariance(message.pose.covariance)
    offset, covariance, levelled = _turned(
        np.array([at.x, at.y, at.z], np.float64), covariance, relative_axes
    )
    return _fix(message, offset, covariance=covariance, levelled=levelled)


def read_modem(message: Any, **_: Any) -> RelativeFix:
    """Read a seatrac_interfaces/ModemRec. Raises `Rejection`."""
    if message.position_flt_error:
        raise Rejection(
            'flagged_invalid', 'the position filter of the beacon has rejected the position'
        )
    own = int(message.src_id)
    if message.includes_range and message.includes_usbl:
        distance = 0.1 * float(message.range_dist)
        azimuth, elevation = np.radians(
            [0.1 * float(message.usbl_azimuth), 0.1 * float(message.usbl_elevation)]
        )
        level = distance * math.cos(elevation)
        offset = np.array(
            [
                level * math.cos(azimuth),
                -level * math.sin(azimuth),
                distance * math.sin(elevation),
            ]
        )
        return _fix(message, offset, target_id=own)
    if message.includes_position and (message.position_easting or message.position_northing):
        offset = 0.1 * np.array(
            [
                message.position_easting,
                message.position_northing,
                float(message.depth_local) - float(message.position_depth),
            ]
        )
        return _fix(message, offset, target_id=own, levelled=True)
    raise Rejection(
        'no_position', 'the message of the modem has neither range and direction nor a position'
    )


def read_usbl_data(message: Any, *, relative_axes: str = 'flu', **_: Any) -> RelativeFix:
    """Read an acomms_msgs/UsblData. Raises `Rejection`."""
    age = float(message.current_time) - float(message.measurement_time)
    if not 0.0 <= age <= LONGEST_AGE:
        age = 0.0  # clocks that were set, or fields that were not filled in
    own = int(message.remote_address)
    accuracy = float(message.accuracy)
    covariance = np.eye(3) * accuracy**2 if 1e-3 < accuracy < 1e4 else None
    enu = np.array([message.enu.x, message.enu.y, message.enu.z], np.float64)
    if enu.any() and np.isfinite(enu).all():
        return _fix(message, enu, covariance=covariance, levelled=True, target_id=own, age=age)
    xyz = np.array([message.xyz.x, message.xyz.y, message.xyz.z], np.float64)
    if not xyz.any():
        raise Rejection('no_position', 'the USBL message has no position')
    offset, covariance, levelled = _turned(xyz, covariance, relative_axes)
    return _fix(message, offset, covariance=covariance, levelled=levelled, target_id=own, age=age)


def read_beacon(message: Any, **_: Any) -> RelativeFix:
    """Read a stonefish_ros2/BeaconInfo. Raises `Rejection`."""
    at = message.relative_position
    offset = np.array([at.x, at.y, at.z], np.float64) * _FRD
    if not offset.any():
        raise Rejection('no_position', 'the beacon has no position')
    return _fix(message, offset, target_id=int(message.beacon_id))


def write_relative(fix: RelativeFix, make: Make) -> Any:
    """Write a PoseWithCovarianceStamped in forward, port, up; its covariance starts with -1 when
    the fix has none."""
    covariance = np.diag(np.full(6, -1.0))
    if fix.covariance is not None:
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = fix.covariance
    return make_position(fix, fix.offset, covariance, make)


def _fix(
    message: Any,
    offset: np.ndarray,
    *,
    covariance: np.ndarray | None = None,
    levelled: bool = False,
    target_id: int = NOBODY,
    age: float = 0.0,
) -> RelativeFix:
    return RelativeFix(
        stamp_ns=stamp_ns(message) - nanoseconds(age),
        offset=offset,
        covariance=covariance,
        levelled=levelled,
        target_id=target_id,
        frame_id=str(message.header.frame_id),
    )


def _turned(
    offset: np.ndarray, covariance: np.ndarray | None, axes: str
) -> tuple[np.ndarray, np.ndarray | None, bool]:
    """Offset and covariance in forward, port, up, or in east, north, up (True)."""
    if axes not in AXES:
        raise ValueError(f"relative_axes must be one of {', '.join(AXES)}, got '{axes}'")
    if axes == 'frd':
        turned = None if covariance is None else covariance * np.outer(_FRD, _FRD)
        return offset * _FRD, turned, False
    if axes == 'ned':
        turned = None if covariance is None else swap_covariance(covariance)
        return swap_axes(offset), turned, True
    return offset, covariance, axes == 'enu'


def _covariance(values: Any) -> np.ndarray | None:
    """The part of x y z (3, 3); None when it is unknown: negative on the diagonal or all zero."""
    covariance = np.array(values, np.float64).ravel()
    if covariance.size != 36:
        raise Rejection(
            'bad_shape', f'the covariance of a pose has {covariance.size} numbers, 36 are needed'
        )
    block = covariance.reshape(6, 6)[:3, :3]
    if not block.any() or (np.diag(block) < 0.0).any():
        return None
    return block
