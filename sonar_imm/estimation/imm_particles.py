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

One set of weighted particles for each model, and the verbs of every particle filter::

    resample    x, c <- x, w, mu, transition, uniform  # who could have become model j
    propagate   x <- F x + G noise                     # each model moves its particles
    weigh       w, mu <- log_likelihood, c             # each particle meets the measurement
    summarise   mean, covariance <- x, w, mu           # before anything is resampled again

There is no rejuvenation step, `move`: the noise of every model keeps copies of a particle apart.

Shapes: M models, n states, N particles per model, k noises. ``x (M, n, N)``, ``w (M, N)`` with
rows summing to one, ``mu (M,)``, ``transition (M, M)`` with ``transition[i, j] = Pr(j at t | i at
t-1)``, ``F (M, n, n)``, ``G (M, n, k)``, ``log_likelihood (M, N)``. Particles come last so that
loops over them run along memory.

**Resampling is the mixing of the multiple-model filter, and is exact.** Given that model j holds
now, the state one step ago has the density ``sum_i mu_{i|j} p_i(x)``, ``mu_{i|j} = P_ij mu_i /
c_j``; the union of all sets with the weights ``mu_{i|j} w_i`` represents it, and N systematic
draws from the union represent it again (Boers and Driessen 2003). A Gaussian IMM has to put one
Gaussian in the place of that mixture; particles do not. No other resampling is needed: what leaves
it has equal weights.

**Weights are retained.** What leaves `weigh` keeps its weights until the next resampling, and the
likelihood of model j is the *weighted* mean ``L_j = sum_n w_n q_n`` of its particles' likelihoods
q_n. The plain mean often printed is right only for equal weights, which is what they are here
after resampling, but not if a step is left out. The answer is summarised before particles are
drawn again, since drawing can only add noise to it.

The filter uses no generator of its own: `uniform (M,)` and `noise (M, k, N)`, standard normal, are
given. The verbs are compiled and write into arrays of the caller. Loops over particles are written
so that the compiler can run them several at a time: no branch, no running sum, one array written.
What cannot be is kept apart.

References: Y. Boers, J. Driessen, *Interacting multiple model particle filter*, IEE Proc. Radar
Sonar Navig. 150(5), 2003; H. Driessen, Y. Boers, *Efficient particle filter for jump Markov
nonlinear systems*, ibid. 152(5), 2005.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from .arrays import FloatArray, IntArray
from .elementary import exponentials, ROUND
from .jit import kernel

LEAST_CHANCE = 1e-290
"""A model less probable than this before a measurement counts as one that nothing can become: the
reciprocal of its probability could not be held."""


class ResampleScratch(NamedTuple):
    """What `resample` needs room for: running (M, N), points (N,) and origin (N + 1,)."""

    running: FloatArray
    points: FloatArray
    origin: IntArray


@kernel
def resample(
    x: FloatArray,
    w: FloatArray,
    mu: FloatArray,
    transition: FloatArray,
    uniform: FloatArray,
    scratch: ResampleScratch,
    mixed: FloatArray,
    c: FloatArray,
) -> None:
    """Equally weighted particles for each model into mixed (M, n, N), and the predicted
    probability of each into c (M,). uniform (M,) in [0, 1).

    A model that nothing can become (c_j below `LEAST_CHANCE`) draws from the mixture of all, so
    that it stays finite and can come back when the chain allows.

    The obvious walk along the cumulative weights has a branch that no processor can predict.
    Instead every particle writes its number where its copies begin, the last one to write at a
    place being the one that has copies there, and a running maximum fills the places between.
    Weights that are not finite give meaningless particles, but no index outside of the arrays.
    """
    M, n, N = x.shape
    running, points, origin = scratch
    for i in range(M):
        total = 0.0
        for s in range(N):
            total += w[i, s]
            running[i, s] = total
    for j in range(M):
        c[j], total = 0.0, 0.0
        for i in range(M):
            c[j] += transition[i, j] * mu[i]
        possible = c[j] > LEAST_CHANCE
        for i in range(M):
            share = transition[i, j] * mu[i] if possible else mu[i]
            total += share * running[i, N - 1]
        for k in range(N + 1):
            origin[k] = 0
        begin, before, scale = 0, 0.0, N / total
        for i in range(M):
            share = transition[i, j] * mu[i] if possible else mu[i]
            row = running[i]
            for s in range(N):
                point = (before + share * row[s]) * scale - uniform[j]
                whole = (point + ROUND) - ROUND
                points[s] = whole + 1.0 if whole < point else whole
            before += share * running[i, N - 1]
            for s in range(N):
                origin[begin] = i * N + s
                begin = int(points[s]) if points[s] < N else N
        source = 0
        for k in range(N):
            source = max(source, origin[k])
            origin[k] = source
        for a in range(n):
            out, i = mixed[j, a], 0
            from_model = x[0, a]
            for k in range(N):
                while origin[k] >= (i + 1) * N:
                    i += 1
                    from_model = x[i, a]
                out[k] = from_model[origin[k] - i * N]


