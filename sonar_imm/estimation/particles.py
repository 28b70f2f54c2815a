# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Weighted particles: weights kept as logarithms, how many particles count, resampling.

A likelihood of many samples underflows long before its logarithm does anything unusual, so
weights travel as logarithms and leave them only where a sum is needed (`normalise`). The set
``{x_n, w_n}`` stands for the density ``sum_n w_n delta(x - x_n)``; expectations are weighted sums.

Shapes: N particles, ``w (..., N)`` summing to one.

**Resampling** makes of weighted particles equally weighted ones with the same expectations.
A particle filter multiplies the weights of its particles at every step, and after a while one
particle has them all. `systematic` draws `count` particles so that particle n, of weight w_n, is
drawn ``count w_n`` times *on average*, and floor(count w_n) or one more times in every case, which
no other scheme can better. It takes one uniform draw for all `count` equal slices of the
cumulative weights. (What one draw shares it also shifts: all slices are read a little left or
right together, by 1 / count at the most.)

Reference: Douc, Cappe, Moulines, *Comparison of resampling schemes for particle filtering*, ISPA
2005.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .arrays import FloatArray, IndexArray


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
    w = np.exp(np.where(dead, 0.0, log_weights - np.where(dead, 0.0, best)))
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


def systematic(weights: ArrayLike, count: int, rng: np.random.Generator) -> IndexArray:
    """Indices (count,), ascending, of particles drawn by weights (n,) in any scale, never one of
    weight zero. ValueError for weights that are negative, not finite or all zero.

    >>> import numpy as np
    >>> systematic([0.5, 0.25, 0.25], 4, np.random.default_rng(1)).tolist()
    [0, 0, 1, 2]
    """
    return invert(np.cumsum(_checked(weights)), (np.arange(count) + rng.random()) / count)


def invert(cumulative: FloatArray, points: FloatArray) -> IndexArray:
    """The particle at each point in [0, 1): the first n with ``cumulative[n] > point * total``.

    cumulative (n,): running sums of weights, in any scale; points (count,), ascending. A point
    that rounding puts at the very end belongs to the last particle that has weight.
    """
    total = cumulative[-1]
    last = int(np.searchsorted(cumulative, total, side='left'))
    found = np.searchsorted(cumulative, points * total, side='right')
    return np.minimum(found, last)


def _checked(weights: ArrayLike) -> FloatArray:
    w = np.asarray(weights, dtype=np.float64)
    if w.ndim != 1 or not len(w):
        raise ValueError(f'weights are a list of numbers, these have shape {w.shape}')
    total = w.sum()
    if not np.isfinite(total) or (w < 0.0).any() or not total > 0.0:
        raise ValueError('weights must be finite, not negative, and not all zero')
    return w
