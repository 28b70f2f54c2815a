# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The verbs of `set_filter` that visit each particle, compiled, into arrays of the caller.

A kernel works on the particles ``first .. last - 1`` and touches no other, so that several threads
may share the work. `moments` alone adds up over particles; it is run by one thread. Sets are
handed over column by column, named as in `set_model.Sets`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .arrays import FloatArray, IntArray
from .jit import kernel

SLOTS = 8192
"""Of `weigh`, for what was found for a set and may be needed again."""


@kernel
def propagate(
    first: int,
    last: int,
    cells: int,
    separation: int,
    walks_from: int,
    uniform: FloatArray,
    old_order: IntArray,
    deaths: IntArray,
    old_cell: IntArray,
    old_sign: NDArray[np.int8],
    parent: IntArray,
    jump: IntArray,
    centre: IntArray,
    walk: FloatArray,
    walk_ratio: FloatArray,
    birth: FloatArray,
    birth_ratio: FloatArray,
    birth_positive: FloatArray,
    shift: IntArray,
    order: IntArray,
    cell: IntArray,
    sign: NDArray[np.int8],
    log_ratio: FloatArray,
) -> None:
    """Steps 3 to 5 of `set_model`, for a lattice of `cells`: those that are left jump together and
    walk, others are born.

    old_order to parent: of `set_model.Left`; jump (N,), cells. Each particle comes with its new
    `order` and shift, and gets its members, the parent of each, -1 for those that are born, and in
    log_ratio (N,), which is added to, that of model to proposal; -inf for impossible sets (whose
    members mean nothing). uniform (N, U): column ``1 + deaths + k`` for the birth k,
    ``walks_from + k`` for the walk of the member k. centre (n,): the middle of the walks from each
    cell of the record, against that cell; walk and walk_ratio: of `set_proposals.WalkTables`;
    birth to birth_positive: of `set_proposals.Births`.
    """
    width, (signs, n) = walk.shape[1], birth_ratio.shape
    for i in range(first, last):
        left, offset, ratio = old_order[i] - deaths[i], shift[i], log_ratio[i]
        for k in range(left):
            source = parent[i, k]
            z = old_cell[i, source] + jump[i]
            if not 0 <= z < cells:
                ratio, z = -math.inf, min(max(z, 0), cells - 1)
            row = z + offset
            step, end = 0, width
            if old_sign[i, source] < 0:
                row += n
            point = uniform[i, walks_from + k] * walk[row, width - 1]
            while step < end:
                middle = (step + end) // 2
                if walk[row, middle] > point:
                    end = middle
                else:
                    step = middle + 1
            step = min(step, width - 1)
            paid = walk_ratio[row, step]
            ratio += math.log(paid) if paid > 0.0 else -math.inf
            # What leaves the lattice is impossible already; its number must stay an index.
            z += step - width // 2 + centre[z + offset]
            if not 0 <= z < cells:
                ratio = -math.inf
            z = min(max(z, 0), cells - 1)
            j = k
            while j > 0 and cell[i, j - 1] > z:
                cell[i, j], parent[i, j] = cell[i, j - 1], parent[i, j - 1]
                j -= 1
            cell[i, j], parent[i, j] = z, source
        for k in range(left):
            sign[i, k] = old_sign[i, parent[i, k]]
            if k > 0 and cell[i, k] - cell[i, k - 1] < separation:
                ratio = -math.inf
        for m in range(left, order[i]):
            # The running sum of the weights of births says what each free gap is worth.
            total, final = 0.0, -1
            for k in range(m + 1):
                low = 0 if k == 0 else cell[i, k - 1] + separation
                high = cells if k == m else cell[i, k] - separation + 1
                if high > low:
                    total += birth[high + offset] - birth[low + offset]
                    final = k
            if final < 0:
                ratio = -math.inf
            if not ratio > -math.inf:
                break
            rest = uniform[i, 1 + deaths[i] + m - left] * total
            for gap in range(final + 1):
                low = 0 if gap == 0 else cell[i, gap - 1] + separation
                high = cells if gap == m else cell[i, gap] - separation + 1
                if high > low:
                    weight = birth[high + offset] - birth[low + offset]
                    if rest < weight or gap == final:
                        break
                    rest -= weight
            point = birth[low + offset] + rest
            at, end = low, high
            while at < end:
                middle = (at + end) // 2
                if birth[middle + offset] > point:
                    end = middle
                else:
                    at = middle + 1
            z, negative = max(low, min(at - 1, high - 1)), 0
            # What is left of the random number within the cell chooses the sign.
            if signs > 1 and point - birth[z + offset] >= birth_positive[z + offset]:
                negative = 1
            paid = birth_ratio[negative, z + offset] + math.log(total)
            # Beside a peak of 1e6 sigmas the weights of all free cells can be lost in rounding.
            ratio += paid if paid < math.inf else -math.inf
            for j in range(m, gap, -1):
                cell[i, j], sign[i, j] = cell[i, j - 1], sign[i, j - 1]
                parent[i, j] = parent[i, j - 1]
            cell[i, gap], sign[i, gap], parent[i, gap] = z, 1 - 2 * negative, -1
        log_ratio[i] = ratio


