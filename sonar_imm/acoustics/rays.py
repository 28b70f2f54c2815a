# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Rays through a profile of sound speed.

The profile is linear between its depths and constant beyond its ends, so in each layer the speed
has a constant gradient g and a ray is an arc of a circle. From speed c0, elevation phi below the
horizontal (S = sin phi) and a time tau inside one layer::

    den = cosh(g tau) - S sinh(g tau),   c = c0 / den
    dz  = c0 (S sinh(g tau)/g - 2 sinh^2(g tau / 2)/g) / den          down
    dx  = c0 cos(phi) (sinh(g tau)/g) / den                           outward
    sin(phi') = (S - T) / (1 - S T),   T = tanh(g tau)

which is well behaved for g -> 0 (a straight line), for phi = 90 degrees and through a turning
point, where phi changes its sign inside the layer. The time to the edge with speed c' is

    (atanh S - atanh S') / g,   S' = +-sqrt(1 - (c' cos(phi) / c0)^2)

and ``ln(c'/c0)/g`` on the vertical. Times are one way.

What a sonar needs is the other way round: at a range r (a time r / c_ref) the floor lies D below
the array; how far below the horizontal did its echo come in? `launch_table` tabulates
``r sin(phi)`` over depth and range. It equals D where sound is straight and is smooth everywhere,
so that bilinear interpolation is enough.

Conventions
    Metres, seconds, m/s, radians; depths positive down from the water line.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..estimation.arrays import FloatArray
from .ray_kernels import trace_rays

SLOWEST, FASTEST = 1300.0, 1700.0

RANGE_STEP, DEPTH_STEP = 1.0, 0.25
"""Metres between the rows and the columns of a launch table, up to 200 m of range."""
_MOST_ROWS = 200
_ELEVATIONS = 721
"""Rays traced for a table, evenly from straight up to straight down."""


class Profile(NamedTuple):
    """Sound speed (n,) m/s at depths (n,) m, increasing."""

    depth: FloatArray
    speed: FloatArray

    def at(self, depth: ArrayLike) -> FloatArray:
        """Speed at depths (...,)."""
        return np.interp(np.asarray(depth, np.float64), self.depth, self.speed)


class Rays(NamedTuple):
    """Where rays are after a time: depth (...,) m, distance (...,) m outward, elevation (...,)
    rad below the horizontal."""

    depth: FloatArray
    distance: FloatArray
    elevation: FloatArray


class LaunchTable(NamedTuple):
    """``r sin(phi)`` (R, D) in metres, at ranges ``k range_step`` and at depths below the array
    ``first_depth + i depth_step``; NaN where no ray gets to."""

    value: FloatArray
    range_step: float
    first_depth: float
    depth_step: float


def profile_problem(pairs: Sequence[float]) -> str | None:
    """What is wrong with a flat list depth, speed, depth, speed, ...; None for a good one."""
    if not pairs or len(pairs) % 2:
        return f'holds depths and speeds in turn, so not {len(pairs)} numbers'
    depth, speed = pairs[::2], pairs[1::2]
    if any(not b > a for a, b in zip(depth, depth[1:])):
        return 'needs increasing depths'
    if not all(SLOWEST <= c <= FASTEST for c in speed):
        return f'needs speeds between {SLOWEST:g} and {FASTEST:g} m/s'
    return None


def profile_of(pairs: Sequence[float]) -> Profile:
    """The profile of a flat list depth, speed, depth, speed, ...

    Raises ValueError for a list that is none.
    """
    if problem := profile_problem(pairs):
        raise ValueError(f'a sound speed profile {problem}')
    return Profile(np.array(pairs[::2], np.float64), np.array(pairs[1::2], np.float64))


def trace(profile: Profile, depth: ArrayLike, elevation: ArrayLike, time: ArrayLike) -> Rays:
    """Rays from `depth` at `elevation` below the horizontal, `time` later; all broadcast."""
    start, launch, tau = np.broadcast_arrays(
        *(np.asarray(value, np.float64) for value in (depth, elevation, time))
    )
    end, reached = np.empty((4, start.size)), np.empty((1, start.size))
    a, b, c = (np.ascontiguousarray(part).ravel() for part in (start, launch, tau))
    trace_rays(profile.depth, profile.speed, a, b, c, reached, end)
    z, x, sine, cosine = end.reshape(4, *start.shape)
    return Rays(z, x, np.arctan2(sine, cosine))


def launch_table(
    profile: Profile, depth: float, last_range: float, sound_speed: float
) -> LaunchTable:
    """Where echoes come in at an array in `depth`, for ranges up to `last_range` and floors at
    all depths that can be reached.

    A range is a time: ``range / sound_speed``, one way, whatever speed made it. Where several rays
    reach one place, the one that left steepest downward counts.
    """
    row_step = max(RANGE_STEP, last_range / _MOST_ROWS)
    column_step = DEPTH_STEP * row_step / RANGE_STEP
    rows = math.ceil(last_range / row_step) + 1
    reach = math.ceil(rows * row_step * float(profile.speed.max()) / sound_speed / column_step) + 1
    elevation = np.linspace(-0.5 * math.pi, 0.5 * math.pi, _ELEVATIONS)
    time = np.full(_ELEVATIONS, row_step / sound_speed)
    reached = np.zeros((rows, _ELEVATIONS))
    start, end = np.full(_ELEVATIONS, depth), np.empty((4, _ELEVATIONS))
    trace_rays(profile.depth, profile.speed, start, elevation, time, reached[1:], end)
    column = -reach * column_step + np.arange(2.0 * reach + 1.0) * column_step
    value = _invert(np.sin(elevation), reached, row_step, column)
    return LaunchTable(value, row_step, -reach * column_step, column_step)


def _invert(
    sines: FloatArray, reached: FloatArray, range_step: float, depth: FloatArray
) -> FloatArray:
    """``r sin(phi)`` (R, D) at depths (D,) from depths by elevation (R, E).

    Beyond the deepest and the highest point the table goes on with slope one, so that the cells
    at straight down and straight up can be interpolated too: there ``r sin(phi) > r`` says that
    nothing is reached. Where rays fold back, whatever lies above is in the shade: NaN.
    """
    value = np.empty((len(reached), len(depth)))
    for k, row in enumerate(reached):
        r, folds = k * range_step, np.flatnonzero(~(np.diff(row) > 0.0))
        first = folds[-1] + 1 if len(folds) else 0  # from here on depths increase
        deeper = (depth >= row[-1]) | (k == 0)
        value[k] = r + depth - row[-1]
        e = first + np.searchsorted(row[first:], depth, side='right')
        between, shallower = ~deeper & (e > first), ~deeper & (e == first)
        e = e[between]
        share = (depth[between] - row[e - 1]) / (row[e] - row[e - 1])
        value[k, between] = r * (sines[e - 1] + share * (sines[e] - sines[e - 1]))
        value[k, shallower] = math.nan if first else -r + depth[shallower] - row[0]
    return value


def look_up(
    value: FloatArray, row: FloatArray, first_depth: float, depth_step: float, depth: FloatArray
) -> FloatArray:
    """``r sin(phi)`` of depths (T,) or (T, ...) from a launch table (R, D), bilinearly; row (T,):
    the range over its range step. NaN outside the table."""
    row = row.reshape(-1, *[1] * (depth.ndim - 1))
    k = np.clip(row.astype(np.int64), 0, len(value) - 2)
    place, last = (depth - first_depth) / depth_step, value.shape[1] - 2
    inside = (place >= 0.0) & (place <= last + 1.0)
    i = np.minimum(np.where(inside, place, 0.0).astype(np.int64), last)
    f, g = row - k, place - i
    low = value[k, i] + g * (value[k, i + 1] - value[k, i])
    high = value[k + 1, i] + g * (value[k + 1, i + 1] - value[k + 1, i])
    return np.where(inside, low + f * (high - low), np.nan)
