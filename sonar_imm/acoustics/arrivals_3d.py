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

"""What one arrival measures of a diver in three dimensions, and how it depends on all that may be
wrong with the instruments.

The path of a pair is ``h = (|p - t| + |p - r - o|) (1 - v) + k``: p the diver, t the transmitter,
r the receiver where it is said to be, o its horizontal offset, ``v = dc/c`` the relative error of
the sound speed, k the error of the receiver's clock times the sound speed. A tag that emits by
itself has the one leg, and its time of emission times the sound speed is added. z points up.

`arrival_paths` and `arrival_angles` are for whole arrays. `observe` is the same for one number,
compiled: it writes the gradient into the columns where a filter keeps its state.

Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
Navigation*, 2001, ch. 10 (range and angle models).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..estimation.arrays import FloatArray, IntArray
from ..estimation.jit import kernel

PATH, ONE_WAY, BEARING, ELEVATION, HEIGHT = range(5)
"""Kinds of number that `observe` predicts: metres, metres, rad, rad, metres."""

X, Y, Z, OFFSET, CLOCK, SOUND_SPEED_ERROR, EMISSION = range(7)
"""Places in the `columns` of `observe`; OFFSET is the x of two neighbours, CLOCK what is added:
the error of the clock to a path, that of all bearings of a receiver to a bearing."""

NEAREST = 1e-6
"""Distance in metres below which a direction is undefined and its gradient is zero."""


class Paths(NamedTuple):
    """length (n,) m; its derivatives by_position (n, 3), by_offset (n, 2) of the receiver,
    by_clock (n,) in metres and by_sound_speed (n,), dc/c."""

    length: FloatArray
    by_position: FloatArray
    by_offset: FloatArray
    by_clock: FloatArray
    by_sound_speed: FloatArray


def arrival_paths(
    position: ArrayLike,
    tx: ArrayLike | None,
    rx: ArrayLike,
    *,
    offset: FloatArray | float = 0.0,
    clock: FloatArray | float = 0.0,
    sound_speed_error: float = 0.0,
) -> Paths:
    """Path lengths for a diver at `position` (3,): tx (3,) or (n, 3), None for a tag; rx (n, 3).

    offset (n, 2) m, clock (n,) m and sound_speed_error = dc/c are the errors of the instruments.
    """
    p, receivers = np.asarray(position, np.float64), np.array(rx, np.float64)
    receivers[:, :2] += offset
    leg, toward = _leg(p, receivers)
    total, slope = leg, toward
    if tx is not None:
        first, onward = _leg(p, np.broadcast_to(np.asarray(tx, np.float64), receivers.shape))
        total, slope = leg + first, toward + onward
    scale = 1.0 - sound_speed_error
    return Paths(
        total * scale + clock,
        slope * scale,
        -toward[:, :2] * scale,
        np.ones(len(total)),
        -total,
    )


def arrival_angles(
    position: ArrayLike, rx: ArrayLike
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Bearing (n,) and its derivative (n, 3), elevation (n,), up positive, and its derivative (n,
    3) of a diver at `position` (3,) seen from rx (n, 3), radians."""
    d = np.asarray(position, np.float64) - np.asarray(rx, np.float64)
    rho2 = np.square(d[:, :2]).sum(axis=1)
    rho, r2 = np.sqrt(rho2), rho2 + d[:, 2] ** 2
    level, slant = np.maximum(rho2, NEAREST**2), np.maximum(r2, NEAREST**2)
    flat = np.maximum(rho, NEAREST)
    by_bearing = np.stack([-d[:, 1] / level, d[:, 0] / level, 0.0 * rho], axis=1)
    by_elevation = np.stack(
        [-d[:, 0] * d[:, 2] / flat / slant, -d[:, 1] * d[:, 2] / flat / slant, rho / slant], axis=1
    )
    return np.arctan2(d[:, 1], d[:, 0]), by_bearing, np.arctan2(d[:, 2], rho), by_elevation


def _leg(position: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    d = position - points
    distance = np.sqrt(np.square(d).sum(axis=1))
    return distance, d / np.where(distance > NEAREST, distance, np.inf)[:, None]


@kernel
def observe(
    kind: int,
    x: FloatArray,
    columns: IntArray,
    height: float,
    tx: FloatArray,
    rx: FloatArray,
    gradient: FloatArray,
) -> float:
    """The number expected at a state x (n,), its gradient (n,) into `gradient`.

    columns (7,): where x holds x, y, z, the receiver's offset, its clock, dc/c and the emission
    (m), -1 for what is not a state; height: z of the diver where z is no state.
    """
    for a in range(len(x)):
        gradient[a] = 0.0
    iz, io = columns[Z], columns[OFFSET]
    z = x[iz] if iz >= 0 else height
    if kind == HEIGHT:
        if iz >= 0:
            gradient[iz] = 1.0
        return z
    ix, iy = columns[X], columns[Y]
    # Angles need no exact place of the receiver: an offset of metres turns them by little.
    ox = x[io] if io >= 0 and kind <= ONE_WAY else 0.0
    oy = x[io + 1] if io >= 0 and kind <= ONE_WAY else 0.0
    dx, dy, dz = x[ix] - rx[0] - ox, x[iy] - rx[1] - oy, z - rx[2]
    rho2 = dx * dx + dy * dy
    ic = columns[CLOCK]
    if kind == BEARING:
        if rho2 > NEAREST**2:
            gradient[ix], gradient[iy] = -dy / rho2, dx / rho2
        if ic >= 0:
            gradient[ic] = 1.0
        return math.atan2(dy, dx) + (x[ic] if ic >= 0 else 0.0)
    r = math.sqrt(rho2 + dz * dz)
    if kind == ELEVATION:
        rho = math.sqrt(rho2)
        if rho > NEAREST:
            gradient[ix], gradient[iy] = -dx * dz / rho / (r * r), -dy * dz / rho / (r * r)
            if iz >= 0:
                gradient[iz] = rho / (r * r)
        return math.atan2(dz, rho)
    iv = columns[SOUND_SPEED_ERROR]
    scale = 1.0 - (x[iv] if iv >= 0 else 0.0)
    total = r
    if r > NEAREST:
        gradient[ix], gradient[iy] = scale * dx / r, scale * dy / r
        if iz >= 0:
            gradient[iz] = scale * dz / r
        if io >= 0:
            gradient[io], gradient[io + 1] = -scale * dx / r, -scale * dy / r
    if kind == PATH:
        tx_, ty_, tz_ = x[ix] - tx[0], x[iy] - tx[1], z - tx[2]
        first = math.sqrt(tx_ * tx_ + ty_ * ty_ + tz_ * tz_)
        total += first
        if first > NEAREST:
            gradient[ix] += scale * tx_ / first
            gradient[iy] += scale * ty_ / first
            if iz >= 0:
                gradient[iz] += scale * tz_ / first
    if iv >= 0:
        gradient[iv] = -total
    value = scale * total
    if ic >= 0:
        gradient[ic] = 1.0
        value += x[ic]
    if kind == ONE_WAY and columns[EMISSION] >= 0:
        gradient[columns[EMISSION]] = 1.0
        value += x[columns[EMISSION]]
    return value
