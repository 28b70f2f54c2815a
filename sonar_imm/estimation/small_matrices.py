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

"""Linear algebra of small matrices, compiled: the pieces of a Kalman update as plain loops.

For matrices of a few rows the call of a library costs more than the arithmetic. Every function
writes into arrays the caller owns, so that nothing is allocated in a loop over models and targets;
only the repairs, which are rare, allocate. `is_psd`, `add_jitter` and the ``square_root_``
functions are the rules that `covariance` explains.
"""

from __future__ import annotations

import math

import numpy as np

from .arrays import BoolArray, FloatArray
from .covariance import JITTER, LIMIT
from .jit import kernel


@kernel
def product(A: FloatArray, B: FloatArray, out: FloatArray) -> None:
    """A B into `out`; A (n, k), B (k, m)."""
    n, m = out.shape
    for a in range(n):
        for b in range(m):
            value = 0.0
            for k in range(A.shape[1]):
                value += A[a, k] * B[k, b]
            out[a, b] = value


@kernel
def product_transposed(A: FloatArray, B: FloatArray, out: FloatArray) -> None:
    """A B^T into `out`; A (n, k), B (m, k)."""
    n, m = out.shape
    for a in range(n):
        for b in range(m):
            value = 0.0
            for k in range(A.shape[1]):
                value += A[a, k] * B[b, k]
            out[a, b] = value


@kernel
def cholesky(S: FloatArray, L: FloatArray) -> bool:
    """Lower Cholesky factor of S into L; False when S is not positive definite by a clear margin
    (`covariance.LIMIT`), or not finite."""
    m = S.shape[0]
    for a in range(m):
        for b in range(a + 1):
            value = S[a, b]
            for k in range(b):
                value -= L[a, k] * L[b, k]
            if a == b:
                if not (value > LIMIT * S[a, a] and value < np.inf):
                    return False
                L[a, a] = math.sqrt(value)
            else:
                L[a, b] = value / L[b, b]
    return True


@kernel
def is_psd(P: FloatArray, L: FloatArray) -> bool:
    """Whether P (n, n) keeps to the limit of `covariance`; False where it is not finite. L (n, n)
    is scratch."""
    # L D L' without square roots: L below the diagonal, L D above it, 1 / D on it.
    n = P.shape[0]
    for a in range(n):
        rest = P[a, a] - LIMIT * P[a, a]
        for b in range(a):
            value = P[a, b]
            for k in range(b):
                value -= L[k, a] * L[b, k]
            if L[b, b] == 0.0 and value != 0.0:
                return False
            L[b, a] = value
            L[a, b] = value * L[b, b]
            rest -= value * L[a, b]
        if rest > 0.0 and rest < np.inf:
            L[a, a] = 1.0 / rest
        elif P[a, a] == 0.0 and rest == 0.0:
            L[a, a] = 0.0
        else:
            return False
    return True


@kernel
def add_jitter(P: FloatArray, L: FloatArray) -> bool:
    """Add to the diagonal of P (n, n), in place, what it lacks to be positive definite; whether
    that was needed. L (n, n) is scratch. A P that is no covariance at all stays as it is."""
    if is_psd(P, L):
        return False
    n = P.shape[0]
    own = np.empty(n)
    for a in range(n):
        own[a] = P[a, a]
    share = JITTER
    while share < 2.0 * n:
        for a in range(n):
            P[a, a] = own[a] + share * own[a]
        if is_psd(P, L):
            return True
        share *= 10.0
    for a in range(n):
        P[a, a] = own[a]
    return True


@kernel
def add_jitter_each(P: FloatArray) -> BoolArray:
    """`add_jitter` each of P (B, n, n) in place: which (B,) needed it."""
    L, needed = np.empty(P.shape[1:]), np.empty(len(P), dtype=np.bool_)
    for b in range(len(P)):
        needed[b] = add_jitter(P[b], L)
    return needed


@kernel
def add_jitter_all(P: FloatArray) -> int:
    """`add_jitter` each of P (M, n, n) in place that is finite: how many needed it."""
    L = np.empty(P.shape[1:])
    repairs = 0
    for j in range(len(P)):
        if not is_psd(P[j], L) and all_finite(P[j]):
            add_jitter(P[j], L)
            repairs += 1
    return repairs


