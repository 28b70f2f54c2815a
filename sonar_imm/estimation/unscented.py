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

"""The unscented transform: the moments of a Gaussian after a nonlinear function.

A Gaussian is replaced by sigma points on its principal axes. The points go through the function,
and their weighted mean and covariance are those of the result. Exact for linear functions; for
quadratic ones the mean is exact.

Three choices make it robust:

- **No negative weights.** ``kappa = max(0, 3 - n)``. Up to three dimensions the fourth moment of
  the Gaussian is matched; above that the centre has no weight and the rule is the cubature rule.
  Every covariance is a sum of squares with non-negative weights, so it cannot lose its
  definiteness. The measurement update has the matching (Joseph) form.
- **Angles are averaged as offsets.** Components marked as angles are compared with the image of
  the centre point. The differences are wrapped once into [-pi, pi], averaged and added back.
  Turning the scene turns the answer and changes nothing else, because the points lie on principal
  axes, which turn with the scene. Singular covariances need no special care.
- **What is not finite is refused** by `CovarianceError`, at the step where it appears.

Functions are vectorised: they take points (..., s, n) and give (..., s, m).

Reference: Julier, Uhlmann, *Unscented Filtering and Nonlinear Estimation*, Proc. IEEE 92(3), 2004;
Arasaratnam, Haykin, *Cubature Kalman Filters*, IEEE TAC 54(6), 2009.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from .angles import wrap_angle
from .arrays import BoolArray, FloatArray
from .covariance import add_jitter, CovarianceError, solve, symmetrise, transpose
from .kalman import apply, factorise, log_density, Predicted, Updated

Function = Callable[[FloatArray], FloatArray]


class Transformed(NamedTuple):
    """A Gaussian after a function: mean (..., m), covariance (..., m, m), and its cross covariance
    (..., n, m) with the argument."""

    mean: FloatArray
    covariance: FloatArray
    cross_covariance: FloatArray


class _Cloud(NamedTuple):
    """Sigma points: offsets from the mean before (..., s, n) and after (..., s, m) the function,
    weights (s,), mean after (..., m)."""

    before: FloatArray
    after: FloatArray
    weights: FloatArray
    mean: FloatArray


def sigma_offsets(P: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Offsets (..., 2n + 1, n) of the sigma points from their mean, the centre first, and their
    weights (2n + 1,).

    Raises CovarianceError when `P` (..., n, n) is not finite. Eigenvalues below zero count as
    zero.
    """
    finite = np.isfinite(P).all(axis=(-1, -2))
    if not finite.all():
        raise CovarianceError('covariance is not finite', np.asarray(~finite))
    n = P.shape[-1]
    kappa = max(0.0, 3.0 - n)
    values, vectors = np.linalg.eigh(P)
    axes = transpose(vectors) * np.sqrt((n + kappa) * np.maximum(values, 0.0))[..., None]
    weights = np.full(2 * n + 1, 0.5 / (n + kappa))
    weights[0] = kappa / (n + kappa)
    return np.concatenate([np.zeros_like(axes[..., :1, :]), axes, -axes], axis=-2), weights


def unscented_transform(
    function: Function, x: FloatArray, P: FloatArray, *, angles: BoolArray | None = None
) -> Transformed:
    """Mean and covariance of ``function(X)``, ``X ~ N(x, P)``.

    function: (..., s, n) to (..., s, m); x: (..., n); P: (..., n, n); angles: (m,), True for
    components of the result that are angles in radians (the mean of those is in [-pi, pi]).

    Raises CovarianceError when P or the result is not finite.
    """
    cloud = _transform(function, x, P, angles)
    weighted = cloud.after * cloud.weights[:, None]
    return Transformed(
        cloud.mean,
        symmetrise(transpose(weighted) @ cloud.after),
        transpose(cloud.before) @ weighted,
    )


def predict(
    x: FloatArray, P: FloatArray, f: Function, Q: FloatArray, *, angles: BoolArray | None = None
) -> Predicted:
    """Time update ``x <- f(x) + w``, ``w ~ N(0, Q)``; `angles` (n,) marks angles of the state."""
    moved = unscented_transform(f, x, P, angles=angles)
    return Predicted(moved.mean, *add_jitter(symmetrise(moved.covariance + Q)))


def update(
    x: FloatArray,
    P: FloatArray,
    z: FloatArray,
    h: Function,
    R: FloatArray,
    *,
    angles: BoolArray | None = None,
    state_angles: BoolArray | None = None,
) -> Updated:
    """Measurement update with ``z = h(x) + v``, ``v ~ N(0, R)``.

    z: (..., m); h: (..., s, n) to (..., s, m); R: (..., m, m); angles: (m,), angles of the
    measurement; state_angles: (n,), angles of the state, which are wrapped into [-pi, pi].

    The covariance is ``sum w (dx - K dz)(.)' + K R K'``: squares only, equal to ``P - K S K'`` in
    exact arithmetic. Raises CovarianceError when P or ``h`` is not finite or a component of the
    innovation has no variance.
    """
    cloud = _transform(h, x, P, angles)
    weighted = cloud.after * cloud.weights[:, None]
    S, singular = add_jitter(symmetrise(transpose(weighted) @ cloud.after + R))
    factor = factorise(S, 'innovation covariance')
    cross = transpose(weighted) @ cloud.before
    gain = transpose(solve(transpose(factor), solve(factor, cross)))
    innovation = _wrap(z - cloud.mean, angles)
    rest = cloud.before - cloud.after @ transpose(gain)
    covariance = transpose(rest * cloud.weights[:, None]) @ rest + gain @ R @ transpose(gain)
    covariance, repaired = add_jitter(symmetrise(covariance))
    nis, log_likelihood = log_density(innovation, factor)
    return Updated(
        _wrap(x + apply(gain, innovation), state_angles),
        covariance,
        S,
        nis,
        log_likelihood,
        repaired | singular,
    )


def _transform(
    function: Function, x: FloatArray, P: FloatArray, angles: BoolArray | None
) -> _Cloud:
    before, weights = sigma_offsets(P)
    images = function(x[..., None, :] + before)
    finite = np.isfinite(images).all(axis=(-1, -2))
    if not finite.all():
        raise CovarianceError('the function is not finite at a sigma point', np.asarray(~finite))
    reference = images[..., :1, :]
    offsets = _wrap(images - reference, angles)
    mean_offset = np.einsum('s,...sm->...m', weights, offsets)
    return _Cloud(
        before,
        offsets - mean_offset[..., None, :],
        weights,
        _wrap(reference[..., 0, :] + mean_offset, angles),
    )


def _wrap(vector: FloatArray, angles: BoolArray | None) -> FloatArray:
    return vector if angles is None else np.where(angles, wrap_angle(vector), vector)
