# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What one arrival measures of a diver in three dimensions, and how it depends on all that may be
wrong with the instruments.

The path of a pair is ``h = (|p - t| + |p - r - o|) (1 - v) + k``: p the diver, t the transmitter,
r the receiver where it is said to be, o its horizontal offset, ``v = dc/c`` the relative error of
the sound speed, k the error of the receiver's clock times the sound speed. A tag that emits by
itself has the one leg, and its time of emission times the sound speed is added. z points up.

`arrival_paths` and `arrival_angles` are for one diver and many receivers. `observe` is the same
for many states of a filter at once; its gradient stands in the columns where the filter keeps its
state.

Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
Navigation*, 2001, ch. 10 (range and angle models).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..estimation.arrays import FloatArray, IndexArray, IntArray

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


def observe(
    x: FloatArray,
    height: float,
    kind: IntArray,
    columns: IntArray,
    tx: FloatArray,
    rx: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the C numbers expected at L states, (C, L), and their gradients, (C, n, L).

    :param x: (n, L) states.
    :param height: z of the diver where z is no state.
    :param kind: (C,) kinds.
    :param columns: (C, 7) where the states hold x, y, z, the receiver's offset, its clock, dc/c
        and the emission (m), -1 for what is not a state. Numbers differ in offset and clock only.
    :param tx: (C, 3) transmitters.
    :param rx: (C, 3) receivers.
    """
    value = np.empty((len(kind), x.shape[1]))
    gradient = np.zeros((len(kind), *x.shape))
    ix, iy, iz = columns[0, :3].tolist() if len(kind) else (0, 0, 0)
    place = x[ix], x[iy], x[iz] if iz >= 0 else np.array([height])
    for each in set(kind.tolist()):
        rows = np.flatnonzero(kind == each)
        if each == HEIGHT:
            value[rows] = place[2]
            if iz >= 0:
                gradient[rows, iz] = 1.0
            continue
        dx, dy, dz = _apart(place, rx[rows])
        if each <= ONE_WAY:
            leaving = _apart(place, tx[rows]) if each == PATH else None
            value[rows] = _paths(x, columns[rows], (dx, dy, dz), leaving, gradient, rows)
            continue
        level2 = dx * dx + dy * dy
        if each == BEARING:
            slope = 1.0 / np.where(level2 > NEAREST**2, level2, np.inf)
            gradient[rows, ix], gradient[rows, iy] = -dy * slope, dx * slope
            value[rows] = np.arctan2(dy, dx) + _clocks(x, columns[rows], gradient, rows)
        else:
            level = np.sqrt(level2)
            slope = 1.0 / np.where(level > NEAREST, level2 + dz * dz, np.inf)
            sine = dz / np.maximum(level, NEAREST) * slope
            gradient[rows, ix], gradient[rows, iy] = -dx * sine, -dy * sine
            if iz >= 0:
                gradient[rows, iz] = level * slope
            value[rows] = np.arctan2(dz, level)
    return value, gradient


Vectors = tuple[FloatArray, FloatArray, FloatArray]
"""x, y and z of (R, L) vectors; those of one z have (R, 1) of it."""


def _apart(place: Vectors, points: FloatArray) -> Vectors:
    """Return the vectors from points (R, 3) to places, (L,) each."""
    x, y, z = place
    return x - points[:, :1], y - points[:, 1:2], z - points[:, 2:]


def _paths(
    x: FloatArray,
    columns: IntArray,
    apart: Vectors,
    leaving: Vectors | None,
    gradient: FloatArray,
    rows: IndexArray,
) -> FloatArray:
    """Return path lengths (R, L) of `rows` (R,); write their gradients.

    :param apart: from the receivers to the diver, changed by their offsets.
    :param leaving: from the transmitters to the diver, None for a tag.
    """
    ix, iy, iz, _, _, iv, ie = columns[0].tolist()
    moved = np.flatnonzero(columns[:, OFFSET] >= 0)
    at = columns[moved, OFFSET]
    if len(moved):
        apart[0][moved] -= x[at]
        apart[1][moved] -= x[at + 1]
    length, nearness = _lengths(apart)
    scale = 1.0 - x[iv] if iv >= 0 else 1.0
    slopes = [each * nearness for each in (apart if iz >= 0 else apart[:2])]
    if len(moved):
        gradient[rows[moved], at] = -scale * slopes[0][moved]
        gradient[rows[moved], at + 1] = -scale * slopes[1][moved]
    if leaving is not None:
        first, nearness = _lengths(leaving)
        length += first
        for slope, each in zip(slopes, leaving):
            slope += each * nearness
    for slope, column in zip(slopes, (ix, iy, iz)):
        gradient[rows, column] = slope if iv < 0 else slope * scale
    if iv >= 0:
        gradient[rows, iv] = -length
        length *= scale
    if ie >= 0 and leaving is None:
        gradient[rows, ie] = 1.0
        length += x[ie]
    return length + _clocks(x, columns, gradient, rows)


def _lengths(apart: Vectors) -> tuple[FloatArray, FloatArray]:
    """Return the lengths (R, L) of vectors, and one over them."""
    dx, dy, dz = apart
    length = np.sqrt(dx * dx + dy * dy + dz * dz)
    return length, 1.0 / np.where(length > NEAREST, length, np.inf)


def _clocks(
    x: FloatArray, columns: IntArray, gradient: FloatArray, rows: IndexArray
) -> FloatArray | float:
    """Return the errors (R, L) of the clocks, 0.0 where none is a state; write their gradients."""
    at = columns[:, CLOCK]
    known = np.flatnonzero(at >= 0)
    if not len(known):
        return 0.0
    gradient[rows[known], at[known]] = 1.0
    late = np.zeros((len(rows), x.shape[1]))
    late[known] = x[at[known]]
    return late
