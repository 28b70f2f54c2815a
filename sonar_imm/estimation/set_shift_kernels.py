# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The shift or jump of each particle, compiled: see `set_shifts`, whose tables are handed over
column by column. Only a filter whose members share one imports this."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from .arrays import FloatArray, IntArray
from .jit import kernel

SLOTS, REST = 256, 18.0
"""Sets that were resampled from one have one proposal; what was found for it is kept. Of the
data-driven part nothing is that is less than e^-REST of its best."""


@kernel
def draw_shifts(
    first: int,
    last: int,
    step: int,
    log_prior: FloatArray,
    prior: FloatArray,
    log_sum: FloatArray,
    share: float,
    uniform: FloatArray,
    old_order: IntArray,
    deaths: IntArray,
    old_cell: IntArray,
    old_sign: NDArray[np.int8],
    parent: IntArray,
    old_shift: IntArray,
    key: IntArray,
    weight: FloatArray,
    running: FloatArray,
    span: IntArray,
    shift: IntArray,
    log_ratio: FloatArray,
) -> None:
    """The shift plus pad (N,) of each particle in a record, drawn from q of `set_shifts` by the
    last column of uniform (N, U), and log_ratio (N,) of model to q.

    log_prior and prior: of `set_shifts.ShiftTables`; log_sum (S, step, n) log Z by sign, of cell
    ``step * k + r`` of the record, or of the padded lattice, in row r; old_order to parent: of
    `set_model.Left`; old_shift (N,): of the record before. Scratch, a row for each slot: key
    (SLOTS, J + 2), -1 throughout; weight and running (SLOTS, G) of the data-driven part of q,
    divided by their total, and span (SLOTS, 2), where it begins and ends.
    """
    G, column = log_prior.shape[1], uniform.shape[1] - 1
    for i in range(first, last):
        before, count = 0, old_order[i] - deaths[i]
        if len(prior) > 1:
            before = old_shift[i] // step
        slot, n = before, step * log_sum.shape[2]
        for k in range(count):
            j = parent[i, k]
            row = old_cell[i, j] + n if old_sign[i, j] < 0 else old_cell[i, j]
            slot = (31 * slot + row) % 1_000_003
        slot %= SLOTS
        known = key[slot, 0] == count and key[slot, 1] == before
        key[slot, 0], key[slot, 1] = count, before
        for k in range(count):
            j = parent[i, k]
            row = old_cell[i, j] + n if old_sign[i, j] < 0 else old_cell[i, j]
            known = known and key[slot, 2 + k] == row
            key[slot, 2 + k] = row
        if not known:
            for g in range(G):
                weight[slot, g] = log_prior[before, g]
            for k in range(count):
                negative = key[slot, 2 + k] // n
                z = key[slot, 2 + k] - negative * n
                near, at = log_sum[negative, z % step], z // step
                for g in range(G):  # neighbours in memory: added several at a time
                    weight[slot, g] += near[at + g]
            best = weight[slot, 0]
            for g in range(1, G):
                best = weight[slot, g] if weight[slot, g] > best else best
            begin, end = 0, G - 1
            while begin < end and weight[slot, begin] < best - REST:
                begin += 1
            while end > begin and weight[slot, end] < best - REST:
                end -= 1
            total = 0.0
            for g in range(begin, end + 1):
                x = weight[slot, g] - best
                weight[slot, g] = math.exp(x) if x > -REST else 0.0
                total += weight[slot, g]
                running[slot, g] = total
            for g in range(begin, end + 1):
                weight[slot, g] /= total
                running[slot, g] /= total
            span[slot, 0], span[slot, 1] = begin, end
        begin, end = span[slot, 0], span[slot, 1]
        low, high = 0, G - 1
        point = uniform[i, column] * (share + (1.0 - share) * prior[before, high])
        while low < high:
            middle = (low + high) // 2
            below = 0.0 if middle < begin else 1.0
            if begin <= middle < end:
                below = running[slot, middle]
            if share * below + (1.0 - share) * prior[before, middle] > point:
                high = middle
            else:
                low = middle + 1
        q = (1.0 - share) * math.exp(log_prior[before, low])
        if begin <= low <= end:
            q += share * weight[slot, low]
        shift[i], log_ratio[i] = low * step, log_prior[before, low] - math.log(q)
