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
probabilities of turning. The measurements of a stamp, a `Scan`, go through

    predict -> associate -> update -> prune -> spawn

and the whole of what is known after it is one value, `DiverState`, so that a late measurement is
put in its place by computing the scans after it again (`intake.stream`). Positions that are not
metres in the frame of the tracks are brought into it first (`georeferencing`).

Source: docs/diver.md, after 'multi-directional motion fusion model for diver tracking'.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import lru_cache, partial
import math
from operator import itemgetter
from typing import cast

from attrs import evolve
import numpy as np

from ...acoustics.geodesy import Origin
from ...estimates import Estimate
from ...estimation import imm_kernels
from ...estimation.adaptation import AdaptiveChain, Form
from ...estimation.arrays import FloatArray
from ...estimation.association import assign_fits, TENTATIVE, Tracks
from ...estimation.consistency import ENOUGH, excess
from ...intake import KnownFrames
from ...intake.stream import ReplayStream, StreamRules
from ...measurements import Arrivals, Fix, Fixes, Measurement, NOBODY, Start
from ..model_checks import track_rules
from . import births, clutter, coverage, families, fix_kernels, heights, jipda, kbest, names, pings
from .births import Birth
from .config import DiverConfig
from .georeferencing import Georeferencer
from .jipda import Association
from .models import build_models
from .offsets import RecentPairs
from .scan import Heights, Positions, Scan
from .state import cross, DiverState, FIXES, learnt_scale, MEMORY, Step
from .state_space import as_stated, Instruments

__all__ = ['DiverConfig', 'DiverState', 'DiverTracker']

SCORE_MEMORY = 0.9
"""Share of its score a track keeps from scan to scan."""


