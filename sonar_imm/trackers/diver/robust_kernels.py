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

"""The update of one diver by many arrivals at once, with heavy tails, compiled.

The mathematics is that of `estimation.student_t`, for the numbers of a ping (`ping_kernels`).
Every model starts from its own prediction and from the positions that the ping suggests by
itself, so that many good arrivals outvote any prior and no prior gates a ping away.
"""

from __future__ import annotations

import math

import numpy as np

from ...acoustics.arrivals_3d import BEARING, EMISSION, observe, ONE_WAY, X, Y
from ...estimation.arrays import BoolArray, FloatArray
from ...estimation.consider import consider_scalar
from ...estimation.jit import kernel
from ...estimation.small_matrices import cholesky, cholesky_with_jitter, whitened_square
from .ping_kernels import Numbers

DEGREES = 4.0
"""Degrees of freedom of the Student-t density of a residual."""

MOST_ITERATIONS = 60

SMALLEST_GAIN = 1e-7
"""Gain in log-density that ends a search: far below what a model probability could show."""


@kernel
def _residual(x: FloatArray, numbers: Numbers, c: int, height: float, g: FloatArray) -> float:
    residual = numbers.value[c] - observe(
        numbers.kind[c], x, numbers.columns[c], height, numbers.tx[c], numbers.rx[c], g
    )
    if numbers.kind[c] == BEARING:
        residual -= 2.0 * math.pi * math.floor(residual / (2.0 * math.pi) + 0.5)
    return residual


@kernel
def _log_density(
    x: FloatArray,
    mean: FloatArray,
    L: FloatArray,
    numbers: Numbers,
    height: float,
    degrees: float,
    g: FloatArray,
    w: FloatArray,
) -> float:
    """Up to a constant that no state and no model changes."""
    total = -0.5 * whitened_square(L, x - mean, w)
    for c in range(len(numbers.value)):
        r = _residual(x, numbers, c, height, g)
        total -= 0.5 * (degrees + 1.0) * math.log1p(r * r / numbers.variance[c] / degrees)
    return total


@kernel
def _weighted(
    at: FloatArray,
    mean: FloatArray,
    P: FloatArray,
    estimated: BoolArray,
    numbers: Numbers,
    height: float,
    degrees: float,
    widen: float,
    x: FloatArray,
    Px: FloatArray,
    weights: FloatArray,
) -> None:
    """The weighted Kalman update of the prior, linearised `at` a state, into x, Px and weights."""
    g, w = np.empty(len(x)), np.empty(len(x))
    x[:] = mean
    Px[:, :] = P
    for c in range(len(numbers.value)):
        r = _residual(at, numbers, c, height, g)
        weights[c] = (degrees + 1.0) / (degrees + r * r / numbers.variance[c])
        innovation = r
        for a in range(len(x)):
            innovation -= g[a] * (x[a] - at[a])
        R = widen * numbers.variance[c] / weights[c]
        consider_scalar(x, Px, g, R, innovation, estimated, w)


@kernel
def climb(
    start: FloatArray,
    mean: FloatArray,
    P: FloatArray,
    L: FloatArray,
    numbers: Numbers,
    height: float,
    degrees: float,
) -> tuple[FloatArray, float]:
    """The maximum uphill of `start` (n,), and its log-density; L the Cholesky factor of P."""
    n, C = len(mean), len(numbers.value)
    g, w, weights = np.empty(n), np.empty(n), np.empty(C)
    Px, every = np.empty((n, n)), np.ones(n, np.bool_)
    x, trial, target = start.copy(), np.empty(n), np.empty(n)
    value = _log_density(x, mean, L, numbers, height, degrees, g, w)
    for _ in range(MOST_ITERATIONS):
        _weighted(x, mean, P, every, numbers, height, degrees, 1.0, target, Px, weights)
        length, gain = 1.0, -1.0
        while length > 1e-3:
            trial[:] = x + length * (target - x)
            new = _log_density(trial, mean, L, numbers, height, degrees, g, w)
            gain = new - value
            if gain >= 0.0:
                break
            length *= 0.5
        if gain > 0.0:
            x[:] = trial
            value += gain
        if not gain > SMALLEST_GAIN:
            break
    return x, value


