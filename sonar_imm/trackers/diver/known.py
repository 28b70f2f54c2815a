# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Tracker state after a scan, and its prediction to the next scan.

`Known` is one immutable value. A track is a weighted set of rows (`estimation.rows`). A row is one
interacting multiple model filter under one assumption: a scale of the measurement covariances, or
a start depth. Data of a stage for each track is a *feature*; its data for all tracks is in the
*memory*. This module knows no feature or memory entry by name.
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
from .config import DiverConfig
from .models import ModelSet, VELOCITY

BORROWING = ('scale', 'delay')
"""Assumptions that can borrow (`estimation.rows`)."""

MOST_STEPS = 300
"""Maximum number of prediction steps over a gap."""


class Feature(NamedTuple):
    """A column of the state with one value for each track."""

    birth: Any
    """Value of a new track."""
    shape: tuple[int, ...] = ()
    """Shape of one value."""
    kind: type = np.float64
    """numpy type of the column."""


@frozen(eq=False)
class Known:
    """Tracker state: T tracks with N rows, and the memory of the stages.

    Arrays are never changed in place, because the states of earlier scans share them.
    """

    stamp_ns: int
    """Time of the scan, ns; 0 before the first scan."""
    life: Tracks
    """Track IDs, hits and misses."""
    rows: Rows
    """N rows of all tracks, in order of the tracks."""
    borrowed: Borrowed
    """Assumptions without a row of their own."""
    features: dict[str, np.ndarray]
    """Columns (T, ...) by name."""
    memory: dict[str, Any]
    """Data of the stages that belongs to no track, by name."""
    counts: dict[str, int]
    """Event counters by name."""

    @classmethod
    def empty(
        cls, life: Tracks, models: ModelSet, size: int, features: Mapping[str, Feature]
    ) -> Known:
        """Return a state without tracks; `life` holds the next track ID."""
        none = np.empty((0, models.rows_per_track, len(models.names), size))
        empty = np.empty((*none.shape, size))
        rows = models.make_rows(none, empty, none[..., 0], none[..., 0, 0])
        columns: dict[str, np.ndarray] = {
            name: np.empty((0, *feature.shape), feature.kind) for name, feature in features.items()
        }
        return cls(0, life, rows, Borrowed.from_rows(rows, BORROWING), columns, {}, {})

    def __len__(self) -> int:
        return len(self.life)

    def __getitem__(self, feature: str) -> np.ndarray:
        """Return a column (T, ...)."""
        return self.features[feature]

    def with_columns(self, **columns: np.ndarray) -> Known:
        """Return the state with the given columns replaced."""
        return evolve(self, features={**self.features, **columns})

    def with_memory(self, **values: Any) -> Known:
        """Return the state with the given memory entries replaced."""
        return evolve(self, memory={**self.memory, **values})

    def add_counts(self, **more: int) -> Known:
        """Return the state with increased event counters."""
        changed = {name: self.counts.get(name, 0) + n for name, n in more.items() if n}
        return evolve(self, counts={**self.counts, **changed}) if changed else self

    def replace(self, **changes: Any) -> Known:
        """Return the state with other rows, life or stamp."""
        return evolve(self, **changes)

    def select(self, kept: BoolArray, life: Tracks | None = None) -> Known:
        """Return the tracks selected by `kept` (T,). life: lifecycle data of the selected
        tracks."""
        if kept.all():
            return self if life is None else evolve(self, life=life)
        return evolve(
            self,
            life=self.life.only(kept) if life is None else life,
            rows=self.rows.select_targets(kept),
            borrowed=self.borrowed.select_targets(kept),
            features={name: column[kept] for name, column in self.features.items()},
        )

    def with_tracks(self, life: Tracks, new: Rows, columns: Mapping[str, Any]) -> Known:
        """Return the state with additional tracks.

        :param life: lifecycle data of all tracks.
        :param new: rows of the new tracks, whose targets are numbered from 0.
        :param columns: for each feature one value, or one value per new track.
        """
        count = len(life) - len(self)
        rows = self.rows.append(evolve(new, target=new.target + len(self)))
        features = {
            name: with_rows(column, count, columns[name]) for name, column in self.features.items()
        }
        return evolve(self, life=life, rows=rows, features=features)

    def with_rows_of(self, track: int, new: Rows) -> Known:
        """Return the state with all rows of one track replaced by `new`."""
        rows, borrowed = self.rows.replace_target(track, new), self.borrowed.without_target(track)
        return evolve(self, rows=rows, borrowed=borrowed)

    def row_indices(self, track: int) -> IndexArray:
        """Return the row indices of a track."""
        return np.flatnonzero(self.rows.target == track)

    def track_rows(self, track: int) -> Rows:
        """Return the rows of one track, as those of target 0."""
        rows = self.rows.select(self.row_indices(track))
        return evolve(rows, target=np.zeros(len(rows), np.int64))

    def require_like(self, other: Known, constants: int) -> None:
        """Check that the state fits the models of `other`, a state without tracks.

        :param constants: expected number of constants behind the motion components.
        :raises ValueError: the state belongs to other models.
        """
        rows, T = self.rows, len(self)
        sizes = {
            block.x.shape[1] - there.x.shape[1] - rows.tail
            for block, there in zip(rows.blocks, other.rows.blocks)
        }
        good = (
            self._form == other._form
            and sizes in ({0}, {constants})
            and all(len(column) == T for column in self.features.values())
            and all(len(column) == len(rows) for column in rows.key.values())
            and all(len(column) == len(self.borrowed) for column in self.borrowed.key.values())
            and np.array_equal(np.unique(rows.target), np.arange(T))
            and bool((np.diff(rows.target) >= 0).all() and (rows.parent >= -1).all())
            and bool(np.isin(self.borrowed.target, rows.target).all())
        )
        if not good:
            raise ValueError('states are of other models')

    @property
    def _form(self) -> tuple[object, ...]:
        """Names, types and shapes, except the numbers of tracks, rows and constants."""
        columns = sorted({**self.features, **self.rows.key, **self.borrowed.key}.items())
        return (
            [(name, column.shape[1:], column.dtype) for name, column in columns],
            [(name, type(value)) for name, value in sorted(self.memory.items())],
            [block.x.shape[2] for block in self.rows.blocks],
            self.life.seen.shape[1],
        )

    def is_finite(self) -> BoolArray:
        """Return which tracks (T,) contain finite numbers only."""
        good = np.ones(len(self.rows), np.bool_)
        for x, P in self.rows.blocks:
            good &= np.isfinite(x).all(axis=(1, 2)) & np.isfinite(P).all(axis=(1, 2, 3))
        return np.bincount(self.rows.target[~good], minlength=len(self)) == 0


