# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The filter on a grid, along the range bins of one ping: the exact filter for one state.

Everything that this engine compiles stands here, for a kernel file imports no other; so it is a
long one. `filter_ping` and `smooth_ping` do on a grid what `filter_kernels` does with particles.

Shapes: T bins of a ping, M models, n states, N particles per model, G cells of the grid, P staves.

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

The verbs work on the cells that hold probability. After `weigh` nearly all of it
lies in a narrow window [low, high) of the grid, the same for all models; what holds less than
`TAIL` at either end is cut off. Values outside the window are garbage and never read.

A walk with a large sigma would cost cells times sigma. It is smooth, so it is computed on every
c-th cell only: probability is handed to the coarse cells with the weights of cubic interpolation,
which keep its first four moments, walks there, and is interpolated back. With at least
`COARSE_SIGMA` coarse cells per sigma the error is below 1e-4 of the peak.

**The likelihood.** `acoustics.laplace` and `acoustics.interference` say what it is. Here the same
numbers come from loops that the processor runs several directions at a time, which calls of the C
library for a cosine, a sine, an exponential and a logarithm would prevent: those are plain
arithmetic, with the same bits everywhere. `horner` takes Re and Im of a trigonometric polynomial,
`log_densities` reads the table of `acoustics.laplace.likelihood_table`. Everything is elementwise:
a row gives the same bits however it is cut.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...estimation.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from ...estimation.jit import kernel

_FIRST: Any = np.int64(0)  # a literal in a call would make a signature of its own
_HALF_CIRCLE = 0.5 * math.pi
_TURNS = 0.5 / math.pi
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
_CELL_BITS = 5
_LOWEST, _HIGHEST = 2.0**-20, 2.0**50 * (1.0 - 2.0**-50)
"""The ends of `acoustics.laplace.likelihood_table`, and how it is numbered."""
_SHIFT = 52 - _CELL_BITS
_FIRST_CELL = (1023 - 20) << _CELL_BITS
_REST = (1 << _SHIFT) - 1
_ONE = 1023 << 52
NARROW = 0.5
"""A walk of less than so many cells goes to the next cell at most, with the chance that gives it
its variance: samples of the normal law would have too little."""
TAIL = 1e-13
COARSE_SIGMA = 8
REACH = 7.0
"""A walk goes no further than so many sigma."""
WIDEST = 1e9
"""Walks are cut to this sigma in cells, wider than any grid: cell numbers stay integers."""


class Geometry(NamedTuple):
    """How a state becomes a direction in each of T bins; see `acoustics.sounding`.

    of_heights: states are heights of the floor, else angles. height (T,): of the array, in the
    same terms, m; reach (T,): r C, by which a depth is divided, m; tilt (T,): psi, rad, with its
    cosine and sine; `spacing` of the staves in wavelengths, negative for a conjugated array.
    launch: where rays bend, the table of `rays.launch_table`, (0, 0) where they do not; row (T,):
    place of each range in it; first_depth and depth_step, m, of its columns.
    drift_from: the first bin that angles reach at constant height, T or more for never.
    """

    of_heights: bool
    height: FloatArray
    reach: FloatArray
    tilt: FloatArray
    cos_tilt: FloatArray
    sin_tilt: FloatArray
    spacing: float
    launch: FloatArray
    row: FloatArray
    first_depth: float
    depth_step: float
    drift_from: int


class PingLikelihood(NamedTuple):
    """The likelihood of the state in each of T bins.

    ranges (T,) in metres; echo (T,): bins with an echo; form (T, P), base (T,), spread
    (T, P), or (T, 0) in white noise, signal (T,) and table: see
    `log_likelihoods`; noise (T,): the variance it was made for; constant (T,):
    what the kernels leave out of the log likelihood.
    """

    ranges: FloatArray
    echo: BoolArray
    form: ComplexArray
    base: FloatArray
    spread: ComplexArray
    signal: FloatArray
    noise: FloatArray
    constant: FloatArray
    table: FloatArray
    geometry: Geometry


class Particles(NamedTuple):
    """x (M, n, N), their weights w (M, N) and the probabilities mu (M,) of the models."""

    x: FloatArray
    w: FloatArray
    mu: FloatArray


