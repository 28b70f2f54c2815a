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

"""Divers from multistatic fixes or raw arrival times.

A diver swims slowly and turns often. The tracker runs one motion model for each of sixteen
headings (`models`) in an interacting multiple model filter, and lets the data correct the
probabilities of turning. A scan of the world goes through

    predict -> fixes: gate, associate, update; pings: explain -> learn -> prune -> spawn

and the whole of what is known after it is one value, `DiverState`, so that a late measurement is
put in its place by computing the scans after it again (`intake.stream`).

Source: docs/diver.md, after 'multi-directional motion fusion model for diver tracking'.
"""

from __future__ import annotations

from collections.abc import Sequence

from attrs import evolve
import numpy as np

from ...acoustics.geodesy import Origin
from ...estimates import Estimate
from ...estimation import adaptation, association, imm_kernels, jipda
from ...estimation.adaptation import AdaptiveChain
from ...estimation.arrays import FloatArray
from ...estimation.association import TENTATIVE, Tracks
from ...intake import KnownFrames
from ...intake.stream import ReplayStream, StreamRules
from ...measurements import Arrivals, Fix, Fixes, Measurement, NOBODY, Start
from ..model_checks import track_rules
from . import fix_kernels, soft
from .births import Birth, births_from_ping
from .config import DiverConfig
from .fix_consistency import FixConsistency
from .fix_scans import each_name_once, shows_all, take_fixes
from .instruments import Layout
from .models import build_models
from .names import hear_named, is_named, merged, names_said, pings_of, remembered
from .pings import begin_from_ping, FAR, ping_numbers
from .placing import Placer
from .scan import Scan
from .sensing import position_groups
from .starts import confirmed, make_room, no_room, starts_of
from .state import DiverState

__all__ = ['DiverConfig', 'DiverState', 'DiverTracker']