@kernel
def all_finite(P: FloatArray) -> bool:
    """Whether all numbers of P (n, m) are finite."""
    for a in range(P.shape[0]):
        for b in range(P.shape[1]):
            if not math.isfinite(P[a, b]):
                return False
    return True


@kernel
def cholesky_with_jitter(S: FloatArray, L: FloatArray) -> bool:
    """`cholesky`, after adding to the diagonal of S in place until there is a factor."""
    share = JITTER
    while not cholesky(S, L):
        if not share < 2.0 * len(S):
            return False
        for r in range(len(S)):
            S[r, r] += share * S[r, r]
        share *= 10.0
    return True


@kernel
def semidefinite_root(P: FloatArray, L: FloatArray) -> None:
    """Lower Cholesky root of a P that may be singular: a direction without variance has none."""
    n = P.shape[0]
    for b in range(n):
        pivot = P[b, b]
        for k in range(b):
            pivot -= L[b, k] * L[b, k]
        known = pivot <= LIMIT * P[b, b] or not pivot > 0.0
        L[b, b] = 0.0 if known else math.sqrt(pivot)
        for a in range(b):
            L[a, b] = 0.0
        for a in range(b + 1, n):
            value = P[a, b]
            for k in range(b):
                value -= L[a, k] * L[b, k]
            L[a, b] = 0.0 if known else value / L[b, b]


@kernel
def triangularise(A: FloatArray) -> None:
    """A (r, c), c >= r, times an orthogonal matrix (Householder), in place: lower triangular with
    a diagonal that is not negative, ``A A'`` unchanged."""
    rows, columns = A.shape
    for a in range(rows):
        size = 0.0
        for k in range(a, columns):
            size += A[a, k] * A[a, k]
        size = math.sqrt(size)
        if not size > 0.0:
            continue
        # The mirror that turns the row into +-size e_a; v is the row with its pivot pushed out.
        pivot = A[a, a]
        turned = -size if pivot > 0.0 else size
        A[a, a] = pivot - turned
        half = size * (size + abs(pivot))
        for b in range(a + 1, rows):
            value = 0.0
            for k in range(a, columns):
                value += A[b, k] * A[a, k]
            value /= half
            for k in range(a, columns):
                A[b, k] -= value * A[a, k]
        sign = 1.0 if turned > 0.0 else -1.0
        A[a, a] = size
        for b in range(a + 1, rows):
            A[b, a] *= sign
        for k in range(a + 1, columns):
            A[a, k] = 0.0


@kernel
def square_root_predict(P: FloatArray, F: FloatArray, Q: FloatArray, out: FloatArray) -> None:
    """F P F^T + Q into `out` by a root of P, positive definite (`covariance.propagate`)."""
    n = P.shape[0]
    L, FL = np.zeros((n, n)), np.empty((n, n))
    semidefinite_root(P, L)
    product(F, L, FL)
    for a in range(n):
        for b in range(a + 1):
            value = 0.0
            for k in range(n):
                value += FL[a, k] * FL[b, k]
            out[a, b] = value + 0.5 * (Q[a, b] + Q[b, a])
            out[b, a] = out[a, b]
    add_jitter(out, L)


