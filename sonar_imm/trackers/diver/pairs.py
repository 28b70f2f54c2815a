# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Records of the comparison of fixes with rows, and of their association."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray, IndexArray, IntArray
from ...estimation.rows import Borrowed, Rows
from .sensors import lent_moves, scale_of


class Assumptions(NamedTuple):
    """All A assumptions of T tracks about one sensor, in order of the tracks."""

    row: IndexArray
    """(A,) row whose states are used."""
    seen: IndexArray
    """(A,) index of the prediction in `Pairs.expected`."""
    scale: FloatArray
    """(A,) scale of the covariances of the sensor."""
    logw: FloatArray
    """(A,) logarithm of the weight."""
    target: IntArray
    """(A,) track index."""
    has_row: BoolArray
    """(A,) True for assumptions with a row of their own, False for borrowed ones."""
    lent: IndexArray
    """(L,) row of each prediction beyond those of the rows, see `seen`."""
    moved: FloatArray
    """(N + L,) time over which each prediction moves along the velocity to the time of the fixes,
    s."""

    @classmethod
    def from_rows(cls, rows: Rows, borrowed: Borrowed, sensor: int) -> Assumptions:
        """Return the assumptions of rows and of the borrowed list about a sensor."""
        N, scale, moved = len(rows), scale_of(rows.key, sensor), -rows.key['delay'][:, sensor]
        every, none = np.arange(N), np.empty(0, np.intp)
        if not len(borrowed):
            has_row = np.ones(N, np.bool_)
            return cls(every, every, scale, rows.logw, rows.target, has_row, none, moved)
        target = np.concatenate([rows.target, borrowed.target])
        order = np.argsort(target, kind='stable')
        lender = borrowed.find_lenders(rows)
        its = lent_moves(rows.key, lender, borrowed.key) - borrowed.key['delay'][:, sensor]
        # A borrowed assumption has no offset.
        nil = N if rows.tail else 0
        seen, other = lender + nil, np.flatnonzero(its != moved[lender])
        lent, late = lender[other], its[other]
        if len(other):
            # One prediction for each row and time.
            pairs, place = np.unique(np.column_stack([lent, late]), axis=0, return_inverse=True)
            seen[other] = N + nil + place.ravel()
            lent, late = pairs[:, 0].astype(np.intp), pairs[:, 1]
        return cls(
            np.concatenate([every, lender])[order],
            np.concatenate([every, seen])[order],
            np.concatenate([scale, scale_of(borrowed.key, sensor)])[order],
            np.concatenate([rows.logw, borrowed.logw])[order],
            target[order],
            order < N,
            lent,
            np.concatenate([moved, late]),
        )

    def select(self, part: slice) -> Assumptions:
        """Return a part of the assumptions; the predictions stay."""
        return self._replace(
            row=self.row[part],
            seen=self.seen[part],
            scale=self.scale[part],
            logw=self.logw[part],
            target=self.target[part],
            has_row=self.has_row[part],
        )


OPEN, OUTLIER, LEAVE = range(3)
"""Ways of a fix: an offset begins, the fix is an outlier, an offset ends."""


class Ways(NamedTuple):
    """Further ways in which E pairs of a row and a fix are read, see `bursts`."""

    row: IndexArray
    """(E,) index of the row."""
    fix: IndexArray
    """(E,) index of the fix."""
    way: IntArray
    """(E,) `OPEN`, `OUTLIER` or `LEAVE`."""
    variance: FloatArray
    """(E,) variance of a new offset, m^2."""
    log: FloatArray
    """(E,) log density of the fix in this way, with the log prior of the way."""
    direct: FloatArray
    """(T, D) share of the density of a fix under a track that has the fix at the target, or at the
    offset it had."""


class Groups(NamedTuple):
    """G groups of the assumptions of T tracks: all without a link, then each linked row."""

    of: IntArray
    """(A,) group of each assumption; those without a link are in the group of their track."""
    target: IntArray
    """(G,) track."""
    link: IntArray
    """(G,) track that the group excludes; -1 for none."""
    weight: FloatArray
    """(G,) weight of the rows of the group, if the target exists."""
    log: FloatArray
    """(G, D) logarithm of the density of each fix, times this weight."""


class Pairs(NamedTuple):
    """Comparison of D fixes with assumptions, as p pairs in order of the assumptions."""

    among: Assumptions
    assumption: IndexArray
    """(p,) index of the assumption."""
    fix: IndexArray
    """(p,) index of the fix."""
    expected: list[tuple[FloatArray, FloatArray]]
    """Predictions of a fix, for each block of models, see `bank.predict_fix`: of the N rows; where
    rows have offsets, of the N rows without them; and of the L rows of `Assumptions.lent`, at
    another time and without an offset."""
    log: FloatArray
    """(p,) log density of the fix under the assumption."""
    track_log: FloatArray
    """(T, D) log density of each fix under each track."""
    nis: FloatArray | None
    """(T, D) smallest NIS of any model; None for density gating."""
    ways: Ways | None = None
    """Further ways of the fixes; None for none."""
    groups: Groups | None = None
    """Groups of assumptions; None if no row is linked."""
    in_parts: bool = False
    """True if the table was too large to be compared at once: such fixes have no further ways."""

    @property
    def direct(self) -> FloatArray | float:
        """Return the share (T, D) of the density that has the fix at the target, or at the offset
        it had."""
        return 1.0 if self.ways is None else self.ways.direct


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
    direct: FloatArray | float = 1.0
    """(T, D) see `Ways`."""
    group_beta: FloatArray | None = None
    """(G, D) probability of each pair of a group; None without groups."""
    group_missed: FloatArray | None = None
    """(G,) probability that the target exists as in the group, and was not detected."""
    held: FloatArray | float = 1.0
    """(T,) probability that no linked row excludes the track."""

    @property
    def hit(self) -> BoolArray:
        """(T,) True if a hit is more probable than a miss."""
        return self.fix >= 0

    @property
    def claimed(self) -> FloatArray:
        """(D,) probability that the fix is at any track, or at the offset it had."""
        return np.asarray((self.beta * self.direct).sum(axis=0))

    @property
    def taken(self) -> BoolArray:
        """(T,) True if the rows of a track have taken a fix in any way."""
        return np.asarray(self.beta.sum(axis=1) > 0.5 * self.exists)

    @property
    def exists(self) -> FloatArray:
        """(T,) probability that the target exists, detected or missed."""
        return self.missed + self.beta.sum(axis=1)
