"""Divers from multistatic fixes or raw arrival times.

A diver swims slowly and turns often. The tracker runs one motion model for each of sixteen
headings (`models`) in an interacting multiple model filter, and lets the data correct the
probabilities of turning. A scan of the world goes through

    predict -> for each group of detections: gate, associate, update -> learn -> end, begin tracks

and the whole of what is known after it is one value, `Divers`, so that a late measurement is put
in its place by computing the scans after it again (`estimation.history`).

Source: docs/diver.md, after 'multi-directional motion fusion model for diver tracking'.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from attrs import evolve
import numpy as np

from ...estimates import Estimate
from ...estimation import imm_kernels
from ...estimation.adaptation import AdaptiveChain
from ...estimation.association import Tracks, TrackStatus
from ...estimation.history import ReplayHistory, StampGate
from ...measurements import Arrivals, Fix, Measurement, nanoseconds
from ..model_checks import track_rules
from .births import Birth, births_from_fixes, births_from_ping
from .config import DiverConfig
from .models import build_models, OUTPUTS
from .scan import Divers, Scan
from .sensing import Group, groups_of, Positions

__all__ = ['DiverConfig', 'Divers', 'DiverTracker']


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
        self.counts: Counter[str] = Counter()
        self._frame_id = ''
        self._gate: StampGate[Measurement] = StampGate(
            nanoseconds(self.config.history),
            nanoseconds(self.config.max_gap),
            self.config.restart_after,
        )
        self._history = self._new_history(Tracks.none(track_rules(self.config)))

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
        now = self._history.state
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
        if not isinstance(measurement, (Fix, Arrivals)):
            self.counts['unknown_type'] += 1
            return []
        if not self._frame_id:
            self._frame_id = measurement.frame_id
        elif measurement.frame_id != self._frame_id:
            self.counts['other_frame'] += 1
            return []
        judgement = self._gate.judge(measurement.stamp_ns, measurement)
        judgement.count_in(self.counts)
        if judgement.verdict == 'restart':
            life = self._history.state.life
            self._history = self._new_history(life.only(np.zeros(len(life), bool)))
        revised: dict[int, Divers] = {}
        for item in judgement.released:
            revised.update(self._revise(item))
        return [self._estimate(revised[stamp_ns]) for stamp_ns in sorted(revised)]

    def _revise(self, item: Measurement) -> list[tuple[int, Divers]]:
        """Put an item in its place in time; the states of its scan and of the later ones."""
        newest = self._history.newest_ns
        inserted = self._history.insert(item.stamp_ns, _key(item), item, self._scan)
        self.counts[inserted.verdict] += 1
        if inserted.revised and newest is not None and item.stamp_ns < newest:
            self.counts['late'] += 1
        return inserted.revised

    def _new_history(self, life: Tracks) -> ReplayHistory[Divers, Measurement]:
        M, n = len(self.models.names), self.models.n
        nobody = Divers(
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
        return ReplayHistory(nobody, nanoseconds(self.config.history))

    # -- one scan ------------------------------------------------------------------------------

    def _scan(self, before: Divers, stamp_ns: int, items: Sequence[Measurement]) -> Divers:
        """The state after all measurements of one stamp. Pure."""
        factor = before.factor() if self.config.estimate_covariance_scale else np.ones(2)
        scan = Scan(self.config, self.models, self._chain, before, stamp_ns)
        left = [
            (group, ~taken)
            for groups in groups_of(items, self.config, factor)
            for group, taken in zip(groups, scan.take(groups))
        ]
        return self._census(scan.result(), self._births(items, left, float(factor[1])))

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

    def _census(self, now: Divers, births: list[Birth]) -> Divers:
        """End the tracks that are over and begin new ones."""
        config, rules = self.config, track_rules(self.config)
        sound = np.isfinite(now.x).all(axis=(1, 2)) & np.isfinite(now.P).all(axis=(1, 2, 3))
        life, kept = now.life.scan(
            now.nis_dof > 0,
            now.stamp_ns,
            rules,
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
        births = births[: max(0, 10 + 5 * config.max_tracks - len(life))]
        if not births and kept.all():
            return evolve(now, life=life)
        new = [self.models.new_track(*birth) for birth in births]
        M, n, count = len(self.models.names), self.models.n, len(new)
        return Divers(
            stamp_ns=now.stamp_ns,
            life=life.born(count, now.stamp_ns, rules),
            x=np.concatenate([now.x[kept], np.reshape([one[0] for one in new], (count, M, n))]),
            P=np.concatenate([now.P[kept], np.reshape([one[1] for one in new], (count, M, n, n))]),
            mu=np.concatenate([now.mu[kept], np.reshape([one[2] for one in new], (count, M))]),
            learnt=np.concatenate([now.learnt[kept], self._chain.fresh(count)]),
            nis=np.append(now.nis[kept], np.full(count, np.nan)),
            nis_dof=np.append(now.nis_dof[kept], np.zeros(count, np.uint16)),
            score=np.append(now.score[kept], np.zeros(count)),
            scale=now.scale,
            broken=now.broken + int((~sound).sum()),
            repairs=now.repairs,
        )

    def _estimate(self, state: Divers) -> Estimate:
        mean, covariance = imm_kernels.combine(state.x, state.P, state.mu, self.models.E)
        depth = np.full(len(mean), self.config.target_z)
        return Estimate(
            stamp_ns=state.stamp_ns,
            frame_id=self._frame_id,
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


def _key(measurement: Measurement) -> bytes:
    """The content of a measurement: it orders those of one stamp and tells duplicates."""
    if isinstance(measurement, Fix):
        covariance = b'' if measurement.covariance is None else measurement.covariance.tobytes()
        return b'fix' + measurement.position.tobytes() + covariance
    names = ('tx_id', 'rx_id', 'tx', 'rx', 'toa', 'var_toa', 'bearing', 'var_bearing')
    return b'arrivals' + b''.join(getattr(measurement, name).tobytes() for name in names)
