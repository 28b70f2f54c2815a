"""The diver tracker offline: what each estimate would have been, had the future been known."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from attrs import evolve, field, frozen
import numpy as np

from ..estimates import Estimate
from ..estimation.smoothing import imm_smooth
from ..measurements import FloatArray, Measurement
from .diver import DiverTracker
from .diver_scan import Divers


@frozen(eq=False)
class _Pass:
    """The forward pass of one track: scans it lived in, and how it came into each."""

    scans: list[int] = field(factory=list)
    x: list[FloatArray] = field(factory=list)
    P: list[FloatArray] = field(factory=list)
    mu: list[FloatArray] = field(factory=list)
    transition: list[FloatArray] = field(factory=list)
    dt: list[float] = field(factory=list)


class SmoothingDiverTracker(DiverTracker):
    """A `DiverTracker` that remembers everything, so that `smoothed` can look back at the end.

    For recordings: memory grows with their length, 10 kB a diver and scan.
    """

    def reset(self) -> None:
        super().reset()
        self._passed: dict[int, Divers] = {}

    def _revise(self, item: Measurement) -> list[tuple[int, Divers]]:
        revised = super()._revise(item)
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
        for track_id, one in self._passes(scans).items():
            result = imm_smooth(*self._arrays(one))
            for scan, x, P, mu in zip(one.scans, result.x, result.P, result.mu):
                row = np.flatnonzero(scans[scan].life.track_id == track_id)[0]
                smooth[scan].x[row], smooth[scan].P[row], smooth[scan].mu[row] = x, P, mu
        return [self._estimate(scan) for scan in smooth]

    def _passes(self, scans: Sequence[Divers]) -> dict[int, _Pass]:
        passes: dict[int, _Pass] = {}
        for number, (before, now) in enumerate(zip([scans[0], *scans], scans)):
            dt = (now.stamp_ns - before.stamp_ns) * 1e-9
            for row, track_id, transition in self._ways(before, now, dt):
                one = passes.setdefault(track_id, _Pass())
                one.scans.append(number)
                one.x.append(now.x[row])
                one.P.append(now.P[row])
                one.mu.append(now.mu[row])
                one.transition.append(transition)
                one.dt.append(dt)
        return passes

    def _ways(
        self, before: Divers, now: Divers, dt: float
    ) -> Iterator[tuple[int, int, FloatArray]]:
        """Row, id and the transition matrix that led into `now`, for each of its tracks."""
        matrices = self._chain.transition(before.learnt, dt)
        for row, track_id in enumerate(now.life.track_id.tolist()):
            came = np.flatnonzero(before.life.track_id == track_id)
            yield (
                row,
                track_id,
                matrices[came[0] if len(came) and len(matrices) > 1 else 0]
                if len(matrices)
                else self.models.chain.matrix,
            )

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
