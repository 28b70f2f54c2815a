# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Covariances that rounding cannot make indefinite.

Double precision keeps sixteen digits of a covariance. Where a state is known 1e16 times better in
one direction than its components are one by one, the covariance cannot hold both, and the usual
formulas give a matrix with negative eigenvalues. Joseph's form is no cure: it squares what
rounding did to the gain.

So every covariance keeps to one stated limit (`is_psd`): no eigenvalue of its correlation matrix
is below `LIMIT`. Then Cholesky's method finds a factor, in whatever order it rounds. (A component
without variance must have no covariance either.) `propagate` and `correct` compute in covariance
form, which is the fastest, and try Cholesky's method on the result. Where the limit is passed they
repair, and say which, so that callers can count:

1. The step is computed again in square-root form, from ``P = L L'``. The result is a sum of
   squares whose rounding is small beside its *own* diagonal, however small that has become.
2. The share `JITTER` is added to the diagonal, more if need be (`add_jitter`). Nothing is thereby
   claimed to be known better than before.

The innovation covariance ``S = H P H' + R`` obeys the same limit, and no measured value has less
than `LIMIT` of it as its own noise: there R is raised by `JITTER` of S's diagonal, so that a
perfect measurement leaves a variance, and can be repeated.

Reference: Bierman, *Factorization Methods for Discrete Sequential Estimation* (1977); Kailath,
Sayed, Hassibi, *Linear Estimation* (2000), ch. 12.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .arrays import BoolArray, FloatArray

LIMIT = 1e-14
"""Least eigenvalue of a correlation matrix. Rounding in Cholesky's method changes it by at most
n (n + 1) / 2^53, 2e-15 for four states, so that up to eight states a covariance within the limit
has a factor."""

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
    return are_sound(np.moveaxis(np.asarray(P, np.float64), (-2, -1), (0, 1)))


def add_jitter(P: FloatArray) -> tuple[FloatArray, BoolArray]:
    """`P` (..., n, n), with larger diagonals where it did not keep to the limit, and which
    (...,) these are.

    What no jitter makes positive definite, because it is no covariance at all, stays as it is.
    """
    n = P.shape[-1]
    batch = np.moveaxis(np.asarray(P, np.float64).reshape(-1, n, n), 0, -1)
    out, repaired = with_jitter(batch)
    return np.moveaxis(out, -1, 0).reshape(P.shape).copy(), repaired.reshape(P.shape[:-2])


def propagate(F: FloatArray, P: FloatArray, Q: FloatArray) -> tuple[FloatArray, BoolArray]:
    """``F P F' + Q`` (..., n, n), and which had to be repaired (...,)."""
    moved = symmetrise(F @ P @ transpose(F) + Q)
    bad = np.asarray(~is_psd(moved) & np.isfinite(moved).all(axis=(-1, -2)))
    if bad.any():
        P, F, Q = (np.broadcast_to(each, moved.shape)[bad] for each in (P, F, Q))
        turned = F @ _roots(P)
        moved[bad] = add_jitter(turned @ transpose(turned) + symmetrise(Q))[0]
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
        cases = (np.broadcast_to(each, shape)[bad] for each, shape in zip((P, H, R), shapes))
        again = [_square_root_correct(*map(np.ascontiguousarray, case)) for case in zip(*cases)]
        updated[bad], gain[bad], factor[bad], usable[bad] = map(np.array, zip(*again))
    return Corrected(updated, gain, factor, S, bad & usable, usable)


def _square_root_correct(
    P: FloatArray, H: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, bool]:
    """P, gain, factor and usable of one case: P (n, n), H (m, n), R (m, m)."""
    m, n = H.shape
    unusable = P, np.zeros((n, m)), np.eye(m), False
    if not all(np.isfinite(each).all() for each in (P, H, R)):
        return unusable
    root, noise = _roots(P), _roots(R)
    seen = H @ root
    own = (seen * seen).sum(axis=1) + (noise * noise).sum(axis=1)
    if not ((own > 0.0) & (own < np.inf)).all():
        return unusable
    raised = ~(np.diag(R) > LIMIT * own)
    for extra in (raised, np.ones(m, np.bool_)):
        more = np.diag(np.sqrt(np.where(extra, JITTER * own, 0.0)))
        blocks = [[noise, seen, more], [np.zeros((n, m)), root, np.zeros((n, m))]]
        A = _triangular(np.block(blocks))
        if (np.square(np.diag(A)[:m]) > LIMIT * own).all():
            break
    factor, cross, rest = A[:m, :m], A[m:, :m], A[m:, m:]
    gain = transpose(solve(transpose(factor), transpose(cross)))
    return add_jitter(rest @ transpose(rest))[0], gain, factor, True


