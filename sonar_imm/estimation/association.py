# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Data association and track management.

A scan gives D detections; T targets are expected. Three steps, each a pure function on arrays:

1. `imm.gate` finds the pairs (target, detection) that may belong together: those whose normalised
   innovation squared lies below a chi-square quantile (`gate_threshold`).
2. `assign` picks, among those pairs, the most likely set in which no target and no detection is
   used twice (global nearest neighbour). The cost of a pair is compared with calling the target
   missed and the detection clutter,

       cost = -ln( P_D N(nu; 0, S) / clutter density ) + ln(1 - P_D),

   and pairs whose cost is not negative stay unassigned. Targets that share no detection do not
   influence each other, so the problem splits into clusters, almost all of them tiny.
   `assign_by_rank` lets some targets choose before others, confirmed ones before tentative ones.
3. `Tracks` counts hits and misses: a tentative track is confirmed by M hits in N scans, a
   confirmed one coasts through misses until it has missed too often or too long. Identities are
   never used again.

Reference: Blackman, Popoli, *Design and Analysis of Modern Tracking Systems* (1999), ch. 6.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum
from functools import lru_cache
import math
from typing import Annotated

from attrs import evolve, frozen
import numpy as np
from numpy.typing import NDArray

from .arrays import BoolArray, FloatArray, IndexArray, IntArray, with_rows
from .imm import pairs_inside

Pair = tuple[int, int, float]
"""A target, a detection, and the cost of taking them together."""

TENTATIVE, CONFIRMED, COASTING = 0, 1, 2
"""The numbers of `TrackStatus`, plain: a scan asks for them often."""


@lru_cache(maxsize=256)
def gate_threshold(probability: float, dimension: int) -> float:
    """Chi-square quantile: the normalised innovation squared of a `dimension`-vector of the target
    itself lies below it with `probability`.

    >>> round(gate_threshold(0.99, 2), 3)
    9.21
    """
    from scipy.special import gammaincinv  # scipy.stats has it too, but takes a second to import

    return 2.0 * float(gammaincinv(dimension / 2.0, probability))


def association_cost(
    log_likelihood: FloatArray, detection_probability: float, clutter_density: float
) -> FloatArray:
    """Cost of each pair, relative to calling the target missed and the detection clutter. Negative
    when the pair is more likely.

    log_likelihood: of the innovations, ``ln N(nu; 0, S)``; clutter_density: false detections (and
    new targets) per unit of the measurement space, > 0; detection_probability: inside (0, 1).
    """
    missed = math.log1p(-detection_probability)
    return missed - math.log(detection_probability) - log_likelihood + math.log(clutter_density)


def assign(
    target: IntArray, detection: IntArray, cost: FloatArray, targets: int, detections: int
) -> IntArray:
    """Choose the pairs with the least total cost, no target and no detection twice.

    target, detection, cost: (pairs,), each pair once; a pair that is not listed is forbidden, and
    one whose cost is not negative is never chosen. Returns (targets,) the detection of each
    target, -1 for none. The same input gives the same choice, ties included.

    >>> import numpy as np
    >>> target, detection = np.array([0, 0, 1]), np.array([0, 1, 0])
    >>> assign(target, detection, np.array([-3.0, -2.5, -4.0]), 2, 2).tolist()
    [1, 0]
    """
    chosen = np.full(targets, -1, np.int64)
    worthwhile = cost < 0.0
    target, detection, cost = target[worthwhile], detection[worthwhile], cost[worthwhile]
    if not (_repeats(target, targets) or _repeats(detection, detections)):
        chosen[target] = detection  # nothing is contested
        return chosen
    for pairs in _clusters(list(zip(target.tolist(), detection.tolist(), cost.tolist()))):
        for t, d in _solve_cluster(pairs):
            chosen[t] = d
    return chosen


def _clusters(pairs: list[Pair]) -> Iterable[list[Pair]]:
    """The pairs that share a target or a detection, directly or by others between them."""
    clusters: dict[int, list[Pair]] = {}
    for pair in pairs:
        t, d = pair[0], -1 - pair[1]
        small, large = sorted((clusters.setdefault(t, []), clusters.setdefault(d, [])), key=len)
        if small is not large:
            large += small
            for its_t, its_d, _ in small:
                clusters[its_t] = clusters[-1 - its_d] = large
            clusters[t] = clusters[d] = large
        large.append(pair)
    return {id(cluster): cluster for cluster in clusters.values()}.values()


def _repeats(numbers: IntArray, count: int) -> bool:
    """Whether any of `numbers`, each below `count`, stands there twice."""
    return bool(np.bincount(numbers, minlength=count).max(initial=0) > 1)


def assign_by_rank(
    target: IntArray, detection: IntArray, cost: FloatArray, rank: IntArray, detections: int
) -> IntArray:
    """`assign` in turns: targets of the lowest rank choose first, others among what is left.

    rank: (T,) of each target; one with a negative rank gets nothing. The rest as in `assign`.
    """
    chosen, free = np.full(len(rank), -1, np.int64), np.ones(detections, np.bool_)
    for turn in sorted(set(rank[rank >= 0].tolist())):
        pairs = (rank == turn)[target] & free[detection]
        found = assign(target[pairs], detection[pairs], cost[pairs], len(rank), detections)
        chosen = np.where(found >= 0, found, chosen)
        free[found[found >= 0]] = False
    return chosen


