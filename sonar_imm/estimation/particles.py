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

"""Weighted particles: weights kept as logarithms, how many particles count, moments, resampling.

A likelihood of many samples underflows long before its logarithm does anything unusual, so
weights travel as logarithms and leave them only where a sum is needed (`normalise`). The set
``{x_n, w_n}`` stands for the density ``sum_n w_n delta(x - x_n)``; expectations are weighted sums.

Shapes: N particles, n states. ``x (n, N)``, ``w (N,)`` summing to one. Leading dimensions are
allowed everywhere: ``x (..., n, N)``, ``w (..., N)``.

**Resampling** makes of weighted particles equally weighted ones with the same expectations.
A particle filter multiplies the weights of its particles at every step, and after a while one
particle has them all. Resampling draws `count` particles so that particle n, of weight w_n, is
drawn ``count w_n`` times *on average*. All schemes here are unbiased in that sense, and differ in
how much the numbers of copies scatter about it:

`multinomial`
    Independent draws: the numbers of copies are multinomial. The textbook scheme, and the worst.
`residual`
    floor(count w_n) copies for certain, and independent draws for the fractions that are left.
`stratified`
    One uniform draw in each of `count` equal slices of the cumulative weights.
`systematic`
    One uniform draw for all slices together: every particle has floor(count w_n) or one more
    copies, which no scheme can better. One random number in all. (What one draw shares it also
    shifts: all slices are read a little left or right together, by 1 / count at the most.)

All have one signature, ``scheme(weights, count, rng) -> indices``: weights (n,) not negative, not
all zero, in any scale; indices (count,) in ascending order, never one of a particle of zero
weight. ValueError for weights that are no weights.

All but `residual` invert the cumulative weights at points in [0, 1) (`invert`).

Reference: Douc, Cappe, Moulines, *Comparison of resampling schemes for particle filtering*, ISPA
2005.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from .arrays import FloatArray, IndexArray

Scheme = Callable[[ArrayLike, int, np.random.Generator], IndexArray]


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


def multinomial(weights: ArrayLike, count: int, rng: np.random.Generator) -> IndexArray:
    """Independent draws. Sorted uniforms come from exponential spacings, in O(n + count)."""
    spacings = np.cumsum(rng.standard_exponential(count + 1))
    return invert(np.cumsum(_checked(weights)), spacings[:-1] / spacings[-1])


def residual(weights: ArrayLike, count: int, rng: np.random.Generator) -> IndexArray:
    """Certain copies first, independent draws for the rest."""
    w = _checked(weights)
    expected = count * w / w.sum()
    certain = np.floor(expected)
    copies = certain.astype(np.intp)
    left = count - int(copies.sum())
    if left > 0:
        np.add.at(copies, multinomial(expected - certain, left, rng), 1)
    return np.repeat(np.arange(len(w)), copies)


def stratified(weights: ArrayLike, count: int, rng: np.random.Generator) -> IndexArray:
    """One draw in each of `count` slices."""
    return invert(np.cumsum(_checked(weights)), (np.arange(count) + rng.random(count)) / count)


def systematic(weights: ArrayLike, count: int, rng: np.random.Generator) -> IndexArray:
    """The same draw in each of `count` slices.

    >>> import numpy as np
    >>> systematic([0.5, 0.25, 0.25], 4, np.random.default_rng(1)).tolist()
    [0, 0, 1, 2]
    """
    return invert(np.cumsum(_checked(weights)), (np.arange(count) + rng.random()) / count)


SCHEMES: dict[str, Scheme] = {
    'multinomial': multinomial,
    'residual': residual,
    'stratified': stratified,
    'systematic': systematic,
}


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