def _roots(P: FloatArray) -> FloatArray:
    """Lower roots (..., n, n) of covariances that may be singular."""
    return np.moveaxis(semidefinite_roots(np.moveaxis(P, (-2, -1), (0, 1))), (0, 1), (-2, -1))


def _triangular(A: FloatArray) -> FloatArray:
    """The lower triangle (r, r) with a diagonal that is not negative and the same ``A A'`` as A
    (r, c)."""
    lower = transpose(np.asarray(np.linalg.qr(transpose(A), mode='r')))
    return np.asarray(lower * np.where(np.diag(lower) < 0.0, -1.0, 1.0))


# -- many small covariances at once, (n, n, ...): numpy runs along the last axes ------------------


def semidefinite_roots(S: FloatArray, columns: int | None = None) -> FloatArray:
    """Return lower roots (n, n, ...), ``S = L L'``, of covariances S (n, n, ...) that may be
    singular: a column without variance is zero; of these the first so many `columns`. Only lower
    triangles are read."""
    count = len(S) if columns is None else columns
    L = np.zeros((len(S), count, *S.shape[2:]))
    for b in range(count):
        pivot = S[b, b] - (L[b, :b] * L[b, :b]).sum(axis=0)
        known = (pivot <= LIMIT * S[b, b]) | ~(pivot > 0.0)
        root = np.sqrt(np.where(known, 0.0, pivot))
        L[b, b] = root
        inverse = np.where(known, 0.0, 1.0 / np.where(known, 1.0, root))
        L[b + 1 :, b] = (S[b + 1 :, b] - (L[b + 1 :, :b] * L[b, :b]).sum(axis=1)) * inverse
    return L


def are_sound(S: FloatArray) -> BoolArray:
    """Return whether each covariance S (n, n, ...) keeps to the limit (...): `is_psd`, by pivots
    without square roots. Only lower triangles are read."""
    n = len(S)
    left = np.array(S)
    good = np.ones(S.shape[2:], np.bool_)
    with np.errstate(invalid='ignore', over='ignore'):  # what is not finite is not sound
        for k in range(n):
            pivot = left[k, k] - LIMIT * S[k, k]
            positive = (pivot > 0.0) & (pivot < np.inf)
            if positive.all():
                if k + 1 < n:
                    column = left[k + 1 :, k]
                    left[k + 1 :, k + 1 :] -= column[:, None] * (column / pivot)
                continue
            # A component without variance must have no covariance either.
            nothing = (S[k, k] == 0.0) & (pivot == 0.0) & ~left[k + 1 :, k].any(axis=0)
            good &= positive | nothing
            column = np.where(positive, left[k + 1 :, k], 0.0)
            left[k + 1 :, k + 1 :] -= column[:, None] * (column / np.where(positive, pivot, 1.0))
    return good


def with_jitter(S: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Return covariances S (n, n, L), with larger diagonals where they did not keep to the limit,
    and which (L,) these are: `add_jitter`. What no jitter cures stays as it is."""
    bad = ~are_sound(S)
    if not bad.any():
        return S, bad
    out, lanes, n = S.copy(), np.flatnonzero(bad), len(S)
    share = JITTER
    while len(lanes) and share < 2.0 * n:
        trial = S[..., lanes].copy()
        trial[range(n), range(n)] *= 1.0 + share
        cured = are_sound(trial)
        out[..., lanes[cured]] = trial[..., cured]
        lanes, share = lanes[~cured], 10.0 * share
    return out, bad
