# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the obstacle tracker takes in: pings of a forward-looking sonar, navigation, altitude."""

from __future__ import annotations

import math
from typing import Any, ClassVar

from attrs import field, frozen
import numpy as np

from ..estimation.arrays import FloatArray
from .checks import (
    check_stamp,
    column,
    content_key,
    floats,
    nanoseconds,
    point,
    points,
    quaternion,
    Rejection,
)

BEAM_AXES = ('marine', 'rep103', 'auto')
"""What the axes of beam vectors may be: z forward and y to starboard; x forward and y to port; by
which of the two the beams point along."""
IMAGE_ORDERS = ('range_major', 'beam_major')
"""How the samples of an image may lie: all beams of a range together, or all ranges of a beam."""
MAX_IMAGE_CELLS = 4_000_000
"""No sonar makes larger images."""
LONGEST_SCAN = 120.0
"""Seconds; no sonar takes longer for a turn."""


OPTIONAL_COLUMNS = (
    'var_range',
    'var_bearing',
    'intensity',
    'extent_range',
    'extent_bearing',
    'elevation',
    'var_elevation',
    'time_offset',
)
"""What a detection may say besides range and bearing."""


def _unknown() -> Any:
    """A column that is left out: NaN in each row, whose number is known after the others."""
    return None


@frozen(eq=False, kw_only=True)
class Detections:
    """What a forward-looking sonar saw in one ping, one row an echo; none is a ping too.

    The stamp is the transmission. range: (n,) metres; bearing: (n,) rad, REP-103: positive to
    port; var_range: (n,) m^2 and var_bearing: (n,) rad^2, NaN where the sender does not know them;
    intensity: (n,), NaN where unknown, not used by the tracker; extent_range: (n,) m and
    extent_bearing: (n,) rad, spread (standard deviation) of the echo, NaN where unknown;
    elevation: (n,) rad, positive up, NaN where the sonar does not measure it, var_elevation: (n,)
    rad^2; time_offset: (n,) s after the stamp at which the row was heard, of a sonar that does not
    take all at once, NaN where unknown. Columns left out are unknown. A row without a finite range
    and bearing is no echo.

    A scan whose rows have times is dated by its end: where a row is later than the stamp, the
    stamp moves there. untimed: s that the ping took, where it says so and its rows have no times.
    """

    FRAME: ClassVar[str] = 'own'

    stamp_ns: int
    range: FloatArray = field(converter=column)
    bearing: FloatArray = field(converter=column)
    var_range: FloatArray = field(factory=_unknown)
    var_bearing: FloatArray = field(factory=_unknown)
    intensity: FloatArray = field(factory=_unknown)
    frame_id: str = ''
    extent_range: FloatArray = field(factory=_unknown)
    extent_bearing: FloatArray = field(factory=_unknown)
    elevation: FloatArray = field(factory=_unknown)
    var_elevation: FloatArray = field(factory=_unknown)
    time_offset: FloatArray = field(factory=_unknown)
    untimed: float = 0.0

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        unknown = column(np.full(len(self.range), np.nan))
        for name in OPTIONAL_COLUMNS:
            given = getattr(self, name)
            object.__setattr__(self, name, unknown if given is None else column(given))
        for name in ('bearing', *OPTIONAL_COLUMNS):
            rows = len(getattr(self, name))
            if rows != len(self):
                raise Rejection(
                    'bad_shape', f'detections: {name} has {rows} rows, range has {len(self)}'
                )
        self._date_by_the_end()

    def _date_by_the_end(self) -> None:
        """Move the stamp to the last row, and count times from there."""
        late = self.time_offset[np.isfinite(self.time_offset)]
        if not len(late):
            return
        if np.abs(late).max() > LONGEST_SCAN:
            raise Rejection(
                'out_of_range',
                f'detections: a time_offset of {late[np.abs(late).argmax()]:g} s; at most '
                f'{LONGEST_SCAN:g} s before or after the stamp are read',
            )
        end = max(float(late.max()), 0.0)
        if end > 0.0:
            object.__setattr__(self, 'stamp_ns', self.stamp_ns + nanoseconds(end))
            check_stamp(self.stamp_ns)
            object.__setattr__(self, 'time_offset', column(self.time_offset - end))

    def __len__(self) -> int:
        return len(self.range)

    @property
    def takes(self) -> float:
        """How long the rows took, s; 0 where all are of one instant."""
        known = np.isfinite(self.time_offset)
        return -float(self.time_offset[known].min()) if known.any() else 0.0

    def key(self) -> bytes:
        """See `content_key`."""
        columns = [self.range, self.bearing, self.var_range, self.var_bearing]
        if np.isfinite(self.elevation).any():
            columns += [self.elevation, self.var_elevation]
        if self.takes:
            columns.append(self.time_offset)
        return content_key('detections', *columns)


