"""One scan of the diver tracker: the state before it, the updates in between, the state after."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
import math
from typing import NamedTuple

from attrs import evolve, frozen
import numpy as np

from ...estimation import imm, imm_kernels
from ...estimation.adaptation import AdaptiveChain
from ...estimation.arrays import BoolArray, FloatArray, IntArray
from ...estimation.association import (
    assign_by_rank,
    association_cost,
    gate_threshold,
    Tracks,
    TrackStatus,
)
from ...measurements import NOBODY
from .config import DiverConfig
from .models import ModelSet
from .sensing import as_fix, Bearings, Group, Positions, RangeSums, TagPing

SCALE_PRIOR = 20.0
"""Numbers measured that the stated covariances are worth when their scale is being learnt."""

MOST_STEPS = 300
"""A gap is crossed in no more steps than this, however long it is."""

EXCLUDED = -1
"""Rank of a track that takes no part in a message."""

FIXES = 0
"""The `Group.kind` of fixes."""

SCORE_MEMORY = 0.9
"""Share of its score a track keeps from scan to scan."""

LIFE = ('existence', 'evidence', 'target_id', 'near_to', 'near_for')
"""What is known of the life of a track beside `Tracks`, by the names in `DiverState`."""

SCALE_MEMORY = 400.0
"""Numbers measured over which the learnt scale forgets."""


@frozen(eq=False, kw_only=True)
class DiverState:
    """All that is known after a scan: T tracks with M models of n states.

    x (T, M, n), P (T, M, n, n), mu (T, M); learnt: what corrects the transitions; nis, nis_dof
    (T,): of this scan, NaN and 0 without a hit; score (T,): how much better than clutter the
    track explained the last ten scans or so, a log-likelihood ratio; scale (2, 2): for fixes and
    for arrivals the sum of squared residuals in units of their stated variance, and their number;
    existence (T,): probability that there is a diver, NaN where hits are counted instead;
    evidence (T,): sum of the probabilities of its detections; target_id (T,): whose track it is,
    `NOBODY` where not known; near_to, near_for (T,): the older track it is near, 0 for none, and
    for how many scans (`soft`);
    broken: tracks ended so far because their numbers were not finite; repairs: covariances
    repaired so far (`estimation.covariance`).
    """

    stamp_ns: int
    life: Tracks
    x: FloatArray
    P: FloatArray
    mu: FloatArray
    learnt: FloatArray
    nis: FloatArray
    nis_dof: np.ndarray
    score: FloatArray
    scale: FloatArray
    existence: FloatArray
    evidence: FloatArray
    target_id: np.ndarray
    near_to: IntArray
    near_for: IntArray
    broken: int = 0
    repairs: int = 0

    def factor(self) -> FloatArray:
        """(2,) by what the covariances of fixes and of arrivals have to be multiplied."""
        return np.asarray((SCALE_PRIOR + self.scale[:, 0]) / (SCALE_PRIOR + self.scale[:, 1]))

    def rows(self, kept: np.ndarray) -> DiverState:
        """The numbers of the tracks where `kept` (T,) is True; `life` is left to the caller."""
        if kept.all():
            return self
        names = ('x', 'P', 'mu', 'learnt', 'nis', 'nis_dof', 'score', *LIFE)
        return evolve(self, **{name: getattr(self, name)[kept] for name in names})


class Step(NamedTuple):
    """Tracks after a step of dt seconds without a measurement, the transitions (T or 1, M, M) of
    that step, and how many covariances it had to repair."""

    x: FloatArray
    P: FloatArray
    mu: FloatArray
    transition: FloatArray
    dt: float
    repairs: int

    def row(self, track: int) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, float]:
        """The step as one track took it."""
        shared = len(self.transition) == 1
        transition = self.transition[0 if shared else track]
        return self.x[track], self.P[track], self.mu[track], transition, self.dt


def cross(
    models: ModelSet, chain: AdaptiveChain, before: DiverState, dt: float, longest: float
) -> Iterator[Step]:
    """Mix and predict over dt seconds, in equal steps of at most `longest`.

    A model holds for a whole step, so one step over a long gap says that the diver swam straight
    all the while: the prediction is a ring, and the diver, who turned, is inside it.
    """
    count = min(max(math.ceil(dt / longest), 1), MOST_STEPS)
    transition, motion = chain.transition(before.learnt, dt / count), models.motion(dt / count)
    x, P, mu = before.x, before.P, before.mu
    for _ in range(count):
        x, P, mu = imm_kernels.mix(x, P, mu, transition)
        x, P, repaired = imm_kernels.predict(x, P, motion.F, motion.Q, motion.B)
        yield Step(x, P, mu, transition, dt / count, int(repaired.sum()))


class Scan:
    """The tracks in the middle of a scan: predicted when made, then `associate_and_update` for
    each message, and `learn` at the end."""

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
        self.transition = np.linalg.matrix_power(transition, len(steps))
        self.nis = np.zeros(len(self.x))
        self.nis_dof = np.zeros(len(self.x), np.uint16)
        self.score = SCORE_MEMORY * before.score
        self.scale = before.scale.copy()
        self.rank = np.zeros(len(self.x), np.int64)
        self.named = before.target_id != NOBODY
        self.existence = before.existence * math.exp(-self.dt / config.survival_time)
        self.evidence = before.evidence

    def associate_and_update(self, groups: Sequence[Group]) -> list[np.ndarray]:
        """Update the tracks with what one message holds for them, group after group. Gives for
        each group True (D,) where a detection was taken.

        Tracks that can explain more of the groups choose first, and among those the confirmed
        ones: a ghost fits the arrivals it was made of, but only those. One that ends up with
        fewer than half of the groups is not what the message shows; for it nothing happened.
        """
        before = self._copies()
        tentative = self.before.life.status == TrackStatus.TENTATIVE
        explained = np.sum(
            [self._fit(group).max(axis=1, initial=-np.inf) > -np.inf for group in groups], axis=0
        )
        self.rank = 2 * (len(groups) - explained) + tentative
        chosen = [self._take_group(group) for group in groups]
        agreeing = np.sum([choice >= 0 for choice in chosen], axis=0)
        doubtful = (agreeing > 0) & (2 * agreeing < len(groups))
        if doubtful.any():
            self.x, self.P, self.mu, self.nis, self.nis_dof, self.score, self.scale = before
            self.rank = np.where(doubtful, EXCLUDED, self.rank)
            chosen = [self._take_group(group) for group in groups]
        return [np.isin(np.arange(len(group.z)), choice) for group, choice in zip(groups, chosen)]

    def take_named(self, group: Positions) -> BoolArray:
        """Update each track by the fix that says it is its own, without association; True (D,)
        where there is a track of that name."""
        names = np.asarray(group.target_id)
        track, row = np.nonzero(self.before.target_id[:, None] == names[None])
        if len(track):
            self._update(group, track, row)
        return np.isin(np.arange(len(names)), row)

    def _copies(self) -> tuple[np.ndarray, ...]:
        return tuple(
            part.copy()
            for part in (self.x, self.P, self.mu, self.nis, self.nis_dof, self.score, self.scale)
        )

    def _take_group(self, group: Group) -> np.ndarray:
        """Associate and update; the detection (T,) each track took, -1 for none."""
        chosen = self._associate(group)
        if isinstance(group, TagPing) and not (chosen >= 0).any():
            # A late reflection among the arrivals, or a prediction too uncertain to linearise at.
            fixed = as_fix(group, self.config)
            if fixed is not None:
                group, chosen = fixed, self._associate(fixed)
        tracks = np.flatnonzero(chosen >= 0)
        if len(tracks):
            self._update(group, tracks, chosen[tracks])
            if isinstance(group, RangeSums):
                self._take_bearings(group.bearings(), tracks, chosen[tracks])
        return chosen

    def learn(self) -> DiverState:
        """The state after the updates; transitions have learnt from the tracks that were hit."""
        hit = np.flatnonzero(self.nis_dof > 0)
        learnt = self.before.learnt.copy()
        shared = len(self.transition) == 1
        learnt[hit] = self.chain.learn(
            learnt[hit],
            self.transition if shared else self.transition[hit],
            self.before.mu[hit],
            self.mu[hit],
            self.dt,
        )
        return evolve(
            self.before,
            stamp_ns=self.stamp_ns,
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
            repairs=self.before.repairs + self.repairs,
        )

    def _fit(self, group: Group) -> FloatArray:
        """Log-likelihood (T, D) of each detection for each track, -inf outside the gate."""
        h, H = group.linearise(self.x, self.models.E)
        threshold = gate_threshold(self.config.gate_probability, group.z.shape[1])
        return imm_kernels.gate(
            h, np.ascontiguousarray(H), self.P, self.mu, group.z, group.R, threshold
        )

    def _associate(self, group: Group) -> np.ndarray:
        """The detection of each track (T,), -1 for none; tracks choose in the order of `rank`."""
        fit = self._fit(group)
        if group.kind == FIXES:
            fit[self.named] = -np.inf  # they know their own
        target, detection = imm.pairs_inside(fit)
        likelihood = fit[target, detection]
        if group.clutter == 0.0:
            cost = -1e6 - likelihood  # nothing to compare with but the other tracks
        else:
            p_detection = self.config.detection_probability
            cost = association_cost(likelihood, p_detection, group.clutter)
        chosen = assign_by_rank(target, detection, cost, self.rank, len(group.z))
        self._keep_score(fit, chosen, group)
        return chosen

    def _keep_score(self, fit: FloatArray, chosen: np.ndarray, group: Group) -> None:
        """ln of P_D N(nu; 0, S) / clutter for a hit, of 1 - P_D for a miss."""
        p_detection = self.config.detection_probability
        hit = np.flatnonzero(chosen >= 0)
        apart = self.named & (group.kind == FIXES)
        self.score += np.where(apart, 0.0, np.log1p(-p_detection))
        self.score[hit] += fit[hit, chosen[hit]] + np.log(p_detection / (1.0 - p_detection))
        self.score[hit] -= np.log(group.clutter or self.config.clutter_density)

    def _expected(self, group: Group, tracks: np.ndarray) -> tuple[FloatArray, FloatArray]:
        """Mean (t, m) and covariance (t, m, m), without R, of what the group would measure of
        `tracks`."""
        x, P, mu = self.x[tracks], self.P[tracks], self.mu[tracks]
        if isinstance(group, Positions):
            return imm_kernels.combine(x, P, mu, np.ascontiguousarray(self.models.E[:, :2]))
        h, H = group.linearise(x, self.models.E)
        mean = np.einsum('tj,tjm->tm', mu, h)
        spread = h - mean[:, None]
        covariance = H @ P @ np.swapaxes(H, -1, -2) + spread[..., :, None] * spread[..., None, :]
        return mean, np.einsum('tj,tjmk->tmk', mu, covariance)

    def _update(self, group: Group, tracks: np.ndarray, detection: np.ndarray) -> None:
        """Update `tracks` (t,), each with its `detection` (t,)."""
        x, P, mu = self.x[tracks], self.P[tracks], self.mu[tracks]
        h, H = group.linearise(x, self.models.E)
        R = np.ascontiguousarray(group.R[detection])
        x, P, mu, _, nis, ok, repaired = imm_kernels.update(
            x, P, mu, group.innovation(h, detection), np.ascontiguousarray(H), R
        )
        self.repairs += int(repaired.sum())
        self.x[tracks], self.P[tracks], self.mu[tracks] = x, P, mu
        self.nis[tracks] += np.where(ok, nis, 0.0)
        self.nis_dof[tracks] += np.where(ok, group.z.shape[1], 0).astype(np.uint16)
        if self.config.estimate_covariance_scale:
            self._learn_scale(group, tracks, detection)

    def _take_bearings(
        self, bearings: Bearings, tracks: np.ndarray, detection: np.ndarray
    ) -> None:
        """Bearings belong to the echo they came with; the gate only keeps outliers out."""
        measured = np.isfinite(bearings.z[detection, 0])
        tracks, detection = tracks[measured], detection[measured]
        if not len(tracks):
            return
        h, H = bearings.linearise(self.x[tracks], self.models.E)
        innovation = np.einsum(
            'tj,tj->t', self.mu[tracks], bearings.innovation(h, detection)[..., 0]
        )
        _, covariance = self._expected(bearings, tracks)
        nis = innovation**2 / (covariance[:, 0, 0] + bearings.R[detection, 0, 0])
        near = nis <= gate_threshold(self.config.gate_probability, 1)
        self._update(bearings, tracks[near], detection[near])

    def _learn_scale(self, group: Group, tracks: np.ndarray, detection: np.ndarray) -> None:
        """Compare residuals with the stated covariance: E[r r' + H P H'] = R after the update,
        where R is right."""
        mean, covariance = self._expected(group, tracks)
        residual = group.z[detection] - mean
        spread = residual[:, :, None] * residual[:, None, :] + covariance
        stated = group.R[detection] / group.factor
        total = float(np.trace(np.linalg.solve(stated, spread), axis1=-2, axis2=-1).sum())
        row = self.scale[group.kind] + (total, residual.size)
        self.scale[group.kind] = row * min(1.0, SCALE_MEMORY / row[1])
