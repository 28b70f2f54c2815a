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

"""Weighted particles: weights kept as logarithms, how many particles count, moments.

A likelihood of many samples underflows long before its logarithm does anything unusual, so
weights travel as logarithms and leave them only where a sum is needed (`normalise`). The set
``{x_n, w_n}`` stands for the density ``sum_n w_n delta(x - x_n)``; expectations are weighted sums.

Shapes: N particles, n states. ``x (n, N)``, ``w (N,)`` summing to one. Leading dimensions are
allowed everywhere: ``x (..., n, N)``, ``w (..., N)``.
"""

from __future__ import annotations

import numpy as np

from .arrays import FloatArray


def normalise(log_weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """w (..., N) summing to one, and ``log sum_n exp(log_weights_n)`` (...,).

    Where every weight is zero (-inf) nothing is known of the particles: w is uniform and the
    logarithm of the sum is -inf.

    >>> import numpy as np
    >>> w, total = normalise(np.log([1.0, 3.0]))
    >>> w.round(6).tolist(), round(float(total), 6)  # log 4
    ([0.25, 0.75], 1.386294)
    """
    best = np.max(log_weights, axis=-1, keepdims=True)
    dead = ~np.isfinite(best)
    w = np.where(dead, 1.0, np.exp(log_weights - np.where(dead, 0.0, best)))
    total = w.sum(axis=-1, keepdims=True)
    log_sum = np.where(dead, -np.inf, np.where(dead, 0.0, best) + np.log(total))
    return w / total, log_sum[..., 0]


def effective_sample_size(w: FloatArray) -> FloatArray:
    """``1 / sum_n w_n^2``, (...,): N for equal weights, 1 when one particle has everything.

    (``1 / sum_n w_n``, sometimes seen in print, is always one.)

    >>> import numpy as np
    >>> float(effective_sample_size(np.array([0.5, 0.5, 0.0, 0.0])))
    2.0
    """
    return np.asarray(1.0 / np.sum(np.square(w), axis=-1))


def mean(x: FloatArray, w: FloatArray) -> FloatArray:
    """The weighted mean, (..., n)."""
    return np.einsum('...N,...aN->...a', w, x)


def covariance(x: FloatArray, w: FloatArray) -> FloatArray:
    """The covariance of the weighted set itself, (..., n, n), about its mean."""
    spread = x - mean(x, w)[..., None]
    return np.einsum('...N,...aN,...bN->...ab', w, spread, spread)
