# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Likelihoods of a direction from their definitions."""

import numpy as np
from numpy.typing import ArrayLike

from sonar_imm.acoustics.laplace import IMPOSSIBLE, log_density
from sonar_imm.estimation.arrays import ComplexArray, FloatArray


def gaussian_log_density(q: ArrayLike, staves: int) -> FloatArray:
    """The part that depends on q of the complex Gaussian density of P staves, -q;
    `laplace.gaussian_log_constant` is the rest."""
    return -np.asarray(q, np.float64)


def log_likelihood(
    sines: ArrayLike,
    y: ArrayLike,
    signal_variance: float,
    noise_variance: float,
    step: float,
    likelihood: str = 'laplace',
) -> FloatArray:
    """Log likelihood of direction sines (...) given one snapshot y (P,), less
    what does not depend on the direction; -inf for NaN. `step` is from `array.phase_step`.

    It builds q from the definition.
    """
    y = np.asarray(y, np.complex128)
    u = np.asarray(sines, np.float64)
    a = np.exp(1j * step * u[..., None] * np.arange(len(y)))
    kappa = signal_variance / (noise_variance + len(y) * signal_variance)
    beam = np.abs(a.conj() @ y) ** 2
    q = (np.vdot(y, y).real - kappa * beam) / noise_variance
    density = (
        log_density(q, len(y)) if likelihood == 'laplace' else gaussian_log_density(q, len(y))
    )
    return np.where(np.isnan(q), IMPOSSIBLE, density)


def interfered_log_likelihood(
    sines: ArrayLike,
    y: ArrayLike,
    signal_variance: float,
    covariance: ComplexArray,
    step: float,
    likelihood: str = 'laplace',
) -> FloatArray:
    """Log likelihood of direction sines (...) given one snapshot y (P,) and its
    noise covariance (P, P), less what does not depend on the direction; -inf for NaN.

    By linear algebra from the definition, which is slow.
    """
    y = np.asarray(y, np.complex128)
    u = np.asarray(sines, np.float64)
    staves = len(y)
    a = np.exp(1j * step * np.nan_to_num(u)[..., None] * np.arange(staves))
    gamma = covariance + signal_variance * a[..., :, None] * a[..., None, :].conj()
    solved = np.linalg.solve(gamma, np.broadcast_to(y[:, None], (*u.shape, staves, 1)))[..., 0]
    q = (y.conj() * solved).sum(axis=-1).real
    laplace = likelihood == 'laplace'
    density = log_density(q, staves) if laplace else gaussian_log_density(q, staves)
    determinant = np.linalg.slogdet(gamma)[1] - np.linalg.slogdet(covariance)[1]
    return np.where(np.isnan(u), IMPOSSIBLE, density - determinant)
