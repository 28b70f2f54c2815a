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

"""The verbs of `imm` compiled: the same mathematics over plain loops, some 300 times faster for
one target.

Signatures are those of `imm` with arrays only: ``B (M, n)`` is always given, and where `imm`
broadcasts over targets (transition, H, R) an array of length one does. All arrays are float64 and
C-contiguous.

What rounding has spoilt is rare, and its repair is a large part of the code. So the kernels of
each verb mark what needs more care, and a second kernel, compiled when it is first needed, does
that.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .arrays import BoolArray, FloatArray, IntArray
from .imm import DEAD
from .jit import kernel
from .small_matrices import (
    all_finite,
    cholesky,
    cholesky_with_jitter,
    gain,
    innovation_covariance,
    is_psd,
    joseph,
    LIMIT,
    product,
    square_root_predict,
    square_root_update,
    whitened_square,
)

LOG_2PI = math.log(2.0 * math.pi)

Cycle = tuple[
    FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, BoolArray
]
"""x, P, mu, mean, covariance, log_likelihood, nis and ok of targets after a whole cycle."""

CANCELLED, MOST_CANCELLED = 10.0, 1e8
"""A second moment so many times the variance it leaves has lost a digit, or half of all digits."""


def mix(
    x: FloatArray, P: FloatArray, mu: FloatArray, transition: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """See `imm.mix`: mixed x (T, M, n), mixed P (T, M, n, n), c (T, M)."""
    x0, P0, c, lost, clear = _mix(x, P, mu, transition)
    if not clear:
        _mix_directly(x, P, mu, transition, c, x0, P0, lost)
    return x0, P0, c


@kernel
def _mix(
    x: FloatArray, P: FloatArray, mu: FloatArray, transition: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray, bool]:
    """`mix`, lost (T, M): whose covariance has lost its digits, and whether none has.

    The second moment is summed about the mean of all models, which makes the work of a pair (i, j)
    one multiplication an entry: sum_i W_ij (P_i + d_i d_i') - e_j e_j', d_i = x_i - centre. Where
    that difference has lost its digits, models far apart and sharp, it has to be summed about
    x0_j.
    """
    T, M, n = x.shape
    x0, P0, c = np.empty((T, M, n)), np.empty((T, M, n, n)), np.empty((T, M))
    lost, clear = np.empty((T, M), dtype=np.bool_), True
    centre, L = np.empty(n), np.empty((n, n))
    # What is summed for every j lies in a row, j last: such loops are vectorised.
    W, w, reach = np.empty((M, M)), np.empty(M), np.empty(M)
    d, e, total = np.empty(n), np.empty((n, M)), np.empty((n, n, M))
    for t in range(T):
        p = t % transition.shape[0]
        for a in range(n):
            centre[a] = 0.0
            for i in range(M):
                centre[a] += mu[t, i] * x[t, i, a]
        reach[:] = 0.0
        for i in range(M):
            for j in range(M):
                W[i, j] = transition[p, i, j] * mu[t, i]
                reach[j] += W[i, j]
        e[:] = 0.0
        total[:] = 0.0
        for i in range(M):
            for j in range(M):
                w[j] = W[i, j] / reach[j] if reach[j] > DEAD else mu[t, i]
            for a in range(n):
                d[a] = x[t, i, a] - centre[a]
                for j in range(M):
                    e[a, j] += w[j] * d[a]
            for a in range(n):
                for b in range(a + 1):
                    moment = P[t, i, a, b] + d[a] * d[b]
                    for j in range(M):
                        total[a, b, j] += w[j] * moment
        for j in range(M):
            c[t, j] = reach[j]
            most = 0.0
            for a in range(n):
                x0[t, j, a] = centre[a] + e[a, j]
                for b in range(a + 1):
                    P0[t, j, a, b] = total[a, b, j] - e[a, j] * e[b, j]
                    P0[t, j, b, a] = P0[t, j, a, b]
                if not total[a, a, j] <= most * P0[t, j, a, a]:
                    positive = P0[t, j, a, a] > 0.0
                    most = total[a, a, j] / P0[t, j, a, a] if positive else np.inf
            lost[t, j] = not (
                most <= CANCELLED or (most <= MOST_CANCELLED and is_psd(P0[t, j], L))
            )
            clear = clear and not lost[t, j]
    return x0, P0, c, lost, clear


@kernel
def _mix_directly(
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    transition: FloatArray,
    c: FloatArray,
    x0: FloatArray,
    P0: FloatArray,
    lost: BoolArray,
) -> None:
    """The mixed covariances of the `lost` (T, M) models, as sums of squares about x0, into P0."""
    T, M, n = x.shape
    for t in range(T):
        for j in range(M):
            if not lost[t, j]:
                continue
            P0[t, j] = 0.0
            for i in range(M):
                W = transition[t % transition.shape[0], i, j] * mu[t, i]
                w = W / c[t, j] if c[t, j] > DEAD else mu[t, i]
                for a in range(n):
                    for b in range(n):
                        apart = (x[t, i, a] - x0[t, j, a]) * (x[t, i, b] - x0[t, j, b])
                        P0[t, j, a, b] += w * (P[t, i, a, b] + apart)


def predict(
    x: FloatArray, P: FloatArray, F: FloatArray, Q: FloatArray, B: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """See `imm.predict`: x, P, repaired."""
    x1, P1, lost, clear = _predict(x, P, F, Q, B)
    if not clear:
        _predict_carefully(P, F, Q, P1, lost)
    return x1, P1, lost


@kernel
def _predict(
    x: FloatArray, P: FloatArray, F: FloatArray, Q: FloatArray, B: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray, bool]:
    """`predict`, lost (T, M): whose covariance is none any more, and whether there is no such."""
    T, M, n = x.shape
    x1, P1 = np.empty((T, M, n)), np.empty((T, M, n, n))
    lost, clear = np.empty((T, M), dtype=np.bool_), True
    FP, L = np.empty((n, n)), np.empty((n, n))
    for t in range(T):
        for j in range(M):
            product(F[j], P[t, j], FP)
            for a in range(n):
                total = B[j, a]
                for b in range(n):
                    total += F[j, a, b] * x[t, j, b]
                x1[t, j, a] = total
            for a in range(n):
                for b in range(a + 1):
                    value = Q[j, a, b]
                    for k in range(n):
                        value += FP[a, k] * F[j, b, k]
                    P1[t, j, a, b] = value
                    P1[t, j, b, a] = value
            lost[t, j] = not is_psd(P1[t, j], L)
            clear = clear and not lost[t, j]
    return x1, P1, lost, clear


@kernel
def _predict_carefully(
    P: FloatArray, F: FloatArray, Q: FloatArray, P1: FloatArray, lost: BoolArray
) -> None:
    """Predict the `lost` (T, M) covariances again, in square-root form, into P1; those that are
    not finite stay, and are no longer marked."""
    T, M = lost.shape
    for t in range(T):
        for j in range(M):
            lost[t, j] = lost[t, j] and all_finite(P1[t, j])
            if lost[t, j]:
                square_root_predict(P[t, j], F[j], Q[j], P1[t, j])


class Updated(NamedTuple):
    """Targets after an update: x (T, M, n), P (T, M, n, n), mu (T, M) of all; of the t targets
    that were updated log_likelihood (t,), nis (t,), ok (t,), repaired (t, M)."""

    x: FloatArray
    P: FloatArray
    mu: FloatArray
    log_likelihood: FloatArray
    nis: FloatArray
    ok: BoolArray
    repaired: BoolArray


def update(
    x: FloatArray,
    P: FloatArray,
    c: FloatArray,
    innovation: FloatArray,
    H: FloatArray,
    R: FloatArray,
) -> Updated:
    """See `imm.update`: x, P, mu, log_likelihood, nis, ok, repaired."""
    targets = np.arange(len(x))
    return update_targets(x, P, c, innovation, H, R, targets, targets % len(R))


def update_targets(
    x: FloatArray,
    P: FloatArray,
    c: FloatArray,
    innovation: FloatArray,
    H: FloatArray,
    R: FloatArray,
    targets: IntArray,
    detection: IntArray,
) -> Updated:
    """`update` of some `targets` (t,), each with its innovation (t, M, m) and its `detection` (t,)
    of R (D, m, m); the others stay as they are."""
    updated, log_density, clear = _update(x, P, c, innovation, H, R, targets, detection)
    if not clear:
        _update_carefully(
            x, P, c, innovation, H, R, targets, detection, log_density, Updated(*updated)
        )
    return Updated(*updated)


@kernel
def _update(
    x: FloatArray,
    P: FloatArray,
    c: FloatArray,
    innovation: FloatArray,
    H: FloatArray,
    R: FloatArray,
    targets: IntArray,
    detection: IntArray,
) -> tuple[
    tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, BoolArray, BoolArray],
    FloatArray,
    bool,
]:
    """`update_targets`, where `repaired` marks what needs a repair; the log-densities (t, M) of
    the innovations; and whether nothing is marked. A target with a mark has no mu yet."""
    M, n = x.shape[1:]
    count, m = len(targets), innovation.shape[2]
    x1, P1, mu = x.copy(), P.copy(), c.copy()
    log_likelihood, nis = np.empty(count), np.empty(count)
    ok, lost = np.empty(count, dtype=np.bool_), np.empty((count, M), dtype=np.bool_)
    log_density, all_clear = np.empty((count, M)), True
    PHt, K, KR = np.empty((n, m)), np.empty((n, m)), np.empty((n, m))
    A, AP, root = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    S, L, S_mix = np.empty((m, m)), np.empty((m, m)), np.empty((m, m))
    scratch, mean = np.empty(m), np.empty(m)
    for k in range(count):
        t = targets[k]
        R_t, h_t = R[detection[k]], t % H.shape[0]
        log_likelihood[k], nis[k], ok[k], clear = -np.inf, np.nan, False, True
        for r in range(m):
            mean[r] = 0.0
            for j in range(M):
                mean[r] += c[t, j] * innovation[k, j, r]
            for s in range(m):
                S_mix[r, s] = 0.0
        for j in range(M):
            P_j, H_j, v_j, P1_j = P[t, j], H[h_t, j], innovation[k, j], P1[t, j]
            innovation_covariance(P_j, H_j, R_t, PHt, S)
            for r in range(m):
                for s in range(m):
                    S_mix[r, s] += c[t, j] * (S[r, s] + (v_j[r] - mean[r]) * (v_j[s] - mean[s]))
            trusted = cholesky(S, L)
            for r in range(m):
                trusted = trusted and R_t[r, r] > LIMIT * S[r, r]
            if trusted:
                gain(PHt, L, K)
                joseph(P_j, K, H_j, R_t, A, AP, KR, P1_j)
                trusted = is_psd(P1_j, root)
            lost[k, j], log_density[k, j] = not trusted, -np.inf
            if trusted:
                log_density[k, j] = _correct(L, K, v_j, x1[t, j], scratch)
            clear = clear and trusted
        if clear:
            log_likelihood[k] = _weigh(x[t], P[t], log_density[k], x1[t], P1[t], mu[t])
            ok[k] = log_likelihood[k] > -np.inf
        all_clear = all_clear and clear
        if (ok[k] or not clear) and cholesky_with_jitter(S_mix, L):
            nis[k] = whitened_square(L, mean, scratch)
    return (x1, P1, mu, log_likelihood, nis, ok, lost), log_density, all_clear


@kernel
def _update_carefully(
    x: FloatArray,
    P: FloatArray,
    c: FloatArray,
    innovation: FloatArray,
    H: FloatArray,
    R: FloatArray,
    targets: IntArray,
    detection: IntArray,
    log_density: FloatArray,
    updated: Updated,
) -> None:
    """Update again, in square-root form and in place, what `_update` marked as to be repaired;
    where that cannot be done the mark goes."""
    M, n = x.shape[1:]
    m = innovation.shape[2]
    L, K, scratch = np.empty((m, m)), np.empty((n, m)), np.empty(m)
    for k in range(len(targets)):
        t, marked = targets[k], False
        for j in range(M):
            if not updated.repaired[k, j]:
                continue
            marked = True
            H_j, P1_j = H[t % H.shape[0], j], updated.P[t, j]
            if square_root_update(P[t, j], H_j, R[detection[k]], L, K, P1_j):
                x1_j = updated.x[t, j]
                log_density[k, j] = _correct(L, K, innovation[k, j], x1_j, scratch)
            else:
                updated.repaired[k, j] = False
                for a in range(n):
                    for b in range(n):
                        P1_j[a, b] = P[t, j, a, b]
        if marked:
            updated.log_likelihood[k] = _weigh(
                x[t], P[t], log_density[k], updated.x[t], updated.P[t], updated.mu[t]
            )
            updated.ok[k] = updated.log_likelihood[k] > -np.inf
            if not updated.ok[k]:
                updated.nis[k] = np.nan


@kernel
def _correct(
    L: FloatArray, K: FloatArray, v: FloatArray, x: FloatArray, scratch: FloatArray
) -> float:
    """x (n,) += K v in place; gives the log-density of the innovation v (m,) by the Cholesky
    factor L of its covariance. scratch: (m,)."""
    n, m = K.shape
    value = -0.5 * (whitened_square(L, v, scratch) + m * LOG_2PI)
    for r in range(m):
        value -= math.log(L[r, r])
    for a in range(n):
        for r in range(m):
            x[a] += K[a, r] * v[r]
    return value


@kernel
def _weigh(
    x: FloatArray,
    P: FloatArray,
    log_density: FloatArray,
    x1: FloatArray,
    P1: FloatArray,
    mu: FloatArray,
) -> float:
    """Weigh the models of a target: mu (M,) by the log-densities (M,) of their innovations, in
    place. Gives the log-likelihood; minus infinity, and x1, P1 as x, P, where no model can be."""
    M, n = x.shape
    best = -np.inf
    for j in range(M):
        if mu[j] > 0.0 and math.isfinite(log_density[j]):
            log_density[j] = math.log(mu[j]) + log_density[j]
            best = max(best, log_density[j])
        else:
            log_density[j] = -np.inf
    if not math.isfinite(best):
        for j in range(M):
            for a in range(n):
                x1[j, a] = x[j, a]
                for b in range(n):
                    P1[j, a, b] = P[j, a, b]
        return -np.inf
    total = 0.0
    for j in range(M):
        mu[j] = math.exp(log_density[j] - best)
        total += mu[j]
    for j in range(M):
        mu[j] /= total
    return best + math.log(total)


@kernel
def combine(
    x: FloatArray, P: FloatArray, mu: FloatArray, E: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """See `imm.combine`."""
    T, M, n = x.shape
    q = E.shape[1]
    mean = np.empty((T, q))
    covariance = np.empty((T, q, q))
    y = np.empty((M, q))
    EP = np.empty((q, n))
    for t in range(T):
        for a in range(q):
            mean[t, a] = 0.0
            for b in range(q):
                covariance[t, a, b] = 0.0
        for j in range(M):
            for a in range(q):
                value = 0.0
                for k in range(n):
                    value += E[j, a, k] * x[t, j, k]
                y[j, a] = value
                mean[t, a] += mu[t, j] * value
        for j in range(M):
            if mu[t, j] == 0.0:
                continue
            product(E[j], P[t, j], EP)
            for a in range(q):
                for b in range(a + 1):
                    value = (y[j, a] - mean[t, a]) * (y[j, b] - mean[t, b])
                    for k in range(n):
                        value += EP[a, k] * E[j, b, k]
                    covariance[t, a, b] += mu[t, j] * value
        for a in range(q):
            for b in range(a):
                covariance[t, b, a] = covariance[t, a, b]
    return mean, covariance


def linear_cycle(
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    transition: FloatArray,
    F: FloatArray,
    Q: FloatArray,
    B: FloatArray,
    z: FloatArray,
    H: FloatArray,
    R: FloatArray,
    E: FloatArray,
) -> Cycle:
    """A whole cycle for targets whose measurements are already assigned: z (T, m), NaN where
    missed; H (M, m, n).

    Gives x, P, mu, mean, covariance, log_likelihood, nis, ok.
    """
    whole, clear = _linear_cycle(x, P, mu, transition, F, Q, B, z, H, R, E)
    if clear:
        return whole
    x0, P0, c = mix(x, P, mu, transition)
    x1, P1, _ = predict(x0, P0, F, Q, B)
    after = update(x1, P1, c, _innovations(z, H, x1), H[None], R)
    mean, covariance = combine(after.x, after.P, after.mu, E)
    return *after[:3], mean, covariance, *after[3:6]


@kernel
def _linear_cycle(
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    transition: FloatArray,
    F: FloatArray,
    Q: FloatArray,
    B: FloatArray,
    z: FloatArray,
    H: FloatArray,
    R: FloatArray,
    E: FloatArray,
) -> tuple[Cycle, bool]:
    """`linear_cycle`, and whether nothing in it needs more care."""
    T, M = mu.shape
    x0, P0, c, _, mixed = _mix(x, P, mu, transition)
    x1, P1, _, predicted = _predict(x0, P0, F, Q, B)
    targets, detection = np.empty(T, dtype=np.int64), np.empty(T, dtype=np.int64)
    for t in range(T):
        targets[t], detection[t] = t, t % len(R)
    after, _, updated = _update(
        x1, P1, c, _innovations(z, H, x1), H.reshape((1, *H.shape)), R, targets, detection
    )
    x2, P2, mu2, log_likelihood, nis, ok, _ = after
    mean, covariance = combine(x2, P2, mu2, E)
    clear = mixed and predicted and updated
    return (x2, P2, mu2, mean, covariance, log_likelihood, nis, ok), clear


@kernel
def _innovations(z: FloatArray, H: FloatArray, x: FloatArray) -> FloatArray:
    """z (T, m) less what each model expects, H (M, m, n) x (T, M, n): (T, M, m)."""
    M, m, n = H.shape
    T = len(x)
    innovation = np.empty((T, M, m))
    for t in range(T):
        for j in range(M):
            for r in range(m):
                value = z[t, r]
                for k in range(n):
                    value -= H[j, r, k] * x[t, j, k]
                innovation[t, j, r] = value
    return innovation
