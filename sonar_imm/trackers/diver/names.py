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

"""Tracks whose name is known, and what to do when a diver is also seen without one.

A named track takes its part of the fixes that have no name, so that a
diver with a transponder on a sonar is one track. A second track can stand beside it all the same:
the sonar may have seen the diver before the transponder was heard. Two divers that swim together
are seen together, now and then at least; a single diver never is. So a nameless track that stays
beside a named one, for so many scans that two divers would have been seen together once but for a
probability of `MISTAKEN`, is the same diver: the confirmed or older of the two goes on, with the
name.

A name lasts as long as something says it: after `max_coast` without a fix of its own a track that
still is seen goes on without its name.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
import math

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray
from ...estimation.association import gate_threshold, TrackStatus
from ...measurements import NOBODY
from .scan import Positions
from .state import DiverState

BESIDE = 4.0
"""Mahalanobis distance squared within which a nameless track is beside a named one."""

MISTAKEN = 1e-3
"""Probability that two divers side by side are taken for one."""


def patience(detection_probability: float) -> int:
    """Scans after which a track never seen together with the one beside it is the same diver."""
    return math.ceil(math.log(MISTAKEN) / math.log1p(-(detection_probability**2)))


def remembered(now: DiverState, names: Iterable[int], max_coast: float) -> DiverState:
    """With the `names` of this stamp, and without those that nothing has said for `max_coast`."""
    last = dict(now.last_named)
    last.update((name, now.stamp_ns) for name in names)
    tracked = set(now.target_id.tolist())
    last = {
        name: stamp_ns
        for name, stamp_ns in last.items()
        if now.stamp_ns - stamp_ns <= max_coast * 1e9
        and (name in tracked or stamp_ns == now.stamp_ns)
    }
    known = np.isin(now.target_id, np.array(list(last), np.int64))
    target_id = np.where(known, now.target_id, NOBODY)
    return now._replace(last_named=tuple(last.items()), target_id=target_id)


def merged(
    now: DiverState, before: DiverState, fixes: Sequence[Positions], E: FloatArray
) -> DiverState:
    """Without the tracks that are divers with a name once more, and that name where it belongs.

    before: the state before any track of this scan ended; fixes: of this scan; E (M, 2, n): to the
    position.
    """
    seen = [group for group in fixes if group.target_id is None and group.whole]
    nameless, named = (np.flatnonzero((now.target_id == NOBODY) == free) for free in (True, False))
    if not seen or not len(named) or not len(nameless):
        return now
    mean, covariance = now.positions(E)
    apart = mean[nameless][:, None] - mean[named][None]
    distance = squared(apart, covariance[nameless][:, None] + covariance[named][None])
    ids = now.life.track_id.astype(np.int64)
    ago = dict(zip(before.life.track_id.tolist(), zip(before.near_to, before.near_for)))
    limit = max(patience(group.config.detection_probability) for group in seen)
    near_to, near_for = now.near_to.copy(), now.near_for.copy()
    target_id, existence = now.target_id.copy(), now.existence.copy()
    going_on = np.ones(len(ids), bool)
    for row, place in zip(nameless.tolist(), distance.argmin(axis=1).tolist()):
        other = int(named[place])
        if distance[nameless == row, place].min() > BESIDE or not going_on[other]:
            continue
        pair = [row, other]
        if sum(int(near(group, mean[pair], covariance[pair]).sum()) for group in seen) > 1:
            continue
        partner, count = ago.get(int(ids[row]), (0, 0))
        near_to[row], near_for[row] = ids[other], 1 + (count if partner == ids[other] else 0)
        if near_for[row] < limit:
            continue
        stays, goes = (row, other) if _prefer(now, row, other) else (other, row)
        target_id[stays], existence[stays], going_on[goes] = target_id[other], math.nan, False
        near_to[stays] = near_for[stays] = 0
    now = now._replace(
        near_to=near_to, near_for=near_for, target_id=target_id, existence=existence
    )
    return now.only(going_on)


def _prefer(now: DiverState, row: int, other: int) -> bool:
    """Whether of two tracks of one diver the first goes on: confirmed before tentative, then
    older."""
    tentative = now.life.status == TrackStatus.TENTATIVE
    if tentative[row] != tentative[other]:
        return bool(tentative[other])
    return bool(now.life.track_id[row] < now.life.track_id[other])


def near(fixes: Positions, mean: FloatArray, covariance: FloatArray) -> BoolArray:
    """Which fixes (D,) of a scan are near one of two tracks: mean (2, 2), covariance (2, 2,
    2)."""
    apart = fixes.z[:, None] - mean[None]
    distance = squared(apart, covariance[None] + fixes.R[:, None])
    threshold = gate_threshold(fixes.config.gate_probability, 2)
    return np.asarray(distance.min(axis=1) <= threshold)


def squared(apart: FloatArray, S: FloatArray) -> FloatArray:
    """Mahalanobis distances squared (...,) of vectors (..., 2) under covariances (..., 2, 2)."""
    return np.einsum('...a,...a->...', apart, np.linalg.solve(S, apart[..., None])[..., 0])
