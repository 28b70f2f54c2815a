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

"""Systematic errors in a Kalman filter: constants that are considered, and the update that leaves
them alone.

An error such as a receiver that stands a metre off, or a clock that is half a millisecond late, is
the same in every measurement. It does not average out, and a larger measurement variance does not
model it. It belongs into the state as a constant b. Where the measurements determine b it is
*estimated* like any state. Where they hardly can, or where its stated variance is a guess, it is
*considered* (Schmidt, 1966): b keeps its mean and its variance for ever, and only its covariance
with the rest of the state is kept up, so that the covariance of the rest is right. The gain
is the Kalman gain with the rows of b set to zero.

A considered b has the same mean and covariance in all models, targets and times. So models mix it
with no effect (`imm.mix` needs nothing new), and targets share it without counting data twice.

Source: S. F. Schmidt, "Application of state-space methods to navigation problems", Advances in
Control Systems 3, 1966; A. H. Jazwinski, *Stochastic Processes and Filtering Theory*, 1970,
sec. 8.3.
"""

from __future__ import annotations

import math

import numpy as np

from .arrays import BoolArray, FloatArray
from .covariance import JITTER, LIMIT
from .jit import kernel


def consider_update(
    x: FloatArray,
    P: FloatArray,
    H: FloatArray,
    R: FloatArray,
    innovation: FloatArray,
    estimated: BoolArray,
) -> tuple[FloatArray, FloatArray]:
    """The Schmidt-Kalman update of x (n,), P (n, n) with H (m, n), R (m, m), innovation (m,).

    estimated (n,): False where a component is only considered. S holds the considered errors, and
    ``P <- P - K H P - (K H P)' + K S K'`` is the covariance for any gain K; it is symmetrised,
    since the antisymmetric part of rounding grows tenfold in twenty steps. Gives x and P.
    """
    PHt = P @ H.T
    S = H @ PHt + R
    K = np.linalg.solve(S, PHt.T).T * np.asarray(estimated, np.float64)[:, None]
    KHP = K @ PHt.T
    updated = P - KHP - KHP.T + K @ S @ K.T
    return x + K @ innovation, 0.5 * (updated + updated.T)


@kernel
def consider_scalar(
    x: FloatArray,
    P: FloatArray,
    h: FloatArray,
    R: float,
    innovation: float,
    estimated: BoolArray,
    PHt: FloatArray,
) -> float:
    """`consider_update` in place for one number: x (n,), P (n, n), h (n,) the row of H, R its
    variance; PHt (n,) is scratch. Gives the log-density of the innovation, -inf where its variance
    is not positive and finite, with x and P as they were."""
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


def consider_models(
    x: FloatArray,
    P: FloatArray,
    c: FloatArray,
    innovation: FloatArray,
    H: FloatArray,
    R: FloatArray,
    estimated: BoolArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, BoolArray]:
    """`imm.update` with considered components: x (T, M, n), P (T, M, n, n), c (T, M), innovation
    (T, M, m), H (M, m, n), R (T, m, m). Gives x, P, mu, the NIS (T,) of the mixture and whether
    (T,) it was finite."""
    PHt = P @ np.swapaxes(H, -1, -2)
    S = H @ PHt + R[:, None]
    x1, P1 = x.copy(), P.copy()
    for t, j in np.ndindex(*c.shape):
        x1[t, j], P1[t, j] = consider_update(
            x[t, j], P[t, j], H[j], R[t], innovation[t, j], estimated
        )
    squared = np.einsum(
        'tjm,tjm->tj', innovation, np.linalg.solve(S, innovation[..., None])[..., 0]
    )
    with np.errstate(divide='ignore'):
        weight = np.log(c) - 0.5 * (squared + np.linalg.slogdet(2.0 * np.pi * S)[1])
    share = np.exp(weight - weight.max(axis=1, keepdims=True))
    mean = np.einsum('tj,tjm->tm', c, innovation)
    spread = innovation - mean[:, None]
    S_mix = np.einsum('tj,tjmk->tmk', c, S + spread[..., :, None] * spread[..., None, :])
    nis = np.einsum('tm,tm->t', mean, np.linalg.solve(S_mix, mean[..., None])[..., 0])
    return x1, P1, share / share.sum(axis=1, keepdims=True), nis, np.asarray(np.isfinite(nis))
