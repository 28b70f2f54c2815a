# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Likelihoods of a direction from their definitions."""

import numpy as np

from sonar_imm.acoustics.laplace import IMPOSSIBLE, log_density


def log_likelihood(sines, y, signal_variance, noise_variance, step, likelihood='laplace'):
    """Log likelihood of direction sines (...) given one snapshot y (P,), less what does not depend
    on the direction; -inf for NaN. `step` is from `array.phase_step`."""
    a = np.exp(1j * step * np.asarray(sines)[..., None] * np.arange(len(y)))
    kappa = signal_variance / (noise_variance + len(y) * signal_variance)
    beam = np.abs(a.conj() @ y) ** 2
    q = (np.vdot(y, y).real - kappa * beam) / noise_variance
    density = log_density(q, len(y)) if likelihood == 'laplace' else -q
    return np.where(np.isnan(q), IMPOSSIBLE, density)


def interfered_log_likelihood(sines, y, signal_variance, covariance, step, likelihood='laplace'):
    """The same, given the noise covariance (P, P) of the snapshot, by linear algebra."""
    u, staves = np.asarray(sines), len(y)
    a = np.exp(1j * step * np.nan_to_num(u)[..., None] * np.arange(staves))
    gamma = covariance + signal_variance * a[..., :, None] * a[..., None, :].conj()
    solved = np.linalg.solve(gamma, np.broadcast_to(y[:, None], (*u.shape, staves, 1)))[..., 0]
    q = (y.conj() * solved).sum(axis=-1).real
    density = log_density(q, staves) if likelihood == 'laplace' else -q
    determinant = np.linalg.slogdet(gamma)[1] - np.linalg.slogdet(covariance)[1]
    return np.where(np.isnan(u), IMPOSSIBLE, density - determinant)
