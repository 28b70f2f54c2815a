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

"""The k best joint hypotheses of a group of fixes, over many scans: `association: kbest`
(`estimation.hypotheses`).

A row of `DiverState` is a track in some of the hypotheses, with the filter as that history of
fixes leaves it; rows of one track have the same identity. So the filter goes over rows as it does
over tracks elsewhere, and what is here says which rows there are. What is published is one
hypothesis of each cluster.

A name is decided like all else. A fix that says whose it is goes to the row that has that name in
a hypothesis, or to one that has none yet, which has it from then on, or it is false, or of a new
diver: of two divers side by side each may be the one who carries the transponder, and later fixes
tell.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math
from typing import NamedTuple

from attrs import evolve
import numpy as np

from ...estimation import hypotheses
from ...estimation.adaptation import AdaptiveChain
from ...estimation.arrays import BoolArray, FloatArray, IntArray
from ...estimation.association import TENTATIVE, TrackRules
from ...estimation.hypotheses import Hypotheses
from ...measurements import NOBODY
from . import coverage, families, jipda
from .config import DiverConfig
from .fix_kernels import expected, finite
from .scan import Positions
from .state import DiverState, Step
from .state_space import Layout, ModelSet

WINDOW = 6
"""Last detections that two rows of a track have in common when they are taken for one, and for
which tracks that competed depend on each other."""

NOBODY_THERE = 1e-4
"""Existence below which a row is left out of its hypotheses."""

CLAIMED = 0.98
"""No track begins at a fix that is another's with more than this."""

TAKEN = 5.0
"""Least log of the odds that a fix with a name is that track's, in sets that do not gate these."""

ROWS_OF_A_TRACK = 4
"""Rows in all, on the average of the tracks there may be: beyond that fewer hypotheses are
kept."""


class Branched(NamedTuple):
    """Rows after they were paired with fixes: the state, not yet updated; the association that
    updates them and says where tracks begin; hypotheses: what holds once they have; first_serial:
    that of the fix before these."""

    state: DiverState
    association: jipda.Association
    hypotheses: Hypotheses
    first_serial: int


def branched(
    now: DiverState,
    fixes: Positions,
    models: ModelSet,
    chain: AdaptiveChain,
    layout: Layout,
    covered: Mapping[str, coverage.Coverage],
) -> Branched:
    """Pair all hypotheses with `fixes`; covered: what is stated of sensors (`coverage`)."""
    config, D = fixes.config, len(fixes.z)
    h, densities = expected(now.x, layout.H), None
    seen = coverage.detectable(covered, fixes.sensor, now, config, fixes.z, fixes.R)
    if models.mixing is not None:
        densities = families.densities(now, h, layout, fixes.z, fixes.R)
        believed = np.isfinite(families.fit(now, fixes, h, layout.H, densities, seen))
        # A track that nothing can be of is lost where two fixes agree that nobody takes.
        hit, left = np.asarray(believed.any(axis=1)), np.asarray(~believed.any(axis=0))
        now, again = families.reacquired(
            now, fixes, hit, left, densities.whole, models, chain, layout, seen
        )
        if again:
            h = expected(now.x, layout.H)
            densities = families.densities(now, h, layout, fixes.z, fixes.R)
            seen = coverage.detectable(covered, fixes.sensor, now, config, fixes.z, fixes.R)
    excluded = np.zeros(len(h), bool)
    if config.named_tracks == 'alone' and fixes.target_id is None:
        excluded = now.target_id != NOBODY
    ratio, p = families.fit(now, fixes, h, layout.H, densities, seen), np.ones(len(h))
    p *= config.detection_probability
    if seen is not None:
        p = np.maximum(seen.tracks, jipda.LEAST_DETECTED)
        ratio = ratio - seen.log_ratio + np.log(seen.fixes)[None] - np.log(p)[:, None]
    ratio = ratio - math.log(fixes.clutter + fixes.births)
    ratio[excluded] = -np.inf
    reserved = np.zeros(ratio.shape, bool)
    if fixes.target_id is not None:
        reserved = now.target_id[:, None] == fixes.target_id[None]
        open_ = (now.target_id == NOBODY)[:, None] & (config.named_tracks == 'share')
        ratio = np.where(reserved | open_, ratio, -np.inf)
        if densities is None:
            ratio = np.where(reserved, np.maximum(ratio, TAKEN), ratio)
    existence = jipda.known_existence(now.existence, now.life.status)
    looked = ~excluded & fixes.whole
    found = hypotheses.paired(
        now.hypotheses,
        now.life.track_id.astype(np.int64),
        ratio,
        np.minimum(existence, 1.0 - 1e-9),
        p,
        np.where(looked, p, 0.0),
        reserved,
        config.hypotheses,
    )
    source, detection = found.source, found.detection
    after = now.at(source, now.life.at(source))
    hit, look = detection >= 0, looked[source]
    if seen is not None and fixes.whole and fixes.target_id is None:
        own = seen._replace(tracks=seen.tracks[source])
        after = coverage.missed(after, own, np.where(look & ~hit, 1.0, 0.0), layout.mask)
    r, p, named = existence[source], p[source], after.target_id != NOBODY
    left = np.where(look & ~named, r * (1.0 - p) / (1.0 - r * p), r)
    target_id, history = after.target_id, after.history.copy()
    if fixes.target_id is not None:
        target_id = np.where(hit, fixes.target_id[detection] if D else NOBODY, target_id)
    history[hit, :-1] = history[hit, 1:]
    history[hit, -1] = now.serial + detection[hit] + 1
    after = jipda.counted(after, fixes, found.claimed)._replace(
        existence=np.where(hit, 1.0, left),
        evidence=after.evidence + hit,
        target_id=target_id,
        history=history,
        serial=now.serial + D,
        hypotheses=found.hypotheses,
    )
    if fixes.target_id is not None:
        held = target_id[:, None] == fixes.target_id[None]
        used = found.used | (found.hypotheses.member @ held)
        found = found._replace(used=used, claimed=found.hypotheses.weight @ used)
    room = max(0, most_tracks(config) - len(np.unique(now.life.track_id)))
    begins = np.flatnonzero(found.claimed < CLAIMED)[:room]
    free = np.zeros(D, bool)
    free[begins] = True
    tracks = np.flatnonzero(hit)
    if densities is not None:
        densities = families.Densities(*(part[source] for part in densities))
    association = jipda.Association(
        tracks,
        detection[tracks],
        h[source],
        after.score,
        free,
        existence=jipda.birth_existence(fixes, np.zeros(D)),
        densities=densities,
        counted=shown_rows(found.hypotheses),
    )
    return Branched(after, association, hypotheses.with_births(found, begins), now.serial)