def row_outputs(rows: Rows, maps: tuple[FloatArray, ...]) -> tuple[FloatArray, FloatArray]:
    """Return mean (N, q) and covariance (N, q, q) of motion outputs of each row.

    :param maps: (q, n', m) of each block.
    """
    blocks = [
        Gaussians(block.x[:, : E.shape[1]], block.P[:, : E.shape[1], : E.shape[1]])
        for block, E in zip(rows.blocks, maps)
    ]
    return bank.combine(blocks, rows.mu, maps)


def track_outputs(rows: Rows, maps: tuple[FloatArray, ...]) -> tuple[FloatArray, FloatArray]:
    """Return mean (T, q) and covariance (T, q, q) of motion outputs; maps as in `row_outputs`."""
    return rows.combine(*row_outputs(rows, maps), rows.weight)


def track_positions(known: Known, models: ModelSet) -> tuple[FloatArray, FloatArray]:
    """Return mean (T, 2) and covariance (T, 2, 2) of the target positions."""
    return track_outputs(known.rows, tuple(part.outputs[:2] for part in models.parts))


def repair_covariances(
    blocks: tuple[Gaussians, ...], tail: int = 0
) -> tuple[tuple[Gaussians, ...], int]:
    """Return blocks with valid covariances, and the number of repairs.

    Other covariances stay bit-identical (`estimation.covariance`).

    :param tail: number of last components, which are nil in some rows.
    """
    if tail:
        nil = np.all([block.P[:, -tail:, -tail:] == 0.0 for block in blocks][0], axis=(1, 2, 3))
        if nil.any():
            return _repair_in_groups(blocks, tail, nil)
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


def _repair_in_groups(
    blocks: tuple[Gaussians, ...], tail: int, nil: BoolArray
) -> tuple[tuple[Gaussians, ...], int]:
    """Repair rows whose last components are `nil` (N,) without these, and the other rows."""
    found = [Gaussians(x.copy(), P.copy()) for x, P in blocks]
    count = 0
    for chosen, size in ((nil, tail), (~nil, 0)):
        some = np.flatnonzero(chosen)
        own = [slice(0, x.shape[1] - size) for x, _ in blocks]
        part = tuple(Gaussians(x[some][:, n], P[some][:, n, n]) for (x, P), n in zip(blocks, own))
        sound, repairs = repair_covariances(part)
        count += repairs
        for whole, (_, P) in zip(found, sound):
            whole.P[some, : P.shape[1], : P.shape[1]] = P
    return tuple(found), count


class Prediction(NamedTuple):
    """Rows after one prediction step."""

    rows: Rows
    transition: FloatArray
    """(T or 1, M, M) transition probabilities of the step."""
    dt: float
    """Length of the step, s."""
    repairs: int
    """Number of repaired covariances."""


def predict_over(
    models: ModelSet,
    chain: AdaptiveChain,
    rows: Rows,
    learnt: FloatArray,
    dt: float,
    longest: float,
) -> list[Prediction]:
    """Mix and predict over dt seconds, in equal steps of at most `longest` seconds.

    A model holds for a whole step. One step over a long gap would assume a straight path, and its
    prediction would be a ring around the position of a turning target.

    :param learnt: corrections of the transition probabilities of each track.
    :returns: the prediction after each step, at least one.
    """
    count = min(max(math.ceil(dt / longest), 1), MOST_STEPS)
    transition, moves = chain.transition(learnt, dt / count), models.moves(dt / count)
    per_row = transition if len(transition) == 1 else transition[rows.target]
    steps = []
    for _ in range(count):
        blocks, mu = bank.mix(models.bank, rows.blocks, rows.mu, per_row, rows.tail)
        moved = tuple(bank.predict(block, each) for block, each in zip(blocks, moves))
        moved, repairs = repair_covariances(moved, rows.tail)
        mu = mu / mu.sum(axis=1, keepdims=True) if len(mu) else mu
        rows = rows.replace(blocks=moved, mu=mu, parent=np.arange(len(rows)))
        steps.append(Prediction(rows, transition, dt / count, repairs))
    return steps


def with_velocities_at_fix(P: FloatArray, models: ModelSet, config: DiverConfig) -> None:
    """Set the velocity variance of tracks started at a fix: P (..., M, n, n), in place."""
    if models.families is not None:
        moving = np.flatnonzero(models.families.kind == VELOCITY)
        P[..., moving, 2, 2] = P[..., moving, 3, 3] = config.velocity_std_at_fix**2