@kernel
def weigh(
    first: int,
    last: int,
    b: FloatArray,
    gram: FloatArray,
    ridge: float,
    penalty: float,
    marginal: bool,
    remembers: bool,
    order: IntArray,
    cell: IntArray,
    prior_mean: FloatArray,
    prior_variance: FloatArray,
    sign: NDArray[np.int8],
    shift: IntArray,
    L: FloatArray,
    vectors: FloatArray,
    owner: IntArray,
    kept: FloatArray,
    log_weight: FloatArray,
    amplitude: FloatArray,
) -> None:
    """Add the log likelihood of each set against that of an empty one to log_weight (N,), -inf
    where an amplitude is not of its member's sign, and write amplitude (N, J), its mean given the
    set, in units of the noise. Weights of -inf are left alone.

    gram to remembers: of `set_filter.AmplitudeModel`. L (J, J), vectors (2, J), owner and kept
    (SLOTS,) are scratch, owner -1 throughout.

    Particles crowd at the peaks of a record: of twenty thousand some three thousand differ. What
    was found for one is kept, in a slot by its members, for those that are the same.
    """
    slot = 0
    for i in range(first, last):
        if not log_weight[i] > -math.inf:
            continue
        m = order[i]
        if not remembers:
            slot = 0
            for k in range(m):
                slot = (31 * slot + cell[i, k] + shift[i]) % 1_000_003
            slot %= SLOTS
            j = owner[slot]
            same = j >= 0 and order[j] == m
            for k in range(m):
                if not same:
                    break
                same = cell[i, k] + shift[i] == cell[j, k] + shift[j] and sign[i, k] == sign[j, k]
            if same:
                for k in range(m):
                    amplitude[i, k] = amplitude[j, k]
                log_weight[i] += kept[slot]
                continue
        value = 0.0
        # Cholesky: A = L L', y = L^-1 h, a = L'^-1 y; y and a are the vectors.
        for r in range(m):
            z, h, precision = cell[i, r], b[cell[i, r] + shift[i]], ridge
            if remembers:
                precision = 1.0 / prior_variance[i, r]
                mean = prior_mean[i, r]
                h += precision * mean
                value += 0.5 * (math.log(precision) - precision * mean * mean)
            for c in range(r):
                product = gram[z - cell[i, c]]
                for k in range(c):
                    product -= L[r, k] * L[c, k]
                product *= L[c, c]
                L[r, c] = product
                h -= product * vectors[0, c]
            pivot = gram[0] + precision
            for k in range(r):
                pivot -= L[r, k] * L[r, k]
            if not pivot > 1e-12:
                value = -math.inf
                break
            # The diagonal of L is kept as its reciprocal.
            L[r, r] = 1.0 / math.sqrt(pivot)
            vectors[0, r] = h * L[r, r]
            value += 0.5 * vectors[0, r] * vectors[0, r]
            if marginal:
                value -= 0.5 * math.log(pivot)
            if not remembers:
                value -= penalty
        if value > -math.inf:
            for r in range(m - 1, -1, -1):
                rest = vectors[0, r]
                for k in range(r + 1, m):
                    rest -= L[k, r] * vectors[1, k]
                vectors[1, r] = rest * L[r, r]
                if not vectors[1, r] * sign[i, r] > 0.0:
                    value = -math.inf
                    break
        if value > -math.inf:
            for k in range(m):
                amplitude[i, k] = vectors[1, k]
        if not remembers:
            owner[slot], kept[slot] = i, value
        log_weight[i] += value


@kernel
def moments(
    w: FloatArray,
    order_min: int,
    order: IntArray,
    cell: IntArray,
    prior_variance: FloatArray,
    shift: IntArray,
    amplitude: FloatArray,
    new_variance: float,
    offset: FloatArray,
    variance: float,
    pmf: FloatArray,
    sums: FloatArray,
) -> None:
    """Add to pmf (orders,) and to sums (5, n), the intensity, the first two moments of the
    amplitude, the variance it had before the record (new_variance where sets have none of their
    own), and the share of members that are the first of their set, that lie on each cell. Both
    are zero before. With a shift, cells are those of the record, where members that share an error
    are not blurred by it, and sums (8, n + 2 pad) has the first two moments of the cell on the
    lattice and its product with the amplitude besides, with the mean offset (N,) of the shift and
    its variance (see `set_shifts`); offset is empty without one."""
    shifted, own = len(offset) > 0, prior_variance.shape[1] > 0
    for i in range(len(w)):
        if w[i] > 0.0:
            pmf[order[i] - order_min] += w[i]
            for k in range(order[i]):
                place, a = cell[i, k], amplitude[i, k]
                z = place + shift[i]
                sums[0, z] += w[i]
                sums[1, z] += w[i] * a
                sums[2, z] += w[i] * a * a
                sums[3, z] += w[i] * (prior_variance[i, k] if own else new_variance)
                if shifted:
                    at = place - offset[i]
                    sums[5, z] += w[i] * at
                    sums[6, z] += w[i] * (at * at + variance)
                    sums[7, z] += w[i] * at * a
            if order[i] > 0:
                sums[4, cell[i, 0] + shift[i]] += w[i]
