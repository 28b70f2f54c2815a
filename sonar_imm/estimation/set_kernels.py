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

"""The verbs of `set_filter` compiled, into arrays of the caller.

Every kernel works on the particles ``first .. last - 1`` and touches no other, so that several
threads may share the work. `moments` alone adds up over particles; it is run by one thread.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .arrays import BoolArray, FloatArray, IntArray
from .jit import kernel
from .set_model import Sets, Walks
from .set_proposals import Beginning
from .set_scatter import against, ScatterFit
from .set_shifts import draw_shift, empty_memory, ShiftTables

SUMS, SHIFTED_SUMS = 5, 8
"""Rows of what `moments` adds up, without a shift and with one."""
SLOTS = 8192
"""Of `weigh`, for what was found for a set and may be needed again."""


class SetMotion(NamedTuple):
    """How sets change from record to record: order_min; separation in cells; most_changes, how
    many members can come and go at once; cumulative (orders, columns), the running sums of the
    rows of the transition matrix, or of `set_model.turnover`."""

    order_min: int
    separation: int
    most_changes: int
    cumulative: FloatArray


class Proposals(NamedTuple):
    """Tables of one record, for S signs: walk (S n, 2 r + 1) cumulative, walk_ratio (S n, 2 r + 1)
    of model to proposal, for cells from which a member walks (others are not filled in),
    negative members in the second n rows; birth (n + 1,) running sum of the birth weights of both
    signs, birth_ratio (S, n) log of model to weight, birth_positive (n,) the weight of positive
    births; shifts; walks, from which the first two are made, with driven (S, n), exp of the gains,
    where those are small enough, else (S, 0)."""

    walk: FloatArray
    walk_ratio: FloatArray
    birth: FloatArray
    birth_ratio: FloatArray
    birth_positive: FloatArray
    shifts: ShiftTables
    walks: Walks
    driven: FloatArray


class AmplitudeModel(NamedTuple):
    """How members answer: gram (n,) by lag; ridge, added to its diagonal; penalty in log
    likelihood for each member; marginal: amplitudes are integrated out; memory: phi of a' = phi a
    + noise, 0 for amplitudes drawn anew; variance of the amplitude of a new member."""

    gram: FloatArray
    ridge: float
    penalty: float
    marginal: bool
    memory: float
    variance: float


class Scratch(NamedTuple):
    """Room of one thread: L (J, J) and y (J,) of the Cholesky factor, and the scale (J,) of the
    amplitudes in front of volume scatter."""

    L: FloatArray
    y: FloatArray
    scale: FloatArray


@kernel
def _fill_row(
    row: int,
    z: int,
    g: FloatArray,
    share: float,
    wanted: bool,
    proposals: Proposals,
) -> float:
    """Row `row` of walk and walk_ratio of `proposals`, from the cell z, as far as it is wanted;
    log Z of it."""
    walks, kind = proposals.walks, proposals.walks.kind[z]
    walk = walks.probability[kind]
    n, width = len(g), len(walk)
    radius = width // 2 - walks.centre[kind]
    low, high = max(walks.first[kind], radius - z), min(walks.last[kind], n + radius - z)
    best, inside = -math.inf, 0.0
    # Of the places within reach; the row of ratios is scratch until its own numbers come.
    driven = proposals.walk_ratio[row]
    data_driven = 0.0
    if proposals.driven.shape[1] > 0:
        best, known = 0.0, proposals.driven[row // n]
        for step in range(low, high):
            inside += walk[step]
            driven[step] = known[z + step - radius]
            data_driven += walk[step] * driven[step]
    else:
        for step in range(low, high):
            best = max(best, g[z + step - radius])
            inside += walk[step]
        for step in range(low, high):
            driven[step] = math.exp(g[z + step - radius] - best)
            data_driven += walk[step] * driven[step]
    log_sum = best + math.log(data_driven) if data_driven > 0.0 else -math.inf
    if not wanted:
        return log_sum
    total = 0.0
    for step in range(width):
        q = 0.0
        if low <= step < high:
            q = share * walk[step] * driven[step] / data_driven
            q += (1.0 - share) * walk[step] / inside
        total += q
        proposals.walk[row, step] = total
        proposals.walk_ratio[row, step] = walk[step] / q if q > 0.0 else 0.0
    return log_sum


@kernel
def fill_walks(
    sets: Sets,
    gain: FloatArray,
    share: float,
    filled: BoolArray,
    proposals: Proposals,
) -> None:
    """The rows from which a member of some particle walks, into walk and walk_ratio of
    `proposals`; gain (S, n) for each sign; filled (S n,) is False throughout before,
    and says which rows after."""
    for i in range(sets.order.shape[0]):
        for k in range(sets.order[i]):
            z, negative = sets.cell[i, k], int(sets.sign[i, k] < 0)
            row = z + gain.shape[1] * negative
            if not filled[row]:
                filled[row] = True
                _fill_row(row, z, gain[negative], share, True, proposals)


@kernel
def fill_all_walks(sets: Sets, gain: FloatArray, share: float, proposals: Proposals) -> None:
    """As `fill_walks`, where a shift is drawn before the walks: the rows that some particle may
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
            found = _fill_row(z + n * negative, z, gain[negative], share, wanted[z], proposals)
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
def _placed(
    low: int, high: int, left: float, birth: FloatArray, offset: int, proposals: Proposals
) -> tuple[int, int, float]:
    """(cell, sign, log ratio) of a birth in low .. high - 1, where the running sum of the weights
    of births passes `left` from low on. offset: from cells of the lattice to those of the
    record."""
    point = birth[low + offset] + left
    place = _search(birth[offset:], low, high, point) - 1
    place = max(low, min(place, high - 1))
    negative = 0
    if proposals.birth_ratio.shape[0] > 1:
        # What is left of the random number within the cell chooses the sign.
        inside = point - birth[place + offset]
        negative = int(inside >= proposals.birth_positive[place + offset])
    return place, 1 - 2 * negative, proposals.birth_ratio[negative, place + offset]


