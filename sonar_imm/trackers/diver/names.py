# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Target IDs of tracks, and merging of duplicates of a target with an ID.

A track with an ID also takes fixes without ID, so a diver with a transponder on a sonar is one
track. A second track can exist beside it, for example if the sonar detected the diver before the
first transponder message. Two targets that swim together are sometimes detected together; one
target never is. So if a track without ID stays near a track with ID for `scans_to_merge` scans
without such a detection, both are one target. The confirmed or older track continues with the ID.

A track loses its ID after `max_coast` without a measurement of this ID.
"""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import NamedTuple

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray
from ...estimation.association import gate_threshold, TrackStatus
from ...measurements import NOBODY
from .known import Feature, Known, track_positions
from .models import ModelSet
from .scan import Group, Scan

FEATURES = {'target_id': Feature(NOBODY, kind=np.int64)}
"""target_id: ID of the target, `NOBODY` if unknown."""

BESIDE = 4.0
"""Squared Mahalanobis distance at which a track without ID is near a track with ID."""

MISTAKEN = 1e-3
"""Probability of merging two targets that swim together."""


class LastNamed(NamedTuple):
    """Stamp, ns, of the last measurement of each ID."""

    stamps: dict[int, int] = {}


def scans_to_merge(detection_probability: float) -> int:
    """Return the number of scans without a joint detection after which two tracks are merged."""
    return math.ceil(math.log(MISTAKEN) / math.log1p(-(detection_probability**2)))


def id_times_stage(max_coast: float) -> Callable[[Known, Scan], Known]:
    """Return the stage that updates the ID times and removes IDs older than `max_coast`
    seconds."""

    def update_id_times(known: Known, scan: Scan) -> Known:
        named: LastNamed = known.memory['last_named']
        if not scan.names and not named.stamps:
            return known
        last = {**named.stamps, **dict.fromkeys(scan.names, known.stamp_ns)}
        tracked = set(known['target_id'].tolist())
        last = {
            name: stamp_ns
            for name, stamp_ns in last.items()
            if known.stamp_ns - stamp_ns <= max_coast * 1e9
            and (name in tracked or stamp_ns == known.stamp_ns)
        }
        kept = np.isin(known['target_id'], np.array(list(last), np.int64))
        target_id = np.where(kept, known['target_id'], NOBODY)
        return known.with_columns(target_id=target_id).with_memory(last_named=LastNamed(last))

    return update_id_times


def merge_stage(models: ModelSet) -> Callable[[Known, Scan], Known]:
    """Return the stage that merges duplicates of targets with an ID."""

    def merge(known: Known, scan: Scan) -> Known:
        return (
            merge_duplicates(known, scan, models) if known.memory['last_named'].stamps else known
        )

    return merge


def merge_duplicates(known: Known, scan: Scan, models: ModelSet) -> Known:
    """Merge tracks without ID into the track of the same target with ID."""
    seen = [group for group in scan.fixes if group.target_id is None and group.is_complete]
    target_id = known['target_id'].copy()
    nameless, named = (np.flatnonzero((target_id == NOBODY) == free) for free in (True, False))
    if not seen or not len(named) or not len(nameless):
        return known
    mean, covariance = track_positions(known, models)
    apart = mean[nameless][:, None] - mean[named][None]
    distance = mahalanobis_squared(apart, covariance[nameless][:, None] + covariance[named][None])
    ids, before = known.life.track_id.astype(np.int64), scan.previous
    ago = dict(zip(before.life.track_id.tolist(), zip(before['near_to'], before['near_for'])))
    limit = max(scans_to_merge(group.config.detection_probability) for group in seen)
    near_to, near_for = known['near_to'].copy(), known['near_for'].copy()
    existence, going_on = known['existence'].copy(), np.ones(len(ids), bool)
    for row, place in zip(nameless.tolist(), distance.argmin(axis=1).tolist()):
        other = int(named[place])
        if distance[nameless == row, place].min() > BESIDE or not going_on[other]:
            continue
        pair = [row, other]
        if sum(int(fixes_near(group, mean[pair], covariance[pair]).sum()) for group in seen) > 1:
            continue
        partner, count = ago.get(int(ids[row]), (0, 0))
        near_to[row], near_for[row] = ids[other], 1 + (count if partner == ids[other] else 0)
        if near_for[row] < limit:
            continue
        stays, goes = (row, other) if _is_preferred(known, row, other) else (other, row)
        target_id[stays], existence[stays], going_on[goes] = target_id[other], math.nan, False
        near_to[stays] = near_for[stays] = 0
    columns = {'near_to': near_to, 'near_for': near_for, 'target_id': target_id}
    return known.with_columns(existence=existence, **columns).select(going_on)


def _is_preferred(known: Known, row: int, other: int) -> bool:
    """Return whether the first of two tracks continues: confirmed before tentative, then the older
    one."""
    tentative = known.life.status == TrackStatus.TENTATIVE
    if tentative[row] != tentative[other]:
        return bool(tentative[other])
    return bool(known.life.track_id[row] < known.life.track_id[other])


def fixes_near(group: Group, mean: FloatArray, covariance: FloatArray) -> BoolArray:
    """Return which fixes (D,) are near one of two tracks: mean (2, 2), covariance (2, 2, 2)."""
    apart = group.z[:, None] - mean[None]
    distance = mahalanobis_squared(apart, covariance[None] + group.R[:, None])
    threshold = gate_threshold(group.config.gate_probability, 2)
    return np.asarray(distance.min(axis=1) <= threshold)


def mahalanobis_squared(apart: FloatArray, S: FloatArray) -> FloatArray:
    """Return squared Mahalanobis distances (...,) of vectors (..., 2) under covariances (..., 2,
    2)."""
    return np.einsum('...a,...a->...', apart, np.linalg.solve(S, apart[..., None])[..., 0])
