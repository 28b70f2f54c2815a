# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Both heights of a bin, three kernels: `two_surfaces` says what they do.

lone (G,) holds what is known of one height, two (G + 2 K, G + 2 K) of pairs i, j >= i + gap, K + i
its row and K + j its column; K is how far a height of two can walk. The outer K rows and columns
are zero, as everything nearer to the diagonal than `gap`. Packed pairs come row after row.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...estimation.jit import kernel

# As in `filter_kernels`: exp, cos and sin of many numbers at a time.
ROUND = 1.5 * 2.0**52
PER_LN2 = 1.0 / math.log(2.0)
LN2, LN2_REST = 6.93147180369123816490e-01, 1.90821492927058770002e-10
LEAST_EXPONENT = -700.0
E = tuple(1.0 / math.factorial(k) for k in range(13))
SINE = tuple((-1.0) ** k * math.pi ** (2 * k + 1) / math.factorial(2 * k + 1) for k in range(11))
COSINE = tuple((-1.0) ** k * math.pi ** (2 * k) / math.factorial(2 * k) for k in range(11))


@kernel
def pair_likelihoods(
    y: NDArray[np.complex128],
    v: float,
    sines: NDArray[np.float64],
    spacing: float,
    gap: int,
    work: NDArray[np.float64],
    bits: NDArray[np.int64],
    two: NDArray[np.float64],
    price: NDArray[np.float64],
    lone: NDArray[np.float64],
    pairs: NDArray[np.float32],
) -> None:
    """Find the likelihoods of one height, into lone (G,), and of pairs, packed into `pairs`, up to
    a common factor, of a bin y (P,) in units of the noise, v times which is the signal; sines (G,)
    of the heights, NaN where no echo can come from. work (11, G), its memory as whole numbers,
    bits, and two and price (G, G) are scratch."""
    P, G = y.shape[0], sines.shape[0]
    d = P + 1.0 / v
    for part in range(4):
        # cos and sin of the phase from stave to stave, of what leads to the middle of the array,
        # and, of both of which G = n / m is made, of half the phase and P times that.
        turns_of = 0.5 * (P - 1) * spacing if part == 1 else spacing
        turns_of = 0.5 * spacing if part == 2 else turns_of
        turns_of = 0.5 * P * spacing if part == 3 else turns_of
        cosines, sins = work[2 * part], work[2 * part + 1]
        for i in range(G):
            turns = turns_of * sines[i]
            f = turns - ((turns + ROUND) - ROUND)
            t = f * f
            s = SINE[8] + t * (SINE[9] + t * SINE[10])
            s = SINE[4] + t * (SINE[5] + t * (SINE[6] + t * (SINE[7] + t * s)))
            s = f * (SINE[0] + t * (SINE[1] + t * (SINE[2] + t * (SINE[3] + t * s))))
            c = COSINE[8] + t * (COSINE[9] + t * COSINE[10])
            c = COSINE[4] + t * (COSINE[5] + t * (COSINE[6] + t * (COSINE[7] + t * c)))
            c = COSINE[0] + t * (COSINE[1] + t * (COSINE[2] + t * (COSINE[3] + t * c)))
            cosines[i] = c * c - s * s
            sins[i] = 2.0 * s * c
    re, im, power = work[8], work[9], work[10]
    for i in range(G):
        re[i] = y[P - 1].real
        im[i] = y[P - 1].imag
    for k in range(P - 2, -1, -1):
        a, b = y[k].real, y[k].imag
        for i in range(G):
            x = re[i] * work[0, i] + im[i] * work[1, i] + a
            im[i] = im[i] * work[0, i] - re[i] * work[1, i] + b
            re[i] = x
    top = 0.0
    for i in range(G):
        x = re[i] * work[2, i] - im[i] * work[3, i]
        im[i] = re[i] * work[3, i] + im[i] * work[2, i]
        re[i] = x
        power[i] = re[i] * re[i] + im[i] * im[i]
        lone[i] = power[i] / d
        top = lone[i] if lone[i] > top else top
    for i in range(G):
        near = min(i + gap, G)
        row, cost = two[i, near:], price[i, near:]
        c_i, s_i, C_i, S_i = work[4, i], work[5, i], work[6, i], work[7, i]
        re_i, im_i, power_i = re[i], im[i], power[i]
        c_j, s_j, C_j, S_j = work[4, near:], work[5, near:], work[6, near:], work[7, near:]
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
    single, double, k = 1.0 / (1.0 + v * P), 1.0 / (v * v), 0
    # The exponentials of all rows of pairs, then those of one height.
    for i in range(G - gap + 1):
        row = two[i, i + gap :] if i < G - gap else lone
        count = row.shape[0]
        for j in range(count):
            x = row[j] - top
            x = x if x > LEAST_EXPONENT else LEAST_EXPONENT
            whole = x * PER_LN2 + ROUND
            work[1, j] = whole
            whole -= ROUND
            f = (x - whole * LN2) - whole * LN2_REST
            p = E[9] + f * (E[10] + f * (E[11] + f * E[12]))
            p = E[5] + f * (E[6] + f * (E[7] + f * (E[8] + f * p)))
            work[0, j] = 1.0 + f * (1.0 + f * (E[2] + f * (E[3] + f * (E[4] + f * p))))
        for j in range(count):
            bits[1, j] = (bits[1, j] + 1023) << 52
        for j in range(count):
            row[j] = work[0, j] * work[1, j] if row[j] - top > LEAST_EXPONENT else 0.0
        if i < G - gap:
            cost = price[i, i + gap :]
            for j in range(count):
                x = row[j] * cost[j] * double
                pairs[k] = x if x == x else 0.0
                k += 1
    for i in range(G):
        lone[i] = lone[i] * single if sines[i] == sines[i] else 0.0


