"""The diver tracker offline: what each estimate would have been, had the future been known."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from attrs import evolve, field, frozen
import numpy as np

from ...estimates import Estimate
from ...estimation.arrays import FloatArray
from ...estimation.smoothing import imm_smooth
from ...measurements import Measurement
from .scan import cross, DiverState
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
        for column, value in zip(
            (self.scans, self.x, self.P, self.mu, self.transition, self.dt), (scan, *step)
        ):
            column.append(value)


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
        scans = [self._passed[stamp] for stamp in sorted(self._passed)]
        smooth = [
            evolve(scan, x=scan.x.copy(), P=scan.P.copy(), mu=scan.mu.copy()) for scan in scans
        ]
        for track_id, one in self._passes(scans):
            result = imm_smooth(*self._arrays(one))
            self._smoothed_repairs += int(result.repaired.sum())
            for scan, x, P, mu in zip(one.scans, result.x, result.P, result.mu):
                if scan is not None:
                    row = np.flatnonzero(scans[scan].life.track_id == track_id)[0]
                    smooth[scan].x[row], smooth[scan].P[row], smooth[scan].mu[row] = x, P, mu
        return [self._estimate(scan) for scan in smooth]

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

    def _arrays(self, one: _Pass) -> tuple[FloatArray, ...]:
        moves = [self.models.motion(dt) for dt in one.dt]
        return (
            np.stack(one.x),
            np.stack(one.P),
            np.stack(one.mu),
            np.stack(one.transition),
            np.stack([move.F for move in moves]),
            np.stack([move.Q for move in moves]),
            np.stack([move.B for move in moves]),
        )
