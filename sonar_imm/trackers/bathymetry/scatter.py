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

"""Smooth floor with slopes, rough floor whose bins scatter about a base: bank, filter, smoother.

Stones on a flat floor do not make its height a random walk: each bin lies beside a base, and the
next one beside the same base. And a smooth floor that rises is no fast walk either. Model j has a
walk of the base b, a lean, and a scatter s_j of the bins,

    b_t = b_{t-1} + lean_j + sigma_j e,      h_t | b_t ~ N(b_t, s_j^2),

and what the staves say of the height, L_t(h), says of the base the same, blurred by the scatter:

    l_j(b) = sum_h N(h - b; s_j) L_t(h).

The state on the grid is the base, so scatter costs a convolution per bin and lean a shift. The
height that is given out is that of the bin, base and deviation together:

    p_j(h) = L_t(h) sum_b N(h - b; s_j) pred_j(b) beta_j(b)

with the predicted density of the base and, smoothed, beta of the bins after this one.

`bank_of` is the default set. Smooth floor keeps one of nine slopes (`steady`) or goes up and down
(`undulating`): without these a fast walk has to count as smooth, or slopes count as rough, and
roughness that is correlated looks like a fast walk. What is rough lasts a shorter while. The
answers are those of kinds of models, not of each slope.

Shapes as in `kernels`; K models of M kinds; verbs of `estimation.grid`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
import math
from typing import NamedTuple

import numpy as np

from ...estimation import grid
from ...estimation.arrays import BoolArray, FloatArray, IntArray
from ...estimation.elementary import exponentials
from ...estimation.jit import kernel
from .kernels import favour_cells, GridMotion, PingLikelihood, state_log_likelihoods, Track

STEADY = tuple(0.05 * k for k in range(-4, 5))
UNDULATING = tuple(0.1 * k for k in range(-2, 3))
"""Slopes of smooth floor, in metres per metre of slant range."""
STEADY_WALK, UNDULATING_WALK = 0.003, 0.008
"""Walk beside the slope over a range bin, m."""
STEADY_TURN, UNDULATING_TURN = 0.002, 0.03
"""Probability per bin of the next slope, up and down."""
UNDULATING_SHARE, ROUGH_SHARE = 0.3, 0.3
"""Before the first bin: undulating, of smooth floor; rough, of all."""
BECOMES_ROUGH, ROUGH_ENDS = 0.5, 5.0
"""In units of 1 - stay: how often smooth floor becomes rough (as often it takes another slope),
and rough floor ends."""
SCATTER_REACH = 5.0
"""Bins scatter no further than so many standard deviations."""
ENDS_SMOOTH = 0.95
"""Rough floor becomes smooth in so many cases, else it becomes rough in another way."""


class Scatter(NamedTuple):
    """What models (K,) of scatter have beside those of a plain walk: the kind (K,) under which
    each is counted; spread (K,) of the bins about the base, and lean (K,) from bin to bin, m."""

    kind: IntArray
    spread: FloatArray
    lean: FloatArray


class Bank(NamedTuple):
    """K models of M kinds: names and rough (M,); kind (K,) of each model, its walk sigma (K,) and
    spread (K,), m, and lean (K,), m per m; transition (K, K), initial (K,) probabilities; coast:
    the level model."""

    names: tuple[str, ...]
    rough: BoolArray
    kind: IntArray
    sigma: FloatArray
    spread: FloatArray
    lean: FloatArray
    transition: FloatArray
    initial: FloatArray
    coast: int


@lru_cache(maxsize=16)
def bank_of(sigmas: Sequence[float], scatters: Sequence[float], stay: float) -> Bank:
    """The bank with rough models of these walks and scatters (R,), m; stay: probability that
    smooth floor keeps its kind over a bin, changes of the slope apart."""
    steady, undulating, rough = len(STEADY), len(UNDULATING), len(sigmas)
    smooth, leave = steady + undulating, 1.0 - stay
    K = smooth + rough
    share = np.array(
        [(1.0 - UNDULATING_SHARE) / steady] * steady + [UNDULATING_SHARE / undulating] * undulating
    )
    back = ENDS_SMOOTH if rough > 1 else 1.0
    transition = np.zeros((K, K))
    transition[:smooth, :smooth] = leave * (1.0 - BECOMES_ROUGH) * share
    transition[:smooth, smooth:] = leave * BECOMES_ROUGH / rough
    transition[smooth:, :smooth] = min(ROUGH_ENDS * leave, 0.5) * back * share
    transition[smooth:, smooth:] = min(ROUGH_ENDS * leave, 0.5) * (1.0 - back) / max(rough - 1, 1)
    for i in range(smooth):
        turn = STEADY_TURN if i < steady else UNDULATING_TURN
        for j in (i - 1, i + 1):
            if 0 <= j < smooth and (i < steady) == (j < steady):
                transition[i, j] += turn
    np.fill_diagonal(transition, 0.0)
    np.fill_diagonal(transition, np.maximum(1.0 - transition.sum(axis=1), 0.0))
    transition /= transition.sum(axis=1, keepdims=True)
    kinds = [f'{"scatter" if scatter > 0.0 else "rw"}' for scatter in scatters]
    numbered = [f'{name}_{kinds[: k + 1].count(name)}' for k, name in enumerate(kinds)]
    return Bank(
        names=('steady', 'undulating', *numbered),
        rough=np.arange(2 + rough) >= 2,
        kind=np.array([0] * steady + [1] * undulating + list(range(2, 2 + rough))),
        sigma=np.array([STEADY_WALK] * steady + [UNDULATING_WALK] * undulating + list(sigmas)),
        spread=np.array([0.0] * smooth + list(scatters)),
        lean=np.array([*STEADY, *UNDULATING, *[0.0] * rough]),
        transition=transition,
        initial=np.concatenate([(1.0 - ROUGH_SHARE) * share, [ROUGH_SHARE / rough] * rough]),
        coast=STEADY.index(0.0),
    )


class ScatterMotion(NamedTuple):
    """`GridMotion` of K models, and in cells their spread (K,) and lean (K,); kind (K,) is where
    each is counted in the answers."""

    grid: GridMotion
    kind: IntArray
    spread: FloatArray
    lean: FloatArray


@kernel
def _shift(
    p: FloatArray, low: int, high: int, by: float, out: FloatArray, to_low: int, to_high: int
) -> None:
    """p (G,) on [low, high) moved by so many cells, into out (G,) on [to_low, to_high); cubic
    weights, as those of `kernels.Drift`."""
    whole = math.floor(by)
    f = by - whole
    a, b = -f * (f - 1.0) * (f - 2.0) / 6.0, (f + 1.0) * (f - 1.0) * (f - 2.0) / 2.0
    c, d = -(f + 1.0) * f * (f - 2.0) / 2.0, (f + 1.0) * f * (f - 1.0) / 6.0
    for g in range(to_low, to_high):
        out[g] = 0.0
        k = g - whole
        if low <= k + 1 < high:
            out[g] += a * p[k + 1]
        if low <= k < high:
            out[g] += b * p[k]
        if low <= k - 1 < high:
            out[g] += c * p[k - 1]
        if low <= k - 2 < high:
            out[g] += d * p[k - 2]
        out[g] = max(out[g], 0.0)


@kernel
def _blur(
    ping: PingLikelihood,
    t: int,
    cells: FloatArray,
    low: int,
    high: int,
    spread: FloatArray,
    wide: IntArray,
    work: FloatArray,
    level: FloatArray,
    likelihood: FloatArray,
) -> float:
    """What bin t says of the base on [low, high), into likelihood (K, G), and of the height, into
    level (G,) on the window into wide (2,), both relative to the largest, whose logarithm is
    returned: -inf where the bin is impossible everywhere, and no more is written then.
    spread (K,): scatter, in cells; work (12, max(G, 128) + 16) is scratch."""
    G, widest = cells.shape[0], 0.0
    for j in range(spread.shape[0]):
        widest = max(widest, spread[j])
    reach = int(math.ceil(SCATTER_REACH * widest))
    start, end = max(low - reach, 0), min(high + reach, G)
    wide[0], wide[1] = start, end
    n = end - start
    value, sines = work[7, :n], work[8, :n]
    state_log_likelihoods(cells[start:end], ping, t, sines, work[:4], value)
    best = -math.inf
    for g in range(n):
        best = value[g] if value[g] > best else best
    if not math.isfinite(best):
        return -math.inf
    for g in range(n):
        value[g] -= best
    exponentials(value, work[9, :n], level[start:end])
    for j in range(spread.shape[0]):
        row = likelihood[j]
        if spread[j] > 0.0:
            grid.walk(level, start, end, spread[j], work, row, low, high)
        else:
            for g in range(low, high):
                row[g] = level[g]
    return best


@kernel
def _answer(
    p: FloatArray,
    low: int,
    high: int,
    cells: FloatArray,
    kind: IntArray,
    spread: FloatArray,
    wide: IntArray,
    work: FloatArray,
    level: FloatArray,
    t: int,
    track: Track,
) -> None:
    """Mean and variance of the height of bin t and the probabilities of the models, from the joint
    density p (K, G) of the base before the bin itself is heard, and what it says, see `_blur`."""
    height, square, whole = 0.0, 0.0, 0.0
    middle, probability = cells[(low + high) // 2], track.probability[t]
    for m in range(probability.shape[0]):
        probability[m] = 0.0
    for j in range(p.shape[0]):
        row, start, end = p[j], low, high
        if spread[j] > 0.0:
            start, end, row = wide[0], wide[1], work[10]
            grid.walk(p[j], low, high, spread[j], work, row, start, end)
        total = 0.0
        for g in range(start, end):
            q, off = row[g] * level[g], cells[g] - middle
            total += q
            height += q * off
            square += q * off * off
        probability[kind[j]] += total
        whole += total
    for m in range(probability.shape[0]):
        probability[m] /= whole
    height /= whole
    track.mean[t, 0] = middle + height
    track.covariance[t, 0, 0] = max(square / whole - height * height, 0.0)


@kernel
def _rest(
    p: FloatArray,
    low: int,
    high: int,
    cells: FloatArray,
    kind: IntArray,
    spread: FloatArray,
    t: int,
    track: Track,
) -> None:
    """The answer for a bin without an echo, from the density p (K, G) of the base."""
    height, square, whole, step = 0.0, 0.0, 0.0, cells[1] - cells[0]
    middle, probability = cells[(low + high) // 2], track.probability[t]
    for m in range(probability.shape[0]):
        probability[m] = 0.0
    for j in range(p.shape[0]):
        total = 0.0
        for g in range(low, high):
            off = cells[g] - middle
            total += p[j, g]
            height += p[j, g] * off
            square += p[j, g] * off * off
        probability[kind[j]] += total
        square += total * (spread[j] * step) ** 2
        whole += total
    for m in range(probability.shape[0]):
        probability[m] /= whole
    height /= whole
    track.mean[t, 0] = middle + height
    track.covariance[t, 0, 0] = max(square / whole - height * height, 0.0)


@kernel
def _weigh(p: FloatArray, low: int, high: int, likelihood: FloatArray) -> float:
    """Multiply p (K, G) on [low, high) by likelihood (K, G) and normalise it; the ratio of its
    sums. An impossible likelihood changes nothing: 0 is returned."""
    before, after = 0.0, 0.0
    for j in range(p.shape[0]):
        for g in range(low, high):
            before += p[j, g]
            after += p[j, g] * likelihood[j, g]
    possible = after > 0.0
    for j in range(p.shape[0]):
        for g in range(low, high):
            p[j, g] *= likelihood[j, g] / after if possible else 1.0 / before
    return after / before if possible else 0.0


@kernel
def filter_scatter(
    p: FloatArray,
    moves: ScatterMotion,
    ping: PingLikelihood,
    window: IntArray,
    track: Track,
    keep: bool,
) -> FloatArray:
    """All T bins from p (K, G), the joint probability of model and base before the first.

    The windows [low, high) of the predicted densities go into window (T, 2), the answers into
    `track`. With `keep` these are the log likelihoods alone, the rest is that of `smooth_scatter`,
    and the predicted densities are returned, K rows for each bin; else nothing (0,).
    """
    (K, G), T = p.shape, ping.ranges.shape[0]
    motion, kind, spread, lean = moves.grid, moves.kind, moves.spread, moves.lean
    cells, sigma, coast = motion.cells, motion.sigma, motion.coast
    mixed, moved = np.empty((K, G)), np.empty(G)
    work = np.empty((12, max(G, 128) + 16))
    level, likelihood = np.empty(G), np.empty((K, G))
    kept, used = np.empty(4096 if keep else 0), 0
    wide = np.empty(2, np.int64)
    low, high = grid.trim(p, 0, G)
    for t in range(T):
        echo, reach = ping.echo[t], 0
        if echo:
            grid.mix(p, low, high, motion.transition, mixed)
            if motion.favour.shape[0] > 0:
                favour_cells(mixed, low, high, motion.favour[t])
        else:
            for j in range(K):
                for g in range(low, high):
                    mixed[j, g] = p[j, g]
        for j in range(K):
            model = j if echo else coast
            further = grid.reach_of(sigma[t, model]) + int(math.ceil(abs(lean[model]))) + 2
            reach = max(reach, further)
        new_low, new_high = max(low - reach, 0), min(high + reach, G)
        for j in range(K):
            model = j if echo else coast
            if lean[model] != 0.0:
                further = int(math.ceil(abs(lean[model]))) + 2
                a, b = max(low - further, 0), min(high + further, G)
                _shift(mixed[j], low, high, lean[model], moved, a, b)
                grid.walk(moved, a, b, sigma[t, model], work, p[j], new_low, new_high)
            else:
                grid.walk(mixed[j], low, high, sigma[t, model], work, p[j], new_low, new_high)
        low, high = grid.trim(p, new_low, new_high)
        window[t, 0], window[t, 1] = low, high
        if keep:
            needed = used + K * (high - low)
            if needed > kept.shape[0]:
                larger = np.empty(2 * needed)
                for s in range(used):
                    larger[s] = kept[s]
                kept = larger
            for j in range(K):
                for g in range(low, high):
                    kept[used] = p[j, g]
                    used += 1
        best = -math.inf
        if echo:
            best = _blur(ping, t, cells, low, high, spread, wide, work, level, likelihood)
        ratio = 0.0
        if math.isfinite(best):
            if not keep:
                _answer(p, low, high, cells, kind, spread, wide, work, level, t, track)
            ratio = _weigh(p, low, high, likelihood)
        if not ratio > 0.0 and not keep:
            _rest(p, low, high, cells, kind, spread, t, track)
        track.log_likelihood[t] = 0.0
        if echo:
            track.log_likelihood[t] = best + math.log(ratio) if ratio > 0.0 else -math.inf
        low, high = grid.trim(p, low, high)
    return kept


@kernel
def smooth_scatter(
    kept: FloatArray,
    window: IntArray,
    moves: ScatterMotion,
    ping: PingLikelihood,
    track: Track,
) -> None:
    """Forward-backward: what `filter_scatter` kept, given the whole ping. The answers of all bins
    are written anew into `track`."""
    motion, kind, spread, lean = moves.grid, moves.kind, moves.spread, moves.lean
    cells, coast, T = motion.cells, motion.coast, ping.ranges.shape[0]
    K, G = motion.transition.shape[0], cells.shape[0]
    beta, back, p = np.empty((K, G)), np.empty((K, G)), np.empty((K, G))
    work, moved = np.empty((12, max(G, 128) + 16)), np.empty(G)
    level, likelihood = np.empty(G), np.empty((K, G))
    backwards, end = motion.transition.T.copy(), 0  # in rows, as `grid.mix` is compiled for
    wide = np.empty(2, np.int64)
    for t in range(T):
        end += K * (window[t, 1] - window[t, 0])
    low, high = window[T - 1, 0], window[T - 1, 1]
    for j in range(K):
        for g in range(low, high):
            beta[j, g] = 1.0
    for t in range(T - 1, -1, -1):
        echo = ping.echo[t]
        end -= K * (high - low)
        total, s = 0.0, end
        for j in range(K):
            for g in range(low, high):
                p[j, g] = kept[s] * beta[j, g]
                total += p[j, g]
                s += 1
        for j in range(K):
            for g in range(low, high):
                p[j, g] /= total
        best = -math.inf
        if echo:
            best = _blur(ping, t, cells, low, high, spread, wide, work, level, likelihood)
        if math.isfinite(track.log_likelihood[t]) and math.isfinite(best):
            _answer(p, low, high, cells, kind, spread, wide, work, level, t, track)
            _weigh(beta, low, high, likelihood)
        else:
            _rest(p, low, high, cells, kind, spread, t, track)
        if t == 0:
            break
        new_low, new_high = window[t - 1, 0], window[t - 1, 1]
        for j in range(K):
            model = j if echo else coast
            width = motion.sigma[t, model]
            if lean[model] != 0.0:
                further = int(math.ceil(abs(lean[model]))) + 2
                a, b = max(low - further, 0), min(high + further, G)
                _shift(beta[j], low, high, -lean[model], moved, a, b)
                grid.walk(moved, a, b, width, work, back[j], new_low, new_high)
            else:
                grid.walk(beta[j], low, high, width, work, back[j], new_low, new_high)
        low, high = new_low, new_high
        if echo:
            if motion.favour.shape[0] > 0:
                favour_cells(back, low, high, motion.favour[t])
            grid.mix(back, low, high, backwards, beta)
        else:
            for j in range(K):
                for g in range(low, high):
                    beta[j, g] = back[j, g]
