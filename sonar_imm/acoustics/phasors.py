"""Sines and cosines of many angles at once, as sums the compiler can run several at a time.

A loop that calls the mathematical library runs one angle at a time. The polynomials below, on at
most half a turn, are plain arithmetic, and give all digits that a likelihood can use: their error
is below 1e-11.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..estimation.jit import kernel

FloatArray = NDArray[np.float64]
ComplexArray = NDArray[np.complex128]

# sin(pi x) = x (S0 + S1 x^2 + ...), cos(pi x) = 1 + C1 x^2 + ..., wanted for |x| <= 1/2
_S0, _S1, _S2, _S3, _S4, _S5, _S6, _S7, _S8 = (
    (-1) ** k * math.pi ** (2 * k + 1) / math.factorial(2 * k + 1) for k in range(9)
)
_C1, _C2, _C3, _C4, _C5, _C6, _C7, _C8 = (
    (-1) ** k * math.pi ** (2 * k) / math.factorial(2 * k) for k in range(1, 9)
)


@kernel
def phasors(values: FloatArray, step: float, cosine: FloatArray, sine: FloatArray) -> None:
    """cos(step v) and sin(step v) of all values (n,) into cosine (n,) and sine (n,)."""
    turns = step / (2.0 * math.pi)
    for i in range(values.shape[0]):
        x = turns * values[i]
        x -= np.rint(x)
        z = x * x
        # Half the angle first: twice it then follows exactly.
        s = z * (_S4 + z * (_S5 + z * (_S6 + z * (_S7 + z * _S8))))
        s = x * (_S0 + z * (_S1 + z * (_S2 + z * (_S3 + s))))
        c = z * (_C5 + z * (_C6 + z * (_C7 + z * _C8)))
        c = 1.0 + z * (_C1 + z * (_C2 + z * (_C3 + z * (_C4 + c))))
        cosine[i] = 1.0 - 2.0 * s * s
        sine[i] = 2.0 * s * c


@kernel
def trigonometric_sums(
    g: ComplexArray,
    cosine: FloatArray,
    sine: FloatArray,
    real: FloatArray,
    imaginary: FloatArray,
) -> None:
    """Re and Im of sum_k g_k exp(-i k x) for all angles x, given by `phasors` (n,), into real (n,)
    and imaginary (n,), by Horner's rule."""
    last = g.shape[0] - 1
    n = cosine.shape[0]
    for i in range(n):
        real[i] = g[last].real
        imaginary[i] = g[last].imag
    for k in range(last - 1, -1, -1):
        a, b = g[k].real, g[k].imag
        for i in range(n):
            x, y = real[i], imaginary[i]
            real[i] = x * cosine[i] + y * sine[i] + a
            imaginary[i] = y * cosine[i] - x * sine[i] + b
