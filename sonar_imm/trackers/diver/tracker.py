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
from ...estimation import imm_kernels, jipda_kernels
from ...estimation.adaptation import AdaptiveChain
from ...estimation.association import Tracks, TrackStatus
from ...measurements import Arrivals, Fix, Fixes, Measurement, NOBODY
from ..model_checks import track_rules
from ..stream import ReplayStream, StreamRules
from . import soft
from .births import Birth, births_from_fixes, births_from_ping
from .config import DiverConfig
from .models import build_models, OUTPUTS
from .scan import DiverState, Scan
from .sensing import Group, groups_of, Positions

__all__ = ['DiverConfig', 'DiverState', 'DiverTracker']


class DiverTracker:
    """The tracker of `trackers.Tracker` for divers: `process` takes `Fix`, `Fixes`, `Arrivals`."""

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
            (Fix, Fixes, Arrivals),
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
        jipda_kernels.warm()
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
            existence=np.empty(0),
            evidence=np.empty(0),
            target_id=np.empty(0, np.int32),
            near_to=np.empty(0, np.int64),
            near_for=np.empty(0, np.int64),
        )

    # -- one scan ------------------------------------------------------------------------------

    def _scan(self, before: DiverState, stamp_ns: int, items: Sequence[Measurement]) -> DiverState:
        """The state after all measurements of one stamp. Pure."""
        factor = before.factor() if self.config.estimate_covariance_scale else np.ones(2)
        scan = self._predict(before, stamp_ns)
        births: list[Birth] = []
        unassigned = []
        for groups in groups_of(items, self.config, factor):
            if isinstance(groups[0], Positions):
                births += self._take_fixes(scan, groups[0])
            else:
                taken = scan.associate_and_update(groups)
                unassigned += [(group, ~one) for group, one in zip(groups, taken)]
        now = self._prune(scan.learn(), items)
        return self._spawn(now, births + self._births(items, unassigned, float(factor[1])))

    def _take_fixes(self, scan: Scan, group: Positions) -> list[Birth]:
        """Update the tracks by fixes; gives where they put new divers."""
        if group.target_id is not None:
            return births_from_fixes(group, ~scan.take_named(group))
        if self.config.association == 'gnn':
            return births_from_fixes(group, ~scan.associate_and_update([group])[0])
        claimed = soft.take_softly(scan, group)
        return births_from_fixes(group, claimed < 0.5, soft.birth_existence(self.config, claimed))

    def _predict(self, before: DiverState, stamp_ns: int) -> Scan:
        return Scan(self.config, self.models, self._chain, before, stamp_ns)

    def _births(
        self, items: Sequence[Measurement], left: Sequence[tuple[Group, np.ndarray]], factor: float
    ) -> list[Birth]:
        """Where the detections no track took put new divers."""
        births: list[Birth] = []
        for ping in (item for item in items if isinstance(item, Arrivals)):
            rows = np.zeros(len(ping), bool)
            for group, free in left:
                if group.ping is ping:
                    rows[group.rows] = free
            births += births_from_ping(ping, rows, self.config, factor)
        return births

    def _prune(self, now: DiverState, items: Sequence[Measurement]) -> DiverState:
        """End the tracks that are over, broken, or too many."""
        config = self.config
        sound = np.isfinite(now.x).all(axis=(1, 2)) & np.isfinite(now.P).all(axis=(1, 2, 3))
        broken = now.broken + int((~sound).sum())
        hit = now.nis_dof > 0
        looked = any(_shows_all(item, config) for item in items) & (now.target_id == NOBODY)
        by_existence = np.isfinite(now.existence)
        life, kept = now.life.scan(
            hit, now.stamp_ns, track_rules(config), looked=looked & ~by_existence
        )
        if by_existence.any():
            judged = soft.judge(now, hit, looked, self.models.E[:, :2])
            status = np.where(by_existence[kept], judged.status[kept], life.status)
            life = evolve(life, status=status)
            now = evolve(now, near_to=judged.near_to, near_for=judged.near_for)
            sound = sound & (judged.alive | ~by_existence)
        life, kept = life.only(sound[kept]), kept & sound
        confirmed = np.flatnonzero(life.status != TrackStatus.TENTATIVE)
        if len(confirmed) > config.max_tracks:
            known = np.where(now.target_id == NOBODY, now.score, np.inf)[kept][confirmed]
            best = np.argsort(-known, kind='stable')[: config.max_tracks]
            room = life.status == TrackStatus.TENTATIVE
            room[confirmed[best]] = True
            kept[kept] = room
            life = life.only(room)
        return evolve(now.rows(kept), life=life, broken=broken)

    def _spawn(self, now: DiverState, births: list[Birth]) -> DiverState:
        """Begin a tentative track at each birth, as long as there is room."""
        config = self.config
        births = _each_name_once(births)[: max(0, 10 + 5 * config.max_tracks - len(now.life))]
        if not births:
            return now
        new = [self.models.new_track(birth.position, birth.covariance) for birth in births]
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
            existence=np.append(now.existence, [birth.existence for birth in births]),
            evidence=np.append(now.evidence, np.ones(count)),
            target_id=np.append(
                now.target_id, np.array([birth.target_id for birth in births], np.int32)
            ),
            near_to=np.append(now.near_to, np.zeros(count, np.int64)),
            near_for=np.append(now.near_for, np.zeros(count, np.int64)),
        )

    def _estimate(self, state: DiverState) -> Estimate:
        shown = soft.published(state.existence)
        state = evolve(state.rows(shown), life=state.life.only(shown))
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
                'existence': state.existence,
                'target_id': state.target_id,
            },
        )


def _shows_all(item: Measurement, config: DiverConfig) -> bool:
    """Whether a diver of whom `item` says nothing was missed by it."""
    if isinstance(item, Fixes):
        return item.target_id is None or not len(item) or bool((item.target_id == NOBODY).any())
    return config.fixes_are_scans


def _each_name_once(births: Sequence[Birth]) -> list[Birth]:
    """Without a second birth of the same name."""
    names = [birth.target_id for birth in births]
    return [
        birth
        for place, birth in enumerate(births)
        if birth.target_id == NOBODY or names.index(birth.target_id) == place
    ]
