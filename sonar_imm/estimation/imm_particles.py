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

"""The interacting multiple model particle filter: the exact filter as particles grow in number.

One set of weighted particles for each model, and the four verbs of every multiple-model filter::

    x, c = mix(x, w, mu, transition, uniform)           # who could have become model j
    x = predict(x, F, G, noise)                         # each model moves
    step = update(log_likelihood, c)                    # each particle meets the measurement
    mean, covariance = combine(x, step.w, step.mu)      # one answer, before anything is resampled

Shapes: M models, n states, N particles per model, k noises. ``x (M, n, N)``, ``w (M, N)`` with
rows summing to one, ``mu (M,)``, ``transition (M, M)`` with ``transition[i, j] = Pr(j at t | i at
t-1)``, ``F (M, n, n)``, ``G (M, n, k)``, ``log_likelihood (M, N)``. Particles come last so that
loops over them run along memory.

**Mixing is exact.** Given that model j holds now, the state one step ago has the density ``sum_i
mu_{i|j} p_i(x)``, ``mu_{i|j} = P_ij mu_i / c_j``; the union of all sets with the weights
``mu_{i|j} w_i`` represents it, and N systematic draws from the union represent it again (Boers and
Driessen 2003). A Gaussian IMM has to put one Gaussian in the place of that mixture; particles do
not. Mixing also is the only resampling that is needed: what leaves it has equal weights.

**Weights are retained.** What leaves `update` keeps its weights until the next mixing, and the
likelihood of model j is the *weighted* mean ``L_j = sum_n w_n q_n`` of its particles' likelihoods
q_n. The plain mean often printed is right only for equal weights, which is what they are here
after mixing, but not if a step is left out. The answer is combined before particles are drawn
again, since drawing can only add noise to it.

The filter uses no generator of its own: `uniform (M,)` and `noise (M, k, N)`, standard normal, are
given. This module is the readable form; `imm_particles_kernels` compiles it, and gives the same
bits for the same numbers.

References: Y. Boers, J. Driessen, *Interacting multiple model particle filter*, IEE Proc. Radar
Sonar Navig. 150(5), 2003; H. Driessen, Y. Boers, *Efficient particle filter for jump Markov
nonlinear systems*, ibid. 152(5), 2005.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from .arrays import FloatArray
from .elementary import exponentials

LEAST_CHANCE = 1e-290
"""A model less probable than this before a measurement counts as one that nothing can become: the
reciprocal of its probability could not be held."""


class WeightUpdate(NamedTuple):
    """w (M, N) and mu (M,) after the measurement; log_likelihood of the measurement given those
    before; ok False when no particle could explain it and the prediction was kept."""

    w: FloatArray
    mu: FloatArray
    log_likelihood: float
    ok: bool


def mix(
    x: FloatArray, w: FloatArray, mu: FloatArray, transition: FloatArray, uniform: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Oracle for tests: equally weighted x (M, n, N) for each model, and its predicted probability
    c (M,).

    A model that nothing can become (c_j below `LEAST_CHANCE`) draws from the mixture of all, so
    that it stays finite and can come back when the chain allows. uniform (M,) in [0, 1).
    """
    M, n, N = x.shape
    union = np.moveaxis(x, 1, 0).reshape(n, M * N)
    running = np.cumsum(w, axis=1)
    mixed, c = np.empty_like(x), np.empty(M)
    for j in range(M):
        shares = transition[:, j] * mu
        c[j] = _total(shares)
        if not c[j] > LEAST_CHANCE:
            shares = mu
        # How many of the points (k + u) / N lie below each particle's share of the whole.
        totals = np.cumsum(np.append(0.0, shares * running[:, -1]))
        cumulative = (totals[:-1, None] + shares[:, None] * running).ravel()
        below = np.ceil(cumulative * (N / totals[-1]) - uniform[j])
        copies = np.diff(np.minimum(below, N), prepend=0.0).astype(np.intp)
        mixed[j] = np.repeat(union, copies, axis=1)
    return mixed, c


def predict(x: FloatArray, F: FloatArray, G: FloatArray, noise: FloatArray) -> FloatArray:
    """Oracle for tests: x <- F x + G e for each model; noise e (M, k, N) standard normal."""
    M, n, _ = x.shape
    moved = np.zeros_like(x)
    for j in range(M):
        for a in range(n):
            for b in range(n):
                moved[j, a] += F[j, a, b] * x[j, b]
            for b in range(G.shape[2]):
                moved[j, a] += G[j, a, b] * noise[j, b]
    return moved


def update(log_likelihood: FloatArray, c: FloatArray, w: FloatArray | None = None) -> WeightUpdate:
    """Oracle for tests: w_n <- w_n q_n / L_j, mu_j <- c_j L_j / sum, L_j = sum_n w_n q_n.

    w (M, N): weights before, equal when not given. A model whose particles are all impossible, or
    that is less likely than another by more than exp(-700), gets mu_j = 0 and keeps its weights.
    """
    M, N = log_likelihood.shape
    prior = np.full((M, N), 1.0 / N) if w is None else w
    best = float(np.max(log_likelihood, initial=-math.inf, where=~np.isnan(log_likelihood)))
    if not math.isfinite(best):
        return WeightUpdate(prior, c, -math.inf, False)
    q = np.empty((M, N))
    for j in range(M):
        exponentials(log_likelihood[j] - best, np.empty(N), q[j])
    weight = prior * q
    L = np.array([_total(row) for row in weight])
    joint = c * L
    total = _total(joint)
    if not total > 0.0:
        return WeightUpdate(prior, c, -math.inf, False)
    alive = L > 0.0
    weight = np.where(alive[:, None], weight / np.where(alive, L, 1.0)[:, None], prior)
    return WeightUpdate(weight, joint / total, best + math.log(total), True)


def combine(x: FloatArray, w: FloatArray, mu: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Oracle for tests: mean (n,) and covariance (n, n) of the mixture of all models."""
    M, n, _ = x.shape
    mean, covariance = np.zeros(n), np.zeros((n, n))
    for j in range(M):
        for a in range(n):
            mean[a] += mu[j] * _total(w[j] * x[j, a])
    for j in range(M):
        for a in range(n):
            for b in range(a + 1):
                spread = _total(w[j] * (x[j, a] - mean[a]) * (x[j, b] - mean[b]))
                covariance[a, b] += mu[j] * spread
                covariance[b, a] = covariance[a, b]
    return mean, covariance


def _total(values: FloatArray) -> float:
    """The sum from left to right, as a loop makes it: numpy's own sum pairs its terms."""
    return float(np.cumsum(values)[-1])