class Track(NamedTuple):
    """The floor along one ping: mean (T, n), covariance (T, n, n), probability (T, M) of each
    model, log_likelihood (T,) of each bin given those before it, sample_size (T,) effective."""

    mean: FloatArray
    covariance: FloatArray
    probability: FloatArray
    log_likelihood: FloatArray
    sample_size: FloatArray


class GridMotion(NamedTuple):
    """How the models move on the grid: cells (G,), the states it is made of; transition (M, M) of
    the models; sigma (T, M) of their walks, in cells; `coast` is the model that all follow through
    bins without an echo; favour (T, M): see `models.TerrainModels`, (0, M) for none."""

    cells: FloatArray
    transition: FloatArray
    sigma: FloatArray
    coast: int
    favour: FloatArray


class Drift(NamedTuple):
    """Where each cell goes if the floor keeps its height: `first` (G,), the cell before the one
    that lies just before that place, and the weights (4, G) of that and the next three cells.

    The weights are those of cubic interpolation, which keep the first four moments: splitting
    between two cells would add noise at every bin."""

    first: IntArray
    weight: FloatArray


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


@kernel
def sines_of(
    state: FloatArray, t: int, geometry: Geometry, work: FloatArray, out: FloatArray
) -> None:
    """Direction sines of states (n,) at bin t into out (n,), NaN where no echo can come from.
    States are heights of the floor, or angles, as `geometry` says; work (1 or more, n or more) is
    scratch."""
    n = state.shape[0]
    first = work[0, :n]
    if geometry.of_heights:
        height = geometry.height[t]
        for s in range(n):
            first[s] = height - state[s]
        if geometry.launch.shape[0] > 0:
            look_up(
                geometry.launch,
                geometry.row[t],
                geometry.first_depth,
                geometry.depth_step,
                first,
            )
        direction_sines(first, geometry.reach[t], geometry.cos_tilt[t], geometry.sin_tilt[t], out)
    else:
        phasors(state, _TURNS, first, out)
        for s in range(n):
            if not abs(state[s]) <= _HALF_CIRCLE:
                out[s] = math.nan


@kernel
def look_up(
    value: FloatArray, row: float, first_depth: float, depth_step: float, depth: FloatArray
) -> None:
    """Replace depths (n,) by ``r sin(phi)`` from a launch table (R, D), bilinearly; row: the range
    over its range step. NaN outside the table."""
    k = min(max(int(row), 0), value.shape[0] - 2)
    f = row - k
    near, far, last = value[k], value[k + 1], value.shape[1] - 2
    for s in range(depth.shape[0]):
        place = (depth[s] - first_depth) / depth_step
        if not 0.0 <= place <= last + 1.0:
            depth[s] = math.nan
            continue
        i = min(int(place), last)
        g = place - i
        low = near[i] + g * (near[i + 1] - near[i])
        high = far[i] + g * (far[i + 1] - far[i])
        depth[s] = low + f * (high - low)


@kernel
def drift(state: FloatArray, t: int, geometry: Geometry, out: FloatArray) -> None:
    """Where angles (n,) of bin t - 1 are at bin t if the floor keeps its height, into out (n,).

    ``phi' = asin(sin(phi) r / r')`` for a level sonar; near nadir that is degrees a bin, more than
    a walk could follow. What is beyond straight down stays beyond it. Bent rays are taken as
    straight: it is a prediction over one bin.
    """
    rise = geometry.height[t] - geometry.height[t - 1]
    for s in range(state.shape[0]):
        down = state[s] + geometry.tilt[t - 1]
        depth = math.sin(down) * geometry.reach[t - 1] + rise
        ratio = min(max(depth / geometry.reach[t], -1.0), 1.0)
        after = math.asin(ratio)
        if down > _HALF_CIRCLE:
            after = math.pi - after
        elif down < -_HALF_CIRCLE:
            after = -math.pi - after
        out[s] = after - geometry.tilt[t]


