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

"""One scan of the diver tracker: the state before it, the updates in between, the state after."""

from __future__ import annotations

from collections.abc import Iterator
import math

import numpy as np

from ...acoustics.multistatic import difference_projection
from ...estimation import imm_kernels
from ...estimation.adaptation import AdaptiveChain
from ...estimation.arrays import BoolArray, FloatArray, IndexArray, IntArray
from ...estimation.association import (
    assign,
    assign_fits,
    association_cost,
    gate_threshold,
    TENTATIVE,
)
from ...estimation.consider import consider_models
from ...estimation.small_matrices import add_jitter_all
from ...measurements import Arrivals, NOBODY
from . import fix_kernels
from .config import DiverConfig
from .expectation_kernels import fit_numbers
from .fix_consistency import FixConsistency, MEMORY
from .model_set import ModelSet
from .pings import Ping, ping_numbers, PingUpdate, residuals, update_by_ping
from .sensing import Positions
from .state import cross, DiverState

FIXES, ARRIVALS = 0, 1
"""Rows of the learnt scale."""

NEAR = 28.0
"""NIS of an echo that may be a track's: beyond, it weighs less than the least explanation kept by
`ping_kernels`."""

TAKEN = 0.5
"""Probability of being good from which a number counts as a track's."""

EXCLUDED = -1
"""Rank of a track that takes no part in a message."""

SCORE_MEMORY = 0.9
"""Share of its score a track keeps from scan to scan."""

SCALE_MEMORY = 400.0
"""Numbers measured over which the learnt scale forgets."""


