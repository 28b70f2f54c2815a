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

"""Covariances that rounding cannot make indefinite.

Double precision keeps sixteen digits of a covariance. Where a state is known 1e16 times better in
one direction than its components are one by one, the covariance cannot hold both, and the usual
formulas give a matrix with negative eigenvalues. Joseph's form is no cure: it squares what
rounding did to the gain.

So every covariance keeps to one stated limit. It is *sound* when no eigenvalue of its correlation
matrix is below `LIMIT`: then Cholesky's method finds a factor, in whatever order it rounds. (A
component without variance is sound when it has no covariance either.) `propagate` and `correct`
compute in covariance form, which is the fastest, and try Cholesky's method on what they get. Where
the limit is passed they repair, and tell, so that callers can count:

1. The step is computed again in square-root form, from ``P = L L'``. The result is a sum of
   squares whose rounding is small beside its *own* diagonal, however small that has become.
2. The diagonal is lifted by the share `JITTER`, more if need be. Nothing is thereby claimed to be
   known better than before.

The innovation covariance ``S = H P H' + R`` obeys the same limit, and no measured value has less
than `LIMIT` of it as its own noise: there R is raised by `JITTER` of S's diagonal, so that a
perfect measurement leaves a variance, and can be repeated.

`small_matrices` compiles the same rules. Reference: Bierman, *Factorization Methods for Discrete
Sequential Estimation* (1977); Kailath, Sayed, Hassibi, *Linear Estimation* (2000), ch. 12.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .arrays import BoolArray, FloatArray

LIMIT = 1e-14
"""Least eigenvalue of a correlation matrix. Rounding in Cholesky's method changes it by at most
n (n + 1) / 2^53, 2e-15 for four states, so that up to eight states a sound covariance has a
factor."""

JITTER = 1e-13
"""What a repair adds to the diagonal, as a share of it; ten times more until it is enough."""


class CovarianceError(ValueError):
    """A covariance that is not finite or not positive definite. `where` (...) is True for the bad
    ones of the batch."""

    def __init__(self, what: str, where: BoolArray):
        self.where = where
        many = f'{int(where.sum())} of {where.size}: ' if where.size > 1 else ''
        super().__init__(f'{many}{what}')


class Corrected(NamedTuple):
    """P (..., n, n) after a measurement; gain (..., n, m); factor (..., m, m), the lower Cholesky
    factor of S (..., m, m); repaired (...,); usable (...,) False where S has no factor, P is then
    the prediction and the gain zero."""

    P: FloatArray
    gain: FloatArray
    factor: FloatArray
    S: FloatArray
    repaired: BoolArray
    usable: BoolArray


def transpose(matrix: FloatArray) -> FloatArray:
    """Matrix transpose of the last two axes."""
    return np.swapaxes(matrix, -1, -2)


def symmetrise(P: FloatArray) -> FloatArray:
    """The symmetric part of `P` (..., n, n), equal to the last bit on both sides."""
    return 0.5 * (P + transpose(P))


def _diagonal(matrix: FloatArray) -> FloatArray:
    return np.diagonal(matrix, axis1=-2, axis2=-1)


def solve(matrix: FloatArray, columns: FloatArray) -> FloatArray:
    """``matrix^-1 columns``, (..., m, m) and (..., m, q), broadcast over the leading axes."""
    # numpy before 2.0 takes a second argument with one axis less for a stack of vectors.
    missing = max(matrix.ndim - columns.ndim, 0)
    stack = columns.reshape((1,) * missing + columns.shape)
    return np.asarray(np.linalg.solve(matrix, stack), dtype=np.float64)


def is_psd(P: FloatArray) -> BoolArray:
    """Whether each P (..., n, n) keeps to the limit, (...,). False where it is not finite."""
    n = P.shape[-1]
    root = np.zeros_like(P)
    good = np.isfinite(P).all(axis=(-1, -2))
    with np.errstate(all='ignore'):
        for a in range(n):
            for b in range(a):
                value = P[..., a, b] - np.sum(root[..., a, :b] * root[..., b, :b], axis=-1)
                pivot = root[..., b, b]
                good &= (pivot > 0.0) | (P[..., a, b] == 0.0)
                root[..., a, b] = np.where(pivot > 0.0, value / pivot, 0.0)
            own = P[..., a, a]
            rest = own - LIMIT * own - np.sum(np.square(root[..., a, :a]), axis=-1)
            empty = (own == 0.0) & (rest == 0.0)
            good &= empty | (rest > 0.0)
            root[..., a, a] = np.sqrt(np.where(rest > 0.0, rest, 0.0))
    return np.asarray(good)


def add_jitter(P: FloatArray) -> tuple[FloatArray, BoolArray]:
    """`P` (..., n, n) with the diagonals of those lifted that are not sound, and which (...,).

    What no lift makes sound, because it is no covariance at all, stays as it is.
    """
    bad = ~is_psd(P)
    lifted = np.array(P)
    own = np.where(np.eye(P.shape[-1], dtype=bool), P, 0.0)
    left, share = bad.copy(), JITTER
    while left.any() and share < 2.0 * P.shape[-1]:
        lifted[left] = P[left] + share * own[left]
        left &= ~is_psd(lifted)
        share *= 10.0
    lifted[left] = P[left]
    return lifted, bad


def semidefinite_root(P: FloatArray) -> FloatArray:
    """A square root L (..., n, n) of `P`, ``L L' = P``, of which negative eigenvalues count as
    zero. The components' units do not matter."""
    own = _diagonal(P)
    scale = np.sqrt(np.where(own > 0.0, own, 1.0))
    values, vectors = np.linalg.eigh(symmetrise(P) / (scale[..., :, None] * scale[..., None, :]))
    return np.asarray(
        scale[..., :, None] * vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]
    )


