"""The law of one range bin seen by an array: heavy-tailed echoes from one direction, and noise.

A patch of floor answers with a few strong facets, so the echo of a bin is not Gaussian: its power
varies. Taking the power as exponentially distributed gives the complex multivariate symmetric
Laplace law of P staves::

    y = sqrt(z) g,   z ~ Exp(1),   g ~ CN(0, Gamma),   Gamma = ss2 a a^H + sn2 I
    p(y) = 2 / (pi^P |Gamma|) q^((1-P)/2) K_{P-1}(2 sqrt(q)),   q = y^H Gamma^-1 y

with a the steering vector, ss2 and sn2 the variances of signal and noise at one stave. (T. Eltoft,
T. Kim, T. Lee, IEEE Signal Processing Letters 13(5), 2006, give the law of 2P real numbers; the
Bessel order is P - 1 here because a complex number counts twice.) `log_density` is the part of
log p(y) that depends on q, `log_constant` the rest.

**Everything about the direction is in q**, and q is cheap. Gamma is rank one plus a multiple of
the identity, so with kappa = ss2 / (sn2 + P ss2)

    q = (|y|^2 - kappa |a^H y|^2) / sn2,   |Gamma| = sn2^P (1 + P ss2 / sn2)

and |a^H y|^2 is a trigonometric polynomial in the direction sine u, whose coefficients are the
autocorrelation c_k = sum_p y_{p+k} conj(y_p) of the snapshot. `form_coefficients` folds all of
this into P complex numbers g with q(u) = Re sum_k g_k exp(-i k w u), w = 2 pi spacing, which
Horner's rule sums in O(P) for each of thousands of candidate directions.

In compiled loops the law is a table (`log_density_table`): a cubic in q, with exact values and
slopes at its ends, for every part of an octave in 32. The bits of a floating-point number are its
octave and its place therein, so that finding the cell needs no logarithm and the loop no branch.
The Gaussian law, whose log density is -q, is a table of the same form.
"""

from __future__ import annotations

from functools import lru_cache
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import kve

from ..estimation.jit import kernel
from .phasors import phasors, trigonometric_sums

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

LAWS = ('laplace', 'gaussian')
MAX_STAVES = 64

LOWEST_OCTAVE, HIGHEST_OCTAVE = -20, 50
"""The table spans q from 2^-20 to 2^50; the law is held constant outside."""
_CELL_BITS = 5
_MANTISSA_BITS = 52
_CELL_SHIFT = _MANTISSA_BITS - _CELL_BITS
_FIRST_CELL = (1023 + LOWEST_OCTAVE) << _CELL_BITS
_MANTISSA_MASK = (1 << _MANTISSA_BITS) - 1
_ONE = 1023 << _MANTISSA_BITS
_LOWEST, _HIGHEST = 2.0**LOWEST_OCTAVE, 2.0**HIGHEST_OCTAVE * (1.0 - 2.0**-53)

IMPOSSIBLE = -math.inf


