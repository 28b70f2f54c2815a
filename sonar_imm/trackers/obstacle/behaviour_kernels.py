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
from ...estimation.small_matrices import (
    add_jitter,
    lanes_for,
    not_psd,
    semidefinite_roots,
    turn_of,
)
from .kernels import KAPPA
from .sigma_kernels import beside, echoes, fan, PLACES, places, product, turned, weighted

STATES = 6
COMMON = 4
"""The states d, delta, z, s that all behaviours have."""


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
    transition: FloatArray,
    floor: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The components before a step in which an obstacle may change what it does.

    prior (C,): see `Motion`. The M components of a slice interact by transition (M, M), ``[i, j]``
    the probability of j after i. States that all have are mixed. A displacement is no velocity: to
    e, a behaviour brings its own, any other its prior, uncorrelated. Slices and components below
    the weight `floor` are dropped.
    """
    T, C, n = x.shape
    M = len(transition)
    x1, P1, mu1 = x.copy(), P.copy(), mu.copy()
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
                    share[i] = mu[t, first + i] * transition[i, a]
                    total += share[i]
                if total < floor:
                    mu1[t, j] = 0.0
                    continue
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


def advance(
    x: FloatArray, P: FloatArray, mu: FloatArray, motion: Motion, step: Step
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Predict what the sonar will see, by the unscented transform.

    x (T, C, 4) of obstacles that are all fixed, or (T, C, 6). Gives x, P and where P (T, C) was
    repaired (`estimation.covariance`). Dropped components are given the numbers of the most
    probable one, so that all stay finite.
    """
    x1, P1, repaired = _advance(x, P, mu, motion, step)
    if np.count_nonzero(repaired):
        _repair(x1, P1, mu, motion.prior, repaired)
    return x1, P1, repaired


