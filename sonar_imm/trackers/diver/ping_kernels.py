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

"""The update of one diver by one ping over all subsets of its arrivals, compiled.

The mathematics is that of `estimation.subset_update`, for numbers that exclude or follow each
other. Numbers of one *node*, the echoes of a transmitter-receiver pair, exclude each other: an
explanation takes one of them as good, or none, which costs ``eps u`` for each. A number with a
*parent*, the bearing that came with an echo, is asked only where the echo is taken.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...acoustics.arrivals_3d import BEARING, observe
from ...estimation.arrays import BoolArray, FloatArray, IntArray
from ...estimation.consider import consider_scalar
from ...estimation.jit import kernel

PRUNE = 14.0
"""An explanation whose log-probability is this much below the best one's is dropped."""

MOST_EXPLANATIONS = 128
"""Explanations of a model at once; beyond, the worst give way."""


class Numbers(NamedTuple):
    """The C numbers of one ping, sorted by node, parents before their children.

    node (C,): numbers of one node exclude each other; parent (C,): index of the number this one
    came with, -1 for none; kind (C,): see `acoustics.arrivals_3d`; value, variance (C,); density
    (C,): of a wild value, per unit; tx, rx (C, 3) m; columns (C, 7): see `arrivals_3d.observe`.
    """

    node: IntArray
    parent: IntArray
    kind: IntArray
    value: FloatArray
    variance: FloatArray
    density: FloatArray
    tx: FloatArray
    rx: FloatArray
    columns: IntArray


@kernel
def _place(
    X: FloatArray,
    Ps: FloatArray,
    good: BoolArray,
    weights: FloatArray,
    count: int,
    x: FloatArray,
    P: FloatArray,
    chosen: BoolArray,
    weight: float,
) -> int:
    """Put an explanation among `count` others, over the worst where there is no room: the slot, -1
    where it is the worst itself."""
    slot = count
    if count == len(weights):
        slot = np.argmin(weights)
        if weights[slot] >= weight:
            return -1
    X[slot, :] = x
    Ps[slot, :, :] = P
    good[slot, :] = chosen
    weights[slot] = weight
    return slot


@kernel
def subset_ping(
    x: FloatArray,
    P: FloatArray,
    estimated: BoolArray,
    height: float,
    numbers: Numbers,
    outlier_probability: float,
    most: int,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Update the M models of a diver, x (M, n), P (M, n, n), by the `numbers` of a ping.

    estimated (n,): False for what is only considered; height: z of the diver where z is no state.
    Gives x, P, the log-evidence (M,) of the ping and the probability (M, C) that each number is
    good.
    """
    M, n = x.shape
    C = len(numbers.value)
    x1, P1 = np.zeros((M, n)), np.zeros((M, n, n))
    evidence, taken = np.empty(M), np.zeros((M, C))
    X, Ps = np.empty((2, most, n)), np.empty((2, most, n, n))
    good, weights = np.zeros((2, most, C), np.bool_), np.full((2, most), -np.inf)
    gradient, scratch, spread = np.empty(n), np.empty(n), np.empty(n)
    x_c, P_c, chosen = np.empty(n), np.empty((n, n)), np.zeros(C, np.bool_)
    log_good = math.log1p(-outlier_probability)
    log_wild = math.log(max(outlier_probability, 1e-300))
    for j in range(M):
        now, count, best, first = 0, 1, 0.0, 0
        X[0, 0, :] = x[j]
        Ps[0, 0, :, :] = P[j]
        good[0, 0, :] = False
        weights[0, 0] = 0.0
        while first < C:
            last, wild = first, 0.0
            while last < C and numbers.node[last] == numbers.node[first]:
                wild += numbers.density[last]
                last += 1
            then, grown = 1 - now, 0
            parent = numbers.parent[first]
            for b in range(count):
                weight = weights[now, b]
                if weight < best - PRUNE:
                    continue
                followed = parent < 0 or good[now, b, parent]
                refused = weight + log_wild if followed else weight
                if parent < 0:
                    refused += math.log(wild)
                slot = _place(
                    X[then],
                    Ps[then],
                    good[then],
                    weights[then],
                    grown,
                    X[now, b],
                    Ps[now, b],
                    good[now, b],
                    refused,
                )
                grown = max(grown, slot + 1)
                if not followed:
                    continue
                for c in range(first, last):
                    x_c[:] = X[now, b]
                    P_c[:, :] = Ps[now, b]
                    innovation = numbers.value[c] - observe(
                        numbers.kind[c],
                        x_c,
                        numbers.columns[c],
                        height,
                        numbers.tx[c],
                        numbers.rx[c],
                        gradient,
                    )
                    if numbers.kind[c] == BEARING:
                        turns = math.floor(innovation / (2.0 * math.pi) + 0.5)
                        innovation -= 2.0 * math.pi * turns
                    fit = consider_scalar(
                        x_c, P_c, gradient, numbers.variance[c], innovation, estimated, scratch
                    )
                    if parent >= 0:
                        fit -= math.log(wild)
                    if not math.isfinite(fit):
                        continue
                    chosen[:] = good[now, b]
                    chosen[c] = True
                    slot = _place(
                        X[then],
                        Ps[then],
                        good[then],
                        weights[then],
                        grown,
                        x_c,
                        P_c,
                        chosen,
                        weight + log_good + fit,
                    )
                    grown = max(grown, slot + 1)
            now, count, first = then, grown, last
            best = weights[now, :count].max()
        total = 0.0
        for b in range(count):
            share = math.exp(weights[now, b] - best)
            if weights[now, b] < best - PRUNE:
                share = 0.0
            weights[now, b] = share
            total += share
        for b in range(count):
            share = weights[now, b] / total
            for a in range(n):
                x1[j, a] += share * X[now, b, a]
            for c in range(C):
                if good[now, b, c]:
                    taken[j, c] += share
        for b in range(count):
            share = weights[now, b] / total
            if share > 0.0:
                for a in range(n):
                    spread[a] = X[now, b, a] - x1[j, a]
                for a in range(n):
                    for k in range(a + 1):
                        P1[j, a, k] += share * (Ps[now, b, a, k] + spread[a] * spread[k])
        for a in range(n):
            for k in range(a):
                P1[j, k, a] = P1[j, a, k]
        evidence[j] = best + math.log(total)
    return x1, P1, evidence, taken