def log_density(q: ArrayLike, staves: int) -> FloatArray:
    """log(q^((1-P)/2) K_{P-1}(2 sqrt(q))): the Laplace law without what does not depend on q.

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


def gaussian_log_density(q: ArrayLike, staves: int) -> FloatArray:
    """The same of the complex Gaussian law of P staves: -q. `gaussian_log_constant` is the
    rest."""
    return -np.asarray(q, np.float64)


def gaussian_log_constant(staves: int, log_determinant: ArrayLike) -> FloatArray:
    """-P log pi - log |Gamma|."""
    return -staves * math.log(math.pi) - np.asarray(log_determinant, np.float64)


def moments_of_q(staves: int) -> tuple[float, float]:
    """Mean and variance of q when Gamma is right: q = z s with z ~ Exp(1), s ~ Gamma(P, 1)."""
    return float(staves), float(2 * staves * (staves + 1) - staves**2)


@lru_cache(maxsize=32)
def log_density_table(staves: int, law: str = 'laplace') -> FloatArray:
    """The law as compiled loops want it: coefficients (4, cells) of a cubic in each cell.

    Raises ValueError for a number of staves or a law that is not known. Read-only.
    """
    if not 1 < staves <= MAX_STAVES:
        raise ValueError(f'the law is tabulated for 2 to {MAX_STAVES} staves, not {staves}')
    if law not in LAWS:
        raise ValueError(f"there is no law '{law}'; there are {' and '.join(LAWS)}")
    octaves = 2.0 ** np.arange(LOWEST_OCTAVE, HIGHEST_OCTAVE)
    starts = np.outer(octaves, 1.0 + np.arange(2**_CELL_BITS) / 2**_CELL_BITS).ravel()
    q = np.append(starts, 2.0 * octaves[-1])
    if law == 'laplace':
        value, slope = log_density(q, staves), log_density_slope(q, staves) / q
    else:
        value, slope = gaussian_log_density(q, staves), np.full(len(q), -1.0)
    width, rise = np.diff(q), np.diff(value)
    first, last = slope[:-1] * width, slope[1:] * width
    table = np.stack([value[:-1], first, 3.0 * rise - 2.0 * first - last, first + last - 2 * rise])
    table.flags.writeable = False
    return table


@kernel
def log_densities(q: FloatArray, table: FloatArray, out: FloatArray) -> None:
    """Log densities of all q (n,) from the table of the law into `out` (n,); q is brought into the
    span of the table in place."""
    n = q.shape[0]
    for i in range(n):
        q[i] = min(max(q[i], _LOWEST), _HIGHEST)
    bits, places = q.view(np.int64), out.view(np.int64)
    for i in range(n):
        # The bits below the cell number become the mantissa of a number from 1 to 2.
        places[i] = ((bits[i] << _CELL_BITS) & _MANTISSA_MASK) | _ONE
    constant, linear, square, cube = table[0], table[1], table[2], table[3]
    for i in range(n):
        t = out[i] - 1.0
        cell = np.uint64((bits[i] >> _CELL_SHIFT) - _FIRST_CELL)
        out[i] = constant[cell] + t * (linear[cell] + t * (square[cell] + t * cube[cell]))


def autocorrelation(y: ArrayLike) -> ComplexArray:
    """c_k = sum_p y_{p+k} conj(y_p) (..., P) of snapshots y (..., P), k = 0 .. P-1.

    |a(u)^H y|^2 = c_0 + 2 Re sum_{k>0} c_k exp(-i k w u).
    """
    y = np.asarray(y, np.complex128)
    staves = y.shape[-1]
    return np.stack(
        [(y[..., lag:] * y[..., : staves - lag].conj()).sum(axis=-1) for lag in range(staves)],
        axis=-1,
    )


def form_coefficients(
    y: ArrayLike, signal_variance: ArrayLike, noise_variance: ArrayLike
) -> ComplexArray:
    """Coefficients g (..., P) of the quadratic form: q(u) = Re sum_k g_k exp(-i k w u).

    y (..., P); variances (...) of signal and noise at one stave.
    """
    noise = np.asarray(noise_variance, np.float64)
    staves = np.shape(y)[-1]
    kappa = signal_variance / (noise + staves * np.asarray(signal_variance, np.float64))
    coefficients = autocorrelation(y)
    power = coefficients[..., 0].copy()
    coefficients *= -2.0 * kappa[..., None]
    coefficients[..., 0] = power * (1.0 - kappa)
    return coefficients / noise[..., None]


@kernel
def form_coefficients_of(
    y: ComplexArray, signal_variance: float, noise_variance: float, g: ComplexArray
) -> None:
    """Compiled `form_coefficients` of one snapshot y (P,) into g (P,)."""
    staves = y.shape[0]
    kappa = signal_variance / (noise_variance + staves * signal_variance)
    for lag in range(staves):
        real, imaginary = 0.0, 0.0
        for p in range(staves - lag):
            a, b = y[p + lag], y[p]
            real += a.real * b.real + a.imag * b.imag
            imaginary += a.imag * b.real - a.real * b.imag
        scale = (1.0 - kappa if lag == 0 else -2.0 * kappa) / noise_variance
        g[lag] = complex(scale * real, scale * imaginary)


@kernel
def log_likelihoods(
    sines: FloatArray,
    g: ComplexArray,
    step: float,
    table: FloatArray,
    scratch: FloatArray,
    out: FloatArray,
) -> None:
    """Log likelihood of every direction sine in `sines` (n,) into `out` (n,), for one bin.

    g (P,) from `form_coefficients`, `step` from `array.phase_step`, `table` from
    `log_density_table`; scratch (4, n). What does not depend on the direction is left out; a NaN
    direction is impossible: -inf.
    """
    cosine, sine, q, imaginary = scratch[0], scratch[1], scratch[2], scratch[3]
    phasors(sines, step, cosine, sine)
    trigonometric_sums(g, cosine, sine, q, imaginary)
    log_densities(q, table, out)
    for i in range(sines.shape[0]):
        out[i] = out[i] if sines[i] == sines[i] else -math.inf


def log_likelihood(
    sines: ArrayLike,
    y: ArrayLike,
    signal_variance: float,
    noise_variance: float,
    step: float,
    law: str = 'laplace',
) -> FloatArray:
    """The same as `log_likelihoods` in numpy, for one snapshot y (P,) and any shape of `sines`.

    It builds q from the definition, so it is slow, and what the kernels are tested against.
    """
    y = np.asarray(y, np.complex128)
    u = np.asarray(sines, np.float64)
    a = np.exp(1j * step * u[..., None] * np.arange(len(y)))
    kappa = signal_variance / (noise_variance + len(y) * signal_variance)
    beam = np.abs(a.conj() @ y) ** 2
    q = (np.vdot(y, y).real - kappa * beam) / noise_variance
    density = log_density(q, len(y)) if law == 'laplace' else gaussian_log_density(q, len(y))
    return np.where(np.isnan(q), IMPOSSIBLE, density)