class Scan:
    """The tracks in the middle of a scan: predicted when made, then `associate_and_update` for
    the fixes, `update_by_ping` for each ping, and `learn` at the end."""

    def __init__(
        self,
        config: DiverConfig,
        models: ModelSet,
        chain: AdaptiveChain,
        before: DiverState,
        stamp_ns: int,
    ):
        self.config, self.models, self.chain, self.before = config, models, chain, before
        self.stamp_ns = stamp_ns
        self.dt = (stamp_ns - before.stamp_ns) * 1e-9 if before.stamp_ns else 0.0
        steps = list(cross(models, chain, before, self.dt, config.longest_step))
        self.x, self.P, self.mu, transition, *_ = steps[-1]
        self.repairs = sum(step.repairs for step in steps)
        single = len(steps) == 1
        self.transition = transition if single else np.linalg.matrix_power(transition, len(steps))
        self.nis = np.zeros(len(self.x))
        self.nis_dof = np.zeros(len(self.x), np.uint16)
        self.score = SCORE_MEMORY * before.score
        self.scale = before.scale.copy()
        self.white = before.white.copy()
        self.fixes = before.fixes
        self.tentative = before.life.status == TENTATIVE
        self.instruments = before.instruments
        self.layout = self.instruments.layout(config, models.n)
        self.x, self.P = self.layout.widened(self.x, self.P)  # sound speed, before any ping
        self.named = before.target_id != NOBODY
        self.existence = before.existence * math.exp(-self.dt / config.survival_time)
        self.evidence = before.evidence

    def learn(self) -> DiverState:
        """What is known now; the transitions have learnt from the tracks that were hit."""
        learnt = self.chain.learn(
            self.before.learnt,
            self.transition,
            self.models.by_model(self.before.mu),
            self.models.by_model(self.mu),
            self.dt,
            np.flatnonzero(self.nis_dof > 0),
        )
        before = self.before
        return DiverState(
            stamp_ns=self.stamp_ns,
            life=before.life,
            x=self.x,
            P=self.P,
            mu=self.mu,
            learnt=learnt,
            nis=np.where(self.nis_dof > 0, self.nis, np.nan),
            nis_dof=self.nis_dof,
            score=self.score,
            scale=self.scale,
            existence=self.existence,
            evidence=self.evidence,
            target_id=before.target_id,
            near_to=before.near_to,
            near_for=before.near_for,
            white=self.white,
            fixes=self.fixes,
            broken=before.broken,
            not_started=before.not_started,
            repairs=before.repairs + self.repairs,
            instruments=self.instruments,
        )

    # -- fixes ---------------------------------------------------------------------------------

    def associate_and_update(self, group: Positions) -> BoolArray:
        """Associate and update; True (D,) where a fix was taken. Confirmed tracks choose first."""
        H, h = self.expected_fixes()
        threshold = gate_threshold(self.config.gate_probability, 2)
        fit = imm_kernels.gate(h, H, self.P, self.mu, group.z, group.R, threshold)
        if self.named.any():
            fit[self.named] = -np.inf  # they know their own
        chosen = self._associate(fit, group.clutter)
        p = self.config.detection_probability
        logs = np.log1p(-p), np.log(p / (1.0 - p)), np.log(group.clutter)
        fix_kernels.keep_score(self.score, fit, chosen, self.named, *logs)
        tracks = np.flatnonzero(chosen >= 0)
        taken = np.zeros(len(group.z), bool)
        if len(tracks):
            taken[chosen[tracks]] = True
            self._update(group, tracks, chosen[tracks], H, h)
        return taken

    def update_by_fixes(self, group: Positions, tracks: IndexArray, detection: IntArray) -> None:
        """Update `tracks` (t,), each with its `detection` (t,), without association."""
        H, h = self.expected_fixes()
        self._update(group, tracks, detection, H, h)

    def expected_fixes(self) -> tuple[FloatArray, FloatArray]:
        """H (1, M, 2, n + q), what a fix measures of the whole state, and the fix h (T, M, 2) that
        each model expects."""
        fix, extra = self.models.fix, self.layout.size - self.models.n
        if extra:
            fix = np.concatenate([fix, np.zeros((*fix.shape[:2], extra))], axis=2)
        H = np.ascontiguousarray(fix[None])
        return H, fix_kernels.expected(self.x, H)

    def _associate(self, fit: FloatArray, clutter: float) -> IntArray:
        """The detection of each track (T,), -1 for none; confirmed tracks choose first."""
        return assign_fits(fit, self.tentative, self.config.detection_probability, clutter)

    def _update(
        self,
        group: Positions,
        tracks: IndexArray,
        detection: IntArray,
        H: FloatArray,
        h: FloatArray,
    ) -> None:
        """Update `tracks` (t,), each with its `detection` (t,); h (T, M, 2) what all expect."""
        mask, z, R = self.layout.mask, group.z, group.R
        self.watch(group, tracks, detection, H)
        if mask.all():
            parts = self.x, self.P, self.mu, h, H, z, R, tracks, detection, self.nis, self.nis_dof
            self.repairs += fix_kernels.take(*parts)
        else:
            innovation = z[detection][:, None, :] - h[tracks]
            x, P, mu, nis, ok = consider_models(
                self.x[tracks],
                self.P[tracks],
                self.mu[tracks],
                innovation,
                H[0],
                R[detection],
                mask,
            )
            self.repairs += sum(add_jitter_all(one) for one in P)
            self.x[tracks], self.P[tracks], self.mu[tracks] = x, P, mu
            self.nis[tracks] += np.where(ok, nis, 0.0)
            self.nis_dof[tracks] += np.where(ok, 2, 0).astype(np.uint16)
        if self.config.estimate_covariance_scale:
            x, P, mu = self.x[tracks], self.P[tracks], self.mu[tracks]
            mean, covariance = imm_kernels.combine(x, P, mu, np.ascontiguousarray(H[0]))
            residual = z[detection] - mean
            stated = R[detection] / group.factor
            self._learn_scale(FIXES, residual, covariance, stated)

    def watch(
        self, group: Positions, tracks: IndexArray, detection: IntArray, H: FloatArray
    ) -> None:
        """Keep account of whitened innovations, of the mixture as it was predicted."""
        where = group.z, group.R, tracks, detection, self.tentative, self.white
        sums = fix_kernels.watch(self.x, self.P, self.mu, H, *where, self.fixes.sums, MEMORY)
        self.fixes = FixConsistency(*sums)

    def _learn_scale(
        self, kind: int, residual: FloatArray, covariance: FloatArray, stated: FloatArray
    ) -> None:
        """Compare residuals (t, m) with the `stated` covariance (t, m, m): E[r r' + H P H'] = R
        after the update, where R is right."""
        spread = residual[:, :, None] * residual[:, None, :] + covariance
        total = float(np.trace(np.linalg.solve(stated, spread), axis1=-2, axis2=-1).sum())
        row = self.scale[kind] + (total, residual.size)
        self.scale[kind] = row * min(1.0, SCALE_MEMORY / row[1])

    # -- pings -----------------------------------------------------------------------------------

    def take_ping(self, ping: Arrivals, factor: float) -> BoolArray:
        """Update the tracks by a ping, `factor` on the variances of its arrival times; True (n,)
        for the rows that a track took."""
        self.instruments = self.instruments.heard(ping, self.config)
        self.layout = self.instruments.layout(self.config, self.models.n)
        self.x, self.P = self.layout.widened(self.x, self.P)
        rows, taken = np.arange(len(ping)), np.zeros(len(ping), bool)
        numbers = ping_numbers(ping, rows, self.config, factor, self.models, self.layout)
        if len(self.x) and numbers.pairs > int(ping.passive):
            good = (self._take_tag if ping.passive else self._take_echoes)(numbers, factor)
            taken[numbers.row[good & numbers.echo]] = True
            taken |= ping.passive and taken.any()  # all are one track's, also those not used
        return taken

    def _take_echoes(self, ping: Ping, factor: float) -> BoolArray:
        """Which numbers (C,) the tracks took of the echoes of one transmission.

        Tracks that can explain more of the pairs choose first, and among those the confirmed
        ones: a ghost fits the echoes it was made of, but only those. One that ends up with fewer
        than half of the pairs is not what the ping shows; for it nothing happened.
        """
        fits = [fit_numbers(*one, self.config.target_z, ping.numbers) for one in self._each()]
        fit, nis = (np.array(column) for column in zip(*fits))
        near = (nis < NEAR) & ping.echo
        pairs = [np.flatnonzero((ping.numbers.node == one) & ping.echo) for one in ping.nodes]
        explained = np.sum([near[:, members].any(axis=1) for members in pairs], axis=0)
        rank = 2 * (len(pairs) - explained) + self.tentative
        before = self._copies()
        taken, hits = self._by_rank(ping, factor, rank, fit, near, pairs)
        doubtful = (hits > 0) & (2 * hits < len(pairs))
        if doubtful.any():
            self._restore(before)
            rank = np.where(doubtful, EXCLUDED, rank)
            taken, _ = self._by_rank(ping, factor, rank, fit, near, pairs)
        return taken

    def _by_rank(
        self,
        ping: Ping,
        factor: float,
        rank: IntArray,
        fit: FloatArray,
        near: BoolArray,
        pairs: list[IndexArray],
    ) -> tuple[BoolArray, IntArray]:
        """Which numbers (C,) were taken, and how many pairs each track (T,) took one of."""
        taken, hits = np.zeros(len(ping.row), bool), np.zeros(len(rank), np.int64)
        self.score += len(pairs) * np.log1p(-self.config.detection_probability)
        gain = np.log(
            self.config.detection_probability / (1.0 - self.config.detection_probability)
        )
        gain -= 0.5 * np.log(self.config.clutter_density)
        for now in np.unique(rank[rank != EXCLUDED]):
            tracks = np.flatnonzero(rank == now)
            owner = self._owners(tracks, fit, near & ~taken, pairs)
            found = np.zeros(len(taken), bool)
            for track in tracks:
                mine = ping.kept(~taken & ~found & ((owner < 0) | (owner == track)))
                index = np.flatnonzero(mine)
                good = self.accept(track, ping.only(mine), factor)
                found[index[good]] = True
                echoes = index[good & ping.echo[index]]
                hits[track] = len(echoes)
                self.score[track] += fit[track, echoes].sum() + gain * len(echoes)
            taken |= found
        return taken, hits

    def _owners(
        self, tracks: IndexArray, fit: FloatArray, near: BoolArray, pairs: list[IndexArray]
    ) -> IntArray:
        """The track each number (C,) is kept for, -1 for none: where several tracks choose at
        once, each pair's echoes are assigned from the prediction."""
        owner = np.full(fit.shape[1], -1)
        if len(tracks) > 1:
            for members in pairs:
                inside = near[np.ix_(tracks, members)]
                target, detection = np.nonzero(inside)
                likelihood = fit[np.ix_(tracks, members)][target, detection]
                cost = association_cost(
                    likelihood,
                    self.config.detection_probability,
                    math.sqrt(self.config.clutter_density),
                )
                chosen = assign(target, detection, cost, len(tracks), len(members))
                hit = np.flatnonzero(chosen >= 0)
                owner[members[chosen[hit]]] = tracks[hit]
        return owner

    def _take_tag(self, ping: Ping, factor: float) -> BoolArray:
        """Which numbers (C,) were taken of a tag's ping, all of it by one track.

        A single diver known to be there is given every ping. Otherwise it is the track that
        explains the ping best of those that need not jump for it. Confirmed tracks come first;
        others are asked where less than half of the arrivals fit the one chosen.
        """
        self.score += np.log1p(-self.config.detection_probability)
        for turn in (~self.tentative, self.tentative):
            chosen = self._best_for_tag(ping, np.flatnonzero(turn))
            if chosen is not None:
                track, after = chosen
                good = self.accept(track, ping, factor, after)
                self.score[track] += float(good.sum())
                if 2 * good.sum() >= len(good):
                    return np.ones(len(good), bool)
        return np.zeros(len(ping.row), bool)

    def _best_for_tag(self, ping: Ping, tracks: IndexArray) -> tuple[int, PingUpdate] | None:
        """Which of `tracks` explains a tag's ping best, and what becomes of it."""
        best: tuple[int, PingUpdate] | None = None
        for track in tracks.tolist():
            after = update_by_ping(*self._one(track), ping, self.config, self.layout)
            if after is None or not (self.config.max_tracks == 1 or self._near(track, after)):
                continue
            if best is None or after.log_evidence > best[1].log_evidence:
                best = track, after
        return best

    def _near(self, track: int, after: PingUpdate) -> bool:
        """Whether the diver after a ping is where the prediction allows it to be."""
        E = np.zeros((self.x.shape[1], 2, self.layout.size))
        E[:, 0, 0] = E[:, 1, 1] = 1.0
        mean, covariance = imm_kernels.combine(*(one[None] for one in self._one(track)), E)
        there, _ = imm_kernels.combine(after.x[None], after.P[None], after.mu[None], E)
        gap = there[0] - mean[0]
        distance = float(gap @ np.linalg.solve(covariance[0], gap))
        return distance <= gate_threshold(self.config.gate_probability, 2)

    def _one(self, track: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        return self.x[track], self.P[track], self.mu[track]

    def _each(self) -> Iterator[tuple[FloatArray, FloatArray, FloatArray]]:
        return (self._one(track) for track in range(len(self.x)))

    def accept(
        self, track: int, ping: Ping, factor: float, after: PingUpdate | None = None
    ) -> BoolArray:
        """Update one track by numbers it may have; True (C,) for those that are its own."""
        before = self._one(track)
        if after is None and ping.echo.any():
            after = update_by_ping(*before, ping, self.config, self.layout)
        if after is None:
            return np.zeros(len(ping.row), bool)
        good = np.asarray(after.good > TAKEN)
        height = self.config.target_z
        if (good & ping.echo).sum() > int(ping.passive):
            own = ping.compared(good)
            residual, covariance, dof = residuals(*before, own, height)
            S = covariance + np.diag(own.numbers.variance)
            self.nis[track] += float(residual @ np.linalg.solve(S, residual))
            self.nis_dof[track] += np.uint16(dof)
        self.x[track], self.P[track], self.mu[track] = after.x, after.P, after.mu
        self.repairs += after.repairs
        if self.config.estimate_covariance_scale and (good & ping.echo).any():
            self._learn_from_ping(track, ping.compared(good & ping.echo), factor)
        return good

    def _learn_from_ping(self, track: int, ping: Ping, factor: float) -> None:
        """The scale of arrival times, from the arrivals a track took."""
        residual, covariance, dof = residuals(*self._one(track), ping, self.config.target_z)
        stated = np.diag(ping.numbers.variance / factor)
        if ping.passive and dof:
            # The emission is unknown: differences, whitened by what is stated.
            projection = difference_projection(ping.numbers.variance / factor)
            residual, stated = projection @ residual, np.eye(dof)
            covariance = projection @ covariance @ projection.T
        if dof:
            self._learn_scale(ARRIVALS, residual[None], covariance[None], stated[None])

    def _copies(self) -> tuple[FloatArray | IntArray, ...]:
        return tuple(
            part.copy()
            for part in (self.x, self.P, self.mu, self.nis, self.nis_dof, self.score, self.scale)
        )

    def _restore(self, copies: tuple[FloatArray | IntArray, ...]) -> None:
        self.x, self.P, self.mu, self.nis, self.nis_dof, self.score, self.scale = copies
