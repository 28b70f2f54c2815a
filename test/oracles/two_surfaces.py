# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""One and two surfaces along a few bins, with one matrix over all heights and pairs of them."""

from __future__ import annotations

import itertools
import math

import numpy as np


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