def propagate(F: FloatArray, P: FloatArray, Q: FloatArray) -> tuple[FloatArray, BoolArray]:
    """``F P F' + Q`` (..., n, n), and which had to be repaired (...,)."""
    moved = symmetrise(F @ P @ transpose(F) + Q)
    bad = np.asarray(~is_psd(moved) & np.isfinite(moved).all(axis=(-1, -2)))
    if bad.any():
        F, P, Q = (np.broadcast_to(each, moved.shape)[bad] for each in (F, P, Q))
        root = F @ semidefinite_root(P)
        moved[bad] = add_jitter(symmetrise(root @ transpose(root) + Q))[0]
    return moved, bad


def correct(P: FloatArray, H: FloatArray, R: FloatArray) -> Corrected:
    """The covariance P (..., n, n) after a measurement ``H x + v``, ``v ~ N(0, R)``.

    H: (..., m, n); R: (..., m, m), which may be singular.
    """
    cross = H @ P
    S = symmetrise(cross @ transpose(H) + R)
    trusted = is_psd(S) & (_diagonal(R) > LIMIT * _diagonal(S)).all(axis=-1)
    factor = np.linalg.cholesky(np.where(trusted[..., None, None], S, np.eye(S.shape[-1])))
    gain = transpose(solve(transpose(factor), solve(factor, cross)))
    kept = np.eye(P.shape[-1]) - gain @ H
    updated = symmetrise(kept @ P @ transpose(kept) + gain @ R @ transpose(gain))
    bad = np.asarray(~(trusted & is_psd(updated)))
    usable = np.ones(bad.shape, bool)
    if bad.any():
        shapes = (updated.shape, (*bad.shape, *H.shape[-2:]), S.shape)
        P, H, R = (np.broadcast_to(each, shape)[bad] for each, shape in zip((P, H, R), shapes))
        updated[bad], gain[bad], factor[bad], usable[bad] = _correct_root(P, H, R)
    return Corrected(updated, gain, factor, S, bad & usable, usable)


def _correct_root(
    P: FloatArray, H: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, BoolArray]:
    """P, gain, factor and usable of B cases in square-root form: P (B, n, n), H (B, m, n), R (B,
    m, m).

    [[R^1/2, H L], [0, L]] is turned into [[S^1/2, 0], [K S^1/2, L']] by an orthogonal matrix.
    """
    m, n = H.shape[-2:]
    finite: BoolArray = np.ones(len(P), np.bool_)
    for each in (P, H, R):
        finite &= np.isfinite(each).all(axis=(1, 2))
    safe = [np.where(finite[:, None, None], each, 0.0) for each in (P, H, R)]
    root, noise = semidefinite_root(safe[0]), semidefinite_root(safe[2])
    seen = safe[1] @ root
    own = np.square(seen).sum(axis=-1) + np.square(noise).sum(axis=-1)
    usable = finite & (own > 0.0).all(axis=-1)
    floor = np.where(_diagonal(safe[2]) > LIMIT * own, 0.0, JITTER * own)
    after = _triangular(noise, seen, root, floor)
    singular = (np.square(_diagonal(after)[:, :m]) <= LIMIT * own).any(axis=1)
    if singular.any():
        after = _triangular(noise, seen, root, np.where(singular[:, None], JITTER * own, floor))
    factor = np.where(usable[:, None, None], after[:, :m, :m], np.eye(m))
    gain = transpose(solve(transpose(factor), transpose(after[:, m:, :m])))
    updated, _ = add_jitter(symmetrise(after[:, m:, m:] @ transpose(after[:, m:, m:])))
    return (
        np.where(usable[:, None, None], updated, P),
        np.where(usable[:, None, None], gain, 0.0),
        factor,
        usable,
    )


def _triangular(
    noise: FloatArray, seen: FloatArray, root: FloatArray, lifted: FloatArray
) -> FloatArray:
    """Lower triangular T (B, m + n, m + n) with a positive diagonal, ``T T' = A A'``, A =
    [[noise, seen, lifted^1/2], [0, root, 0]]; `lifted` (B, m) is a diagonal."""
    m, n = seen.shape[-2:]
    A = np.zeros((len(root), m + n, m + n + m))
    A[:, :m, :m], A[:, :m, m : m + n], A[:, m:, m : m + n] = noise, seen, root
    A[:, range(m), range(m + n, m + n + m)] = np.sqrt(lifted)
    T = transpose(np.asarray(np.linalg.qr(transpose(A), 'r')))
    return np.asarray(T * np.where(_diagonal(T) < 0.0, -1.0, 1.0)[:, None])
