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

"""What is known of all divers after a scan, and how it crosses the time to the next.

`Known` is one immutable value. A track is a weighted set of rows (`estimation.rows`): a row is one
interacting multiple model filter under one assumption, a scale of the covariances of measurements
or a depth at which the track began. What a stage of the tracker notes of each track is a
*feature*, what it remembers of no track stands in the *memory*; this module knows neither by name.
"""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Any, NamedTuple

from attrs import evolve, frozen
import numpy as np

from ...estimation import bank
from ...estimation.adaptation import AdaptiveChain
from ...estimation.arrays import BoolArray, FloatArray, IndexArray, with_rows
from ...estimation.association import Tracks
from ...estimation.bank import Gaussians
from ...estimation.covariance import are_sound, with_jitter
from ...estimation.rows import Borrowed, Rows
from .models import ModelSet

MOST_STEPS = 300
"""A gap is crossed in no more steps than this, however long it is."""


class Feature(NamedTuple):
    """What is noted of each track: the value for one that begins, its shape and its type."""

    birth: Any
    shape: tuple[int, ...] = ()
    kind: type = np.float64


@frozen(eq=False)
class Known:
    """T tracks, N rows of them, and what the stages remember.

    life: identities, hits and misses; features: by name, a column (T, ...) each; memory: by the
    name of what a stage remembers of no track; counts: of what happened so far. No array is ever
    written again: values of earlier scans share them.
    """

    stamp_ns: int
    life: Tracks
    rows: Rows
    borrowed: Borrowed
    features: dict[str, np.ndarray]
    memory: dict[str, Any]
    counts: dict[str, int]

    @classmethod
    def nobody(
        cls, life: Tracks, models: ModelSet, size: int, features: Mapping[str, Feature]
    ) -> Known:
        """Return the value without a track; `life` has none, but the next identity."""
        none = np.empty((0, models.copies, len(models.names), size))
        empty = np.empty((*none.shape, size))
        rows = models.rows(none, empty, none[..., 0], none[..., 0, 0])
        columns: dict[str, np.ndarray] = {
            name: np.empty((0, *feature.shape), feature.kind) for name, feature in features.items()
        }
        return cls(0, life, rows, Borrowed.none(), columns, {}, {})

    def __len__(self) -> int:
        return len(self.life)

    def __getitem__(self, feature: str) -> np.ndarray:
        """Return a column (T, ...)."""
        return self.features[feature]

    def put(self, **columns: np.ndarray) -> Known:
        """Return this with other columns."""
        return evolve(self, features={**self.features, **columns})

    def remember(self, **values: Any) -> Known:
        """Return this with other values in the memory."""
        return evolve(self, memory={**self.memory, **values})

    def counted(self, **more: int) -> Known:
        """Return this with counts that are higher by so many."""
        changed = {name: self.counts.get(name, 0) + n for name, n in more.items() if n}
        return evolve(self, counts={**self.counts, **changed}) if changed else self

    def replace(self, **changes: Any) -> Known:
        """Return this with other rows, life or stamp."""
        return evolve(self, **changes)

    def only(self, kept: BoolArray, life: Tracks | None = None) -> Known:
        """Return the tracks where `kept` (T,) is True; life: that of those."""
        if kept.all():
            return self if life is None else evolve(self, life=life)
        return evolve(
            self,
            life=self.life.only(kept) if life is None else life,
            rows=self.rows.of_targets(kept),
            borrowed=self.borrowed.of_targets(kept),
            features={name: column[kept] for name, column in self.features.items()},
        )

    def with_tracks(self, life: Tracks, new: Rows, columns: Mapping[str, Any]) -> Known:
        """Return this with more tracks, `life` is that of all: `new` are their rows, numbered from
        0, and `columns` has a value for each feature, or one for each track."""
        count = len(life) - len(self)
        rows = self.rows.append(evolve(new, target=new.target + len(self)))
        features = {
            name: with_rows(column, count, columns[name]) for name, column in self.features.items()
        }
        return evolve(self, life=life, rows=rows, features=features)

    def with_rows_of(self, track: int, new: Rows) -> Known:
        """Return this with `new` as all rows of one track."""
        rows, borrowed = self.rows.in_place_of(track, new), self.borrowed.without(track)
        return evolve(self, rows=rows, borrowed=borrowed)

    def rows_of(self, track: int) -> IndexArray:
        """Return which rows are those of a track."""
        return np.flatnonzero(self.rows.target == track)

    def require_like(self, other: Known, constants: int) -> None:
        """Raise ValueError where this is no value of the models of `other`, which has no track,
        with so many constants behind their components."""
        rows, T = self.rows, len(self)
        sizes = {
            block.x.shape[1] - there.x.shape[1]
            for block, there in zip(rows.blocks, other.rows.blocks)
        }
        good = (
            self._form == other._form
            and sizes in ({0}, {constants})
            and all(len(column) == T for column in self.features.values())
            and all(len(column) == len(rows) for column in rows.key.values())
            and np.array_equal(np.unique(rows.target), np.arange(T))
            and bool((np.diff(rows.target) >= 0).all() and (rows.parent >= -1).all())
            and bool(np.isin(self.borrowed.target, rows.target).all())
        )
        if not good:
            raise ValueError('states are of other models')

    @property
    def _form(self) -> tuple[object, ...]:
        """Names, types and shapes, but for the numbers of tracks, rows and constants."""
        columns = sorted({**self.features, **self.rows.key}.items())
        return (
            [(name, column.shape[1:], column.dtype) for name, column in columns],
            [(name, type(value)) for name, value in sorted(self.memory.items())],
            [block.x.shape[2] for block in self.rows.blocks],
            self.life.seen.shape[1],
        )

    def finite(self) -> BoolArray:
        """Return which tracks (T,) have finite numbers only."""
        good = np.ones(len(self.rows), np.bool_)
        for x, P in self.rows.blocks:
            good &= np.isfinite(x).all(axis=(1, 2)) & np.isfinite(P).all(axis=(1, 2, 3))
        return np.bincount(self.rows.target[~good], minlength=len(self)) == 0


