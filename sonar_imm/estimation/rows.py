"""Elementary functions of a whole row of numbers at a time.

A call of the C library for each of a few hundred particles costs more than the rest of a filter.
Written as loops without branches the processor runs several numbers at a time, and, since every
operation is plain arithmetic, gives the same bits everywhere.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .jit import kernel

FloatArray = NDArray[np.float64]

ROUND = 1.5 * 2.0**52
"""Adding this to a double and taking it away again rounds it to a whole number; in between, the
low bits hold that number."""
_PER_LN2 = 1.0 / math.log(2.0)
# ln 2 in two parts: products of the first with whole numbers up to 1075 are exact.
_LN2, _LN2_REST = 6.93147180369123816490e-01, 1.90821492927058770002e-10
_LEAST = -700.0
_E = tuple(1.0 / math.factorial(k) for k in range(13))


@kernel
def exponentials(values: FloatArray, scratch: FloatArray, out: FloatArray) -> None:
    """exp of values (n,) that are not positive, into out (n,); 0 below -700 and for NaN.

    exp(v) = 2^k exp(f) with v = k ln 2 + f, abs(f) <= ln(2) / 2: a polynomial for exp(f), exact to
    a unit in the last place, and k put where a double keeps its exponent.
    """
    bits = scratch.view(np.int64)
    for i in range(values.shape[0]):
        v = values[i] if values[i] > _LEAST else _LEAST
        whole = v * _PER_LN2 + ROUND
        scratch[i] = whole
        whole -= ROUND
        f = (v - whole * _LN2) - whole * _LN2_REST
        p = _E[9] + f * (_E[10] + f * (_E[11] + f * _E[12]))
        p = _E[5] + f * (_E[6] + f * (_E[7] + f * (_E[8] + f * p)))
        out[i] = 1.0 + f * (1.0 + f * (_E[2] + f * (_E[3] + f * (_E[4] + f * p))))
    for i in range(values.shape[0]):
        bits[i] = (bits[i] + 1023) << 52
    for i in range(values.shape[0]):
        out[i] = out[i] * scratch[i] if values[i] > _LEAST else 0.0
