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

"""What of `association` runs for every target at each scan, compiled.

All floats are float64, all arrays C-contiguous. `warm` compiles or loads every kernel.
"""

from __future__ import annotations

import numpy as np

from .arrays import BoolArray, FloatArray, IntArray
from .jit import kernel

TENTATIVE, CONFIRMED, COASTING = 0, 1, 2
"""The numbers of `association.TrackStatus`, plain: a scan asks for them often."""


@kernel
def choose(
    fit: FloatArray, tentative: BoolArray, missed: float, log_clutter: float
) -> tuple[IntArray, bool]:
    """`association.assign_by_rank` where no pair competes with another: the detection (T,) of each
    target, -1 for none, and whether that is all there is to say.

    fit (T, D): of `imm.gate`; confirmed targets choose before those that are `tentative` (T,);
    missed: ln (1 - P_D) / P_D. False where a target could take two detections, or a detection
    could go to two targets of the same rank: then the choice has to be weighed.
    """
    T, D = fit.shape
    chosen = np.full(T, -1, dtype=np.int64)
    taken_by = np.full(D, -1, dtype=np.int64)
    for turn in range(2):
        for t in range(T):
            if tentative[t] != (turn == 1):
                continue
            for d in range(D):
                if not fit[t, d] > -np.inf or not missed - fit[t, d] + log_clutter < 0.0:
                    continue
                holder = taken_by[d]
                if holder >= 0 and tentative[holder] != tentative[t]:
                    continue
                if holder >= 0 or chosen[t] >= 0:
                    return chosen, False
                chosen[t], taken_by[d] = d, t
    return chosen, True


@kernel
def count(
    age: IntArray,
    seen: BoolArray,
    misses: IntArray,
    last_hit_ns: IntArray,
    status: np.ndarray,
    hit: BoolArray,
    looked: BoolArray,
    stamp_ns: int,
    confirm_hits: int,
    delete_misses: int,
    max_coast_ns: int,
) -> tuple[np.ndarray, IntArray, BoolArray, IntArray, IntArray, BoolArray]:
    """See `association.Tracks.scan`: status, age, seen, misses and last_hit_ns of the tracks that
    live on, and the mask kept (T,) of those."""
    T, window = seen.shape
    kept = np.zeros(T, dtype=np.bool_)
    out = 0
    status_1, age_1 = np.empty(T, dtype=np.uint8), np.empty(T, dtype=np.int64)
    seen_1 = np.empty((T, window), dtype=np.bool_)
    misses_1, last_1 = np.empty(T, dtype=np.int64), np.empty(T, dtype=np.int64)
    for t in range(T):
        there = looked[t] or hit[t]
        hits = 0
        for k in range(window):
            one = seen[t, k]
            if there:
                one = seen[t, k + 1] if k + 1 < window else hit[t]
            seen_1[out, k] = one
            hits += one
        age_1[out] = age[t] + there
        misses_1[out] = 0 if hit[t] else misses[t] + there
        last_1[out] = stamp_ns if hit[t] else last_hit_ns[t]
        if status[t] != TENTATIVE or hits >= confirm_hits:
            status_1[out] = CONFIRMED if hit[t] else (COASTING if there else status[t])
            ended = misses_1[out] >= delete_misses
        else:
            status_1[out] = TENTATIVE
            ended = min(age_1[out], window) - hits > window - confirm_hits
        kept[t] = not ended and stamp_ns - last_1[out] <= max_coast_ns
        out += kept[t]
    return status_1[:out], age_1[:out], seen_1[:out], misses_1[:out], last_1[:out], kept


def warm() -> None:
    """Run the kernels once on tiny input: compiled or loaded from the cache."""
    one, no = np.ones(1, np.int64), np.zeros(1, np.bool_)
    choose(np.zeros((1, 1)), no, 0.0, 0.0)
    count(one, no[:, None], one, one, one.astype(np.uint8), no, no, 1, 1, 1, 1)
