# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The verbs of `trackers.bathymetry.filter_kernels` in numpy, bit for bit the same."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from oracles.bin_likelihood import exponentials
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.trackers.bathymetry.filter_kernels import LEAST_CHANCE


class WeightUpdate(NamedTuple):
    """w (M, N) and mu (M,) after the measurement; log_likelihood of the measurement given those
    before; ok False when no particle could explain it and the prediction was kept."""

    w: FloatArray
    mu: FloatArray
    log_likelihood: float
    ok: bool


def resample(x, w, mu, transition, uniform):
    """Equally weighted x (M, n, N) for each model, and its predicted probability c (M,).

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


def propagate(x, F, G, noise):
    """x <- F x + G e for each model; noise e (M, k, N) standard normal."""
    M, n, _ = x.shape
    moved = np.zeros_like(x)
    for j in range(M):
        for a in range(n):
            for b in range(n):
                moved[j, a] += F[j, a, b] * x[j, b]
            for b in range(G.shape[2]):
                moved[j, a] += G[j, a, b] * noise[j, b]
    return moved


def weigh(log_likelihood, c, w=None):
    """w_n <- w_n q_n / L_j, mu_j <- c_j L_j / sum, L_j = sum_n w_n q_n.

    w (M, N): weights before, equal when not given. A model whose particles are all impossible, or
    that is less likely than another by more than exp(-700), gets mu_j = 0 and keeps its weights.
    """
    M, N = log_likelihood.shape
    prior = np.full((M, N), 1.0 / N) if w is None else w
    best = float(np.max(log_likelihood, initial=-math.inf, where=~np.isnan(log_likelihood)))
    if not math.isfinite(best):
        return WeightUpdate(prior, c, -math.inf, False)
    weight = prior * exponentials(log_likelihood - best)
    L = np.array([_total(row) for row in weight])
    joint = c * L
    total = _total(joint)
    if not total > 0.0:
        return WeightUpdate(prior, c, -math.inf, False)
    alive = L > 0.0
    weight = np.where(alive[:, None], weight / np.where(alive, L, 1.0)[:, None], prior)
    return WeightUpdate(weight, joint / total, best + math.log(total), True)


def summarise(x, w, mu):
    """Mean (n,) and covariance (n, n) of the mixture of all models."""
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


def filter_bins(x, w, mu, models, chains, uniform, noise, echo, look, drift):
    """All bins of a ping; a bin's mean, covariance, mu, log likelihood and effective sample size
    each, and the particles at the end. look(state, t): log likelihoods; drift(state, t): where
    they are before they are moved."""
    answers, w = [], w.copy()
    M, _, N = x.shape
    for t in range(len(noise)):
        log_likelihood = 0.0
        mixed, c, kind = x.copy(), mu, np.full(M, models.coast)
        if echo[t]:
            mixed, c = resample(x, w, mu, chains[0], uniform[t, 0])
            if len(models.favour):
                c = c * models.favour[t]
                c = c / _total(c)
            kind = np.arange(M)
        for j in range(M):
            mixed[j, 0] = drift(mixed[j, 0], t)
        G = models.G * models.scale[t][:, None, None]
        x = propagate(mixed, models.F[kind], G[kind], noise[t])
        if echo[t]:
            w, mu, log_likelihood, _ = weigh(np.array([look(row, t) for row in x[:, 0]]), c)
        size = _total(np.array([m / _total(np.square(row)) for m, row in zip(mu, w)]))
        if len(chains) > 1 and echo[t]:
            x, _ = resample(x, w, mu, chains[1], uniform[t, 1])
            w = np.full((M, N), 1.0 / N)
        answers.append([*summarise(x, w, mu), mu, log_likelihood, size])
    return answers, x, w


def _total(values):
    """The sum from left to right, as a loop makes it: numpy's own sum pairs its terms."""
    return float(np.cumsum(values)[-1])