class DiverTracker:
    """The tracker of `trackers.Tracker` for divers: `process` takes `Fix`, `Fixes`, `Arrivals`,
    `Start`, and what `georeferencing` makes fixes of."""

    STATE = ('_stream', '_georeferencer')

    def __init__(self, config: DiverConfig):
        self.models = build_models(config := config.for_target())
        self._position = np.ascontiguousarray(self.models.E[:, :2])
        mixing = self.models.mixing
        kind = partial(families.FamilyChain, mixing.family) if mixing else AdaptiveChain
        self._chain = kind(
            self.models.chain,
            cast(Form, config.adaptation),
            weight=config.adaptation_prior,
        )
        self._settle(config)
        self.reset()

    def _settle(self, config: DiverConfig) -> None:
        """What follows from the parameters, once and not in every scan."""
        self.config = config
        self._keeps_hypotheses = config.pairing == 'kbest'
        self.rules = track_rules(config)
        layouts = partial(Instruments.layout, config=config, models=self.models)
        self._layout = lru_cache(maxsize=16)(layouts)
        self._covered = coverage.stated(config)

    def reset(self) -> None:
        self._stream = ReplayStream(
            (Fix, Fixes, Arrivals, Start),
            StreamRules.of(self.config),
            step=self._step,
            initial=self._nobody(Tracks.none(self.rules)),
            survivor=lambda state: self._nobody(state.life.none_left()),
        )
        self.counts = self._stream.counts
        self._georeferencer = Georeferencer(self.config, self.counts)

    def _nobody(self, life: Tracks) -> DiverState:
        nobody = DiverState.of_nobody(life, self.models, self._chain.fresh(0))
        return nobody._replace(history=np.empty((0, self._window), np.int64))

    def restored(self) -> None:
        """Raise ValueError for states, put in, that are none of these models."""
        nobody = self._nobody(Tracks.none(self.rules))
        for state in self._stream.kept:
            state.require_like(nobody, self._layout(state.instruments).size)

    @property
    def _window(self) -> int:
        return kbest.WINDOW if self._keeps_hypotheses else 0

    @property
    def origin(self) -> Origin | None:
        """Where the frame of the tracks lies on Earth, None when that is not known."""
        return self._georeferencer.origin

    @property
    def frames(self) -> KnownFrames:
        return self._stream.frames

    def reconfigure(self, config: DiverConfig) -> None:
        config = config.for_target()
        self.config.require_changeable(config)
        self._settle(config)
        self._georeferencer.config = config

    def warm(self, inputs: Collection[type] | None = None) -> None:
        if inputs is None or not {Arrivals, Start}.issuperset(inputs):
            self._warm_fixes()
        if inputs is None or Arrivals in inputs:
            self._warm_pings(np.zeros(3))
            self._warm_pings(np.full(3, np.nan))

    def _warm_fixes(self) -> None:
        tracker = self._for_warming()
        for second in (1, 2):
            for x in (0.0, 0.1):
                stamp_ns, at, P = second * 10**9, (x, 0.0, 0.0), np.eye(self.config.dimensions)
                tracker.process(Fix(stamp_ns=stamp_ns, position=at, covariance=P))

    def _warm_pings(self, tx: FloatArray) -> None:
        tracker = self._for_warming()
        rx = np.array([[0.0, 0.0, 0.0], [70.0, 10.0, 0.0], [-60.0, 45.0, 0.0], [10.0, 85.0, 0.0]])
        leg = np.linalg.norm(rx - [20.0, 30.0, -5.0], axis=1)
        for second in (1, 2):
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

    def _for_warming(self) -> DiverTracker:
        return DiverTracker(evolve(self.config, max_gap=3600.0, max_tracks=2))

    def health(self) -> dict[str, float]:
        now = self._stream.state
        if self._keeps_hypotheses:
            now = kbest.shown(now)
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
            'waiting_for_vessel': len(self._georeferencer),
            'scale_fixes': now.factor()[0],
            'scale_arrivals': now.factor()[1],
        }

    def warnings(self) -> list[str]:
        """What of the input cannot be true or used, in sentences for the user."""
        state, advice = self._stream.state, 'check var_toa, var_bearing and toa_std'
        stds = 'receiver_position_std', 'receiver_clock_std', 'sound_speed_std'
        unstated = [name for name in stds if not getattr(self.config, name)]
        if self.config.dimensions == 2:
            unstated.insert(0, 'target_z (or dimensions: 3)')
        if unstated:
            advice += ', or state what is not exact: ' + ', '.join(unstated)
        return [
            *self._georeferencer.warnings(),
            *state.fixes.warnings(self.config.fix_bias_std > 0.0),
            *state.heights.warnings(self.config),
            *state.arrivals.warnings('arrivals', advice, more_than_stated=state.excess >= ENOUGH),
            *state.offsets.warnings(self.config),
            *births.no_room(state, self.config),
            *clutter.warnings(state.clutter, self.config, (state.life.status != TENTATIVE).any()),
        ]

    def process(self, measurement: Measurement) -> list[Estimate]:
        return [self._estimate(state) for _, state in self._revise(measurement)]

    def _revise(self, measurement: Measurement) -> list[tuple[int, DiverState]]:
        """The stamps and states that are new or changed, oldest first."""
        revised: dict[int, DiverState] = {}
        for ready in self._georeferencer.georeference(measurement):
            revised.update(self._stream.revise(ready))
        return sorted(revised.items(), key=itemgetter(0))

    # -- one scan ------------------------------------------------------------------------------

    def _step(self, before: DiverState, stamp_ns: int, items: Sequence[Measurement]) -> DiverState:
        """The state after all measurements of one stamp. Pure."""
        scan = self._scan(before, items)
        now, step = self._predict(before, stamp_ns)
        found: list[Birth] = []
        for fixes in scan.fixes:
            if self._keeps_hypotheses:
                now = self._branch(now, fixes)
                continue
            now = now.as_seen(fixes.turned_by, self._layout)
            association = self._associate(now, fixes)
            now, again = self._reacquire(now, fixes, association)
            if again:
                association = self._associate(now, fixes)
            now = self._update(now, fixes, association)
            now = self._update_heights(now, fixes, association)
            now = jipda.counted(now, fixes, association.claimed)
            if self._covered and fixes.whole and fixes.target_id is None:
                now = self._missed(now, fixes, association)
            now = now.as_seen(fixes.turned_by, self._layout, back=True)
            found += births.births_from_fixes(fixes, association.free, association.existence)
        if scan.pings and self._keeps_hypotheses:
            now = kbest.decided(now)
        for ping in scan.pings:
            of_ping = ping, self.config, scan.factor, self.models, self._covered
            now, free = pings.associate_and_update(now, *of_ping)
            layout = self._layout(now.instruments)
            now = births.begun_anew(now, ping, free, self.models, layout, self.config)
            found += births.births_from_ping(ping, free, self.config, scan.factor)
        now = self._prune(self._learn(before, now, step, scan), scan)
        now = jipda.without_first_fixes(before, now, scan.fixes)
        return self._spawn(now, found, scan.starts)

    def _scan(self, before: DiverState, items: Sequence[Measurement]) -> Scan:
        stated, learns = self.config.covariance_scale, self.config.estimate_covariance_scale
        fixes, arrivals = before.factor() if learns else (1.0, 1.0)
        return Scan.of(items, self.config, (stated * fixes, stated * arrivals), before.clutter)

    def _predict(self, before: DiverState, stamp_ns: int) -> tuple[DiverState, Step]:
        """The tracks as this scan should show them, and the step that led there."""
        dt = (stamp_ns - before.stamp_ns) * 1e-9 if before.stamp_ns else 0.0
        steps = list(cross(self.models, self._chain, before, dt, self.config.longest_step))
        last, count = steps[-1], len(before.x)
        if len(steps) > 1:
            whole = np.linalg.matrix_power(last.transition, len(steps))
            repairs = sum(step.repairs for step in steps)
            last = last._replace(transition=whole, repairs=repairs)
        # The error of the sound speed has its place in the state before any ping.
        x, P = self._layout(before.instruments).widened(last.x, last.P)
        now = before._replace(
            stamp_ns=stamp_ns,
            x=x,
            P=P,
            mu=families.shared(last.mu, self.models),
            nis=np.zeros(count),
            nis_dof=np.zeros(count, np.uint16),
            score=SCORE_MEMORY * before.score,
            existence=before.existence * math.exp(-dt / self.config.survival_time),
            came_from=np.arange(count),
            repairs=before.repairs + last.repairs,
        )
        return now, last._replace(dt=dt)

    def _associate(self, now: DiverState, fixes: Positions) -> Association:
        """Which fixes are of which tracks; of several tracks the confirmed ones choose first. A
        fix that says whose it is goes to the track of that name."""
        config, layout = fixes.config, self._layout(now.instruments)
        H, densities = layout.H, None
        expected = fix_kernels.expected(now.x, H)
        if self.models.mixing is not None:
            densities = families.densities(now, expected, layout, fixes.z, fixes.R)
        if fixes.target_id is not None:
            tracks, row = np.nonzero(now.target_id[:, None] == fixes.target_id[None])
            free = ~np.isin(np.arange(len(fixes.z)), row)
            if densities is not None:
                good = densities.whole[tracks, row] > families.bound(fixes)
                tracks, row = tracks[good], row[good]
            return Association(tracks, row, expected, now.score, free, densities=densities)
        excluded = now.target_id != NOBODY
        if config.named_tracks == 'share':
            excluded = np.zeros(len(excluded), bool)
        where = now, config, fixes.z, fixes.R
        seen = coverage.detectable(self._covered, fixes.sensor, *where)
        if config.pairing == 'jipda':
            weights = jipda.joint_weights(now, fixes, expected, H, excluded, densities, seen)
            claimed = weights.beta.sum(axis=0)
            existence = jipda.birth_existence(fixes, claimed)
            tracks, likeliest = weights.likeliest()
            free = claimed < 0.5
            by_weights = free, existence, weights, densities
            return Association(tracks, likeliest, expected, now.score, *by_weights, seen=seen)
        fit = families.fit(now, fixes, expected, H, densities, seen)
        fit[excluded] = -np.inf
        p, false = config.detection_probability, fixes.clutter
        chosen = assign_fits(fit, now.life.status == TENTATIVE, p, false)
        logs = np.log1p(-p), np.log(p / (1.0 - p)), np.log(false)
        score = fix_kernels.scores(now.score, fit, chosen, excluded, *logs)
        if seen is not None:
            score = score + np.where(excluded, 0.0, np.log1p(-seen.tracks) - logs[0])
        tracks = np.flatnonzero(chosen >= 0)
        free = np.ones(len(fixes.z), bool)
        free[chosen[tracks]] = False
        hits = tracks, chosen[tracks], expected
        return Association(*hits, score, free, densities=densities, seen=seen)

    def _missed(self, now: DiverState, fixes: Positions, association: Association) -> DiverState:
        """With what it says of the tracks that the sensor looked, and did not see them."""
        weights = association.weights
        share = np.ones(len(now.x)) if weights is None else weights.missed_share
        share[association.tracks] = 0.0
        if self.config.named_tracks == 'alone':
            share[now.target_id != NOBODY] = 0.0
        return coverage.missed(now, association.seen, share, self._layout(now.instruments).mask)

    def _branch(self, now: DiverState, fixes: Positions) -> DiverState:
        """The tracks in all hypotheses after `fixes`, those that may begin there among them."""
        now = now.as_seen(fixes.turned_by, self._layout)
        layout = self._layout(now.instruments)
        found = kbest.branched(now, fixes, self.models, self._chain, layout, self._covered)
        now = self._update(found.state, fixes, found.association)
        now = self._update_heights(now, fixes, found.association)
        now = now.as_seen(fixes.turned_by, self._layout, back=True)
        new = births.births_from_fixes(fixes, found.association.free, found.association.existence)
        now = self._with_tracks(now, new)
        return kbest.begun(now, found)

    def _reacquire(
        self, now: DiverState, fixes: Positions, association: Association
    ) -> tuple[DiverState, bool]:
        """The tracks, those that were lost where two fixes say that they are, and whether there
        was one."""
        seen, weights = association.seen, association.weights
        if association.densities is None or not len(now.x):
            return now, False
        hit, left = np.zeros(len(now.x), bool), np.ones(len(fixes.z), bool)
        hit[association.tracks] = True
        firm = now.life.status != TENTATIVE
        if weights is None:
            left[association.detection[firm[association.tracks]]] = False
        else:
            left = weights.beta[firm].sum(axis=0) < 0.5
            hit = hit if seen is None else hit | ~seen.unseen
        layout, whole = self._layout(now.instruments), association.densities.whole
        parts = self.models, self._chain, layout, seen
        return families.reacquired(now, fixes, hit, left, whole, *parts)

    def _update(self, now: DiverState, fixes: Positions, association: Association) -> DiverState:
        """The tracks after the fixes that are theirs."""
        tracks, detection, h = association.tracks, association.detection, association.expected
        layout = self._layout(now.instruments)
        white, consistency = now.white, now.fixes
        if len(tracks):
            stated = as_stated(now.mu, layout.stated)
            mean, covariance = imm_kernels.combine(now.x, now.P, stated, layout.H[0])
            z, R, row = fixes.z, fixes.R, detection
            tentative, sums = now.life.status == TENTATIVE, now.fixes.sums
            if association.counted is not None:
                tentative |= ~association.counted
            scale = np.ones(len(tracks))
            if self.models.mixing is not None:
                scale = families.scale(now.mu[tracks], self.models)
                z, R, row = z[row], R[row] * scale[:, None, None], np.arange(len(tracks))
            innovations = mean, covariance, z, R, tracks, row
            white, sums = fix_kernels.watch(*innovations, tentative, white, sums, MEMORY)
            consistency = now.fixes.after(sums, scale, tentative[tracks])
            now = now._replace(offsets=now.offsets._replace(recent=RecentPairs()))
        now = now._replace(white=white, fixes=consistency, score=association.score)
        if association.weights is not None:
            weights, considered = association.weights, ~layout.mask
            now = jipda.update_jointly(
                now, fixes, weights, tracks, h, layout, considered, association.densities
            )
            return self._with_scale(now, fixes, association)
        if not len(tracks):
            return now
        if association.densities is not None:
            of_copies = association.densities.copies
            after = families.update(now, fixes, tracks, detection, h, layout, of_copies)
        elif layout.mask.all():
            predicted = now.x, now.P, now.mu, h, layout.H, fixes.z, fixes.R, tracks, detection
            after = fix_kernels.update(*predicted, now.nis, now.nis_dof)
        else:
            after = families.considered_update(now, fixes, tracks, detection, h, layout)
        x, P, mu, nis, nis_dof, repairs = after
        now = now._replace(
            x=x, P=P, mu=mu, nis=nis, nis_dof=nis_dof, repairs=now.repairs + repairs
        )
        return self._with_scale(now, fixes, association)

    def _update_heights(self, now: DiverState, fixes: Positions, found: Association) -> DiverState:
        """The tracks after what the fixes that are theirs state of z."""
        layout, place = self._layout(now.instruments), self.models.height
        return heights.update(now, fixes, found, layout, place, self.config)

    def _with_scale(
        self, now: DiverState, fixes: Positions, association: Association
    ) -> DiverState:
        """With the scale of the stated covariances learnt from the pairs of an association."""
        tracks, detection = association.tracks, association.detection
        if association.counted is not None:
            counts = association.counted[tracks]
            tracks, detection = tracks[counts], detection[counts]
        if not self.config.estimate_covariance_scale or not len(tracks):
            return now
        layout = self._layout(now.instruments)
        mu = as_stated(now.mu[tracks], layout.stated)
        mean, covariance = imm_kernels.combine(now.x[tracks], now.P[tracks], mu, layout.H[0])
        residual, stated = fixes.z[detection] - mean, fixes.R[detection] / fixes.factor
        scale = learnt_scale(now.scale, FIXES, residual, covariance, stated)
        return now._replace(scale=scale)

    def _learn(self, before: DiverState, now: DiverState, step: Step, scan: Scan) -> DiverState:
        """What the hits say of the transitions, and of the stated variances of arrivals where no
        fix says the same."""
        hit = now.nis_dof > 0
        if self._keeps_hypotheses:
            learnt = kbest.learnt(before, now, step, self.models, self._chain)
        else:
            learnt = self._chain.learn(
                before.learnt,
                step.transition,
                self.models.by_model(before.mu),
                self.models.by_model(now.mu),
                step.dt,
                np.flatnonzero(hit),
            )
        nis, arrivals, more = np.where(hit, now.nis, np.nan), before.arrivals, before.excess
        if scan.pings and not scan.fixes:
            sure = hit & (now.life.status != TENTATIVE)
            arrivals = arrivals.after(nis[sure], now.nis_dof[sure])
            if not len(self._layout(now.instruments).variances):  # what lasts is no evidence twice
                more = excess(more, nis[sure], now.nis_dof[sure])
        return now._replace(learnt=learnt, nis=nis, arrivals=arrivals, excess=more)

    def _prune(self, now: DiverState, scan: Scan) -> DiverState:
        """End the tracks that are over, broken, there twice, or too many."""
        config, before = self.config, now
        if scan.names or now.last_named:
            now = names.remembered(now, scan.names, config.max_coast)
        if self._keeps_hypotheses:
            looked = scan.complete & (now.target_id == NOBODY)
            return kbest.pruned(now, now.nis_dof > 0, looked, self.rules, config)
        alive = fix_kernels.finite(now.x, now.P)
        if not alive.all():
            now = now._replace(broken=now.broken + int((~alive).sum()))
        hit, looked = now.nis_dof > 0, scan.complete & (now.target_id == NOBODY)
        # Nobody coasts while there are fixes that may be his own.
        refused = now.refused[:, 0] == now.stamp_ns
        if self._covered:
            named = now.target_id != NOBODY
            looked, refused = (
                looked & (now.looks > 1.0 - 1e-9),
                refused & ((now.looks > 0.5) | named),
            )
            now = now._replace(looks=np.where(hit | looked | refused, 0.0, now.looks))
        looked = looked | refused
        by_existence = np.isfinite(now.existence)
        life, kept = now.life.scan(hit, now.stamp_ns, self.rules, looked=looked & ~by_existence)
        if self.models.mixing is not None and any(group.whole for group in scan.fixes):
            doubtful, over = families.doubtful(now, config)
            status = np.where(doubtful[kept], TENTATIVE, life.status).astype(np.uint8)
            life, alive = evolve(life, status=status), alive & ~over
        if by_existence.any():
            judged = jipda.judge(now, hit, looked, self._position, scan.fixes)
            status = np.where(by_existence[kept], judged.status[kept], life.status)
            life = evolve(life, status=status)
            now = now._replace(near_to=judged.near_to, near_for=judged.near_for)
            alive = alive & (judged.alive | ~by_existence)
        if not alive.all():
            life, kept = life.only(alive[kept]), kept & alive
        confirmed = np.flatnonzero(life.status != TENTATIVE)
        if len(confirmed) > config.max_tracks:
            known = np.where(now.target_id == NOBODY, now.score, np.inf)[kept][confirmed]
            best = np.argsort(-known, kind='stable')[: config.max_tracks]
            room = life.status == TENTATIVE
            room[confirmed[best]] = True
            kept[kept] = room
            life = life.only(room)
        now = now.rows(kept, life)
        if config.named_tracks == 'share' and now.last_named:
            now = names.merged(now, before, scan.fixes, self._position)
        return now

    def _spawn(self, now: DiverState, found: list[Birth], starts: list[Start]) -> DiverState:
        """Begin a tentative track at each birth, as long as there is room, and a confirmed one
        where somebody says that a diver is."""
        config = self.config
        if found:
            room = max(0, kbest.most_tracks(config) - len(now.life))
            now = self._with_tracks(now, births.each_name_once(found)[:room])
        if starts and self._keeps_hypotheses:
            now = kbest.decided(now)
        for start in starts:
            now, free = births.make_room(now, start, config, self._position)
            if free:
                height = None
                if config.dimensions == 3:
                    stated = Heights.of(start.position[None], start.covariance[None], 1.0)
                    height = stated and stated.row(0)
                plane = start.position[:2], start.covariance[:2, :2]
                birth = Birth(*plane, measured=False, height=height)
                now = births.confirmed(self._with_tracks(now, [birth]))
        return now

    def _with_tracks(self, now: DiverState, found: list[Birth]) -> DiverState:
        """With a track for each birth."""
        count = len(found)
        if not count:
            return now
        layout = self._layout(now.instruments)
        x, P, mu = births.new_tracks(found, self.models, layout, self.config)
        if self._keeps_hypotheses:
            now = now._replace(hypotheses=now.hypotheses.with_alone(count))
        return now.with_rows(
            now.life.born(count, now.stamp_ns, self.rules),
            {
                'x': x,
                'P': P,
                'mu': mu,
                'learnt': self._chain.fresh(count),
                'nis': np.nan,
                'nis_dof': 0,
                'score': 0.0,
                'white': np.nan,
                'existence': [birth.existence for birth in found],
                'evidence': 1.0,
                'target_id': [birth.target_id for birth in found],
                'near_to': 0,
                'near_for': 0,
                'refused': np.nan,
                'history': 0,
                'came_from': -1,
                'looks': 0.0,
                'refused_z': np.nan,
                'spreads': 0,
            },
        )

    def _estimate(self, state: DiverState) -> Estimate:
        if self._keeps_hypotheses:
            state = kbest.shown(state)
        # Of tracks whose hits are counted the existence is NaN.
        state = state.only(~(state.existence <= jipda.PUBLISHES))
        mean, covariance = families.positions(state, self.models)
        covariance = state.offsets.widened(mean, covariance, self.config)
        xyz = np.full((len(mean), 3), self.config.target_z)
        known = 3 if self.models.height >= 0 else 2
        xyz[:, :known] = mean[:, :known]
        extras: dict[str, np.ndarray] = {
            'track_id': state.life.track_id,
            'track_state': state.life.status,
            'nis': state.nis,
            'nis_dof': state.nis_dof,
            'existence': state.existence,
            'target_id': state.target_id.astype(np.int32),
            **families.columns(state.mu, self.models),
        }
        if self.models.copies > 1 and self.models.height >= 0:
            extras['depth_ambiguous'] = heights.ambiguous(state, self.models).astype(np.uint8)
        if self.origin is not None:
            place = self.origin.geodetic(xyz)
            extras |= {'latitude': place[:, 0], 'longitude': place[:, 1]}
        return Estimate(
            stamp_ns=state.stamp_ns,
            frame_id=self._stream.frame_id,
            xyz=xyz,
            state_names=self.models.outputs,
            state=mean,
            covariance=covariance,
            model_names=self.models.names,
            probabilities=self.models.by_model(state.mu),
            extras=extras,
        )
