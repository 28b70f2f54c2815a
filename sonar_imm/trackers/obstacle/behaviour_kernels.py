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

"""The arithmetic of `behaviours`, compiled: mixing inside a depth slice, and the prediction.

A target is C components of six states (d, delta, z, s, e_N, e_E): those of `kernels`, and what the
behaviour adds, m or m/s along north and east. Component `k M + a` is behaviour `a` of slice `k`;
components after the last slice are on their own. A behaviour without e has zeros there, and its
sigma points are those of the first four states, so that it costs and says what it does without the
others. A component of weight 0 is dropped: it takes no further part.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray
from ...estimation.jit import kernel
from ...estimation.small_matrices import lift, semidefinite_root
from .kernels import along, echo, echo_beside, moments, point_towards, to_world

STATES = 6
COMMON = 4
"""The states d, delta, z, s that all behaviours have."""
PLACED = 3
"""The first of them say where the obstacle is."""


class Motion(NamedTuple):
    """What the components do in a step, each (C,): ``e' = keep e + w``, ``w ~ N(0, noise I)``, and
    the obstacle goes by ``step e + push w`` along north and east. prior: variance of e before
    anything is known, 0 for a behaviour without e."""

    keep: FloatArray
    step: FloatArray
    push: FloatArray
    noise: FloatArray
    prior: FloatArray

    @classmethod
    def none(cls, C: int) -> Motion:
        """Of C components that all stay where they are."""
        return cls(*np.zeros((5, C)))


class Step(NamedTuple):
    """Sonar poses before and after, position (3,) and rotation (3, 3), NED and FRD; noise (3,):
    variances the time adds to horizontal position, azimuth and depth; cone: which azimuth."""

    p0: FloatArray
    R0: FloatArray
    p1: FloatArray
    R1: FloatArray
    noise: FloatArray
    cone: bool


@kernel
def mix(
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    prior: FloatArray,
    slices: int,
    M: int,
    stay: float,
    floor: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The components before a step in which an obstacle may change what it does.

    prior (C,): see `Motion`. The M components of a slice interact: a behaviour is kept with
    probability `stay`, the others share the rest. States that all have are mixed. A displacement
    is no velocity: to e, a behaviour brings its own, any other its prior, uncorrelated. Slices
    below the weight `floor` are dropped.
    """
    T, C, n = x.shape
    x1, P1, mu1 = x.copy(), P.copy(), mu.copy()
    change = (1.0 - stay) / (M - 1) if M > 1 else 0.0
    share, off = np.empty(M), np.empty((M, n))
    for t in range(T):
        for j in range(slices * M, C):
            if mu[t, j] < floor:
                mu1[t, j] = 0.0
        for k in range(slices):
            first = k * M
            weight = 0.0
            for i in range(M):
                weight += mu[t, first + i]
            if weight < floor:
                for i in range(M):
                    mu1[t, first + i] = 0.0
                continue
            if M == 1:
                continue
            for a in range(M):
                j = first + a
                # A behaviour without e has none after the mixing either.
                size = n if prior[j] > 0.0 else COMMON
                total = 0.0
                for i in range(M):
                    share[i] = mu[t, first + i] * (stay if i == a else change)
                    total += share[i]
                mu1[t, j] = total
                for b in range(size):
                    x1[t, j, b] = 0.0
                for i in range(M):
                    share[i] = share[i] / total if total > 0.0 else (1.0 if i == a else 0.0)
                    for b in range(size):
                        off[i, b] = x[t, first + i, b] if b < COMMON or i == a else 0.0
                        x1[t, j, b] += share[i] * off[i, b]
                for i in range(M):
                    for b in range(size):
                        off[i, b] -= x1[t, j, b]
                for b in range(size):
                    for d in range(b + 1):
                        value = 0.0
                        for i in range(M):
                            own = P[t, first + i, b, d]
                            if i != a and b >= COMMON:
                                own = prior[j] if b == d else 0.0
                            value += share[i] * (own + off[i, b] * off[i, d])
                        P1[t, j, b, d] = value
                        P1[t, j, d, b] = value
        total = 0.0
        for j in range(C):
            total += mu1[t, j]
        for j in range(C):
            mu1[t, j] = mu1[t, j] / total if total > 0.0 else mu[t, j]
    return x1, P1, mu1


