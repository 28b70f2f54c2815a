"""Divers from multistatic fixes or raw arrival times.

A diver swims slowly and turns often. The tracker runs one motion model for each of sixteen
headings (`models`) in an interacting multiple model filter, and lets the data correct the
probabilities of turning. A scan of the world goes through

    predict -> for each group of detections: gate, associate, update -> learn -> prune -> spawn

and the whole of what is known after it is one value, `DiverState`, so that a late measurement is
put in its place by computing the scans after it again (`trackers.stream`).

Source: docs/diver.md, after 'multi-directional motion fusion model for diver tracking'.
"""

from __future__ import annotations

from collections.abc import Sequence

from attrs import evolve
import numpy as np

from ...estimates import Estimate
from ...estimation import imm_kernels
from ...estimation.adaptation import AdaptiveChain
from ...estimation.association import Tracks, TrackStatus
from ...measurements import Arrivals, Fix, Measurement
from ..model_checks import track_rules
from ..stream import ReplayStream, StreamRules
from .births import Birth, births_from_fixes, births_from_ping
from .config import DiverConfig
from .models import build_models, OUTPUTS
from .scan import DiverState, Scan
from .sensing import Group, groups_of, Positions

__all__ = ['DiverConfig', 'DiverState', 'DiverTracker']


