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

"""Point masses: the exact filter and smoother for a jump Markov system of one state.

With one state the densities need no approximation but a fine grid. Probability sits on the cells
x_g = x_0 + g step; ``p (M, G)`` is the joint probability of model j and cell g, all models
together summing to one. A cycle is that of a particle filter whose particles never move, with sums
for integrals; cells need neither resampling nor rejuvenation::

    propagate  s_j(g) = sum_i P_ij p_i(g)                      `mix`: who could become model j
               p_j(g) = sum_h N(g - h; sigma_j / step) s_j(h)  `walk`: each model moves at random
    weigh      p_j(g) <- p_j(g) L(g) / sum                     each cell meets the measurement
    summarise  mu_j = sum_g p_j(g),  mean = sum x_g p_j(g)

and the smoother runs back from the last step with what the future says of each cell,

    beta_i(g) = sum_j P_ij sum_h N(h - g; sigma_j / step) L'(h) beta'_j(h)
    p_i(g) <- p_i(g) beta_i(g) / sum

primes denoting the next step. Sums over equal steps converge faster than any power of the step for
functions that are smooth on its scale: a step of the smallest sigma is already exact to 1e-8.
A much smaller sigma keeps its variance (`NARROW`).

The verbs are compiled and work on the cells that hold probability. After `weigh` nearly all of it
lies in a narrow window [low, high) of the grid, the same for all models; what holds less than
`TAIL` at either end is cut off. Values outside the window are garbage and never read.

A walk with a large sigma would cost cells times sigma. It is smooth, so it is computed on every
c-th cell only: probability is handed to the coarse cells with the weights of cubic interpolation,
which keep its first four moments, walks there, and is interpolated back. With at least
`COARSE_SIGMA` coarse cells per sigma the error is below 1e-4 of the peak.
"""

from __future__ import annotations

import math

from .arrays import FloatArray
from .elementary import exponentials
from .jit import kernel

NARROW = 0.5
"""A walk of less than so many cells goes to the next cell at most, with the chance that gives it
its variance: samples of the normal law would have too little."""
TAIL = 1e-13
COARSE_SIGMA = 8
REACH = 7.0
"""A walk goes no further than so many sigma."""
WIDEST = 1e9
"""Walks are cut to this sigma in cells, wider than any grid: cell numbers stay integers."""


@kernel
def reach_of(sigma: float) -> int:
    """Cells a walk of `sigma` cells can cross."""
    return int(math.ceil(REACH * (sigma if sigma < WIDEST else WIDEST)))


@kernel
def walk(
    source: FloatArray,
    low: int,
    high: int,
    sigma: float,
    scratch: FloatArray,
    out: FloatArray,
    out_low: int,
    out_high: int,
) -> None:
    """Spread source [low, high) by a normal distribution of `sigma` cells into out [out_low,
    out_high), which is overwritten. scratch (7, max(G, 128) + 16) for a grid of G cells, whatever
    sigma is.
    """
    sigma = sigma if sigma < WIDEST else WIDEST  # NaN too
    for g in range(out_low, out_high):
        out[g] = 0.0
    factor = int(sigma / COARSE_SIGMA)
    if factor < 2:
        _spread(source, low, high, sigma, scratch[2], out, out_low, out_high)
        return
    inside, outside = scratch[0], scratch[1]
    a, b, c, d = scratch[3], scratch[4], scratch[5], scratch[6]
    # A coarse cell wider than the grid has no more fine cells than the grid.
    for k in range(min(factor, max(high, out_high))):
        f = k / factor
        a[k] = -f * (f - 1.0) * (f - 2.0) / 6.0
        b[k] = (f + 1.0) * (f - 1.0) * (f - 2.0) / 2.0
        c[k] = -(f + 1.0) * f * (f - 2.0) / 2.0
        d[k] = (f + 1.0) * f * (f - 1.0) / 6.0
    # Coarse cell m + 2 stands at the fine cell m * factor: interpolation needs one cell before it.
    first, last = low // factor, (high - 1) // factor
    for m in range(first + 1, last + 5):
        inside[m] = 0.0
    for m in range(first, last + 1):
        shift = m * factor
        for g in range(max(low, shift), min(high, shift + factor)):
            k = g - shift
            inside[m + 1] += source[g] * a[k]
            inside[m + 2] += source[g] * b[k]
            inside[m + 3] += source[g] * c[k]
            inside[m + 4] += source[g] * d[k]
    to, end = out_low // factor, (out_high - 1) // factor
    for m in range(to + 1, end + 5):
        outside[m] = 0.0
    coarse = sigma / factor
    _spread(inside, first + 1, last + 5, coarse, scratch[2], outside, to + 1, end + 5)
    for m in range(to, end + 1):
        shift = m * factor
        va, vb = outside[m + 1] / factor, outside[m + 2] / factor
        vc, vd = outside[m + 3] / factor, outside[m + 4] / factor
        for k in range(max(out_low - shift, 0), min(out_high - shift, factor)):
            out[shift + k] = max(va * a[k] + vb * b[k] + vc * c[k] + vd * d[k], 0.0)


