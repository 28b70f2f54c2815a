# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Comparison of fixes with tracks, and the update by fixes.

`compare` computes the density of each fix under each row it may belong to: all models of the row,
with the covariance scale of the row. The densities of a track select the association (`pairing`).

`update_tracks` updates the rows with all associated fixes, in proportion to the association
probabilities. The likelihood of the fixes weights the rows. Rows of negligible weight are not
computed.

Source: docs/diver.md, 'Association'.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import math
from typing import Any

from attrs import evolve
import numpy as np

from ...estimation import bank
from ...estimation.arrays import BoolArray, FloatArray, IntArray
from ...estimation.rows import (
    Borrowed,
    drop_weightless_rows,
    LEAST_LOG,
    log_sum,
    normalise_weights,
    reduce_targets,
    restore_rows,
    ROW_LOST,
    Rows,
)
from ...measurements import NOBODY
from . import bursts, links, ways
from .disagreement import begin_disagreement, record_innovations
from .known import Feature, Known, repair_covariances
from .models import ModelSet
from .pairs import Association, Assumptions, Pairs
from .scales import can_restore, lending, protected_rows, rescaled_rows, with_far_scales
from .scan import Group

FEATURES = {
    'score': Feature(0.0),
    'existence': Feature(math.nan),
    'evidence': Feature(1.0),
}
"""score: log-likelihood ratio of the track against clutter over about the last ten scans.

existence: probability that the target exists; NaN for tracks confirmed by hits.

evidence: sum of the detection probabilities of the track.
"""

FAR = 80.0
"""Squared normalised distance along one axis beyond which a density is replaced by a bound. The
bound decreases with the distance, so it still ranks tracks."""

MAX_TABLE = 1 << 19
"""Largest number of assumptions times fixes that are compared at once."""


# -- comparison ----------------------------------------------------------------------------------


def compare(
    known: Known,
    group: Group,
    models: ModelSet,
    min_probability: float,
) -> Pairs:
    """Compare the fixes of a group with rows near them, or with the tracks of the same ID.

    :param min_probability: minimum model probability, see `pairing.MIN_MODEL_PROBABILITY`.
    """
    among = Assumptions.from_rows(known.rows, known.borrowed, group.number)
    expected = _predict_fixes(known, among, group.number, models)
    by_nis = models.families is None
    each = [
        _compare_part(known, group, among, part, expected, min_probability if by_nis else None)
        for part in _parts(among.target, len(group.z))
    ]
    assumption, fix, log, whole, nis = zip(*each)
    return Pairs(
        among,
        np.concatenate(assumption),
        np.concatenate(fix),
        expected,
        np.concatenate(log),
        np.concatenate(whole),
        np.concatenate(nis) if by_nis else None,
        in_parts=len(each) > 1,
    )


def _predict_fixes(
    known: Known, among: Assumptions, sensor: int, models: ModelSet
) -> list[tuple[FloatArray, FloatArray]]:
    """Return `Pairs.expected` of a sensor."""
    rows, N = known.rows, len(known.rows)
    factor, found = ways.offset_factor(rows, sensor), []
    for block, part in zip(rows.blocks, models.parts):
        velocity, measured = part.outputs[2:4], part.measured
        own = bank.move_along(block, velocity, among.moved[:N])
        each = [bank.predict_fix(own, measured, factor)]
        if factor is not None:
            each.append(bank.predict_fix(own, measured, np.zeros(N)))
        if len(among.lent):
            lent = bank.move_along(block.select(among.lent), velocity, among.moved[N:])
            none = None if factor is None else np.zeros(len(among.lent))
            each.append(bank.predict_fix(lent, measured, none))
        h, S = zip(*each)
        found.append((np.concatenate(h), np.concatenate(S)) if len(each) > 1 else each[0])
    return found