class DiverTracker:
    """The tracker of `trackers.Tracker` for divers: `process` takes `Fix` and `Arrivals`."""

    def __init__(self, config: DiverConfig):
        self.config = config
        self.models = build_models(config)
        self._chain = AdaptiveChain(
            self.models.chain,
            config.adaptation,
            weight=config.adaptation_prior,
            guard=config.adaptation_guard,
        )
        self.reset()

    def reset(self) -> None:
        self._stream = ReplayStream(
            (Fix, Arrivals),
            StreamRules.of(self.config),
            step=self._scan,
            initial=self._nobody(Tracks.none(track_rules(self.config))),
            survivor=lambda state: self._nobody(state.life.none_left()),
        )
        self.counts = self._stream.counts

    def reconfigure(self, config: DiverConfig) -> None:
        self.config.require_changeable(config)
        self.config = config

    def warm(self) -> None:
        imm_kernels.warm()
        # A contested scan and a ping, in which nothing is left to be loaded at the first real one.
        tracker = DiverTracker(evolve(self.config, max_gap=3600.0, max_tracks=2))
        for second in (1, 2):
            for x in (0.0, 0.1):
                position = np.array([x, 0.0, 0.0])
                fix = Fix(stamp_ns=second * 10**9, position=position, covariance=np.eye(2))
                tracker.process(fix)

    def health(self) -> dict[str, float]:
        now = self._stream.state
        hit = now.nis_dof > 0
        return {
            'tracks': len(now.life),
            'confirmed': int((now.life.status != TrackStatus.TENTATIVE).sum()),
            'nis_mean': float(np.mean(now.nis[hit] / now.nis_dof[hit]))
            if hit.any()
            else float('nan'),
            'broken_tracks': now.broken,
            'covariance_repairs': now.repairs,
            'scale_fixes': float(now.factor()[0]),
            'scale_arrivals': float(now.factor()[1]),
        }

    def process(self, measurement: Measurement) -> list[Estimate]:
        return [self._estimate(state) for _, state in self._revise(measurement)]

    def _revise(self, measurement: Measurement) -> list[tuple[int, DiverState]]:
        """The stamps and states that are new or changed, oldest first."""
        return self._stream.revise(measurement)

    def _nobody(self, life: Tracks) -> DiverState:
        """The state without a track; `life` has none, but the next identity."""
        M, n = len(self.models.names), self.models.n
        return DiverState(
            stamp_ns=0,
            life=life,
            x=np.empty((0, M, n)),
            P=np.empty((0, M, n, n)),
            mu=np.empty((0, M)),
            learnt=self._chain.fresh(0),
            nis=np.empty(0),
            nis_dof=np.empty(0, np.uint16),
            score=np.empty(0),
            scale=np.zeros((2, 2)),
        )

    # -- one scan ------------------------------------------------------------------------------

    def _scan(self, before: DiverState, stamp_ns: int, items: Sequence[Measurement]) -> DiverState:
        """The state after all measurements of one stamp. Pure."""
        factor = before.factor() if self.config.estimate_covariance_scale else np.ones(2)
        scan = self._predict(before, stamp_ns)
        unassigned = [
            (group, ~taken)
            for groups in groups_of(items, self.config, factor)
            for group, taken in zip(groups, scan.associate_and_update(groups))
        ]
        now = self._prune(scan.learn())
        return self._spawn(now, self._births(items, unassigned, float(factor[1])))

    def _predict(self, before: DiverState, stamp_ns: int) -> Scan:
        return Scan(self.config, self.models, self._chain, before, stamp_ns)

    def _births(
        self, items: Sequence[Measurement], left: Sequence[tuple[Group, np.ndarray]], factor: float
    ) -> list[Birth]:
        """Where the detections no track took put new divers."""
        births: list[Birth] = []
        for group, free in left:
            if isinstance(group, Positions):
                births += births_from_fixes(group, free)
        for ping in (item for item in items if isinstance(item, Arrivals)):
            rows = np.zeros(len(ping), bool)
            for group, free in left:
                if group.ping is ping:
                    rows[group.rows] = free
            births += births_from_ping(ping, rows, self.config, factor)
        return births

    def _prune(self, now: DiverState) -> DiverState:
        """End the tracks that are over, broken, or too many."""
        config = self.config
        sound = np.isfinite(now.x).all(axis=(1, 2)) & np.isfinite(now.P).all(axis=(1, 2, 3))
        life, kept = now.life.scan(
            now.nis_dof > 0,
            now.stamp_ns,
            track_rules(config),
            looked=np.full(len(sound), config.fixes_are_scans),
        )
        life, kept = life.only(sound[kept]), kept & sound
        confirmed = np.flatnonzero(life.status != TrackStatus.TENTATIVE)
        if len(confirmed) > config.max_tracks:
            best = np.argsort(-now.score[kept][confirmed], kind='stable')[: config.max_tracks]
            room = life.status == TrackStatus.TENTATIVE
            room[confirmed[best]] = True
            kept[kept] = room
            life = life.only(room)
        broken = now.broken + int((~sound).sum())
        return evolve(now.rows(kept), life=life, broken=broken)

    def _spawn(self, now: DiverState, births: list[Birth]) -> DiverState:
        """Begin a tentative track at each birth, as long as there is room."""
        config = self.config
        births = births[: max(0, 10 + 5 * config.max_tracks - len(now.life))]
        if not births:
            return now
        new = [self.models.new_track(*birth) for birth in births]
        M, n, count = len(self.models.names), self.models.n, len(new)
        return evolve(
            now,
            life=now.life.born(count, now.stamp_ns, track_rules(config)),
            x=np.concatenate([now.x, np.reshape([one[0] for one in new], (count, M, n))]),
            P=np.concatenate([now.P, np.reshape([one[1] for one in new], (count, M, n, n))]),
            mu=np.concatenate([now.mu, np.reshape([one[2] for one in new], (count, M))]),
            learnt=np.concatenate([now.learnt, self._chain.fresh(count)]),
            nis=np.append(now.nis, np.full(count, np.nan)),
            nis_dof=np.append(now.nis_dof, np.zeros(count, np.uint16)),
            score=np.append(now.score, np.zeros(count)),
        )

    def _estimate(self, state: DiverState) -> Estimate:
        mean, covariance = imm_kernels.combine(state.x, state.P, state.mu, self.models.E)
        depth = np.full(len(mean), self.config.target_z)
        return Estimate(
            stamp_ns=state.stamp_ns,
            frame_id=self._stream.frame_id,
            xyz=np.column_stack([mean[:, :2], depth]).astype(np.float32),
            state_names=OUTPUTS,
            state=mean,
            covariance=covariance,
            model_names=self.models.names,
            probabilities=state.mu,
            extras={
                'track_id': state.life.track_id,
                'track_state': state.life.status,
                'nis': state.nis,
                'nis_dof': state.nis_dof,
            },
        )