@kernel
def _birth(
    cells: IntArray,
    m: int,
    separation: int,
    running: FloatArray,
    proposals: Proposals,
    uniform: float,
    offset: int,
) -> tuple[int, int, int, float]:
    """(position in cells, cell, sign, log ratio) of one more member of cells[:m]; position -1 when
    there is no room. running (n + 1,): sum of the weights of births; offset: from cells of the
    lattice to those of the record."""
    birth = running[offset:]
    n = len(running) - 1 - proposals.shifts.step * (len(proposals.shifts.start) - 1)
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
                place, sign, paid = _placed(low, high, left, running, offset, proposals)
                return k, place, sign, paid + math.log(total)
            left -= weight
    return -1, 0, 1, -math.inf


@kernel
def start(
    first: int,
    last: int,
    motion: SetMotion,
    charge: FloatArray,
    proposals: Proposals,
    beginning: Beginning,
    uniform: FloatArray,
    sets: Sets,
    log_ratio: FloatArray,
) -> None:
    """Sets drawn where the first record will want them, and log_ratio (N,) of model to proposal;
    charge (orders,): what sets of each size cost in it. Of `proposals` only births are used."""
    orders, separation, J = motion.cumulative.shape[0], motion.separation, sets.cell.shape[1]
    G = len(proposals.shifts.start)
    n = len(proposals.birth) - 1 - proposals.shifts.step * (G - 1)
    for i in range(first, last):
        u, m, ratio, here, sign = uniform[i], 0, 0.0, sets.cell[i], sets.sign[i]
        offset = 0
        if G > 1:
            offset = min(_search(proposals.shifts.start, 0, G, u[1 + J]), G - 1)
            offset *= proposals.shifts.step
        sets.shift[i] = offset
        for k in range(len(beginning.sure)):
            low, high = max(beginning.first[k] - offset, 0), min(beginning.last[k] - offset, n)
            if not low < high:
                continue
            weight = proposals.birth[high + offset] - proposals.birth[low + offset]
            sure, drawn = beginning.sure[k], u[len(u) - 1 - k]
            if drawn >= sure:
                ratio -= math.log1p(-sure)
                continue
            here[m], sign[m], paid = _placed(
                low, high, drawn / sure * weight, proposals.birth, offset, proposals
            )
            ratio += paid + math.log(weight / sure)
            if m > 0 and here[m] - here[m - 1] < separation:
                ratio = -math.inf
            m += 1
        least = max(0, motion.order_min - m)
        most = motion.order_min + orders - 1 - m
        total, chance, more = 0.0, 1.0, least
        for _ in range(least, most + 1):
            total += chance
            chance *= beginning.decay
        left, chance = u[0] * total, 1.0
        while left >= chance and more < most:
            left -= chance
            chance *= beginning.decay
            more += 1
        ratio += math.log(total / chance / orders) - math.lgamma(more + 1.0)
        for k in range(more):
            at, place, drawn, paid = _birth(
                here, m, separation, beginning.elsewhere, proposals, u[1 + k], offset
            )
            ratio += paid
            if at < 0:
                break
            for j in range(m, at, -1):
                here[j], sign[j] = here[j - 1], sign[j - 1]
            here[at], sign[at] = place, drawn
            m += 1
        sets.order[i] = max(m, motion.order_min)
        log_ratio[i] = ratio - charge[sets.order[i] - motion.order_min]


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
    """Steps 1 to 5 of `set_model`: from the sets `old` to `new`, and log_ratio (N,) of model to
    proposal, -inf for impossible sets (whose members mean nothing)."""
    order_min, separation, changes, cumulative = motion
    orders, columns = cumulative.shape
    width, cells, walks = proposals.walk.shape[1], proposals.birth_ratio.shape[1], proposals.walks
    J, G = new.cell.shape[1], len(proposals.shifts.start)
    last_cell = cells - 1 - proposals.shifts.step * (G - 1)
    parent, rows, memory = np.empty(J, np.int64), np.empty(J, np.int64), empty_memory(J, G)
    for i in range(first, last):
        before, u, here, sign = old.order[i], uniform[i], new.cell[i], new.sign[i]
        column = min(_search(cumulative[before - order_min], 0, columns, u[0]), columns - 1)
        m = order_min + column % orders
        left, ratio = before, 0.0
        deaths = max(before - m, 0) + column // orders
        for k in range(before):
            parent[k] = k
        for k in range(deaths):
            death = min(int(u[1 + k] * left), left - 1)
            left -= 1
            for j in range(death, left):
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
            table = proposals.walk[row]
            step = min(_search(table, 0, width, u[1 + changes + k] * table[width - 1]), width - 1)
            paid = proposals.walk_ratio[row, step]
            ratio += math.log(paid) if paid > 0.0 else -math.inf
            # What leaves the lattice is impossible already; its number must stay an index.
            z += step - width // 2 + walks.centre[walks.kind[z + offset]]
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
                    here, count, separation, proposals.birth, proposals, u[1 + deaths + k], offset
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
def weigh(
    first: int,
    last: int,
    b: FloatArray,
    amplitudes: AmplitudeModel,
    scatter: ScatterFit,
    sets: Sets,
    log_weight: FloatArray,
    amplitude: FloatArray,
) -> None:
    """Add the log likelihood of each set against that of an empty one to log_weight (N,), -inf
    where an amplitude is not of its member's sign, and write amplitude (N, J), its mean given the
    set, in units of the noise. Weights of -inf are left alone.

    Particles crowd at the peaks of a record: of twenty thousand some three thousand differ. What
    was found for one is kept, in a slot by its members, for those that are the same."""
    J, memory = sets.cell.shape[1], amplitudes.memory > 0.0
    scratch = Scratch(np.empty((J, J)), np.empty(J), np.ones(J))
    owner, kept = np.full(SLOTS, -1, np.int64), np.empty(SLOTS)
    for i in range(first, last):
        if not log_weight[i] > -math.inf:
            continue
        if memory:
            log_weight[i] += _explain(i, b, amplitudes, scatter, sets, amplitude, scratch)
            continue
        slot = 0
        for k in range(sets.order[i]):
            slot = (31 * slot + sets.cell[i, k] + sets.shift[i]) % 1_000_003
        slot %= SLOTS
        j = owner[slot]
        if j >= 0 and _same(i, j, sets):
            for k in range(sets.order[i]):
                amplitude[i, k] = amplitude[j, k]
        else:
            owner[slot] = i
            kept[slot] = _explain(i, b, amplitudes, scatter, sets, amplitude, scratch)
        log_weight[i] += kept[slot]


