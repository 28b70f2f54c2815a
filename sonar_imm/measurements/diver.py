# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the diver tracker takes in: position fixes, one by one or as scans, and arrival times."""

from __future__ import annotations

from typing import Any

from attrs import evolve, field, frozen
import numpy as np
from numpy.typing import NDArray

from ..estimation.arrays import FloatArray
from .checks import (
    check_covariance,
    check_stamp,
    column,
    content_key,
    floats,
    point,
    points,
    Rejection,
)
from .variances import LEAST_VARIANCE, UNKNOWN_VARIANCE


def _ids(value: Any) -> NDArray[np.uint16]:
    array = np.array(value, dtype=np.uint16)
    array.flags.writeable = False
    return array


NOBODY = -1
"""The `target_id` of a fix that does not say whose it is."""

FARTHEST_FIX = 1e8
"""Most metres of a fix from the origin on each axis."""

LEAST_REST = 1e-9
"""Least share of the variance of z that may be left when x and y are known."""


def in_space(covariance: Any, position: FloatArray) -> FloatArray:
    """Covariances (n, 3, 3) at `position` (n, 3) of those of x and y (n, 2, 2) or of all.

    The row and the column of z are NaN where z is not stated: it has no variance, one that is not
    positive, or `UNKNOWN_VARIANCE` and more; it goes together with x and y as no errors can; or z
    itself is not finite. x and y are then used without it. Where x and y are unknown (NaN), z may
    be stated all the same. Raises `Rejection` for other shapes.
    """
    given, n = np.asarray(covariance, np.float64), len(position)
    if given.shape == (n, 2, 2):
        whole = np.full((n, 3, 3), np.nan)
        whole[:, :2, :2] = given
        return whole
    whole = floats(given, n, 3, 3).copy()
    if np.isnan(whole[:, 2, 2]).all():  # z is not stated, which is so scan after scan
        whole[:, 2, :] = whole[:, :, 2] = np.nan
        return whole
    with np.errstate(all='ignore'):
        variance, across = whole[:, 2, 2], 0.5 * (whole[:, 2, :2] + whole[:, :2, 2])
        a, b, d = whole[:, 0, 0], 0.5 * (whole[:, 0, 1] + whole[:, 1, 0]), whole[:, 1, 1]
        x, y = across.T
        taken = (x * x * d - 2.0 * x * y * b + y * y * a) / (a * d - b * b)
        apart = np.abs(whole[:, 2, :2] - whole[:, :2, 2]).max(axis=1, initial=0.0)
        real = (taken >= 0.0) & (taken <= (1.0 - LEAST_REST) * variance)
        real &= apart <= 1e-6 * np.sqrt(variance * np.maximum(a, d))
    flat = np.isnan(whole[:, :2, :2]).all(axis=(1, 2))
    stated = (variance >= LEAST_VARIANCE) & (variance < UNKNOWN_VARIANCE) & (real | flat)
    stated &= np.abs(position[:, 2]) <= FARTHEST_FIX
    whole[flat, 2, :2] = whole[flat, :2, 2] = np.nan
    whole[~stated, 2, :] = whole[~stated, :, 2] = np.nan
    return whole


@frozen(eq=False, kw_only=True)
class Fix:
    """A position found elsewhere: multistatic fusion, USBL, GPS.

    position: (3,) x, y, z in `frame_id`, metres (ENU by default; z may be 0).
    covariance: (3, 3) in m^2, or None when the sender does not know it; NaN in the row and column
    of z where z is not stated, NaN in the block of x and y where only z is (`in_space`). Also
    taken: (2, 2) of x and y. target_id: whose position it is, `NOBODY` when that is not known;
    sensor: which of several sensors it is from, by a name of the parameter `sensors`; seen_from:
    (2,) x and y of the sensor, None where they do not matter or are not known.
    """

    stamp_ns: int
    position: FloatArray = field(converter=point)
    covariance: FloatArray | None = None
    target_id: int = NOBODY
    sensor: str = ''
    frame_id: str = ''
    seen_from: FloatArray | None = None

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        if not np.isfinite(self.position[:2]).all():
            raise Rejection('nan', 'the fix has a position that is not finite')
        if np.abs(self.position[:2]).max() > 1e8:
            raise Rejection(
                'out_of_range',
                f'the fix lies at {self.position[:2]}, further than 100,000 km from the origin',
            )
        if self.covariance is not None:
            covariance = _checked(self.covariance, self.position, 'a fix')
            object.__setattr__(self, 'covariance', covariance)

    def key(self) -> bytes:
        """See `content_key`."""
        parts = self.position, self.covariance, _target_ids(self)
        place = () if self.seen_from is None else (self.seen_from,)
        return content_key('fix' + self.sensor, *parts, *place)


