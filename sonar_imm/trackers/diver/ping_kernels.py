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

"""The measurements of one ping and the M models of one diver, compiled.

*What is expected*: likelihood, residuals and their covariance under the mixture of the models.

*All subsets* (`subset_ping`): the mathematics of `oracles.subset_update` of the tests, for
measurements that exclude or follow each other. Measurements of one *node*, the echoes of a
transmitter-receiver pair, exclude each other: an explanation takes one of them as good, or none,
which costs ``eps u`` for each. A measurement with a *parent*, the bearing that came with an echo,
is asked only where the echo is taken.

*Heavy tails* (`student_t_ping`): that of `oracles.student_t`, for many arrivals at once. Every
model starts from its own prediction and from the positions that the ping suggests by itself, so
that many good arrivals outvote any prior and no prior gates a ping away.

In all of them x is (M, n), P (M, n, n), mu (M,); height: z of the diver where z is no state.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...acoustics.arrivals_3d import BEARING, EMISSION, observe, ONE_WAY, X, Y
from ...estimation.arrays import BoolArray, FloatArray, IntArray
from ...estimation.consider import consider_scalar
from ...estimation.jit import kernel
from ...estimation.small_matrices import cholesky, cholesky_with_jitter, whitened_square

PRUNE = 14.0
"""An explanation whose log-probability is this much below the best one's is dropped."""

MOST_EXPLANATIONS = 128
"""Explanations of a model at once; beyond, the worst give way."""

DEGREES = 4.0
"""Degrees of freedom of the Student-t density of a residual."""

MOST_ITERATIONS = 60

SMALLEST_GAIN = 1e-7
"""Gain in log-density that ends a search: far below what a model probability could show."""


class PingMeasurements(NamedTuple):
    """The C measurements of one ping, sorted by node, parents before their children.

    node (C,): measurements of one node exclude each other; parent (C,): index of the measurement
    that this one came with, -1 for none; kind (C,): see `acoustics.arrivals_3d`; value, variance
    (C,); density (C,): of a wild value, per unit; tx, rx (C, 3) m; columns (C, 7): see
    `arrivals_3d.observe`.
    """

    node: IntArray
    parent: IntArray
    kind: IntArray
    value: FloatArray
    variance: FloatArray
    density: FloatArray
    tx: FloatArray
    rx: FloatArray
    columns: IntArray


@kernel
def _residual(
    x: FloatArray, measured: PingMeasurements, c: int, height: float, g: FloatArray
) -> float:
    """Measurement c less what a diver at x (n,) causes, bearings within half a turn; its gradient
    goes into g (n,)."""
    residual = measured.value[c] - observe(
        measured.kind[c], x, measured.columns[c], height, measured.tx[c], measured.rx[c], g
    )
    if measured.kind[c] == BEARING:
        residual -= 2.0 * math.pi * math.floor(residual / (2.0 * math.pi) + 0.5)
    return residual


@kernel
def fit_measurements(
    x: FloatArray, P: FloatArray, mu: FloatArray, height: float, measured: PingMeasurements
) -> tuple[FloatArray, FloatArray]:
    """Log-likelihood (C,) of each measurement under the mixture of the models, and its least NIS
    (C,) of any model."""
    M, n = x.shape
    C = len(measured.value)
    likelihood, least = np.zeros(C), np.full(C, np.inf)
    g = np.empty(n)
    for c in range(C):
        for j in range(M):
            nu = _residual(x[j], measured, c, height, g)
            S = measured.variance[c]
            for a in range(n):
                if g[a] != 0.0:
                    for b in range(n):
                        S += g[a] * P[j, a, b] * g[b]
            nis = nu * nu / S
            least[c] = min(least[c], nis)
            likelihood[c] += mu[j] * math.exp(-0.5 * nis) / math.sqrt(2.0 * math.pi * S)
        likelihood[c] = math.log(max(likelihood[c], 1e-300))
    return likelihood, least