@kernel
def _same(i: int, j: int, sets: Sets) -> bool:
    if sets.order[i] != sets.order[j]:
        return False
    for k in range(sets.order[i]):
        if sets.cell[i, k] + sets.shift[i] != sets.cell[j, k] + sets.shift[j]:
            return False
        if sets.sign[i, k] != sets.sign[j, k]:
            return False
    return True


@kernel
def _explain(
    i: int,
    b: FloatArray,
    amplitudes: AmplitudeModel,
    scatter: ScatterFit,
    sets: Sets,
    amplitude: FloatArray,
    scratch: Scratch,
) -> float:
    """Log likelihood of the set i, whose row of `amplitude` is written. Scatter begins at the
    first member, or as probably at the second where that is louder and well below."""
    cell, apart = sets.cell[i], scatter.apart
    if scatter.level.shape[0] == 0 or sets.order[i] < 2 or cell[1] - cell[0] < apart:
        return _explain_from(0, i, b, amplitudes, scatter, sets, amplitude, scratch)
    second = _explain_from(1, i, b, amplitudes, scatter, sets, amplitude, scratch)
    louder = second > -math.inf and amplitude[i, 1] > amplitude[i, 0]
    first = _explain_from(0, i, b, amplitudes, scatter, sets, amplitude, scratch)
    if not louder:
        return first
    if second > first:
        _explain_from(1, i, b, amplitudes, scatter, sets, amplitude, scratch)
    best = max(first, second)
    return best + math.log(0.5 * (1.0 + math.exp(min(first, second) - best)))