@kernel
def slopes(m: FloatArray, R: FloatArray, cone: bool, J: FloatArray) -> None:
    """How range and azimuth of m (3,), seen by a sonar turned by R, change with the obstacle's
    north and east: J (2, 2)."""
    d = math.sqrt(m[0] * m[0] + m[1] * m[1] + m[2] * m[2])
    level = m[0] * m[0] + m[1] * m[1]
    for i in range(2):
        J[0, i] = (R[i, 0] * m[0] + R[i, 1] * m[1] + R[i, 2] * m[2]) / d
        if cone:
            J[1, i] = (R[i, 1] - m[1] / d * J[0, i]) / math.sqrt(d * d - m[1] * m[1])
        else:
            J[1, i] = (R[i, 1] * m[0] - R[i, 0] * m[1]) / level


@kernel
def advance(
    x: FloatArray, P: FloatArray, mu: FloatArray, motion: Motion, step: Step
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Predict what the sonar will see, by the unscented transform.

    x (T, C, 4) of obstacles that are all fixed, or (T, C, 6). Gives x, P and where P (T, C) was
    repaired (`estimation.covariance`). Dropped components are given the numbers of the most
    probable one, so that all stay finite.
    """
    T, C, size = x.shape
    p0, R0, p1, R1, noise, cone = step
    x1, P1 = np.zeros((T, C, size)), np.zeros((T, C, size, size))
    repaired = np.zeros((T, C), dtype=np.bool_)
    L, images = np.zeros((size, size)), np.empty((size, 2 * size + 1))
    y, m, J = np.empty(size), np.empty(3), np.empty((2, 2))
    middle, world, scratch = np.empty(3), np.empty(3), np.empty((size, size))
    for t in range(T):
        best = 0
        for j in range(C):
            if mu[t, j] > mu[t, best]:
                best = j
            if mu[t, j] <= 0.0:
                continue
            n = size if motion.prior[j] > 0.0 else COMMON
            centre, mean, spread, root = x[t, j], x1[t, j, :n], P1[t, j, :n, :n], L[:n, :n]
            semidefinite_root(P[t, j, :n, :n], root)
            towards = math.cos(centre[1]), math.sin(centre[1])
            for number in range(2 * n + 1):
                column, reach = along(number, n)
                for a in range(n):
                    y[a] = centre[a] + reach * root[a, column]
                # The root is triangular: on its later columns a point is where the centre is.
                if column < PLACED:
                    cosine, sine = towards
                    if column < 2 and number > 0:
                        cosine, sine = math.cos(y[1]), math.sin(y[1])
                    point_towards(y[0], cosine, sine, y[2] - p0[2], R0, cone, m)
                    to_world(R0, m, world)
                    if number == 0:
                        middle[:] = world
                else:
                    world[:] = middle
                for i in range(2):
                    world[i] += (p0[i] - p1[i]) * (1.0 + y[3])
                    if n > COMMON:
                        world[i] += motion.step[j] * y[COMMON + i]
                        images[COMMON + i, number] = motion.keep[j] * y[COMMON + i]
                world[2] += p0[2] - p1[2]
                for i in range(3):
                    m[i] = R1[0, i] * world[0] + R1[1, i] * world[1] + R1[2, i] * world[2]
                images[2, number], images[3, number] = y[2], y[3]
                if number == 0:
                    seen = m[0], m[1]
                    images[0, 0], images[1, 0] = echo(m, cone)
                    if n > COMMON:
                        slopes(m, R1, cone, J)
                else:
                    images[0, number], images[1, number] = echo_beside(
                        m, cone, seen[0], seen[1], images[1, 0]
                    )
            moments(images, 2 * n + 1, mean, spread)
            P1[t, j, 0, 0] += noise[0]
            P1[t, j, 1, 1] += noise[0] / (x1[t, j, 0] * x1[t, j, 0]) + noise[1]
            P1[t, j, 2, 2] += noise[2]
            if n > COMMON:
                _add_push(P1[t, j], J, motion.push[j], motion.noise[j])
            repaired[t, j] = lift(P1[t, j, :n, :n], scratch[:n, :n])
        for j in range(C):
            if mu[t, j] <= 0.0:
                x1[t, j], P1[t, j] = x1[t, best], P1[t, best]
    return x1, P1, repaired


@kernel
def _add_push(P: FloatArray, J: FloatArray, push: float, noise: float) -> None:
    """Add what w brings to P (6, 6): to range and azimuth, to e, and to both together."""
    for a in range(2):
        for b in range(2):
            P[a, b] += push * push * noise * (J[a, 0] * J[b, 0] + J[a, 1] * J[b, 1])
            P[a, COMMON + b] += push * noise * J[a, b]
            P[COMMON + b, a] += push * noise * J[a, b]
        P[COMMON + a, COMMON + a] += noise
