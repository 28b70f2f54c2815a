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

"""Records of the comparison of fixes with rows, and of their association."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray, IndexArray, IntArray
from ...estimation.rows import Borrowed, Rows


class Assumptions(NamedTuple):
    """All A assumptions of T tracks, in order of the tracks."""

    row: IndexArray
    """(A,) row whose states are used."""
    scale: FloatArray
    """(A,) scale of the covariances."""
    logw: FloatArray
    """(A,) logarithm of the weight."""
    target: IntArray
    """(A,) track index."""
    has_row: BoolArray
    """(A,) True for assumptions with a row of their own, False for borrowed ones."""

    @classmethod
    def from_rows(cls, rows: Rows, borrowed: Borrowed) -> Assumptions:
        """Return the assumptions of rows and of the borrowed list."""
        N, scale = len(rows), rows.key['scale']
        if not len(borrowed):
            return cls(np.arange(N), scale, rows.logw, rows.target, np.ones(N, np.bool_))
        target = np.concatenate([rows.target, borrowed.target])
        order = np.argsort(target, kind='stable')
        return cls(
            np.concatenate([np.arange(N), borrowed.find_lenders(rows)])[order],
            np.concatenate([scale, borrowed.key['scale']])[order],
            np.concatenate([rows.logw, borrowed.logw])[order],
            target[order],
            order < N,
        )


class Pairs(NamedTuple):
    """Comparison of D fixes with assumptions, as p pairs in order of the assumptions."""

    among: Assumptions
    assumption: IndexArray
    """(p,) index of the assumption."""
    fix: IndexArray
    """(p,) index of the fix."""
    expected: list[tuple[FloatArray, FloatArray]]
    """Prediction of a fix by each row, for each block of models: see `bank.predict_fix`."""
    log: FloatArray
    """(p,) log density of the fix under the assumption."""
    track_log: FloatArray
    """(T, D) log density of each fix under each track."""
    nis: FloatArray | None
    """(T, D) smallest NIS of any model; None for density gating."""


class Association(NamedTuple):
    """Association of D fixes with T tracks."""

    beta: FloatArray
    """(T, D) probability of each pair."""
    missed: FloatArray
    """(T,) probability that the target exists and was not detected."""
    fix: IntArray
    """(T,) most probable fix of a track with a hit; -1 for no hit."""
    free: BoolArray
    """(D,) True for fixes that may start a track."""
    existence: FloatArray | None
    """(D,) existence of a track started at the fix; None if hits are counted."""
    score: FloatArray
    """(T,) new score of each track."""
    is_joint: bool = False
    """True if existence follows from the probabilities."""

    @property
    def hit(self) -> BoolArray:
        """(T,) True if a hit is more probable than a miss."""
        return self.fix >= 0

    @property
    def claimed(self) -> FloatArray:
        """(D,) probability that the fix belongs to any track."""
        return np.asarray(self.beta.sum(axis=0))

    @property
    def exists(self) -> FloatArray:
        """(T,) probability that the target exists, detected or missed."""
        return self.missed + self.beta.sum(axis=1)
