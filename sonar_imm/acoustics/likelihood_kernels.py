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

"""The likelihood of a whole row of directions at a time, compiled for the trackers.

`laplace` and `interference` say what the likelihood is. Here the same numbers come from loops that
the processor runs several directions at a time, which calls of the C library for a cosine, a sine
and a logarithm would prevent; that makes them nine times faster.

* `horner`: Re and Im of a trigonometric polynomial, term after term over the whole row.
* `likelihood_table` and `log_densities`: a double holds its own logarithm. Its exponent and its
  first five bits number the cells of a table, 32 to the octave. The remaining bits say where in
  the cell it lies, so that cubic interpolation needs no logarithm. The table reaches from 2^-20 to
  2^50; outside, q is put to the nearest end. The relative error is 3e-7 at most. The Gaussian
  likelihood is a table too.

Everything is elementwise: a row gives the same bits however it is cut.
"""

from __future__ import annotations

from functools import lru_cache
import math

import numpy as np

from ..estimation.arrays import ComplexArray, FloatArray
from ..estimation.elementary import phasors
from ..estimation.jit import kernel
from .laplace import LIKELIHOODS, log_density, log_density_slope, MAX_STAVES

_CELL_BITS = 5
_OCTAVES = (-20, 50)
_LOWEST, _HIGHEST = 2.0 ** _OCTAVES[0], 2.0 ** _OCTAVES[1] * (1.0 - 2.0**-50)
_SHIFT = 52 - _CELL_BITS
_FIRST_CELL = (1023 + _OCTAVES[0]) << _CELL_BITS
_REST = (1 << _SHIFT) - 1
_ONE = 1023 << 52


@lru_cache(maxsize=32)
def likelihood_table(staves: int, likelihood: str = 'laplace') -> FloatArray:
    """The table of a likelihood, (4, cells): coefficients of the cubic in each cell. Read-only.

    Raises ValueError for a number of staves or a likelihood that there is not.
    """
    if not 1 < staves <= MAX_STAVES:
        raise ValueError(f'likelihoods are tabulated for 2 to {MAX_STAVES} staves, not {staves}')
    if likelihood not in LIKELIHOODS:
        raise ValueError(
            f"there is no likelihood '{likelihood}'; there are {' and '.join(LIKELIHOODS)}"
        )
    node = np.arange(((_OCTAVES[1] - _OCTAVES[0]) << _CELL_BITS) + 1)
    cells = 1 << _CELL_BITS
    q = np.ldexp(1.0 + (node % cells) / cells, _OCTAVES[0] + node // cells)
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


@kernel
def horner(
    g: ComplexArray, cosine: FloatArray, sine: FloatArray, real: FloatArray, imaginary: FloatArray
) -> None:
    """sum_k g_k z^k of z = cosine - i sine, (n,), into real and imaginary."""
    last = g.shape[0] - 1
    a, b = g[last].real, g[last].imag
    for i in range(cosine.shape[0]):
        real[i] = a
        imaginary[i] = b
    for k in range(last - 1, -1, -1):
        a, b = g[k].real, g[k].imag
        for i in range(cosine.shape[0]):
            x = real[i] * cosine[i] + imaginary[i] * sine[i] + a
            imaginary[i] = imaginary[i] * cosine[i] - real[i] * sine[i] + b
            real[i] = x


@kernel
def log_densities(q: FloatArray, t: FloatArray, table: FloatArray, out: FloatArray) -> None:
    """The tabulated log likelihood of q (n,) into out (n,); q and t are left as scratch."""
    cell, rest = q.view(np.int64), t.view(np.int64)
    for i in range(q.shape[0]):
        value = q[i] if q[i] > _LOWEST else _LOWEST  # NaN goes to the low end too
        q[i] = value if value < _HIGHEST else _HIGHEST
    for i in range(q.shape[0]):
        rest[i] = ((cell[i] & _REST) << _CELL_BITS) | _ONE
    constant, linear, square, cube = table[0], table[1], table[2], table[3]
    for i in range(q.shape[0]):
        x = t[i] - 1.0
        # Unsigned, so that no check for an index from the end gets into the loop.
        k = np.uint64((cell[i] >> _SHIFT) - _FIRST_CELL)
        out[i] = constant[k] + x * (linear[k] + x * (square[k] + x * cube[k]))


@kernel
def log_likelihoods(
    sines: FloatArray,
    spacing: float,
    form: ComplexArray,
    base: float,
    spread: ComplexArray,
    signal_variance: float,
    table: FloatArray,
    work: FloatArray,
    out: FloatArray,
) -> None:
    """Log likelihood of every direction sine (n,) for one bin into out (n,); -inf for NaN.

    White noise: form (P,) from `laplace.form_coefficients`, base 0, spread (0,). Beside
    interferers: base, form = -ss2 beam and spread (P,) of one bin of an
    `interference.InterferenceForm`. spacing in wavelengths, negative for a conjugated array; work
    (4, n or more) is scratch. What does not depend on the direction is left out.
    """
    n = sines.shape[0]
    cosine, sine, q, other = work[0, :n], work[1, :n], work[2, :n], work[3, :n]
    phasors(sines, spacing, cosine, sine)
    if spread.shape[0] > 0:
        horner(spread, cosine, sine, out, other)
        horner(form, cosine, sine, q, other)
        for i in range(n):
            gain = max(1.0 + signal_variance * out[i], 1.0)
            q[i] = base + q[i] / gain
            sine[i] = math.log(gain)
        log_densities(q, cosine, table, out)
        for i in range(n):
            out[i] -= sine[i]
    else:
        horner(form, cosine, sine, q, other)
        log_densities(q, cosine, table, out)
    for i in range(n):
        if not sines[i] == sines[i]:
            out[i] = -math.inf


@kernel
def direction_sines(
    depth: FloatArray, slant_range: float, cos_tilt: float, sin_tilt: float, out: FloatArray
) -> None:
    """`array.direction_sine` of depths (n,) at one range, into out (n,); NaN where it cannot
    be."""
    for i in range(depth.shape[0]):
        ratio = depth[i] / slant_range
        out[i] = ratio * cos_tilt - math.sqrt(1.0 - ratio * ratio) * sin_tilt
