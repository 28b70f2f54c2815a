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

"""The diver tracker offline: what each estimate would have been, had the future been known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from attrs import field, frozen
import numpy as np

from ...estimates import Estimate
from ...estimation.arrays import FloatArray
from ...estimation.smoothing import imm_smooth
from ...measurements import Measurement
from .state import cross, DiverState
from .tracker import DiverTracker

LONGEST_GAP = 5
"""Steps without a measurement beyond which a pass of several models ends. What a mixture becomes
in a long gap is too crude to carry the future back: on the tag of docs/real_recordings.md, heard
every 29 s, it made estimates worse."""


@frozen(eq=False)
class _Pass:
    """The forward pass of one track, step by step: the number of the scan (None for a step inside
    a gap), the state after it, and how it was reached."""

    scans: list[int | None] = field(factory=list)
    x: list[FloatArray] = field(factory=list)
    P: list[FloatArray] = field(factory=list)
    mu: list[FloatArray] = field(factory=list)
    transition: list[FloatArray] = field(factory=list)
    dt: list[float] = field(factory=list)

    def add(self, scan: int | None, *step: Any) -> None:
        """Append a step: x (M, n), P (M, n, n), mu (M,), transition (M, M), dt."""
        columns: tuple[list[Any], ...] = self.x, self.P, self.mu, self.transition, self.dt
        for column, value in zip((self.scans, *columns), (scan, *step)):
            column.append(value)


def _family_weights(mu: FloatArray, transition: FloatArray, blocks: Sequence[slice]) -> FloatArray:
    """What each block of models weighs (K, blocks) given all data, of filtered mu (K, M) and the
    transitions (K, M, M) into each step; of all models together what they weigh at the end."""
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
    """A `DiverTracker` that remembers everything, so that `smoothed` can look back at the end.

    For recordings: memory grows with their length, 10 kB a diver and scan.
    """

    def reset(self) -> None:
        super().reset()
        self._passed: dict[int, DiverState] = {}
        self._smoothed_repairs = 0

    def health(self) -> dict[str, float]:
        health = super().health()
        health['covariance_repairs'] += self._smoothed_repairs
        return health

    def _revise(self, measurement: Measurement) -> list[tuple[int, DiverState]]:
        revised = super()._revise(measurement)
        self._passed.update(revised)
        return revised

    def smoothed(self) -> list[Estimate]:
        """The estimates of all scans, oldest first, each given all measurements.

        Tracks, ids and states are those of the filter; ``nis`` stays the filter's too.
        """
        if not self._passed:
            return []
        newest = self._passed[max(self._passed)]
        layout = newest.instruments.layout(self.config, self.models)
        scans = []
        for stamp in sorted(self._passed):
            scan = self._passed[stamp]
            x, P = layout.widened(scan.x, scan.P)
            scans.append(scan._replace(x=x, P=P, instruments=newest.instruments))
        smooth = [
            scan._replace(x=scan.x.copy(), P=scan.P.copy(), mu=scan.mu.copy()) for scan in scans
        ]
        for track_id, forward in self._passes(scans):
            x, P, mu = self._smooth(forward)
            for k, number in enumerate(forward.scans):
                if number is not None:
                    row = np.flatnonzero(scans[number].life.track_id == track_id)[0]
                    smooth[number].x[row], smooth[number].P[row] = x[k], P[k]
                    smooth[number].mu[row] = mu[k]
        return [self._estimate(scan) for scan in smooth]

    def _smooth(self, forward: _Pass) -> tuple[FloatArray, FloatArray, FloatArray]:
        """x (K, M, n), P (K, M, n, n), mu (K, M) of a pass, smoothed copy by copy: copies do not
        switch, so that what each weighs at the end it weighs all along. Families, whose states are
        unequal, are smoothed each by itself, and then what they weigh (`_family_weights`)."""
        x, P, mu = np.stack(forward.x), np.stack(forward.P), np.stack(forward.mu)
        M = len(self.models.names)
        moves = self._moves(forward, x.shape[-1])
        transition = np.stack(forward.transition)
        parts = self.models.copies * len(self.models.blocks)
        for copy in range(self.models.copies):
            whole = slice(copy * M, (copy + 1) * M)
            weights = _family_weights(mu[:, whole], transition, self.models.blocks)
            for block, weight in zip(self.models.blocks, weights.T):
                own = slice(copy * M + block.start, copy * M + block.stop)
                total = mu[:, own].sum(axis=1, keepdims=True)
                if not (total > 0.0).all():
                    mu[:, own] = 0.0
                    continue
                inside = mu[:, own] / total if parts > 1 else mu
                steps = transition[:, block, block]
                if len(weights.T) > 1:
                    steps = steps / steps.sum(axis=2, keepdims=True)
                result = imm_smooth(
                    x[:, own], P[:, own], inside, steps, *(part[:, block] for part in moves)
                )
                self._smoothed_repairs += int(result.repaired.sum())
                x[:, own], P[:, own] = result.x, result.P
                mu[:, own] = result.mu * weight[:, None] if parts > 1 else result.mu
        if parts > 1:
            mu /= mu.sum(axis=1, keepdims=True)
            mu[-1] = forward.mu[-1]
        return x, P, mu

    def _passes(self, scans: Sequence[DiverState]) -> list[tuple[int, _Pass]]:
        """Each track, cut where a gap is too long to look across."""
        passes: list[tuple[int, _Pass]] = []
        newest: dict[int, _Pass] = {}
        for number, (before, now) in enumerate(zip([*scans[:1], *scans], scans)):
            dt = (now.stamp_ns - before.stamp_ns) * 1e-9
            *between, last = cross(self.models, self._chain, before, dt, self.config.longest_step)
            for row, track_id in enumerate(now.life.track_id.tolist()):
                came = np.flatnonzero(before.life.track_id == track_id)
                cut = len(between) >= LONGEST_GAP and len(self.models.names) > 1
                # Copies that were spread anew have no past of their own.
                cut |= any(before.spreads[came] != now.spreads[row])
                if not number or not len(came) or cut:
                    newest[track_id] = _Pass()
                    passes.append((track_id, newest[track_id]))
                    transition, step_dt = self.models.chain.matrix, 0.0
                else:
                    for step in between:
                        newest[track_id].add(None, *step.row(came[0]))
                    *_, transition, step_dt = last.row(came[0])
                newest[track_id].add(
                    number, now.x[row], now.P[row], now.mu[row], transition, step_dt
                )
        return passes

    def _moves(self, forward: _Pass, size: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """F, Q (K, M, size, size) and B (K, M, size): the motion, and constants that stay."""
        moves = [self.models.motion(dt) for dt in forward.dt]
        F, Q, B = (np.stack(parts) for parts in zip(*moves))
        n = B.shape[-1]
        if size == n:
            return F, Q, B
        wide = (*B.shape[:-1], size)
        F_all, Q_all, B_all = np.zeros((*wide, size)), np.zeros((*wide, size)), np.zeros(wide)
        F_all[..., :n, :n], Q_all[..., :n, :n], B_all[..., :n] = F, Q, B
        F_all[..., range(n, size), range(n, size)] = 1.0
        return F_all, Q_all, B_all
