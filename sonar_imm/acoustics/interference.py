# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The likelihood beside known interferers: echoes by way of the surface, other sonars.

An interferer of variance sb2 from a known direction b is noise with a structure. With several of
them the noise covariance is R = sn2 I + sum_b sb2 a_b a_b^H, and Gamma = ss2 a a^H + R. Whitening
by R would send the steering vector out of its family; instead, with w = R^-1 y,

    q(u) = y^H w - ss2 |a^H w|^2 / (1 + ss2 a^H R^-1 a)
    |Gamma| = |R| (1 + ss2 a^H R^-1 a)

where |a^H w|^2 (**beam**) and a^H R^-1 a (**spread**) are again trigonometric polynomials in the
direction sine u, so one candidate direction costs two Horner sums. The determinant now depends on
the direction and belongs to the likelihood: near an interferer the spread vanishes, echo and
interference cannot be told apart, and the likelihood is flat rather than wrong. (Merely raising
the white noise does not help: it blurs all directions alike.)
"""

from __future__ import annotations

from attrs import frozen
import numpy as np
from numpy.typing import ArrayLike

from ..estimation.arrays import ComplexArray, FloatArray
from .array import direction_grid, phase_step
from .laplace import autocorrelation


@frozen(eq=False)
class InterferenceForm:
    """What the likelihood of n bins needs: base (n,) = y^H R^-1 y; the coefficients beam (n, P)
    and spread (n, P) of polynomials, as in `laplace.form_coefficients`; log_determinant (n,)."""

    base: FloatArray
    beam: ComplexArray
    spread: ComplexArray
    log_determinant: FloatArray


def noise_covariance(
    sines: ArrayLike, variances: ArrayLike, noise_variance: ArrayLike, staves: int, step: float
) -> ComplexArray:
    """R (n, P, P) of interferers at `sines` (n, m) with `variances` (n, m) in white noise (n,). A
    direction that is NaN, or a variance that is not positive, is no interferer.

    `step` is from `array.phase_step`.
    """
    u, variance = np.broadcast_arrays(np.asarray(sines, float), np.asarray(variances, float))
    there = np.isfinite(u) & (variance > 0.0)
    phase = step * np.where(there, u, 0.0)[..., None] * np.arange(staves)
    scaled = np.sqrt(np.where(there, variance, 0.0))[..., None] * np.exp(1j * phase)
    white = np.asarray(noise_variance, float)[..., None, None] * np.eye(staves)
    return white + np.swapaxes(scaled, -1, -2) @ scaled.conj()


def interference_form(iq: ArrayLike, covariance: ComplexArray) -> InterferenceForm:
    """Fold snapshots iq (n, P) and noise covariances (n, P, P) into an `InterferenceForm`."""
    y = np.asarray(iq, np.complex128)
    inverse = np.linalg.inv(covariance)
    whitened = (inverse @ y[..., None])[..., 0]
    beam = autocorrelation(whitened)
    beam[..., 1:] *= 2.0
    spread = np.stack(
        [
            np.trace(inverse, offset=-lag, axis1=-2, axis2=-1) * (2.0 if lag else 1.0)
            for lag in range(y.shape[-1])
        ],
        axis=-1,
    )
    base = (y.conj() * whitened).sum(axis=-1).real
    return InterferenceForm(base, beam, spread, np.linalg.slogdet(covariance)[1])


def coherence_beside(form: InterferenceForm, spacing: float) -> FloatArray:
    """Coherence (n,) that is left beside the interferers, max_u |a^H w|^2 / (y^H w a^H R^-1 a): as
    `coherence.coherence`, of whitened snapshots. NaN for silent bins."""
    staves = form.beam.shape[1]
    phase = phase_step(spacing) * direction_grid(staves, spacing)
    waves = np.exp(-1j * np.arange(staves)[:, None] * phase)
    beam, spread = (form.beam @ waves).real, (form.spread @ waves).real
    usable = np.isfinite(form.base) & (form.base > 0.0)
    with np.errstate(over='ignore'):
        share = (beam / np.maximum(spread, 1e-300)).max(axis=1) / np.where(usable, form.base, 1.0)
    return np.where(usable, np.minimum(share, 1.0), np.nan)
