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

"""The unscented filter, of the baseline in `landmark`: a Gaussian through a nonlinear function.

Sigma points go through the function, and their weighted mean and covariance are those of the
result: exact for linear functions; for quadratic ones the mean is exact. Components marked as
angles are compared with the image of the centre point, wrapped once, averaged and added back.
Functions are vectorised: they take points (..., s, n) and give (..., s, m).

Reference: Julier, Uhlmann, *Unscented Filtering and Nonlinear Estimation*, Proc. IEEE 92(3), 2004.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from sonar_imm.estimation.angles import wrap_angle
from sonar_imm.estimation.arrays import BoolArray, FloatArray
from sonar_imm.estimation.covariance import (
    add_jitter,
    CovarianceError,
    solve,
    symmetrise,
    transpose,
)
from sonar_imm.estimation.kalman import apply, factorise, log_density, Updated
from sonar_imm.estimation.smoothing import sigma_offsets

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


def update(
    x: FloatArray,
    P: FloatArray,
    z: FloatArray,
    h: Function,
    R: FloatArray,
    *,
    angles: BoolArray | None = None,
) -> Updated:
    """Measurement update with ``z = h(x) + v``, ``v ~ N(0, R)``.

    z: (..., m); h: (..., s, n) to (..., s, m); R: (..., m, m); angles: (m,), angles of the
    measurement.

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
        x + apply(gain, innovation),
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
