"""The Kalman filter, for one target or for thousands at once.

A Gaussian state with mean ``x`` (..., n) and covariance ``P`` (..., n, n) moves by ``x <- F x + b
+ w``, ``w ~ N(0, Q)``, and is seen through ``z = H x + v``, ``v ~ N(0, R)``. Every function takes
any leading axes (targets, models, both) and broadcasts them, so the same lines serve one diver and
a thousand divers under sixteen models.

The extended filter is the same code: linearise about the mean, pass the Jacobians as `F` and `H`,
``b = f(x) - F x``, and as innovation ``z - h(x)`` (wrapped, when it is an angle: only the caller
knows).

Two habits keep covariances healthy. The update is in Joseph form, a sum of two positive
semidefinite terms, which stays positive semidefinite under rounding where ``P - K S K'`` does not;
and nothing is ever inverted: ``S = L L'`` is factorised and triangular systems are solved. A
covariance that is broken nevertheless raises `CovarianceError`, which says which of the batch it
was; `repair_covariance` mends what rounding can explain and tells, so that callers can count it.

Reference: Bar-Shalom, Li, Kirubarajan, *Estimation with Applications to Tracking and Navigation*
(2001), ch. 5 and 10.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .arrays import BoolArray, FloatArray

LOG_2PI = float(np.log(2.0 * np.pi))


class CovarianceError(ValueError):
    """A covariance that is not finite or not positive definite. `where` (...) is True for the bad
    ones of the batch."""

    def __init__(self, what: str, where: BoolArray):
        self.where = where
        many = f'{int(where.sum())} of {where.size}: ' if where.size > 1 else ''
        super().__init__(f'{many}{what}')


class Updated(NamedTuple):
    """A state after a measurement.

    x: (..., n); P: (..., n, n); innovation_covariance: (..., m, m); nis: (...,) normalised
    innovation squared, chi-square with m degrees of freedom; log_likelihood: (...,) of the
    innovation, natural logarithm.
    """

    x: FloatArray
    P: FloatArray
    innovation_covariance: FloatArray
    nis: FloatArray
    log_likelihood: FloatArray


def transpose(matrix: FloatArray) -> FloatArray:
    """Matrix transpose of the last two axes."""
    return np.swapaxes(matrix, -1, -2)


def symmetrise(P: FloatArray) -> FloatArray:
    """The symmetric part of `P` (..., n, n), equal to the last bit on both sides."""
    return 0.5 * (P + transpose(P))


def apply(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Matrix (..., m, n) times vector (..., n), broadcast over the rest."""
    return (matrix @ vector[..., None])[..., 0]


def predict(
    x: FloatArray, P: FloatArray, F: FloatArray, Q: FloatArray, b: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Time update: ``F x + b`` (..., n) and ``F P F' + Q`` (..., n, n), symmetrised."""
    moved = apply(F, x)
    return moved if b is None else moved + b, symmetrise(F @ P @ transpose(F) + Q)


def update(
    x: FloatArray, P: FloatArray, innovation: FloatArray, H: FloatArray, R: FloatArray
) -> Updated:
    """Measurement update in Joseph form.

    x: (..., n); P: (..., n, n); innovation: (..., m), measurement minus prediction; H: (..., m,
    n); R: (..., m, m). R may be singular (a perfect component) as long as ``S = H P H' + R`` is
    not.

    Raises CovarianceError when an innovation covariance S is not finite or not positive definite.
    """
    cross = H @ P
    S = symmetrise(cross @ transpose(H) + R)
    factor = factorise(S, 'innovation covariance')
    gain = transpose(solve(transpose(factor), solve(factor, cross)))
    kept = np.eye(x.shape[-1]) - gain @ H
    nis, log_likelihood = log_density(innovation, factor)
    return Updated(
        x + apply(gain, innovation),
        symmetrise(kept @ P @ transpose(kept) + gain @ R @ transpose(gain)),
        S,
        nis,
        log_likelihood,
    )


def factorise(S: FloatArray, what: str = 'covariance') -> FloatArray:
    """Lower Cholesky factor (..., m, m) of `S`. Raises CovarianceError that names `what` when
    there is none."""
    finite = np.isfinite(S).all(axis=(-1, -2))
    if not finite.all():
        raise CovarianceError(f'{what} is not finite', np.asarray(~finite))
    try:
        return np.asarray(np.linalg.cholesky(S), dtype=np.float64)
    except np.linalg.LinAlgError:
        values = np.linalg.eigvalsh(S)
        indefinite = values[..., 0] <= 1e-15 * values[..., -1]
        raise CovarianceError(f'{what} is not positive definite', np.asarray(indefinite)) from None


def solve(matrix: FloatArray, columns: FloatArray) -> FloatArray:
    """``matrix^-1 columns``, (..., m, m) and (..., m, q), broadcast over the leading axes."""
    # numpy before 2.0 takes a second argument with one axis less for a stack of vectors.
    missing = max(matrix.ndim - columns.ndim, 0)
    stack = columns.reshape((1,) * missing + columns.shape)
    return np.asarray(np.linalg.solve(matrix, stack), dtype=np.float64)


def log_density(deviation: FloatArray, factor: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Squared Mahalanobis distance (...,) and log density (...,) of `deviation` (..., m) under
    ``N(0, factor factor')``."""
    white = solve(factor, deviation[..., None])[..., 0]
    distance = np.einsum('...i,...i->...', white, white)
    log_root_determinant = np.log(np.diagonal(factor, axis1=-2, axis2=-1)).sum(axis=-1)
    return distance, -0.5 * (distance + deviation.shape[-1] * LOG_2PI) - log_root_determinant


def repair_covariance(
    P: FloatArray, *, tolerance: float = 1e-12, limit: float = 1e-3
) -> tuple[FloatArray, BoolArray]:
    """Symmetrise `P` (..., n, n) and lift negative eigenvalues to zero, within bounds.

    Returns the covariances and ``repaired`` (...,), True where an eigenvalue was below
    ``-tolerance`` times the largest magnitude. Healthy members keep their bits (they are only
    symmetrised), and singular ones are healthy.

    Raises CovarianceError when a member is not finite, or has an eigenvalue below ``-limit`` times
    the largest magnitude: rounding does not do that, so it must not be painted over.
    """
    P = symmetrise(P)
    finite = np.isfinite(P).all(axis=(-1, -2))
    if not finite.all():
        raise CovarianceError('covariance is not finite', np.asarray(~finite))
    values, vectors = np.linalg.eigh(P)
    largest = np.abs(values).max(axis=-1)
    broken = np.asarray(values[..., 0] < -limit * largest)
    if broken.any():
        raise CovarianceError(
            'covariance is further from positive semidefinite than rounding explains', broken
        )
    repaired = np.asarray(values[..., 0] < -tolerance * largest)
    if not repaired.any():
        return P, repaired
    lifted = symmetrise((vectors * np.maximum(values, 0.0)[..., None, :]) @ transpose(vectors))
    return np.where(repaired[..., None, None], lifted, P), repaired
