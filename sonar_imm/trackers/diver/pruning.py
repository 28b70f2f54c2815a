# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""End of tracks: by existence or misses, invalid numbers, duplicates, or the track limit.

With joint association, the probability of existence determines the status of a track. Otherwise
the hits and misses of `estimation.association.Tracks` determine it.
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
from ...measurements import nanoseconds, NOBODY
from . import links, names
from .config import DiverConfig
from .known import Feature, Known, track_positions
from .models import ModelSet
from .pairing import CONFIRM_EXISTENCE
from .scan import Group, Scan

END_EXISTENCE = 0.002
"""Existence, or target probability, below which a track ends."""

FEATURES = {
    'near_to': Feature(0, kind=np.int64),
    'near_for': Feature(0, kind=np.int64),
    'least_existence': Feature(END_EXISTENCE),
}
"""near_to: ID of the older track nearby, 0 for none; near_for: number of scans near it.

least_existence: existence below which the track ends: at most that at its start. Where false fixes
are dense, or scans frequent, a target starts with less than `END_EXISTENCE`.
"""

CONFIRM_EVIDENCE = 2.5
"""Minimum sum of detection probabilities of a confirmed track."""

PUBLISH_EXISTENCE = 0.5
"""Existence above which a track is published."""

NEAR_TENTATIVE, SCANS_TENTATIVE = 4.0, 2
"""Squared Mahalanobis distance to an older track, and number of consecutive scans, after which a
tentative track ends."""

NEAR_CONFIRMED, SCANS_CONFIRMED = 0.3, 8
"""The same limits for a confirmed track near an older confirmed track. At a low detection
probability, `names.scans_to_merge` raises the number of scans."""

StatusArray = NDArray[np.uint8]


def track_rules(config: DiverConfig) -> TrackRules:
    """Return the rules of tracks that `config` states."""
    return TrackRules(
        config.confirm_hits,
        config.confirm_window,
        config.delete_misses,
        nanoseconds(config.max_coast),
    )


def pruning_stage(
    models: ModelSet, config: DiverConfig, rules: TrackRules, covered: bool
) -> Callable[[Known, Scan], Known]:
    """Return the stage that ends tracks. covered: whether a coverage is configured."""

    def prune(known: Known, scan: Scan) -> Known:
        alive = known.is_finite()
        known = known.add_counts(broken=int((~alive).sum()))
        hit, looked = known['nis_dof'] > 0, scan.complete & (known['target_id'] == NOBODY)
        if scan.are_tags:
            # Tags ping in turn: one that was heard since the last ping of this one is not missed,
            # and the ping of a new one is no miss of any.
            heard = known.life.last_hit_ns
            looked = looked & (hit | (heard < (heard[hit].min() if hit.any() else 0)))
        # A rejected fix counts as a miss, so a track does not coast while fixes arrive near it.
        rejected = known['rejected'][:, 0] == known.stamp_ns
        if covered:
            looked, rejected, known = _weigh_misses(known, hit, looked, rejected)
        # Rows that take a fix as an outlier, or as the first of a burst, are not missed.
        for group in scan.fixes:
            if group.association is not None:
                looked = looked & ~(group.association.taken & ~hit)
        looked = looked | rejected
        by_existence = np.isfinite(known['existence'])
        life, kept = known.life.scan(hit, known.stamp_ns, rules, looked=looked & ~by_existence)
        if models.families is not None and any(group.is_complete for group in scan.fixes):
            doubted, over = confirmation_masks(known, config, scan.fixes)
            status = np.where(doubted[kept], TENTATIVE, life.status).astype(np.uint8)
            life, alive = evolve(life, status=status), alive & ~over
        if by_existence.any():
            update = update_status(known, hit, looked, models, scan.fixes)
            status = np.where(by_existence[kept], update.status[kept], life.status)
            life = evolve(life, status=status)
            known = known.with_columns(near_to=update.near_to, near_for=update.near_for)
            alive = alive & (update.alive | ~by_existence)
        if not alive.all():
            life, kept = life.only(alive[kept]), kept & alive
        return _limit_tracks(known, kept, life, config)

    return prune


def _weigh_misses(
    known: Known, hit: BoolArray, looked: BoolArray, rejected: BoolArray
) -> tuple[BoolArray, BoolArray, Known]:
    """Return which tracks (T,) count a miss, which count a rejected fix, and the new state.

    A miss counts at a `miss_weight` of 1, a rejected fix at 0.5 (`coverage`).
    """
    looks, named = known['miss_weight'], known['target_id'] != NOBODY
    looked, rejected = looked & (looks > 1.0 - 1e-9), rejected & ((looks > 0.5) | named)
    return (
        looked,
        rejected,
        known.with_columns(miss_weight=np.where(hit | looked | rejected, 0.0, looks)),
    )


def _limit_tracks(known: Known, kept: BoolArray, life: Tracks, config: DiverConfig) -> Known:
    """Select the `kept` (T,) tracks, with at most `max_tracks` confirmed ones."""
    confirmed = np.flatnonzero(life.status != TENTATIVE)
    if len(confirmed) > config.max_tracks:
        score = np.where(known['target_id'] == NOBODY, known['score'], np.inf)[kept][confirmed]
        best = np.argsort(-score, kind='stable')[: config.max_tracks]
        room = life.status == TENTATIVE
        room[confirmed[best]] = True
        kept = kept.copy()
        kept[kept] = room
        life = life.only(room)
    return known.select(kept, life)