@kernel
def _moved(mean: FloatArray, position: FloatArray, numbers: Numbers, height: float) -> FloatArray:
    """A state like `mean` at another position (2,), the emission, if any, at its median."""
    x = mean.copy()
    columns = numbers.columns[0]
    x[columns[X]], x[columns[Y]] = position[0], position[1]
    if columns[EMISSION] >= 0:
        late, g = np.empty(len(numbers.value)), np.empty(len(mean))
        x[columns[EMISSION]] = 0.0
        count = 0
        for c in range(len(numbers.value)):
            if numbers.kind[c] == ONE_WAY:
                late[count] = _residual(x, numbers, c, height, g)
                count += 1
        if count:
            x[columns[EMISSION]] = np.median(late[:count])
    return x


@kernel
def student_t_maxima(
    mean: FloatArray,
    P: FloatArray,
    positions: FloatArray,
    numbers: Numbers,
    height: float,
    degrees: float,
) -> tuple[FloatArray, FloatArray]:
    """Where the search ends that starts at each of `positions` (S, 2): states (S, n), and their
    log-densities (S,), for one prior `mean` (n,), P (n, n)."""
    S, n = len(positions), len(mean)
    found, value, L = np.empty((S, n)), np.full(S, -np.inf), np.zeros((n, n))
    if cholesky(P, L):
        for s in range(S):
            start = _moved(mean, positions[s], numbers, height)
            found[s], value[s] = climb(start, mean, P, L, numbers, height, degrees)
    return found, value


@kernel
def student_t_ping(
    x: FloatArray,
    P: FloatArray,
    estimated: BoolArray,
    height: float,
    numbers: Numbers,
    positions: FloatArray,
    degrees: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Update the M models of a diver, x (M, n), P (M, n, n), by all `numbers` of a ping at once.

    positions (S, 2): where to start besides the prediction; estimated (n,): False for what is only
    considered; height: z of the diver where z is no state. Gives x, P, the log-evidence (M,) up to
    a constant common to the models, and the weights (M, C).
    """
    M, n = x.shape
    C = len(numbers.value)
    x1, P1, evidence = x.copy(), P.copy(), np.full(M, -np.inf)
    weights = np.zeros((M, C))
    L, Lc = np.zeros((n, n)), np.zeros((n, n))
    state = np.empty(n)
    every = np.ones(n, np.bool_)
    widen = (degrees + 3.0) / (degrees + 1.0)
    for j in range(M):
        if not cholesky(P[j], L):
            continue
        at, best = climb(
            _moved(x[j], x[j][numbers.columns[0][X : Y + 1]], numbers, height),
            x[j],
            P[j],
            L,
            numbers,
            height,
            degrees,
        )
        for s in range(len(positions)):
            start = _moved(x[j], positions[s], numbers, height)
            other, value = climb(start, x[j], P[j], L, numbers, height, degrees)
            if value > best + SMALLEST_GAIN:
                at, best = other, value
        _weighted(at, x[j], P[j], every, numbers, height, degrees, 1.0, state, P1[j], weights[j])
        if not cholesky_with_jitter(P1[j], Lc):
            P1[j, :, :] = P[j]
            continue
        evidence[j] = best
        for a in range(n):
            evidence[j] += math.log(Lc[a, a] / L[a, a])
        # The mean is that of the plain weights, the covariance that of the wider ones.
        _weighted(
            at,
            x[j],
            P[j],
            estimated,
            numbers,
            height,
            degrees,
            1.0,
            x1[j],
            P1[j],
            weights[j],
        )
        _weighted(
            at,
            x[j],
            P[j],
            estimated,
            numbers,
            height,
            degrees,
            widen,
            state,
            P1[j],
            weights[j],
        )
    return x1, P1, evidence, weights
