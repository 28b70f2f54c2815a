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

"""Which tracks end: by their existence or their misses, by broken numbers, because another track
is the same diver, or because there are too many.

What the hits and misses of `estimation.association.Tracks` are to a hard choice, the probability
of existence is where all pairings are weighed: it says when a track is confirmed, published and
ended.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import math
from typing import NamedTuple

from attrs import evolve
import numpy as np
from numpy.typing import NDArray

from ...estimation import jipda
from ...estimation.arrays import BoolArray, FloatArray, IntArray
from ...estimation.association import COASTING, CONFIRMED, TENTATIVE, TrackRules, Tracks
from ...measurements import NOBODY
from . import names
from .config import DiverConfig
from .fixes import CONFIRMS
from .known import Feature, Known, places
from .models import ModelSet
from .scan import Group, Scan

FEATURES = {'near_to': Feature(0, kind=np.int64), 'near_for': Feature(0, kind=np.int64)}
"""The older track that a track is near, 0 for none, and for how many scans."""

EVIDENCE = 2.5
"""Sum of the probabilities of its detections that a confirmed track has seen."""

PUBLISHES = 0.5
"""Existence above which a track is published."""

ENDS = 0.002
"""Existence, or probability that a track is a diver, below which it ends."""

NEAR_TENTATIVE, SCANS_TENTATIVE = 4.0, 2
"""A tentative track ends when it is nearer than this (Mahalanobis distance squared) to an older
one in so many scans in a row."""

NEAR_CONFIRMED, SCANS_CONFIRMED = 0.3, 8
"""The same of a confirmed track and an older confirmed one: two tracks on one diver. There may be
more scans where two divers are seldom detected both, see `names.patience`."""

StatusArray = NDArray[np.uint8]


def forgetting(
    models: ModelSet, config: DiverConfig, rules: TrackRules, covered: bool
) -> Callable[[Known, Scan], Known]:
    """Return the stage that ends the tracks that are over, broken, there twice, or too many;
    covered: whether it is stated where a sensor sees."""

    def forget(known: Known, scan: Scan) -> Known:
        alive = known.finite()
        known = known.counted(broken=int((~alive).sum()))
        hit, looked = known['nis_dof'] > 0, scan.complete & (known['target_id'] == NOBODY)
        # Nobody coasts while there are fixes that may be his own.
        refused = known['refused'][:, 0] == known.stamp_ns
        if covered:
            looked, refused, known = _by_looks(known, hit, looked, refused)
        looked = looked | refused
        by_existence = np.isfinite(known['existence'])
        life, kept = known.life.scan(hit, known.stamp_ns, rules, looked=looked & ~by_existence)
        if models.families is not None and any(group.whole for group in scan.fixes):
            doubted, over = doubtful(known, config)
            status = np.where(doubted[kept], TENTATIVE, life.status).astype(np.uint8)
            life, alive = evolve(life, status=status), alive & ~over
        if by_existence.any():
            judged = judge(known, hit, looked, models, scan.fixes)
            status = np.where(by_existence[kept], judged.status[kept], life.status)
            life = evolve(life, status=status)
            known = known.put(near_to=judged.near_to, near_for=judged.near_for)
            alive = alive & (judged.alive | ~by_existence)
        if not alive.all():
            life, kept = life.only(alive[kept]), kept & alive
        return _within_room(known, kept, life, config)

    return forget


def _by_looks(
    known: Known, hit: BoolArray, looked: BoolArray, refused: BoolArray
) -> tuple[BoolArray, BoolArray, Known]:
    """Return which tracks were looked at for a whole miss, which refused a fix for half of one,
    and the tracks with what is left to count (`coverage`)."""
    looks, named = known['looks'], known['target_id'] != NOBODY
    looked, refused = looked & (looks > 1.0 - 1e-9), refused & ((looks > 0.5) | named)
    return looked, refused, known.put(looks=np.where(hit | looked | refused, 0.0, looks))


def _within_room(known: Known, kept: BoolArray, life: Tracks, config: DiverConfig) -> Known:
    """Return the tracks that are `kept` (T,), without the confirmed ones that are too many."""
    confirmed = np.flatnonzero(life.status != TENTATIVE)
    if len(confirmed) > config.max_tracks:
        score = np.where(known['target_id'] == NOBODY, known['score'], np.inf)[kept][confirmed]
        best = np.argsort(-score, kind='stable')[: config.max_tracks]
        room = life.status == TENTATIVE
        room[confirmed[best]] = True
        kept = kept.copy()
        kept[kept] = room
        life = life.only(room)
    return known.only(kept, life)


def doubtful(known: Known, config: DiverConfig) -> tuple[BoolArray, BoolArray]:
    """Return which tentative tracks (T,) explain their fixes no better than clutter does, so that
    their hits do not confirm them, and which so badly that they end.

    A row with large covariances takes what lies far away, so that hits alone mean little. The odds
    of a track are those of a new diver against a false fix, and what its fixes made of them.
    """
    odds = known['score'] + math.log(config.birth_density / config.usual_clutter)
    tentative = (known.life.status == TENTATIVE) & (known['target_id'] == NOBODY)
    asked = tentative & np.isnan(known['existence'])
    return asked & (odds < _log_odds(CONFIRMS)), asked & (odds < _log_odds(ENDS))


def _log_odds(probability: float) -> float:
    return math.log(probability) - math.log1p(-probability)


class Judged(NamedTuple):
    """What becomes of tracks (T,) that live by their existence: status; alive; near_to and
    near_for as in `FEATURES`."""

    status: StatusArray
    alive: BoolArray
    near_to: IntArray
    near_for: IntArray


def judge(
    known: Known, hit: BoolArray, looked: BoolArray, models: ModelSet, groups: Sequence[Group]
) -> Judged:
    """Judge tracks by their existence and by how near they are to older ones.

    hit (T,): a detection is more probable than a miss; looked (T,): whether one would have been
    seen.
    """
    was, existence = known.life.status != TENTATIVE, known['existence']
    confirmed = was | (existence > CONFIRMS) & (known['evidence'] >= EVIDENCE)
    alive = ~(existence < ENDS)
    status = status_of(known.life.status, confirmed, hit, looked)
    if not looked.any():
        return Judged(status, alive, known['near_to'], known['near_for'])
    nameless = [group for group in groups if group.target_id is None]
    if len(known) < 2:
        return Judged(
            status, alive, np.zeros(len(known), np.int64), np.zeros(len(known), np.int64)
        )
    near_to, near_for = coalescence(known, was, *places(known, models), nameless)
    before = np.where(near_to == known['near_to'], known['near_for'], 0)
    near_for = np.where(looked, near_for, before)
    scans = [names.patience(group.config.detection_probability) for group in nameless]
    patience = np.where(was, max([SCANS_CONFIRMED, *scans]), SCANS_TENTATIVE)
    return Judged(status, alive & (near_for < patience), near_to, near_for)


def status_of(
    before: StatusArray, confirmed: BoolArray, hit: BoolArray, looked: BoolArray
) -> StatusArray:
    """Return the status (T,) of tracks, of which some are `confirmed`."""
    seen = np.where(looked, COASTING, before)
    seen = np.where(hit | (seen == TENTATIVE), CONFIRMED, seen)
    return np.where(confirmed, seen, TENTATIVE).astype(np.uint8)


def coalescence(
    known: Known,
    confirmed: BoolArray,
    mean: FloatArray,
    covariance: FloatArray,
    groups: Sequence[Group],
) -> tuple[IntArray, IntArray]:
    """Return the older track that each one is near (T,), 0 for none, and for how many scans (T,).

    mean (T, 2) and covariance (T, 2, 2) of the positions. Named tracks take no part. Tracks that
    are seen in the same scan are two divers, however near they are.
    """
    ids, free = known.life.track_id.astype(np.int64), known['target_id'] == NOBODY
    partner, distance = jipda.nearest_older(mean, covariance, ids, free, confirmed)
    near = distance < np.where(confirmed, NEAR_CONFIRMED, NEAR_TENTATIVE)
    for track in np.flatnonzero(near):
        pair = [track, partner[track]]
        near[track] = not any(_both_seen(each, mean[pair], covariance[pair]) for each in groups)
    near_to = np.where(near, ids[partner], 0)
    before = np.where(near_to == known['near_to'], known['near_for'], 0)
    return near_to, np.where(near, before + 1, 0)


def _both_seen(group: Group, mean: FloatArray, covariance: FloatArray) -> bool:
    """Return whether a scan has two fixes near two tracks, mean (2, 2) and covariance (2, 2, 2).
    Two that are as near to each other as tracks of one diver are one that came twice."""
    near = names.near(group, mean, covariance)
    z, R = group.z[near], group.R[near]
    distance = names.squared(z[:, None] - z[None], R[:, None] + R[None])
    return bool((distance >= NEAR_CONFIRMED).any())
