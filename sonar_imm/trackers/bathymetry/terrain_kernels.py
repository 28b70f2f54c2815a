# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Two Gaussian filters along the range bins of one ping, outward and inward, and their fusion.

Given the model j, the state is Gaussian: the height b of the base and its slope s, with the
probability mu_j. The height of a bin lies about the base with the scatter of its model,
``h | b ~ N(b, scatter_j^2)``, and only h meets the samples. The verbs::

    mix         x, P <- x, P, mu, chain           # one Gaussian for all that could become model j
    predict     x <- F x, P <- F P F' + Q
    weigh       m, V, evidence <- N(b, S) L(h)    # the exact law at five nodes
    update      x, P <- x, P, m, V                # the slope follows the height by regression
    fuse        x, P <- outward, inward           # two predictions of a bin, then weigh once more

**Mixing** is that of the Gaussian IMM, by moments, with one exception: of what could become a
model, sources below `FAINT` of the largest one give their probability and not their moments. A
source that has just drawn its slope anew, at a probability of 1e-4, would widen the slope of a
steady floor for ever.

**Weighing** needs one integral over h for each model. The logarithm L of the likelihood has
several maxima, one for each lobe of the beam. The search for the one that matters begins at b, or,
where the samples know more than the prediction, at the product of the prediction with the main
lobe, if that is more probable. Its steps majorise: L is a mixture of Gaussian laws over the
unknown power of the echo, so ``-f'(q)`` is the weight of the EM algorithm, and ``-f'(q) max(q'',
0)`` is at least the curvature. Then five Gauss-Hermite nodes about the maximum, at the width of
the curvature, give evidence, mean and variance. What all share is ``q(psi) = Re sum_k g_k exp(-i k
psi)`` of the phase step psi from stave to stave, with both derivatives by Horner's rule, and f and
its derivatives by the table of `acoustics.laplace.likelihood_table`, as in `filter_kernels`.

**Fusion.** All slopes have one stationary law N(0, slope0^2) and the chain is reversible, so the
ping backwards obeys the same models, with s -> -s. Two predictions of a bin, neither of which has
seen it, are independent but for that law, which both hold and which is taken off once.

Shapes: T bins, M models, P staves. Loops over lanes, a model or one of its nodes each, are written
so that the compiler can run them several at a time. Nothing is allocated here.

Reference: H. Blom, Y. Bar-Shalom, *The interacting multiple model algorithm for systems with
Markovian switching coefficients*, IEEE Trans. Automatic Control 33(8), 1988; A. Doucet, N. de
Freitas, N. Gordon, *Sequential Monte Carlo Methods in Practice*, 2001, of two-filter smoothing.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ...estimation.jit import kernel

FAINT = 0.01
"""Sources of a mixture below this share of the largest one do not give their moments."""
STEPS, NEAR, FARTHEST = 4, 0.3, 3.0
"""The search for the maximum: at most so many steps, until one is shorter than `NEAR` standard
deviations; none is longer than `FARTHEST` of the prediction."""
LEAST_CURVATURE = 0.3
"""Of the curvature that majorises."""
LEAST_VARIANCE = 0.05
"""Of the variance at the maximum: where one node has all the weight, five say nothing of it."""
NEGLIGIBLE = 14.0
"""Models whose fused log probability is below the best one by so much are not weighed."""
END_VARIANCE = 9.0
"""m^2, of the start of the inward filter about the end of the outward one."""
STATIONARY_SHARE = 0.99
NODES = 5
NODE = (-2.0201828704560856, -0.9585724646138185, 0.0, 0.9585724646138185, 2.0201828704560856)
# Logarithms of the weights of Gauss and Hermite, and the squares of the nodes added to them.
LOG_NODE = tuple(
    math.log(weight) + node * node
    for weight, node in zip(
        (
            0.019953242059045913,
            0.39361932315224116,
            0.9453087204829419,
            0.39361932315224116,
            0.019953242059045913,
        ),
        NODE,
    )
)
HALF_LOG_PI = 0.5 * math.log(math.pi)
TURN = 2.0 * math.pi
ROUND = 1.5 * 2.0**52
"""Adding this to a double and taking it away again rounds it to a whole number."""
# Taylor series in f^2 of sin(pi f) / f and cos(pi f), for abs(f) <= 1/2.
S = tuple((-1.0) ** k * math.pi ** (2 * k + 1) / math.factorial(2 * k + 1) for k in range(11))
C = tuple((-1.0) ** k * math.pi ** (2 * k) / math.factorial(2 * k) for k in range(11))
# The cells of `acoustics.laplace.likelihood_table`: 32 to the octave, from 2^-20 to 2^50. The
# density has no bound at q = 0, which only noise-free samples reach: q stays above `LOWEST`.
LOWEST, HIGHEST = 1e-3, 2.0**50 * (1.0 - 2.0**-50)
CELL_BITS = 5
SHIFT = 52 - CELL_BITS
FIRST_CELL = (1023 - 20) << CELL_BITS
REST = (1 << SHIFT) - 1
ONE = 1023 << 52
EXPONENT = 0x7FF << 52
ROWS = 20
"""Rows of scratch."""


