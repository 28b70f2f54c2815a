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

"""What is done once in every ping, beside the filter, compiled: rows of detections in, rows of
estimates out. Done with one array operation after another, it would take as long as the filter.

`0.0 +` makes a plain zero of a minus zero, as the products with matrices in `geometry` do.
"""

from __future__ import annotations

import math

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray
from ...estimation.jit import kernel

SMALLEST, WIDEST = 1e-12, 0.25
"""Variances m^2 and rad^2: below the one a sender means none; bearings above the other say
nothing."""


@kernel
def mounted(
    position: FloatArray, R: FloatArray, lever: FloatArray, turned: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Position (3,) and rotation (3, 3), NED and FRD, of a sensor at `lever` (3,) of a vehicle at
    `position`, turned by R, itself turned by `turned` (3, 3), all of these ENU and FLU
    (`geometry.mounted`, `geometry.flip_rotation`)."""
    there, look = np.empty(3), np.empty((3, 3))
    for a in range(len(there)):
        i, sign = (1 - a, 1.0) if a < 2 else (2, -1.0)
        outward = R[i, 0] * lever[0] + R[i, 1] * lever[1] + R[i, 2] * lever[2]
        there[a] = 0.0 + sign * (position[i] + outward)
        for b in range(len(there)):
            look[a, b] = 0.0 + sign * turned[i, b]
            if b > 0:
                look[a, b] = -look[a, b]
    return there, look


@kernel
def slope(t: FloatArray, positions: FloatArray) -> FloatArray:
    """Slope (3,) of the straight line through positions (N, 3) at times t (N,), N > 1."""
    N, middle, square, v = len(t), 0.0, 0.0, np.zeros(3)
    for k in range(N):
        middle += t[k]
    middle /= N
    for k in range(N):
        since = t[k] - middle
        square += since * since
        for a in range(len(v)):
            v[a] += since * (positions[k, a] - positions[0, a])
    for a in range(len(v)):
        v[a] /= square
    return v


@kernel
def echoes(
    distance: FloatArray,
    bearing: FloatArray,
    var_range: FloatArray,
    var_bearing: FloatArray,
    own: FloatArray,
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """z (D, 2), R (D, 2, 2), azimuth positive to starboard, of detections, each (D,), and which of
    them (D,) are echoes: a row that is as uncertain as it is far says nothing. own (2,): variances
    of a detection that comes without."""
    D = len(distance)
    z, R, real = np.empty((D, 2)), np.zeros((D, 2, 2)), np.empty(D, dtype=np.bool_)
    for k in range(D):
        z[k, 0], z[k, 1] = distance[k], -bearing[k]  # REP-103 counts bearings to port
        R[k, 0, 0], R[k, 1, 1] = var_range[k], var_bearing[k]
        for i in range(z.shape[1]):
            if not (math.isfinite(R[k, i, i]) and R[k, i, i] > SMALLEST):
                R[k, i, i] = own[i]
        real[k] = math.isfinite(z[k, 0]) and abs(z[k, 1]) < 0.5 * math.pi
        real[k] &= z[k, 0] > 2.0 * math.sqrt(R[k, 0, 0]) and R[k, 1, 1] < WIDEST
    return z, R, real


@kernel
def is_finite(x: FloatArray, P: FloatArray) -> BoolArray:
    """Which of the mixtures x (T, K, n), P (T, K, n, n) have finite numbers throughout, (T,)."""
    T, K, n = x.shape
    usable, states, squares = np.empty(T, dtype=np.bool_), x.reshape(-1), P.reshape(-1)
    for t in range(T):
        flaws = 0
        for k in range(t * K * n, (t + 1) * K * n):
            flaws += not math.isfinite(states[k])
        for k in range(t * K * n * n, (t + 1) * K * n * n):
            flaws += not math.isfinite(squares[k])
        usable[t] = flaws == 0
    return usable


@kernel
def widen(
    covariance: FloatArray,
    place_covariance: FloatArray,
    state: FloatArray,
    place: FloatArray,
    position: FloatArray,
    scale: float,
    centre: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Covariances of state and place, (T, 3, 3) each, with errors that are the same in every ping.

    state (T, 3): range, azimuth, vertical offset; place (T, 3) and position (3,) of the sonar;
    scale: variance of the factor that all ranges are wrong by; centre (T, 2): variances m^2 along
    and across the line of sight.
    """
    wide, wide_place = np.empty(covariance.shape), np.empty(covariance.shape)
    away, reach, axis = np.empty(3), np.empty(3), np.empty((2, 2))
    for t in range(len(state)):
        reach[0], reach[1], reach[2] = state[t, 0], 0.0, state[t, 2]
        for a in range(len(away)):
            away[a] = place[t, a] - position[a]
        for a in range(len(away)):
            for b in range(len(away)):
                wide[t, a, b] = covariance[t, a, b] + scale * (reach[a] * reach[b])
                wide_place[t, a, b] = place_covariance[t, a, b] + scale * (away[a] * away[b])
        if not (centre[t, 0] > 0.0 or centre[t, 1] > 0.0):
            continue
        wide[t, 0, 0] += centre[t, 0]
        wide[t, 1, 1] += centre[t, 1] / (state[t, 0] * state[t, 0])
        level = max(math.sqrt(away[0] * away[0] + away[1] * away[1]), 1e-9)
        axis[0, 0], axis[0, 1] = away[0] / level, away[1] / level
        axis[1, 0], axis[1, 1] = -axis[0, 1], axis[0, 0]
        for i in range(len(axis)):
            for a in range(len(axis)):
                for b in range(len(axis)):
                    wide_place[t, a, b] += centre[t, i] * (axis[i, a] * axis[i, b])
    return wide, wide_place


@kernel
def turned_round(points: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """`geometry.flip_world` of points (T, 3) and of both axes of their covariances (T, 3, 3)."""
    T = len(points)
    there, spread = np.empty((T, 3)), np.empty((T, 3, 3))
    for t in range(T):
        for a in range(points.shape[1]):
            i = 1 - a if a < 2 else 2
            there[t, a] = 0.0 + points[t, i] if a < 2 else 0.0 - points[t, i]
            for b in range(points.shape[1]):
                j = 1 - b if b < 2 else 2
                same = (a < 2) == (b < 2)
                spread[t, a, b] = 0.0 + (covariance[t, i, j] if same else -covariance[t, i, j])
    return there, spread
