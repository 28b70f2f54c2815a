# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The likelihood of one range bin of an array: heavy-tailed echoes from one direction, and noise.

A patch of floor answers with a few strong facets, so the echo of a bin is not Gaussian: its power
varies. Taking the power as exponentially distributed gives the complex multivariate symmetric
Laplace distribution of P staves::

    y = sqrt(z) g,   z ~ Exp(1),   g ~ CN(0, Gamma),   Gamma = ss2 a a^H + sn2 I
    p(y) = 2 / (pi^P |Gamma|) q^((1-P)/2) K_{P-1}(2 sqrt(q)),   q = y^H Gamma^-1 y

with a the steering vector, ss2 and sn2 the variances of signal and noise at one stave. (T. Eltoft,
T. Kim, T. Lee, IEEE Signal Processing Letters 13(5), 2006, give that of 2P real numbers; the
Bessel order is P - 1 here because a complex number counts twice.) `log_density` is the part of
log p(y) that depends on q, `log_constant` the rest.

**Everything about the direction is in q**, and q is cheap. Gamma is rank one plus a multiple of
the identity, so with kappa = ss2 / (sn2 + P ss2)

    q = (|y|^2 - kappa |a^H y|^2) / sn2,   |Gamma| = sn2^P (1 + P ss2 / sn2)

and |a^H y|^2 is a trigonometric polynomial in the direction sine u, whose coefficients are the
autocorrelation c_k = sum_p y_{p+k} conj(y_p) of the snapshot. `form_coefficients` folds all of
this into P complex numbers g with q(u) = Re sum_k g_k exp(-i k w u), w = 2 pi spacing, which
Horner's rule sums in O(P) for each of thousands of candidate directions.

