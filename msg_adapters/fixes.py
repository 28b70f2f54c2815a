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

"""Position fixes and starts of tracks: geometry_msgs PoseWithCovarianceStamped or PointStamped.

Publishers fill in covariances in different ways. Of the x-y block a negative variance means
unknown. All zeros mean that it was not filled in: unknown too, and worth a warning (see
`doubt_fix`). Anything else has to be finite, symmetric and positive definite, or the fix is
refused. What is stated of z is used with it, or left out where it cannot be true
(`measurements.in_space`).
"""

from __future__ import annotations

from typing import Any, TypeVar

from attrs import evolve
import numpy as np
from numpy.typing import NDArray

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Fix, Rejection, RelativeFix, Start
from sonar_imm.measurements.checks import check_covariance
from sonar_imm.measurements.diver import UNKNOWN_VARIANCE

from .headers import Make, make_header, make_pose, stamp_ns, swap_axes, swap_covariance, to_enu

Place = TypeVar('Place', Fix, Start)

LEAST_VARIANCE, MOST_VARIANCE = 1e-12, 1e16
"""Limits of the variance of a fix, m^2: a micrometre and 100,000 km squared."""


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
        stamp_ns=stamp_ns(message),
        position=(x, y, z if np.isfinite(z) else 0.0),
        covariance=covariance,
        frame_id=str(message.header.frame_id),
    )
    check_size(fix)
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
        stamp_ns=stamp_ns(message),
        position=(float(point.x), float(point.y), float(point.z)),
        covariance=covariance,
        frame_id=str(message.header.frame_id),
    )
    check_size(start, 'start')
    return to_enu(start, world_frame, _turned)


def _turned(fix: Place) -> Place:
    """The same place in ENU, of one in NED."""
    covariance = None if fix.covariance is None else swap_covariance(fix.covariance)
    return evolve(fix, position=swap_axes(fix.position), covariance=covariance)


def check_size(fix: Fix | Start, what: str = 'fix') -> None:
    """Raise `Rejection` for a covariance so small or large that arithmetic with it breaks down."""
    if fix.covariance is None or np.isnan(fix.covariance[0, 0]):
        return
    least, most = np.linalg.eigvalsh(fix.covariance[:2, :2])
    if least < LEAST_VARIANCE or most > MOST_VARIANCE:
        raise Rejection(
            'out_of_range',
            f'the {what} states a standard deviation from '
            f'{np.sqrt(least):g} m to {np.sqrt(most):g} m',
        )


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
    return make(
        'geometry_msgs/msg/PoseWithCovarianceStamped',
        header=make_header(fix.stamp_ns, fix.frame_id, make),
        pose=make(
            'geometry_msgs/msg/PoseWithCovariance',
            pose=make_pose(position, make),
            covariance=covariance.ravel(),
        ),
    )


def known_covariance(message: Any) -> NDArray[np.float64] | None:
    """The covariance (3, 3) of x, y and z, NaN where it is unknown; None where it is throughout.

    Raises `Rejection` where that of x and y cannot be used."""
    covariance = _covariance(message)
    if covariance is None:
        return None
    block = covariance[:2, :2]
    if block.any() and not (np.diag(block) < 0.0).any():
        check_covariance(block, 'a fix')
        return covariance
    covariance[:2], covariance[:, :2] = np.nan, np.nan
    stated = 0.0 < covariance[2, 2] < UNKNOWN_VARIANCE
    return covariance if stated else None


def _covariance(message: Any) -> NDArray[np.float64] | None:
    """Cut x, y and z (3, 3) out of the 6 x 6 covariance; None for a message without one."""
    if hasattr(message, 'point'):
        return None
    covariance = np.array(message.pose.covariance, np.float64)
    if covariance.size != 36:
        raise Rejection(
            'bad_shape', f'the covariance of a pose has {covariance.size} numbers, 36 are needed'
        )
    return covariance.reshape(6, 6)[:3, :3].copy()
