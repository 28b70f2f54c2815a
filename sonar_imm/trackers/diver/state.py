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

from collections.abc import Callable, Iterator, Mapping
from functools import partial
import math
from typing import Annotated, Any, NamedTuple

import numpy as np

from ...estimation import imm_kernels
from ...estimation.adaptation import AdaptiveChain
from ...estimation.arrays import BoolArray, FloatArray, IndexArray, IntArray, with_rows
from ...estimation.association import Tracks
from ...estimation.consistency import NisMemory
from ...estimation.motion import Motion
from . import family_kernels
from .clutter import Clutters
from .config import DiverConfig
from .family_kernels import Mixing
from .offsets import Offsets
from .state_space import Instruments, Layout, ModelSet

MEMORY = 50.0
"""Fixes over which `FixConsistency` is gathered and forgotten."""

OPTIMISTIC, PESSIMISTIC, CORRELATED = 1.7, 0.5, 0.3
"""Mean NIS for each coordinate above and below which, and lag-1 correlation above which, a
covariance is not what it says. Of `MEMORY` fixes with true covariances the mean has a standard
deviation of 0.14, so that the first is five sigmas away: motion takes up a part of errors that are
larger than stated, and leaves a mean of about 2 however much larger they are."""

TOO_SMALL, ENOUGH = 2.0, 12.0
"""Scale of the covariances of fixes above which they are too small to be left as they are, and the
sum of the logarithms of what was above it, over groups of fixes in turn, that is evidence enough:
8 groups where the scale is 10, 17 where it is 4. Of true covariances the sum stayed below 4 in
four hours of the scenes of `simulate`."""

DOUBTED = 0.1
"""Share of the heights of fixes from which what is doubted of them is said, after `MANY` of
them."""

MANY = 20

MOST_STEPS = 300
"""A gap is crossed in no more steps than this, however long it is."""

ROWS = (
    'x',
    'P',
    'mu',
    'learnt',
    'nis',
    'nis_dof',
    'score',
    'white',
    'existence',
    'evidence',
    'target_id',
    'near_to',
    'near_for',
    'refused',
    'looks',
    'refused_z',
    'spreads',
)
"""What of `DiverState` has a row for each track."""


class FixConsistency(NamedTuple):
    """When a stated covariance of fixes cannot be true, and what innovations cannot tell: sums
    over the last fixes of confirmed tracks.

    number of fixes; nis, for each coordinate; pairs of successive fixes, their cross product and
    mean square of whitened innovations; of `families` the scale of the covariances that the copies
    of the filter tell, and the evidence (`ENOUGH`) that it is above `TOO_SMALL`.

    Innovations of a filter with true covariances have a mean NIS of their number of coordinates
    (2) and are white; one beyond three sigmas for each coordinate is a sharp turn and counts as
    that. Larger: the covariances are optimistic, and may be scaled up. Smaller, or correlated from
    fix to fix: the source filters its output, so that its errors last, or its covariances are
    pessimistic. These two look the same. And a source that states only the white part of errors
    that last looks perfect: from one sensor, a bias slower than the motion is not in the
    innovations. So a covariance is never scaled down on this evidence; `warnings` says what the
    user has to state.
    """

    number: float = 0.0
    nis: float = 0.0
    pairs: float = 0.0
    cross: float = 0.0
    square: float = 0.0
    scale: float = 1.0
    evidence: float = 0.0

    @property
    def sums(self) -> tuple[float, float, float, float, float]:
        """All of them, as `fix_kernels.watch` takes and gives them."""
        return self.number, self.nis, self.pairs, self.cross, self.square

    def after(
        self, sums: tuple[float, ...], scale: FloatArray, tentative: BoolArray
    ) -> FixConsistency:
        """With new sums, after fixes whose covariances were taken `scale` (k,) times, by tracks of
        which some are `tentative` (k,)."""
        least, evidence = self.scale, self.evidence
        if not tentative.all():
            # What one track takes for true is true; others may be on the wrong fixes.
            least = float(scale[~tentative].min())
            evidence = max(evidence + math.log(least / TOO_SMALL), 0.0)
        return self._replace(**dict(zip(self._fields, sums)), scale=least, evidence=evidence)

    @property
    def mean_nis(self) -> float:
        """For each coordinate, 1 where all is well; NaN without a fix."""
        return self.nis / self.number if self.number else float('nan')

    @property
    def lag_1(self) -> float:
        """Correlation of successive whitened innovations; NaN without a pair."""
        return self.cross / self.square if self.square else float('nan')

    def warnings(self, bias_stated: bool) -> list[str]:
        """Sentences on covariances that cannot be true: of `families` as soon as the evidence is
        enough, else once `MEMORY` fixes were seen."""
        if self.evidence >= ENOUGH:
            times = self.scale * max(self.mean_nis, 1.0)
            return [
                f'fixes scatter some {math.sqrt(times):.2g} times as far as they state: their '
                f'covariances are {times:.2g} times too small; multiply covariance_scale by that'
            ]
        if self.number < 0.99 * MEMORY:
            return []
        if self.mean_nis > OPTIMISTIC:
            return [
                f'fixes miss by more than they state: mean NIS {self.mean_nis:.2g} for each '
                'coordinate, 1 is due; raise covariance_scale (model_set families finds out by '
                'how much) or the noise of the motion'
            ]
        if not bias_stated and (self.mean_nis < PESSIMISTIC or self.lag_1 > CORRELATED):
            return [
                f'the errors of the fixes last, or their covariances are too large (mean NIS '
                f'{self.mean_nis:.2g} for each coordinate, correlation {self.lag_1:.2g} from fix '
                'to fix); the data cannot tell which: state fix_bias_std'
            ]
        return []


