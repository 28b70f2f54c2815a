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

"""Small matrices of many components at once, compiled.

One component's numbers hardly fill a processor that does several additions at a time. So many
components lie side by side here, each in a *lane*: an array (.., lanes) has one number of every
component in a row, and the last loop of everything runs along such a row. What is done to a lane
does not depend on its neighbours, so a component has the same bits in any company.

The loops are kept short, with few arrays in each: only then are they compiled to vector
instructions.
"""

from __future__ import annotations

import math

from .arrays import FloatArray, IntArray
from .covariance import LIMIT
from .jit import kernel

MOST_LANES = 48
"""With more, the numbers of all lanes do not fit into the fastest memory."""


@kernel
def lanes_for(count: int) -> int:
    """How many lanes `count` > 0 components are worked on with, in as few turns as can be."""
    turns = (count + MOST_LANES - 1) // MOST_LANES
    return (count + turns - 1) // turns


@kernel
def turn_of(first: int, count: int, lanes: int) -> int:
    """Where the turn that would begin with component `first` does begin, so that it ends with the
    last of `count`; some are then done twice, which changes nothing."""
    return min(first, count - lanes)


@kernel
def roots(S: FloatArray, L: FloatArray, scratch: FloatArray) -> None:
    """`small_matrices.semidefinite_root` of the matrices S (n, n, lanes), into L; only lower
    triangles are read and written. scratch: (lanes,)."""
    n, _, lanes = S.shape
    for b in range(n):
        for a in range(b, n):
            for k in range(lanes):
                L[a, b, k] = S[a, b, k]
            for c in range(b):
                for k in range(lanes):
                    L[a, b, k] -= L[a, c, k] * L[b, c, k]
        for k in range(lanes):
            pivot = L[b, b, k]
            known = pivot <= LIMIT * S[b, b, k] or not pivot > 0.0
            root = math.sqrt(pivot)
            L[b, b, k] = 0.0 if known else root
            scratch[k] = 0.0 if known else 1.0 / root
        for a in range(b + 1, n):
            for k in range(lanes):
                L[a, b, k] *= scratch[k]


@kernel
def unsound(S: FloatArray, L: FloatArray, scratch: FloatArray, bad: IntArray) -> None:
    """bad (lanes,): 1 where `small_matrices.sound` would refuse the matrix of S (n, n, lanes), 0
    elsewhere. The lower triangle is read; L (n, n, lanes) and scratch (lanes,) are written."""
    n, _, lanes = S.shape
    for k in range(lanes):
        bad[k] = 0
    for a in range(n):
        # L D L' without square roots: L below the diagonal, L D above it, 1 / D on it.
        for k in range(lanes):
            scratch[k] = S[a, a, k] - LIMIT * S[a, a, k]
        for b in range(a):
            for k in range(lanes):
                L[b, a, k] = S[a, b, k]
            for c in range(b):
                for k in range(lanes):
                    L[b, a, k] -= L[c, a, k] * L[b, c, k]
            for k in range(lanes):
                L[a, b, k] = L[b, a, k] * L[b, b, k]
            for k in range(lanes):
                lost = (L[b, b, k] == 0.0) & (L[b, a, k] != 0.0)
                bad[k] = 1 if lost else bad[k]
            for k in range(lanes):
                scratch[k] -= L[b, a, k] * L[a, b, k]
        for k in range(lanes):
            rest = scratch[k]
            positive = (rest > 0.0) & (rest < math.inf)
            L[a, a, k] = 1.0 / rest if positive else 0.0
        for k in range(lanes):
            nothing = (S[a, a, k] == 0.0) & (scratch[k] == 0.0)
            bad[k] = bad[k] if (L[a, a, k] > 0.0) | nothing else 1
