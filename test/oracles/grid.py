# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The filter of one state on a grid: exact, but for the width of a cell."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sonar_imm.estimation.arrays import FloatArray


class Filtered(NamedTuple):
    """Mean (T,) and variance (T,) of the state at each bin, probability (T, M) of the models, and
    the logarithm (T,) of its likelihood given the bins before it."""

    mean: FloatArray
    variance: FloatArray
    probability: FloatArray
    log_likelihood: FloatArray


def filtered(
    cells: FloatArray,
    start: tuple[float, float],
    sigma: FloatArray,
    transition: FloatArray,
    initial: FloatArray,
    log_likelihood: FloatArray,
) -> Filtered:
    """Walks of noise sigma (M,), at least the width of a cell. cells (G,), even; start: mean and
    standard deviation of the state; log_likelihood (T, G) of the cells at each bin."""
    law = np.exp(-0.5 * np.square((cells - start[0]) / start[1]))
    lag = np.arange(-len(cells) + 1, len(cells)) * (cells[1] - cells[0])
    walks = np.exp(-0.5 * np.square(lag / sigma[:, None]))
    walks /= walks.sum(axis=1, keepdims=True)
    p, rows = initial[:, None] * law / law.sum(), []
    for logs in log_likelihood:
        p = np.array([np.convolve(q, walk, 'valid') for q, walk in zip(transition.T @ p, walks)])
        p = p * np.exp(logs - logs.max())
        evidence, p = logs.max() + np.log(p.sum()), p / p.sum()
        mean = p.sum(axis=0) @ cells
        rows.append((mean, p.sum(axis=0) @ np.square(cells - mean), p.sum(axis=1), evidence))
    return Filtered(*(np.array(column) for column in zip(*rows)))
