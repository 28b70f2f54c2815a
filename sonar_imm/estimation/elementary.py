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

"""Elementary functions of a whole row of numbers at a time.

A call of the C library for each of a few hundred particles costs more than the rest of a filter.
Written as loops without branches the processor runs several numbers at a time, and, since every
operation is plain arithmetic, gives the same bits everywhere.
"""

from __future__ import annotations

import math

import numpy as np

from .arrays import FloatArray
from .jit import kernel

ROUND = 1.5 * 2.0**52
"""Adding this to a double and taking it away again rounds it to a whole number; in between, the
low bits hold that number."""
_PER_LN2 = 1.0 / math.log(2.0)
# ln 2 in two parts: products of the first with whole numbers up to 1075 are exact.
_LN2, _LN2_REST = 6.93147180369123816490e-01, 1.90821492927058770002e-10
_LEAST = -700.0
_E = tuple(1.0 / math.factorial(k) for k in range(13))


def _even_polynomial(function: str) -> tuple[float, ...]:
    """Coefficients in f^2 of sin(pi f) / f or cos(pi f) for abs(f) <= 1/2: their Taylor series."""
    first = 1 if function == 'sin' else 0
    return tuple(
        (-1.0) ** k * math.pi ** (2 * k + first) / math.factorial(2 * k + first) for k in range(11)
    )


_S = _even_polynomial('sin')
_C = _even_polynomial('cos')


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


@kernel
def phasors(values: FloatArray, factor: float, cosine: FloatArray, sine: FloatArray) -> None:
    """cos and sin of 2 pi factor values (n,); NaN stays NaN.

    Taking the nearest whole number away leaves f in [-1/2, 1/2], where sin(pi f) and cos(pi f) are
    polynomials to 1e-15; doubling the angle does the rest.
    """
    for i in range(values.shape[0]):
        turns = factor * values[i]
        f = turns - ((turns + ROUND) - ROUND)
        t = f * f
        s = _S[8] + t * (_S[9] + t * _S[10])
        s = _S[4] + t * (_S[5] + t * (_S[6] + t * (_S[7] + t * s)))
        s = f * (_S[0] + t * (_S[1] + t * (_S[2] + t * (_S[3] + t * s))))
        c = _C[8] + t * (_C[9] + t * _C[10])
        c = _C[4] + t * (_C[5] + t * (_C[6] + t * (_C[7] + t * c)))
        c = _C[0] + t * (_C[1] + t * (_C[2] + t * (_C[3] + t * c)))
        cosine[i] = c * c - s * s
        sine[i] = 2.0 * s * c
