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

"""What fixes do to their tracks, compiled: many fixes are few numbers each.

All floats are float64, all arrays C-contiguous; T tracks of M models with n states. No kernel
changes its arguments.
"""

from __future__ import annotations

import math

import numpy as np

from ...estimation import imm_kernels
from ...estimation.adaptation import row_sum
from ...estimation.arrays import BoolArray, FloatArray, IntArray
from ...estimation.consistency import FARTHEST
from ...estimation.covariance import JITTER, LIMIT
from ...estimation.jit import kernel

Sums = tuple[float, float, float, float, float]
"""The fields of `state.FixConsistency`."""


@kernel
def expected(x: FloatArray, H: FloatArray) -> FloatArray:
    """What each model expects, (T, M, m): x (T, M, n), H (1, M, m, n)."""
    T, M, n = x.shape
    m = H.shape[2]
    h = np.empty((T, M, m))
    for t in range(T):
        for j in range(M):
            for r in range(m):
                h[t, j, r] = 0.0
                for a in range(n):
                    h[t, j, r] += H[0, j, r, a] * x[t, j, a]
    return h


@kernel
def finite(x: FloatArray, P: FloatArray) -> BoolArray:
    """Which tracks (T,) have finite numbers only: x (T, M, n), P (T, M, n, n)."""
    T = len(x)
    out = np.empty(T, dtype=np.bool_)
    for t in range(T):
        out[t] = True
        # A sum of finite numbers may overflow, so each is asked.
        for value in x[t].flat:
            out[t] = out[t] and math.isfinite(value)
        for value in P[t].flat:
            out[t] = out[t] and math.isfinite(value)
    return out


def update(
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    h: FloatArray,
    H: FloatArray,
    z: FloatArray,
    R: FloatArray,
    tracks: IntArray,
    detection: IntArray,
    nis: FloatArray,
    nis_dof: np.ndarray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, np.ndarray, int]:
    """Update `tracks` (t,), each with its `detection` (t,) of z (D, 2), R (D, 2, 2): x (T, M, n),
    P (T, M, n, n), mu (T, M); h (T, M, 2) expected. Gives x, P, mu, nis (T,) and nis_dof (T,) of
    all tracks, and how many covariances were repaired."""
    innovation = z[detection][:, None] - h[tracks]
    after = imm_kernels.update_targets(x, P, mu, innovation, H, R, tracks, detection)
    nis, nis_dof = nis.copy(), nis_dof.copy()
    hit = tracks[after.ok]
    nis[hit] += after.nis[after.ok]
    nis_dof[hit] += np.uint16(2)
    repairs = int(np.count_nonzero(after.repaired))
    return after.x, after.P, after.mu, nis, nis_dof, repairs


@kernel
def scores(
    score: FloatArray,
    fit: FloatArray,
    chosen: IntArray,
    excluded: BoolArray,
    missed: float,
    gain: float,
    log_clutter: float,
) -> FloatArray:
    """The score (T,) with ln of P_D N(nu; 0, S) / clutter for a hit, ln of 1 - P_D, which is
    `missed`, for a miss; gain: ln of P_D / (1 - P_D). Not for tracks that are `excluded` (T,)."""
    score = score.copy()
    for t in range(len(score)):
        if not excluded[t]:
            score[t] += missed
        if chosen[t] >= 0:
            score[t] += fit[t, chosen[t]] + gain
            score[t] -= log_clutter
    return score


@kernel
def _shortening(first: float, second: float) -> float:
    """What a whitened innovation is multiplied by, so that it is as long as it may be."""
    square = first * first + second * second
    return math.sqrt(2.0 * FARTHEST / square) if square > 2.0 * FARTHEST else 1.0


