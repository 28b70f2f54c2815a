# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The filter and smoother of `trackers.bathymetry.grid_kernels` in numpy, over all cells."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.trackers.bathymetry.grid_kernels import NARROW


class Filtered(NamedTuple):
    """density (T, M, G), joint over models and cells at each step; log_likelihood (T,) of each
    measurement given those before it."""

    density: FloatArray
    log_likelihood: FloatArray


def walk_matrix(cells: int, sigma: float) -> FloatArray:
    """W[h, g] (G, G), the probability of going from cell h to g, `sigma` in
    cells. Rows far from the ends sum to one; near them probability leaves the grid."""
    if not sigma > 0.0:
        return np.eye(cells)
    lag = np.arange(cells)
    if sigma < NARROW:
        row = np.where(lag == 0, 1.0 - sigma**2, np.where(lag == 1, 0.5 * sigma**2, 0.0))
        return np.asarray(row[np.abs(lag[:, None] - lag)])
    row = np.exp(-0.5 * (lag / sigma) ** 2)
    return np.asarray(row[np.abs(lag[:, None] - lag)] / (2.0 * row.sum() - 1.0))


def filter_densities(
    start: FloatArray, transition: FloatArray, sigma: FloatArray, log_likelihood: FloatArray
) -> Filtered:
    """Filter T steps. start (M, G) before the first step; sigma (T, M) in cells;
    log_likelihood (T, G)."""
    T, G = log_likelihood.shape
    density, log_sums = np.empty((T, *start.shape)), np.empty(T)
    p = start
    for t in range(T):
        mixed = transition.T @ p
        p = np.stack([m @ walk_matrix(G, s) for m, s in zip(mixed, sigma[t])])
        p /= p.sum()
        best = log_likelihood[t].max()
        p = p * np.exp(log_likelihood[t] - best)
        log_sums[t] = best + np.log(p.sum())
        density[t] = p = p / p.sum()
    return Filtered(density, log_sums)
