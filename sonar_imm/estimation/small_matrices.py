"""Linear algebra of small matrices, compiled: the pieces of a Kalman update as plain loops.

For matrices of a few rows the call of a library costs more than the arithmetic. Every function
writes into arrays the caller owns, so that nothing is allocated in a loop over models and targets.
"""

from __future__ import annotations

import math

from .arrays import FloatArray
from .jit import kernel


@kernel
def cholesky(S: FloatArray, L: FloatArray) -> bool:
    """Lower Cholesky factor of S into L; False when S is not positive definite (or not finite)."""
    m = S.shape[0]
    for a in range(m):
        for b in range(a + 1):
            value = S[a, b]
            for k in range(b):
                value -= L[a, k] * L[b, k]
            if a == b:
                if not value > 0.0:
                    return False
                L[a, a] = math.sqrt(value)
            else:
                L[a, b] = value / L[b, b]
    return True


@kernel
def innovation_covariance(
    P: FloatArray, H: FloatArray, R: FloatArray, PHt: FloatArray, S: FloatArray
) -> None:
    """P H^T into PHt (n, m) and H P H^T + R into S (m, m)."""
    m, n = H.shape
    for a in range(n):
        for r in range(m):
            value = 0.0
            for k in range(n):
                value += P[a, k] * H[r, k]
            PHt[a, r] = value
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
        for r in range(m):
            value = 0.0
            for s in range(m):
                value += K[a, s] * R[s, r]
            KR[a, r] = value
    for a in range(n):
        for b in range(n):
            value = 0.0
            for k in range(n):
                value += A[a, k] * P[k, b]
            AP[a, b] = value
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
