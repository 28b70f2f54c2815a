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

"""The arithmetic of the obstacle filter, compiled: updates, bands and outlook.

A target is K components of four states (d, delta, z, s): range m, azimuth rad positive to
starboard, depth m of the obstacle, scale of the navigation's horizontal distances. A kernel takes
x (T, K, 4) and P (T, K, 4, 4) of all targets at once; `cone` says which azimuth is meant.
`acoustics.geometry` describes points and projections; here they are written out again for speed,
and where no point exists, as can happen at a sigma point, the nearest existing one is taken. Sigma
points (`sigma_kernels`) are on the columns of the Cholesky root with kappa = 1, so
that no weight is negative and the centre of four states weighs 1/5.
"""

from __future__ import annotations

import math

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray
from ...estimation.covariance import LIMIT
from ...estimation.elementary import gaussians
from ...estimation.jit import kernel
from ...estimation.small_matrices import add_jitter, is_psd, square_root_update, whitened_square

KAPPA = 1.0
NEGLIGIBLE = 1e-12
"""A component that weighs less plays no part in a quantile or a place."""
AHEAD = 0.2
"""Cosine to the axis of the sonar, 78 degrees: beyond, range and azimuth fix nothing."""
ROOT_2PI = math.sqrt(2.0 * math.pi)
NORMAL_95 = 1.645
"""Where the search for a quantile begins, standard deviations off the mean."""


@kernel
def point(d: float, delta: float, d_st: float, R: FloatArray, cone: bool, m: FloatArray) -> None:
    """`geometry.reconstruct` into m (3,)."""
    cosine, sine = math.cos(delta), math.sin(delta)
    a, b, c = R[2, 0], R[2, 1], R[2, 2]
    if cone:
        m_y, r = d * sine, d * cosine
        m[0], m[2] = _level(a, c, d_st - b * m_y, r)
        m[1] = m_y
    else:
        level, m[2] = _level(a * cosine + b * sine, c, d_st, d)
        m[0], m[1] = level * cosine, level * sine


@kernel
def _level(k: float, c: float, drop: float, r: float) -> tuple[float, float]:
    """The two components of length r at the elevation asin(drop / (r A)) - atan2(k, c), A =
    hypot(k, c): the arcs are never computed, only their cosines and sines."""
    A = math.sqrt(k * k + c * c)
    sine = min(1.0, max(-1.0, drop / (r * A)))
    cosine = math.sqrt((1.0 - sine) * (1.0 + sine))
    if A > 0.0:
        k, c = k / A, c / A
    else:
        k, c = 0.0, 1.0
    return r * (cosine * c + sine * k), r * (sine * c - cosine * k)


@kernel
def points(x: FloatArray, p: FloatArray, R: FloatArray, cone: bool) -> FloatArray:
    """Where the means lie, seen from the sonar at (p, R): (T, K, 3)."""
    T, K, _ = x.shape
    out = np.empty((T, K, 3))
    for t in range(T):
        for j in range(K):
            point(x[t, j, 0], x[t, j, 1], x[t, j, 2] - p[2], R, cone, out[t, j])
    return out


@kernel
def outlook(
    m: FloatArray,
    spread: FloatArray,
    mu: FloatArray,
    vertical: float,
    horizontal: float,
    reach: float,
) -> tuple[FloatArray, BoolArray]:
    """Of targets that lie at m (T, K, 3), seen from the sonar, with `spread` (T, K) rad in
    elevation: the probability (T,) that a beam of these half widths and that reach holds them, and
    whether they lie `AHEAD` (T,)."""
    T, K, _ = m.shape
    inside, ahead, mean = np.zeros(T), np.zeros(T, dtype=np.bool_), np.empty(3)
    # Of all components in a beam: whose they are, and how far off the two edges.
    which, end = np.empty((T * K, 2), dtype=np.int64), 0
    rows = np.empty((4, 2 * T * K))
    across, along = math.cos(horizontal), math.sin(horizontal)
    for t in range(T):
        for i in range(len(mean)):
            mean[i] = 0.0
        for j in range(K):
            for i in range(len(mean)):
                mean[i] += mu[t, j] * m[t, j, i]
            x, y, z = m[t, j, 0], m[t, j, 1], m[t, j, 2]
            d = math.sqrt(x * x + y * y + z * z)
            # The sine of how far inside the edge the azimuth lies.
            if mu[t, j] > 0.0 and d <= reach and along * x - across * abs(y) >= 0.0:
                elevation, std = math.asin(z / d), max(spread[t, j], 1e-6)
                rows[0, 2 * end] = (vertical - elevation) / std
                rows[0, 2 * end + 1] = (-vertical - elevation) / std
                which[end, 0], which[end, 1] = t, j
                end += 1
        d = math.sqrt(mean[0] * mean[0] + mean[1] * mean[1] + mean[2] * mean[2])
        ahead[t] = mean[0] > AHEAD * d
    n = 2 * end
    gaussians(rows[0, :n], rows[1, :n], rows[2, :n], rows[3, :n])
    for k in range(end):
        t, j = which[k, 0], which[k, 1]
        inside[t] += mu[t, j] * (rows[3, 2 * k] - rows[3, 2 * k + 1])
    return inside, ahead


