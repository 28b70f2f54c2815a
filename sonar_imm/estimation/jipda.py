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

"""Joint integrated probabilistic data association with the IMM filter (Musicki and Evans 2004).

Where targets cross and false detections abound, choosing one pairing and forgetting the others
loses identities. Here every joint event, in which each track takes at most one detection and each
detection goes to at most one track, is weighed,

    Pr(event) ~ prod_assigned r_t P_D f_ti / lambda * prod_missed (1 - r_t P_D),

with r_t the probability that the target of track t exists, ``f_ti = sum_j c_j N(z_i; h_j, S_j)``
the likelihood of detection i in the mixture of the track's models, and lambda the density of false
detections and new targets together. The sums over the events are

    beta_ti         the target exists and caused detection i,
    missed_t        it exists and was not detected: Pr(no detection) r (1 - P_D) / (1 - r P_D),
    r_t             the new probability of existence: beta summed, plus missed.

`associate` computes these sums exactly, without visiting the events (`marginals`). Within a
track, model j shares detection i in proportion to N_ji (`update`), ``beta_i|j ~ beta_i N_ji /
f_i`` and ``mu_j ~ c_j (beta_0 + sum_i beta_i N_ji / f_i)``, moment-matched in each model.

All arrays are float64 and C-contiguous.
"""

from __future__ import annotations

import math

import numpy as np

from .arrays import BoolArray, FloatArray, IntArray
from .jit import kernel
from .marginals import marginals
from .small_matrices import (
    add_jitter_each,
    cholesky_with_jitter,
    gain,
    innovation_covariance,
    is_psd,
    joseph,
    whitened_square,
)

OPENS_GATE = 0.01
"""A model less probable than this opens no gate for a shared detection."""

LOG_2PI = math.log(2.0 * math.pi)


@kernel
def likelihoods(
    h: FloatArray,
    H: FloatArray,
    P: FloatArray,
    c: FloatArray,
    z: FloatArray,
    R: FloatArray,
    threshold: float = np.inf,
) -> tuple[FloatArray, FloatArray]:
    """See `jipda.likelihoods`: mixture and nis (T, D). A pair whose nis is sure to be above
    `threshold` has none: mixture 0, nis infinite."""
    T, M, m = h.shape
    D, n = len(z), P.shape[2]
    mixture, least = np.zeros((T, D)), np.full((T, D), np.inf)
    PHt, nothing, S0 = np.empty((n, m)), np.zeros((m, m)), np.empty((M, m, m))
    S, L, v, w = np.empty((m, m)), np.zeros((m, m)), np.empty(m), np.empty(m)
    for t in range(T):
        for j in range(M):
            innovation_covariance(P[t, j], H[t % H.shape[0], j], nothing, PHt, S0[j])
        for d in range(D):
            # nis is at least v_r^2 / S_rr: most fixes are far from most tracks.
            near = threshold == np.inf
            j = 0
            while not near and j < M:
                near = c[t, j] > OPENS_GATE
                for r in range(m):
                    gap = z[d, r] - h[t, j, r]
                    near = near and not gap * gap > threshold * (S0[j, r, r] + R[d, r, r])
                j += 1
            if not near:
                continue
            for j in range(M):
                for r in range(m):
                    v[r] = z[d, r] - h[t, j, r]
                    for s in range(m):
                        S[r, s] = S0[j, r, s] + R[d, r, s]
                if not cholesky_with_jitter(S, L):
                    continue
                nis = whitened_square(L, v, w)
                value = -0.5 * (nis + m * LOG_2PI)
                for r in range(m):
                    value -= math.log(L[r, r])
                mixture[t, d] += c[t, j] * math.exp(value)
                if c[t, j] > OPENS_GATE and nis < least[t, d]:
                    least[t, d] = nis
    return mixture, least


