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

"""Lost tracks: two refused fixes in a row that agree with each other begin a track anew, under its
own identity.

A fix that may have been a track's own and was not believed is remembered. One that agrees with it,
as the next fix of a track that began at the first would, begins the track anew.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
import math

import numpy as np

from ...estimation.adaptation import AdaptiveChain
from ...estimation.arrays import BoolArray, FloatArray
from ...estimation.association import TENTATIVE
from ...estimation.rows import Rows
from . import fixes
from .births import with_velocities_at_fix
from .instruments import Layout
from .known import crossed, Feature, Known, outputs
from .models import ModelSet
from .scan import Group

FEATURES = {'refused': Feature(math.nan, (6,))}
"""Stamp, position and covariance (xx, xy, yy) of the last fix that may have been the track's own
and was not believed, NaN since it took another."""

LOST = 0.02
"""A track whose misses in a row were less probable than this may be lost."""

MISTAKEN = 0.02
"""A false fix is expected beside another this often, at most, where two refused fixes that agree
begin a track anew."""

REACH = 13.8
"""Mahalanobis distance squared within which a fix is beside another."""


def restarting(
    models: ModelSet,
    chain: AdaptiveChain,
    layouts: Callable[[Known], Layout],
    associate: Callable[[Known, Group], Known],
) -> Callable[[Known, Group], Known]:
    """Return the stage that begins lost tracks anew, and asks whose the fixes are once more where
    it did."""

    def restart(known: Known, group: Group) -> Known:
        known, begun = reacquired(known, group, models, chain, layouts(known))
        return associate(known, group) if begun else known

    return restart


def reacquired(
    known: Known, group: Group, models: ModelSet, chain: AdaptiveChain, layout: Layout
) -> tuple[Known, bool]:
    """Return what becomes of tracks that a group of fixes did not hit, and whether one began anew.
    Whoever is where the sensor does not see may have done anything there."""
    found, seen, refused = group.found, group.seen, known['refused']
    assert found is not None and group.pairs is not None
    if not len(known):
        return known, False
    hit, firm = found.hit, known.life.status != TENTATIVE
    left = found.beta[firm].sum(axis=0) < 0.5
    if found.weighed and seen is not None:
        hit = hit | ~seen.unseen
    if hit.any():
        refused = refused.copy()
        refused[hit] = np.nan
    begun: dict[int, Rows] = {}
    for track, row in _refusals(known, group, hit, left, group.pairs.whole):
        z, R, new = group.z[row], group.R[row], None
        hidden = seen is not None and seen.unseen[track]
        lost = _reaches(known, track, z, group) if hidden else _may_be_lost(known, track, group)
        if np.isfinite(refused[track, 0]) and lost:
            new = _anew(known, track, refused[track], z, R, group, models, chain, layout)
        refused = refused.copy()
        if new is None:
            refused[track] = known.stamp_ns, *z, R[0, 0], R[0, 1], R[1, 1]
        else:
            begun[track], refused[track] = new, np.nan
    for track, new in begun.items():
        known = known.with_rows_of(track, new)
    return known.put(refused=refused), bool(begun)


def _refusals(
    known: Known, group: Group, hit: BoolArray, left: BoolArray, whole: FloatArray
) -> Iterator[tuple[int, int]]:
    """Yield tracks, each with the fix that may have been its own: by the name, or the nearest of
    what confirmed tracks `left`, each to the track it is nearest to."""
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
    """Return whether so many misses in a row are improbable of a track that is where it should
    be."""
    if group.target_id is not None or not group.whole:
        return True
    missed = 1.0 - group.config.detection_probability
    # Who lives by his existence has no count of misses, but refused a fix before.
    before = max(int(known.life.misses[track]), 1)
    return bool(missed ** (before + 1) <= LOST)


def _reaches(known: Known, track: int, z: FloatArray, group: Group) -> bool:
    """Return whether the diver of a track may have come to z (2,) since he was seen."""
    rows = known.rows.take(known.rows_of(track))
    weight = rows.weight_among_themselves()
    x = np.concatenate([block.x[:, :2] for block in rows.blocks], axis=2)
    mean = np.einsum('r,rm,ram->a', weight, rows.mu, x)
    passed = (known.stamp_ns - int(known.life.last_hit_ns[track])) * 1e-9
    fastest = group.config.speed_mean + 3.0 * group.config.speed_std
    return bool(np.hypot(*(z - mean)) <= fastest * passed)


def _anew(
    known: Known,
    track: int,
    refused: FloatArray,
    z: FloatArray,
    R: FloatArray,
    group: Group,
    models: ModelSet,
    chain: AdaptiveChain,
    layout: Layout,
) -> Rows | None:
    """Return the rows now of the track, had it begun at the fix that it `refused` (6,); None where
    the fix z (2,), R (2, 2) does not agree, or two false fixes may well do."""
    stamp, px, py, xx, xy, yy = refused.tolist()
    x, P, mu = models.new_tracks(np.array([[px, py]]), np.array([[[xx, xy], [xy, yy]]]))
    with_velocities_at_fix(P, models, group.config)
    x, P = layout.widened(x, P)
    rows = models.rows(x, P, mu, np.full(x.shape[:2], -math.log(x.shape[1])))
    dt = max((known.stamp_ns - stamp) * 1e-9, 0.0)
    learnt = known['learnt'][track : track + 1]
    rows = crossed(models, chain, rows, learnt, dt, group.config.longest_step)[-1].rows
    whole = fixes.density(rows, z, R, models)
    if whole <= fixes.bound(group):
        return None
    if group.target_id is None and group.config.max_tracks > 1:
        _, covariance = outputs(rows, tuple(part.seen for part in models.parts))
        area = math.pi * REACH * math.sqrt(np.linalg.det(covariance[0] + R))
        if group.clutter * area > MISTAKEN:
            return None
    return rows
