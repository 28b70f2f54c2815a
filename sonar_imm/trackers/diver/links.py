# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""Links in scans of several targets: a burst row and the track that its fix begins.

The fixes of a burst are those of the track, off by an offset, or those of another target. So a
burst row excludes the track that its first fix began, its *link* (`estimation.linked_rows`). The
existence of that track is conditional: it holds if the row does not.

Source: docs/diver.md, 'Bursts'.
"""

from __future__ import annotations

from collections.abc import Mapping
import math

from attrs import evolve
import numpy as np

from ...estimation.arrays import BoolArray, FloatArray, IntArray
from ...estimation.association import TENTATIVE
from ...estimation.rows import ROW_LOST
from ...measurements import NOBODY
from .bursts import end_rows, LONGEST_BURST, PLAIN_LOST
from .known import Known
from .pairs import Association, OPEN, Ways
from .scan import Group, Scan
from .ways import is_alone

MISSED, DIRECT_FIXES = 0.02, 10
"""Scans of several targets: share of a miss, and number of fixes before, for a burst to begin."""

OPEN_ODDS, OPEN_WEIGHT = 1e-3, 2e-4
"""Scans of several targets: odds to a miss, and weight, of a burst that begins."""

CLAIM = 0.3
"""Probability above which a tentative track has the fix of a burst."""


def openers(known: Known, association: Association) -> BoolArray:
    """Return the tracks (T,) on which a burst may begin in a scan of several targets."""
    rows = known.rows
    taken = np.zeros(len(known), np.int64)
    np.maximum.at(taken, rows.target, rows.key['taken'])
    missed = association.missed > MISSED * np.maximum(association.exists, 1e-300)
    firm = (known.life.status != TENTATIVE) & (known['target_id'] == NOBODY)
    return np.asarray(firm & missed & (taken >= DIRECT_FIXES))


def weights_of_ways(
    known: Known, group: Group, ways: Ways, logw: FloatArray, association: Association
) -> FloatArray:
    """Return the log weights (E,) of ways, with those that leave no row at minus infinity."""
    if is_alone(group):
        return np.where(logw > math.log(ROW_LOST), logw, -np.inf)
    track = known.rows.target[ways.row]
    exists = np.maximum(association.exists, 1e-300)[track]
    missed = np.maximum(association.missed[track] / exists, 1e-300)
    begins = (np.exp(logw) > OPEN_ODDS * missed) & (exists * np.exp(logw) > OPEN_WEIGHT)
    tentative = known.life.status == TENTATIVE
    claims = (association.beta * tentative[:, None]).max(axis=0, initial=0.0)
    linked = association.free | (claims > CLAIM)
    kept = np.where(ways.way == OPEN, begins & linked[ways.fix], logw > PLAIN_LOST)
    return np.where(kept, logw, -np.inf)


def links_of_fixes(known: Known, group: Group) -> IntArray:
    """Return the link (D,) of a burst that begins with each fix: the track which the fix begins or
    which claims it; a number below -1 stands for a track that is not begun yet."""
    association = group.association
    if is_alone(group) or association is None:
        return np.zeros(len(group.z), np.int64)
    marks = birth_marks(group)
    tentative = np.flatnonzero(known.life.status == TENTATIVE)
    if not len(tentative):
        return marks
    claims = association.beta[tentative]
    ids = known.life.track_id[tentative].astype(np.int64)[claims.argmax(axis=0)]
    return np.where(association.free, marks, ids)


def birth_marks(group: Group) -> IntArray:
    """Return a number (D,) below -1 for the track that each fix may begin."""
    return -2 - np.arange(len(group.z)) - group.number * 10**6


def resolve_links(known: Known, begun: Mapping[int, int]) -> Known:
    """Link rows to the tracks that have begun: IDs by `birth_marks`. Rows without one end."""
    rows = known.rows
    waiting = np.flatnonzero(rows.key['link'] < -1)
    if not len(waiting):
        return known
    link = rows.key['link'].copy()
    link[waiting] = [begun.get(each, 0) for each in link[waiting].tolist()]
    ended = np.zeros(len(rows), np.bool_)
    ended[waiting] = link[waiting] == 0
    return known.replace(rows=end_rows(rows.replace(key={**rows.key, 'link': link}), ended))


def update_links(known: Known, _: Scan) -> Known:
    """End rows whose linked track is confirmed or has ended, and rows of long bursts.

    A row without its link would take the fixes of a target that appears where the burst is. A
    stage of the tracker.
    """
    rows = known.rows
    if not rows.tail or not (rows.key['link'] != 0).any():
        return known
    track_id = known.life.track_id
    wrong = np.isin(rows.key['link'], track_id[known.life.status > TENTATIVE])
    if wrong.any():
        kept = np.where(wrong, -np.inf, rows.logw)
        left = rows.log_sum(kept)[rows.target]
        # A row stays where it is the last.
        stays = np.isfinite(left)
        kept = np.where(stays, kept - np.where(stays, left, 0.0), rows.logw)
        some = np.flatnonzero(np.isfinite(kept))
        rows = evolve(rows.replace(logw=kept).select(some), parent=rows.parent[some])
    link = rows.key['link']
    over = (link > 0) & ~np.isin(link, track_id)
    over |= (link != 0) & (rows.key['fixes'] >= np.minimum(LONGEST_BURST, rows.key['taken']))
    return known.replace(rows=end_rows(rows, over))


def existence_beside_bursts(known: Known) -> FloatArray:
    """Return the existence (T,) of tracks, with the weights of the rows that exclude them."""
    existence, rows = known['existence'], known.rows
    linked = np.flatnonzero(rows.key['link'] > 0)
    if not len(linked):
        return existence
    out = existence.copy()
    owner = existence[rows.target[linked]] * rows.weight[linked]
    for row, weight in zip(linked.tolist(), owner.tolist()):
        out[known.life.track_id == rows.key['link'][row]] *= 1.0 - weight
    return out