def of_rows(rows: Rows, maps: tuple[FloatArray, ...]) -> tuple[FloatArray, FloatArray]:
    """Return mean (N, q) and covariance (N, q, q) of outputs of the motion under each row, `maps`
    (q, n', m) of each block."""
    blocks = [
        Gaussians(block.x[:, : E.shape[1]], block.P[:, : E.shape[1], : E.shape[1]])
        for block, E in zip(rows.blocks, maps)
    ]
    return bank.combine(blocks, rows.mu, maps)


def outputs(rows: Rows, maps: tuple[FloatArray, ...]) -> tuple[FloatArray, FloatArray]:
    """Return mean (T, q) and covariance (T, q, q) of outputs of the motion, as in `of_rows`."""
    return rows.combine(*of_rows(rows, maps), rows.weight)


def places(known: Known, models: ModelSet) -> tuple[FloatArray, FloatArray]:
    """Return mean (T, 2) and covariance (T, 2, 2) of where the divers are."""
    return outputs(known.rows, tuple(part.outputs[:2] for part in models.parts))


def repaired(blocks: tuple[Gaussians, ...]) -> tuple[tuple[Gaussians, ...], int]:
    """Return the blocks with covariances that are such, and how many were none. One that is spoilt
    changes no other (`estimation.covariance`)."""
    found, count = [], 0
    for block in blocks:
        P = block.P.transpose(1, 2, 0, 3)
        bad = ~are_sound(P)
        if bad.any():
            covariance = block.P.copy()
            row, model = np.nonzero(bad)
            covariance[row, :, :, model] = np.moveaxis(with_jitter(P[:, :, row, model])[0], -1, 0)
            block = Gaussians(block.x, covariance)
            count += int(np.isfinite(P[:, :, row, model]).all(axis=(0, 1)).sum())
        found.append(block)
    return tuple(found), count


class Step(NamedTuple):
    """Rows after a step of dt seconds without a measurement, the transitions (T or 1, M, M) of
    that step, and how many covariances it had to repair."""

    rows: Rows
    transition: FloatArray
    dt: float
    repairs: int


def crossed(
    models: ModelSet,
    chain: AdaptiveChain,
    rows: Rows,
    learnt: FloatArray,
    dt: float,
    longest: float,
) -> list[Step]:
    """Mix and predict over dt seconds, in equal steps of at most `longest`; learnt: what corrects
    the transitions of each track.

    A model holds for a whole step, so one step over a long gap says that the diver swam straight
    all the while: the prediction is a ring, and the diver, who turned, is inside it.
    """
    count = min(max(math.ceil(dt / longest), 1), MOST_STEPS)
    transition, moves = chain.transition(learnt, dt / count), models.moves(dt / count)
    of_rows = transition if len(transition) == 1 else transition[rows.target]
    steps = []
    for _ in range(count):
        blocks, mu = bank.mix(models.bank, rows.blocks, rows.mu, of_rows)
        moved = tuple(bank.predict(block, each) for block, each in zip(blocks, moves))
        moved, repairs = repaired(moved)
        mu = mu / mu.sum(axis=1, keepdims=True) if len(mu) else mu
        rows = rows.replace(blocks=moved, mu=mu, parent=np.arange(len(rows)))
        steps.append(Step(rows, transition, dt / count, repairs))
    return steps
