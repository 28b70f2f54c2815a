# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The Kalman filter, for one target or for thousands at once.

A Gaussian state with mean ``x`` (..., n) and covariance ``P`` (..., n, n) moves by ``x <- F x + b
+ w``, ``w ~ N(0, Q)``, and is seen through ``z = H x + v``, ``v ~ N(0, R)``. Every function takes
any leading axes (targets, models, both) and broadcasts them, so the same lines serve one diver and
a thousand divers under sixteen models.

The extended filter is the same code: linearise about the mean, pass the Jacobians as `F` and `H`,
``b = f(x) - F x``, and as innovation ``z - h(x)`` (wrapped, when it is an angle: only the caller
knows).

`covariance` keeps covariances healthy: the update is in Joseph form, nothing is ever inverted (``S
= L L'`` is factorised and triangular systems are solved), and what rounding would make indefinite
all the same is repaired and reported in `repaired`, so that callers can count it. Input from which
nothing can be computed raises `CovarianceError`, which says which of the batch it was.

Reference: Bar-Shalom, Li, Kirubarajan, *Estimation with Applications to Tracking and Navigation*
(2001), ch. 5 and 10.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .arrays import BoolArray, FloatArray
from .covariance import correct, CovarianceError, propagate, solve

LOG_2PI = float(np.log(2.0 * np.pi))


class Predicted(NamedTuple):
    """x (..., n) and P (..., n, n) after a time update; repaired (...,): where P was, see
    `covariance`."""

    x: FloatArray
    P: FloatArray
    repaired: BoolArray


class Updated(NamedTuple):
    """A state after a measurement.

    x: (..., n); P: (..., n, n); innovation_covariance: (..., m, m); nis: (...,) normalised
    innovation squared, chi-square with m degrees of freedom; log_likelihood: (...,) of the
    innovation, natural logarithm; repaired: (...,) where P was, see `covariance`.
    """

    x: FloatArray
    P: FloatArray
    innovation_covariance: FloatArray
    nis: FloatArray
    log_likelihood: FloatArray
    repaired: BoolArray


def apply(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    """Matrix (..., m, n) times vector (..., n), broadcast over the rest."""
    return (matrix @ vector[..., None])[..., 0]


def predict(
    x: FloatArray, P: FloatArray, F: FloatArray, Q: FloatArray, b: FloatArray | None = None
) -> Predicted:
    """Time update: ``F x + b`` (..., n) and ``F P F' + Q`` (..., n, n).

    >>> import numpy as np
    >>> F = np.array([[1.0, 2.0], [0.0, 1.0]])  # two seconds at constant velocity
    >>> x, P, _ = predict(np.array([5.0, 1.0]), np.eye(2), F, np.zeros((2, 2)))
    >>> x.tolist(), P.tolist()
    ([7.0, 1.0], [[5.0, 2.0], [2.0, 1.0]])
    """
    moved = apply(F, x)
    return Predicted(moved if b is None else moved + b, *propagate(F, P, Q))


def update(
    x: FloatArray, P: FloatArray, innovation: FloatArray, H: FloatArray, R: FloatArray
) -> Updated:
    """Measurement update in Joseph form.

    x: (..., n); P: (..., n, n); innovation: (..., m), measurement minus prediction; H: (..., m,
    n); R: (..., m, m), which may be singular (a perfect component).

    Raises CovarianceError when an innovation covariance ``S = H P H' + R`` is not finite, or has a
    component without any variance.

    >>> import numpy as np
    >>> x, P, H, R = np.zeros(1), np.eye(1), np.eye(1), np.eye(1)
    >>> found = update(x, P, np.array([2.0]) - H @ x, H, R)
    >>> found.x.round(6).tolist(), found.P.round(6).tolist()  # half way, half the variance
    ([1.0], [[0.5]])
    """
    after = correct(P, H, R)
    if not after.usable.all():
        finite = np.isfinite(after.S).all(axis=(-1, -2))
        if not finite.all():
            raise CovarianceError('innovation covariance is not finite', np.asarray(~finite))
        raise CovarianceError('innovation covariance is not positive definite', ~after.usable)
    nis, log_likelihood = log_density(innovation, after.factor)
    x = x + apply(after.gain, innovation)
    return Updated(x, after.P, after.S, nis, log_likelihood, after.repaired)


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


def log_density(deviation: FloatArray, factor: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Squared Mahalanobis distance (...,) and log density (...,) of `deviation` (..., m) under
    ``N(0, factor factor')``."""
    white = solve(factor, deviation[..., None])[..., 0]
    distance = np.einsum('...i,...i->...', white, white)
    log_root_determinant = np.log(np.diagonal(factor, axis1=-2, axis2=-1)).sum(axis=-1)
    return distance, -0.5 * (distance + deviation.shape[-1] * LOG_2PI) - log_root_determinant