@kernel
def _explain_from(
    begins: int,
    i: int,
    b: FloatArray,
    amplitudes: AmplitudeModel,
    scatter: ScatterFit,
    sets: Sets,
    amplitude: FloatArray,
    scratch: Scratch,
) -> float:
    """`_explain` where the scatter begins at the member of that number. Cholesky: A = L L',
    y = L^-1 h, a = L'^-1 y."""
    order, cell, mean, variance, sign, shift = sets
    L, y, scale = scratch
    gram, memory, m = amplitudes.gram, amplitudes.memory > 0.0, order[i]
    scattered, begin = scatter.level.shape[0] > 0, cell[i, begins] + shift[i]
    value = scatter.evidence[begin] if scattered and m > 0 else 0.0
    for r in range(m):
        z, h, precision = cell[i, r], b[cell[i, r] + shift[i]], amplitudes.ridge
        if scattered:
            h, scale[r] = against(scatter, h, begin, z + shift[i])
        if memory:
            precision = 1.0 / variance[i, r]
            h += precision * mean[i, r]
            value += 0.5 * (math.log(precision) - precision * mean[i, r] * mean[i, r])
        row = L[r]
        for c in range(r):
            other = L[c]
            value_rc = gram[z - cell[i, c]]
            for k in range(c):
                value_rc -= row[k] * other[k]
            value_rc *= other[c]
            row[c] = value_rc
            h -= value_rc * y[c]
        pivot = gram[0] + precision
        for k in range(r):
            pivot -= row[k] * row[k]
        if not pivot > 1e-12:
            value = -math.inf
            break
        # The diagonal of L is kept as its reciprocal.
        row[r] = 1.0 / math.sqrt(pivot)
        y[r] = h * row[r]
        value += 0.5 * y[r] * y[r]
        if amplitudes.marginal:
            value -= 0.5 * math.log(pivot)
        if not memory:
            value -= amplitudes.penalty
    if value > -math.inf:
        a = amplitude[i]
        for r in range(m - 1, -1, -1):
            rest = y[r]
            for k in range(r + 1, m):
                rest -= L[k, r] * a[k]
            a[r] = rest * L[r, r]
            if not a[r] * sign[i, r] > 0.0:
                value = -math.inf
                break
        for r in range(m if scattered else 0):
            a[r] *= scale[r]
    return value


@kernel
def remember(
    first: int,
    last: int,
    amplitudes: AmplitudeModel,
    amplitude: FloatArray,
    sets: Sets,
) -> None:
    """Amplitudes (N, J) after a record become those expected before the next, a' = phi a + noise:
    prior_mean and prior_variance of `sets`, in place. Each is kept for itself, given the others:
    in place of their full covariance that costs less than 0.1 % of accuracy while neighbouring
    pulses overlap by less than 0.3 (band pulses at the default separation: 0.06), and 2 to 6 % at
    0.7."""
    phi, stationary = amplitudes.memory, amplitudes.variance
    for i in range(first, last):
        for k in range(sets.order[i]):
            after = 1.0 / (amplitudes.gram[0] + 1.0 / sets.prior_variance[i, k])
            sets.prior_mean[i, k] = phi * amplitude[i, k]
            sets.prior_variance[i, k] = phi * phi * after + (1.0 - phi * phi) * stationary


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