def associate(
    ratio: FloatArray,
    nis: FloatArray,
    existence: FloatArray,
    detection_probability: FloatArray,
    threshold: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return beta (T, D), missed (T,) and the new existence (T,) of the joint events above.

    :param ratio: (T, D) f / lambda.
    :param nis: (T, D) normalised innovation squared; pairs above `threshold` are impossible.
    :param existence: (T,) before the scan.
    :param detection_probability: (T,) of a target that exists.
    """
    detected = existence * detection_probability
    beta, none = marginals(detected[:, None] * ratio, 1.0 - detected, nis <= threshold)
    missed = none * existence * (1.0 - detection_probability) / (1.0 - detected)
    # What is rounded adds up to a little more than 1.
    return beta, missed, np.minimum(missed + beta.sum(axis=1), 1.0)


def update(
    x: FloatArray,
    P: FloatArray,
    c: FloatArray,
    h: FloatArray,
    H: FloatArray,
    z: FloatArray,
    R: FloatArray,
    beta: FloatArray,
    missed: FloatArray,
    considered: BoolArray,
) -> tuple[FloatArray, FloatArray, FloatArray, int]:
    """`jipda.update` of each track: x (T, M, n), P (T, M, n, n), mu (T, M), covariances repaired.

    h (T, M, m) expected; z (D, m); R (D, m, m); beta (T, D) and missed (T,) as of `associate`:
    they need not sum to one. considered (n,).
    """
    x1, P1, mu, lost, clear = _update(x, P, c, h, H, z, R, beta, missed, considered)
    if clear:
        return x1, P1, mu, 0
    spoilt = P1[lost]
    repairs = int(np.count_nonzero(add_jitter_each(spoilt)))
    P1[lost] = spoilt
    return x1, P1, mu, repairs


@kernel
def _update(
    x: FloatArray,
    P: FloatArray,
    c: FloatArray,
    h: FloatArray,
    H: FloatArray,
    z: FloatArray,
    R: FloatArray,
    beta: FloatArray,
    missed: FloatArray,
    considered: BoolArray,
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray, bool]:
    """`update`, but lost (T, M) are the covariances that are none any more, and are yet to be
    repaired; and whether there is no such."""
    T, M, n = x.shape
    D, m = z.shape
    x1, P1, mu = x.copy(), P.copy(), c.copy()
    lost, clear = np.zeros((T, M), dtype=np.bool_), True
    log, shift = np.empty((D, M)), np.empty((D, M, n))
    after, nothing = np.empty((D, M, n, n)), np.zeros((m, m))
    PHt, K, KR = np.empty((n, m)), np.empty((n, m)), np.empty((n, m))
    A, AP, root = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))
    S, S0, L = np.empty((m, m)), np.empty((m, m)), np.zeros((m, m))
    v, w, mean = np.empty(m), np.empty(m), np.empty(n)
    share, weight = np.empty((D, M)), np.empty(M)
    for t in range(T):
        exists = missed[t]
        for d in range(D):
            exists += beta[t, d]
        if not exists > missed[t]:
            continue
        for j in range(M):
            innovation_covariance(P[t, j], H[t % H.shape[0], j], nothing, PHt, S0)
            for d in range(D):
                if not beta[t, d] > 0.0:
                    continue
                log[d, j] = -np.inf
                for r in range(m):
                    v[r] = z[d, r] - h[t, j, r]
                    for s in range(m):
                        S[r, s] = S0[r, s] + R[d, r, s]
                for a in range(n):
                    shift[d, j, a] = 0.0
                if not cholesky_with_jitter(S, L):
                    continue
                log[d, j] = -0.5 * whitened_square(L, v, w)
                for r in range(m):
                    log[d, j] -= math.log(L[r, r])
                gain(PHt, L, K)
                for a in range(n):
                    for r in range(m):
                        if considered[a]:
                            K[a, r] = 0.0
                        shift[d, j, a] += K[a, r] * v[r]
                joseph(P[t, j], K, H[t % H.shape[0], j], R[d], A, AP, KR, after[d, j])
        for j in range(M):
            weight[j] = missed[t] / exists
        for d in range(D):
            if not beta[t, d] > 0.0:
                continue
            top, total = -np.inf, 0.0
            for j in range(M):
                if c[t, j] > 0.0:
                    top = max(top, log[d, j])
            for j in range(M):
                total += c[t, j] * math.exp(log[d, j] - top) if c[t, j] > 0.0 else 0.0
            for j in range(M):
                share[d, j] = beta[t, d] / exists * math.exp(log[d, j] - top - math.log(total))
                weight[j] += share[d, j]
        total = 0.0
        for j in range(M):
            mu[t, j] = c[t, j] * weight[j]
            total += mu[t, j]
            if not (weight[j] > 0.0 and weight[j] < np.inf):
                continue
            for a in range(n):
                mean[a] = 0.0
                for d in range(D):
                    if beta[t, d] > 0.0 and share[d, j] > 0.0:
                        mean[a] += share[d, j] / weight[j] * shift[d, j, a]
                x1[t, j, a] = x[t, j, a] + mean[a]
            for a in range(n):
                for b in range(a + 1):
                    value = missed[t] / exists / weight[j] * P[t, j, a, b] - mean[a] * mean[b]
                    for d in range(D):
                        if beta[t, d] > 0.0 and share[d, j] > 0.0:
                            value += (
                                share[d, j]
                                / weight[j]
                                * (after[d, j, a, b] + shift[d, j, a] * shift[d, j, b])
                            )
                    P1[t, j, a, b] = value
                    P1[t, j, b, a] = value
            lost[t, j] = not is_psd(P1[t, j], root)
            clear = clear and not lost[t, j]
        for j in range(M):
            mu[t, j] /= total
    return x1, P1, mu, lost, clear


@kernel
def nearest_older(
    mean: FloatArray, covariance: FloatArray, ids: IntArray, free: BoolArray, firm: BoolArray
) -> tuple[IntArray, FloatArray]:
    """For each track (T,) the older one that is nearest, -1 for none, and how far it is
    (Mahalanobis distance squared of their difference).

    mean (T, 2), covariance (T, 2, 2); ids (T,) rise with age; of `free` (T,) tracks alone; a
    `firm` (T,) one is compared with firm ones only.
    """
    T = len(ids)
    partner, distance = np.full(T, -1, dtype=np.int64), np.full(T, np.inf)
    for t in range(T):
        for u in range(T):
            if not (free[t] and free[u] and ids[u] < ids[t] and (firm[u] or not firm[t])):
                continue
            x, y = mean[t, 0] - mean[u, 0], mean[t, 1] - mean[u, 1]
            a = covariance[t, 0, 0] + covariance[u, 0, 0]
            b = covariance[t, 0, 1] + covariance[u, 0, 1]
            d = covariance[t, 1, 1] + covariance[u, 1, 1]
            # By the Cholesky factor, written out.
            y -= b / a * x
            now = x * x / a + y * y / (d - b / a * b)
            if now < distance[t]:
                partner[t], distance[t] = u, now
    return partner, distance


@kernel
def log_odds(existence: FloatArray) -> FloatArray:
    """ln r / (1 - r) of probabilities (T,), minus infinity at 0."""
    out = np.empty(len(existence))
    for t in range(len(existence)):
        out[t] = -np.inf
        if existence[t] > 0.0:
            out[t] = math.log(existence[t]) - math.log(max(1.0 - existence[t], 1e-300))
    return out
