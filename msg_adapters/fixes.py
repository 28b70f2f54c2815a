# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Position fixes and starts of tracks: in metres (geometry_msgs PoseWithCovarianceStamped or
PointStamped), relative to a vessel, and in latitude and longitude.

Publishers fill in covariances in different ways: `measurements.variances` has the table. All zeros
are worth a warning (see `doubt_fix`). What is stated of x and y has to be symmetric and positive
definite, or the fix is refused. What is stated of z is used with it, or left out where it cannot
be true (`measurements.in_space`).

Positions that a transceiver on a vessel has measured from itself (USBL), and those of
geographic_msgs, are read by field names, so that the packages of the drivers need not be
installed. What is used of each type: docs/topics.md.

What a driver flags as invalid is refused.

A sensor_msgs/NavSatFix whose status says that there is no fix is refused (``no_fix``). The type of
its covariance (east, north, up) decides: unknown is unknown, whatever the numbers; diagonal means
only the diagonal.
"""

from __future__ import annotations

import math
from typing import Any, TypeVar

from attrs import evolve
import numpy as np
from numpy.typing import NDArray

from sonar_imm.acoustics.geodesy import NEAR_ZERO, Origin
from sonar_imm.estimates import Estimate
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import (
    Fix,
    GeodeticFix,
    nanoseconds,
    Rejection,
    RelativeFix,
    Start,
    VesselFix,
)
from sonar_imm.measurements.variances import (
    check_flat,
    is_stated,
    LEAST_VARIANCE,
    UNKNOWN_VARIANCE,
)

from .headers import (
    head_of,
    Make,
    make_header,
    make_stated_pose,
    square,
    stamp_ns,
    swap_axes,
    swap_covariance,
    to_enu,
)

Place = TypeVar('Place', Fix, Start)


def read_fix(message: Any, *, world_frame: str = 'enu') -> Fix:
    """Read a PoseWithCovarianceStamped or a PointStamped; `world_frame` is ``'enu'`` or ``'ned'``.

    A z that is not finite is read as 0 and as not stated. Raises `Rejection`.
    """
    point = message.point if hasattr(message, 'point') else message.pose.pose.position
    x, y, z = float(point.x), float(point.y), float(point.z)
    covariance = known_covariance(message)
    if covariance is not None and not np.isfinite(z):
        covariance[2, 2] = np.nan
        covariance = None if np.isnan(covariance).all() else covariance
    fix = Fix(
        **head_of(message),
        position=(x, y, z if np.isfinite(z) else 0.0),
        covariance=covariance,
    )
    return to_enu(fix, world_frame, _turned)


def read_start(message: Any, *, world_frame: str = 'enu') -> Start:
    """Read the start of a track from a PoseWithCovarianceStamped, as RViz sends it by a click; the
    orientation is not used. Raises `Rejection`, also without a covariance of x and y: how far off
    the place may be is what a start has to say."""
    point, covariance = message.pose.pose.position, known_covariance(message)
    if covariance is None or np.isnan(covariance[0, 0]):
        raise Rejection(
            'no_covariance',
            'the start has no covariance of x and y: state how far off it may be, in m^2',
        )
    start = Start(
        **head_of(message),
        position=(float(point.x), float(point.y), float(point.z)),
        covariance=covariance,
    )
    return to_enu(start, world_frame, _turned)


def _turned(fix: Place) -> Place:
    """The same place in ENU, of one in NED."""
    covariance = None if fix.covariance is None else swap_covariance(fix.covariance)
    return evolve(fix, position=swap_axes(fix.position), covariance=covariance)


def check_size(fix: Fix | Start, what: str = 'fix') -> None:
    """Raise `Rejection` for a covariance of x and y that no message may state."""
    if fix.covariance is not None and not np.isnan(fix.covariance[0, 0]):
        check_flat(fix.covariance[:2, :2], f'the {what}')


def doubt_fix(message: Any) -> str | None:
    """Give ``'zero_covariance'`` for a covariance that was not filled in: all zero in x and y."""
    covariance = _covariance(message)
    block = None if covariance is None else covariance[:2, :2]
    return 'zero_covariance' if block is not None and not block.any() else None


def doubt_height(message: Any, fix: Fix) -> str | None:
    """Give ``'bad_height'`` for a message that states the variance of z, in a covariance that
    cannot be true, so that `fix` has none."""
    stated = _covariance(message)
    if stated is None or not LEAST_VARIANCE <= stated[2, 2] < UNKNOWN_VARIANCE:
        return None
    kept = fix.covariance is not None and np.isfinite(fix.covariance[2, 2])
    return None if kept or not np.isfinite(message.pose.pose.position.z) else 'bad_height'


def write_fix(fix: Fix, make: Make) -> Any:
    """Write a PoseWithCovarianceStamped, whose covariance starts with -1 when the fix has none."""
    covariance = np.zeros((6, 6))
    if fix.covariance is None:
        np.fill_diagonal(covariance, -1.0)
    else:
        np.fill_diagonal(covariance, UNKNOWN_VARIANCE)
        if np.isnan(fix.covariance[0, 0]):
            covariance[:2, :2] = -np.eye(2)
        stated = np.isfinite(fix.covariance)
        covariance[:3, :3][stated] = fix.covariance[stated]
    return make_position(fix, fix.position, covariance, make)


def write_start(start: Start, make: Make) -> Any:
    """Write a start as a PoseWithCovarianceStamped."""
    covariance = np.diag(np.full(6, UNKNOWN_VARIANCE))
    stated = np.isfinite(start.covariance)
    covariance[:3, :3][stated] = start.covariance[stated]
    return make_position(start, start.position, covariance, make)


def make_position(
    fix: Fix | RelativeFix | Start, position: FloatArray, covariance: FloatArray, make: Make
) -> Any:
    """Make a PoseWithCovarianceStamped with stamp and frame of `fix`, at `position` (3,) m, not
    turned, with `covariance` (6, 6)."""
    header = make_header(fix.stamp_ns, fix.frame_id, make)
    kind, pose = (
        'geometry_msgs/msg/PoseWithCovarianceStamped',
        make_stated_pose(position, covariance, make),
    )
    return make(kind, header=header, pose=pose)


def known_covariance(message: Any) -> NDArray[np.float64] | None:
    """The covariance (3, 3) of x, y and z, NaN where it is unknown; None where it is throughout.

    Raises `Rejection` where that of x and y cannot be used."""
    covariance = _covariance(message)
    if covariance is None:
        return None
    block = covariance[:2, :2]
    if is_stated(block):
        check_flat(block, 'a fix')
        return covariance
    covariance[:2], covariance[:, :2] = np.nan, np.nan
    stated = 0.0 < covariance[2, 2] < UNKNOWN_VARIANCE
    return covariance if stated else None


def _covariance(message: Any) -> NDArray[np.float64] | None:
    """Cut x, y and z (3, 3) out of the 6 x 6 covariance; None for a message without one."""
    if hasattr(message, 'point'):
        return None
    return square(message.pose.covariance, 6)[:3, :3].copy()


# -- relative to a vessel ----------------------------------------------------------------------


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
        covariance = _stated(message.pose.covariance)
    offset, covariance, levelled = _in_axes(
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
    offset, covariance, levelled = _in_axes(xyz, covariance, relative_axes)
    return _fix(message, offset, covariance=covariance, levelled=levelled, target_id=own, age=age)


def read_beacon(message: Any, **_: Any) -> RelativeFix:
    """Read a stonefish_ros2/BeaconInfo. Raises `Rejection`."""
    at = message.relative_position
    offset = np.array([at.x, at.y, at.z], np.float64) * _FRD
    if not offset.any():
        raise Rejection('no_position', 'the beacon has no position')
    return _fix(message, offset, target_id=int(message.beacon_id))


RELATIVE_DRIVERS = {
    'seatrac_interfaces/msg/ModemRec': read_modem,
    'acomms_msgs/msg/UsblData': read_usbl_data,
    'stonefish_ros2/msg/BeaconInfo': read_beacon,
}
"""Messages of single drivers and simulators for the input `relative`, with their readers."""


def write_relative(fix: RelativeFix, make: Make) -> Any:
    """Write a PoseWithCovarianceStamped in forward, port, up; its covariance starts with -1 when
    the fix has none."""
    covariance = np.diag(np.full(6, -1.0))
    if fix.covariance is not None:
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = fix.covariance
    return make_position(fix, fix.offset, covariance, make)


def _fix(message: Any, offset: np.ndarray, *, age: float = 0.0, **known: Any) -> RelativeFix:
    """A fix, offset forward, port, up, or with levelled=True east, north, up, of which the message
    says what is `known` besides; age: seconds before its stamp."""
    return RelativeFix(
        stamp_ns=stamp_ns(message) - nanoseconds(age),
        offset=offset,
        frame_id=str(message.header.frame_id),
        **known,
    )


def _in_axes(
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


def _stated(values: Any) -> np.ndarray | None:
    """The part of x y z (3, 3); None when it is unknown. Raises `Rejection` as of a fix."""
    block = square(values, 6)[:3, :3]
    if not is_stated(block):
        return None
    check_flat(block[:2, :2], 'a relative position')
    return block


# -- in latitude and longitude -----------------------------------------------------------------


NO_FIX, FIX = -1, 0
UNKNOWN, DIAGONAL, KNOWN = 0, 2, 3
"""Status and covariance types of NavSatFix that matter here."""


def read_geodetic(message: Any, **_: Any) -> GeodeticFix:
    """Read a NavSatFix or a message of geographic_msgs. Raises `Rejection`."""
    return _read(message, GeodeticFix)


def read_vessel_fix(message: Any, **_: Any) -> VesselFix:
    """The same as the position of a vessel. Raises `Rejection`."""
    fix: VesselFix = _read(message, VesselFix)
    return fix


def write_geodetic(fix: GeodeticFix, make: Make) -> Any:
    """Write a NavSatFix."""
    known = fix.covariance is not None
    covariance = np.zeros((3, 3)) if fix.covariance is None else fix.covariance
    return _navsat(
        fix.stamp_ns,
        fix.frame_id,
        np.array([fix.latitude, fix.longitude, fix.height]),
        covariance,
        KNOWN if known else UNKNOWN,
        make,
    )


def write_geo(estimate: Estimate, row: int, origin: Origin, make: Make) -> Any:
    """Write where one diver is as a NavSatFix, frame ``diver_<track_id>``.

    The covariance is east, north, up at the diver. Where depth is not estimated the altitude is
    NaN and its variance large.
    """
    names = [name for name in ('px', 'py', 'pz') if name in estimate.state_names]
    index = [estimate.state_names.index(name) for name in names]
    where = estimate.state[row, index]
    covariance = np.diag([0.0, 0.0, UNKNOWN_VARIANCE])
    covariance[: len(index), : len(index)] = estimate.covariance[row][np.ix_(index, index)]
    flat = len(index) < 3
    place = origin.at_height(where, estimate.xyz[row, 2]) if flat else origin.geodetic(where)
    turn = origin.turn(place[0], place[1]).T
    if flat:
        place[2] = np.nan
    return _navsat(
        estimate.stamp_ns,
        f'diver_{int(estimate.extras["track_id"][row])}',
        place,
        turn @ covariance @ turn.T,
        KNOWN,
        make,
    )


def doubt_geodetic(message: Any) -> str | None:
    """Give ``'zero_covariance'`` for a NavSatFix that claims a covariance of zeros."""
    if not hasattr(message, 'position_covariance_type') or not message.position_covariance_type:
        return None
    return None if np.any(message.position_covariance) else 'zero_covariance'


def is_geodetic(message: Any) -> bool:
    """Whether a message says latitude and longitude."""
    return hasattr(_point(message), 'latitude')


def _point(message: Any) -> Any:
    """Where latitude, longitude and altitude stand."""
    for name in ('position', 'pose'):
        message = getattr(message, name, message)
    for name in ('pose', 'position'):
        message = getattr(message, name, message)
    return message


def _read(message: Any, kind: type[GeodeticFix]) -> Any:
    status = getattr(message, 'status', None)
    if status is not None and int(status.status) < FIX:
        raise Rejection('no_fix', 'the receiver says that it has no fix')
    point = _point(message)
    latitude, longitude = float(point.latitude), float(point.longitude)
    if max(abs(latitude), abs(longitude)) < NEAR_ZERO:
        raise Rejection('no_fix', 'latitude 0, longitude 0 is what receivers without a fix say')
    return kind(
        **head_of(message),
        latitude=latitude,
        longitude=longitude,
        height=float(point.altitude) if np.isfinite(point.altitude) else float('nan'),
        covariance=_on_earth(message),
    )


def _on_earth(message: Any) -> np.ndarray | None:
    """(3, 3) east, north, up; None where it is unknown or was not filled in."""
    if hasattr(message, 'position_covariance'):
        values, n, kind = message.position_covariance, 3, int(message.position_covariance_type)
    elif hasattr(getattr(message, 'pose', None), 'covariance'):
        values, n, kind = message.pose.covariance, 6, KNOWN
    else:
        return None
    if kind == UNKNOWN:
        return None
    covariance = square(values, n, 'covariance')[:3, :3]
    if kind == DIAGONAL:
        covariance = np.diag(np.diag(covariance))
    if not is_stated(covariance[:2, :2]):
        return None
    check_flat(covariance[:2, :2], 'the position')
    of_z = covariance[2, 2]
    if not (np.isfinite(covariance[2]).all() and LEAST_VARIANCE <= of_z < UNKNOWN_VARIANCE):
        # No height: say so, rather than that it is certain.
        covariance[2] = covariance[:, 2] = 0.0
        covariance[2, 2] = UNKNOWN_VARIANCE
    return covariance


def _navsat(
    stamp: int,
    frame_id: str,
    place: np.ndarray,
    covariance: np.ndarray,
    kind: int,
    make: Make,
) -> Any:
    latitude, longitude, height = (float(value) for value in place)
    return make(
        'sensor_msgs/msg/NavSatFix',
        header=make_header(stamp, frame_id, make),
        status=make('sensor_msgs/msg/NavSatStatus', status=FIX, service=1),
        latitude=latitude,
        longitude=longitude,
        altitude=height,
        position_covariance=np.ravel(covariance),
        position_covariance_type=kind,
    )
