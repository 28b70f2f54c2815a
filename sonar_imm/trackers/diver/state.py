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

"""What is known of all divers after a scan, and how it crosses the time to the next."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
import math
from typing import Any, NamedTuple

from attrs import evolve, frozen
import numpy as np

from ...estimation import imm_kernels
from ...estimation.adaptation import AdaptiveChain
from ...estimation.arrays import BoolArray, FloatArray, IntArray
from ...estimation.association import Tracks
from ...estimation.consistency import NisMemory
from .fix_consistency import FixConsistency
from .state_space import Instruments, ModelSet, Motion

SCALE_PRIOR = 20.0
"""Numbers measured that the stated covariances are worth when their scale is being learnt."""

MOST_STEPS = 300
"""A gap is crossed in no more steps than this, however long it is."""

LIFE = ('existence', 'evidence', 'target_id', 'near_to', 'near_for')
"""What is known of the life of a track beside `Tracks`, by the names in `DiverState`."""

ROWS = ('x', 'P', 'mu', 'learnt', 'nis', 'nis_dof', 'score', 'white', *LIFE)
"""What of `DiverState` has a row for each track."""


@frozen(eq=False, kw_only=True)
class DiverState:
    """All that is known after a scan: T tracks with M models of n states, the errors of the
    `instruments` heard so far among them.

    x (T, M, n), P (T, M, n, n), mu (T, M); learnt: what corrects the transitions; nis, nis_dof
    (T,): of this scan, NaN and 0 without a hit; score (T,): how much better than clutter the
    track explained the last ten scans or so, a log-likelihood ratio; scale (2, 2): for fixes and
    for arrivals the sum of squared residuals in units of their stated variance, and their number;
    white (T, 2): whitened innovation of the last fix, NaN for none; fixes, arrivals: what
    innovations say of the stated covariances of either; existence (T,): probability that there
    is a diver, NaN where hits are counted instead; evidence (T,): sum of the probabilities of its
    detections; target_id (T,): whose track it is, `NOBODY` where not known; near_to, near_for
    (T,): the older track it is near, 0 for none, and for how many scans (`soft`, `names`);
    said: names and when each was said last, ns; broken: tracks ended so far because their numbers
    were not finite; not_started:
    starts so far for which there was no room; repairs: covariances repaired so far
    (`estimation.covariance`).
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
    target_id: IntArray
    near_to: IntArray
    near_for: IntArray
    white: FloatArray
    fixes: FixConsistency
    arrivals: NisMemory = NisMemory()
    broken: int = 0
    not_started: int = 0
    repairs: int = 0
    instruments: Instruments = Instruments()
    said: tuple[tuple[int, int], ...] = ()

    def factor(self) -> FloatArray:
        """(2,) by what the covariances of fixes and of arrivals have to be multiplied."""
        return np.asarray((SCALE_PRIOR + self.scale[:, 0]) / (SCALE_PRIOR + self.scale[:, 1]))

    def rows(self, kept: BoolArray, **changes: Any) -> DiverState:
        """With `changes`, those of `ROWS` for all tracks, and then only the tracks where `kept`
        (T,) is True; `life` is left to the caller."""
        if not kept.all():
            index = np.flatnonzero(kept)
            for name in ROWS:
                changes[name] = changes.get(name, getattr(self, name)).take(index, axis=0)
        return evolve(self, **changes)

    def with_rows(self, life: Tracks, new: Mapping[str, FloatArray | IntArray]) -> DiverState:
        """With more tracks, `life` is that of all: `new` holds an array for each of `ROWS`."""
        return evolve(
            self,
            life=life,
            **{name: np.concatenate([getattr(self, name), new[name]]) for name in ROWS},
        )


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
        x, P, mu = _mix(x, P, mu, transition, models.copies)
        x, P, repairs = _predict(x, P, motion, models.copies)
        yield Step(x, P, mu, transition, dt / count, repairs)


def _mix(
    x: FloatArray, P: FloatArray, mu: FloatArray, transition: FloatArray, copies: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mix the models of each copy among each other."""
    if copies == 1:
        return imm_kernels.mix(x, P, mu, transition)
    T, n = len(mu), x.shape[-1]
    M = mu.shape[1] // copies
    weight = mu.reshape(T * copies, M)
    total = weight.sum(axis=1, keepdims=True)
    weight = np.where(total > 0.0, weight / np.where(total > 0.0, total, 1.0), 1.0 / M)
    if len(transition) > 1:
        transition = np.repeat(transition, copies, axis=0)
    x, P, c = imm_kernels.mix(
        x.reshape(T * copies, M, n), P.reshape(T * copies, M, n, n), weight, transition
    )
    whole = T, copies * M, n
    return x.reshape(whole), P.reshape(*whole, n), (c * total).reshape(T, copies * M)


def _predict(
    x: FloatArray, P: FloatArray, motion: Motion, copies: int
) -> tuple[FloatArray, FloatArray, int]:
    """Predict the states of motion; constants behind them stay as they are. Gives x, P and how
    many covariances were repaired."""
    M, n = motion.B.shape
    T, size = len(x), x.shape[-1]
    if copies == 1 and size == n:
        x, P, repaired = imm_kernels.predict(x, P, motion.F, motion.Q, motion.B)
        return x, P, int(repaired.sum())
    x_all, P_all = x.reshape(T * copies, M, size), P.reshape(T * copies, M, size, size)
    x_n, P_n, repaired = imm_kernels.predict(
        np.ascontiguousarray(x_all[..., :n]),
        np.ascontiguousarray(P_all[..., :n, :n]),
        motion.F,
        motion.Q,
        motion.B,
    )
    x1, P1 = x_all.copy(), P_all.copy()
    x1[..., :n], P1[..., :n, :n] = x_n, P_n
    if size > n:
        P1[..., :n, n:] = motion.F @ P_all[..., :n, n:]
        P1[..., n:, :n] = np.swapaxes(P1[..., :n, n:], -1, -2)
    return x1.reshape(x.shape), P1.reshape(P.shape), int(repaired.sum())