@kernel
def square_root_update(
    P: FloatArray,
    H: FloatArray,
    R: FloatArray,
    L: FloatArray,
    K: FloatArray,
    out: FloatArray,
) -> bool:
    """The update in square-root form (`covariance.correct`): the factor of S into L (m, m), the
    gain into K (n, m), the covariance, positive definite, into `out` (n, n). False, with nothing
    of use written, where S is not finite or has a component without any variance."""
    m, n = H.shape
    for a in range(n):
        for b in range(n):
            if not math.isfinite(P[a, b]):
                return False
        for r in range(m):
            if not math.isfinite(H[r, a]):
                return False
    root, noise = np.zeros((n, n)), np.zeros((m, m))
    semidefinite_root(P, root)
    semidefinite_root(R, noise)
    seen, own = np.empty((m, n)), np.empty(m)
    product(H, root, seen)
    for r in range(m):
        own[r] = 0.0
        for b in range(n):
            own[r] += seen[r, b] * seen[r, b]
        for s in range(m):
            own[r] += noise[r, s] * noise[r, s]
            if not math.isfinite(R[r, s]):
                return False
        if not (own[r] > 0.0 and own[r] < np.inf):
            return False
    A = np.empty((m + n, m + n + m))
    for attempt in range(2):
        A[:] = 0.0
        for a in range(n):
            for b in range(n):
                A[m + a, m + b] = root[a, b]
        for r in range(m):
            for s in range(m):
                A[r, s] = noise[r, s]
            for b in range(n):
                A[r, m + b] = seen[r, b]
            if attempt == 1 or not R[r, r] > LIMIT * own[r]:
                A[r, m + n + r] = math.sqrt(JITTER * own[r])
        triangularise(A)
        clear = True
        for r in range(m):
            clear = clear and A[r, r] * A[r, r] > LIMIT * own[r]
        if clear:
            break
    for r in range(m):
        for s in range(m):
            L[r, s] = A[r, s] if s <= r else 0.0
    for a in range(n):
        for r in range(m - 1, -1, -1):
            value = A[m + a, r]
            for k in range(r + 1, m):
                value -= K[a, k] * L[k, r]
            K[a, r] = value / L[r, r]
        for b in range(a + 1):
            value = 0.0
            for k in range(b + 1):
                value += A[m + a, m + k] * A[m + b, m + k]
            out[a, b] = value
            out[b, a] = value
    add_jitter(out, root)
    return True


@kernel
def innovation_covariance(
    P: FloatArray, H: FloatArray, R: FloatArray, PHt: FloatArray, S: FloatArray
) -> None:
    """P H^T into PHt (n, m) and H P H^T + R into S (m, m)."""
    m, n = H.shape
    product_transposed(P, H, PHt)
    for r in range(m):
        for s in range(r + 1):
            value = 0.5 * (R[r, s] + R[s, r])
            for k in range(n):
                value += H[r, k] * PHt[k, s]
            S[r, s] = value
            S[s, r] = value


@kernel
def gain(PHt: FloatArray, L: FloatArray, K: FloatArray) -> None:
    """K = PHt S^-1 from S = L L^T: two triangular solves a row."""
    n, m = PHt.shape
    for a in range(n):
        for r in range(m):
            value = PHt[a, r]
            for k in range(r):
                value -= L[r, k] * K[a, k]
            K[a, r] = value / L[r, r]
        for r in range(m - 1, -1, -1):
            value = K[a, r]
            for k in range(r + 1, m):
                value -= L[k, r] * K[a, k]
            K[a, r] = value / L[r, r]


@kernel
def joseph(
    P: FloatArray,
    K: FloatArray,
    H: FloatArray,
    R: FloatArray,
    A: FloatArray,
    AP: FloatArray,
    KR: FloatArray,
    out: FloatArray,
) -> None:
    """(I - K H) P (I - K H)^T + K R K^T into `out`, exactly symmetric; A, AP (n, n) and KR (n, m)
    are scratch."""
    m, n = H.shape
    for a in range(n):
        for b in range(n):
            value = 1.0 if a == b else 0.0
            for r in range(m):
                value -= K[a, r] * H[r, b]
            A[a, b] = value
    product(K, R, KR)
    product(A, P, AP)
    for a in range(n):
        for b in range(a + 1):
            value = 0.0
            for k in range(n):
                value += AP[a, k] * A[b, k]
            for r in range(m):
                value += KR[a, r] * K[b, r]
            out[a, b] = value
            out[b, a] = value


@kernel
def whitened_square(L: FloatArray, v: FloatArray, w: FloatArray) -> float:
    """v^T S^-1 v with S = L L^T; w (m,) is scratch."""
    total = 0.0
    for r in range(len(v)):
        value = v[r]
        for k in range(r):
            value -= L[r, k] * w[k]
        w[r] = value / L[r, r]
        total += w[r] * w[r]
    return total
