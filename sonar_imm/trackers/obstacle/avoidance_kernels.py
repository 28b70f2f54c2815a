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

"""The arithmetic of `avoidance`, compiled.

A component is a Gaussian over what decides a collision, g = (r_N, r_E, dz, v_N, v_E): where the
obstacle lies from the sonar, m, depth downwards, and its velocity, m/s.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray
from ...estimation.jit import kernel
from ...estimation.small_matrices import semidefinite_root
from .behaviour_kernels import COMMON, PLACED
from .kernels import along, moments, NEGLIGIBLE, normal, point_towards, to_world

SIZE = 5
SLICES = 16
"""Of the vertical offset, in the closed form, at most."""
FINE = 20.0
"""Slices for each standard deviation of the miss distance, given the offset, by which its mean
differs from one end of the offset to the other. Half as many change a probability by 1e-4."""
FAR = 8.0
"""Standard deviations off which nothing of a Gaussian is left, 1e-15."""
WEIGHT = 1e-6
"""A component that weighs less plays no part."""
LITTLE = 1e-18


class Safety(NamedTuple):
    """velocity: (3,) m/s of the vehicle, NED, the last one 0 unless it climbs or dives; std: m/s
    an axis, of its course; radius, half height m, horizon s; draws (n, 5): standard normal."""

    velocity: FloatArray
    std: float
    radius: float
    height: float
    horizon: float
    draws: FloatArray


@kernel
def relative(
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    moves: BoolArray,
    p: FloatArray,
    R: FloatArray,
    cone: bool,
) -> tuple[FloatArray, FloatArray]:
    """Mean (T, K, 5) and covariance (T, K, 5, 5) of g, by the unscented transform, of components
    whose states are (d, delta, z, s) and, where `moves` (K,), the velocity; zeros where the
    weight mu (T, K) is negligible."""
    T, K, size = x.shape
    mean, covariance = np.zeros((T, K, SIZE)), np.zeros((T, K, SIZE, SIZE))
    L, images = np.zeros((size, size)), np.zeros((SIZE, 2 * COMMON + 1))
    y, m, world = np.empty(3), np.empty(3), np.empty(3)
    for t in range(T):
        for j in range(K):
            if mu[t, j] <= NEGLIGIBLE:
                continue
            n = size if moves[j] else COMMON
            semidefinite_root(P[t, j, :n, :n], L[:n, :n])
            images[3:] = 0.0
            towards = math.cos(x[t, j, 1]), math.sin(x[t, j, 1])
            for number in range(2 * COMMON + 1):
                column, reach = along(number, COMMON)
                for a in range(3):
                    y[a] = x[t, j, a] + reach * L[a, column]
                for a in range(COMMON, n):
                    images[a - 1, number] = x[t, j, a] + reach * L[a, column]
                images[2, number] = y[2] - p[2]
                if column < PLACED:
                    cosine, sine = towards
                    if column < 2 and number > 0:
                        cosine, sine = math.cos(y[1]), math.sin(y[1])
                    point_towards(y[0], cosine, sine, images[2, number], R, cone, m)
                    to_world(R, m, world)
                    images[0, number], images[1, number] = world[0], world[1]
                else:
                    images[0, number], images[1, number] = images[0, 0], images[1, 0]
            moments(images, 2 * COMMON + 1, mean[t, j], covariance[t, j])
            # What of the velocity the place does not tell.
            for a in range(COMMON, n):
                for b in range(COMMON, n):
                    for i in range(COMMON, n):
                        covariance[t, j, a - 1, b - 1] += L[a, i] * L[b, i]
    return mean, covariance


@kernel
def closest(r0: float, r1: float, w0: float, w1: float, horizon: float) -> tuple[float, float]:
    """When (s) and how near (m) a point at r that moves with w comes to the origin."""
    square = w0 * w0 + w1 * w1
    t = -(r0 * w0 + r1 * w1) / square if square > LITTLE else 0.0
    t = min(max(t, 0.0), horizon)
    return t, math.sqrt((r0 + w0 * t) ** 2 + (r1 + w1 * t) ** 2)


@kernel
def collides(
    r0: float,
    r1: float,
    dz: float,
    w0: float,
    w1: float,
    wz: float,
    radius: float,
    height: float,
    horizon: float,
) -> bool:
    """Whether at some time up to the horizon the point is within the radius and the half height
    at once: two intervals of time that overlap."""
    first, last = 0.0, horizon
    square = w0 * w0 + w1 * w1
    outside = r0 * r0 + r1 * r1 - radius * radius
    if square > LITTLE:
        towards = r0 * w0 + r1 * w1
        # b^2 - a c, without the cancellation: the miss distance squared against the radius.
        cross = r0 * w1 - r1 * w0
        root = square * radius * radius - cross * cross
        if root < 0.0:
            return False
        root = math.sqrt(root)
        first = max(first, (-towards - root) / square)
        last = min(last, (-towards + root) / square)
    elif outside > 0.0:
        return False
    if abs(wz) > 1e-12:
        ends = (-height - dz) / wz, (height - dz) / wz
        first, last = max(first, min(ends)), min(last, max(ends))
    elif abs(dz) > height:
        return False
    return first <= last


@kernel
def _between(low: float, high: float, mean: float, std: float) -> float:
    """Probability of a Gaussian in an interval."""
    if std <= 1e-12:
        return 1.0 if low <= mean <= high else 0.0
    return normal((high - mean) / std) - normal((low - mean) / std)


@kernel
def sampled(g: FloatArray, L: FloatArray, safety: Safety) -> float:
    """Share of the draws of a component, g (5,) with the root L of its covariance, that collide;
    the error of the course is in L."""
    hits = 0
    y = np.empty(SIZE)
    V = safety.velocity
    for k in range(len(safety.draws)):
        for a in range(SIZE):
            y[a] = g[a]
            for b in range(a + 1):
                y[a] += L[a, b] * safety.draws[k, b]
        if collides(
            y[0], y[1], y[2], y[3] - V[0], y[4] - V[1], -V[2],
            safety.radius, safety.height, safety.horizon,
        ):  # fmt: skip
            hits += 1
    return hits / len(safety.draws)


@kernel
def closed_form(g: FloatArray, L: FloatArray, safety: Safety) -> float:
    """Probability that a component, g (5,) with the root L of its covariance, collides with a
    vehicle that keeps its depth: miss distance, vertical offset and the time of the closest
    approach as Gaussians by sigma points."""
    V, horizon = safety.velocity, safety.horizon
    images, y = np.empty((3, 2 * SIZE + 1)), np.empty(SIZE)
    mean, spread = np.empty(3), np.empty((3, 3))
    for number in range(2 * SIZE + 1):
        column, reach = along(number, SIZE)
        for a in range(SIZE):
            y[a] = g[a] + reach * L[a, column]
        w0, w1 = y[3] - V[0], y[4] - V[1]
        square = max(w0 * w0 + w1 * w1, LITTLE)
        images[0, number] = (y[0] * w1 - y[1] * w0) / math.sqrt(square)
        images[1, number] = y[2]
        images[2, number] = -(y[0] * w0 + y[1] * w1) / square
    moments(images, 2 * SIZE + 1, mean, spread)
    b, z, t = mean
    var_b, var_z, var_t, both = spread[0, 0], spread[1, 1], spread[2, 2], spread[0, 1]
    std_z, R = math.sqrt(var_z), safety.radius
    low, high = max(-safety.height, z - 6.0 * std_z), min(safety.height, z + 6.0 * std_z)
    # Most obstacles are passed far off: what follows would find the same.
    if not low <= high or abs(b) - R > FAR * math.sqrt(var_b):
        return 0.0
    in_time = _between(0.0, horizon, t, math.sqrt(var_t))
    if in_time < LITTLE:
        return 0.0
    slope = both / var_z if var_z > LITTLE else 0.0
    rest = math.sqrt(max(var_b - slope * both, 0.0))
    if std_z <= 1e-9:
        return _between(-R, R, b, rest) * in_time
    change = abs(slope) * (high - low)
    slices = SLICES if change * FINE >= SLICES * rest else 1 + int(change * FINE / rest)
    total, width, before = 0.0, (high - low) / slices, normal((low - z) / std_z)
    for k in range(slices):
        end = low + (k + 1) * width
        until = normal((end - z) / std_z)
        if until - before > LITTLE:
            given = b + slope * (end - 0.5 * width - z)
            total += (until - before) * _between(-R, R, given, rest)
        before = until
    return total * in_time


@kernel
def probability(g: FloatArray, C: FloatArray, safety: Safety) -> float:
    """Probability that one component, mean g (5,) and covariance C (5, 5), collides."""
    L, total = np.zeros((SIZE, SIZE)), C.copy()
    for i in (3, 4):
        total[i, i] += safety.std * safety.std
    semidefinite_root(total, L)
    w0, w1 = g[3] - safety.velocity[0], g[4] - safety.velocity[1]
    # A course that may be any has no miss distance to be Gaussian in.
    unsure = w0 * w0 + w1 * w1 <= 4.0 * (total[3, 3] + total[4, 4])
    inside = g[0] * g[0] + g[1] * g[1] <= safety.radius * safety.radius
    if safety.velocity[2] != 0.0 or inside or unsure:
        return sampled(g, L, safety)
    return closed_form(g, L, safety)


@kernel
def assess(
    mean: FloatArray, covariance: FloatArray, mu: FloatArray, safety: Safety
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distance (T,) m and time (T,) s of the closest approach, and the probability (T,) of a
    collision, of mixtures (T, K) of g."""
    T, K, _ = mean.shape
    distance, when, risk = np.zeros(T), np.zeros(T), np.zeros(T)
    V = safety.velocity
    for t in range(T):
        known = 0.0
        for j in range(K):
            if mu[t, j] < WEIGHT:
                continue
            g = mean[t, j]
            time, near = closest(g[0], g[1], g[3] - V[0], g[4] - V[1], safety.horizon)
            distance[t] += mu[t, j] * near
            when[t] += mu[t, j] * time
            risk[t] += mu[t, j] * probability(g, covariance[t, j], safety)
            known += mu[t, j]
        distance[t], when[t], risk[t] = distance[t] / known, when[t] / known, risk[t] / known
        risk[t] = min(max(risk[t], 0.0), 1.0)
    return distance, when, risk
