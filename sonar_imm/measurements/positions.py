# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Positions that are not in the frame of the tracks: latitude and longitude, or relative to a
transceiver on a vessel; and the vessel's own pose. The diver tracker places them. Beside them
what is known of frames that are fixed to each other."""

from __future__ import annotations

import math
from typing import ClassVar

from attrs import field, frozen
import numpy as np

from ..acoustics.geometry import Pose
from ..estimation.arrays import FloatArray
from .checks import (
    check_covariance,
    check_stamp,
    content_key,
    floats,
    point,
    quaternion,
    Rejection,
)
from .diver import NOBODY
from .obstacle import Navigation
from .variances import MOST_VARIANCE, UNMEASURED_ANGLE

FARTHEST_OFFSET = 1e5
"""Most metres from a transceiver to what it has located."""


def _symmetric(covariance: FloatArray | None, what: str) -> FloatArray | None:
    """A read-only covariance (3, 3). Raises `Rejection` for one that is none."""
    if covariance is None:
        return None
    given = floats(covariance, 3, 3)
    if np.isfinite(given).all() and np.abs(given).max() > MOST_VARIANCE:
        raise Rejection(
            'out_of_range', f'the covariance of {what} reaches {np.abs(given).max():g}'
        )
    check_covariance(given, what)
    symmetric = 0.5 * given + 0.5 * given.T
    symmetric.flags.writeable = False
    return np.asarray(symmetric)


@frozen(eq=False, kw_only=True)
class GeodeticFix:
    """A position in latitude and longitude.

    latitude, longitude: degrees, WGS 84; height: m above the ellipsoid, NaN when unknown.
    covariance: (3, 3) east, north, up at the place, m^2, or None. target_id: whose position it is,
    `NOBODY` when that is not known; sensor: which of several sensors it is from.
    """

    FRAME: ClassVar[str] = 'none'

    stamp_ns: int
    latitude: float
    longitude: float
    height: float = float('nan')
    covariance: FloatArray | None = None
    target_id: int = NOBODY
    sensor: str = ''
    frame_id: str = ''

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        if not np.isfinite([self.latitude, self.longitude]).all():
            raise Rejection('nan', 'the latitude or the longitude is not finite')
        if abs(self.latitude) > 90.0 or abs(self.longitude) > 360.0:
            raise Rejection(
                'out_of_range',
                f'latitude {self.latitude:g}, longitude {self.longitude:g} is not a position on '
                'Earth',
            )
        if np.isinf(self.height) or abs(self.height) > 1e6:
            raise Rejection('out_of_range', f'the height is {self.height:g} m')
        covariance = _symmetric(self.covariance, 'a position')
        object.__setattr__(self, 'covariance', covariance)

    def key(self) -> bytes:
        """See `content_key`."""
        place = np.array([self.latitude, self.longitude, self.height])
        return content_key('geodetic', place, self.covariance, np.int64(self.target_id))


@frozen(eq=False, kw_only=True)
class VesselFix(GeodeticFix):
    """Where the antenna of the vessel is."""


@frozen(eq=False, kw_only=True)
class VesselPose(Navigation):
    """The pose of the vessel that carries a transceiver. Its frame is that of what it places."""

    FRAME: ClassVar[str] = 'none'


@frozen(eq=False, kw_only=True)
class VesselHeading:
    """How the vessel lies: orientation (4,) quaternion x, y, z, w, ENU from FLU; covariance (3, 3)
    of a rotation vector in the world, rad^2, NaN in row and column of an axis that is unknown, or
    None."""

    FRAME: ClassVar[str] = 'none'

    stamp_ns: int
    orientation: FloatArray = field(converter=quaternion)
    covariance: FloatArray | None = None
    frame_id: str = ''

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        if not np.isfinite(self.orientation).all():
            raise Rejection('nan', 'the orientation of the vessel is not finite')
        length = math.hypot(*self.orientation)
        if abs(length - 1.0) > 0.01:
            raise Rejection(
                'bad_orientation',
                f'the orientation is a quaternion of length {length:.3g}, not 1',
            )
        if self.covariance is not None:
            given = floats(self.covariance, 3, 3)
            variance = np.diag(given)
            known = (variance > 0.0) & (variance <= UNMEASURED_ANGLE)
            if known.any():
                check_covariance(given[np.ix_(known, known)], 'an orientation')
            object.__setattr__(self, 'covariance', given)

    def key(self) -> bytes:
        """See `content_key`."""
        return content_key('heading', self.orientation)


@frozen(eq=False, kw_only=True)
class RelativeFix:
    """A position that a transceiver on a vessel has measured from itself.

    offset: (3,) m, in the axes of the transceiver (forward, port, up), or, when levelled, east,
    north, up by its own compass. covariance: (3, 3) in the same axes, m^2, or None; target_id and
    sensor: as of `GeodeticFix`.
    """

    FRAME: ClassVar[str] = 'own'

    stamp_ns: int
    offset: FloatArray = field(converter=point)
    covariance: FloatArray | None = None
    levelled: bool = False
    target_id: int = NOBODY
    sensor: str = ''
    frame_id: str = ''

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        if not np.isfinite(self.offset).all():
            raise Rejection('nan', 'the relative position is not finite')
        if np.abs(self.offset).max() > FARTHEST_OFFSET:
            raise Rejection(
                'out_of_range',
                f'the relative position {self.offset} is further than '
                f'{FARTHEST_OFFSET / 1e3:g} km away',
            )
        covariance = _symmetric(self.covariance, 'a relative position')
        object.__setattr__(self, 'covariance', covariance)

    def key(self) -> bytes:
        """See `content_key`."""
        turned = np.array([self.target_id, self.levelled], np.int64)
        return content_key('relative', self.offset, self.covariance, turned)


@frozen(eq=False, kw_only=True)
class StaticTransforms:
    """What one message says of frames that are fixed to each other: of each child frame its parent
    and its pose in that, FLU or ENU axes."""

    FRAME: ClassVar[str] = 'none'

    poses: dict[str, tuple[str, Pose]]
    stamp_ns: int = 0
    frame_id: str = ''

    def key(self) -> bytes:
        """No tracker takes it into its history."""
        return b'transforms'