def _checked(covariance: Any, position: FloatArray, what: str) -> FloatArray:
    """A read-only covariance (3, 3), see `in_space`, of one whose part of x and y is good or,
    where z is stated, unknown. Raises `Rejection`."""
    whole = in_space(np.array(covariance, np.float64)[None], position[None])[0]
    if np.isnan(whole[2, 2]) or not np.isnan(whole[:2, :2]).all():
        check_covariance(whole[:2, :2], what)
    whole = 0.5 * whole + 0.5 * whole.T
    whole.flags.writeable = False
    return np.asarray(whole)


def _target_ids(fix: Fix) -> NDArray | None:
    """The name of a fix as an array, None when it has none."""
    return None if fix.target_id == NOBODY else np.array([fix.target_id], np.int32)


def _names(value: Any) -> NDArray[np.int32] | None:
    if value is None:
        return None
    array = np.array(value, dtype=np.int32)
    array.flags.writeable = False
    return array


@frozen(eq=False, kw_only=True)
class Fixes:
    """A scan: all positions that were found at one stamp, also when there are none.

    position: (n, 3) x, y, z in `frame_id`, metres; covariance: (n, 3, 3) in m^2, each as of `Fix`,
    NaN throughout where the sender does not know it, None when no row has one; also taken:
    (n, 2, 2); target_id: (n,) whose position it is, `NOBODY` where that is not known, None when no
    row says so; sensor: as of `Fix`.
    """

    stamp_ns: int
    position: FloatArray = field(converter=points)
    covariance: FloatArray | None = None
    target_id: NDArray[np.int32] | None = field(default=None, converter=_names)
    sensor: str = ''
    frame_id: str = ''

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        n = len(self.position)
        if self.target_id is not None and self.target_id.shape != (n,):
            raise Rejection(
                'bad_shape', f'fixes: {len(self.target_id)} identities for {n} positions'
            )
        if self.covariance is not None:
            covariance = in_space(self.covariance, self.position)
            covariance.flags.writeable = False
            known = not np.isnan(covariance).all()
            object.__setattr__(self, 'covariance', covariance if known else None)
        if not usable_fixes(self.position, self.covariance).all():
            raise Rejection(
                'bad_row', 'a fix of the scan has a position or a covariance that cannot be used'
            )

    def __len__(self) -> int:
        return len(self.position)

    def key(self) -> bytes:
        """See `content_key`."""
        return content_key('fixes' + self.sensor, self.position, self.covariance, self.target_id)


def scan_of(measurement: Fix | Fixes) -> Fixes:
    """A fix as a scan with one row; a scan as it is."""
    if isinstance(measurement, Fixes):
        return measurement
    return Fixes(
        stamp_ns=measurement.stamp_ns,
        position=measurement.position[None],
        covariance=None if measurement.covariance is None else measurement.covariance[None],
        target_id=None if measurement.target_id == NOBODY else [measurement.target_id],
        sensor=measurement.sensor,
        frame_id=measurement.frame_id,
    )


def usable_fixes(position: FloatArray, covariance: FloatArray | None) -> NDArray[np.bool_]:
    """Which of the positions (n, 3), with covariances (n, 3, 3) or None, can be used: finite x and
    y, and a covariance of these that is unknown (NaN throughout) or symmetric and positive
    definite."""
    with np.errstate(invalid='ignore', over='ignore'):
        usable = (np.abs(position[:, :2]) <= FARTHEST_FIX).all(axis=1)
        if covariance is None:
            return np.asarray(usable)
        a, b, c, d = covariance[:, :2, :2].reshape(-1, 4).T
        scale = np.maximum(np.maximum(np.abs(a), np.abs(d)), np.abs(b))
        # Halved before it is added, so that nothing overflows; as `check_covariance`.
        least = 0.5 * a + 0.5 * d - np.hypot(0.5 * a - 0.5 * d, b)
        known = (np.abs(b - c) <= 1e-6 * scale) & (least > 1e-12 * scale) & (scale < np.inf)
        if not known.all():
            known |= np.isnan(covariance[:, :2, :2]).all(axis=(1, 2))
        return np.asarray(usable & known)


OPTIONAL_ARRIVALS = ('elevation', 'var_elevation', 'depth', 'var_depth')
"""Columns of `Arrivals` that may be left out."""

ARRIVAL_COLUMNS = (
    'tx_id',
    'rx_id',
    'toa',
    'var_toa',
    'tx',
    'rx',
    'bearing',
    'var_bearing',
    *OPTIONAL_ARRIVALS,
)
"""Columns of `Arrivals`, in the order in which they sort its rows."""


