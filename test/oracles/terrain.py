# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Exact smoothers along the bins of a ping. One surface: heights and slopes with several models.

Exact but for the width of the cells: no Gaussian stands in for any density, and what the models
mix is kept as it is. Probability sits on cells (M, B, S) of model, height of the base and slope.

One and two surfaces: with one matrix over all heights and pairs of them."""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import numpy as np

from sonar_imm.estimation.arrays import FloatArray


class Moments(NamedTuple):
    """Of each bin: mean (T,) and variance (T,) of its height, probability (T, M) of the models,
    and the logarithm (T,) of its likelihood given the bins before it."""

    mean: FloatArray
    variance: FloatArray
    probability: FloatArray
    log_likelihood: FloatArray


def density(x, std):
    """Normal density of x (...), as a share of the cells of the last axis."""
    shape = np.exp(-0.5 * np.square(x / std))
    return np.asarray(shape / np.maximum(shape.sum(axis=-1, keepdims=True), 1e-300))


def motion(base, slope, walk, phi, follow, slope0, width):
    """How one model moves: weights (S, S') of slopes, and (S, S', B, B') of heights given both."""
    S = len(slope)
    if not follow:
        turned = np.tile(density(slope, slope0), (S, 1))
        walked = density(base[None, :] - base[:, None], walk)
        return turned, np.broadcast_to(walked, (S, S, *walked.shape))
    noise = slope0 * np.sqrt(1.0 - phi**2)
    turned = density(slope[None, :] - phi * slope[:, None], noise)
    shift = 0.5 * width * (slope[:, None] + slope[None, :])
    off = base[None, None, None, :] - base[None, None, :, None] - shift[:, :, None, None]
    return turned, density(off, walk)


def smoothed(
    start, base, slope, models, transition, initial, slope0, width, log_likelihood, echo, coast
):
    """What the bins before and at each one say, and what the whole ping says.

    start: mean and standard deviation of the base. models: walk, phi, follow and scatter of each.
    log_likelihood (T, B) of the height of a bin at the cells `base`; echo (T,).
    """
    T, M = len(log_likelihood), len(models)
    moves = [motion(base, slope, *model[:3], slope0, width) for model in models]
    about = [
        density(base[None, :] - base[:, None], model[3]) if model[3] > 0.0 else np.eye(len(base))
        for model in models
    ]
    level = np.exp(log_likelihood - log_likelihood.max(axis=1, keepdims=True))
    law = density(base - start[0], start[1])[:, None] * density(slope, slope0)
    p = initial[:, None, None] * law
    predicted, answers, logs = np.empty((T, *p.shape)), [], np.zeros(T)
    for t in range(T):
        mixed = np.einsum('ij,ibs->jbs', transition, p) if echo[t] else p
        for j in range(M):
            turned, walked = moves[j if echo[t] else coast[j]]
            predicted[t, j] = np.einsum('bs,sr,srbc->cr', mixed[j], turned, walked, optimize=True)
        p = predicted[t]
        answers.append(of_bin(p, base, about, level[t], echo[t]))
        if echo[t]:
            p = p * np.array([kernel @ level[t] for kernel in about])[:, :, None]
            logs[t] = np.log(p.sum()) + log_likelihood[t].max()
            p = p / p.sum()
    later, whole = np.ones(p.shape), []
    for t in range(T - 1, -1, -1):
        whole.append(of_bin(predicted[t] * later, base, about, level[t], echo[t]))
        if echo[t]:
            later = later * np.array([kernel @ level[t] for kernel in about])[:, :, None]
        back = np.empty_like(later)
        for j in range(M):
            turned, walked = moves[j if echo[t] else coast[j]]
            back[j] = np.einsum('cr,sr,srbc->bs', later[j], turned, walked, optimize=True)
        later = np.einsum('ij,jbs->ibs', transition, back) if echo[t] else back
        later /= later.max()
    before, after = (
        Moments(*(np.array(part) for part in zip(*each)), logs) for each in (answers, whole[::-1])
    )
    return before, after


def of_bin(p, base, about, level, echo):
    """Mean and variance of the height of a bin, and the models (M,), given all but its samples
    p (M, B, S) and those, `level` (B,)."""
    height = np.array([each.sum(axis=1) @ kernel for each, kernel in zip(p, about)])
    height = height * level if echo else height
    height /= height.sum()
    mean = float(height.sum(axis=0) @ base)
    return mean, float(height.sum(axis=0) @ np.square(base - mean)), height.sum(axis=1)


def states_of(cells, gap):
    """Every height alone, and every pair of heights `gap` cells or more apart: tuples of cells."""
    pairs = [(i, j) for i, j in itertools.combinations(range(cells), 2) if j - i >= gap]
    return [(i,) for i in range(cells)] + pairs


def log_likelihood(y, v, sines, spacing):
    """Log density of a bin y (P,) in unit noise with echoes from `sines`, each of power v: normal
    with covariance R = I + v sum a a^H; relative to noise alone."""
    p = np.arange(len(y))
    R = np.eye(len(y), dtype=complex)
    for sine in sines:
        a = np.exp(2j * math.pi * spacing * sine * p)
        R += v * np.outer(a, a.conj())
    exponent = (y.conj() @ y - y.conj() @ np.linalg.solve(R, y)).real
    return exponent - math.log(np.linalg.det(R).real)


def walk(cells, parts, step, reach):
    """Matrix (G, G) of a walk that is a mixture of (share, std) and is lost beyond the grid."""
    place = step * np.arange(-reach, reach + 1)
    taps = sum(
        share * np.exp(-0.5 * (place / std) ** 2) / np.exp(-0.5 * (place / std) ** 2).sum()
        for share, std in parts
    )
    matrix = np.zeros((cells, cells))
    for i, j in itertools.product(range(cells), repeat=2):
        if abs(i - j) <= reach:
            matrix[i, j] = taps[reach + i - j]
    return matrix


def transition(states, single, two, birth, end, anywhere, cells):
    """Chance (N, N) from a state, row, to a state, column."""
    matrix = np.zeros((len(states), len(states)))
    for (a, before), (b, after) in itertools.product(enumerate(states), repeat=2):
        if len(before) == len(after) == 1:
            moved = (1.0 - anywhere) * single[before[0], after[0]] + anywhere / cells
            matrix[a, b] = (1.0 - birth) * moved
        elif len(before) == len(after) == 2:
            moved = (1.0 - anywhere) * two[before[0], after[0]] * two[before[1], after[1]]
            # One of both stays, the other one may be anywhere.
            moved += 0.5 * anywhere / cells * sum(h in after for h in before)
            matrix[a, b] = (1.0 - end) * moved
        elif len(after) == 2:
            matrix[a, b] = birth / cells * (before[0] in after)
        else:
            matrix[a, b] = 0.5 * end * (after[0] in before)
    return matrix


def smooth(start, step, log_weights):
    """Probability (n, N) of each state in each bin: start (N,), step (N, N), what each bin says of
    each state (n, N)."""
    weights = np.exp(log_weights - log_weights.max(axis=1, keepdims=True))
    ahead = [start * weights[0]]
    for weight in weights[1:]:
        ahead.append((ahead[-1] @ step) * weight)
        ahead[-1] /= ahead[-1].sum()
    back = np.ones(len(start))
    out = []
    for t in range(len(weights) - 1, -1, -1):
        p = ahead[t] * back
        out.append(p / p.sum())
        back = step @ (weights[t] * back)
    return np.array(out[::-1])
