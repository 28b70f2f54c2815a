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

Four forms (`AdaptiveChain`):

counts
    Dirichlet: expected transitions ``n_ij += W_ij mu_j`` on top of a prior worth `weight`
    transitions per row. At a constant step it is ``P = rownorm(n + weight P0)``, the mean of the
    posterior. The default of the diver tracker.
paper
    Eq. (1) of the diver paper read as a product, ``P_ij <- P_ij mu_j / sum``, guarded by
    ``P <- (1 - guard) P + guard P0``. The equation is lost in the source.
ratio
    The same equation read as a ratio, ``P_ij <- P_ij mu_j(k) / mu_j(k-1) / sum``, guarded alike.
fixed
    The chain as it is.

What `counts` does at each step is compiled; its arrays are float64 and C-contiguous.
"""

from __future__ import annotations

from typing import get_args, Literal, Protocol

import numpy as np

from .arrays import FloatArray, IndexArray, IntArray
from .jit import kernel

Form = Literal['counts', 'paper', 'ratio', 'fixed']

LEAST = 1e-12
"""A model less probable than this before a step counts as this probable in a ratio."""


class Chain(Protocol):
    """A Markov chain over models: `markov.RateChain`, `markov.EventChain`."""

    matrix: FloatArray
    step: float

    def transition(self, dt: float) -> FloatArray:
        """P(dt), (M, M)."""
        ...


class AdaptiveChain:
    """A chain and the way the data of T targets correct it. What was learnt is a value that the
    caller keeps: `fresh` makes it, `learn` updates it.

    weight: counts only, how many transitions per row the prior is worth; guard: paper and ratio,
    share of the prior that is kept at each step.
    """

    def __init__(self, chain: Chain, form: Form, *, weight: float = 2.0, guard: float = 0.7):
        if form not in get_args(Form):
            raise ValueError(f"the form of adaptation is one of {get_args(Form)}, not '{form}'")
        self.chain = chain
        self.form = form
        self.weight = weight
        self.guard = guard

    def fresh(self, targets: int) -> FloatArray:
        """Nothing learnt yet: (targets, K, M, M), K = 2 for counts (seen, expected), 1 for paper
        and ratio, 0 for fixed."""
        M = len(self.chain.matrix)
        if self.form == 'counts':
            return np.zeros((targets, 2, M, M))
        return np.ones((targets, 0 if self.form == 'fixed' else 1, M, M))

    def transition(self, learnt: FloatArray, dt: float) -> FloatArray:
        """The matrices of a step of dt seconds: (targets, M, M), or (1, M, M) when nothing can be
        learnt."""
        nominal = self.chain.transition(dt)
        if self.form == 'fixed':
            return np.array(nominal[None])
        if self.form == 'counts':
            return counts_transition(nominal, learnt, self.chain.matrix, self.weight)
        return corrected(nominal, learnt[:, 0])

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
        if self.form == 'counts':
            nominal = self.chain.transition(dt)
            return learn_counts(learnt, hit, transition, mu_before, mu_after, nominal)
        learnt, factor = learnt.copy(), mu_after[hit]
        if self.form == 'ratio':
            factor = factor / np.maximum(mu_before[hit], LEAST)
        learnt[hit, 0] = adapt_product(learnt[hit, 0], factor, self.chain.matrix, self.guard)
        return learnt


def adapt_product(
    correction: FloatArray, factor: FloatArray, prior: FloatArray, guard: float
) -> FloatArray:
    """Eq. (1) of the diver paper as a factor on P0: P_ij <- P_ij f_j / sum, then the guard
    P <- (1 - guard) P + guard P0; f (..., M) is mu(k), or mu(k) / mu(k-1).

    Without the guard the exponent of f = mu doubles at each step, and rows become one-hot within
    five; ratios telescope to mu(k) / mu(0), whatever the chain.
    """
    P = corrected(prior, correction) * factor[..., None, :]
    total = P.sum(axis=-1, keepdims=True)
    P = np.where(total > 0.0, P / np.where(total > 0.0, total, 1.0), prior)
    P = (1.0 - guard) * P + guard * prior
    return np.asarray(np.where(prior > 0.0, P / np.where(prior > 0.0, prior, 1.0), 1.0))


def corrected(P: FloatArray, correction: FloatArray) -> FloatArray:
    """Apply a learnt factor to the matrix of any step and renormalise the rows. (..., M, M)."""
    out = P * correction
    total = out.sum(axis=-1, keepdims=True)
    return np.asarray(np.where(total > 0.0, out / np.where(total > 0.0, total, 1.0), P))


@kernel
def counts_transition(
    nominal: FloatArray, learnt: FloatArray, prior: FloatArray, weight: float
) -> FloatArray:
    """`corrected` by the counts (n + N0 P0) / (e + N0 P0): the matrices (T, M, M) of a step whose
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
