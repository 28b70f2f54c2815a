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
from ..estimation.jit import kernel

_FLAT = 1e-9
"""Gradients (1/s) below this are none: over 20 km they bend a ray by less than a millimetre."""
_MOST_LAYERS = 10_000
"""A ray crosses at most so many edges."""
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
    out = np.empty((start.size, 4))
    a, b, c = (np.ascontiguousarray(part).ravel() for part in (start, launch, tau))
    _trace_all(profile.depth, profile.speed, a, b, c, out)
    shape = start.shape
    angle = np.arctan2(out[:, 2], out[:, 3])
    return Rays(out[:, 0].reshape(shape), out[:, 1].reshape(shape), angle.reshape(shape))


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
    value = np.empty((rows, 2 * reach + 1))
    elevation = np.linspace(-0.5 * math.pi, 0.5 * math.pi, _ELEVATIONS)
    reached = np.empty((rows, _ELEVATIONS))
    _depths_reached(
        profile.depth, profile.speed, depth, elevation, row_step / sound_speed, reached
    )
    first = -reach * column_step
    _invert(np.sin(elevation), reached, row_step, first, column_step, value)
    return LaunchTable(value, row_step, first, column_step)


@kernel
def _trace_all(
    depths: FloatArray,
    speeds: FloatArray,
    start: FloatArray,
    launch: FloatArray,
    time: FloatArray,
    out: FloatArray,
) -> None:
    for k in range(start.shape[0]):
        z, x, sine, cosine = advance(
            depths, speeds, start[k], 0.0, math.sin(launch[k]), math.cos(launch[k]), time[k]
        )
        out[k, 0], out[k, 1], out[k, 2], out[k, 3] = z, x, sine, cosine


@kernel
def advance(
    depths: FloatArray,
    speeds: FloatArray,
    z: float,
    x: float,
    sine: float,
    cosine: float,
    time: float,
) -> tuple[float, float, float, float]:
    """A ray at depth z and distance x, going at (sine, cosine) of its elevation, `time` later."""
    n, left = depths.shape[0], time
    layer = 0  # between the depths layer - 1 and layer; on an edge, the one the ray goes into
    while layer < n and (z > depths[layer] or (z == depths[layer] and sine > 0.0)):
        layer += 1
    level_edges = 0
    for _ in range(_MOST_LAYERS):
        inside = 0 < layer < n
        g, c = 0.0, speeds[min(layer, n - 1)]
        if inside:
            g = (speeds[layer] - speeds[layer - 1]) / (depths[layer] - depths[layer - 1])
            c = speeds[layer - 1] + g * (z - depths[layer - 1])
        if abs(g) < _FLAT:
            down, edge_sine, edge_cosine = sine > 0.0, sine, cosine
            open_ended = sine == 0.0 or (layer == n if down else layer == 0)
            spent = math.inf
            if not open_ended:
                spent = (depths[layer if down else layer - 1] - z) / (c * sine)
        else:
            down, spent, edge_sine, edge_cosine = _to_edge(
                depths, speeds, layer, sine, cosine, c, g
            )
        step = min(max(spent, 0.0), left)
        if abs(g) < _FLAT:
            x += c * cosine * step
            z += c * sine * step
        else:
            sinh, half = math.sinh(g * step), math.sinh(0.5 * g * step)
            den = math.cosh(g * step) - sine * sinh
            x += c * cosine * sinh / (g * den)
            z += c * (sine * sinh - 2.0 * half * half) / (g * den)
            tangent = math.tanh(g * step)
            sine, cosine = (sine - tangent) / (1.0 - sine * tangent), cosine / den
        # A level ray on an edge goes to the layer it bends into. At a minimum of the speed both
        # layers send it back: it goes straight on.
        level_edges = level_edges + 1 if sine == 0.0 and not spent > 0.0 else 0
        if level_edges > 2:
            x += c * left
            break
        if not spent < left:
            break
        left -= step
        z = depths[layer if down else layer - 1]
        sine, cosine = edge_sine, edge_cosine
        layer += 1 if down else -1
    return z, x, sine, cosine


