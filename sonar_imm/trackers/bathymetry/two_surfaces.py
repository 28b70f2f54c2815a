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

"""Whether a range bin holds two surfaces (``gated``), and the height of both (``resolved``).

Only stretches of a ping are looked at in which `acoustics.layover` finds a second surface
possible. There an exact filter and smoother runs on a grid of heights. A bin is of order 1, one
height h, or of order 2, a pair h1 < h2 at least `APART` from each other::

    birth   order 1 -> 2: the height stays, the other one may be anywhere
    end     order 2 -> 1: either height survives
    move    each height walks, mostly little; sometimes it goes anywhere, as three surfaces do
            that take turns to be the two strongest

The amplitudes of the echoes are integrated out. With the local signal-to-noise ratio v,
d = P + 1/v, b = a^H y of the middle of the array, y in units of the noise, and real
G = a1^H a2 = n / m, n = sin(P x / 2), m = sin(x / 2), x the difference of both phase steps::

    log l1 = |b|^2 / d - log(1 + v P)
    log l2 = (d (|b1|^2 + |b2|^2) - 2 G Re(conj(b1) b2)) / (d^2 - G^2) - log(v^2 (d^2 - G^2))

Multiplied by m^2, a pair takes one division. All moves are symmetric and act on each height by
itself, so that the smoother uses them as they are.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.ndimage import median_filter

from ...acoustics.layover import BIRTH, END, Layover
from ...acoustics.likelihood_kernels import horner
from ...acoustics.variances import HALF_WIDTH, mean_power, moving_mean
from ...estimation.arrays import BoolArray, ComplexArray, FloatArray
from ...estimation.elementary import exponentials, phasors
from ...estimation.jit import kernel
from .kernels import Geometry, PingLikelihood, sines_of

POSSIBLE, MARGIN = 0.05, 10
"""A stretch is where the chain says more than this, and so many bins around it."""
BRIGHTER, AROUND = 3.0, 60
"""It is also where the power, a mean of 21 bins, is so many times the median of so many bins to
either side: what faces the sonar is bright, also where two waves are too faint for the chain."""
EXISTS = 0.5
"""From this probability on both surfaces are soundings."""
FEWEST_STAVES = 4
STEP, BELOW, ABOVE, ABOVE_HIGHER = 0.1, 1.5, 4.5, 1.5
"""Metres: the grid's step, and how far it reaches below and above the lower of the floors at both
ends of a stretch, and at least above the higher one."""
MOST_CELLS = 121
LONGEST = 4000
"""A stretch of more bins is cut: what is kept of each bin takes 14 kB or more."""
APART = 0.3
WALK = (0.98, 0.03), (0.02, 0.2)
WALK_OF_TWO = (0.7, 0.04), (0.3, 0.2)
"""Share and standard deviation, m, of the moves from one bin to the next."""
ANYWHERE = 0.002
NOISE = 1.3
"""By this factor noise is larger than stated: there are more than two echoes in many bins."""
WIDER, WIDEST = 1.5, 0.05
"""Standard deviations are larger than those of the grid by this factor, and by so many metres."""
START_STD, LEAST_START = 0.1, 1e-9
"""How near the floor a stretch begins, m; and what cells have that lie further away."""


class Surfaces(NamedTuple):
    """existence (T,) of a second surface, the heights (T, 2) of the lower and the upper one and
    their variances (T, 2), NaN outside stretches."""

    existence: FloatArray
    height: FloatArray
    variance: FloatArray


class Moves(NamedTuple):
    """How bins follow each other: birth and end of the second height, the chance that a height
    goes `anywhere`, the walks of one height and of each of two, (K + 1,) see `_taps`, and the
    least distance of two, `gap`, in cells."""

    birth: float
    end: float
    anywhere: float
    walk: FloatArray
    walk_of_two: FloatArray
    gap: int


def possible_bins(iq: np.ndarray, second: Layover) -> BoolArray:
    """Bins (T,) of iq (T, P) in which a second surface is possible: the chain says so, or they are
    `BRIGHTER` than those around them."""
    power = np.nan_to_num(moving_mean(mean_power(iq), HALF_WIDTH, second.usable))
    # Made longer here: scipy 1.15 gives zeros for fewer bins than half a window.
    usual = median_filter(np.pad(power, AROUND, 'edge'), 2 * AROUND + 1)[AROUND:-AROUND]
    bright = second.usable & (power > BRIGHTER * usual)
    return np.asarray((second.existence > POSSIBLE) | bright)


def stretches(possible: BoolArray) -> list[tuple[int, int]]:
    """First bin and end of each stretch around bins (T,) in which a second surface is possible."""
    near = np.convolve(possible, np.ones(2 * MARGIN + 1))[MARGIN:-MARGIN] > 0.5
    edges = np.flatnonzero(np.diff(np.concatenate([[False], near, [False]]).astype(np.int8)))
    return [
        (low, min(low + LONGEST, end))
        for first, end in edges.reshape(-1, 2).tolist()
        for low in range(first, end, LONGEST)
    ]


def resolve(
    iq: np.ndarray, ping: PingLikelihood, geometry: Geometry, second: Layover, floor: FloatArray
) -> Surfaces:
    """Both surfaces in the stretches of a ping: iq (T, P), how heights become directions, what
    `acoustics.layover` says, and the height of the floor (T,) as a single surface has it."""
    existence = np.array(second.existence)
    height, variance = np.full((2, len(existence), 2), np.nan)
    snr = ping.signal / ping.noise
    larger = NOISE * (1.0 + second.array_error * snr)
    moves = Moves(
        BIRTH,
        END,
        ANYWHERE,
        _taps(WALK),
        _taps(WALK_OF_TWO).astype(np.float32),
        round(APART / STEP),
    )
    for first, end in stretches(possible_bins(iq, second)):
        here = slice(first, end)
        cells = _cells(floor, first, end)
        start = np.exp(-0.5 * np.square((cells - floor[first]) / START_STD)) + LEAST_START
        smooth_stretch(
            first,
            start / start.sum(),
            cells,
            (iq[here] / np.sqrt(ping.noise * larger)[here, None]).astype(np.complex128),
            (snr / larger)[here],
            second.usable[here],
            geometry,
            moves,
            existence[here],
            height[here],
            variance[here],
        )
    return Surfaces(existence, height, WIDER**2 * (variance + STEP**2 / 12.0) + WIDEST**2)


def _cells(floor: FloatArray, first: int, end: int) -> FloatArray:
    """The grid (G,) of a stretch, by the floors before and behind it."""
    before = float(np.median(floor[max(first - MARGIN, 0) : first + MARGIN]))
    behind = float(np.median(floor[max(end - MARGIN, 0) : end + MARGIN]))
    low, high = min(before, behind), max(before, behind)
    top = max(low + ABOVE, high + ABOVE_HIGHER)
    count = min(round((top - low + BELOW) / STEP) + 1, MOST_CELLS)
    return np.asarray(low - BELOW + STEP * np.arange(count, dtype=np.float64))


def _taps(walk: tuple[tuple[float, float], ...]) -> FloatArray:
    """Probabilities (K + 1,) of moving by 0, 1, ... K cells in either direction."""
    reach = math.ceil(3.5 * max(std for _, std in walk) / STEP)
    place = STEP * np.arange(-reach, reach + 1)
    taps = np.zeros(2 * reach + 1)
    for share, std in walk:
        part = np.exp(-0.5 * np.square(place / std))
        taps += share * part / part.sum()
    return np.ascontiguousarray(taps[reach:])


@kernel
def pair_likelihoods(
    y: ComplexArray,
    v: float,
    sines: FloatArray,
    spacing: float,
    gap: int,
    work: FloatArray,
    price: FloatArray,
    lone: FloatArray,
    two: FloatArray,
) -> bool:
    """Likelihoods of one height, into lone (G,), and of pairs i, j >= i + gap, into two (G, G), up
    to a common factor, of a bin y (P,) in units of the noise; sines (G,) of the heights, NaN
    where no echo can come from. False if that is everywhere. work (8, G or more) and price (G, G)
    are scratch."""
    P, G = y.shape[0], sines.shape[0]
    c, s, C, S = work[0, :G], work[1, :G], work[2, :G], work[3, :G]
    re, im, power = work[4, :G], work[5, :G], work[6, :G]
    d = P + 1.0 / v
    phasors(sines, spacing, c, s)
    horner(y, c, s, re, im)
    phasors(sines, 0.5 * (P - 1) * spacing, c, s)
    for i in range(G):
        x = re[i] * c[i] - im[i] * s[i]
        im[i] = re[i] * s[i] + im[i] * c[i]
        re[i] = x
        power[i] = re[i] * re[i] + im[i] * im[i]
    phasors(sines, 0.5 * spacing, c, s)
    phasors(sines, 0.5 * P * spacing, C, S)
    top = 0.0
    for i in range(G):
        lone[i] = power[i] / d
        top = lone[i] if lone[i] > top else top
    for i in range(G):
        near = min(i + gap, G)
        row, cost = two[i, near:], price[i, near:]
        c_i, s_i, C_i, S_i, re_i, im_i, power_i = c[i], s[i], C[i], S[i], re[i], im[i], power[i]
        c_j, s_j, C_j, S_j = c[near:], s[near:], C[near:], S[near:]
        re_j, im_j, power_j = re[near:], im[near:], power[near:]
        for j in range(row.shape[0]):
            m = s_j[j] * c_i - c_j[j] * s_i
            n = S_j[j] * C_i - C_j[j] * S_i
            r = m / (d * d * m * m - n * n)
            cross = re_i * re_j[j] + im_i * im_j[j]
            row[j] = (d * m * (power_i + power_j[j]) - 2.0 * n * cross) * r
            cost[j] = m * r
        for j in range(row.shape[0]):
            top = row[j] if row[j] > top else top
    single, double = 1.0 / (1.0 + v * P), 1.0 / (v * v)
    for i in range(G):
        c[i] = lone[i] - top
    exponentials(c, s, lone)
    reached = False
    for i in range(G):
        reached = reached or sines[i] == sines[i]
        lone[i] = lone[i] * single if sines[i] == sines[i] else 0.0
    for i in range(G - gap):
        row, cost = two[i, i + gap :], price[i, i + gap :]
        n = row.shape[0]
        for j in range(n):
            c[j] = row[j] - top
        exponentials(c[:n], s, row)
        for j in range(n):
            x = row[j] * cost[j] * double
            row[j] = x if x == x else 0.0
    return reached


@kernel
def walk_of_two(p: FloatArray, taps: FloatArray, gap: int, half: FloatArray) -> None:
    """Move both heights of pairs by themselves: p (G + 2K, G + 2K), whose outer K rows and columns
    are zero, as everything nearer to the diagonal than `gap`. What would get there is lost. half:
    scratch like p, its outer rows zero."""
    K, width = taps.shape[0] - 1, p.shape[0]
    first, last = K * width, (width - K) * width
    # The zeros between two rows are as many as a height can go to both sides.
    spread(p.ravel(), 1, taps, first, last, half.ravel())
    spread(half.ravel(), width, taps, first, last, p.ravel())
    for i in range(K, width - K):
        p[i, : min(i + gap, width)] = 0.0
        p[i, width - K :] = 0.0


@kernel
def spread(
    values: FloatArray, stride: int, taps: FloatArray, first: int, last: int, out: FloatArray
) -> None:
    """Sum of taps[k] times what lies k strides before and behind, of [first, last), into out."""
    n, there = last - first, out[first:last]
    here = values[first:last]
    for x in range(n):
        there[x] = taps[0] * here[x]
    for k in range(1, taps.shape[0]):
        tap, away = taps[k], k * stride
        before, behind = values[first - away : last - away], values[first + away : last + away]
        for x in range(n):
            there[x] += tap * (before[x] + behind[x])


@kernel
def walk_of_single(p: FloatArray, taps: FloatArray, out: FloatArray) -> None:
    """Move the height of order 1: p and out (G,). What leaves the grid is lost."""
    G, K = p.shape[0], taps.shape[0] - 1
    for i in range(G):
        total = taps[0] * p[i]
        for k in range(1, min(K, G - 1) + 1):
            if i >= k:
                total += taps[k] * p[i - k]
            if i + k < G:
                total += taps[k] * p[i + k]
        out[i] = total


@kernel
def step_orders(
    lone: FloatArray,
    two: FloatArray,
    moves: Moves,
    backward: bool,
    sums: FloatArray,
    half: FloatArray,
) -> None:
    """From one bin to the next, in place: lone (G,), two (G + 2K, G + 2K) as `walk_of_two` takes
    it. backward: the transpose, of what later bins say. sums (3, G) and half are scratch."""
    G, K, gap = lone.shape[0], moves.walk_of_two.shape[0] - 1, moves.gap
    any_height = 1.0 / G
    rows, columns, moved = sums[0], sums[1], sums[2]
    total = 0.0
    for i in range(G):
        columns[i] = 0.0
        total += lone[i]
    for i in range(G):
        near, here = min(i + gap, G), 0.0
        row, column = two[K + i, K + near : K + G], columns[near:]
        for j in range(row.shape[0]):
            here += row[j]
            column[j] += row[j]
        rows[i] = here
    walk_of_single(lone, moves.walk, moved)
    # What changes order: forward by birth and end, backward the other way round.
    birth, end = moves.birth * any_height, 0.5 * moves.end
    up, down = (end, birth) if backward else (birth, end)
    stay, leap = 1.0 - moves.anywhere, moves.anywhere * any_height
    for i in range(G):
        held = rows[i] + columns[i]
        moved[i] = (1.0 - moves.birth) * (stay * moved[i] + leap * total) + down * held
        rows[i] = up * lone[i] + (1.0 - moves.end) * 0.5 * leap * held
    walk_of_two(two, moves.walk_of_two, gap, half)
    kept = (1.0 - moves.end) * stay
    for i in range(G):
        near, more = min(i + gap, G), rows[i]
        row, other = two[K + i, K + near : K + G], rows[near:]
        for j in range(row.shape[0]):
            row[j] = kept * row[j] + more + other[j]
    for i in range(G):
        lone[i] = moved[i]


@kernel
def smooth_stretch(
    first: int,
    start: FloatArray,
    cells: FloatArray,
    y: ComplexArray,
    ratio: FloatArray,
    usable: BoolArray,
    geometry: Geometry,
    moves: Moves,
    existence: FloatArray,
    height: FloatArray,
    variance: FloatArray,
) -> None:
    """Filter and smoother of a stretch of n bins that begins at bin `first`.

    start (G,): probabilities of cells (G,), heights of order 1, at the first bin; y (n, P) in
    units of the noise, ratio (n,) of signal to noise, and which bins are usable (n,): the others
    say nothing. Into existence (n,), and of a pair, were there one, lower and upper height (n, 2)
    and their variance (n, 2).
    """
    n, G = y.shape[0], start.shape[0]
    K, gap = moves.walk_of_two.shape[0] - 1, moves.gap
    pairs = (G - gap) * (G - gap + 1) // 2
    # Of each bin: what it says itself, and what it and those before say; pairs row after row.
    likely_lone, likely_two = np.ones((n, G)), np.ones((n, pairs), np.float32)
    kept_lone, kept_two = np.empty((n, G)), np.empty((n, pairs), np.float32)
    lone, two = np.empty(G), np.zeros((G + 2 * K, G + 2 * K), np.float32)
    half = np.zeros((G + 2 * K, G + 2 * K), np.float32)
    alone, sines, work, sums = np.empty(G), np.empty(G), np.empty((8, G)), np.empty((3, G))
    likelihood, price = np.empty((G, G)), np.empty((G, G))
    for i in range(G):
        lone[i] = start[i]
    for t in range(n):
        if t > 0:
            step_orders(lone, two, moves, False, sums, half)
        if usable[t]:
            sines_of(cells, first + t, geometry, work, sines)
            reached = pair_likelihoods(
                y[t], ratio[t], sines, geometry.spacing, gap, work, price, alone, likelihood
            )
            if reached:
                for i in range(G):
                    likely_lone[t, i] = alone[i]
                pack(likelihood, 0, gap, likely_two[t])
        weigh_orders(lone, two, likely_lone[t], likely_two[t], K, gap)
        for i in range(G):
            kept_lone[t, i] = lone[i]
        pack(two, K, gap, kept_two[t])
    # From here on what later bins say of each height and pair.
    for i in range(G):
        lone[i] = 1.0
        for j in range(i + gap, G):
            two[K + i, K + j] = 1.0
    for t in range(n - 1, -1, -1):
        single, double, k = 0.0, 0.0, 0
        low = low_square = high = high_square = 0.0
        for i in range(G):
            single += kept_lone[t, i] * lone[i]
        for i in range(G - gap):
            row, here, here_square = 0.0, 0.0, 0.0
            for j in range(i + gap, G):
                p = kept_two[t, k] * two[K + i, K + j]
                row += p
                here += p * cells[j]
                here_square += p * cells[j] * cells[j]
                k += 1
            double += row
            low += row * cells[i]
            low_square += row * cells[i] * cells[i]
            high += here
            high_square += here_square
        if single + double > 0.0:
            existence[t] = double / (single + double)
        if double > 0.0:
            low, high = low / double, high / double
            height[t, 0], height[t, 1] = low, high
            variance[t, 0] = max(low_square / double - low * low, 0.0)
            variance[t, 1] = max(high_square / double - high * high, 0.0)
        if t > 0:
            weigh_orders(lone, two, likely_lone[t], likely_two[t], K, gap)
            step_orders(lone, two, moves, True, sums, half)


@kernel
def pack(two: FloatArray, border: int, gap: int, out: FloatArray) -> None:
    """The pairs i, j >= i + gap of two (G + 2 border, G + 2 border) into out, row after row."""
    n, k = two.shape[0] - border, 0
    for i in range(border, n - gap):
        row = two[i]
        for j in range(i + gap, n):
            out[k] = row[j]
            k += 1


@kernel
def weigh_orders(
    lone: FloatArray,
    two: FloatArray,
    likely_lone: FloatArray,
    likely_two: FloatArray,
    border: int,
    gap: int,
) -> None:
    """Multiply heights (G,) and pairs by what a bin says, packed; all together sum to one."""
    G, k, total = lone.shape[0], 0, 0.0
    for i in range(G):
        lone[i] *= likely_lone[i]
        total += lone[i]
    for i in range(G - gap):
        row = two[border + i]
        for j in range(border + i + gap, border + G):
            row[j] *= likely_two[k]
            total += row[j]
            k += 1
    share = 1.0 / total
    factor = np.float32(share)
    for i in range(G):
        lone[i] *= share
        row = two[border + i]
        for j in range(border + i + gap, border + G):
            row[j] *= factor