@kernel
def find_drift(
    cells: FloatArray,
    low: int,
    high: int,
    t: int,
    geometry: Geometry,
    out: Drift,
    work: FloatArray,
) -> tuple[int, int]:
    """The drift of the cells [low, high) from bin t - 1 to bin t; the window they reach. work (1
    or more, G) is scratch."""
    G, step = cells.shape[0], cells[1] - cells[0]
    to = work[0, : high - low]
    drift(cells[low:high], t, geometry, to)
    new_low, new_high = G, 0
    for g in range(low, high):
        place = min(max((to[g - low] - cells[0]) / step, 1.0), G - 3.0)
        k = min(int(place), G - 3)
        f = place - k
        out.first[g] = k - 1
        out.weight[0, g] = -f * (f - 1.0) * (f - 2.0) / 6.0
        out.weight[1, g] = (f + 1.0) * (f - 1.0) * (f - 2.0) / 2.0
        out.weight[2, g] = -(f + 1.0) * f * (f - 2.0) / 2.0
        out.weight[3, g] = (f + 1.0) * f * (f - 1.0) / 6.0
        new_low, new_high = min(new_low, k - 1), max(new_high, k + 3)
    return new_low, new_high


@kernel
def push(
    p: FloatArray, low: int, high: int, cells: Drift, out: FloatArray, to_low: int, to_high: int
) -> None:
    """Probability p (G,) on [low, high) carried along, into out (G,) on [to_low, to_high)."""
    for g in range(to_low, to_high):
        out[g] = 0.0
    for g in range(low, high):
        for i in range(4):
            out[cells.first[g] + i] += cells.weight[i, g] * p[g]
    for g in range(to_low, to_high):
        out[g] = max(out[g], 0.0)


@kernel
def pull(
    beta: FloatArray, low: int, high: int, cells: Drift, out: FloatArray, to_low: int, to_high: int
) -> None:
    """The adjoint of `push`: what the future says of where each cell of [low, high) goes, from
    beta (G,) on [to_low, to_high), zero outside, into out (G,)."""
    for g in range(low, high):
        total = 0.0
        for i in range(4):
            k = cells.first[g] + i
            if to_low <= k < to_high:
                total += cells.weight[i, g] * beta[k]
        out[g] = max(total, 0.0)


@kernel
def filter_ping(
    p: FloatArray,
    motion: GridMotion,
    ping: PingLikelihood,
    window: IntArray,
    track: Track,
    keep: bool,
) -> FloatArray:
    """All T bins from p (M, G), the joint probability before the first.

    The windows [low, high) of the filtered densities go into window (T, 2), the answers into
    `track`. With `keep` the densities themselves are returned, one after the other, M rows each;
    else nothing (0,).
    """
    (M, G), T = p.shape, ping.ranges.shape[0]
    cells, sigma, coast = motion.cells, motion.sigma, motion.coast
    mixed, scratch = np.empty((M, G)), np.empty((7, max(G, 128) + 16))
    work, value, sines = np.empty((4, G)), np.empty(G), np.empty(G)
    kept, used = np.empty(4096 if keep else 0), 0
    carried = Drift(np.empty(G, np.int64), np.empty((4, G)))
    low, high = trim(p, _FIRST, G)
    for t in range(T):
        echo, reach = ping.echo[t], 0
        if echo:
            mix(p, low, high, motion.transition, mixed)
            if motion.favour.shape[0] > 0:
                favour_cells(mixed, low, high, motion.favour[t])
        else:
            for j in range(M):
                for g in range(low, high):
                    mixed[j, g] = p[j, g]
        if t >= ping.geometry.drift_from:
            to_low, to_high = find_drift(cells, low, high, t, ping.geometry, carried, work)
            for j in range(M):
                push(mixed[j], low, high, carried, p[j], to_low, to_high)
                for g in range(to_low, to_high):
                    mixed[j, g] = p[j, g]
            low, high = to_low, to_high
        for j in range(M):
            reach = max(reach, reach_of(sigma[t, j if echo else coast]))
        new_low, new_high = max(low - reach, 0), min(high + reach, G)
        for j in range(M):
            width = sigma[t, j if echo else coast]
            walk(mixed[j], low, high, width, scratch, p[j], new_low, new_high)
        low, high = trim(p, new_low, new_high)
        n = high - low
        here = value[:n]
        if echo:
            state_log_likelihoods(cells[low:high], ping, t, sines[:n], work, here)
        else:
            for g in range(n):
                here[g] = 0.0
        track.log_likelihood[t] = weigh(p, low, high, here, work)
        low, high = trim(p, low, high)
        window[t, 0], window[t, 1] = low, high
        track.mean[t, 0], track.covariance[t, 0, 0] = summarise(
            p, low, high, cells, track.probability[t]
        )
        if keep:
            needed = used + M * (high - low)
            if needed > kept.shape[0]:
                larger = np.empty(2 * needed)
                for s in range(used):
                    larger[s] = kept[s]
                kept = larger
            for j in range(M):
                for g in range(low, high):
                    kept[used] = p[j, g]
                    used += 1
    return kept


