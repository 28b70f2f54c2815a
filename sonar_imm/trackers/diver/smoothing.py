# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Offline diver tracker: estimates from past and future measurements.

Rows do not interact, so the final weight of a row applies to all its scans. Each final row of a
track is traced back by its parents and smoothed on its own. Families have unequal states: each
family is smoothed on its own, then the family weights.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from attrs import field, frozen
import numpy as np

from ...estimates import Estimate
from ...estimation.arrays import FloatArray, IndexArray
from ...estimation.rows import Rows
from ...estimation.smoothing import imm_smooth, IMMPredicted
from ...measurements import Measurement
from .known import Known, predict_over, Prediction
from .tracker import DiverTracker

LONGEST_GAP = 5
"""Maximum number of prediction steps without a measurement inside a pass of several models. Longer
gaps made estimates worse (tag of docs/results/recordings.md, received every 29 s)."""


class _Scan(NamedTuple):
    """A scan in common components, with N rows."""

    known: Known
    """State after the scan."""
    x: FloatArray
    """(N, M, n)."""
    P: FloatArray
    """(N, M, n, n)."""
    steps: tuple[Prediction, ...]
    """Prediction steps to the scan."""
    predicted: tuple[tuple[FloatArray, FloatArray], ...]
    """x and P after each step; the last ones are those before the update."""


@frozen(eq=False)
class _Path:
    """Forward pass of one row, step by step."""

    scans: list[int | None] = field(factory=list)
    """Number of the scan; None for a step inside a gap."""
    x: list[FloatArray] = field(factory=list)
    P: list[FloatArray] = field(factory=list)
    mu: list[FloatArray] = field(factory=list)
    transition: list[FloatArray] = field(factory=list)
    dt: list[float] = field(factory=list)
    predicted: list[IMMPredicted] = field(factory=list)

    def add(self, scan: int | None, *step: Any) -> None:
        """Append a step: x (M, n), P (M, n, n), mu (M,), transition (M, M), dt, prediction."""
        columns: tuple[list[Any], ...] = self.x, self.P, self.mu, self.transition, self.dt
        columns += (self.predicted,)
        for column, value in zip((self.scans, *columns), (scan, *step)):
            column.append(value)


class _Smoothed(NamedTuple):
    """Smoothed rows of one track at one scan: x (M, n), P (M, n, n), mu (M,), log weight and key
    of each row."""

    x: list[FloatArray]
    P: list[FloatArray]
    mu: list[FloatArray]
    logw: list[float]
    key: list[dict[str, Any]]


def _family_weights(mu: FloatArray, transition: FloatArray, blocks: Sequence[slice]) -> FloatArray:
    """Return smoothed weights (K, blocks) of blocks of models, from filtered mu (K, M) and
    transitions (K, M, M) into each step."""
    filtered = np.stack([mu[:, block].sum(axis=1) for block in blocks], axis=1)
    if len(blocks) == 1:
        return np.broadcast_to(filtered[-1], filtered.shape)
    rows = [transition[:, block].mean(axis=1) for block in blocks]
    between = np.stack(
        [np.stack([row[:, block].sum(axis=1) for block in blocks], axis=1) for row in rows], axis=1
    )
    smoothed, total = filtered.copy(), filtered[-1].sum()
    for k in range(len(mu) - 2, -1, -1):
        predicted = filtered[k] @ between[k + 1]
        ratio = smoothed[k + 1] / np.where(predicted > 0.0, predicted, 1.0)
        weight = filtered[k] * (between[k + 1] @ ratio)
        smoothed[k] = weight * (total / weight.sum()) if weight.sum() > 0.0 else smoothed[k + 1]
    return smoothed