def confirmation_masks(
    known: Known, config: DiverConfig, groups: Sequence[Group]
) -> tuple[BoolArray, BoolArray]:
    """Return which tentative tracks (T,) must not be confirmed, and which end.

    Rows with large covariances accept distant fixes, so hits alone do not confirm a track. The
    score is compared with the odds of a new target against a false fix.
    """
    new = max(group.new_targets for group in groups if group.is_complete)
    start = math.log(new / config.usual_clutter)
    odds, least = known['score'] + start, min(_log_odds(END_EXISTENCE), start)
    tentative = (known.life.status == TENTATIVE) & (known['target_id'] == NOBODY)
    asked = tentative & np.isnan(known['existence'])
    return asked & (odds < _log_odds(CONFIRM_EXISTENCE)), asked & (odds < least)


def _log_odds(probability: float) -> float:
    """Return ln p / (1 - p)."""
    return math.log(probability) - math.log1p(-probability)


class StatusUpdate(NamedTuple):
    """New status of T tracks with existence."""

    status: StatusArray
    alive: BoolArray
    """(T,) False for tracks that end."""
    near_to: IntArray
    """(T,) see `FEATURES`."""
    near_for: IntArray
    """(T,) see `FEATURES`."""


def update_status(
    known: Known, hit: BoolArray, looked: BoolArray, models: ModelSet, groups: Sequence[Group]
) -> StatusUpdate:
    """Update the status of tracks by existence and by the distance to older tracks.

    :param hit: (T,) True if a detection is more probable than a miss.
    :param looked: (T,) True if a detection was possible.
    """
    was, existence = known.life.status != TENTATIVE, known['existence']
    likely = links.existence_beside_bursts(known) > CONFIRM_EXISTENCE
    confirmed = was | likely & (known['evidence'] >= CONFIRM_EVIDENCE)
    # Without the track that a burst excludes, the burst would take the fixes of a new target.
    linked = np.isin(known.life.track_id, known.rows.key['link'])
    alive = linked | ~(existence < known['least_existence'])
    status = track_status(known.life.status, confirmed, hit, looked)
    if not looked.any():
        return StatusUpdate(status, alive, known['near_to'], known['near_for'])
    nameless = [group for group in groups if group.target_id is None]
    if len(known) < 2:
        return StatusUpdate(
            status, alive, np.zeros(len(known), np.int64), np.zeros(len(known), np.int64)
        )
    near_to, near_for = count_near_scans(known, was, *track_positions(known, models), nameless)
    before = np.where(near_to == known['near_to'], known['near_for'], 0)
    near_for = np.where(looked, near_for, before)
    scans = [names.scans_to_merge(group.config.detection_probability) for group in nameless]
    patience = np.where(was, max([SCANS_CONFIRMED, *scans]), SCANS_TENTATIVE)
    return StatusUpdate(status, alive & (near_for < patience), near_to, near_for)


def track_status(
    before: StatusArray, confirmed: BoolArray, hit: BoolArray, looked: BoolArray
) -> StatusArray:
    """Return the status (T,) of tracks. confirmed: (T,) True for confirmed tracks."""
    seen = np.where(looked, COASTING, before)
    seen = np.where(hit | (seen == TENTATIVE), CONFIRMED, seen)
    return np.where(confirmed, seen, TENTATIVE).astype(np.uint8)


def count_near_scans(
    known: Known,
    confirmed: BoolArray,
    mean: FloatArray,
    covariance: FloatArray,
    groups: Sequence[Group],
) -> tuple[IntArray, IntArray]:
    """Return the ID of the older track near each track (T,), 0 for none, and the number of scans
    (T,).

    Tracks with an ID are excluded. Two tracks detected in the same scan are two targets.

    :param mean: (T, 2) positions.
    :param covariance: (T, 2, 2) position covariances.
    """
    ids, free = known.life.track_id.astype(np.int64), known['target_id'] == NOBODY
    partner, distance = jipda.nearest_older(mean, covariance, ids, free, confirmed)
    near = distance < np.where(confirmed, NEAR_CONFIRMED, NEAR_TENTATIVE)
    for track in np.flatnonzero(near):
        pair = [track, partner[track]]
        near[track] = not any(
            _have_two_fixes(each, mean[pair], covariance[pair]) for each in groups
        )
    near_to = np.where(near, ids[partner], 0)
    before = np.where(near_to == known['near_to'], known['near_for'], 0)
    return near_to, np.where(near, before + 1, 0)


def _have_two_fixes(group: Group, mean: FloatArray, covariance: FloatArray) -> bool:
    """Return whether a scan has two separate fixes near two tracks, mean (2, 2), covariance (2, 2,
    2).

    Fixes closer than `NEAR_CONFIRMED` count as one target detected twice.
    """
    near = names.fixes_near(group, mean, covariance)
    z, R = group.z[near], group.R[near]
    distance = names.mahalanobis_squared(z[:, None] - z[None], R[:, None] + R[None])
    return bool((distance >= NEAR_CONFIRMED).any())
