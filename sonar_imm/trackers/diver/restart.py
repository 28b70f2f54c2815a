# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Restart of lost tracks after two consecutive rejected fixes that agree.

A rejected fix is stored with the nearest track, or with the track of its ID. If the next rejected
fix fits a track started at the stored fix, the track restarts there and keeps its ID.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import math

import numpy as np

from ...estimation.adaptation import AdaptiveChain
from ...estimation.arrays import BoolArray, FloatArray
from ...estimation.association import TENTATIVE
from ...estimation.rows import Rows
from . import fixes, ways
from .instruments import Layout
from .known import Feature, Known, predict_over, track_outputs, with_velocities_at_fix
from .models import ModelSet
from .scan import Group

FEATURES = {'rejected': Feature(math.nan, (6,))}
"""Stamp, position and covariance (xx, xy, yy) of the last rejected fix of the track; NaN after a
hit."""

LOST = 0.02
"""Probability of consecutive misses below which a track may be lost."""

MISTAKEN = 0.02
"""Maximum expected number of false fixes near a rejected fix for a restart."""

REACH = 13.8
"""Squared Mahalanobis distance within which two fixes are near each other."""


def restart_stage(
    models: ModelSet,
    chain: AdaptiveChain,
    layouts: Callable[[Known], Layout],
    associate: Callable[[Known, Group], Known],
) -> Callable[[Known, Group], Known]:
    """Return the stage that restarts lost tracks and then repeats the association."""

    def restart(known: Known, group: Group) -> Known:
        known, restarted = restart_lost_tracks(known, group, models, chain, layouts(known))
        return associate(known, group) if restarted else known

    return restart


def restart_lost_tracks(
    known: Known, group: Group, models: ModelSet, chain: AdaptiveChain, layout: Layout
) -> tuple[Known, bool]:
    """Restart tracks whose last two rejected fixes agree with each other, if the target can have
    reached the fix.

    :returns: the new state, and whether any track restarted.
    """
    association, seen, rejected = group.association, group.detection, known['rejected']
    assert association is not None and group.pairs is not None
    if not len(known):
        return known, False
    hit, firm = association.hit | association.taken, known.life.status != TENTATIVE
    left = association.beta[firm].sum(axis=0) < 0.5
    if association.is_joint and seen is not None:
        hit = hit | ~seen.is_outside
    if hit.any():
        rejected = rejected.copy()
        rejected[hit] = np.nan
    restarted: dict[int, Rows] = {}
    for track, row in _rejected_fixes(known, group, hit, left, group.pairs.track_log):
        z, R, new = group.z[row], group.R[row], None
        hidden = seen is not None and seen.is_outside[track]
        lost = hidden or _may_be_lost(known, track, group)
        lost = lost and _can_reach(known, track, z, R, group, models)
        if np.isfinite(rejected[track, 0]) and lost:
            new = restarted_track(known, track, rejected[track], row, group, models, chain, layout)
        rejected = rejected.copy()
        if new is None:
            rejected[track] = known.stamp_ns, *z, R[0, 0], R[0, 1], R[1, 1]
        else:
            restarted[track], rejected[track] = new, np.nan
    for track, new in restarted.items():
        known = known.with_rows_of(track, new)
    return known.with_columns(rejected=rejected), bool(restarted)


def _rejected_fixes(
    known: Known, group: Group, hit: BoolArray, left: BoolArray, whole: FloatArray
) -> Iterator[tuple[int, int]]:
    """Yield each track without a hit, with its rejected fix.

    Fixes with an ID belong to the track of the ID. Others belong to the nearest track, if
    confirmed tracks `left` (D,) them.
    """
    if group.target_id is not None:
        own = known['target_id'][:, None] == group.target_id[None]
        for track, row in zip(*np.nonzero(own)):
            if not hit[track]:
                yield int(track), int(row)
        return
    waiting = np.flatnonzero(~hit & (known.life.status != TENTATIVE))
    rows = np.flatnonzero(left)
    if not len(waiting) or not len(rows):
        return
    near = whole[np.ix_(waiting, rows)]
    nearest = near.argmax(axis=0)
    for place, track in enumerate(waiting.tolist()):
        own = np.flatnonzero(nearest == place)
        if len(own):
            yield track, int(rows[own[near[place, own].argmax()]])


def _may_be_lost(known: Known, track: int, group: Group) -> bool:
    """Return whether the number of consecutive misses is improbable for a correct track."""
    if group.target_id is not None or not group.is_complete:
        return True
    missed = 1.0 - group.config.detection_probability
    # Tracks with existence count no misses; one miss is the stored rejected fix.
    before = max(int(known.life.misses[track]), 1)
    return bool(missed ** (before + 1) <= LOST)


def _can_reach(
    known: Known, track: int, z: FloatArray, R: FloatArray, group: Group, models: ModelSet
) -> bool:
    """Return whether the target can have moved to z (2,), R (2, 2) since its last hit."""
    outputs = tuple(part.outputs for part in models.parts)
    mean, _ = track_outputs(known.track_rows(track), outputs)
    passed = (known.stamp_ns - int(known.life.last_hit_ns[track])) * 1e-9
    fastest = ways.fastest_speed(mean[0, ways.velocity_outputs(models)], group.config)
    return bool(np.hypot(*(z - mean[0, :2])) <= fastest * passed + 3.0 * math.sqrt(np.trace(R)))


def restarted_track(
    known: Known,
    track: int,
    rejected: FloatArray,
    row: int,
    group: Group,
    models: ModelSet,
    chain: AdaptiveChain,
    layout: Layout,
) -> Rows | None:
    """Return the rows of a track started at its rejected fix (6,).

    Return None if the fix `row` of the group does not agree, or if two false fixes are likely.
    """
    z, R = group.z[row], group.R[row]
    stamp, px, py, xx, xy, yy = rejected.tolist()
    x, P, mu = models.initial_states(np.array([[px, py]]), np.array([[[xx, xy], [xy, yy]]]))
    with_velocities_at_fix(P, models, group.config)
    x, P = layout.with_new_constants(x, P)
    logw = np.full(x.shape[:2], -math.log(x.shape[1]))
    rows = models.make_rows(x, P, mu, logw, group.number)
    dt = max((known.stamp_ns - stamp) * 1e-9, 0.0)
    learnt = known['learnt'][track : track + 1]
    rows = predict_over(models, chain, rows, learnt, dt, group.config.longest_step)[-1].rows
    whole = fixes.track_log_density(rows, z, R, models, group.number)
    if whole <= fixes.gate_log_density(group)[row]:
        return None
    if group.target_id is None and group.config.max_tracks > 1:
        _, covariance = track_outputs(rows, tuple(part.fix_matrix for part in models.parts))
        area = math.pi * REACH * math.sqrt(np.linalg.det(covariance[0] + R))
        if group.clutter[row] * area > MISTAKEN:
            return None
    return rows