@kernel
def _advance(
    x: FloatArray, P: FloatArray, mu: FloatArray, motion: Motion, step: Step
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """`advance` without the repairs: where (T, C) they are needed.

    Components are predicted together, see `sigma_kernels`: weight (size, lanes) is that of a sigma
    point on each column, 0 on those of states that a component has not, apart (lanes,) on those
    that it has. A kernel contains all that it calls, so this is no chain of smaller ones; and the
    length of a short loop is a variable, or the compiler would write out every round of it.
    """
    p0, R0, p1, R1, noise, cone = step
    T, C, size = x.shape
    x1, P1 = np.zeros((T, C, size)), np.zeros((T, C, size, size))
    repaired = np.zeros((T, C), dtype=np.bool_)
    live, which = 0, np.empty((T * C, 2), dtype=np.int64)
    for t in range(T):
        for j in range(C):
            if not mu[t, j] <= 0.0:
                which[live, 0], which[live, 1] = t, j
                live += 1
    if live == 0:
        return x1, P1, repaired
    lanes, numbers = lanes_for(live), 2 * size + 1
    y, weight, rest = np.empty((size, lanes)), np.empty((size, lanes)), np.empty((6, lanes))
    S, F = np.zeros((size, size, lanes)), np.zeros((size, size, lanes))
    centre, apart, keep, go, push, extra = rest[0], rest[1], rest[2], rest[3], rest[4], rest[5]
    seen, places_scratch = np.empty((3, PLACES, lanes)), np.empty((9, PLACES, lanes))
    m, scratch = np.empty((3, numbers, lanes)), np.empty((3, numbers, lanes))
    images, J = np.empty((2, numbers, lanes)), np.empty((2, 2, lanes))
    bad, points, moves = np.empty(lanes, dtype=np.int64), m.reshape(3, -1), scratch.reshape(3, -1)
    scale, north, east = moves[0], moves[1], moves[2]
    turn_M, across, down = np.zeros((3, 3)), np.empty(3), np.empty(3)
    axes, level = len(down), len(J)
    for i in range(axes):
        down[i] = R1[2, i] * (p0[2] - p1[2])
        across[i] = R1[0, i] * (p0[0] - p1[0]) + R1[1, i] * (p0[1] - p1[1])
        for j in range(axes):
            for k in range(axes):
                turn_M[i, j] += R1[k, i] * R0[k, j]
    for turn in range(0, live, lanes):
        first = turn_of(turn, live, lanes)
        for k in range(lanes):
            t, j = which[first + k, 0], which[first + k, 1]
            n = size if motion.prior[j] > 0.0 else COMMON
            centre[k], apart[k] = KAPPA / (n + KAPPA), 0.5 / (n + KAPPA)
            keep[k], go[k] = motion.keep[j], motion.step[j]
            push[k], extra[k] = motion.push[j], motion.noise[j]
            for a in range(size):
                y[a, k] = x[t, j, a]
                weight[a, k] = apart[k] if a < n else 0.0
                for b in range(a + 1):
                    S[a, b, k] = P[t, j, a, b]
        semidefinite_roots(S, F, scale)
        for k in range(lanes):
            scale[k] = math.sqrt(0.5 / apart[k])
        for a in range(size):
            for b in range(a + 1):
                for k in range(lanes):
                    F[a, b, k] *= scale[k]
        # Range and azimuth after the step of all sigma points.
        places(y, F, p0[2], R0, cone, places_scratch, seen)
        turned(turn_M, seen, m)
        for i in range(axes):
            for number in range(PLACES, numbers):
                for k in range(lanes):
                    m[i, number, k] = m[i, 0, k]
        for a in range(COMMON - 1, size):
            to = scratch[a - COMMON + 1]
            fan(y[a], F[a, : a + 1], to)
            if a >= COMMON:
                for number in range(numbers):
                    for k in range(lanes):
                        to[number, k] *= go[k]
        for i in range(axes):
            for k in range(numbers * lanes):
                points[i, k] += across[i] * (1.0 + scale[k]) + down[i]
            if size > COMMON:
                for k in range(numbers * lanes):
                    points[i, k] += R1[0, i] * north[k] + R1[1, i] * east[k]
        echoes(y[1], m, cone, scratch, images[0], images[1])
        # How they change, at the centre, with the obstacle's north and east.
        for i in range(level if size > COMMON else 0):
            for k in range(lanes):
                X, Y, Z = points[0, k], points[1, k], points[2, k]
                d = math.sqrt(X * X + Y * Y + Z * Z)
                J[0, i, k] = (R1[i, 0] * X + R1[i, 1] * Y + R1[i, 2] * Z) / d
            for k in range(lanes):
                X, Y, Z = points[0, k], points[1, k], points[2, k]
                if cone:
                    square = X * X + Y * Y + Z * Z
                    off = R1[i, 1] - Y / math.sqrt(square) * J[0, i, k]
                    J[1, i, k] = off / math.sqrt(square - Y * Y)
                else:
                    J[1, i, k] = (R1[i, 1] * X - R1[i, 0] * Y) / (X * X + Y * Y)
        # Mean and covariance of the components after the step.
        for i in range(level):
            weighted(images[i], centre, weight, y[i])
        for i in range(level):
            for b in range(i + 1):
                product(images[i], images[b], centre, weight, S[i, b])
            for a in range(2, size):
                beside(images[i], F[a, : a + 1], apart, S[a, i])
        for k in range(lanes):
            S[0, 0, k] += noise[0]
            S[1, 1, k] += noise[0] / (y[0, k] * y[0, k]) + noise[1]
            S[2, 2, k] += noise[2]
        for a in range(COMMON, size):
            for k in range(lanes):
                y[a, k] *= keep[k]
            for b in range(a + 1):
                for k in range(lanes):
                    S[a, b, k] *= keep[k] * keep[k] if b >= COMMON else keep[k]
        # What w brings: to range and azimuth, to e, and to both together.
        for a in range(level if size > COMMON else 0):
            for b in range(a + 1):
                for k in range(lanes):
                    both = J[a, 0, k] * J[b, 0, k] + J[a, 1, k] * J[b, 1, k]
                    S[a, b, k] += push[k] * push[k] * extra[k] * both
            for b in range(level):
                for k in range(lanes):
                    S[COMMON + b, a, k] += push[k] * extra[k] * J[a, b, k]
            for k in range(lanes):
                S[COMMON + a, COMMON + a, k] += extra[k]
        not_psd(S, F, scale, bad)
        for k in range(lanes):
            t, j = which[first + k, 0], which[first + k, 1]
            n = size if motion.prior[j] > 0.0 else COMMON
            for a in range(n):
                x1[t, j, a] = y[a, k]
                for b in range(a + 1):
                    P1[t, j, a, b] = P1[t, j, b, a] = S[a, b, k]
            repaired[t, j] = bad[k] > 0
    for t in range(T):
        _fill(x1, P1, mu, t)
    return x1, P1, repaired


@kernel
def _fill(x: FloatArray, P: FloatArray, mu: FloatArray, t: int) -> None:
    """Give the dropped components of a target the numbers of its most probable one."""
    best = 0
    for j in range(mu.shape[1]):
        # As argmax: NaN counts as the greatest.
        if not mu[t, j] <= mu[t, best] and mu[t, best] == mu[t, best]:
            best = j
    for j in range(mu.shape[1]):
        if mu[t, j] <= 0.0:
            for a in range(x.shape[2]):
                x[t, j, a] = x[t, best, a]
                for b in range(x.shape[2]):
                    P[t, j, a, b] = P[t, best, a, b]


@kernel
def _repair(
    x: FloatArray, P: FloatArray, mu: FloatArray, prior: FloatArray, repaired: BoolArray
) -> None:
    """`add_jitter` the covariances that are to be `repaired` (T, C), of as many states as the
    component has, in place; False afterwards where there was nothing to do."""
    T, C, size = x.shape
    for t in range(T):
        some = False
        for j in range(C):
            if repaired[t, j]:
                n = size if prior[j] > 0.0 else COMMON
                own = P[t, j, :n, :n].copy()
                repaired[t, j] = add_jitter(own, np.empty((n, n)))
                for a in range(n):
                    for b in range(n):
                        P[t, j, a, b] = own[a, b]
                some = True
        if some:
            _fill(x, P, mu, t)