def assign_fits(
    fit: FloatArray, tentative: BoolArray, detection_probability: float, clutter_density: float
) -> IntArray:
    """The detection (T,) of each target, -1 for none, from a table fit (T, D) of `imm.gate`;
    those that are not `tentative` (T,) choose first. The rest as in `association_cost`."""
    missed = math.log1p(-detection_probability) - math.log(detection_probability)
    chosen, clear = choose(fit, tentative, missed, math.log(clutter_density))
    if clear:
        return chosen
    target, detection = pairs_inside(fit)
    cost = association_cost(fit[target, detection], detection_probability, clutter_density)
    return assign_by_rank(target, detection, cost, tentative.astype(np.int64), fit.shape[1])


def _solve_cluster(pairs: list[Pair]) -> list[tuple[int, int]]:
    """Solve one cluster as a dense table. A cell of cost zero stands for 'not assigned', so a full
    assignment always exists."""
    if len(pairs) == 1:
        return [pairs[0][:2]]
    from scipy.optimize import linear_sum_assignment

    # Plain dictionaries: most clusters hold two pairs, for which numpy.unique is the slowest part.
    rows = {t: i for i, t in enumerate(sorted({t for t, _, _ in pairs}))}
    columns = {d: j for j, d in enumerate(sorted({d for _, d, _ in pairs}))}
    table = np.zeros((len(rows), len(columns)))
    for t, d, cost in pairs:
        table[rows[t], columns[d]] = cost
    targets, detections = list(rows), list(columns)
    return [
        (targets[i], detections[j])
        for i, j in zip(*linear_sum_assignment(table))
        if table[i, j] < 0.0
    ]


class TrackStatus(IntEnum):
    """State of a track. The numbers are those of the column ``track_state``."""

    TENTATIVE = TENTATIVE
    CONFIRMED = CONFIRMED
    COASTING = COASTING


@frozen
class TrackRules:
    """When a track is confirmed and when it ends.

    A tentative track is confirmed by confirm_hits hits in confirm_window scans; its first
    detection counts. It ends as soon as these scans hold too many misses to confirm it. A
    confirmed track ends after delete_misses misses in a row. Any track ends after max_coast_ns
    without a hit.
    """

    confirm_hits: int
    confirm_window: int
    delete_misses: int
    max_coast_ns: int

    def __attrs_post_init__(self) -> None:
        if (
            not 1 <= self.confirm_hits <= self.confirm_window
            or self.delete_misses < 1
            or self.max_coast_ns < 0
        ):
            raise ValueError(
                'track rules need 1 <= confirm_hits <= confirm_window, delete_misses >= 1, '
                'max_coast_ns >= 0'
            )


def new_ids(
    next_id: int, count: int, living: NDArray[np.uint32]
) -> tuple[NDArray[np.uint32], int]:
    """Identities (count,) from `next_id` on, and the next one after them.

    They are unsigned numbers of 32 bits, 0 is none. After the last one, weeks away where every
    ping is full of clutter, they begin with 1 again, without those of the `living` (T,).
    """
    last = int(np.iinfo(np.uint32).max)
    if next_id + count <= last and not (len(living) and living.max() >= next_id):
        return np.arange(next_id, next_id + count, dtype=np.uint32), next_id + count
    ids = (next_id - 1 + np.arange(count + len(living))) % last + 1
    ids = ids[~np.isin(ids, living)][:count]
    return ids.astype(np.uint32), int(ids[-1]) % last + 1 if count else next_id