@kernel
def propagate(
    x: FloatArray, F: FloatArray, G: FloatArray, noise: FloatArray, moved: FloatArray
) -> None:
    """x <- F x + G noise for a single model: x (n, N), F (n, n), G (n, k), noise (k, N) standard
    normal, into moved (n, N)."""
    n, N = x.shape
    for a in range(n):
        out = moved[a]
        for s in range(N):
            out[s] = 0.0
        for b in range(n):
            if F[a, b] != 0.0:
                factor, source = F[a, b], x[b]
                for s in range(N):
                    out[s] += factor * source[s]
        for b in range(G.shape[1]):
            if G[a, b] != 0.0:
                factor, source = G[a, b], noise[b]
                for s in range(N):
                    out[s] += factor * source[s]


@kernel
def weigh(
    log_likelihood: FloatArray, c: FloatArray, w: FloatArray, mu: FloatArray, work: FloatArray
) -> float:
    """w_n <- w_n q_n / L_j, mu_j <- c_j L_j / sum, L_j = sum_n w_n q_n.

    w (M, N) is read and replaced, mu (M,) written; work (2, N) is scratch, log_likelihood (M, N)
    is left shifted. Gives the log likelihood of the measurement given those before, -inf when no
    particle could explain it and the prediction was kept. A model whose particles are all
    impossible, or that is less likely than another by more than exp(-700), gets mu_j = 0 and keeps
    its weights."""
    M, N = w.shape
    best, everything = -math.inf, 0.0
    for j in range(M):
        mu[j] = c[j]
        row = log_likelihood[j]
        for s in range(N):
            best = row[s] if row[s] > best else best
    if not math.isfinite(best):
        return -math.inf
    for j in range(M):
        row, prior = log_likelihood[j], w[j]
        for s in range(N):
            row[s] -= best
        exponentials(row, work[0], work[1])
        total = 0.0
        for s in range(N):
            row[s] = prior[s] * work[1, s]
            total += row[s]
        mu[j] = c[j] * total
        everything += mu[j]
        for s in range(N):
            row[s] = row[s] / total if total > 0.0 else prior[s]
    if not everything > 0.0:
        for j in range(M):
            mu[j] = c[j]
        return -math.inf
    for j in range(M):
        mu[j] /= everything
        for s in range(N):
            w[j, s] = log_likelihood[j, s]
    return best + math.log(everything)


@kernel
def summarise(
    x: FloatArray, w: FloatArray, mu: FloatArray, mean: FloatArray, covariance: FloatArray
) -> None:
    """Mean (n,) and covariance (n, n) of the mixture of all models."""
    M, n, N = x.shape
    for a in range(n):
        mean[a] = 0.0
        for b in range(n):
            covariance[a, b] = 0.0
    for j in range(M):
        for a in range(n):
            total = 0.0
            for s in range(N):
                total += w[j, s] * x[j, a, s]
            mean[a] += mu[j] * total
    for j in range(M):
        for a in range(n):
            for b in range(a + 1):
                total = 0.0
                for s in range(N):
                    total += w[j, s] * (x[j, a, s] - mean[a]) * (x[j, b, s] - mean[b])
                covariance[a, b] += mu[j] * total
                covariance[b, a] = covariance[a, b]


@kernel
def effective_sample_size(w: FloatArray, mu: FloatArray) -> float:
    """sum_j mu_j / sum_n w_jn^2: how many particles of the likely models count."""
    total = 0.0
    for j in range(w.shape[0]):
        squares = 0.0
        for s in range(w.shape[1]):
            squares += w[j, s] * w[j, s]
        total += mu[j] / squares
    return total
