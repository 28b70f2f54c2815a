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
from ...estimation.elementary import gaussians
from ...estimation.jit import kernel
from ...estimation.small_matrices import lanes_for, semidefinite_roots, turn_of
from .behaviour_kernels import COMMON
from .kernels import KAPPA, NEGLIGIBLE
from .sigma_kernels import beside, fan, PLACED, PLACES, places, product, turned, weighted

SIZE = 5
SLICES = 16
"""Of the vertical offset, in the closed form, at most."""
EDGES = 3 + 3 * SLICES
"""What a component needs to know of the normal distribution, at most: see `_edges`."""
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
    live, which = 0, np.empty((T * K, 2), dtype=np.int64)
    for t in range(T):
        for j in range(K):
            if mu[t, j] > NEGLIGIBLE:
                which[live, 0], which[live, 1] = t, j
                live += 1
    if live == 0:
        return mean, covariance
    lanes = lanes_for(live)
    y, S, F = np.empty((size, lanes)), np.zeros((size, size, lanes)), np.zeros((size, size, lanes))
    g, C = np.zeros((SIZE, lanes)), np.zeros((SIZE, SIZE, lanes))
    seen, world = np.empty((3, PLACES, lanes)), np.empty((3, PLACES, lanes))
    scratch = np.empty((9, PLACES, lanes))
    # Points on the other columns lie at the centre.
    reach, others = math.sqrt(COMMON + KAPPA), 2.0 * (COMMON - PLACED)
    apart, centre = np.empty((PLACED, lanes)), np.empty(lanes)
    for k in range(lanes):
        centre[k] = (KAPPA + 0.5 * others) / (COMMON + KAPPA)
        for a in range(len(apart)):
            apart[a, k] = 0.5 / (COMMON + KAPPA)
    for turn in range(0, live, lanes):
        first = turn_of(turn, live, lanes)
        for k in range(lanes):
            t, j = which[first + k, 0], which[first + k, 1]
            for a in range(size):
                own = 1.0 if a < COMMON or moves[j] else 0.0
                y[a, k] = own * x[t, j, a]
                for b in range(a + 1):
                    S[a, b, k] = own * P[t, j, a, b]
        semidefinite_roots(S, F, scratch[0, 0])
        for a in range(size):
            for b in range(len(apart)):
                for k in range(lanes):
                    F[a, b, k] *= reach
        places(y, F, p[2], R, cone, scratch, seen)
        turned(R, seen, world)
        for i in range(2):
            weighted(world[i], centre, apart, g[i])
        for i in range(2):
            for b in range(i + 1):
                product(world[i], world[b], centre, apart, C[i, b])
        for a in range(2, len(g)):
            state = a if a == 2 else a + 1
            if state < size:
                for i in range(2):
                    beside(world[i], F[state, :PLACED], apart[0], C[a, i])
                for k in range(lanes):
                    g[a, k] = y[state, k]
                for b in range(2, a + 1):
                    other = b if b == 2 else b + 1
                    for k in range(lanes):
                        C[a, b, k] = S[state, other, k]
        for k in range(lanes):
            t, j = which[first + k, 0], which[first + k, 1]
            g[2, k] -= p[2]
            for a in range(len(g)):
                mean[t, j, a] = g[a, k]
                for b in range(a + 1):
                    covariance[t, j, a, b] = covariance[t, j, b, a] = C[a, b, k]
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
def _off(edge: float, std: float, inside: bool) -> float:
    """How many standard deviations an edge lies above the mean; one that is on it, where there is
    no spread, as if the mean were `inside` below it or not."""
    if std > 1e-12:
        return edge / std
    return math.inf if edge > 0.0 or (edge == 0.0 and inside) else -math.inf


@kernel
def _edges(moments: FloatArray, z: float, var_z: float, safety: Safety, row: FloatArray) -> int:
    """What has to be known of the normal distribution for `_within` of a component with these
    moments (5,), the means of miss distance and of time, their variances, and the covariance of
    the first with the vertical offset; and with a vertical offset of that mean and variance. Into
    row: the edges of the time; those of n slices of the vertical offset; the two of the miss
    distance, given each slice. Gives n, 0 where nothing is near."""
    b, t, var_b, var_t, both = moments
    std_z, R = math.sqrt(var_z), safety.radius
    low, high = max(-safety.height, z - 6.0 * std_z), min(safety.height, z + 6.0 * std_z)
    # Most obstacles are passed far off: what follows would find the same.
    if not low <= high or abs(b) - R > FAR * math.sqrt(var_b):
        return 0
    std_t = math.sqrt(var_t)
    row[0], row[1] = _off(-t, std_t, False), _off(safety.horizon - t, std_t, True)
    slope = both / var_z if var_z > LITTLE else 0.0
    rest = math.sqrt(max(var_b - slope * both, 0.0))
    if std_z <= 1e-9:
        row[2], row[3] = -math.inf, math.inf
        row[4], row[5] = _off(-R - b, rest, False), _off(R - b, rest, True)
        return 1
    change = abs(slope) * (high - low)
    slices = SLICES if change * FINE >= SLICES * rest else 1 + int(change * FINE / rest)
    width = (high - low) / slices
    row[2] = (low - z) / std_z
    for k in range(slices):
        end = low + (k + 1) * width
        row[3 + k] = (end - z) / std_z
        given = b + slope * (end - 0.5 * width - z)
        at = 3 + slices + 2 * k
        row[at] = _off(-R - given, rest, False)
        row[at + 1] = _off(R - given, rest, True)
    return slices


