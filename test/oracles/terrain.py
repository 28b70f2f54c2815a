# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The filter and smoother of heights and slopes with several models, on cells of both.

Exact but for the width of the cells: no Gaussian stands in for any density, and what the models
mix is kept as it is. Probability sits on cells (M, B, S) of model, height of the base and slope.
"""

from __future__ import annotations

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