def begun(now: DiverState, found: Branched) -> DiverState:
    """With the hypotheses of `found`, after the tracks that begin there are the last rows."""
    begins = np.flatnonzero(found.association.free)
    history = now.history.copy()
    if len(begins):
        history[-len(begins) :, -1] = found.first_serial + begins + 1
    return now._replace(history=history, hypotheses=found.hypotheses)


def learnt(
    before: DiverState, now: DiverState, step: Step, models: ModelSet, chain: AdaptiveChain
) -> FloatArray:
    """What the hits of this scan say of the transitions of each row, by the row it came from."""
    old = np.flatnonzero(now.came_from >= 0)
    source, after = now.came_from[old], now.learnt.copy()
    if len(old):
        transition = step.transition
        after[old] = chain.learn(
            before.learnt[source],
            transition if len(transition) == 1 else transition[source],
            models.by_model(before.mu[source]),
            models.by_model(now.mu[old]),
            step.dt,
            np.flatnonzero(now.nis_dof[old] > 0),
        )
    return after


def shown_rows(now: Hypotheses) -> BoolArray:
    """The rows (T,) of the hypotheses that are shown, of several in a cluster the likeliest."""
    rank = np.where(now.shown, now.log_weight + 1e6, now.log_weight)
    order = np.lexsort((-rank, now.cluster))
    _, first = np.unique(now.cluster[order], return_index=True)
    return np.asarray(now.member[order[first]].any(axis=0))


def shown(now: DiverState) -> DiverState:
    """One row of each track that is in the hypotheses shown; existence: see `presence`."""
    return now._replace(existence=presence(now)).only(shown_rows(now.hypotheses))


def decided(now: DiverState) -> DiverState:
    """With the hypotheses that are shown taken for true: for what is paired otherwise."""
    now = now.only(shown_rows(now.hypotheses))
    return now._replace(hypotheses=Hypotheses.none().with_alone(len(now.life)))


def one_past(scans: Sequence[DiverState]) -> list[DiverState]:
    """Successive states with one row of each track: the one from which that of the next state
    comes, of tracks that end there the one that is shown."""
    found: list[DiverState] = []
    later: dict[int, int] = {}
    for now in reversed(scans):
        rows, ids = np.flatnonzero(shown_rows(now.hypotheses)), now.life.track_id
        chosen = dict(zip(ids[rows].tolist(), rows.tolist())) | later
        kept = np.array(sorted(chosen.values()), np.intp)
        alone = Hypotheses.none().with_alone(len(kept))
        single = now.at(kept, now.life.at(kept))
        single = single._replace(existence=presence(now)[kept], hypotheses=alone)
        later = dict(zip(single.life.track_id.tolist(), single.came_from.tolist()))
        later = {track: row for track, row in later.items() if row >= 0}
        found.append(single)
    return found[::-1]