@kernel
def _spread(
    source: FloatArray,
    low: int,
    high: int,
    sigma: float,
    taps: FloatArray,
    out: FloatArray,
    out_low: int,
    out_high: int,
) -> None:
    """`walk` on the cells themselves, added to `out`."""
    if sigma < NARROW:
        taps[0], taps[1] = 1.0 - sigma * sigma, 0.5 * sigma * sigma
        for lag in range(-1, 2):
            for g in range(max(out_low, low + lag), min(out_high, high + lag)):
                out[g] += taps[abs(lag)] * source[g - lag]
        return
    reach = reach_of(sigma)
    total = -1.0
    for lag in range(reach + 1):
        taps[lag] = math.exp(-0.5 * (lag / sigma) ** 2) if lag > 0 else 1.0
        total += 2.0 * taps[lag]
    tap = taps[0] / total
    for g in range(max(out_low, low), min(out_high, high)):
        out[g] += tap * source[g]
    for lag in range(1, reach + 1):
        tap = taps[lag] / total
        # Where both the source `lag` above and that `lag` below exist they come in one pass.
        above, above_end = max(out_low, low - lag), min(out_high, high - lag)
        below, below_end = max(out_low, low + lag), min(out_high, high + lag)
        both, both_end = max(above, below), max(min(above_end, below_end), max(above, below))
        for g in range(above, min(above_end, both)):
            out[g] += tap * source[g + lag]
        for g in range(both, both_end):
            out[g] += tap * (source[g + lag] + source[g - lag])
        for g in range(max(below, both_end if both_end > both else below), below_end):
            out[g] += tap * source[g - lag]


@kernel
def mix(p: FloatArray, low: int, high: int, transition: FloatArray, mixed: FloatArray) -> None:
    """Let the models change: p (M, G) into mixed (M, G), both on [low, high)."""
    M = p.shape[0]
    for j in range(M):
        out = mixed[j]
        for g in range(low, high):
            out[g] = 0.0
        for i in range(M):
            source, share = p[i], transition[i, j]
            for g in range(low, high):
                out[g] += share * source[g]


@kernel
def weigh(
    p: FloatArray, low: int, high: int, log_likelihood: FloatArray, work: FloatArray
) -> float:
    """Multiply p (M, G) on [low, high) by a likelihood (high - low,) and normalise it. Gives the
    log likelihood of the measurement; -inf when it is impossible and p was only normalised.
    work (2, G) is scratch."""
    M, n = p.shape[0], high - low
    best, before, after = -math.inf, 0.0, 0.0
    for g in range(n):
        best = log_likelihood[g] if log_likelihood[g] > best else best
    possible = math.isfinite(best)
    scratch, q = work[0, :n], work[1, :n]
    if possible:
        for g in range(n):
            log_likelihood[g] -= best
        exponentials(log_likelihood, scratch, q)
    for j in range(M):
        row = p[j, low:high]
        # Four sums at a time: each addition would wait for the one before.
        a, b, c, d = 0.0, 0.0, 0.0, 0.0
        for g in range(0, n - 3, 4):
            a += row[g]
            b += row[g + 1]
            c += row[g + 2]
            d += row[g + 3]
        for g in range(n - n % 4, n):
            a += row[g]
        before += (a + b) + (c + d)
        if possible:
            a, b, c, d = 0.0, 0.0, 0.0, 0.0
            for g in range(0, n - 3, 4):
                a += row[g] * q[g]
                b += row[g + 1] * q[g + 1]
                c += row[g + 2] * q[g + 2]
                d += row[g + 3] * q[g + 3]
            for g in range(n - n % 4, n):
                a += row[g] * q[g]
            after += (a + b) + (c + d)
    possible = possible and after > 0.0
    total = after if possible else before
    for j in range(M):
        row = p[j, low:high]
        if possible:
            for g in range(n):
                row[g] *= q[g] / total
        else:
            for g in range(n):
                row[g] /= total
    return best + math.log(after / before) if possible else -math.inf


@kernel
def trim(p: FloatArray, low: int, high: int) -> tuple[int, int]:
    """The part of [low, high) outside of which p (M, G) holds less than `TAIL` at either end."""
    tail = 0.0
    while low < high - 1:
        for j in range(p.shape[0]):
            tail += p[j, low]
        if tail > TAIL:
            break
        low += 1
    tail = 0.0
    while low < high - 1:
        for j in range(p.shape[0]):
            tail += p[j, high - 1]
        if tail > TAIL:
            break
        high -= 1
    return low, high


@kernel
def summarise(
    p: FloatArray, low: int, high: int, cells: FloatArray, probability: FloatArray
) -> tuple[float, float]:
    """Mean and variance of the state and probability (M,) of the models; cells (G,) are the
    states on the grid."""
    M = p.shape[0]
    mean, variance = 0.0, 0.0
    for j in range(M):
        probability[j] = 0.0
        for g in range(low, high):
            probability[j] += p[j, g]
            mean += p[j, g] * cells[g]
    for j in range(M):
        for g in range(low, high):
            variance += p[j, g] * (cells[g] - mean) ** 2
    return mean, variance