@frozen(eq=False, kw_only=True)
class SonarImage:
    """A ping of a forward-looking sonar before detection; no tracker takes it in.

    range (R,) m and bearing (B,) rad, positive to port, of the magnitudes amplitude (R, B); rows
    and beams without a finite place, and samples that are not finite, are left out by a detector.
    scanning: one direction of a sonar that turns, of which a detector gathers many. delay: (B,) s
    after the stamp at which each beam was taken, None for a sonar that takes all at once.
    """

    FRAME: ClassVar[str] = 'own'

    stamp_ns: int
    range: FloatArray = field(converter=column)
    bearing: FloatArray = field(converter=column)
    amplitude: FloatArray
    frame_id: str = ''
    scanning: bool = False
    delay: FloatArray | None = None

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        shape = len(self.range), len(self.bearing)
        if self.amplitude.shape != shape:
            raise Rejection(
                'bad_shape', f'an image of shape {self.amplitude.shape} has axes of {shape}'
            )
        if shape[0] * shape[1] > MAX_IMAGE_CELLS:
            raise Rejection('too_large', f'an image of {shape[0]} ranges and {shape[1]} beams')


@frozen(eq=False, kw_only=True)
class SonarInfo:
    """What a sonar says of its images, in place of parameters; no tracker takes it in.

    scale: what a sample is, ``'amplitude'``, ``'power'``, ``'decibel'``, or '' where it is not
    stated. gain, offset: a sample times `gain` plus `offset` is that; gain 0: not stated.
    echo_duration: s between the -3 dB points of the echo of a point, 0: not stated.
    """

    FRAME: ClassVar[str] = 'own'

    stamp_ns: int
    scale: str = ''
    gain: float = 0.0
    offset: float = 0.0
    echo_duration: float = 0.0
    frame_id: str = ''


@frozen(eq=False, kw_only=True)
class Navigation:
    """Where the vehicle was: its pose in the world and its velocity in its own frame.

    position: (3,) metres and orientation: (4,) quaternion x, y, z, w, world from body; velocity:
    (3,) m/s and turn_rate: (3,) rad/s of the body, NaN where unknown. World ENU, body FLU.
    pose_covariance, twist_covariance: (6, 6) or None when unknown.
    """

    stamp_ns: int
    position: FloatArray = field(converter=point)
    orientation: FloatArray = field(converter=quaternion)
    velocity: FloatArray = field(converter=point, factory=lambda: np.full(3, np.nan))
    turn_rate: FloatArray = field(converter=point, factory=lambda: np.full(3, np.nan))
    pose_covariance: FloatArray | None = None
    twist_covariance: FloatArray | None = None
    frame_id: str = ''
    child_frame_id: str = ''

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        if not (np.isfinite(self.position).all() and np.isfinite(self.orientation).all()):
            raise Rejection('nan', 'the navigation has a pose that is not finite')
        if np.abs(self.position).max() > 1e8:
            raise Rejection(
                'out_of_range', 'the vehicle lies further than 100,000 km from the origin'
            )
        length = math.hypot(*self.orientation)
        if abs(length - 1.0) > 0.01:
            raise Rejection(
                'bad_orientation',
                f'the orientation is a quaternion of length {length:.3g}, not 1',
            )
        for name in ('pose_covariance', 'twist_covariance'):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, floats(getattr(self, name), 6, 6))

    def key(self) -> bytes:
        """See `content_key`; velocities are not used."""
        return content_key('navigation', self.position, self.orientation)


@frozen(eq=False, kw_only=True)
class Altitude:
    """How high above the sea floor the vehicle was, metres; variance m^2, NaN when unknown."""

    FRAME: ClassVar[str] = 'own'

    stamp_ns: int
    altitude: float
    variance: float = float('nan')
    frame_id: str = ''

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        if not np.isfinite(self.altitude):
            raise Rejection('nan', 'the altitude is not finite')
        if self.altitude < 0.0:
            raise Rejection('out_of_range', f'the altitude is {self.altitude:g} m, below zero')

    def key(self) -> bytes:
        """See `content_key`."""
        return content_key('altitude', np.float64(self.altitude))


@frozen(eq=False, kw_only=True)
class Ground:
    """Soundings: places of the sea floor in the world.

    position: (n, 3) m, ENU; variance: (n,) m^2 of the height, 0 where unknown.
    """

    stamp_ns: int
    position: FloatArray = field(converter=points)
    variance: FloatArray = field(converter=column)
    frame_id: str = ''

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        if len(self.variance) != len(self):
            raise Rejection(
                'bad_shape', f'{len(self)} soundings have {len(self.variance)} variances'
            )
        if not (np.isfinite(self.position).all() and np.isfinite(self.variance).all()):
            raise Rejection('nan', 'a sounding is not finite')
        if len(self) and np.abs(self.position).max() > 1e8:
            raise Rejection(
                'out_of_range', 'a sounding lies further than 100,000 km from the origin'
            )

    def __len__(self) -> int:
        return len(self.position)

    def key(self) -> bytes:
        """See `content_key`."""
        return content_key('ground', self.position, self.variance)
