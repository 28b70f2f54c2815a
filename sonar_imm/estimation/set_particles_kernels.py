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

"""`set_particles` compiled: the same draws for the same random numbers, into arrays of the caller.

Every kernel works on the particles ``first .. last - 1`` and touches no other, so that several
threads may share the work. `moments` alone adds up over particles; it is run by one thread.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .arrays import BoolArray, FloatArray, IntArray
from .jit import kernel
from .set_amplitudes import AmplitudeModel
from .set_model import Sets
from .set_particles import Proposals
from .set_shifts import draw_shift, empty_memory

SUMS, SHIFTED_SUMS = 5, 8
"""Rows of what `moments` adds up, without a shift and with one."""


class SetMotion(NamedTuple):
    """How sets change from record to record: order_min; separation in cells; most_changes, how
    many members can come or go at once; cumulative (orders, orders), the running sums of the rows
    of the transition matrix."""

    order_min: int
    separation: int
    most_changes: int
    cumulative: FloatArray


@kernel
def _fill_row(
    row: int,
    z: int,
    g: FloatArray,
    move: FloatArray,
    share: float,
    wanted: bool,
    proposals: Proposals,
) -> float:
    """Row `row` of move and move_ratio of `proposals`, from the cell z, as far as it is wanted;
    log Z of it."""
    n, width = len(g), len(move)
    radius = width // 2
    low, high = max(0, radius - z), min(width, n + radius - z)
    best, inside = -math.inf, 0.0
    for step in range(low, high):
        best = max(best, g[z + step - radius])
        inside += move[step]
    # Of the places within reach; the row of ratios is scratch until its own numbers come.
    driven = proposals.move_ratio[row]
    data_driven = 0.0
    for step in range(low, high):
        driven[step] = math.exp(g[z + step - radius] - best)
        data_driven += move[step] * driven[step]
    if not wanted:
        return best + math.log(data_driven)
    total = 0.0
    for step in range(width):
        q = 0.0
        if low <= step < high:
            q = share * move[step] * driven[step] / data_driven
            q += (1.0 - share) * move[step] / inside
        total += q
        proposals.move[row, step] = total
        proposals.move_ratio[row, step] = math.log(move[step] / q) if q > 0.0 else -math.inf
    return best + math.log(data_driven)


@kernel
def fill_moves(
    sets: Sets,
    gain: FloatArray,
    move: FloatArray,
    share: float,
    filled: BoolArray,
    proposals: Proposals,
) -> None:
    """The rows of `set_particles.propose` from which some particle moves, into move and
    move_ratio of `proposals`; gain (S, n) for each sign; filled (S n,) is False throughout before,
    and says which rows after."""
    for i in range(sets.order.shape[0]):
        for k in range(sets.order[i]):
            z, negative = sets.cell[i, k], int(sets.sign[i, k] < 0)
            row = z + gain.shape[1] * negative
            if not filled[row]:
                filled[row] = True
                _fill_row(row, z, gain[negative], move, share, True, proposals)


@kernel
def fill_all_moves(
    sets: Sets, gain: FloatArray, move: FloatArray, share: float, proposals: Proposals
) -> None:
    """As `fill_moves`, where a shift is drawn before the moves: the rows that some particle may
    come to by one, and log_sum of all rows."""
    n, step, reached = gain.shape[1], proposals.shifts.step, np.zeros(gain.shape, np.bool_)
    last = step * (len(proposals.shifts.start) - 1)
    for i in range(sets.order.shape[0]):
        for k in range(sets.order[i]):
            reached[int(sets.sign[i, k] < 0), sets.cell[i, k]] = True
    wanted = np.zeros(n, np.bool_)
    for negative in range(gain.shape[0]):
        wanted[:] = False
        for z in range(n):
            if reached[negative, z]:
                wanted[z : z + last + 1 : step] = True
        for z in range(n):
            found = _fill_row(
                z + n * negative, z, gain[negative], move, share, wanted[z], proposals
            )
            proposals.shifts.log_sum[negative, z] = found


@kernel
def _search(cumulative: FloatArray, low: int, high: int, point: float) -> int:
    """The first place in low .. high - 1 whose entry exceeds `point`, high if none does."""
    while low < high:
        middle = (low + high) // 2
        if cumulative[middle] > point:
            high = middle
        else:
            low = middle + 1
    return low


@kernel
def _birth(
    cells: IntArray,
    m: int,
    separation: int,
    proposals: Proposals,
    uniform: float,
    offset: int,
) -> tuple[int, int, int, float]:
    """(position in cells, cell, sign, log ratio) of one more member of cells[:m]; position -1 when
    there is no room. offset: from cells of the lattice to those of the record."""
    birth = proposals.birth[offset:]
    n = proposals.birth.shape[0] - 1 - proposals.shifts.step * (len(proposals.shifts.start) - 1)
    total, last = 0.0, -1
    for k in range(m + 1):
        low = 0 if k == 0 else cells[k - 1] + separation
        high = n if k == m else cells[k] - separation + 1
        if high > low:
            total += birth[high] - birth[low]
            last = k
    if last < 0:
        return -1, 0, 1, -math.inf
    left = uniform * total
    for k in range(last + 1):
        low = 0 if k == 0 else cells[k - 1] + separation
        high = n if k == m else cells[k] - separation + 1
        if high > low:
            weight = birth[high] - birth[low]
            if left < weight or k == last:
                place = _search(birth, low, high, birth[low] + left) - 1
                place = max(low, min(place, high - 1))
                negative = 0
                if proposals.birth_ratio.shape[0] > 1:
                    # What is left of the random number within the cell chooses the sign.
                    inside = birth[low] + left - birth[place]
                    negative = int(inside >= proposals.birth_positive[place + offset])
                paid = proposals.birth_ratio[negative, place + offset] + math.log(total)
                return k, place, 1 - 2 * negative, paid
            left -= weight
    return -1, 0, 1, -math.inf


@kernel
def start(
    first: int,
    last: int,
    motion: SetMotion,
    charge: FloatArray,
    proposals: Proposals,
    uniform: FloatArray,
    sets: Sets,
    log_ratio: FloatArray,
) -> None:
    """See `set_particles.start`; charge (orders,): what sets of each size cost in log ratio. Of
    `proposals` only births are used."""
    orders, separation = motion.cumulative.shape[0], motion.separation
    for i in range(first, last):
        chosen = min(int(uniform[i, 0] * orders), orders - 1)
        m = motion.order_min + chosen
        ratio, here, sign, offset = 0.0, sets.cell[i], sets.sign[i], 0
        if len(proposals.shifts.start) > 1:
            G, drawn_at = len(proposals.shifts.start), uniform[i, 1 + sets.cell.shape[1]]
            offset = min(_search(proposals.shifts.start, 0, G, drawn_at), G - 1)
            offset *= proposals.shifts.step
        sets.shift[i] = offset
        for k in range(m):
            at, place, drawn, paid = _birth(
                here, k, separation, proposals, uniform[i, 1 + k], offset
            )
            ratio += paid
            if at < 0:
                break
            for j in range(k, at, -1):
                here[j], sign[j] = here[j - 1], sign[j - 1]
            here[at], sign[at] = place, drawn
        sets.order[i] = m
        log_ratio[i] = ratio - charge[chosen]


@kernel
def propagate(
    first: int,
    last: int,
    motion: SetMotion,
    amplitudes: AmplitudeModel,
    proposals: Proposals,
    uniform: FloatArray,
    old: Sets,
    new: Sets,
    log_ratio: FloatArray,
) -> None:
    """See `set_particles.propagate`: from the sets `old` to `new` and log_ratio (N,)."""
    order_min, separation, changes, cumulative = motion
    orders, width, cells = (
        cumulative.shape[0],
        proposals.move.shape[1],
        proposals.birth_ratio.shape[1],
    )
    J, G = new.cell.shape[1], len(proposals.shifts.start)
    last_cell = cells - 1 - proposals.shifts.step * (G - 1)
    parent, rows, memory = np.empty(J, np.int64), np.empty(J, np.int64), empty_memory(J, G)
    for i in range(first, last):
        before, u, here, sign = old.order[i], uniform[i], new.cell[i], new.sign[i]
        m = order_min + min(_search(cumulative[before - order_min], 0, orders, u[0]), orders - 1)
        left, ratio = before, 0.0
        for k in range(before):
            parent[k] = k
        for k in range(before - m):
            gone = min(int(u[1 + k] * left), left - 1)
            left -= 1
            for j in range(gone, left):
                parent[j] = parent[j + 1]
        offset = 0
        for k in range(left):
            negative = int(old.sign[i, parent[k]] < 0)
            rows[k] = old.cell[i, parent[k]] + negative * cells
        if G > 1:
            drawn_at = u[1 + changes + J]
            offset, ratio = draw_shift(
                proposals.shifts, old.shift[i], rows, left, cells, drawn_at, memory
            )
        new.shift[i] = offset
        for k in range(left):
            source = parent[k]
            z = old.cell[i, source]
            row = rows[k] + offset
            table = proposals.move[row]
            step = min(_search(table, 0, width, u[1 + changes + k] * table[width - 1]), width - 1)
            ratio += proposals.move_ratio[row, step]
            # What leaves the lattice is impossible already; its number must stay an index.
            z += step - width // 2
            if not 0 <= z <= last_cell:
                ratio = -math.inf
            z = min(max(z, 0), last_cell)
            j = k
            while j > 0 and here[j - 1] > z:
                here[j], parent[j] = here[j - 1], parent[j - 1]
                j -= 1
            here[j], parent[j] = z, source
        for k in range(left):
            sign[k] = old.sign[i, parent[k]]
        for k in range(1, left):
            if here[k] - here[k - 1] < separation:
                ratio = -math.inf
        for k in range(m - left):
            if ratio > -math.inf:
                count = left + k
                at, place, drawn, paid = _birth(
                    here, count, separation, proposals, u[1 + k], offset
                )
                ratio += paid
                if at >= 0:
                    for j in range(count, at, -1):
                        here[j], parent[j], sign[j] = here[j - 1], parent[j - 1], sign[j - 1]
                    here[at], parent[at], sign[at] = place, -1, drawn
        new.order[i], log_ratio[i] = m, ratio
        if amplitudes.memory > 0.0 and ratio > -math.inf:
            for k in range(m):
                born, j = parent[k] < 0, parent[k]
                new.prior_mean[i, k] = 0.0 if born else old.prior_mean[i, j]
                variance = amplitudes.variance if born else old.prior_variance[i, j]
                new.prior_variance[i, k] = variance


@kernel
def free(sets: Sets, cells: int) -> tuple[IntArray, IntArray]:
    """The least and the greatest offset (N,), in cells, by which all members of a set can be
    lowered and stay on the lattice of so many cells."""
    low, high = np.full(len(sets.order), -cells), np.full(len(sets.order), cells)
    for i in range(len(sets.order)):
        if sets.order[i] > 0:
            low[i] = sets.cell[i, sets.order[i] - 1] - (cells - 1)
            high[i] = sets.cell[i, 0]
    return low, high


@kernel
def lowered(sets: Sets, offset: IntArray) -> IntArray:
    """The cells (N, J), those of each set less by its offset (N,)."""
    cell = sets.cell.copy()
    for i in range(len(sets.order)):
        for k in range(sets.order[i]):
            cell[i, k] -= offset[i]
    return cell


@kernel
def moments(
    w: FloatArray,
    sets: Sets,
    amplitude: FloatArray,
    offset: FloatArray,
    variance: float,
    prior_variance: float,
    order_min: int,
    pmf: FloatArray,
    sums: FloatArray,
) -> None:
    """Add to pmf (orders,) and to sums (5, n), the intensity, the first two moments of the
    amplitude, the variance it had before the record (prior_variance where sets have none of their
    own), and the share of members that are the first of their set, that lie on each cell. Both
    are zero before. With a shift, cells are those of
    the record, where members that share an error are not blurred by it, and sums (8, n + 2 pad)
    has the first two moments of the cell on the lattice and its product with the amplitude
    besides, with the mean offset (N,) of the shift and its variance (see `set_shifts`)."""
    shifted, own = sums.shape[0] > SUMS, sets.prior_variance.shape[1] > 0
    for i in range(w.shape[0]):
        if w[i] > 0.0:
            pmf[sets.order[i] - order_min] += w[i]
            for k in range(sets.order[i]):
                place, a = sets.cell[i, k], amplitude[i, k]
                z = place + sets.shift[i]
                sums[0, z] += w[i]
                sums[1, z] += w[i] * a
                sums[2, z] += w[i] * a * a
                sums[3, z] += w[i] * (sets.prior_variance[i, k] if own else prior_variance)
                if shifted:
                    at = place - offset[i]
                    sums[5, z] += w[i] * at
                    sums[6, z] += w[i] * (at * at + variance)
                    sums[7, z] += w[i] * at * a
            if sets.order[i] > 0:
                sums[4, sets.cell[i, 0] + sets.shift[i]] += w[i]
