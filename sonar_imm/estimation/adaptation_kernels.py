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

"""The form `counts` of `adaptation` compiled: what a tracker computes at each scan.

All arrays are float64 and C-contiguous. `warm` compiles or loads every kernel.
"""

from __future__ import annotations

import numpy as np

from .arrays import FloatArray, IntArray
from .jit import kernel


@kernel
def counts_transition(
    nominal: FloatArray, learnt: FloatArray, prior: FloatArray, weight: float
) -> FloatArray:
    """See `adaptation.corrected` and `counts_correction`: the matrices (T, M, M) of a step whose
    nominal one is `nominal` (M, M), after what was `learnt` (T, 2, M, M)."""
    T, _, M, _ = learnt.shape
    out = np.empty((T, M, M))
    for t in range(T):
        for i in range(M):
            row = out[t, i]
            for j in range(M):
                pseudo = weight * prior[i, j]
                given = learnt[t, 1, i, j] + pseudo
                factor = (learnt[t, 0, i, j] + pseudo) / given if given > 0.0 else 1.0
                row[j] = nominal[i, j] * factor
            total = row_sum(row)
            for j in range(M):
                row[j] = row[j] / total if total > 0.0 else nominal[i, j]
    return out


@kernel
def learn_counts(
    learnt: FloatArray,
    hit: IntArray,
    transition: FloatArray,
    mu_before: FloatArray,
    mu_after: FloatArray,
    nominal: FloatArray,
) -> FloatArray:
    """See `adaptation.transition_posterior` and `adapt_counts`: `learnt` (T, 2, M, M) after a step
    with `transition` (T or 1, M, M), new for the targets `hit` alone."""
    out = learnt.copy()
    M = len(nominal)
    reach, posterior = np.empty(M), np.empty(M)
    for t in hit:
        P = transition[t % len(transition)]
        for j in range(M):
            reach[j] = 0.0
        for i in range(M):
            for j in range(M):
                reach[j] += P[i, j] * mu_before[t, i]
        for i in range(M):
            for j in range(M):
                known = reach[j] if reach[j] > 0.0 else 1.0
                posterior[j] = P[i, j] * mu_before[t, i] / known * mu_after[t, j]
            total = row_sum(posterior)
            for j in range(M):
                out[t, 0, i, j] += posterior[j]
                out[t, 1, i, j] += total * nominal[i, j]
    return out


@kernel
def row_sum(row: FloatArray) -> float:
    """The sum of up to 128 numbers, eight partial sums side by side, as numpy adds a row."""
    n = len(row)
    if n < 8:
        total = 0.0
        for k in range(n):
            total += row[k]
        return total
    a, b, c, d = row[0], row[1], row[2], row[3]
    e, f, g, h = row[4], row[5], row[6], row[7]
    last = n - n % 8
    for k in range(8, last, 8):
        a, b, c, d = a + row[k], b + row[k + 1], c + row[k + 2], d + row[k + 3]
        e, f, g, h = e + row[k + 4], f + row[k + 5], g + row[k + 6], h + row[k + 7]
    total = ((a + b) + (c + d)) + ((e + f) + (g + h))
    for k in range(last, n):
        total += row[k]
    return total


def warm() -> None:
    """Run the kernels once on tiny input: compiled or loaded from the cache."""
    P, mu = np.full((2, 2), 0.5), np.full((1, 2), 0.5)
    learnt = np.zeros((1, 2, 2, 2))
    transition = counts_transition(P, learnt, P, 1.0)
    learn_counts(learnt, np.zeros(1, np.int64), transition, mu, mu, P)
