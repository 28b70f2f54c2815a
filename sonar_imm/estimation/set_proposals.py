# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Where the particle filter for sets (`set_filter`) looks for members in a record.

Members that stand close, or of which one is much stronger, show in each other's places: by its
side lobes a member of 30 sigma draws births to places where nothing is, and weaker ones away from
theirs. What **stands out** is therefore taken off before: the highest place of the record is a
member, with all found so far the amplitudes are fitted anew and taken off, and so on, while what
is left stands out (orthogonal matching pursuit). Then each is moved to where the record without
the others has it. The **gain** g of a place is what a member there is worth beside all others,

    g = max(s b', 0)^2 / 2,    b' the record without the echoes of those found elsewhere.

All of this is a proposal: each draw is weighted by the exact ratio of model to proposal.

A walk is looked for in the gains around it (`fill_walks`). Before the first record, each of what
stands out has a member with the probability that it is one, and the rest is born elsewhere
(`begin`, `first_members`).

Source: Y. C. Pati, R. Rezaiifar, P. S. Krishnaprasad, *Orthogonal matching pursuit*, Asilomar
Conference (1993).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from .arrays import BoolArray, FloatArray, IntArray
from .set_model import SetModel, Sets, Walks

_SWEEPS, _UNSURE, _SURE = 2, 0.05, 0.98
_AT_ONCE = 1 << 15
"""Of the numbers of `fill_walks`, as many as stay in the cache."""


class Peaks(NamedTuple):
    """What stands out of a record, ascending: the cells first (K,) <= z < last (K,) in which it
    is, no two of them in common."""

    first: IntArray
    last: IntArray


NOTHING = Peaks(np.empty(0, np.int64), np.empty(0, np.int64))


def standing_out(model: SetModel, b: FloatArray, gram: FloatArray) -> tuple[FloatArray, Peaks]:
    """b (n,) without the echoes of members elsewhere, gram (n,) of it, and what stands out: its
    gain exceeds what births get at most."""
    n, half, least = len(b), model.separation // 2, math.sqrt(2.0 * model.birth_cap)
    gram = np.pad(gram[:n], (0, n - len(gram[:n])))
    mirrored = np.concatenate([gram[:0:-1], gram])
    free, left = np.ones(n), b
    at, echoes, a = np.empty(0, np.int64), np.empty((0, n)), np.empty(0)

    def fitted() -> tuple[FloatArray, FloatArray]:
        a = np.linalg.solve(echoes[:, at] + (model.ridge or 1e-6) * np.eye(len(at)), b[at])
        return np.asarray(a), np.asarray(b - a @ echoes)

    def seen(values: FloatArray) -> FloatArray:
        return np.abs(values) if len(model.signs) > 1 else values

    while len(at) < model.order_max:
        z = int(np.argmax(seen(left) * free))
        if not seen(left)[z] * free[z] > least:
            break
        free[max(0, z - model.separation + 1) : z + model.separation] = 0.0
        at, echoes = np.append(at, z), np.vstack([echoes, mirrored[n - 1 - z : 2 * n - 1 - z]])
        a, left = fitted()
    for k in np.tile(np.arange(len(at)), _SWEEPS if len(at) > 1 else 0):
        low, high = max(0, at[k] - half), at[k] + half + 1
        z = low + int(np.argmax(seen(left[low:high] + a[k] * echoes[k, low:high])))
        if z != at[k] and np.abs(np.delete(at, k) - z).min() >= model.separation:
            at[k], echoes[k] = z, mirrored[n - 1 - z : 2 * n - 1 - z]
            a, left = fitted()
    order = np.argsort(at)
    middle = (at[order][1:] + at[order][:-1] + 1) // 2
    first = np.maximum(at[order] - half, np.append(0, middle)[: len(at)])
    last = np.minimum(at[order] + half + 1, np.append(middle, n)[: len(at)])
    alone = left.copy()
    for k, low, high in zip(order, first, last):
        alone[low:high] += a[k] * echoes[k, low:high]
    return alone, Peaks(first, last)


def gains(model: SetModel, b: FloatArray, gram: FloatArray) -> tuple[FloatArray, Peaks]:
    """g (S, n) for each sign, and what stands out of the record b (n,), gram (n,) of it; nothing
    where proposals are blind."""
    peaks = NOTHING
    if model.walk_share:
        b, peaks = standing_out(model, b, gram)
    return np.stack([0.5 * np.square(np.maximum(sign * b, 0.0)) for sign in model.signs]), peaks


def levelled(model: SetModel, g: FloatArray) -> FloatArray:
    """The gains g (S, n), lowered where the sum of ``exp(g)`` over a peak exceeds what it were if
    all of it were at `birth_cap`. What lies within half of the separation is one peak, and is
    lowered by as much, so that it keeps its shape."""
    half = model.separation // 2
    around = sliding_window_view(np.pad(g, ((0, 0), (half, half))), 2 * half + 1, axis=1)
    height, width = np.pad(g, ((0, 0), (half, half))), 1
    while width < 2 * half + 1:
        step = min(width, 2 * half + 1 - width)
        height = np.maximum(height[:, :-step], height[:, step:])
        width += step
    low = g.copy()
    # Elsewhere no sum exceeds it.
    high = height > model.birth_cap
    top = height[high]
    mass = top + np.log(np.exp(around[high] - top[:, None]).mean(axis=1))
    low[high] -= np.maximum(mass - model.birth_cap, 0.0)
    return low


class Births(NamedTuple):
    """How members are born: running (n + 1,), sum of the weights of both signs; ratio (S, n), log
    of model to weight; positive (n,), the weight of positive births."""

    running: FloatArray
    ratio: FloatArray
    positive: FloatArray


def propose_births(model: SetModel, g: FloatArray, share: float, cap: float = math.inf) -> Births:
    """Births by the gains g (S, n): a share in proportion to what each place and sign is worth,
    which is no more than exp(cap), the rest uniformly."""
    prior = np.array(list(model.signs.values()))[:, None]
    data_driven = np.exp(np.minimum(g + np.log(prior), cap))
    weight = share * data_driven / data_driven.sum() + (1.0 - share) * prior / model.cells
    running = np.append(0.0, np.cumsum(weight.sum(axis=0)))
    return Births(running, -np.log(model.cells * weight / prior), weight[0])


class WalkTables(NamedTuple):
    """How members walk from each cell, those of negative sign in the second n rows: running
    (S n, 2 r + 1), sums of the probabilities of a row; ratio (S n, 2 r + 1) of model to proposal;
    log_sum (S n,), log of what the walks from a cell hold of the record."""

    running: FloatArray
    ratio: FloatArray
    log_sum: FloatArray

    @classmethod
    def empty(cls, rows: int, width: int) -> WalkTables:
        return cls(np.empty((rows, width)), np.empty((rows, width)), np.empty(rows))


def walked_from(model: SetModel, sets: Sets) -> BoolArray:
    """Whether some member may walk from each cell of the record, by sign (S n,), whatever the
    shift."""
    signs, n = len(model.signs), model.record_cells
    row = sets.cell if signs == 1 else sets.cell + n * (sets.sign < 0)
    reached = (np.bincount(row.ravel(), minlength=signs * n) > 0).reshape(signs, n)
    found = np.zeros_like(reached)
    for offset in range(0, 2 * model.pad + 1, model.shift.step if model.shift else 1):
        found[:, offset:] |= reached[:, : n - offset]
    return found.ravel()


def fill_walks(
    walks: Walks,
    g: FloatArray,
    share: float,
    wanted: BoolArray,
    tables: WalkTables,
    *,
    all_sums: bool = False,
) -> None:
    """Fill in the rows `wanted` (S n,) of `tables`, for the gains g (S, n), and log_sum of all
    rows where that is asked for. A share of the walks is drawn by what each cell is worth, the
    rest by `walks` alone."""
    n, width = g.shape[1], walks.probability.shape[1]
    pad = width // 2 + int(np.abs(walks.centre).max())
    # Peaks that were levelled are so low that one scale serves all of them.
    worth = np.exp(g) if walks.wide else g
    if all_sums and walks.wide:
        # Walks of one kind from neighbours are a correlation.
        padded, edges = np.pad(worth, ((0, 0), (pad, pad))), np.flatnonzero(np.diff(walks.kind))
        sums = tables.log_sum.reshape(-1, n)
        for low, high in zip(np.append(0, edges + 1), np.append(edges + 1, n)):
            kind = walks.kind[low]
            first = low + walks.centre[kind] + pad - width // 2
            for sign, part in enumerate(padded[:, first : first + high - low + width - 1]):
                with np.errstate(divide='ignore'):
                    log_sum = np.log(np.correlate(part, walks.probability[kind], 'valid'))
                sums[sign, low:high] = log_sum
        all_sums = False
    # Nothing of the record is negative, so that -1 says where it ends.
    windows = np.pad(worth, ((0, 0), (pad, pad)), constant_values=-1.0)
    windows = sliding_window_view(windows, width, axis=1)
    begin = np.arange(n) + walks.centre[walks.kind] + pad - width // 2
    rows = np.arange(g.size) if all_sums else np.flatnonzero(wanted)
    count = max(1, _AT_ONCE // width)
    with np.errstate(all='ignore'):
        for row in np.split(rows, range(count, len(rows), count)):
            negative, z = np.divmod(row, n)
            near, best = windows[negative, begin[z]], np.zeros((len(row), 1))
            K = np.where(near >= 0.0, walks.probability[walks.kind[z]], 0.0)
            if not walks.wide:
                near = np.where(K > 0.0, near, 0.0)
                best = near.max(axis=1, keepdims=True)
                near = np.exp(near - best)
            total = (K * near).sum(axis=1, keepdims=True)
            tables.log_sum[row] = (best + np.log(total))[:, 0]
            if all_sums:
                use = wanted[row]
                row, K, near, total = row[use], K[use], near[use], total[use]
            q = share * K * near / total + (1.0 - share) * K / K.sum(axis=1, keepdims=True)
            tables.running[row] = np.cumsum(q, axis=1)
            tables.ratio[row] = np.where(q > 0.0, K / q, 0.0)


class Beginning(NamedTuple):
    """How the first sets are drawn: each of K peaks has a member, first (K,) <= z < last (K,),
    with the probability sure (K,), by the births; elsewhere (n + 1,): running sum of the weights
    of births outside of peaks; of those there are e more with a probability in proportion to
    decay^e."""

    first: IntArray
    last: IntArray
    sure: FloatArray
    elsewhere: FloatArray
    decay: float


def begin(model: SetModel, g: FloatArray, peaks: Peaks) -> tuple[Beginning, Births]:
    """How the first sets are drawn from the gains g (S, n), and the births.

    One after the other, births would find all of eight peaks in one of some hundred sets, and as
    the last of eight the same member is far more probable than as the first, so that weights
    would differ by many orders of magnitude: one set would be left, with whatever else is in
    it. The sets walk before they meet the record, so that they begin as far from its peaks as
    that."""
    if not len(peaks.first):
        births = propose_births(model, g, model.birth_share, model.birth_cap)
        return Beginning(*peaks, np.empty(0), births.running, 1.0), births
    worth = np.stack([np.convolve(np.exp(row), model.walk, 'same') for row in levelled(model, g)])
    worth = np.log(np.maximum(worth[:, : g.shape[1]], 1e-300))
    births = propose_births(model, worth, model.walk_share)
    reach, between = model.separation // 2, (peaks.last[:-1] + peaks.first[1:]) // 2
    first = np.maximum(peaks.first - reach, np.append(0, between))
    last = np.minimum(peaks.last + reach, np.append(between, g.shape[1]))
    weight, log_odds = np.diff(births.running), np.empty(len(first))
    prior = np.log(list(model.signs.values()))[:, None]
    for k, (low, high) in enumerate(zip(first, last)):
        weight[low:high] = 0.0
        log_odds[k] = np.logaddexp.reduce((g[:, low:high] + prior).ravel())
    # What one member more costs among so many.
    order = np.clip(len(log_odds) - model.order_min, 1, len(model.start) - 1)
    rarer = model.start[order] / model.start[order - 1] if len(model.start) > 1 else 1.0
    log_odds += math.log(rarer * len(log_odds) / model.cells) - model.penalty
    sure = np.clip(1.0 / (1.0 + np.exp(-log_odds.clip(-50.0, 50.0))), _UNSURE, _SURE)
    return Beginning(first, last, sure, np.append(0.0, np.cumsum(weight)), 0.5), births


def first_members(
    model: SetModel, beginning: Beginning, births: Births, uniform: FloatArray, shift: IntArray
) -> tuple[Sets, IntArray, FloatArray]:
    """Sets that have some of the peaks, the order (N,) that each is to have with those elsewhere,
    and log_ratio (N,) of model to proposal.

    uniform (N, U): in the first column of how many are elsewhere, in the last ones of the peaks,
    the last one of the first; shift (N,) plus pad, not used up."""
    N, orders = len(uniform), len(model.transition)
    sets, log_ratio, m = Sets.empty(model, N), np.zeros(N), np.zeros(N, np.int64)
    for k, sure in enumerate(beginning.sure):
        drawn = uniform[:, -1 - k]
        low = np.maximum(beginning.first[k], shift)
        high = np.minimum(beginning.last[k], shift + model.cells)
        log_ratio[(low < high) & (drawn >= sure)] -= math.log1p(-sure)
        i = np.flatnonzero((low < high) & (drawn < sure))
        low, high = low[i], high[i]
        weight = births.running[high] - births.running[low]
        point = births.running[low] + drawn[i] / sure * weight
        z = np.clip(np.searchsorted(births.running, point, 'right') - 1, low, high - 1)
        # What is left of the random number within the cell chooses the sign.
        negative = (point - births.running[z] >= births.positive[z]) & (len(births.ratio) > 1)
        log_ratio[i] += births.ratio[negative.astype(np.int64), z] + np.log(weight / sure)
        sets.cell[i, m[i]], sets.sign[i, m[i]] = z - shift[i], np.where(negative, -1, 1)
        m[i] += 1
    chance = beginning.decay ** np.arange(model.order_max + 1)
    running, least = np.cumsum(chance), np.maximum(model.order_min - m, 0)
    total = running[model.order_max - m - least]
    more = np.searchsorted(running, uniform[:, 0] * total, 'right')
    more = np.minimum(more, model.order_max - m - least)
    ways = np.array([math.lgamma(k + 1.0) for k in range(model.order_max + 1)])
    log_ratio += np.log(total / chance[more] / orders) - ways[more + least]
    sets.order[:] = m
    return sets, m + more + least, log_ratio