def _parts(target: IntArray, fixes: int) -> list[slice]:
    """Return slices of the assumptions, each with all assumptions of its tracks: a table of all
    tracks and thousands of fixes would take hundreds of megabytes."""
    count = max(1, MAX_TABLE // max(fixes, 1))
    if len(target) <= count:
        return [slice(0, len(target))]
    first = np.append(np.flatnonzero(np.diff(target, prepend=-1)), len(target))
    cuts = [0]
    for start, stop in zip(first, first[1:]):
        if stop - cuts[-1] > count and start > cuts[-1]:
            cuts.append(int(start))
    return [slice(*pair) for pair in zip(cuts, [*cuts[1:], len(target)])]


def _compare_part(
    known: Known,
    group: Group,
    among: Assumptions,
    part: slice,
    expected: list[tuple[FloatArray, FloatArray]],
    min_probability: float | None,
) -> tuple[Any, ...]:
    """Return the fields of `Pairs` after the first for a part of the assumptions.

    :param min_probability: of a model whose NIS counts; None if no NIS is needed.
    """
    rows, z, R = known.rows, group.z, group.R
    among = among.select(part)
    track = among.target - (among.target[0] if len(among.target) else 0)
    off = _box_distance(expected, among, z, R)
    if len(z) > 1 and group.target_id is None:
        # Of a whole scan, an improbable large scale would reach every fix.
        off[~among.has_row & (among.logw < math.log(ROW_LOST))] = np.inf
    # A fix near one row is compared with all rows of the track, or a row could stay behind.
    near = reduce_targets(np.logical_or, off <= 1.0, track)
    if group.target_id is not None:
        near = known['target_id'][np.unique(among.target), None] == group.target_id
    assumption, fix = np.nonzero(near[track])
    row, scaled = among.row[assumption], R[fix] * among.scale[assumption][:, None, None]
    seen = among.seen[assumption]
    compared = tuple(bank.compare(*each, seen, z[fix], scaled) for each in expected)
    log = bank.mixture_log_density(rows.mu[row], compared)
    table = np.square(np.maximum(off, 1.0, out=off), out=off)
    table *= -0.5 * FAR
    table[assumption, fix] = log
    whole = log_sum(among.logw[:, None] + table, track)
    nis = None
    if min_probability is not None:
        probable = (rows.mu * np.exp(rows.logw)[:, None])[row] >= min_probability
        least = np.concatenate([each.nis for each in compared], axis=1)
        least = np.where(probable, least, np.inf).min(axis=1, initial=np.inf)
        nis = np.full(whole.shape, np.inf)
        np.minimum.at(nis, (track[assumption], fix), least)
    return assumption + part.start, fix, log, whole, nis


def track_log_density(
    rows: Rows, z: FloatArray, R: FloatArray, models: ModelSet, sensor: int
) -> float:
    """Return the log density of a fix z (2,), R (2, 2) of a sensor under the rows of one new
    track."""
    every, scale = np.arange(len(rows)), rows.key['scale'][:, sensor]
    many = np.tile(z, (len(rows), 1)), R * scale[:, None, None]
    compared = [
        bank.weigh(block, every, *many, part.measured)
        for block, part in zip(rows.blocks, models.parts)
    ]
    log = rows.logw + bank.mixture_log_density(rows.mu, compared)
    return float(log_sum(log, np.zeros(len(rows), np.int64))[0])


def _box_distance(
    expected: list[tuple[FloatArray, FloatArray]],
    among: Assumptions,
    z: FloatArray,
    R: FloatArray,
) -> FloatArray:
    """Return the distance (A, D) of each fix from the box around the predictions of an assumption.

    Unit: half the box width.
    """
    if not len(z):
        return np.empty((len(among.row), 0))
    widest = np.array([R[:, 0, 0].max(), R[:, 1, 1].max()])
    low, high = np.full((len(among.row), 2), np.inf), np.full((len(among.row), 2), -np.inf)
    for h, S in expected:
        spread = S[among.seen][:, [0, 2]] + (among.scale[:, None] * widest)[..., None]
        reach = np.sqrt(FAR * np.maximum(spread, 0.0))
        place = h[among.seen]
        low = np.minimum(low, (place - reach).min(axis=2))
        high = np.maximum(high, (place + reach).max(axis=2))
    middle, half = 0.5 * (low + high), np.maximum(0.5 * (high - low), 1e-300)
    # Axis by axis and in place: a scan of 10,000 fixes takes much memory.
    off = np.zeros((len(among.row), len(z)))
    for axis in (0, 1):
        apart = z[:, axis] - middle[:, axis, None]
        np.abs(apart, out=apart)
        apart /= half[:, axis, None]
        np.maximum(off, apart, out=off)
    return off


def gate_log_density(group: Group) -> FloatArray:
    """Return the gate threshold (D,): the log density at which a detection and a miss with a
    false fix are equally probable."""
    p = group.config.detection_probability
    return np.asarray(np.log(group.clutter) + (math.log1p(-p) - math.log(p)))


# -- update --------------------------------------------------------------------------------------


def update_stage(
    models: ModelSet, estimated: Callable[[Known], tuple[BoolArray | None, ...]]
) -> Callable[[Known, Group], Known]:
    """Return the stage that updates rows, models and existence. estimated: masks of the components
    that an update may change, one per block."""

    has_scales = len(models.scales) > 1

    def update(known: Known, group: Group) -> Known:
        association, pairs = group.association, group.pairs
        assert association is not None and pairs is not None
        rejected = _rejected_fixes(known, group, association, pairs) if has_scales else None
        known = record_innovations(known, group, models)
        columns = {'score': association.score}
        if association.is_joint:
            # Tracks with an ID live by the hits of their own fixes.
            named = known['target_id'] != NOBODY
            after = association.exists / association.held
            columns['existence'] = np.where(named, known['existence'], after)
            columns['evidence'] = known['evidence'] + association.beta.sum(axis=1)
        known = known.with_columns(**columns)
        if rejected is None and not (association.beta > 0.0).any():
            return known
        return update_tracks(known, group, pairs, association, models, estimated(known), rejected)

    return update


def update_tracks(
    known: Known,
    group: Group,
    pairs: Pairs,
    association: Association,
    models: ModelSet,
    estimated: tuple[BoolArray | None, ...],
    rejected: tuple[IntArray, FloatArray] | None,
) -> Known:
    """Update the tracks by the fixes, with the probabilities of the association.

    rejected: see `_rejected_fixes`.
    """
    among = pairs.among
    exists = np.where(association.exists > 0.0, association.exists, 1.0)
    missed = np.where(association.beta.any(axis=1), association.missed / exists, 1.0)
    beta, logs, of = association.beta / exists[:, None], pairs.track_log, among.target
    groups = pairs.groups
    if groups is not None and association.group_beta is not None:
        beta = association.group_beta / exists[groups.target][:, None]
        heavy = np.where(groups.weight > 0.0, groups.weight, 1.0)
        missed = np.asarray(association.group_missed) / heavy / exists[groups.target]
        logs, of = groups.log, groups.of
    weight = beta[of[pairs.assumption], pairs.fix]
    used = np.flatnonzero((weight > 0.0) & (pairs.log > -np.inf))
    assumption, weight = pairs.assumption[used], weight[used]
    whole = logs[of[assumption], pairs.fix[used]]
    gain = np.bincount(assumption, weight * np.exp(pairs.log[used] - whole), len(among.row))
    factor: FloatArray = np.add(missed[of], gain)
    weighed = np.asarray(association.beta.any(axis=1))
    if rejected is not None:
        factor *= _rejected_factor(pairs, *rejected)
        weighed = weighed | (rejected[1] > 0.0)
    sensor = group.number
    of_row = np.empty(len(known.rows), np.int64)
    of_row[among.row[among.has_row]] = of[among.has_row]
    rows, borrowed, of_ways = _update_weights(known, pairs, factor, beta, logs, of_row)
    began: list[Rows] = []
    if pairs.ways is not None:
        of_ways = links.weights_of_ways(known, group, pairs.ways, of_ways, association)
        link = links.links_of_fixes(known, group)
        began += bursts.begin_rows(known, group, pairs.ways, of_ways, link, models, estimated)
    if ways.has_ways(group, models) and ways.is_alone(group):
        began += begin_disagreement(known, group, models, estimated)
    stays = protected_rows(rows) | bursts.divided(rows, began)
    rows, borrowed, left = drop_weightless_rows(rows, borrowed, stays)
    # Pairs of the remaining rows, in row order.
    place = np.full(len(known.rows), -1)
    place[left] = np.arange(len(left))
    row = np.where(among.has_row, place[among.row], -1)[assumption]
    own = row >= 0
    row, weight, whole = row[own], weight[own, None], whole[own, None]
    assumption, fix = assumption[own], pairs.fix[used[own]]
    z, R = group.z[fix], group.R[fix] * among.scale[assumption][:, None, None]
    blocks, factors = [], []
    offset, late = ways.offset_factor(rows, sensor), rows.key['delay'][:, sensor]
    each = zip(rows.blocks, models.parts, pairs.expected, estimated)
    for block, part, expected, mask in each:
        innovations = bank.compare(*expected, among.seen[assumption], z, R)
        block = bank.move_along(block, part.outputs[2:4], -late)
        ratio, none = weight * np.exp(innovations.log - whole), missed[of_row[left]]
        mask = bursts.with_tail_mask(mask, rows.tail)
        block, of_models = bank.update(
            block, innovations, row, ratio, none, part.measured, mask, offset
        )
        blocks.append(bank.move_along(block, part.outputs[2:4], late))
        factors.append(of_models)
    sound, repairs = repair_covariances(tuple(blocks), rows.tail)
    rows, _ = rows.replace(blocks=sound).multiply_models(np.concatenate(factors, axis=1))
    rows, borrowed = with_far_scales(rows, borrowed, sensor)
    again = can_restore(rows, borrowed) & weighed[borrowed.target]
    last = association.fix if rejected is None else np.maximum(association.fix, rejected[0])
    lend = lending(models, group, last)
    rows, borrowed = restore_rows(rows, borrowed, again, bursts.ENDED, lend)
    took = association.beta.sum(axis=1) > 0.5 * exists
    rows = bursts.count_fixes(rows, sensor, took[rows.target], known.stamp_ns)
    began += rescaled_rows(rows, models.scales, sensor)
    if pairs.ways is not None or began or rows.tail:
        rows, borrowed = _join_rows(rows, borrowed, began)
    return known.replace(rows=rows, borrowed=borrowed).add_counts(repairs=repairs)


def _rejected_fixes(
    known: Known, group: Group, association: Association, pairs: Pairs
) -> tuple[IntArray, FloatArray] | None:
    """Return the nearest fix (T,) of each track that got none, -1 for none, and the probability
    (T,) that the fix is of the track.

    A fix has one track: the nearest, or the one with its ID. Return None if there is no such fix.
    """
    whole = pairs.track_log + (0.0 if group.detection is None else group.detection.log_ratio)
    without = np.asarray(~(association.beta > 0.0).any(axis=1))
    possible = without[:, None] & np.asarray(association.claimed < 0.5)
    if group.target_id is not None:
        possible &= known['target_id'][:, None] == group.target_id
    whole = np.where(possible & np.isfinite(pairs.track_log), whole, -np.inf)
    if not np.isfinite(whole).any():
        return None
    nearest = whole.argmax(axis=1)
    best = whole[np.arange(len(whole)), nearest]
    own = np.isfinite(best) & (whole[:, nearest].max(axis=0) == best)
    odds = np.minimum(best - gate_log_density(group)[nearest], 0.0)
    return np.where(own, nearest, -1), np.where(own, np.exp(odds) / (1.0 + np.exp(odds)), 0.0)


def _rejected_factor(pairs: Pairs, nearest: IntArray, share: FloatArray) -> FloatArray:
    """Return the factors (A,) of the weights of all assumptions by rejected fixes.

    A rejected fix is a false fix, or the covariances are much too small. Without this factor, no
    fix could show that.

    :param nearest: (T,) rejected fix of each track; -1 for none.
    :param share: (T,) probability that the fix is of the track.
    """
    among = pairs.among
    track = among.target[pairs.assumption]
    own = np.flatnonzero((nearest[track] == pairs.fix) & (pairs.log > -np.inf))
    assumption, track = pairs.assumption[own], track[own]
    fit = np.exp(pairs.log[own] - pairs.track_log[track, pairs.fix[own]])
    gain = np.bincount(assumption, share[track] * fit, len(among.row))
    return np.asarray(1.0 - share[among.target] + gain, np.float64)


def _join_rows(rows: Rows, borrowed: Borrowed, began: Sequence[Rows]) -> tuple[Rows, Borrowed]:
    """Add new rows of offsets, and remove rows of negligible weight.

    Return the rows and the borrowed list.
    """
    for new in began:
        rows = rows.append(new)
    rows = bursts.merge_rows(rows)
    rows, borrowed = bursts.drop_rows(rows, borrowed, protected_rows(rows))
    return normalise_weights(bursts.without_unused_tail(rows), borrowed)


def _update_weights(
    known: Known,
    pairs: Pairs,
    factor: FloatArray,
    beta: FloatArray,
    logs: FloatArray,
    of_row: IntArray,
) -> tuple[Rows, Borrowed, FloatArray]:
    """Multiply the weights of all assumptions by `factor` (A,).

    Return the rows, the borrowed list, and the log weights (E,) of the rows that ways lead to.

    :param beta: (G, D) probability of each pair of a group, if the target exists.
    :param logs: (G, D) log density of each pair.
    :param of_row: (N,) group of each row; without links, the track.
    """
    among, ways, of_ways = pairs.among, pairs.ways, np.empty(0)
    with np.errstate(divide='ignore'):
        logw = among.logw + np.log(factor)
        every, target = logw, among.target
        if ways is not None:
            track = known.rows.target[ways.row]
            of = of_row[ways.row]
            of_ways = known.rows.logw[ways.row] + ways.log - logs[of, ways.fix]
            of_ways = of_ways + np.log(beta[of, ways.fix])
            target = np.concatenate([target, track])
            order = np.argsort(target, kind='stable')
            every, target = np.concatenate([every, of_ways])[order], target[order]
    total = log_sum(every, target)
    logw = np.maximum(logw - total[among.target], LEAST_LOG)
    if ways is not None:
        of_ways = of_ways - total[track]
    rows, borrowed = known.rows, known.borrowed
    of_rows, of_list = np.empty(len(rows)), np.empty(len(borrowed))
    of_rows[among.row[among.has_row]] = logw[among.has_row]
    of_list[np.argsort(borrowed.target, kind='stable')] = logw[~among.has_row]
    return rows.replace(logw=of_rows), evolve(borrowed, logw=of_list), of_ways