@kernel
def smooth_ping(
    kept: FloatArray,
    window: IntArray,
    motion: GridMotion,
    ping: PingLikelihood,
    track: Track,
) -> None:
    """Forward-backward: what `filter_ping` kept, given the whole ping. The answers of all bins but
    the last are written anew into `track`."""
    cells, coast = motion.cells, motion.coast
    M, G, T = motion.transition.shape[0], cells.shape[0], ping.ranges.shape[0]
    beta, back, p = np.empty((M, G)), np.empty((M, G)), np.empty((M, G))
    scratch, work = np.empty((7, max(G, 128) + 16)), np.empty((4, G))
    value, sines = np.empty(G), np.empty(G)
    carried = Drift(np.empty(G, np.int64), np.empty((4, G)))
    backwards, end = motion.transition.T.copy(), 0  # in rows, as `mix` is compiled for
    for t in range(T):
        end += M * (window[t, 1] - window[t, 0])
    low, high = window[T - 1, 0], window[T - 1, 1]
    for j in range(M):
        for g in range(low, high):
            beta[j, g] = 1.0
    end -= M * (high - low)
    for t in range(T - 2, -1, -1):
        echo = ping.echo[t + 1]
        if echo:
            n = high - low
            state_log_likelihoods(cells[low:high], ping, t + 1, sines[:n], work, value[:n])
            weigh(beta, low, high, value[:n], work)
        new_low, new_high = window[t, 0], window[t, 1]
        drifts = t + 1 >= ping.geometry.drift_from
        to_low, to_high = new_low, new_high
        if drifts:
            to_low, to_high = find_drift(
                cells, new_low, new_high, t + 1, ping.geometry, carried, work
            )
        for j in range(M):
            width = motion.sigma[t + 1, j if echo else coast]
            walk(beta[j], low, high, width, scratch, back[j], to_low, to_high)
            if drifts:
                pull(back[j], new_low, new_high, carried, beta[j], to_low, to_high)
                for g in range(new_low, new_high):
                    back[j, g] = beta[j, g]
        low, high = new_low, new_high
        if echo:
            if motion.favour.shape[0] > 0:
                favour_cells(back, low, high, motion.favour[t + 1])
            mix(back, low, high, backwards, beta)
        else:
            for j in range(M):
                for g in range(low, high):
                    beta[j, g] = back[j, g]
        end -= M * (high - low)
        total, s = 0.0, end
        for j in range(M):
            for g in range(low, high):
                p[j, g] = kept[s] * beta[j, g]
                total += p[j, g]
                s += 1
        for j in range(M):
            for g in range(low, high):
                p[j, g] /= total
        track.mean[t, 0], track.covariance[t, 0, 0] = summarise(
            p, low, high, cells, track.probability[t]
        )


@kernel
def favour_cells(p: FloatArray, low: int, high: int, favour: FloatArray) -> None:
    """Multiply each model's row of p (M, G) on [low, high) by its factor."""
    for j in range(p.shape[0]):
        for g in range(low, high):
            p[j, g] *= favour[j]


@kernel
def state_log_likelihoods(
    state: FloatArray,
    ping: PingLikelihood,
    t: int,
    sines: FloatArray,
    work: FloatArray,
    out: FloatArray,
) -> None:
    """Log likelihood of states (n,) given bin t into out (n,); sines (n,) and work (4, n or more)
    are scratch."""
    sines_of(state, t, ping.geometry, work, sines)
    log_likelihoods(
        sines,
        ping.geometry.spacing,
        ping.form[t],
        ping.base[t],
        ping.spread[t],
        ping.signal[t],
        ping.table,
        work,
        out,
    )