@kernel
def step_orders(
    lone: NDArray[np.float64],
    two: NDArray[np.float32],
    birth: float,
    end: float,
    anywhere: float,
    walk: NDArray[np.float64],
    walk_of_two: NDArray[np.float32],
    gap: int,
    backward: bool,
    sums: NDArray[np.float64],
    flat: NDArray[np.float32],
    half: NDArray[np.float32],
) -> None:
    """Go from one bin to the next, in place; `two_surfaces.Moves` says how. backward: the
    transpose, of what later bins say. flat: `two` as one row; sums (3, G) and half, like flat and
    zero at the beginning, are scratch."""
    G, K, W = lone.shape[0], walk_of_two.shape[0] - 1, walk.shape[0] - 1
    width, any_height = G + 2 * K, 1.0 / G
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
    # The height of order 1 walks; what leaves the grid is lost.
    for i in range(G):
        here = walk[0] * lone[i]
        for k in range(1, min(W, G - 1) + 1):
            if i >= k:
                here += walk[k] * lone[i - k]
            if i + k < G:
                here += walk[k] * lone[i + k]
        moved[i] = here
    # What changes order: forward by birth and end, backward the other way round.
    born, ends = birth * any_height, 0.5 * end
    up, down = (ends, born) if backward else (born, ends)
    stay, leap = 1.0 - anywhere, anywhere * any_height
    for i in range(G):
        held = rows[i] + columns[i]
        moved[i] = (1.0 - birth) * (stay * moved[i] + leap * total) + down * held
        rows[i] = up * lone[i] + (1.0 - end) * 0.5 * leap * held
    # Both heights of a pair walk by themselves, first along the rows, then along the columns. The
    # zeros between two rows are as many as a height can go to both sides.
    first, last = K * width, (width - K) * width
    for stage in range(2):
        source, target = (flat, half) if stage == 0 else (half, flat)
        stride = 1 if stage == 0 else width
        here_of, there = source[first:last], target[first:last]
        for x in range(last - first):
            there[x] = walk_of_two[0] * here_of[x]
        for k in range(1, K + 1):
            tap, away = walk_of_two[k], k * stride
            before = source[first - away : last - away]
            behind = source[first + away : last + away]
            for x in range(last - first):
                there[x] += tap * (before[x] + behind[x])
    kept = (1.0 - end) * stay
    for i in range(G):
        near, more = min(i + gap, G), rows[i]
        for j in range(K + near):
            two[K + i, j] = 0.0
        for j in range(G + K, width):
            two[K + i, j] = 0.0
        row, other = two[K + i, K + near : K + G], rows[near:]
        for j in range(row.shape[0]):
            row[j] = kept * row[j] + more + other[j]
    for i in range(G):
        lone[i] = moved[i]


@kernel
def weigh_orders(
    lone: NDArray[np.float64],
    two: NDArray[np.float32],
    likely_lone: NDArray[np.float64],
    likely_two: NDArray[np.float32],
    kept_lone: NDArray[np.float64],
    kept_two: NDArray[np.float32],
    cells: NDArray[np.float64],
    gap: int,
    backward: bool,
    answer: NDArray[np.float64],
) -> None:
    """Multiply heights and pairs by what a bin says, packed; all together sum to one. Forward what
    comes of it is kept, packed. backward: before that, with what was kept, find the answer (6,) of
    the bin: probabilities of both orders, of a pair, were there one, the mean of the lower and of
    the upper height, and their variances."""
    G, k, K = lone.shape[0], 0, (two.shape[0] - lone.shape[0]) // 2
    if backward:
        single, double = 0.0, 0.0
        low = low_square = high = high_square = 0.0
        for i in range(G):
            single += kept_lone[i] * lone[i]
        for i in range(G - gap):
            total, here, here_square = 0.0, 0.0, 0.0
            row = two[K + i, K:]
            for j in range(i + gap, G):
                p = kept_two[k] * row[j]
                total += p
                here += p * cells[j]
                here_square += p * cells[j] * cells[j]
                k += 1
            double += total
            low += total * cells[i]
            low_square += total * cells[i] * cells[i]
            high += here
            high_square += here_square
        low, high = low / double, high / double
        answer[0], answer[1], answer[2], answer[3] = single, double, low, high
        answer[4] = max(low_square / double - low * low, 0.0)
        answer[5] = max(high_square / double - high * high, 0.0)
    k, total = 0, 0.0
    for i in range(G):
        lone[i] *= likely_lone[i]
        total += lone[i]
    for i in range(G - gap):
        row = two[K + i]
        for j in range(K + i + gap, K + G):
            row[j] *= likely_two[k]
            total += row[j]
            k += 1
    k, share = 0, 1.0 / total
    factor = np.float32(share)
    for i in range(G):
        lone[i] *= share
        if not backward:
            kept_lone[i] = lone[i]
        row = two[K + i]
        for j in range(K + i + gap, K + G):
            row[j] *= factor
            if not backward:
                kept_two[k] = row[j]
                k += 1
