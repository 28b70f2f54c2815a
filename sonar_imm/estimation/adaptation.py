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

"""Transition probabilities that are learnt from the data, for each target by itself.

Learning does not change the chain. It gives a *correction*, a factor for each transition, that is
applied to the matrix of the next step: ``P(dt) = rownorm(P0(dt) * correction)``. So it works at
irregular steps too.

Two forms (`AdaptiveChain`):

counts
    Dirichlet: expected transitions ``n_ij += W_ij mu_j`` on top of a prior worth `weight`
    transitions per row. At a constant step it is ``P = rownorm(n + weight P0)``, the mean of the
    posterior. The default of the diver tracker.
fixed
    The chain as it is.

What `counts` does at each step is compiled; its arrays are float64 and C-contiguous.
"""

from __future__ import annotations

from typing import get_args, Literal, Protocol

import numpy as np

from .arrays import FloatArray, IndexArray, IntArray
from .jit import kernel

Form = Literal['counts', 'fixed']


class Chain(Protocol):
    """A Markov chain over models, such as `markov.RateChain`."""

    matrix: FloatArray
    step: float

    def transition(self, dt: float) -> FloatArray:
        """P(dt), (M, M)."""
        ...


class AdaptiveChain:
    """A chain and the way the data of T targets correct it. What was learnt is a value that the
    caller keeps: `fresh` makes it, `learn` updates it.

    weight: of counts, how many transitions per row the prior is worth.
    """

    def __init__(self, chain: Chain, form: Form, *, weight: float = 2.0):
        if form not in get_args(Form):
            raise ValueError(f"the form of adaptation is one of {get_args(Form)}, not '{form}'")
        self.chain = chain
        self.form = form
        self.weight = weight

    def fresh(self, targets: int) -> FloatArray:
        """Nothing learnt yet: (targets, K, M, M), K = 2 for counts (seen, expected), 0 for
        fixed."""
        M = len(self.chain.matrix)
        return np.zeros((targets, 2 if self.form == 'counts' else 0, M, M))

    def transition(self, learnt: FloatArray, dt: float) -> FloatArray:
        """The matrices of a step of dt seconds: (targets, M, M), or (1, M, M) when nothing can be
        learnt."""
        nominal = self.chain.transition(dt)
        if self.form == 'fixed':
            return np.array(nominal[None])
        return counts_transition(nominal, learnt, self.chain.matrix, self.weight)

    def learn(
        self,
        learnt: FloatArray,
        transition: FloatArray,
        mu_before: FloatArray,
        mu_after: FloatArray,
        dt: float,
        hit: IndexArray | None = None,
    ) -> FloatArray:
        """What is learnt after a step that used `transition` (targets or 1, M, M) and took the
        model probabilities (targets, M) from `mu_before` to `mu_after`. Only the targets `hit`
        (all by default), which were measured, learn: a miss holds no information on
        transitions."""
        if self.form == 'fixed':
            return learnt
        hit = np.arange(len(learnt)) if hit is None else hit
        nominal = self.chain.transition(dt)
        return learn_counts(learnt, hit, transition, mu_before, mu_after, nominal)


@kernel
def counts_transition(
    nominal: FloatArray, learnt: FloatArray, prior: FloatArray, weight: float
) -> FloatArray:
    """Multiply by (n + N0 P0) / (e + N0 P0) and renormalise the rows: the matrices (T, M, M) of a
    step whose nominal one is `nominal` (M, M), after what was `learnt` (T, 2, M, M)."""
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
    """`learnt` (T, 2, M, M) after a step with `transition` (T or 1, M, M), new for the targets
    `hit` alone: the expected transitions n_ij += W_ij mu_j, W the mixing weights, and e_ij, those
    that the nominal matrix predicts for the same step."""
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