class SmoothingDiverTracker(DiverTracker):
    """A `DiverTracker` that stores all states for `smoothed`.

    For bags: memory grows with their length, about 10 kB per track and scan.
    """

    def reset(self) -> None:
        super().reset()
        self._passed: dict[int, Known] = {}
        self._smoothed_repairs = 0

    def health(self) -> dict[str, float]:
        health = super().health()
        health['covariance_repairs'] += self._smoothed_repairs
        return health

    def _revise(self, measurement: Measurement) -> list[tuple[int, Known]]:
        revised = super()._revise(measurement)
        self._passed.update(revised)
        return revised

    def smoothed(self) -> list[Estimate]:
        """Return the smoothed estimates of all scans, oldest first.

        Track IDs, track states and ``nis`` are those of the filter.
        """
        if not self._passed:
            return []
        scans = self._build_scans()
        found: dict[tuple[int, int], _Smoothed] = {}
        for track_id, first, last in self._find_passes(scans):
            self._smooth(scans, track_id, first, last, found)
        made = [
            self._estimate(self._with_smoothed_rows(scan, k, found))
            for k, scan in enumerate(scans[:-1])
        ]
        # The last scan has no future; its rows keep their offsets.
        return [*made, self._estimate(self._passed[max(self._passed)])]

    def _build_scans(self) -> list[_Scan]:
        """Return all scans with the constants of all instruments, and the steps between them."""
        newest = self._passed[max(self._passed)]
        layout = self._layouts(newest)
        scans: list[_Scan] = []
        for stamp in sorted(self._passed):
            known = self._passed[stamp]
            # Offsets are no part of the path of the target.
            rows = layout.rows_with_new_constants(known.rows, self.models).with_tail(0)
            known = known.replace(rows=rows)
            previous = scans[-1].known if scans else known
            dt = (known.stamp_ns - previous.stamp_ns) * 1e-9
            steps = predict_over(
                self.models,
                self._chain,
                previous.rows,
                previous['learnt'],
                dt,
                self.config.longest_step,
            )
            predicted = tuple(self.models.to_common(step.rows.blocks) for step in steps)
            scans.append(
                _Scan(known, *self.models.to_common(known.rows.blocks), tuple(steps), predicted)
            )
        return scans

    def _find_passes(self, scans: Sequence[_Scan]) -> list[tuple[int, int, int]]:
        """Return track ID, first and last scan of each pass.

        Passes end at long gaps and where rows have no parent.
        """
        passes: list[tuple[int, int, int]] = []
        open_: dict[int, int] = {}
        for k, scan in enumerate(scans):
            before = scans[k - 1].known if k else scan.known
            long = len(scan.steps) > LONGEST_GAP and len(self.models.names) > 1
            ids = scan.known.life.track_id.tolist()
            for track_id in [each for each in open_ if each not in ids]:
                passes.append((track_id, open_.pop(track_id), k - 1))
            for track, track_id in enumerate(ids):
                came = np.flatnonzero(before.life.track_id == track_id)
                rows = scan.known.rows
                cut = not k or not len(came) or long
                cut |= bool((rows.parent[rows.target == track] < 0).any())
                if not cut:
                    cut = before['respreads'][came[0]] != scan.known['respreads'][track]
                if cut:
                    if track_id in open_:
                        passes.append((track_id, open_[track_id], k - 1))
                    open_[track_id] = k
        return passes + [(each, first, len(scans) - 1) for each, first in open_.items()]

    def _smooth(
        self,
        scans: Sequence[_Scan],
        track_id: int,
        first: int,
        last: int,
        found: dict[tuple[int, int], _Smoothed],
    ) -> None:
        """Smooth the final rows of a pass, and add them to `found` by scan and track ID."""
        end = scans[last].known.rows
        rows: IndexArray = np.flatnonzero(end.target == _track_index(scans[last].known, track_id))
        for row in rows.tolist():
            path = self._trace_path(scans, track_id, row, first, last)
            x, P, mu = self._smooth_path(path)
            key = {name: column[row] for name, column in end.key.items()}
            for k, number in enumerate(path.scans):
                if number is None:
                    continue
                kept = found.setdefault((number, track_id), _Smoothed([], [], [], [], []))
                columns: tuple[list[Any], ...] = tuple(kept)
                for column, value in zip(columns, (x[k], P[k], mu[k], end.logw[row], key)):
                    column.append(value)

    def _trace_path(
        self, scans: Sequence[_Scan], track_id: int, row: int, first: int, last: int
    ) -> _Path:
        """Return the forward pass that leads to a row of the `last` scan."""
        chain = [row]
        for scan in scans[last:first:-1]:
            chain.append(int(scan.known.rows.parent[chain[-1]]))
        path = _Path()
        for number, own in zip(range(first, last + 1), reversed(chain)):
            scan = scans[number]
            state = IMMPredicted(scan.x[own], scan.P[own], scan.known.rows.mu[own])
            transition, dt, predicted = self.models.chain.matrix, 0.0, state
            if number > first:
                came = chain[last - number + 1]
                at = _track_index(scans[number - 1].known, track_id)
                for step, (x, P) in zip(scan.steps, scan.predicted):
                    predicted = IMMPredicted(x[came], P[came], step.rows.mu[came])
                    transition, dt = _track_transition(step.transition, at), step.dt
                    if step is not scan.steps[-1]:
                        path.add(None, *predicted, transition, dt, predicted)
            path.add(number, *state, transition, dt, predicted)
        return path

    def _smooth_path(self, path: _Path) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return smoothed x (K, M, n), P (K, M, n, n) and mu (K, M) of a path."""
        x, P, mu = np.stack(path.x), np.stack(path.P), np.stack(path.mu)
        predicted = IMMPredicted(*(np.stack(part) for part in zip(*path.predicted)))
        moves, transition = self._stack_motions(path, x.shape[-1]), np.stack(path.transition)
        blocks = self._family_slices()
        weights = _family_weights(mu, transition, blocks)
        for block, weight in zip(blocks, weights.T):
            total = mu[:, block].sum(axis=1, keepdims=True)
            if not (total > 0.0).all():
                mu[:, block] = 0.0
                continue
            steps = transition[:, block, block]
            if len(blocks) > 1:
                steps = steps / steps.sum(axis=2, keepdims=True)
            inside = mu[:, block] / total if len(blocks) > 1 else mu
            F, Q, B = (part[:, block] for part in moves)
            prior = None  # of one family, that of `imm_smooth` is the one of the tracker
            if len(blocks) > 1:
                prior = IMMPredicted(*(part[:, block] for part in predicted))
                prior = prior._replace(mu=prior.mu / prior.mu.sum(axis=1, keepdims=True))
            result = imm_smooth(x[:, block], P[:, block], inside, steps, F, Q, B, prior)
            self._smoothed_repairs += int(result.repaired.sum())
            x[:, block], P[:, block] = result.x, result.P
            mu[:, block] = result.mu * weight[:, None] if len(blocks) > 1 else result.mu
        if len(blocks) > 1:
            mu /= mu.sum(axis=1, keepdims=True)
            mu[-1] = path.mu[-1]
        return x, P, mu

    def _family_slices(self) -> list[slice]:
        """Return the slices of models with equal components that switch between each other."""
        kinds = self.models.families
        if kinds is None:
            return [slice(0, len(self.models.names))]
        ends = np.cumsum(np.bincount(kinds.family)).tolist()
        return [slice(first, last) for first, last in zip([0, *ends], ends)]

    def _stack_motions(self, path: _Path, size: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Return F, Q (K, M, size, size) and B (K, M, size) of the motion with constants."""
        moves = [self.models.motion(dt) for dt in path.dt]
        F, Q, B = (np.stack(parts) for parts in zip(*moves))
        n = B.shape[-1]
        if size == n:
            return F, Q, B
        wide = (*B.shape[:-1], size)
        F_all, Q_all, B_all = np.zeros((*wide, size)), np.zeros((*wide, size)), np.zeros(wide)
        F_all[..., :n, :n], Q_all[..., :n, :n], B_all[..., :n] = F, Q, B
        F_all[..., range(n, size), range(n, size)] = 1.0
        return F_all, Q_all, B_all

    def _with_smoothed_rows(
        self, scan: _Scan, number: int, found: dict[tuple[int, int], _Smoothed]
    ) -> Known:
        """Return the state of a scan with smoothed rows."""
        known = scan.known
        parts = [found[number, track_id] for track_id in known.life.track_id.tolist()]
        if not parts:
            return known
        target = np.repeat(np.arange(len(parts)), [len(part.logw) for part in parts])
        x, P, mu, logw = (
            np.array([value for part in parts for value in part[k]]) for k in range(4)
        )
        keys = [key for part in parts for key in part.key]
        key = {name: np.array([each[name] for each in keys]) for name in known.rows.key}
        blocks, nobody = self.models.to_blocks(x, P), np.full(len(target), -1)
        rows = Rows(blocks, mu, logw, target, nobody, key)
        return known.replace(rows=rows, borrowed=known.borrowed.select(np.arange(0)))


def _track_index(known: Known, track_id: int) -> int:
    return int(np.flatnonzero(known.life.track_id == track_id)[0])


def _track_transition(transition: FloatArray, track: int) -> FloatArray:
    """Return the matrix (M, M) of a track from transitions (T or 1, M, M)."""
    return transition[0 if len(transition) == 1 else track]