class HeightCounts(NamedTuple):
    """How many heights of fixes there were for tracks, how many of them were refused, and how many
    lie outside `depth_min` to `depth_max`."""

    seen: int = 0
    refused: int = 0
    outside: int = 0

    def warnings(self, config: DiverConfig) -> list[str]:
        """Sentences for the user."""
        if self.seen < MANY:
            return []
        found = []
        if self.outside > DOUBTED * self.seen:
            found.append(
                f'{self.outside} of {self.seen} heights of fixes lie outside depth_min '
                f'({config.depth_min:g} m) to depth_max ({config.depth_max:g} m): state these, or '
                'the height of origin for positions in latitude and longitude'
            )
        if self.refused > DOUBTED * self.seen:
            found.append(
                f'{self.refused} of {self.seen} heights of fixes were refused: z misses by more '
                'than it states, or the divers go up and down faster than target says'
            )
        return found


class DiverState(NamedTuple):
    """All that is known after a scan: T tracks with M models of n states, the errors of the
    `instruments` heard so far among them.

    x (T, M, n), P (T, M, n, n), mu (T, M); learnt: what corrects the transitions; nis, nis_dof
    (T,): of this scan, NaN and 0 without a hit; score (T,): how much better than clutter the
    track explained the last ten scans or so, a log-likelihood ratio; white (T, 2): whitened
    innovation of the last fix, NaN for none; existence (T,): probability that there is a diver,
    NaN where hits are counted instead; evidence (T,): sum of the probabilities of its detections;
    target_id (T,): whose track it is, `NOBODY` where not known; near_to, near_for (T,): the older
    track it is near, 0 for none, and for how many scans (`jipda`, `names`); refused (T, 6): stamp,
    position and covariance (xx, xy, yy) of the last fix that may have been its own and was not
    believed, NaN since it took another (`families`); refused_z (T, 3): stamp, z and variance of
    the last height of a fix that was not, spreads (T,): how often the copies of the models were
    spread anew (`heights`); looks (T,): parts of a miss that have not been counted yet, where the
    sensor does not see everywhere (`coverage`); fixes, arrivals: what innovations say of the
    stated covariances of either; excess: of `estimation.consistency`, that those of arrivals are
    too small; offsets: that arrivals miss by the same ping after ping; heights: how many z of
    fixes could be used; clutter: what each sensor
    showed that was nobody's; last_named: names and the stamp of each
    one's last measurement; broken: tracks ended so far because their numbers were not finite;
    not_started: starts so far for which there was no room;
    repairs: covariances repaired so far (`estimation.covariance`).
    """

    stamp_ns: int
    life: Tracks
    x: Annotated[FloatArray, 'TMn']
    P: Annotated[FloatArray, 'TMnn']
    mu: Annotated[FloatArray, 'TM']
    learnt: Annotated[FloatArray, 'Tall']
    nis: Annotated[FloatArray, 'T']
    nis_dof: Annotated[np.ndarray, 'T']
    score: Annotated[FloatArray, 'T']
    white: Annotated[FloatArray, 'T2']
    existence: Annotated[FloatArray, 'T']
    evidence: Annotated[FloatArray, 'T']
    target_id: Annotated[IntArray, 'T']
    near_to: Annotated[IntArray, 'T']
    near_for: Annotated[IntArray, 'T']
    refused: Annotated[FloatArray, 'T6']
    refused_z: Annotated[FloatArray, 'T3']
    spreads: Annotated[IntArray, 'T']
    looks: Annotated[FloatArray, 'T']
    fixes: FixConsistency = FixConsistency()
    arrivals: NisMemory = NisMemory()
    excess: float = 0.0
    heights: HeightCounts = HeightCounts()
    offsets: Offsets = Offsets()
    instruments: Instruments = Instruments()
    clutter: Clutters = ()
    last_named: tuple[tuple[int, int], ...] = ()
    broken: int = 0
    not_started: int = 0
    repairs: int = 0

    def require_like(self, other: DiverState, n: int) -> None:
        """Raise ValueError where this is no state of the models of `other` with n states each."""
        shapes = [(state.x.shape[1], state.learnt[:0].shape) for state in (self, other)]
        seen = self.life.seen.shape[1:] == other.life.seen.shape[1:]
        if shapes[0] != shapes[1] or (len(self.x) and self.x.shape[2] != n) or not seen:
            raise ValueError('states are of other models')

    @classmethod
    def of_nobody(cls, life: Tracks, models: ModelSet, learnt: FloatArray) -> DiverState:
        """The state without a track; `life` and `learnt` have none, but the next identity."""
        M, n = len(models.E), models.n
        return cls(
            stamp_ns=0,
            life=life,
            x=np.empty((0, M, n)),
            P=np.empty((0, M, n, n)),
            mu=np.empty((0, M)),
            learnt=learnt,
            nis=np.empty(0),
            nis_dof=np.empty(0, np.uint16),
            score=np.empty(0),
            white=np.empty((0, 2)),
            existence=np.empty(0),
            evidence=np.empty(0),
            target_id=np.empty(0, np.int64),
            near_to=np.empty(0, np.int64),
            near_for=np.empty(0, np.int64),
            refused=np.empty((0, 6)),
            looks=np.empty(0),
            refused_z=np.empty((0, 3)),
            spreads=np.empty(0, np.int64),
        )

    def rows(self, kept: BoolArray, life: Tracks) -> DiverState:
        """The tracks where `kept` (T,) is True; `life` is that of those."""
        if kept.all():
            return self._replace(life=life)
        return self.at(kept.nonzero()[0], life)

    def at(self, rows: IndexArray, life: Tracks) -> DiverState:
        """The rows of those numbers; `life` is that of them."""
        parts: dict[str, Any] = {name: getattr(self, name).take(rows, axis=0) for name in ROWS}
        return self._replace(life=life, **parts)

    def only(self, kept: BoolArray) -> DiverState:
        """The tracks where `kept` (T,) is True."""
        return self if kept.all() else self.rows(kept, self.life.only(kept))

    def with_rows(self, life: Tracks, new: Mapping[str, Any]) -> DiverState:
        """With more tracks, `life` is that of all: `new` holds for each of `ROWS` an array, or a
        number for all."""
        count = len(life) - len(self.x)
        parts: dict[str, Any] = {
            name: with_rows(getattr(self, name), count, new[name]) for name in ROWS
        }
        return self._replace(life=life, **parts)

    def as_seen(
        self,
        sensor: tuple[str, FloatArray] | None,
        layouts: Callable[[Instruments], Layout],
        *,
        back: bool = False,
    ) -> DiverState:
        """The tracks where a `sensor` shows them whose bearings may all be off, by its name and
        place (2,), or back; None: a sensor without such an error."""
        if sensor is None:
            return self
        instruments = self.instruments.with_sensor(sensor[0])
        layout = layouts(instruments)
        x, P = layout.as_seen(*layout.widened(self.x, self.P), *sensor, back=back)
        return self._replace(x=x, P=P, instruments=instruments)

    def positions(self, E: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Mean (T, q) and covariance (T, q, q) of the outputs E (M, q, n) of the motion."""
        x, P, n = self.x, self.P, E.shape[-1]
        if x.shape[-1] > n:
            x, P = np.ascontiguousarray(x[..., :n]), np.ascontiguousarray(P[..., :n, :n])
        return imm_kernels.combine(x, P, self.mu, E)


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
        x, P, mu = _mix(x, P, mu, transition, models)
        x, P, repairs = _predict(x, P, motion, models.copies)
        yield Step(x, P, mu, transition, dt / count, repairs)


def _mix(
    x: FloatArray, P: FloatArray, mu: FloatArray, transition: FloatArray, models: ModelSet
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Mix the models of each copy among each other."""
    mix, copies = partial(_mix_models, mixing=models.mixing), models.copies
    if copies == 1:
        return mix(x, P, mu, transition)
    T, n = len(mu), x.shape[-1]
    M = mu.shape[1] // copies
    weight = mu.reshape(T * copies, M)
    total = weight.sum(axis=1, keepdims=True)
    weight = np.where(total > 0.0, weight / np.where(total > 0.0, total, 1.0), 1.0 / M)
    if len(transition) > 1:
        transition = np.repeat(transition, copies, axis=0)
    x, P, c = mix(x.reshape(T * copies, M, n), P.reshape(T * copies, M, n, n), weight, transition)
    whole = T, copies * M, n
    return x.reshape(whole), P.reshape(*whole, n), (c * total).reshape(T, copies * M)


def _mix_models(
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    transition: FloatArray,
    mixing: Mixing | None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    if mixing is None:
        return imm_kernels.mix(x, P, mu, transition)
    return family_kernels.mix(x, P, mu, transition, mixing)


def _predict(
    x: FloatArray, P: FloatArray, motion: Motion, copies: int
) -> tuple[FloatArray, FloatArray, int]:
    """Predict the states of motion; constants behind them stay as they are. Gives x, P and how
    many covariances were repaired."""
    M, n = motion.B.shape
    T, size = len(x), x.shape[-1]
    if copies == 1 and size == n:
        x, P, repaired = imm_kernels.predict(x, P, motion.F, motion.Q, motion.B)
        return x, P, int(np.count_nonzero(repaired))
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
    return x1.reshape(x.shape), P1.reshape(P.shape), int(np.count_nonzero(repaired))