@kernel
def _within(below: FloatArray, slices: int) -> float:
    """Probability that a component passes within the radius and the height, before the horizon,
    from the probabilities below all of its `_edges`."""
    total = 0.0
    for k in range(slices):
        share, at = below[3 + k] - below[2 + k], 3 + slices + 2 * k
        if share > LITTLE:
            total += share * (below[at + 1] - below[at])
    in_time = below[1] - below[0]
    return total * in_time if in_time >= LITTLE else 0.0


@kernel
def assess(
    mean: FloatArray, covariance: FloatArray, mu: FloatArray, safety: Safety
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Distance (T,) m and time (T,) s of the closest approach, and the probability (T,) of a
    collision, of mixtures (T, K) of g.

    Miss distance, vertical offset and the time of the closest approach are Gaussian, by sigma
    points, where a vehicle keeps its depth and a course that is certain; else draws are counted.
    """
    T, K, size = mean.shape
    distance, when, risk = np.zeros(T), np.zeros(T), np.zeros(T)
    live, which = 0, np.empty((T * K, 2), dtype=np.int64)
    for t in range(T):
        for j in range(K):
            if mu[t, j] >= WEIGHT:
                which[live, 0], which[live, 1] = t, j
                live += 1
    V, known, chance = safety.velocity, np.zeros(T), np.zeros(live)
    if live:
        lanes, numbers = lanes_for(live), 2 * size + 1
        g, S = np.empty((size, lanes)), np.empty((size, size, lanes))
        # The root of S, and that times the reach of the sigma points.
        L, F = np.zeros((size, size, lanes)), np.zeros((size, size, lanes))
        weight, moments = np.empty((size, lanes)), np.empty((lanes, 5))
        centre, row = np.empty(lanes), np.empty(lanes)
        points, images = np.empty((4, numbers, lanes)), np.empty((2, numbers, lanes))
        flat, image = points.reshape(4, -1), images.reshape(2, -1)
        own, root = np.empty(size), np.empty((size, size))
        slices, rows = np.empty(lanes, dtype=np.int64), np.empty((4, EDGES * lanes))
        for turn in range(0, live, lanes):
            first = turn_of(turn, live, lanes)
            for k in range(lanes):
                t, j = which[first + k, 0], which[first + k, 1]
                centre[k] = KAPPA / (SIZE + KAPPA)
                for a in range(size):
                    g[a, k], weight[a, k] = mean[t, j, a], 0.5 / (SIZE + KAPPA)
                    for b in range(a + 1):
                        S[a, b, k] = covariance[t, j, a, b]
                for a in range(3, size):
                    S[a, a, k] += safety.std * safety.std
            semidefinite_roots(S, L, row)
            reach = math.sqrt(SIZE + KAPPA)
            for a in range(size):
                for b in range(a + 1):
                    for k in range(lanes):
                        F[a, b, k] = reach * L[a, b, k]
            # Signed miss distance and time of the closest approach of all sigma points.
            for at in range(len(points)):
                state = at if at < 2 else at + 1
                fan(g[state], F[state, : state + 1], points[at])
            for k in range(numbers * lanes):
                v, w = flat[2, k] - V[0], flat[3, k] - V[1]
                square = v * v + w * w
                square = square if square > LITTLE else LITTLE
                image[0, k] = (flat[0, k] * w - flat[1, k] * v) / math.sqrt(square)
                image[1, k] = -(flat[0, k] * v + flat[1, k] * w) / square
            for i in range(len(images)):
                weighted(images[i], centre, weight, row)
                for k in range(lanes):
                    moments[k, i] = row[k]
                product(images[i], images[i], centre, weight, row)
                for k in range(lanes):
                    moments[k, 2 + i] = row[k]
            beside(images[0], F[2, :3], weight[0], row)
            end = 0
            for k in range(lanes):
                slices[k], moments[k, 4] = 0, row[k]
                w0, w1 = g[3, k] - V[0], g[4, k] - V[1]
                # A course that may be any has no miss distance to be Gaussian in.
                unsure = w0 * w0 + w1 * w1 <= 4.0 * (S[3, 3, k] + S[4, 4, k])
                inside = g[0, k] * g[0, k] + g[1, k] * g[1, k] <= safety.radius * safety.radius
                if V[2] != 0.0 or inside or unsure:
                    for a in range(size):
                        own[a] = g[a, k]
                        for b in range(a + 1):
                            root[a, b] = L[a, b, k]
                    chance[first + k] = sampled(own, root, safety)
                else:
                    chance[first + k] = 0.0
                    slices[k] = _edges(moments[k], g[2, k], S[2, 2, k], safety, rows[0, end:])
                    end += 3 + 3 * slices[k] if slices[k] else 0
            gaussians(rows[0, :end], rows[1, :end], rows[2, :end], rows[3, :end])
            end = 0
            for k in range(lanes):
                if slices[k]:
                    chance[first + k] = _within(rows[3, end:], slices[k])
                    end += 3 + 3 * slices[k]
    for k in range(live):
        t, j = which[k, 0], which[k, 1]
        g0, g1, w0, w1 = mean[t, j, 0], mean[t, j, 1], mean[t, j, 3] - V[0], mean[t, j, 4] - V[1]
        time, near = closest(g0, g1, w0, w1, safety.horizon)
        distance[t] += mu[t, j] * near
        when[t] += mu[t, j] * time
        risk[t] += mu[t, j] * chance[k]
        known[t] += mu[t, j]
    for t in range(T):
        distance[t], when[t] = distance[t] / known[t], when[t] / known[t]
        risk[t] = min(max(risk[t] / known[t], 0.0), 1.0)
    return distance, when, risk