@kernel
def expect_residuals(
    x: FloatArray, mu: FloatArray, height: float, measured: PingMeasurements
) -> tuple[FloatArray, FloatArray]:
    """Residuals (C,), value less the one that the mixture expects, and those of each model
    (M, C)."""
    M, n = x.shape
    C = len(measured.value)
    residual, nu, g = np.zeros(C), np.empty((M, C)), np.empty(n)
    for j in range(M):
        for c in range(C):
            nu[j, c] = _residual(x[j], measured, c, height, g)
            residual[c] += mu[j] * nu[j, c]
    return residual, nu


@kernel
def expect_measurements(
    x: FloatArray, P: FloatArray, mu: FloatArray, height: float, measured: PingMeasurements
) -> tuple[FloatArray, FloatArray]:
    """Residuals (C,), value less the one that the mixture expects, and the covariance (C, C) of
    what is expected, without the variances of the measurements."""
    M, n = x.shape
    C = len(measured.value)
    covariance, G, GP = np.zeros((C, C)), np.empty((C, n)), np.empty(n)
    residual, nu = expect_residuals(x, mu, height, measured)
    for j in range(M):
        if mu[j] == 0.0:
            continue
        for c in range(C):
            _residual(x[j], measured, c, height, G[c])
        for c in range(C):
            for a in range(n):
                GP[a] = 0.0
                for b in range(n):
                    GP[a] += G[c, b] * P[j, b, a]
            for d in range(c + 1):
                value = 0.0
                for a in range(n):
                    value += GP[a] * G[d, a]
                covariance[c, d] += mu[j] * value
    for c in range(C):
        for d in range(c + 1):
            for j in range(M):
                covariance[c, d] += mu[j] * (nu[j, c] - residual[c]) * (nu[j, d] - residual[d])
            covariance[d, c] = covariance[c, d]
    return residual, covariance


@kernel
def _put(x: FloatArray, P: FloatArray, to_x: FloatArray, to_P: FloatArray) -> None:
    """Copy x (n,) and P (n, n)."""
    for a in range(len(x)):
        to_x[a] = x[a]
        for b in range(len(x)):
            to_P[a, b] = P[a, b]