@kernel
def looked(
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    m: FloatArray,
    floor: FloatArray,
    slope: FloatArray,
    edge: float,
    soft: float,
    horizontal: float,
    reach: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """The density of mixtures (T, K) times `floor + slope B`, matched in mean and covariance
    component by component, and the mean (T,) of B beforehand (`looks`).

    m (T, K, 3): where the means lie, seen from the sonar; floor, slope (T,); edge and soft, rad:
    half height of the pattern B and the standard deviation of its edges; horizontal, reach: half
    width of the sector, rad, and its range, m, which fade out likewise.
    """
    T, K, n = x.shape
    x1, P1, mu1, held = x.copy(), P.copy(), mu.copy(), np.zeros(T)
    which, end = np.empty((T * K, 2), dtype=np.int64), 0
    rows, sides = np.empty((4, 2 * T * K)), np.empty((2, T * K))
    for t in range(T):
        for j in range(K):
            if mu[t, j] <= NEGLIGIBLE:
                continue
            X, Y, Z = m[t, j, 0], m[t, j, 1], m[t, j, 2]
            d = math.sqrt(X * X + Y * Y + Z * Z)
            off = horizontal - math.atan2(abs(Y), X)
            share = min(max(0.5 + 0.25 * off / soft, 0.0), 1.0)
            share *= min(max(0.5 + 0.25 * (reach / d - 1.0) / soft, 0.0), 1.0)
            std = math.sqrt(soft * soft + P[t, j, 2, 2] / (d * d))
            elevation = math.asin(Z / d)
            rows[0, 2 * end] = (edge - elevation) / std
            rows[0, 2 * end + 1] = (-edge - elevation) / std
            sides[0, end], sides[1, end] = share, 1.0 / (std * d)
            which[end, 0], which[end, 1] = t, j
            end += 1
    gaussians(rows[0, : 2 * end], rows[1, : 2 * end], rows[2, : 2 * end], rows[3, : 2 * end])
    for k in range(end):
        t, j, share, rate = which[k, 0], which[k, 1], sides[0, k], sides[1, k]
        upper, lower = rows[2, 2 * k] / ROOT_2PI, rows[2, 2 * k + 1] / ROOT_2PI
        inside = share * (rows[3, 2 * k] - rows[3, 2 * k + 1])
        first = share * rate * (lower - upper)
        second = share * rate * rate * (rows[0, 2 * k + 1] * lower - rows[0, 2 * k] * upper)
        held[t] += mu[t, j] * inside
        weight = floor[t] + slope[t] * inside
        first *= slope[t] / weight
        second = slope[t] * second / weight - first * first
        mu1[t, j] = mu[t, j] * weight
        for a in range(n):
            x1[t, j, a] += P[t, j, a, 2] * first
            for b in range(n):
                P1[t, j, a, b] += P[t, j, a, 2] * P[t, j, b, 2] * second
    for t in range(T):
        total = 0.0
        for j in range(K):
            total += mu1[t, j]
        for j in range(K):
            mu1[t, j] = mu1[t, j] / total if total > 0.0 else mu[t, j]
    return x1, P1, mu1, held


@kernel
def matched(x: FloatArray, P: FloatArray, mu: FloatArray, n: int) -> tuple[FloatArray, FloatArray]:
    """Mean (T, n) and covariance (T, n, n) of the first n states of mixtures (T, K)."""
    T, K, _ = x.shape
    mean, covariance, off = np.zeros((T, n)), np.zeros((T, n, n)), np.empty(n)
    for t in range(T):
        for j in range(K):
            for a in range(n):
                mean[t, a] += mu[t, j] * x[t, j, a]
        for j in range(K):
            for a in range(n):
                off[a] = x[t, j, a] - mean[t, a]
                for b in range(a + 1):
                    covariance[t, a, b] += mu[t, j] * (P[t, j, a, b] + off[a] * off[b])
        for a in range(n):
            for b in range(a):
                covariance[t, b, a] = covariance[t, a, b]
    return mean, covariance


def jipda_update(
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    h: FloatArray,
    z: FloatArray,
    R: FloatArray,
    outlier_probability: float,
    outlier_density: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, BoolArray]:
    """Update with one detection per target that may be an outlier; range and azimuth are states.

    h (T, K, 2) expected, z (T, 2) measured, R (T, 2, 2). With probability beta the detection is
    the target's, else it says nothing; both cases together are matched in mean and covariance.
    Gives x, P, mu (T, K), the normalised innovation squared (T,) of the mixture's mean, and where
    P (T, K) was repaired (`estimation.covariance`).
    """
    outlier = outlier_probability * outlier_density
    x1, P1, mu1, nis, repaired = _update(x, P, mu, h, z, R, outlier_probability, outlier)
    if np.count_nonzero(repaired):
        _update_again(x, P, mu, h, z, R, outlier_probability, outlier, x1, P1, mu1, repaired)
    return x1, P1, mu1, nis, repaired


@kernel
def _update(
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    h: FloatArray,
    z: FloatArray,
    R: FloatArray,
    outlier_probability: float,
    outlier: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, BoolArray]:
    """`jipda_update` where the plain form is exact enough. Weights of a target of which something
    is to be repaired are not normalised."""
    T, K, n = x.shape
    x1, P1, mu1, nis = np.empty((T, K, n)), np.empty((T, K, n, n)), np.empty((T, K)), np.empty(T)
    repaired = np.zeros((T, K), dtype=np.bool_)
    g0, g1, k0, k1 = np.empty(n), np.empty(n), np.empty(n), np.empty(n)
    L = np.empty((n, n))
    for t in range(T):
        total, exact = 0.0, True
        v0 = v1 = 0.0
        for j in range(K):
            v0 += mu[t, j] * (z[t, 0] - h[t, j, 0])
            v1 += mu[t, j] * (z[t, 1] - h[t, j, 1])
        s00 = s01 = s11 = 0.0
        for j in range(K):
            e0, e1 = z[t, 0] - h[t, j, 0] - v0, z[t, 1] - h[t, j, 1] - v1
            s00 += mu[t, j] * (P[t, j, 0, 0] + R[t, 0, 0] + e0 * e0)
            s01 += mu[t, j] * (P[t, j, 0, 1] + R[t, 0, 1] + e0 * e1)
            s11 += mu[t, j] * (P[t, j, 1, 1] + R[t, 1, 1] + e1 * e1)
        determinant = max(s00 * s11 - s01 * s01, LIMIT * s00 * s11)
        nis[t] = (s11 * v0 * v0 - 2.0 * s01 * v0 * v1 + s00 * v1 * v1) / determinant
        for j in range(K):
            if mu[t, j] == 0.0:
                mu1[t, j] = 0.0
                for a in range(n):
                    x1[t, j, a] = x[t, j, a]
                    for b in range(n):
                        P1[t, j, a, b] = P[t, j, a, b]
                continue
            r0, r1 = z[t, 0] - h[t, j, 0], z[t, 1] - h[t, j, 1]
            s00 = P[t, j, 0, 0] + R[t, 0, 0]
            s01 = P[t, j, 0, 1] + R[t, 0, 1]
            s11 = P[t, j, 1, 1] + R[t, 1, 1]
            determinant = s00 * s11 - s01 * s01
            distance = (s11 * r0 * r0 - 2.0 * s01 * r0 * r1 + s00 * r1 * r1) / determinant
            own = (1.0 - outlier_probability) * math.exp(-0.5 * distance)
            own /= 2.0 * math.pi * math.sqrt(determinant)
            likelihood = own + outlier
            beta = own / (own + outlier) if own + outlier > 0.0 else 0.0
            for a in range(n):
                g0[a], g1[a] = P[t, j, a, 0], P[t, j, a, 1]
                k0[a] = (s11 * g0[a] - s01 * g1[a]) / determinant
                k1[a] = (s00 * g1[a] - s01 * g0[a]) / determinant
                x1[t, j, a] = x[t, j, a] + beta * (k0[a] * r0 + k1[a] * r1)
            for a in range(n):
                for b in range(a + 1):
                    gained = k0[a] * g0[b] + k1[a] * g1[b]
                    spread = (k0[a] * r0 + k1[a] * r1) * (k0[b] * r0 + k1[b] * r1)
                    value = P[t, j, a, b] - beta * gained + beta * (1.0 - beta) * spread
                    P1[t, j, a, b] = value
                    P1[t, j, b, a] = value
            trusted = R[t, 0, 0] > LIMIT * s00 and R[t, 1, 1] > LIMIT * s11
            trusted = trusted and determinant > LIMIT * s00 * s11
            if not (trusted and is_psd(P1[t, j], L)):
                repaired[t, j], exact = True, False
            mu1[t, j] = mu[t, j] * likelihood
            total += mu1[t, j]
        for j in range(K):
            if exact:
                mu1[t, j] = mu1[t, j] / total if total > 0.0 else mu[t, j]
    return x1, P1, mu1, nis, repaired


@kernel
def _update_again(
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    h: FloatArray,
    z: FloatArray,
    R: FloatArray,
    outlier_probability: float,
    outlier: float,
    x1: FloatArray,
    P1: FloatArray,
    mu1: FloatArray,
    repaired: BoolArray,
) -> None:
    """Finish `_update`, in place, for the targets of which something is `repaired` (T, K)."""
    T, K, _ = x.shape
    v = np.empty(2)
    for t in range(T):
        total, exact = 0.0, True
        for j in range(K):
            if repaired[t, j]:
                exact = False
                v[0], v[1] = z[t, 0] - h[t, j, 0], z[t, 1] - h[t, j, 1]
                mu1[t, j] = mu[t, j] * _square_root_jipda_update(
                    x[t, j], P[t, j], v, R[t], outlier_probability, outlier, x1[t, j], P1[t, j]
                )
            total += mu1[t, j]
        for j in range(K):
            if not exact:
                mu1[t, j] = mu1[t, j] / total if total > 0.0 else mu[t, j]


@kernel
def _square_root_jipda_update(
    x: FloatArray,
    P: FloatArray,
    v: FloatArray,
    R: FloatArray,
    outlier_probability: float,
    outlier: float,
    x1: FloatArray,
    P1: FloatArray,
) -> float:
    """`jipda_update` of one component with innovation v (2,) in square-root form, into x1 and P1;
    its likelihood. What cannot be used, because it is not finite, leaves x and P as they are."""
    n = len(x)
    L, K, H, w = np.zeros((2, 2)), np.empty((n, 2)), np.eye(2, n), np.empty(2)
    for a in range(n):
        x1[a] = x[a]
        for b in range(n):
            P1[a, b] = P[a, b]
    updated = np.empty((n, n))
    if not square_root_update(P, H, R, L, K, updated):
        return outlier
    own = (1.0 - outlier_probability) * math.exp(-0.5 * whitened_square(L, v, w))
    own /= 2.0 * math.pi * L[0, 0] * L[1, 1]
    beta = own / (own + outlier) if own + outlier > 0.0 else 0.0
    for a in range(n):
        w[0] = K[a, 0] * v[0] + K[a, 1] * v[1]
        x1[a] += beta * w[0]
        for b in range(a + 1):
            w[1] = K[b, 0] * v[0] + K[b, 1] * v[1]
            spread = beta * (1.0 - beta) * w[0] * w[1]
            P1[a, b] = (1.0 - beta) * P[a, b] + beta * updated[a, b] + spread
            P1[b, a] = P1[a, b]
    add_jitter(P1, updated)
    return own + outlier


@kernel
def halley(
    value: float,
    bracket: FloatArray,
    missing: float,
    density: float,
    slope: float,
) -> tuple[float, bool]:
    """A step of Halley's towards a quantile of a mixture that has this density there, with this
    slope, and is `missing` so much probability below `value`; halves the bracket (2,) where it
    would leave it. The next value, and whether it is the last."""
    bracket[0 if missing > 0.0 else 1] = value
    step = missing / density if density > 0.0 else np.inf
    # A step e leaves an error of e^3, but where the density bends within it.
    bend = 0.5 * step * slope / density if density > 0.0 else 0.0
    if abs(step) <= 1e-5 * (1.0 + abs(value)) and abs(bend) <= 1e-3:
        return value + step / (1.0 + bend), True
    if abs(bend) < 0.5:
        step /= 1.0 + bend
    value += step
    if not bracket[0] < value < bracket[1]:
        value = 0.5 * (bracket[0] + bracket[1])
    return value, False


@kernel
def bands(
    mean: FloatArray, std: FloatArray, mu: FloatArray, tail: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of mixtures (T, K): the quantiles `tail` and 1 - `tail`, and the probability below zero.

    All that is asked goes on together, since `gaussians` is quick with long rows only: question
    3 t is the lower quantile of target t, 3 t + 1 the upper one, 3 t + 2 the probability."""
    T, K = mean.shape
    count, parts = np.empty(T, dtype=np.int64), np.empty((T, 3, K))
    value, bracket = np.zeros(3 * T), np.empty((T, 2, 2))
    negative, rows = np.zeros(T), np.empty((4, 3 * T * K))
    for t in range(T):
        count[t], middle, square = 0, 0.0, 0.0
        low, high = np.inf, -np.inf
        for j in range(K):
            middle += mu[t, j] * mean[t, j]
            square += mu[t, j] * (std[t, j] * std[t, j] + mean[t, j] * mean[t, j])
            if mu[t, j] > NEGLIGIBLE:
                n = count[t]
                parts[t, 0, n], parts[t, 1, n], parts[t, 2, n] = mean[t, j], std[t, j], mu[t, j]
                count[t] += 1
                low = min(low, mean[t, j] - 9.0 * std[t, j])
                high = max(high, mean[t, j] + 9.0 * std[t, j])
        # The search begins where the quantiles of a Gaussian as wide as the mixture would be.
        reach = NORMAL_95 * math.sqrt(max(square - middle * middle, 0.0))
        value[3 * t] = min(max(middle - reach, low), high)
        value[3 * t + 1] = min(max(middle + reach, low), high)
        for kind in range(bracket.shape[1]):
            bracket[t, kind, 0], bracket[t, kind, 1] = low, high
    waiting, still = np.empty(3 * T, dtype=np.int64), 3 * T
    for question in range(3 * T):
        waiting[question] = question
    for _ in range(100):
        end = 0
        for i in range(still):
            question = waiting[i]
            t = question // 3
            for j in range(count[t]):
                rows[0, end] = (value[question] - parts[t, 0, j]) / parts[t, 1, j]
                end += 1
        gaussians(rows[0, :end], rows[1, :end], rows[2, :end], rows[3, :end])
        end, asked, still = 0, still, 0
        for i in range(asked):
            question = waiting[i]
            t, kind = question // 3, question % 3
            reached, density, slope = 0.0, 0.0, 0.0
            for j in range(count[t]):
                height = parts[t, 2, j] * rows[2, end] / (parts[t, 1, j] * ROOT_2PI)
                reached += parts[t, 2, j] * rows[3, end]
                density += height
                slope -= height * rows[0, end] / parts[t, 1, j]
                end += 1
            if kind == 2:
                # Weights add up to one but for rounding: no probability may leave [0, 1] for it.
                negative[t] = min(reached, 1.0)
                continue
            missing = (tail if kind == 0 else 1.0 - tail) - reached
            value[question], done = halley(
                value[question], bracket[t, kind], missing, density, slope
            )
            if not done:
                waiting[still] = question
                still += 1
        if still == 0:
            break
    lower, upper = np.empty(T), np.empty(T)
    for t in range(T):
        lower[t], upper[t] = value[3 * t], value[3 * t + 1]
    return lower, upper, negative