@frozen(eq=False, kw_only=True)
class Arrivals:
    """Arrival times of one ping, one row a transmitter-receiver pair.

    toa: (n,) seconds after the stamp. With a known transmitter (`tx` finite) the stamp is the
    transmission and the path is transmitter - target - receiver. With `tx` NaN the target itself
    emits at an unknown time near the stamp (an acoustic tag) and only differences between
    receivers carry information. tx, rx: (n, 3) metres in `frame_id`; var_toa: (n,) s^2, NaN where
    unknown; bearing: (n,) rad at the receiver, counter-clockwise from +x, NaN where not measured;
    var_bearing: (n,) rad^2. elevation: (n,) rad at the receiver, up positive, with var_elevation,
    and depth: (n,) m, down positive, the target's own report, with var_depth m^2; each NaN or left
    out where not measured.
    """

    stamp_ns: int
    tx_id: NDArray[np.uint16] = field(converter=_ids)
    rx_id: NDArray[np.uint16] = field(converter=_ids)
    tx: FloatArray = field(converter=points)
    rx: FloatArray = field(converter=points)
    toa: FloatArray = field(converter=column)
    var_toa: FloatArray = field(converter=column)
    bearing: FloatArray = field(converter=column)
    var_bearing: FloatArray = field(converter=column)
    elevation: FloatArray = field(default=(), converter=column)
    var_elevation: FloatArray = field(default=(), converter=column)
    depth: FloatArray = field(default=(), converter=column)
    var_depth: FloatArray = field(default=(), converter=column)
    frame_id: str = ''

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        n = len(self.toa)
        for name in OPTIONAL_ARRIVALS:
            if n and not len(getattr(self, name)):
                object.__setattr__(self, name, column(np.full(n, np.nan)))
        columns = ('tx_id', 'rx_id', 'tx', 'rx', 'var_toa', 'bearing', 'var_bearing')
        for name in (*columns, *OPTIONAL_ARRIVALS):
            if len(getattr(self, name)) != n:
                raise Rejection(
                    'bad_shape',
                    f'arrivals: {name} has {len(getattr(self, name))} rows, toa has {n}',
                )
        if not np.isfinite(self.rx).all():
            raise Rejection('nan', 'arrivals: a receiver position is not finite')

    def __len__(self) -> int:
        return len(self.toa)

    def key(self) -> bytes:
        """See `content_key`."""
        ordered = self.in_order()
        return content_key('arrivals', *(getattr(ordered, name) for name in ARRIVAL_COLUMNS))

    def in_order(self) -> Arrivals:
        """The same ping with its rows in the order of their content."""
        keys = [getattr(self, name) for name in reversed(ARRIVAL_COLUMNS)]
        columns = [column for key in keys for column in np.atleast_2d(key.T)[::-1]]
        order = np.lexsort(columns) if len(self) else np.arange(0)
        if (np.diff(order) == 1).all():
            return self
        return self.only(order)

    def only(self, rows: NDArray) -> Arrivals:
        """The same ping with some of its rows: an index or a mask."""
        return evolve(self, **{name: getattr(self, name)[rows] for name in ARRIVAL_COLUMNS})

    @property
    def passive(self) -> bool:
        """True when the target itself emits, at an unknown time."""
        return len(self) > 0 and bool(np.isnan(self.tx).all())


@frozen(eq=False, kw_only=True)
class Start:
    """Where somebody says that a diver is: not measured, but from a person or another program.

    position: (3,) x, y, z in `frame_id`, the frame of the tracks, m; z is not used by a tracker of
    two dimensions. covariance: (3, 3) or (2, 2) in m^2 as of `Fix`; there is no start without one
    of x and y. target_id: ID of the diver, or `NOBODY`.
    """

    stamp_ns: int
    position: FloatArray = field(converter=point)
    covariance: FloatArray
    frame_id: str = ''
    target_id: int = NOBODY

    def __attrs_post_init__(self) -> None:
        check_stamp(self.stamp_ns)
        if not np.isfinite(self.position[:2]).all():
            raise Rejection('nan', 'the start has a position that is not finite')
        if np.abs(self.position[:2]).max() > FARTHEST_FIX:
            raise Rejection(
                'out_of_range',
                f'the start lies at {self.position[:2]}, further than 100,000 km from the origin',
            )
        covariance = _checked(self.covariance, self.position, 'a start')
        check_covariance(covariance[:2, :2], 'a start')
        object.__setattr__(self, 'covariance', covariance)

    def key(self) -> bytes:
        """See `content_key`."""
        return content_key('start', self.position, self.covariance, np.int64(self.target_id))