@kernel
def watch(
    mean: FloatArray,
    covariance: FloatArray,
    z: FloatArray,
    R: FloatArray,
    tracks: IntArray,
    detection: IntArray,
    tentative: BoolArray,
    white: FloatArray,
    sums: Sums,
    memory: float,
) -> tuple[FloatArray, Sums]:
    """Whiten the innovations that each of `tracks` (t,) sees in its `detection` (t,), by the mean
    (T, 2) and covariance (T, 2, 2) of the fix that its mixture expects. Gives white (T, 2) with
    them, and the sums with those of confirmed tracks, of which about the last `memory` count;
    tentative (T,), the rest as in `update`.

    An innovation longer than `FARTHEST` allows is a sharp turn and says nothing of noise: in the
    sums it is shortened to that."""
    firm, paired = np.empty(2 * len(tracks)), np.empty(2 * len(tracks))
    count, pairs = 0, 0
    white = white.copy()
    for k in range(len(tracks)):
        t, row = tracks[k], detection[k]
        # The inverse of the Cholesky factor of 2 x 2, written out.
        a = math.sqrt(covariance[t, 0, 0] + R[row, 0, 0])
        b = (covariance[t, 1, 0] + R[row, 1, 0]) / a
        c = math.sqrt(covariance[t, 1, 1] + R[row, 1, 1] - b * b)
        first = (z[row, 0] - mean[t, 0]) / a
        second = (z[row, 1] - mean[t, 1] - b * first) / c
        if not tentative[t] and math.isfinite(first) and math.isfinite(second):
            kept = _shortening(first, second)
            firm[count], firm[count + 1] = kept * first, kept * second
            if math.isfinite(white[t, 0]) and math.isfinite(white[t, 1]):
                kept = _shortening(white[t, 0], white[t, 1])
                for r in range(2):
                    paired[pairs + r] = kept * white[t, r]
                    # Those that have a partner come first.
                    firm[count + r], firm[pairs + r] = firm[pairs + r], firm[count + r]
                pairs += 2
            count += 2
        white[t, 0], white[t, 1] = first, second
    if not count:
        return white, sums
    # What is summed takes the place of what it is made of.
    cross = np.empty(pairs)
    for k in range(count):
        square = firm[k] * firm[k]
        if k < pairs:
            cross[k] = firm[k] * paired[k]
            paired[k] = square + paired[k] * paired[k]
        firm[k] = square
    total = sums[0] + count // 2
    kept = memory / total if total > memory else 1.0
    return white, (
        total * kept,
        (sums[1] + 0.5 * row_sum(firm[:count])) * kept,
        (sums[2] + pairs // 2) * kept,
        (sums[3] + row_sum(cross)) * kept,
        (sums[4] + 0.5 * row_sum(paired[:pairs])) * kept,
    )


@kernel
def _consider_scalar(
    x: FloatArray,
    P: FloatArray,
    h: FloatArray,
    R: float,
    innovation: float,
    estimated: BoolArray,
    PHt: FloatArray,
) -> float:
    """`consider.consider_update` in place for one number: x (n,), P (n, n), h (n,) the row of H,
    R its variance; PHt (n,) is scratch. Gives the log-density of the innovation, -inf where its
    variance is not positive and finite, with x and P as they were."""
    n = len(x)
    S = R
    for a in range(n):
        PHt[a] = 0.0
    for b in range(n):
        if h[b] != 0.0:
            for a in range(n):
                PHt[a] += P[a, b] * h[b]
    for a in range(n):
        S += h[a] * PHt[a]
    if not (S > 0.0 and math.isfinite(S)):
        return -math.inf
    if not R > LIMIT * S:  # the rule of `covariance` for values that are too good
        S += JITTER * S
    for a in range(n):
        if estimated[a]:
            x[a] += PHt[a] * innovation / S
    for a in range(n):
        for b in range(a + 1):
            # K_a (HP)_b and its mirror image, plus K_a S K_b where both have a gain
            if estimated[a] or estimated[b]:
                value = 0.5 * (P[a, b] + P[b, a]) - PHt[a] * PHt[b] / S
                P[a, b] = value
                P[b, a] = value
    return -0.5 * (innovation * innovation / S + math.log(2.0 * math.pi * S))


@kernel
def update_heights(
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    H: FloatArray,
    place: int,
    value: FloatArray,
    gain: FloatArray,
    rest: FloatArray,
    tracks: IntArray,
    weight: FloatArray,
    estimated: BoolArray,
    threshold: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Update `tracks` (t,), each by one number: `value` (t,) is z, at `place` in the state, less
    `gain` (t, 2) times x and y as H (1, M, 2, n) measures them, with variance `rest` (t,). Gives x
    (T, M, n), P (T, M, n, n), mu (T, M) and the NIS (t,) of the mixture, by which nothing changes
    where it is above `threshold`.

    weight (t,): probability that the number is the track's. Below 1 each model becomes the mixture
    of what it is with it and without. estimated (n,): see `estimation.consider`."""
    x, P, mu = x.copy(), P.copy(), mu.copy()
    M, n = x.shape[1], x.shape[2]
    h, innovation = np.empty((M, n)), np.empty(M)
    density, scratch = np.empty(M), np.empty(n)
    nis = np.empty(len(tracks))
    for k in range(len(tracks)):
        t = tracks[k]
        mean, square = 0.0, 0.0
        for j in range(M):
            innovation[j] = value[k]
            for a in range(n):
                h[j, a] = -gain[k, 0] * H[0, j, 0, a] - gain[k, 1] * H[0, j, 1, a]
                if a == place:
                    h[j, a] += 1.0
                innovation[j] -= h[j, a] * x[t, j, a]
            S = rest[k]
            for a in range(n):
                for b in range(n):
                    S += h[j, a] * P[t, j, a, b] * h[j, b]
            mean += mu[t, j] * innovation[j]
            square += mu[t, j] * (S + innovation[j] * innovation[j])
        nis[k] = mean * mean / (square - mean * mean)
        if not nis[k] <= threshold:
            continue
        without_x, without_P = x[t].copy(), P[t].copy()
        most = -math.inf
        for j in range(M):
            density[j] = _consider_scalar(
                x[t, j], P[t, j], h[j], rest[k], innovation[j], estimated, scratch
            )
            if mu[t, j] > 0.0:
                most = max(most, density[j])
        if most == -math.inf:
            nis[k] = math.inf
            continue
        total = 0.0
        for j in range(M):
            density[j] = math.exp(density[j] - most) if mu[t, j] > 0.0 else 0.0
            total += mu[t, j] * density[j]
        for j in range(M):
            own = weight[k] * density[j] / total
            none = 1.0 - weight[k]
            mu[t, j] *= own + none
            if weight[k] < 1.0:
                own /= own + none
                for a in range(n):
                    for b in range(n):
                        spread = (x[t, j, a] - without_x[j, a]) * (x[t, j, b] - without_x[j, b])
                        P[t, j, a, b] = (
                            own * P[t, j, a, b]
                            + (1.0 - own) * without_P[j, a, b]
                            + own * (1.0 - own) * spread
                        )
                for a in range(n):
                    x[t, j, a] = own * x[t, j, a] + (1.0 - own) * without_x[j, a]
    return x, P, mu, nis