Compiled loops take the likelihood from a table: see `likelihood_table`.
"""

from __future__ import annotations

from functools import lru_cache
import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import kve

from ..estimation.arrays import ComplexArray, FloatArray

LIKELIHOODS = ('laplace', 'gaussian')
MAX_STAVES = 64
OCTAVES, OCTAVE_CELLS = (-20, 50), 32
"""The likelihood is tabulated for q from 2^-20 to 2^50, so many cells to the octave; outside,
q is put to the nearest end."""

IMPOSSIBLE = -math.inf


def log_density(q: ArrayLike, staves: int) -> FloatArray:
    """log(q^((1-P)/2) K_{P-1}(2 sqrt(q))): the Laplace density without what does not depend on q.

    Infinite at q = 0, where the density is (but its integral is not). Any P from 1 on.
    """
    q = np.asarray(q, np.float64)
    order = staves - 1
    root = np.sqrt(q)
    with np.errstate(divide='ignore', over='ignore', invalid='ignore'):
        value = np.log(kve(order, 2.0 * root)) - 2.0 * root - order * np.log(root)
        if order == 0:
            return value
        # The scaled Bessel function of a high order overflows where its logarithm is harmless.
        small = math.lgamma(order) - math.log(2.0) - order * np.log(q)
        if order > 1:
            small = small + np.log1p(-np.minimum(q, 0.5) / (order - 1))
    return np.where(np.isposinf(value), small, value)


def log_density_slope(q: ArrayLike, staves: int) -> FloatArray:
    """Derivative of `log_density` by ln q: -sqrt(q) K_P(2 sqrt(q)) / K_{P-1}(2 sqrt(q))."""
    root = np.sqrt(np.asarray(q, np.float64))
    with np.errstate(over='ignore', invalid='ignore'):
        value = -root * kve(staves, 2.0 * root) / kve(staves - 1, 2.0 * root)
    return np.where(np.isfinite(value), value, 1.0 - staves)


def log_constant(staves: int, log_determinant: ArrayLike) -> FloatArray:
    """What `log_density` leaves out: log 2 - P log pi - log |Gamma|."""
    return math.log(2.0) - staves * math.log(math.pi) - np.asarray(log_determinant, np.float64)


def gaussian_log_constant(staves: int, log_determinant: ArrayLike) -> FloatArray:
    """-P log pi - log |Gamma|."""
    return -staves * math.log(math.pi) - np.asarray(log_determinant, np.float64)


def autocorrelation(y: ArrayLike) -> ComplexArray:
    """c_k = sum_p y_{p+k} conj(y_p) (..., P) of snapshots y (..., P), k = 0 .. P-1.

    |a(u)^H y|^2 = c_0 + 2 Re sum_{k>0} c_k exp(-i k w u).
    """
    y = np.asarray(y, np.complex128)
    staves = y.shape[-1]
    out = np.empty(y.shape, np.complex128)
    for lag in range(staves):
        out[..., lag] = np.einsum('...p,...p->...', y[..., lag:], y[..., : staves - lag].conj())
    return out


def weighted_form(
    y: ArrayLike, weights: FloatArray | None = None
) -> tuple[ComplexArray, FloatArray]:
    """The autocorrelation (..., P) of w y and the power (...,) sum_p w_p |y_p|^2 of snapshots
    y (..., P), whose staves have the weights w (P,), see `form_coefficients`; None for ones."""
    if weights is None:
        coefficients = autocorrelation(y)
        return coefficients, coefficients[..., 0].real.copy()
    y = np.asarray(y, np.complex128)
    return autocorrelation(weights * y), np.square(np.abs(y)) @ weights


def form_coefficients(
    y: ArrayLike,
    signal_variance: ArrayLike,
    noise_variance: ArrayLike,
    weights: FloatArray | None = None,
) -> ComplexArray:
    """Coefficients g (..., P) of the quadratic form: q(u) = Re sum_k g_k exp(-i k w u).

    y (..., P); variances (...) of signal and noise at one stave. weights (P,) where the noise
    differs from stave to stave: the noise variance is then the harmonic mean h over the staves
    that are there, and h / w_p that of one; the others have the weight 0. With B = |sum_p w_p
    conj(a_p) y_p|^2 and E = sum_p w_p |y_p|^2 the form is q = (E - kappa B) / h, exactly.
    """
    noise = np.asarray(noise_variance, np.float64)
    staves = np.shape(y)[-1] if weights is None else np.count_nonzero(weights)
    kappa = signal_variance / (noise + staves * np.asarray(signal_variance, np.float64))
    coefficients, power = weighted_form(y, weights)
    own = coefficients[..., 0].real.copy()
    coefficients *= -2.0 * kappa[..., None]
    coefficients[..., 0] = power * (1.0 - kappa) + kappa * (power - own)
    return coefficients / noise[..., None]


@lru_cache(maxsize=32)
def likelihood_table(staves: int, likelihood: str = 'laplace') -> FloatArray:
    """The table of a likelihood, (4, cells): coefficients of the cubic in each cell. Read-only.

    A double holds its own logarithm: its exponent and its first five bits number the cells, the
    remaining bits say where in the cell it lies, so that compiled loops need no logarithm. The
    relative error is 3e-7 at most. The Gaussian likelihood is a table too.

    Raises ValueError for a number of staves or a likelihood that there is not.
    """
    if not 1 < staves <= MAX_STAVES:
        raise ValueError(f'likelihoods are tabulated for 2 to {MAX_STAVES} staves, not {staves}')
    if likelihood not in LIKELIHOODS:
        raise ValueError(
            f"there is no likelihood '{likelihood}'; there are {' and '.join(LIKELIHOODS)}"
        )
    node = np.arange((OCTAVES[1] - OCTAVES[0]) * OCTAVE_CELLS + 1)
    q = np.ldexp(1.0 + (node % OCTAVE_CELLS) / OCTAVE_CELLS, OCTAVES[0] + node // OCTAVE_CELLS)
    laplace = likelihood == 'laplace'
    value = log_density(q, staves) if laplace else -q
    slope = log_density_slope(q, staves) / q if laplace else -np.ones_like(q)
    width, rise = np.diff(q), np.diff(value)
    left, right = width * slope[:-1], width * slope[1:]
    table = np.stack(
        [value[:-1], left, 3.0 * rise - 2.0 * left - right, left + right - 2.0 * rise]
    )
    table.flags.writeable = False
    return table