def _of_tracks(now: DiverState, value: FloatArray) -> FloatArray:
    """The expected `value` (T,) of the track of each row, 0 where it is not there."""
    _, which = np.unique(now.life.track_id, return_inverse=True)
    return _summed(which, now.hypotheses.marginal() * value)


def _summed(which: IntArray, share: FloatArray) -> FloatArray:
    """The sum (T,) of the shares (T,) of each kind; bincount of nothing gives integers."""
    return np.asarray(np.bincount(which, share)[which], float)


def presence(now: DiverState) -> FloatArray:
    """The probability (T,) that a diver is where a row is: in all hypotheses that have its track,
    or, where that is more, in all that give its last fix to any track. Who a diver is may stay
    open long after it is sure that there is one."""
    share = now.hypotheses.marginal() * now.existence
    _, last = np.unique(now.history[:, -1:], return_inverse=True)
    there = _summed(last.ravel(), share)
    known = now.history[:, -1:].any(axis=1)
    own = _of_tracks(now, now.existence)
    # Weights that are rounded add up to a little more than 1.
    return np.asarray(np.minimum(np.where(known, np.fmax(there, own), own), 1.0))


def most_tracks(config: DiverConfig) -> int:
    """Tracks there may be, tentative ones and all."""
    return 10 + 5 * config.max_tracks


def pruned(
    now: DiverState, hit: BoolArray, looked: BoolArray, rules: TrackRules, config: DiverConfig
) -> DiverState:
    """End what is over, broken, improbable, or too many; hit, looked (T,) as in `Tracks.scan`."""
    alive = finite(now.x, now.P)
    broken = now.broken + int((~alive).sum())
    by_existence = np.isfinite(now.existence)
    life, kept = now.life.scan(hit, now.stamp_ns, rules, looked=looked & ~by_existence)
    status = now.life.status.copy()
    status[kept] = life.status
    existence, present = _of_tracks(now, now.existence), presence(now)
    was = now.life.status != TENTATIVE
    firm = was | (present > jipda.CONFIRMS) & (now.evidence >= jipda.EVIDENCE)
    judged = jipda.status_of(now.life.status, firm, hit, looked)
    status = np.where(by_existence, judged, status)
    over = (existence < jipda.ENDS) | (now.existence < NOBODY_THERE)
    alive &= kept & ~(by_existence & over)
    alive &= ~_too_many(now, status, existence, config.max_tracks)
    ids = now.life.track_id.astype(np.int64)
    name = np.where(now.target_id == NOBODY, 0, -2 - now.target_id)
    key = np.column_stack([now.history, name])
    most, room = config.hypotheses, ROWS_OF_A_TRACK * most_tracks(config)
    after, rows = hypotheses.settled(now.hypotheses, ids, key, alive, most)
    while most > 1 and int(rows.sum()) > room:
        most //= 2
        after, rows = hypotheses.settled(now.hypotheses, ids, key, alive, most)
    whole = np.zeros((3, len(status)), np.int64)
    whole[:, kept] = np.array([life.age, life.misses, life.last_hit_ns])
    seen = np.zeros((len(status), life.seen.shape[1]), bool)
    seen[kept] = life.seen
    life = evolve(
        life,
        track_id=now.life.track_id[rows],
        status=status[rows].astype(np.uint8),
        age=whole[0, rows],
        seen=seen[rows],
        misses=whole[1, rows],
        last_hit_ns=whole[2, rows],
    )
    return now.rows(rows, life)._replace(hypotheses=after, broken=broken)


def _too_many(now: DiverState, status: np.ndarray, existence: FloatArray, most: int) -> BoolArray:
    """The rows (T,) of confirmed tracks beyond `most`, the least probable ones."""
    firm = status != TENTATIVE
    ids = np.unique(now.life.track_id[firm])
    out = np.zeros(len(status), bool)
    if len(ids) > most:
        rank = {int(track): 0.0 for track in ids}
        named = now.target_id != NOBODY
        for row in np.flatnonzero(firm).tolist():
            rank[int(now.life.track_id[row])] = existence[row] + named[row]
        best = sorted(rank, key=lambda track: (-rank[track], track))[:most]
        out = firm & ~np.isin(now.life.track_id, best)
    return out