@kernel
def _to_edge(
    depths: FloatArray,
    speeds: FloatArray,
    layer: int,
    sine: float,
    cosine: float,
    c: float,
    g: float,
) -> tuple[bool, float, float, float]:
    """Which edge of a layer a ray meets (True: the lower), after what time, and its sine and
    cosine there.

    The ray bends to the slower side: the edge there is met always, the faster one only by a ray
    that goes to it and does not turn before.
    """
    faster_is_below = g > 0.0
    faster = speeds[layer] if faster_is_below else speeds[layer - 1]
    slower = speeds[layer - 1] if faster_is_below else speeds[layer]
    sign = 1.0 if faster_is_below else -1.0
    rest = 1.0 - (faster * cosine / c) ** 2
    if sign * sine > 0.0 and rest >= 0.0:
        down, edge, edge_sine = faster_is_below, faster, sign * math.sqrt(rest)
    else:
        down, edge = not faster_is_below, slower
        edge_sine = -sign * math.sqrt(max(1.0 - (slower * cosine / c) ** 2, 0.0))
    # atanh S = ln((1 + S) / cos) = -ln((1 - S) / cos); the one without cancellation, and with the
    # cosines left out where they would be 0 / 0.
    ratio = edge / c
    if sine >= 0.0 and edge_sine >= 0.0:
        turned = math.log((1.0 + sine) / (1.0 + edge_sine) * ratio)
    elif sine <= 0.0 and edge_sine <= 0.0:
        turned = math.log((1.0 - edge_sine) / ((1.0 - sine) * ratio))
    elif sine > 0.0:
        turned = math.log((1.0 + sine) * (1.0 - edge_sine) / (cosine * cosine * ratio))
    else:
        turned = -math.log((1.0 - sine) * (1.0 + edge_sine) / (cosine * cosine * ratio))
    return down, turned / g, edge_sine, ratio * cosine


@kernel
def _depths_reached(
    depths: FloatArray,
    speeds: FloatArray,
    start: float,
    elevation: FloatArray,
    time_step: float,
    reached: FloatArray,
) -> None:
    """How far below `start` each ray (E,) is after 0, 1, ... time steps, into reached (R, E)."""
    for e in range(elevation.shape[0]):
        z, x, sine, cosine = start, 0.0, math.sin(elevation[e]), math.cos(elevation[e])
        if e == 0 or e == elevation.shape[0] - 1:
            cosine = 0.0
        reached[0, e] = 0.0
        for k in range(1, reached.shape[0]):
            z, x, sine, cosine = advance(depths, speeds, z, x, sine, cosine, time_step)
            reached[k, e] = z - start


@kernel
def _invert(
    sines: FloatArray,
    reached: FloatArray,
    range_step: float,
    first_depth: float,
    depth_step: float,
    value: FloatArray,
) -> None:
    """``r sin(phi)`` by depth (R, D) from depths by elevation (R, E).

    Beyond the deepest and the highest point the table goes on with slope one, so that the cells
    at straight down and straight up can be interpolated too: there ``r sin(phi) > r`` says that
    nothing is reached.
    """
    last = sines.shape[0] - 1
    for k in range(reached.shape[0]):
        r, e = k * range_step, last
        for i in range(value.shape[1] - 1, -1, -1):
            depth = first_depth + i * depth_step
            if k == 0 or depth >= reached[k, last]:
                value[k, i] = r + depth - reached[k, last]
                continue
            while e > 0 and reached[k, e - 1] > depth and reached[k, e - 1] < reached[k, e]:
                e -= 1
            if e == 0:
                value[k, i] = -r + depth - reached[k, 0]
            elif reached[k, e - 1] < reached[k, e]:
                share = (depth - reached[k, e - 1]) / (reached[k, e] - reached[k, e - 1])
                value[k, i] = r * (sines[e - 1] + share * (sines[e] - sines[e - 1]))
            else:  # the rays fold back: whatever lies above is in the shade
                value[k, i] = math.nan


@kernel
def look_up(
    value: FloatArray, row: float, first_depth: float, depth_step: float, depth: FloatArray
) -> None:
    """Replace depths (n,) by ``r sin(phi)`` from a launch table (R, D), bilinearly; row: the range
    over its range step. NaN outside the table."""
    k = min(max(int(row), 0), value.shape[0] - 2)
    f = row - k
    near, far, last = value[k], value[k + 1], value.shape[1] - 2
    for s in range(depth.shape[0]):
        place = (depth[s] - first_depth) / depth_step
        if not 0.0 <= place <= last + 1.0:
            depth[s] = math.nan
            continue
        i = min(int(place), last)
        g = place - i
        low = near[i] + g * (near[i + 1] - near[i])
        high = far[i] + g * (far[i + 1] - far[i])
        depth[s] = low + f * (high - low)


@kernel
def look_up_each(
    value: FloatArray, row: FloatArray, first_depth: float, depth_step: float, depth: FloatArray
) -> FloatArray:
    """`look_up` of one depth per range: row (T,), depth (T,); gives (T,)."""
    out = depth.copy()
    for t in range(depth.shape[0]):
        look_up(value, row[t], first_depth, depth_step, out[t : t + 1])
    return out
