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

"""The models of `families`, whose states are unequal, compiled: their mixing and what a fix says
of them.

A heading or hover has (x, y, s, unused), a constant velocity (x, y, vx, vy); what stands behind
these four components (depth, errors of fixes and instruments) is the same in all. The unused
component has mean 0 and variance 1, uncorrelated. With u the unit vector of a heading, w its left
normal and q the variance of a direction within its sector, the *image* of a model in the
components of another is

heading -> velocity
    v = s u, cov_v = P_ss u u' + q (s^2 + P_ss) w w', cov_pv = P_ps u'.
hover -> velocity
    v = 0, cov_v = (s^2 + P_ss) / 2 I, uncorrelated.
velocity -> hover
    s as in a new track, uncorrelated.
velocity -> heading
    The state given that w'v = 0 with variance q ((u'v)^2 + u'P_v u); then s = u'v. What stands
    behind the four components stays as it is, as if it were only considered: a hypothesis of the
    heading says nothing of it. Directions share the probability of going to headings as
    N(w'v; 0, S) E[max(s, 0)], S the variance of w'v and that one.
same components
    The state as it is.

All floats are float64, all arrays C-contiguous; T targets of M models with n states.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...estimation.arrays import FloatArray, IntArray
from ...estimation.imm import DEAD
from ...estimation.imm_kernels import CANCELLED, MOST_CANCELLED
from ...estimation.jit import kernel
from ...estimation.small_matrices import innovation_covariance, is_psd

LOG_2PI = math.log(2.0 * math.pi)

HEADING, VELOCITY, HOVER = 0, 1, 2
"""Kinds of models."""

LEAST_ACROSS = 1e-9
"""Variance, (m/s)^2, that a velocity across a heading has at least."""


NEGLIGIBLE = 40.0
"""A density by so much below another, in logarithms, adds nothing to it."""

FAR = 1000.0
"""Normalised distance squared along an axis, from what every model expects, beyond which a density
is nothing but small: what counts is which one is nearer."""


class Mixing(NamedTuple):
    """The kinds of M models: family (M,), the place of each one's family; kind (M,); direction
    (M,): of a heading, its place in units (D, 2); speed and speed_variance of a new track;
    sector_variance of a direction, rad^2."""

    family: IntArray
    kind: IntArray
    direction: IntArray
    units: FloatArray
    speed: float
    speed_variance: float
    sector_variance: float


@kernel
def mix(
    x: FloatArray, P: FloatArray, mu: FloatArray, transition: FloatArray, mixing: Mixing
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """As `imm_kernels.mix`, of the images of all models in the components of each: x (T, M, n), P
    (T, M, n, n), mu (T, M), transition (T or 1, M, M); velocities come after all others."""
    T, M, n = x.shape
    D = len(mixing.units)
    kind, direction = mixing.kind, mixing.direction
    x0, P0, c = np.empty((T, M, n)), np.empty((T, M, n, n)), np.empty((T, M))
    # Images of each model: as a velocity or a hover, and of a velocity in each direction.
    other_x, other_P = np.empty((M, n)), np.empty((M, n, n))
    turned_x, turned_P = np.empty((M, D, n)), np.empty((M, D, n, n))
    fit, W, reach = np.empty(D), np.empty((M, M)), np.empty(M)
    S = 0
    while S < M and kind[S] != VELOCITY:
        S += 1
    centre, d = np.empty(n), np.empty(n)
    # About the centre, first and second moments of the images of a velocity, the hover's last; and
    # which of them each heading or hover takes.
    first, second = np.empty((n, D + 1)), np.empty((n, n, D + 1))
    image = np.empty(S, dtype=np.int64)
    for j in range(S):
        image[j] = direction[j] if kind[j] == HEADING else D
    # Sums for all headings and hovers, which come first, lie in a row: such loops are vectorised.
    e, total, L = np.empty((n, S)), np.empty((n, n, S)), np.empty((n, n))
    for t in range(T):
        p = t % transition.shape[0]
        for i in range(M):
            for j in range(M):
                W[i, j] = transition[p, i, j] * mu[t, i]
            if i >= S:
                _as_hover(x[t, i], P[t, i], mixing, other_x[i], other_P[i])
                for k in range(D):
                    fit[k] = _as_heading(
                        x[t, i], P[t, i], k, mixing, turned_x[i, k], turned_P[i, k]
                    )
                _share(W[i], kind, direction, fit)
            else:
                _as_velocity(
                    x[t, i], P[t, i], kind[i], direction[i], mixing, other_x[i], other_P[i]
                )
        for j in range(M):
            reach[j] = 0.0
        for i in range(M):
            for j in range(M):
                reach[j] += W[i, j]
        for j in range(M):
            c[t, j] = reach[j]
        for i in range(M):
            for j in range(M):
                W[i, j] = W[i, j] / reach[j] if reach[j] > DEAD else mu[t, i]
        for a in range(n):
            centre[a] = 0.0
            for i in range(S):
                centre[a] += W[i, 0] * x[t, i, a]
            for j in range(S):
                e[a, j] = 0.0
            for b in range(a + 1):
                for j in range(S):
                    total[a, b, j] = 0.0
        for i in range(S):
            for a in range(n):
                d[a] = x[t, i, a] - centre[a]
                for j in range(S):
                    e[a, j] += W[i, j] * d[a]
                for b in range(a + 1):
                    moment = P[t, i, a, b] + d[a] * d[b]
                    if moment != 0.0:
                        for j in range(S):
                            total[a, b, j] += W[i, j] * moment
        for i in range(S, M):
            for k in range(D + 1):
                x_i, P_i = other_x[i], other_P[i]
                if k < D:
                    x_i, P_i = turned_x[i, k], turned_P[i, k]
                for a in range(n):
                    first[a, k] = x_i[a] - centre[a]
                    for b in range(a + 1):
                        second[a, b, k] = P_i[a, b] + first[a, k] * first[b, k]
            for a in range(n):
                for j in range(S):
                    e[a, j] += W[i, j] * first[a, image[j]]
                for b in range(a + 1):
                    for j in range(S):
                        total[a, b, j] += W[i, j] * second[a, b, image[j]]
        for j in range(M):
            most = np.inf if j >= S else 0.0
            for a in range(n):
                if j >= S:
                    break
                x0[t, j, a] = centre[a] + e[a, j]
                for b in range(a + 1):
                    P0[t, j, a, b] = total[a, b, j] - e[a, j] * e[b, j]
                    P0[t, j, b, a] = P0[t, j, a, b]
                if not total[a, a, j] <= most * P0[t, j, a, a]:
                    positive = P0[t, j, a, a] > 0.0
                    most = total[a, a, j] / P0[t, j, a, a] if positive else np.inf
            # Models far apart and sharp: the difference may have lost its digits.
            if most <= CANCELLED or (most <= MOST_CANCELLED and is_psd(P0[t, j], L)):
                continue
            x0[t, j, :] = 0.0
            P0[t, j, :, :] = 0.0
            # The mean first: what is summed about it keeps its digits.
            for turn in range(2):
                for i in range(M):
                    w = W[i, j]
                    x_i, P_i = x[t, i], P[t, i]
                    if (i >= S) != (j >= S):
                        x_i, P_i = other_x[i], other_P[i]
                        if kind[j] == HEADING:
                            x_i, P_i = turned_x[i, direction[j]], turned_P[i, direction[j]]
                    for a in range(n):
                        if turn == 0:
                            x0[t, j, a] += w * x_i[a]
                            continue
                        d[a] = x_i[a] - x0[t, j, a]
                        for b in range(a + 1):
                            P0[t, j, a, b] += w * (P_i[a, b] + d[a] * d[b])
                            P0[t, j, b, a] = P0[t, j, a, b]
    return x0, P0, c


@kernel
def _share(W: FloatArray, kind: IntArray, direction: IntArray, fit: FloatArray) -> None:
    """Share what goes from a velocity to the headings, in its row W (M,), by the logarithms fit
    (D,) of the weights of their directions."""
    best = -np.inf
    for k in range(len(fit)):
        best = max(best, fit[k])
    if not math.isfinite(best):
        return
    going, total = 0.0, 0.0
    for j in range(len(W)):
        if kind[j] == HEADING:
            going += W[j]
            total += math.exp(fit[direction[j]] - best)
    for j in range(len(W)):
        if kind[j] == HEADING:
            W[j] = going * math.exp(fit[direction[j]] - best) / total


@kernel
def _as_velocity(
    x: FloatArray,
    P: FloatArray,
    kind: int,
    direction: int,
    mixing: Mixing,
    out_x: FloatArray,
    out_P: FloatArray,
) -> None:
    """The image of a heading or hover as a velocity."""
    n = len(x)
    for a in range(n):
        out_x[a] = x[a]
        for b in range(n):
            out_P[a, b] = P[a, b]
    along, across = P[2, 2], mixing.sector_variance * (x[2] ** 2 + P[2, 2])
    u, v, speed = 0.0, 0.0, x[2]
    if kind == HEADING:
        u, v = mixing.units[direction, 0], mixing.units[direction, 1]
    for a in range(n):
        out_P[a, 2] = out_P[2, a] = P[a, 2] * u
        out_P[a, 3] = out_P[3, a] = P[a, 2] * v
    if kind == HEADING:
        out_P[2, 2] = along * u * u + across * v * v
        out_P[2, 3] = out_P[3, 2] = (along - across) * u * v
        out_P[3, 3] = along * v * v + across * u * u
    else:
        out_P[2, 3] = out_P[3, 2] = 0.0
        out_P[2, 2] = out_P[3, 3] = 0.5 * (speed**2 + P[2, 2])
    out_x[2], out_x[3] = speed * u, speed * v


@kernel
def _as_hover(
    x: FloatArray, P: FloatArray, mixing: Mixing, out_x: FloatArray, out_P: FloatArray
) -> None:
    """The image of a velocity as a hover."""
    n = len(x)
    for a in range(n):
        out_x[a] = x[a]
        for b in range(n):
            apart = a == 2 or a == 3 or b == 2 or b == 3
            out_P[a, b] = 0.0 if apart else P[a, b]
    out_x[2], out_x[3] = mixing.speed, 0.0
    out_P[2, 2], out_P[3, 3] = mixing.speed_variance, 1.0


@kernel
def _as_heading(
    x: FloatArray,
    P: FloatArray,
    direction: int,
    mixing: Mixing,
    out_x: FloatArray,
    out_P: FloatArray,
) -> float:
    """The image of a velocity as a heading, and the logarithm of the weight of its direction."""
    n = len(x)
    u, v = mixing.units[direction, 0], mixing.units[direction, 1]
    speed = u * x[2] + v * x[3]
    across = u * x[3] - v * x[2]
    along = u * u * P[2, 2] + 2.0 * u * v * P[2, 3] + v * v * P[3, 3]
    S = u * u * P[3, 3] - 2.0 * u * v * P[2, 3] + v * v * P[2, 2]
    S += mixing.sector_variance * (speed * speed + along) + LEAST_ACROSS
    for a in range(n):
        g = u * P[a, 3] - v * P[a, 2]
        out_x[a] = x[a] - g * across / S if a < 4 else x[a]
        for b in range(n):
            out_P[a, b] = P[a, b]
            if a < 4 or b < 4:
                out_P[a, b] -= g * (u * P[b, 3] - v * P[b, 2]) / S
    speed = u * out_x[2] + v * out_x[3]
    variance = u * u * out_P[2, 2] + 2.0 * u * v * out_P[2, 3] + v * v * out_P[3, 3]
    for a in range(n):
        out_P[a, 2] = out_P[2, a] = u * out_P[a, 2] + v * out_P[a, 3]
    for a in range(n):
        out_P[a, 3] = out_P[3, a] = 0.0
    out_x[2], out_x[3] = speed, 0.0
    out_P[2, 2], out_P[3, 3] = variance, 1.0
    weight = -0.5 * (across * across / S + LOG_2PI + math.log(S))
    return weight + _log_positive_part(speed, variance)


@kernel
def _log_positive_part(mean: float, variance: float) -> float:
    """ln E[max(s, 0)] of a normal s."""
    std = math.sqrt(max(variance, 1e-300))
    t = mean / std
    density = math.exp(-0.5 * t * t - 0.5 * LOG_2PI)
    value = density + 0.5 * t * math.erfc(-t / math.sqrt(2.0))
    if t > -30.0:
        return math.log(std) + math.log(value)
    return math.log(std) - 0.5 * (t * t + LOG_2PI) - 2.0 * math.log(-t)


@kernel
def log_densities(
    h: FloatArray,
    H: FloatArray,
    P: FloatArray,
    c: FloatArray,
    z: FloatArray,
    R: FloatArray,
    scales: FloatArray,
) -> FloatArray:
    """ln of the predictive density of each fix in each copy of the models, (T, K, D): h
    (T, K M, 2) expected by H (1, K M, 2, n), P (T, K M, n, n), c (T, K M); z (D, 2), R (D, 2, 2),
    which copy k takes `scales` (K,) times. Of fixes that are `FAR` off it is a rough figure, all
    the smaller the farther."""
    T, models, _ = h.shape
    K, D, n = len(scales), len(z), P.shape[2]
    M = models // K
    out = np.empty((T, K, D))
    PHt, nothing, S = np.empty((n, 2)), np.empty((2, 2)), np.empty((M, 2, 2))
    logs, weight = np.empty(M), np.empty(M)
    low, high, widest = np.empty(2), np.empty(2), np.empty(2)
    for r in range(2):
        nothing[r, 0] = nothing[r, 1] = widest[r] = 0.0
        for d in range(D):
            widest[r] = max(widest[r], R[d, r, r])
    for t in range(T):
        for k in range(K):
            total = 0.0
            for r in range(2):
                low[r], high[r] = np.inf, -np.inf
            for j in range(M):
                own = k * M + j
                total += c[t, own]
                innovation_covariance(P[t, own], H[0, own], nothing, PHt, S[j])
                for r in range(2):
                    reach = math.sqrt(FAR * max(S[j, r, r] + scales[k] * widest[r], 0.0))
                    low[r] = min(low[r], h[t, own, r] - reach)
                    high[r] = max(high[r], h[t, own, r] + reach)
            for j in range(M):
                share = c[t, k * M + j] / total
                weight[j] = math.log(share) - LOG_2PI if share > 0.0 else -np.inf
            for d in range(D):
                off = 0.0
                for r in range(2):
                    half = 0.5 * (high[r] - low[r])
                    if not low[r] <= z[d, r] <= high[r] and half > 0.0:
                        off = max(off, abs(z[d, r] - 0.5 * (low[r] + high[r])) / half)
                if off > 1.0:
                    out[t, k, d] = -0.5 * FAR * off * off
                    continue
                # The least determinant of an innovation covariance is that of the fix alone.
                sharpest = scales[k] ** 2 * (R[d, 0, 0] * R[d, 1, 1] - R[d, 0, 1] * R[d, 1, 0])
                sharpest = math.log(sharpest) if sharpest > 0.0 else -np.inf
                best = -np.inf
                for j in range(M):
                    # The Cholesky factor of 2 x 2, written out.
                    own = k * M + j
                    a = S[j, 0, 0] + scales[k] * R[d, 0, 0]
                    b = S[j, 1, 0] + scales[k] * R[d, 1, 0]
                    e = S[j, 1, 1] + scales[k] * R[d, 1, 1] - b * b / a
                    logs[j] = -np.inf
                    if weight[j] > -np.inf and a > 0.0 and e > 0.0:
                        first = z[d, 0] - h[t, own, 0]
                        second = z[d, 1] - h[t, own, 1] - b / a * first
                        nis = first * first / a + second * second / e
                        if weight[j] - 0.5 * (nis + sharpest) < best - NEGLIGIBLE:
                            continue
                        logs[j] = weight[j] - 0.5 * (nis + math.log(a * e))
                        best = max(best, logs[j])
                out[t, k, d] = best
                if math.isfinite(best):
                    sum_d = 0.0
                    for j in range(M):
                        if logs[j] > best - NEGLIGIBLE:
                            sum_d += math.exp(logs[j] - best)
                    out[t, k, d] = best + math.log(sum_d)
    return out


@kernel
def inside_families(transition: FloatArray, nominal: FloatArray, family: IntArray) -> FloatArray:
    """`transition` (T, M, M) inside each family, `nominal` (M, M) between them; each row goes to
    its own family as often as in `nominal`."""
    T, M = len(transition), len(nominal)
    out = np.empty((T, M, M))
    for t in range(T):
        for i in range(M):
            total, due = 0.0, 0.0
            for j in range(M):
                if family[j] == family[i]:
                    total += transition[t, i, j]
                    due += nominal[i, j]
            for j in range(M):
                own = family[j] == family[i] and total > 0.0
                out[t, i, j] = transition[t, i, j] * due / total if own else nominal[i, j]
    return out
