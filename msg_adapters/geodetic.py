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

"""Positions in latitude and longitude: sensor_msgs/NavSatFix and the messages of geographic_msgs.

A NavSatFix whose status says that there is no fix is refused (``no_fix``). The type of its
covariance (east, north, up) decides: unknown is unknown, whatever the numbers; diagonal means only
the diagonal. geographic_msgs is read by field names: GeoPointStamped, GeoPoseStamped and
GeoPoseWithCovarianceStamped.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import GeodeticFix, Rejection, VesselFix

from .fixes import LEAST_VARIANCE, MOST_VARIANCE, UNKNOWN_VARIANCE
from .headers import Make, make_header, stamp_ns

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
    enu = np.zeros(3)
    enu[2] = estimate.xyz[row, 2]
    enu[: len(index)] = estimate.state[row, index]
    covariance = np.diag([0.0, 0.0, UNKNOWN_VARIANCE])
    covariance[: len(index), : len(index)] = estimate.covariance[row][np.ix_(index, index)]
    place = origin.geodetic(enu)
    turn = origin.turn(place[0], place[1]).T
    if len(index) < 3:
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
    return kind(
        stamp_ns=stamp_ns(message),
        latitude=float(point.latitude),
        longitude=float(point.longitude),
        height=float(point.altitude) if np.isfinite(point.altitude) else float('nan'),
        covariance=_covariance(message),
        frame_id=str(message.header.frame_id),
    )


def _covariance(message: Any) -> np.ndarray | None:
    """(3, 3) east, north, up; None where it is unknown or was not filled in."""
    if hasattr(message, 'position_covariance'):
        covariance = np.array(message.position_covariance, np.float64).ravel()
        size, kind = 9, int(message.position_covariance_type)
    elif hasattr(getattr(message, 'pose', None), 'covariance'):
        covariance, size, kind = np.array(message.pose.covariance, np.float64).ravel(), 36, KNOWN
    else:
        return None
    if kind == UNKNOWN:
        return None
    if covariance.size != size:
        raise Rejection(
            'bad_shape', f'the covariance has {covariance.size} numbers, {size} are needed'
        )
    covariance = covariance.reshape(3, 3) if size == 9 else covariance.reshape(6, 6)[:3, :3]
    if kind == DIAGONAL:
        covariance = np.diag(np.diag(covariance))
    if not covariance.any() or (np.diag(covariance) < 0.0).any():
        return None
    if not covariance[2].any():  # no height: say so, rather than that it is certain
        covariance = covariance + np.diag([0.0, 0.0, UNKNOWN_VARIANCE])
    if (np.abs(covariance) <= MOST_VARIANCE).all():
        least = float(np.linalg.eigvalsh(0.5 * (covariance + covariance.T))[0])
        if least < LEAST_VARIANCE:
            raise Rejection('out_of_range', f'the position states a variance of {least:g} m^2')
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