@kernel
def filter_terrain(
    turns: int,
    walk: NDArray[np.float64],
    phi: NDArray[np.float64],
    follow: NDArray[np.bool_],
    scatter: NDArray[np.float64],
    coast: NDArray[np.int64],
    chain: NDArray[np.float64],
    stationary: NDArray[np.float64],
    slope0: float,
    width: float,
    start_mean: float,
    start_std: float,
    favour: NDArray[np.float64],
    temper: float,
    echo: NDArray[np.bool_],
    form: NDArray[np.complex128],
    base: NDArray[np.float64],
    spread: NDArray[np.complex128],
    signal: NDArray[np.float64],
    table: NDArray[np.float64],
    peak: NDArray[np.float64],
    peak_variance: NDArray[np.float64],
    height: NDArray[np.float64],
    reach: NDArray[np.float64],
    cos_tilt: NDArray[np.float64],
    sin_tilt: NDArray[np.float64],
    spacing: float,
    launch: NDArray[np.float64],
    row: NDArray[np.float64],
    first_depth: float,
    depth_step: float,
    kept: NDArray[np.float64],
    x: NDArray[np.float64],
    pred: NDArray[np.float64],
    mu: NDArray[np.float64],
    who: NDArray[np.int64],
    work: NDArray[np.float64],
    bits: NDArray[np.int64],
    mean: NDArray[np.float64],
    variance: NDArray[np.float64],
    probability: NDArray[np.float64],
    log_likelihood: NDArray[np.float64],
) -> None:
    """Filter a ping outward (turns 1), or outward, inward and fused (turns 3).

    Models: walk (M,) m a bin; phi (M,) of the slope kept over a bin; follow (M,): b moves with the
    slope; scatter (M,) m; coast (M,): the model whose motion crosses bins without an echo; chain
    (M, M), reversible, with the law `stationary` (M,); slope0 of the law of slopes; width of a
    bin, m; start_mean and start_std of the base before the first bin; favour (T, M): see
    `models.TerrainModels`, (0, M) for none.

    The likelihood and the geometry: see `filter_kernels.filter_block`, but for spread and launch,
    which have no column and no row where there are none; temper: the log likelihood
    counts so much; peak (T,): the height from which the beam is strongest, NaN for none.

    Scratch: peak_variance (T,), kept (2, T, M, 6), x (M, 5), pred (M, 6), mu (M,), who (M,), work
    (ROWS, NODES M) and the same memory as whole numbers, bits. Into mean (T,), variance (T,) of
    the height of each bin, probability (T, M), and log_likelihood (T,) of each bin given those
    before it, without what the table leaves out, -inf when no model could explain it and the
    prediction was kept.
    """
    T, M, last = echo.shape[0], walk.shape[0], form.shape[1] - 1
    law, among = slope0 * slope0, spread.shape[1] > 0
    for turn in range(turns):
        center, wide = start_mean, start_std * start_std
        if turn == 1:
            center, wide = 0.0, END_VARIANCE
            for j in range(M):
                center += mu[j] * x[j, 0]
        for j in range(M):
            x[j, 0], x[j, 1], x[j, 2], x[j, 3], x[j, 4] = center, 0.0, wide, 0.0, law
            mu[j] = stationary[j]
        for step in range(T):
            t = T - 1 - step if turn == 1 else step
            count = M
            if turn < 2:
                for j in range(M):
                    # Mix.
                    model, c, largest = j, mu[j], 0.0
                    b, s, bb, bs, ss = x[j, 0], x[j, 1], x[j, 2], x[j, 3], x[j, 4]
                    if echo[t]:
                        c, total, b, s = 0.0, 0.0, 0.0, 0.0
                        for i in range(M):
                            share = chain[i, j] * mu[i]
                            c += share
                            largest = max(largest, share)
                        for i in range(M):
                            share = chain[i, j] * mu[i]
                            if share >= FAINT * largest:
                                total += share
                                b += share * x[i, 0]
                                s += share * x[i, 1]
                        b, s, bb, bs, ss = b / total, s / total, 0.0, 0.0, 0.0
                        for i in range(M):
                            share = chain[i, j] * mu[i] / total
                            if share * total >= FAINT * largest:
                                db, ds = x[i, 0] - b, x[i, 1] - s
                                bb += share * (x[i, 2] + db * db)
                                bs += share * (x[i, 3] + db * ds)
                                ss += share * (x[i, 4] + ds * ds)
                    else:
                        model = coast[j]
                    # Predict.
                    keep, noise = phi[model], law * (1.0 - phi[model] * phi[model])
                    if follow[model]:
                        k = 0.5 * width * (1.0 + keep)
                        b += k * s
                        bb += k * (2.0 * bs + k * ss) + 0.25 * width * width * noise
                        bs = keep * (bs + k * ss) + 0.5 * width * noise
                        s, ss = keep * s, keep * keep * ss + noise
                    else:
                        s, bs, ss = 0.0, 0.0, law
                    bb += walk[model] * walk[model]
                    pred[j, 0], pred[j, 1], pred[j, 2] = b, s, bb
                    pred[j, 3], pred[j, 4], pred[j, 5] = bs, ss, c
                    for k in range(6):
                        kept[turn, t, j, k] = pred[j, k]
                    who[j] = j
            else:
                # Fuse; heights are counted from the outward one.
                best = -math.inf
                for j in range(M):
                    fb, fs, fbb = kept[0, t, j, 0], kept[0, t, j, 1], kept[0, t, j, 2]
                    fbs, fss = kept[0, t, j, 3], kept[0, t, j, 4]
                    off, bs, bbb = kept[1, t, j, 0] - fb, -kept[1, t, j, 1], kept[1, t, j, 2]
                    bbs, bss = -kept[1, t, j, 3], kept[1, t, j, 4]
                    once = min(1.0 / law, STATIONARY_SHARE * max(1.0 / fss, 1.0 / bss))
                    det_f, det_b = fbb * fss - fbs * fbs, bbb * bss - bbs * bbs
                    f00, f01, f11 = fss / det_f, -fbs / det_f, fbb / det_f
                    b00, b01, b11 = bss / det_b, -bbs / det_b, bbb / det_b
                    j00, j01, j11 = f00 + b00, f01 + b01, f11 + b11 - once
                    det = j00 * j11 - j01 * j01
                    h0 = f01 * fs + b00 * off + b01 * bs
                    h1 = f11 * fs + b01 * off + b11 * bs
                    m0, m1 = (j11 * h0 - j01 * h1) / det, (j00 * h1 - j01 * h0) / det
                    misfit = f11 * fs * fs + b00 * off * off + 2.0 * b01 * off * bs
                    misfit += b11 * bs * bs - m0 * h0 - m1 * h1
                    chance = kept[0, t, j, 5] * kept[1, t, j, 5] / stationary[j]
                    chance = math.log(chance) + 0.5 * math.log(law / (det_f * det_b * det))
                    pred[j, 0], pred[j, 1] = fb + m0, m1
                    pred[j, 2], pred[j, 3], pred[j, 4] = j11 / det, -j01 / det, j00 / det
                    pred[j, 5] = chance - 0.5 * misfit
                    if favour.shape[0] > 0:
                        pred[j, 5] += math.log(favour[t, j])
                    best = max(best, pred[j, 5])
                count, total = 0, 0.0
                for j in range(M):
                    above = pred[j, 5] - best
                    pred[j, 5] = math.exp(above) if above > -NEGLIGIBLE else 0.0
                    total += pred[j, 5]
                    if pred[j, 5] > 0.0:
                        who[count] = j
                        count += 1
                for j in range(M):
                    pred[j, 5] /= total
            if turn < 2 and echo[t] and favour.shape[0] > 0:
                total = 0.0
                for j in range(M):
                    pred[j, 5] *= favour[t, j]
                    total += pred[j, 5]
                for j in range(M):
                    pred[j, 5] /= total
            # Weigh, each lane a model. Rows of work: 0 height, 1 and 2 cosine and sine of the
            # phase step, later scratch; 3 to 8 q, its slope and its curvature, and the same of the
            # gain beside interferers; 9 slope of the phase by the height, NaN where no echo can
            # come from; 10 value, 11 slope, 12 curvature that majorises, 13 what curves less; 14
            # prediction, 15 its variance S; 16 mean and 17 variance of the height, 18 evidence.
            arrived = 0
            for stage in range(-1 if turn == 0 else 0, STEPS + 2 if echo[t] else -1):
                lanes = count
                if stage == -1:
                    lanes, work[0, 0] = 1, peak[t]
                elif stage == 0:
                    lanes = 2 * count
                    for a in range(count):
                        j = who[a]
                        b, prior = pred[j, 0], pred[j, 2] + scatter[j] * scatter[j]
                        work[14, a], work[15, a], work[16, a] = b, prior, 0.0
                        work[0, a] = work[0, count + a] = b
                        if prior > peak_variance[t]:
                            weight = prior / (prior + peak_variance[t])
                            work[0, count + a] = b + weight * (peak[t] - b)
                elif stage <= STEPS:
                    if arrived == count:
                        continue
                    arrived = 0
                    for a in range(count):
                        total = 1.0 / work[15, a] + work[12, a]
                        move = work[11, a] - (work[0, a] - work[14, a]) / work[15, a]
                        move /= total
                        most = FARTHEST * math.sqrt(work[15, a])
                        move = min(max(move, -most), most)
                        if work[16, a] > 0.0:
                            move = 0.0
                        work[0, a] += move
                        if move * move * total < NEAR * NEAR:
                            work[16, a] = 1.0
                            arrived += 1
                else:
                    lanes = NODES * count
                    for a in range(count):
                        curve = max(work[12, a] - work[13, a], LEAST_CURVATURE * work[12, a])
                        work[17, a] = 1.0 / (1.0 / work[15, a] + curve)
                        work[16, a] = work[0, a]
                    for k in range(NODES):
                        for a in range(count):
                            wide = math.sqrt(2.0 * work[17, a])
                            work[0, k * count + a] = work[16, a] + wide * NODE[k]
                # The phase step, in turns, and its slope.
                for s in range(lanes):
                    work[1, s] = height[t] - work[0, s]
                    work[9, s] = -1.0
                if len(launch):
                    k = min(max(int(row[t]), 0), launch.shape[0] - 2)
                    f, columns = row[t] - k, launch.shape[1] - 2
                    for s in range(lanes):
                        place = (work[1, s] - first_depth) / depth_step
                        if not 0.0 <= place <= columns + 1.0:
                            work[1, s] = math.nan
                            continue
                        i = min(int(place), columns)
                        low = launch[k, i] + f * (launch[k + 1, i] - launch[k, i])
                        high = launch[k, i + 1] + f * (launch[k + 1, i + 1] - launch[k, i + 1])
                        work[1, s] = low + (place - i) * (high - low)
                        work[9, s] = -(high - low) / depth_step
                for s in range(lanes):
                    ratio = work[1, s] / reach[t]
                    inside = abs(ratio) < 1.0  # false for NaN
                    ratio = ratio if inside else 0.0
                    across = math.sqrt(1.0 - ratio * ratio)
                    change = work[9, s] / reach[t] * (cos_tilt[t] + ratio / across * sin_tilt[t])
                    work[9, s] = TURN * spacing * change if inside else math.nan
                    turned = spacing * (ratio * cos_tilt[t] - across * sin_tilt[t])
                    f = turned - ((turned + ROUND) - ROUND)
                    g = f * f
                    sine = S[8] + g * (S[9] + g * S[10])
                    sine = S[4] + g * (S[5] + g * (S[6] + g * (S[7] + g * sine)))
                    sine = f * (S[0] + g * (S[1] + g * (S[2] + g * (S[3] + g * sine))))
                    cosine = C[8] + g * (C[9] + g * C[10])
                    cosine = C[4] + g * (C[5] + g * (C[6] + g * (C[7] + g * cosine)))
                    cosine = C[0] + g * (C[1] + g * (C[2] + g * (C[3] + g * cosine)))
                    work[1, s] = cosine * cosine - sine * sine
                    work[2, s] = 2.0 * sine * cosine
                # q by Horner's rule; in the search its derivatives too.
                if stage > STEPS:
                    re, im = form[t, last].real, form[t, last].imag
                    for s in range(lanes):
                        work[3, s] = re
                        work[4, s] = im
                    for k in range(last - 1, -1, -1):
                        re, im = form[t, k].real, form[t, k].imag
                        for s in range(lanes):
                            z = work[3, s] * work[1, s] + work[4, s] * work[2, s] + re
                            work[4, s] = work[4, s] * work[1, s] - work[3, s] * work[2, s] + im
                            work[3, s] = z
                    if among:
                        re, im = spread[t, last].real, spread[t, last].imag
                        for s in range(lanes):
                            work[6, s] = re
                            work[7, s] = im
                        for k in range(last - 1, -1, -1):
                            re, im = spread[t, k].real, spread[t, k].imag
                            for s in range(lanes):
                                z = work[6, s] * work[1, s] + work[7, s] * work[2, s] + re
                                work[7, s] = work[7, s] * work[1, s] - work[6, s] * work[2, s] + im
                                work[6, s] = z
                else:
                    for part in range(2 if among else 1):
                        for s in range(lanes):
                            # With d = d/dz, the value p and d p and d^2 p / 2.
                            p, p1, p2 = 0j, 0j, 0j
                            z = complex(work[1, s], -work[2, s])
                            for k in range(last, -1, -1):
                                p2 = p2 * z + p1
                                p1 = p1 * z + p
                                if among and part == 1:
                                    p = p * z + spread[t, k]
                                else:
                                    p = p * z + form[t, k]
                            p1 *= z
                            work[3 + 3 * part, s] = p.real
                            work[4 + 3 * part, s] = p1.imag
                            work[5 + 3 * part, s] = -(2.0 * z * z * p2 + p1).real
                if among:
                    # Beside interferers: the gain 1 + ss2 a^H R^-1 a; its logarithm into work[2].
                    for s in range(lanes):
                        gain = 1.0 + signal[t] * work[6, s]
                        slope, bend = signal[t] * work[7, s], signal[t] * work[8, s]
                        if not gain > 1.0:
                            gain, slope, bend = 1.0, 0.0, 0.0
                        work[2, s] = math.log(gain)
                        q = work[3, s] / gain
                        q1 = (work[4, s] - q * slope) / gain
                        work[5, s] = (work[5, s] - 2.0 * q1 * slope - q * bend) / gain
                        work[3, s], work[4, s] = base[t] + q, q1
                for s in range(lanes):
                    q = work[3, s] if work[3, s] > LOWEST else LOWEST  # NaN goes to the low end
                    work[3, s] = q if q < HIGHEST else HIGHEST
                for s in range(lanes):
                    bits[1, s] = ((bits[3, s] & REST) << CELL_BITS) | ONE
                for s in range(lanes):
                    f = work[1, s] - 1.0
                    # Unsigned, so that no check for an index from the end gets into the loop.
                    cell = np.uint64((bits[3, s] >> SHIFT) - FIRST_CELL)
                    square, cube = table[2, cell], table[3, cell]
                    value = table[0, cell] + f * (table[1, cell] + f * (square + f * cube))
                    work[10, s] = temper * value
                    work[11, s] = temper * (table[1, cell] + f * (2.0 * square + 3.0 * f * cube))
                    work[13, s] = temper * (2.0 * square + 6.0 * f * cube)
                if among:
                    for s in range(lanes):
                        work[10, s] -= temper * work[2, s]
                if stage <= STEPS:
                    for s in range(lanes):
                        bits[1, s] = bits[3, s] & EXPONENT  # the power of two at or below q
                    for s in range(lanes):
                        cells = (1 << CELL_BITS) / work[1, s]
                        slope, q1 = work[11, s] * cells, work[4, s] * work[9, s]
                        work[13, s] *= cells * cells * q1 * q1
                        work[12, s] = -slope * max(work[5, s], 0.0) * work[9, s] * work[9, s]
                        work[11, s] = slope * q1
                for s in range(lanes):
                    if not work[9, s] == work[9, s]:
                        work[10, s] = -math.inf
                        work[11, s], work[12, s], work[13, s] = 0.0, 0.0, 0.0
                if stage == -1:
                    peak_variance[t] = 1.0 / work[12, 0] if work[12, 0] > 0.0 else math.inf
                elif stage == 0:
                    for a in range(count):
                        other = count + a
                        off = work[0, other] - work[14, a]
                        if work[10, other] - 0.5 * off * off / work[15, a] > work[10, a]:
                            work[0, a], work[10, a] = work[0, other], work[10, other]
                            for k in range(11, 14):
                                work[k, a] = work[k, other]
            # The nodes: evidence, mean and variance of the height.
            best = -math.inf
            for a in range(count if echo[t] else 0):
                highest, total, first = -math.inf, 0.0, 0.0
                for k in range(NODES):
                    s = k * count + a
                    off = work[0, s] - work[14, a]
                    work[10, s] += LOG_NODE[k] - 0.5 * off * off / work[15, a]
                    highest = max(highest, work[10, s])
                work[18, a] = -math.inf
                if not math.isfinite(highest):
                    continue
                for k in range(NODES):
                    s = k * count + a
                    work[10, s] = math.exp(work[10, s] - highest)
                    total += work[10, s]
                    first += work[10, s] * work[0, s]
                middle, second = first / total, 0.0
                for k in range(NODES):
                    s = k * count + a
                    off = work[0, s] - middle
                    second += work[10, s] * off * off
                work[18, a] = highest + math.log(total) - HALF_LOG_PI
                work[18, a] += 0.5 * math.log(work[17, a] / work[15, a])
                work[16, a] = middle
                work[17, a] = max(second / total, LEAST_VARIANCE * work[17, a])
                best = max(best, work[18, a])
            total = 0.0
            if math.isfinite(best):
                for a in range(count):
                    j = who[a]
                    work[18, a] = pred[j, 5] * math.exp(work[18, a] - best)
                    total += work[18, a]
            known = total > 0.0
            if turn == 0:
                log_likelihood[t] = 0.0
                if echo[t]:
                    log_likelihood[t] = best + math.log(total) if known else -math.inf
            # Update; what the bin says of a model that cannot explain it, nothing.
            for j in range(M):
                mu[j] = 0.0 if known else pred[j, 5]
                for k in range(5):
                    x[j, k] = pred[j, k]
            for a in range(count if known else 0):
                j = who[a]
                mu[j] = work[18, a] / total
                if work[18, a] > 0.0:
                    prior = work[15, a]
                    k0, k1, less = pred[j, 2] / prior, pred[j, 3] / prior, work[17, a] - prior
                    off = work[16, a] - pred[j, 0]
                    x[j, 0] += k0 * off
                    x[j, 1] += k1 * off
                    x[j, 2] += k0 * k0 * less
                    x[j, 3] += k0 * k1 * less
                    x[j, 4] += k1 * k1 * less
            if turn != turns - 1:
                continue
            # Summarise: the height of the bin.
            for j in range(M):
                probability[t, j] = mu[j]
            for a in range(count):
                j = who[a]
                if not known or not work[18, a] > 0.0:
                    work[16, a] = pred[j, 0]
                    work[17, a] = pred[j, 2] + scatter[j] * scatter[j]
                else:  # what a pulse wider than a bin does not see of the scatter
                    work[17, a] += (1.0 - temper) * scatter[j] * scatter[j]
            center, wide = 0.0, 0.0
            for a in range(count):
                center += mu[who[a]] * work[16, a]
            for a in range(count):
                off = work[16, a] - center
                wide += mu[who[a]] * (work[17, a] + off * off)
            mean[t], variance[t] = center, wide