class DiverTracker:
    """The tracker of `trackers.Tracker` for divers: `process` takes `Fix`, `Fixes`, `Arrivals`."""

    STATE = ('_stream', '_placer')

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
            (Fix, Fixes, Arrivals, Start),
            StreamRules.of(self.config),
            step=self._scan,
            initial=self._nobody(Tracks.none(track_rules(self.config))),
            survivor=lambda state: self._nobody(state.life.none_left()),
        )
        self.counts = self._stream.counts
        self._placer = Placer(self.config, self.counts)

    @property
    def origin(self) -> Origin | None:
        """Where the frame of the tracks lies on Earth, None when that is not known."""
        return self._placer.origin

    @property
    def frames(self) -> KnownFrames:
        return self._stream.frames

    def reconfigure(self, config: DiverConfig) -> None:
        self.config.require_changeable(config)
        self.config = self._placer.config = config

    def warm(self) -> None:
        imm_kernels.warm()
        jipda.warm()
        adaptation.warm()
        association.warm()
        fix_kernels.warm()
        # A contested scan, echoes and a tag: nothing is left to be loaded at the first real one.
        tracker = DiverTracker(evolve(self.config, max_gap=3600.0, max_tracks=2))
        rx = np.array([[0.0, 0.0, 0.0], [70.0, 10.0, 0.0], [-60.0, 45.0, 0.0], [10.0, 85.0, 0.0]])
        leg = np.linalg.norm(rx - [20.0, 30.0, -5.0], axis=1)
        for second in (1, 2):
            for x in (0.0, 0.1):
                position = np.array([x, 0.0, 0.0])
                fix = Fix(stamp_ns=second * 10**9, position=position, covariance=np.eye(2))
                tracker.process(fix)
            for tx in (rx[0], np.full(3, np.nan)):
                ping = Arrivals(
                    stamp_ns=second * 10**9,
                    tx_id=np.zeros(4),
                    rx_id=np.arange(4),
                    tx=np.tile(tx, (4, 1)),
                    rx=rx,
                    toa=(leg + leg[0]) / self.config.sound_speed,
                    var_toa=np.full(4, 1e-8),
                    bearing=np.full(4, np.nan),
                    var_bearing=np.full(4, np.nan),
                )
                tracker.process(ping)

    def health(self) -> dict[str, float]:
        now = self._stream.state
        hit = now.nis_dof > 0
        return {
            'tracks': len(now.life),
            'confirmed': int((now.life.status != TENTATIVE).sum()),
            'nis_mean': float(np.mean(now.nis[hit] / now.nis_dof[hit]))
            if hit.any()
            else float('nan'),
            'broken_tracks': now.broken,
            'covariance_repairs': now.repairs,
            'not_started': now.not_started,
            'fixes_mean_nis': now.fixes.mean_nis,
            'fixes_lag_1': now.fixes.lag_1,
            'arrivals_mean_nis': now.arrivals.mean,
            'waiting_for_vessel': len(self._placer),
            'scale_fixes': float(now.factor()[0]),
            'scale_arrivals': float(now.factor()[1]),
        }

    def warnings(self) -> list[str]:
        """What of the input cannot be true or used, in sentences for the user."""
        state, advice = self._stream.state, 'check var_toa, var_bearing and toa_std'
        lasting = state.fixes.warnings(self.config.fix_bias_std > 0.0)
        heard = state.arrivals.warnings('arrivals', advice)
        return [*self._placer.warnings(), *lasting, *heard, *no_room(state, self.config)]

    def process(self, measurement: Measurement) -> list[Estimate]:
        return [self._estimate(state) for _, state in self._revise(measurement)]

    def _revise(self, measurement: Measurement) -> list[tuple[int, DiverState]]:
        """The stamps and states that are new or changed, oldest first."""
        revised: dict[int, DiverState] = {}
        for one in self._placer.place(measurement):
            revised.update(self._stream.revise(one))
        return [(stamp_ns, revised[stamp_ns]) for stamp_ns in sorted(revised)]

    def _nobody(self, life: Tracks) -> DiverState:
        """The state without a track; `life` has none, but the next identity."""
        M, n = self.models.copies * len(self.models.names), self.models.n
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
            white=np.empty((0, 2)),
            fixes=FixConsistency(),
            scale=np.zeros((2, 2)),
            existence=np.empty(0),
            evidence=np.empty(0),
            target_id=np.empty(0, np.int64),
            near_to=np.empty(0, np.int64),
            near_for=np.empty(0, np.int64),
        )

    # -- one scan ------------------------------------------------------------------------------

    def _scan(self, before: DiverState, stamp_ns: int, items: Sequence[Measurement]) -> DiverState:
        """The state after all measurements of one stamp. Pure."""
        factor = before.factor() if self.config.estimate_covariance_scale else np.ones(2)
        scan = self._predict(before, stamp_ns)
        births: list[Birth] = []
        fix_factor = float(self.config.covariance_scale * factor[0])
        groups = position_groups(items, self.config, fix_factor)
        for group in groups:
            births += take_fixes(scan, group)
        pings = pings_of(items)
        for ping in pings:
            if is_named(ping):
                births += hear_named(scan, ping, self.config, float(factor[1]))
                continue
            taken = scan.take_ping(ping, float(self.config.covariance_scale * factor[1]))
            births += births_from_ping(ping, ~taken, self.config, float(factor[1]))
        said = names_said(groups, pings)
        learnt = scan.learn()
        if pings and not groups:
            sure = (learnt.nis_dof > 0) & (learnt.life.status != TENTATIVE)
            heard = before.arrivals.after(learnt.nis[sure], learnt.nis_dof[sure])
            learnt = evolve(learnt, arrivals=heard)
        now = self._prune(remembered(learnt, before, said, self.config.max_coast), items)
        now = merged(now, before, groups, self.config, self.models.E[:, :2])
        now = self._spawn(now, births, scan.layout)
        for start in starts_of(items):
            now = self._start(now, start, scan.layout)
        return now

    def _predict(self, before: DiverState, stamp_ns: int) -> Scan:
        return Scan(self.config, self.models, self._chain, before, stamp_ns)

    def _prune(self, now: DiverState, items: Sequence[Measurement]) -> DiverState:
        """End the tracks that are over, broken, or too many."""
        config = self.config
        sound = fix_kernels.finite(now.x, now.P)
        broken = now.broken + int((~sound).sum())
        hit = now.nis_dof > 0
        looked = any(shows_all(item, config) for item in items) & (now.target_id == NOBODY)
        by_existence = np.isfinite(now.existence)
        life, kept = now.life.scan(
            hit, now.stamp_ns, track_rules(config), looked=looked & ~by_existence
        )
        near = {'near_to': now.near_to, 'near_for': now.near_for}
        if by_existence.any():
            judged = soft.judge(now, hit, looked, self.models.E[:, :2])
            status = np.where(by_existence[kept], judged.status[kept], life.status)
            life = evolve(life, status=status)
            near = {'near_to': judged.near_to, 'near_for': judged.near_for}
            sound = sound & (judged.alive | ~by_existence)
        if not sound.all():
            life, kept = life.only(sound[kept]), kept & sound
        confirmed = np.flatnonzero(life.status != TENTATIVE)
        if len(confirmed) > config.max_tracks:
            known = np.where(now.target_id == NOBODY, now.score, np.inf)[kept][confirmed]
            best = np.argsort(-known, kind='stable')[: config.max_tracks]
            room = life.status == TENTATIVE
            room[confirmed[best]] = True
            kept[kept] = room
            life = life.only(room)
        return now.rows(kept, life=life, broken=broken, **near)

    def _spawn(self, now: DiverState, births: list[Birth], layout: Layout) -> DiverState:
        """Begin a tentative track at each birth, as long as there is room."""
        config = self.config
        births = each_name_once(births)[: max(0, 10 + 5 * config.max_tracks - len(now.life))]
        return self._append(now, births, layout) if births else now

    def _append(self, now: DiverState, births: list[Birth], layout: Layout) -> DiverState:
        """With a track for each birth."""
        config = self.config
        x, P, mu = self._new_tracks(births, layout)
        count = len(births)
        return now.with_rows(
            now.life.born(count, now.stamp_ns, track_rules(config)),
            {
                'x': x,
                'P': P,
                'mu': mu,
                'learnt': self._chain.fresh(count),
                'nis': np.full(count, np.nan),
                'nis_dof': np.zeros(count, np.uint16),
                'score': np.zeros(count),
                'white': np.full((count, 2), np.nan),
                'existence': np.array([birth.existence for birth in births]),
                'evidence': np.ones(count),
                'target_id': np.array([birth.target_id for birth in births]),
                'near_to': np.zeros(count, np.int64),
                'near_for': np.zeros(count, np.int64),
            },
        )

    def _start(self, now: DiverState, start: Start, layout: Layout) -> DiverState:
        """Begin a confirmed track where somebody says that a diver is, when there is room."""
        now, room = make_room(now, start, self.config, self.models.E[:, :2])
        if not room:
            return now
        birth = Birth(start.position[:2], start.covariance)
        return confirmed(self._append(now, [birth], layout))

    def _new_tracks(
        self, births: list[Birth], layout: Layout
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """x, P and mu of tracks that begin."""
        plain = self.models.height < 0 and layout.size == self.models.n
        if all(birth.ping is None for birth in births) or (plain and self.models.bias < 0):
            position = np.array([birth.position for birth in births])
            covariance = np.array([birth.covariance for birth in births])
            x, P, mu = self.models.new_tracks(position, covariance)
            return *layout.widened(x, P), mu
        parts = [self._new_track(birth, layout, plain) for birth in births]
        x, P, mu = (np.concatenate(one) for one in zip(*parts))
        return x, P, mu

    def _new_track(
        self, birth: Birth, layout: Layout, plain: bool
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """x, P and mu of one track, with a row."""
        where = birth.position[None]
        if birth.ping is None or birth.rows is None or plain:
            x, P, mu = self.models.new_tracks(where, birth.covariance[None], birth.ping is None)
            return *layout.widened(x, P), mu
        x, P, mu = self.models.new_tracks(where, np.eye(2)[None] * FAR**2, False)
        x, P = layout.widened(x, P)
        factor = self.config.covariance_scale
        ping = ping_numbers(birth.ping, birth.rows, self.config, factor, self.models, layout)
        # All models of a copy begin alike: one of each is enough to ask.
        M = len(self.models.names)
        first = begin_from_ping(x[0, ::M], P[0, ::M], ping, birth.position, self.config, layout)
        known = np.isfinite(first[2]).any()
        share = np.exp(first[2] - first[2].max()) if known else np.ones(len(first[2]))
        mu = mu * np.repeat(share / share.sum() * len(share), M)
        return np.repeat(first[0], M, axis=0)[None], np.repeat(first[1], M, axis=0)[None], mu

    def _estimate(self, state: DiverState) -> Estimate:
        n, shown = self.models.n, soft.published(state.existence)
        if not shown.all():
            state = state.rows(shown, life=state.life.only(shown))
        x, P = state.x, state.P
        if x.shape[-1] > n:
            x, P = np.ascontiguousarray(x[..., :n]), np.ascontiguousarray(P[..., :n, :n])
        mean, covariance = imm_kernels.combine(x, P, state.mu, self.models.E)
        depth = np.full(len(mean), self.config.target_z)
        if self.models.height >= 0:
            depth = mean[:, 2]
        return Estimate(
            stamp_ns=state.stamp_ns,
            frame_id=self._stream.frame_id,
            xyz=np.column_stack([mean[:, :2], depth]),
            state_names=self.models.outputs,
            state=mean,
            covariance=covariance,
            model_names=self.models.names,
            probabilities=self.models.by_model(state.mu),
            extras={
                'track_id': state.life.track_id,
                'track_state': state.life.status,
                'nis': state.nis,
                'nis_dof': state.nis_dof,
                'existence': state.existence,
                'target_id': state.target_id.astype(np.int32),
                **self._on_earth(mean, depth),
            },
        )

    def _on_earth(self, mean: FloatArray, height: FloatArray) -> dict[str, FloatArray]:
        """Columns with latitude and longitude, degrees, where the origin is known."""
        if self.origin is None:
            return {}
        place = self.origin.geodetic(np.column_stack([mean[:, :2], height]))
        return {'latitude': place[:, 0], 'longitude': place[:, 1]}