@kernel
def subset_ping(
    x: FloatArray,
    P: FloatArray,
    estimated: BoolArray,
    height: float,
    measured: PingMeasurements,
    outlier_probability: float,
    most: int,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Update the models of a diver by all subsets of what a ping measured.

    estimated (n,): False for what is only considered; most: explanations of a model at once.
    Gives x, P, the log-evidence (M,) of the ping and the probability (M, C) that each measurement
    is good.
    """
    M, n = x.shape
    C = len(measured.value)
    x1, P1 = np.zeros((M, n)), np.zeros((M, n, n))
    evidence, taken = np.empty(M), np.zeros((M, C))
    X, Ps = np.empty((2, most, n)), np.empty((2, most, n, n))
    good, weights = np.empty((2, most, C), np.bool_), np.empty((2, most))
    gradient, scratch, spread = np.empty(n), np.empty(n), np.empty(n)
    x_c, P_c = np.empty(n), np.empty((n, n))
    log_good = math.log1p(-outlier_probability)
    log_wild = math.log(max(outlier_probability, 1e-300))
    for j in range(M):
        now, count, best, first = 0, 1, 0.0, 0
        _put(x[j], P[j], X[0, 0], Ps[0, 0])
        good[0, 0, :] = False
        weights[0, 0] = 0.0
        while first < C:
            last, wild = first, 0.0
            while last < C and measured.node[last] == measured.node[first]:
                wild += measured.density[last]
                last += 1
            then, grown = 1 - now, 0
            parent = measured.parent[first]
            for b in range(count):
                weight = weights[now, b]
                if weight < best - PRUNE:
                    continue
                followed = parent < 0 or good[now, b, parent]
                refused = weight + log_wild if followed else weight
                if parent < 0:
                    refused += math.log(wild)
                # First what takes none of the node, then what takes each of its measurements.
                for c in range(first - 1, last if followed else first):
                    _put(X[now, b], Ps[now, b], x_c, P_c)
                    score = refused
                    if c >= first:
                        innovation = _residual(x_c, measured, c, height, gradient)
                        fit = consider_scalar(
                            x_c,
                            P_c,
                            gradient,
                            measured.variance[c],
                            innovation,
                            estimated,
                            scratch,
                        )
                        if parent >= 0:
                            fit -= math.log(wild)
                        if not math.isfinite(fit):
                            continue
                        score = weight + log_good + fit
                    slot = grown
                    if grown == most:  # over the worst, unless it is the worst itself
                        slot = 0
                        for k in range(1, most):
                            if weights[then, k] < weights[then, slot]:
                                slot = k
                        if weights[then, slot] >= score:
                            continue
                    _put(x_c, P_c, X[then, slot], Ps[then, slot])
                    for k in range(C):
                        good[then, slot, k] = good[now, b, k] or (k == c and c >= first)
                    weights[then, slot] = score
                    grown = max(grown, slot + 1)
            now, count, first, best = then, grown, last, -np.inf
            for b in range(count):
                best = max(best, weights[now, b])
        total = 0.0
        for b in range(count):
            share = math.exp(weights[now, b] - best)
            if weights[now, b] < best - PRUNE:
                share = 0.0
            weights[now, b] = share
            total += share
        for b in range(count):
            share = weights[now, b] / total
            for a in range(n):
                x1[j, a] += share * X[now, b, a]
            for c in range(C):
                if good[now, b, c]:
                    taken[j, c] += share
        for b in range(count):
            share = weights[now, b] / total
            if share > 0.0:
                for a in range(n):
                    spread[a] = X[now, b, a] - x1[j, a]
                for a in range(n):
                    for k in range(a + 1):
                        P1[j, a, k] += share * (Ps[now, b, a, k] + spread[a] * spread[k])
        for a in range(n):
            for k in range(a):
                P1[j, k, a] = P1[j, a, k]
        evidence[j] = best + math.log(total)
    return x1, P1, evidence, taken


@kernel
def _log_density(
    x: FloatArray,
    mean: FloatArray,
    L: FloatArray,
    measured: PingMeasurements,
    height: float,
    degrees: float,
    g: FloatArray,
    w: FloatArray,
) -> float:
    """Up to a constant that no state and no model changes."""
    for a in range(len(x)):
        g[a] = x[a] - mean[a]
    total = -0.5 * whitened_square(L, g, w)
    for c in range(len(measured.value)):
        r = _residual(x, measured, c, height, g)
        total -= 0.5 * (degrees + 1.0) * math.log1p(r * r / measured.variance[c] / degrees)
    return total


@kernel
def _weighted(
    at: FloatArray,
    mean: FloatArray,
    P: FloatArray,
    estimated: BoolArray,
    measured: PingMeasurements,
    height: float,
    degrees: float,
    widen: float,
    x: FloatArray,
    Px: FloatArray,
    weights: FloatArray,
) -> None:
    """The weighted Kalman update of the prior, linearised `at` a state, into x, Px and weights."""
    g, w = np.empty(len(x)), np.empty(len(x))
    _put(mean, P, x, Px)
    for c in range(len(measured.value)):
        r = _residual(at, measured, c, height, g)
        weights[c] = (degrees + 1.0) / (degrees + r * r / measured.variance[c])
        innovation = r
        for a in range(len(x)):
            innovation -= g[a] * (x[a] - at[a])
        R = widen * measured.variance[c] / weights[c]
        consider_scalar(x, Px, g, R, innovation, estimated, w)


@kernel
def climb(
    start: FloatArray,
    mean: FloatArray,
    P: FloatArray,
    L: FloatArray,
    measured: PingMeasurements,
    height: float,
    degrees: float,
) -> tuple[FloatArray, float]:
    """The maximum uphill of `start` (n,), and its log-density; L the Cholesky factor of P."""
    n, C = len(mean), len(measured.value)
    g, w, weights = np.empty(n), np.empty(n), np.empty(C)
    Px, every = np.empty((n, n)), np.ones(n, np.bool_)
    x, trial, target = start.copy(), np.empty(n), np.empty(n)
    value = _log_density(x, mean, L, measured, height, degrees, g, w)
    for _ in range(MOST_ITERATIONS):
        _weighted(x, mean, P, every, measured, height, degrees, 1.0, target, Px, weights)
        length, gain = 1.0, -1.0
        while length > 1e-3:
            for a in range(n):
                trial[a] = x[a] + length * (target[a] - x[a])
            new = _log_density(trial, mean, L, measured, height, degrees, g, w)
            gain = new - value
            if gain >= 0.0:
                break
            length *= 0.5
        if gain > 0.0:
            for a in range(n):
                x[a] = trial[a]
            value += gain
        if not gain > SMALLEST_GAIN:
            break
    return x, value


@kernel
def _moved(
    mean: FloatArray, px: float, py: float, measured: PingMeasurements, height: float
) -> FloatArray:
    """A state like `mean` at another position, the emission, if any, at its median."""
    x = mean.copy()
    columns = measured.columns[0]
    x[columns[X]], x[columns[Y]] = px, py
    if columns[EMISSION] >= 0:
        late, g = np.empty(len(measured.value)), np.empty(len(mean))
        x[columns[EMISSION]] = 0.0
        count = 0
        for c in range(len(measured.value)):
            if measured.kind[c] == ONE_WAY:
                # Sorted as they come.
                value, k = _residual(x, measured, c, height, g), count
                while k > 0 and late[k - 1] > value:
                    late[k] = late[k - 1]
                    k -= 1
                late[k] = value
                count += 1
        if count:
            middle = late[count // 2]
            if count % 2 == 0:
                middle = (late[count // 2 - 1] + middle) / 2.0
            x[columns[EMISSION]] = middle
    return x


@kernel
def student_t_maxima(
    mean: FloatArray,
    P: FloatArray,
    positions: FloatArray,
    measured: PingMeasurements,
    height: float,
    degrees: float,
) -> tuple[FloatArray, FloatArray]:
    """Where the search ends that starts at each of `positions` (S, 2): states (S, n), and their
    log-densities (S,), for one prior `mean` (n,), P (n, n)."""
    S, n = len(positions), len(mean)
    found, value, L = np.empty((S, n)), np.empty(S), np.empty((n, n))
    known = cholesky(P, L)
    for s in range(S):
        value[s] = -np.inf
        if known:
            start = _moved(mean, positions[s, 0], positions[s, 1], measured, height)
            at, value[s] = climb(start, mean, P, L, measured, height, degrees)
            for a in range(n):
                found[s, a] = at[a]
    return found, value


@kernel
def student_t_ping(
    x: FloatArray,
    P: FloatArray,
    estimated: BoolArray,
    height: float,
    measured: PingMeasurements,
    positions: FloatArray,
    degrees: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Update the models of a diver by all that a ping measured at once, with heavy tails.

    positions (S, 2): where to start besides the prediction; estimated (n,): False for what is only
    considered. Gives x, P, the log-evidence (M,) up to a constant common to the models, and the
    weights (M, C).
    """
    M, n = x.shape
    C = len(measured.value)
    x1, P1, evidence = x.copy(), P.copy(), np.empty(M)
    weights = np.zeros((M, C))
    L, Lc = np.empty((n, n)), np.empty((n, n))
    state, at = np.empty(n), np.empty(n)
    every = np.ones(n, np.bool_)
    columns = measured.columns[0]
    for j in range(M):
        evidence[j] = -np.inf
        if not cholesky(P[j], L):
            continue
        best = -np.inf
        for s in range(-1, len(positions)):
            px, py = x[j, columns[X]], x[j, columns[Y]]
            if s >= 0:
                px, py = positions[s, 0], positions[s, 1]
            start = _moved(x[j], px, py, measured, height)
            other, value = climb(start, x[j], P[j], L, measured, height, degrees)
            if s < 0 or value > best + SMALLEST_GAIN:
                at, best = other, value
        # By all components for the evidence; without what is considered for the mean; the
        # covariance is that of wider weights.
        for turn in range(3):
            free, widen = every if turn == 0 else estimated, 1.0
            if turn == 2:
                widen = (degrees + 3.0) / (degrees + 1.0)
            to = x1[j] if turn == 1 else state
            _weighted(
                at, x[j], P[j], free, measured, height, degrees, widen, to, P1[j], weights[j]
            )
            if turn == 0 and not cholesky_with_jitter(P1[j], Lc):
                _put(x[j], P[j], x1[j], P1[j])
                break
            if turn == 0:
                evidence[j] = best
                for a in range(n):
                    evidence[j] += math.log(Lc[a, a] / L[a, a])
    return x1, P1, evidence, weights
