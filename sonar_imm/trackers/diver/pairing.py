# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""Association of compared fixes with tracks.

- `associate_by_id`: the ID selects the track of a fix; the fix still has to pass the gate.
- `associate_jipda`: exact probabilities of all joint events (`estimation.jipda`), with a
  probability of existence for each track.
- `associate_gnn`: the most likely assignment; hits and misses are counted.

For families, gating uses the predictive density of the mixture instead of a chi-square test. A fix
passes if a detection at this place is more probable than a missed target and a false fix
(`gate_log_density`).

Source: docs/diver.md, 'Association'.
"""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import NamedTuple

import numpy as np

from ...estimation import jipda
from ...estimation.arrays import BoolArray, FloatArray, IntArray
from ...estimation.association import assign_fits, gate_threshold, TENTATIVE
from ...estimation.linked_rows import linked_marginals
from . import links
from .fixes import compare, gate_log_density
from .known import Known
from .models import ModelSet
from .pairs import Association, Groups, LEAVE, OPEN, Pairs
from .scan import Group
from .ways import has_ways, is_alone, with_ways

MIN_MODEL_PROBABILITY = {'gnn': 1e-6, 'jipda': 0.01}
"""Minimum probability of a model that opens the gate. A single assignment needs rare models, or
it loses tracks in sharp turns; joint association does not."""

MIN_DETECTION_PROBABILITY = 1e-9
"""Lower bound of the detection probability of a track outside the coverage, because ratios are
divided by it."""

SURELY = 1e3
"""Log density of a pair that is chosen."""

CONFIRM_EXISTENCE = 0.9
"""Existence above which a track can be confirmed."""


def gate_pairs(group: Group, pairs: Pairs) -> BoolArray:
    """Return which pairs (T, D) pass the gate."""
    if pairs.nis is not None:
        threshold = gate_threshold(group.config.gate_probability, 2)
        return np.asarray(pairs.nis <= threshold)
    ratio = 0.0 if group.detection is None else group.detection.log_ratio
    return np.asarray(pairs.track_log + ratio > gate_log_density(group))


def association_stage(models: ModelSet, pairing: str) -> Callable[[Known, Group], Known]:
    """Return the stage that compares and associates fixes: by ID if fixes have IDs, otherwise by
    `pairing`."""
    by_density = {'jipda': associate_jipda, 'gnn': associate_gnn}[pairing]
    min_probability = MIN_MODEL_PROBABILITY[pairing]

    def associate(known: Known, group: Group) -> Known:
        pairs = compared = compare(known, group, models, min_probability)
        several = has_ways(group, models) and not compared.in_parts
        if several:
            pairs = with_ways(known, group, compared, models)
        associate_pairs = by_density if group.target_id is None else associate_by_id
        group.pairs, group.association = pairs, associate_pairs(known, group, pairs)
        if several and not is_alone(group):
            openers = links.openers(known, group.association)
            if openers.any():
                # With the bursts that may begin, which a first pass has found missing fixes for.
                pairs = with_ways(known, group, compared, models, openers)
                if pairs.ways is not None:
                    group.pairs, group.association = pairs, associate_pairs(known, group, pairs)
        return known

    return associate


def associate_by_id(known: Known, group: Group, pairs: Pairs) -> Association:
    """Assign each fix to the track of its ID, if it passes the gate."""
    T, D = pairs.track_log.shape
    own = known['target_id'][:, None] == group.target_id
    good = own & np.isfinite(pairs.track_log)
    if pairs.nis is None:
        good &= (pairs.track_log > gate_log_density(group)) | (pairs.direct < 1.0)
    fix = np.where(good.any(axis=1), good.argmax(axis=1) if D else -1, -1)
    free = ~own.any(axis=0)
    hard = _hard_association(fix, D)
    fix = _direct_hits(fix, pairs)
    return Association(*hard, fix, free, None, known['score'], direct=pairs.direct)


def _held(pairs: Pairs) -> BoolArray:
    """Return which tracks (T,) hold the only fix: their rows weigh themselves that it is an
    outlier."""
    if pairs.ways is None:
        return np.zeros(len(pairs.track_log), np.bool_)
    return np.asarray(pairs.ways.direct[:, 0] < 1.0)


def _direct_hits(fix: IntArray, pairs: Pairs) -> IntArray:
    """Return `fix` (T,) with -1 for fixes that are rather outliers or begin an offset."""
    if pairs.ways is None or not pairs.ways.direct.shape[1]:
        return fix
    direct = pairs.ways.direct[np.arange(len(fix)), fix] > 0.5
    return np.where(direct, fix, -1)


def associate_gnn(known: Known, group: Group, pairs: Pairs) -> Association:
    """Select the most likely joint event; confirmed tracks are assigned before tentative
    tracks."""
    T, D = pairs.track_log.shape
    seen, p = group.detection, group.config.detection_probability
    ratio = 0.0 if seen is None else seen.log_ratio
    may = gate_pairs(group, pairs) | (pairs.direct < 1.0)
    fit = np.where(may, pairs.track_log + ratio, -np.inf)
    clutter, chosen = group.config.usual_clutter, fit
    if D == 1:
        chosen = np.where(_held(pairs)[:, None], SURELY, fit)
    fix = assign_fits(chosen, known.life.status == TENTATIVE, p, clutter)
    hit = np.flatnonzero(fix >= 0)
    missed = np.full(T, math.log1p(-p)) if seen is None else np.log1p(-seen.tracks)
    score = known['score'] + missed
    score[hit] += fit[hit, fix[hit]] + math.log(p / (1.0 - p)) - math.log(clutter)
    free = np.ones(D, np.bool_)
    free[fix[hit]] = False
    hard = _hard_association(fix, D)
    fix = _direct_hits(fix, pairs)
    return Association(*hard, fix, free, None, score, direct=pairs.direct)


def _hard_association(fix: IntArray, D: int) -> tuple[FloatArray, FloatArray]:
    """Return beta (T, D) and missed (T,) of a single assignment. fix (T,): -1 for a miss."""
    beta = np.zeros((len(fix), D))
    hit = np.flatnonzero(fix >= 0)
    beta[hit, fix[hit]] = 1.0
    return beta, np.where(fix >= 0, 0.0, 1.0)


def associate_jipda(known: Known, group: Group, pairs: Pairs) -> Association:
    """Compute the probabilities of all joint events of tracks and fixes."""
    T, D = pairs.track_log.shape
    config, status, seen = group.config, known.life.status, group.detection
    may = gate_pairs(group, pairs) | (pairs.direct < 1.0)
    # With max_tracks confirmed tracks, no fix is attributed to a new target.
    full = int((status != TENTATIVE).sum()) >= config.max_tracks
    ratio = np.exp(pairs.track_log) / (group.clutter + (0.0 if full else group.birth_density))
    detected = np.full(T, config.detection_probability)
    if seen is not None:
        detected = np.maximum(seen.tracks, MIN_DETECTION_PROBABILITY)
        ratio = ratio * seen.fixes / detected[:, None]
    looked = group.is_complete | may.any(axis=1)
    before = known['existence']
    # The existence of tracks from pings and starts is unknown.
    guess = np.where(status == TENTATIVE, 0.5, CONFIRM_EXISTENCE)
    before = np.where(np.isnan(before), guess, before)
    detected = np.where(looked, detected, 0.0)
    linked = None
    if pairs.groups is None:
        beta, missed, after = jipda.associate(ratio, may, before, detected)
    else:
        linked = _associate_groups(group, pairs, pairs.groups, ratio, may, before, detected)
        beta, missed, after = linked.beta, linked.missed, linked.exists
    alone = is_alone(group)
    if alone and D == 1 and (held := _held(pairs)).any():
        beta[:, 0], missed = np.where(held, before, 0.0), np.where(held, 0.0, missed)
        after = np.where(held, before, after)
    hit = beta.sum(axis=1) > 0.5 * after
    fix = np.where(hit, beta.argmax(axis=1), -1) if D else np.full(T, -1)
    fix = _direct_hits(fix, pairs)
    # In a scan of several targets, a fix with which a burst may begin may be of a new one.
    claimed = (beta if alone else beta * pairs.direct).sum(axis=0)
    new = group.birth_density
    birth = new / (new + group.clutter) * (1.0 - claimed)
    score = jipda.log_odds(after if linked is None else after / linked.held)
    found = Association(beta, missed, fix, claimed < 0.5, birth, score, True, pairs.direct)
    if linked is None:
        return found
    return found._replace(
        group_beta=linked.group_beta, group_missed=linked.group_missed, held=linked.held
    )


class _Linked(NamedTuple):
    """Association with groups, see `Association`."""

    beta: FloatArray
    missed: FloatArray
    exists: FloatArray
    group_beta: FloatArray
    group_missed: FloatArray
    held: FloatArray


def _associate_groups(
    group: Group,
    pairs: Pairs,
    groups: Groups,
    ratio: FloatArray,
    may: BoolArray,
    before: FloatArray,
    detected: FloatArray,
) -> _Linked:
    """Compute the probabilities of all joint events where rows exclude tracks.

    :param ratio: (T, D) density over that of all other fixes; for tracks without linked rows.
    :param may: (T, D) True for possible pairs; other arguments (T,).
    """
    T, of = len(before), groups.target
    with np.errstate(invalid='ignore', divide='ignore'):
        other = np.exp(pairs.track_log) / ratio
    other = np.where(np.isfinite(other) & (other > 0.0), other, 1.0)
    density = np.exp(groups.log)
    # The gate of a linked row is that of its own density.
    gate = groups.log - np.log(np.maximum(groups.weight, 1e-300))[:, None]
    passes = gate > gate_log_density(group)
    tied = np.bincount(of, minlength=T) > 1
    # Openings have no gate, those from a burst neither.
    plain = passes[:T] | (pairs.direct < 1.0) | ~tied[:, None]
    possible = np.concatenate([may & plain, passes[T:]])
    of_row, ways = _groups_of_rows(pairs, groups), pairs.ways
    if ways is not None:
        opens = ways.way == OPEN
        possible[of_row[ways.row[opens]], ways.fix[opens]] = True
    r, p = before[of], detected[of]
    alive = r * groups.weight
    missed = alive * (1.0 - p)
    missed[:T] += 1.0 - before
    found = linked_marginals(
        (r * p)[:, None] * density / other[of], missed, possible, of, groups.link, T
    )
    none = found.none * np.where(missed > 0.0, alive * (1.0 - p) / missed, 0.0)
    beta = np.zeros(may.shape)
    np.add.at(beta, of, found.pair)
    total = np.bincount(of, none, minlength=T).astype(np.float64)
    held = found.held + _leaving(pairs, groups, of_row, found.pair, T)
    exists = np.minimum(total + beta.sum(axis=1), 1.0)
    return _Linked(beta, total, exists, found.pair, none, np.minimum(held, 1.0))


def _groups_of_rows(pairs: Pairs, groups: Groups) -> IntArray:
    """Return the group (N,) of each row."""
    among = pairs.among
    of_row = np.empty(int(among.row.max()) + 1, np.int64)
    of_row[among.row[among.has_row]] = groups.of[among.has_row]
    return of_row


def _leaving(
    pairs: Pairs, groups: Groups, of_row: IntArray, beta: FloatArray, targets: int
) -> FloatArray:
    """Return the probability (T,) that a burst which excludes the track has ended.

    of_row: (N,) group of each row.
    """
    out = np.zeros(targets)
    ways = pairs.ways
    if ways is None:
        return out
    leave = np.flatnonzero(ways.way == LEAVE)
    among = pairs.among
    logw = np.empty(len(of_row))
    logw[among.row[among.has_row]] = among.logw[among.has_row]
    at, fix = of_row[ways.row[leave]], ways.fix[leave]
    share = np.exp(logw[ways.row[leave]] + ways.log[leave] - groups.log[at, fix])
    linked = groups.link[at] >= 0
    np.add.at(out, groups.link[at[linked]], (beta[at, fix] * share)[linked])
    return out