@frozen(eq=False)
class Tracks:
    """Hits, misses and status of T tracks. An immutable value: `scan` and `born` return the next
    one.

    track_id: (T,) not used again for another target, but for `new_ids`; status: (T,) TrackStatus;
    age: (T,) scans; seen: (T, confirm_window) True for hits, newest last; misses: (T,)
    in a row; last_hit_ns: (T,); next_id: of the next track.
    """

    track_id: Annotated[NDArray[np.uint32], 'T']
    status: Annotated[NDArray[np.uint8], 'T']
    age: Annotated[IntArray, 'T']
    seen: Annotated[BoolArray, 'Tw']
    misses: Annotated[IntArray, 'T']
    last_hit_ns: Annotated[IntArray, 'T']
    next_id: int = 1

    @classmethod
    def none(cls, rules: TrackRules) -> Tracks:
        """No tracks yet."""
        return cls(
            np.empty(0, np.uint32),
            np.empty(0, np.uint8),
            np.empty(0, np.int64),
            np.empty((0, rules.confirm_window), np.bool_),
            np.empty(0, np.int64),
            np.empty(0, np.int64),
        )

    def __len__(self) -> int:
        return len(self.track_id)

    def born(self, count: int, stamp_ns: int, rules: TrackRules) -> Tracks:
        """Append `count` tracks, each with its first hit."""
        track_id, next_id = new_ids(self.next_id, count, self.track_id)
        seen = with_rows(_window(self.seen, rules.confirm_window), count, False)
        seen[len(self) :, -1] = True
        return Tracks(
            with_rows(self.track_id, count, track_id),
            with_rows(self.status, count, CONFIRMED if rules.confirm_hits == 1 else TENTATIVE),
            with_rows(self.age, count, 1),
            seen,
            with_rows(self.misses, count, 0),
            with_rows(self.last_hit_ns, count, stamp_ns),
            next_id,
        )

    def renamed(self, chosen: BoolArray) -> Tracks:
        """Give the `chosen` tracks (T,) new IDs."""
        count = int(chosen.sum())
        if not count:
            return self
        new, next_id = new_ids(self.next_id, count, self.track_id)
        track_id = self.track_id.copy()
        track_id[chosen] = new
        return evolve(self, track_id=track_id, next_id=next_id)

    def resumed(self, track_id: int, stamp_ns: int, rules: TrackRules) -> Tracks:
        """Append a confirmed track that ended before, without a hit; it may coast from now on."""
        return Tracks(
            with_rows(self.track_id, 1, track_id),
            with_rows(self.status, 1, COASTING),
            with_rows(self.age, 1, 0),
            with_rows(_window(self.seen, rules.confirm_window), 1, False),
            with_rows(self.misses, 1, 0),
            with_rows(self.last_hit_ns, 1, stamp_ns),
            self.next_id,
        )

    def scan(
        self, hit: BoolArray, stamp_ns: int, rules: TrackRules, *, looked: BoolArray | None = None
    ) -> tuple[Tracks, BoolArray]:
        """Take in one scan. `hit` (T,) says which tracks got a detection, `looked` (T,) which
        could have got one (all by default). A track outside the view is neither hit nor missed.

        Returns the tracks that live on and the mask ``kept`` (T,) of those, to select the states
        that the caller keeps beside them.
        """
        there = np.ones(len(self), np.bool_) if looked is None else looked | hit
        seen = _window(self.seen, rules.confirm_window)
        newest = np.concatenate([seen[:, 1:], hit[:, None]], axis=1)
        seen = np.where(there[:, None], newest, seen)
        hits, age = seen.sum(axis=1), self.age + there
        misses = np.where(hit, 0, self.misses + there)
        last_hit_ns = np.where(hit, stamp_ns, self.last_hit_ns)
        firm = (self.status != TENTATIVE) | (hits >= rules.confirm_hits)
        now = np.where(hit, CONFIRMED, np.where(there, COASTING, self.status))
        status = np.where(firm, now, TENTATIVE).astype(np.uint8)
        too_few = np.minimum(age, rules.confirm_window) - hits
        ended = np.where(
            firm,
            misses >= rules.delete_misses,
            too_few > rules.confirm_window - rules.confirm_hits,
        )
        kept = ~ended & (stamp_ns - last_hit_ns <= rules.max_coast_ns)
        after = Tracks(self.track_id, status, age, seen, misses, last_hit_ns, self.next_id)
        return after.only(kept), kept

    def none_left(self) -> Tracks:
        """No tracks any more; identities go on."""
        return self.only(np.zeros(len(self), np.bool_))

    def only(self, kept: BoolArray) -> Tracks:
        """The tracks where `kept` (T,) is True. For callers that end tracks by rules of their
        own."""
        return self if kept.all() else self.at(np.flatnonzero(kept))

    def at(self, rows: IndexArray) -> Tracks:
        """The tracks of those numbers, each as often as it is named."""
        return evolve(
            self,
            track_id=self.track_id[rows],
            status=self.status[rows],
            age=self.age[rows],
            seen=self.seen[rows],
            misses=self.misses[rows],
            last_hit_ns=self.last_hit_ns[rows],
        )


def _window(seen: BoolArray, length: int) -> BoolArray:
    """The newest `length` columns; the rules may change while tracks live."""
    if seen.shape[1] == length:
        return seen
    missing = max(length - seen.shape[1], 0)
    return np.pad(seen[:, seen.shape[1] - length + missing :], ((0, 0), (missing, 0)))


def choose(
    fit: FloatArray, tentative: BoolArray, missed: float, log_clutter: float
) -> tuple[IntArray, bool]:
    """`assign_by_rank` where no pair competes with another: the detection (T,) of each
    target, -1 for none, and whether that is all there is to say.

    fit (T, D): of `imm.gate`; confirmed targets choose before those that are `tentative` (T,);
    missed: ln (1 - P_D) / P_D. False where a target could take two detections, or a detection
    could go to two targets of the same rank: then the choice has to be weighed.
    """
    T, D = fit.shape
    chosen, free = np.full(T, -1, np.int64), np.ones(D, np.bool_)
    worthwhile = (fit > -np.inf) & (missed - fit + log_clutter < 0.0)
    for turn in (False, True):
        open_ = worthwhile & (tentative == turn)[:, None] & free
        if (open_.sum(axis=0) > 1).any() or (open_.sum(axis=1) > 1).any():
            return chosen, False
        t, d = np.nonzero(open_)
        chosen[t], free[d] = d, False
    return chosen, True
