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

"""Fixes: which are whose, and what they do to the tracks.

Every fix is compared with every row it may belong to (`compare`): with the covariances that the
row assumes, under all its models. So each fix has a density under each row, and one under each
whole track. By these densities it is decided whose it is:

- `by_name`: the fix says so. A name settles whose a fix is, never whether it is good.
- `jointly` (jipda): every pairing of tracks and fixes is weighed, exactly (`estimation.jipda`). So
  a track has a probability of existence, by which it is confirmed, published and ended.
- `singly` (gnn): the likeliest pairing is taken for true; hits and misses are counted.

Which fix may be a track's is not asked of a chi-square where the models are families, but of the
density of the whole mixture: it has to be more probable that the diver was seen there than that he
was missed and the fix is false (`bound`).

Then the rows are updated by the fixes that may be theirs, in proportion to the probabilities
(`update`). What each row says of the fixes weighs it, and rows without weight are not computed.

Source: docs/diver.md, 'Association'.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import math
from typing import NamedTuple

import numpy as np

from ...estimation import bank, jipda
from ...estimation.arrays import BoolArray, FloatArray, IndexArray, IntArray
from ...estimation.association import assign_fits, gate_threshold, TENTATIVE
from ...estimation.bank import Innovations
from ...estimation.rows import (
    Borrowed,
    LEAST_LOG,
    log_sum,
    of_targets,
    revived,
    ROW_AGAIN,
    ROW_LOST,
    Rows,
    thinned,
)
from ...measurements import NOBODY
from .innovations import FixConsistency, watch
from .known import Feature, Known, of_rows, repaired
from .models import ModelSet
from .offsets import RecentPairs
from .scan import Group

FEATURES = {
    'nis': Feature(math.nan),
    'nis_dof': Feature(0, kind=np.uint16),
    'score': Feature(0.0),
    'white': Feature(math.nan, (2,)),
    'existence': Feature(math.nan),
    'evidence': Feature(1.0),
}
"""nis, nis_dof: of this scan, NaN and 0 without a hit; score: how much better than clutter the
track explained the last ten scans or so, a log-likelihood ratio; white: whitened innovation of the
last fix; existence: probability that there is a diver, NaN where hits are counted instead;
evidence: sum of the probabilities of its detections."""

FAR = 80.0
"""Normalised distance squared along an axis, from what every model expects, beyond which a density
is nothing but small: what counts is which one is nearer."""

OPENS_GATE = {'gnn': 1e-6, 'jipda': 0.01}
"""A model less probable than this opens no gate. A choice needs the rare ones, or loses the track
at a sharp turn; where all pairings are weighed they cost little."""

LEAST_DETECTED = 1e-9
"""Probability of detection of a track outside of all that the sensor covers: that of a fix is
divided by it."""

CONFIRMS = 0.9
"""Existence above which a track may be confirmed."""

SHARE = 5e-4
"""Share of the weight of the scales that is spread evenly over them with each scan, so that a
sensor which becomes worse is noticed."""

STATED = 1.0
"""Rows with a lower scale say where a diver is, but not how well that is known: fixes that are
better than stated look like fixes whose errors last."""


class Assumptions(NamedTuple):
    """All that is assumed of T tracks, in their order: row (A,) whose states are used; scale (A,)
    of the covariances; logw (A,), logarithms of the weights; target (A,), the track; own (A,):
    whether the row is its own, or borrowed."""

    row: IndexArray
    scale: FloatArray
    logw: FloatArray
    target: IntArray
    own: BoolArray

    @classmethod
    def of(cls, rows: Rows, borrowed: Borrowed) -> Assumptions:
        """Return the assumptions of rows and of the list of those without one."""
        N, scale = len(rows), rows.key['scale']
        if not len(borrowed):
            return cls(np.arange(N), scale, rows.logw, rows.target, np.ones(N, np.bool_))
        target = np.concatenate([rows.target, borrowed.target])
        order = np.argsort(target, kind='stable')
        return cls(
            np.concatenate([np.arange(N), borrowed.lender(rows, 'scale')])[order],
            np.concatenate([scale, borrowed.key])[order],
            np.concatenate([rows.logw, borrowed.logw])[order],
            target[order],
            order < N,
        )


class Pairs(NamedTuple):
    """Fixes beside assumptions: assumption, fix (p,), in rising order of the first; compared: what
    each block of models says of each pair; log (p,): density of the fix under the assumption, and
    whole (T, D) under the track, logarithms; nis (T, D): the least of any model, where a
    chi-square is the gate, else None."""

    among: Assumptions
    assumption: IndexArray
    fix: IndexArray
    compared: tuple[Innovations, ...]
    log: FloatArray
    whole: FloatArray
    nis: FloatArray | None


class Association(NamedTuple):
    """Whose D fixes are: beta (T, D), the probability of each pair; missed (T,): that a track has
    none; fix (T,): the likeliest one of a track that was hit, -1 of others; free (D,): where a
    track may begin; existence (D,): of that track, None where its hits will tell; score (T,);
    weighed: whether existence follows from the probabilities."""

    beta: FloatArray
    missed: FloatArray
    fix: IntArray
    free: BoolArray
    existence: FloatArray | None
    score: FloatArray
    weighed: bool = False

    @property
    def hit(self) -> BoolArray:
        """(T,) whether a hit is likelier than a miss."""
        return self.fix >= 0

    @property
    def claimed(self) -> FloatArray:
        """(D,) the probability that each fix is a track's."""
        return np.asarray(self.beta.sum(axis=0))

    @property
    def exists(self) -> FloatArray:
        """(T,) the probability that there is a diver, hit or missed."""
        return self.missed + self.beta.sum(axis=1)


# -- comparing -----------------------------------------------------------------------------------


def compare(known: Known, group: Group, models: ModelSet, opens: float) -> Pairs:
    """Compare the fixes of a group with the rows that they may belong to: with those near them,
    or, of fixes with names, with those of these names. opens: as in `OPENS_GATE`."""
    rows, z, R = known.rows, group.z, group.R
    among = Assumptions.of(rows, known.borrowed)
    expected = [bank.expected(b, part.measured) for b, part in zip(rows.blocks, models.parts)]
    off = _off(expected, among, z, R)
    # All rows of a track see what one of them may: else one would stay where it is for ever.
    near = of_targets(np.logical_or, off <= 1.0, among.target)
    if group.target_id is not None:
        near = known['target_id'][:, None] == group.target_id
    near = near[among.target]
    assumption, fix = np.nonzero(near)
    row, scaled = among.row[assumption], R[fix] * among.scale[assumption][:, None, None]
    compared = tuple(bank.compare(*each, row, z[fix], scaled) for each in expected)
    log = _of_mixture(rows.mu[row], compared)
    table = -0.5 * FAR * np.square(np.maximum(off, 1.0))
    table[assumption, fix] = log
    whole = log_sum(among.logw[:, None] + table, among.target)
    nis = None
    if models.families is None:
        probable = (rows.mu * np.exp(rows.logw)[:, None])[row] >= opens
        least = np.concatenate([each.nis for each in compared], axis=1)
        least = np.where(probable, least, np.inf).min(axis=1, initial=np.inf)
        nis = np.full(whole.shape, np.inf)
        np.minimum.at(nis, (among.target[assumption], fix), least)
    return Pairs(among, assumption, fix, compared, log, whole, nis)


def _of_mixture(mu: FloatArray, compared: Sequence[Innovations]) -> FloatArray:
    """Return the logarithm (p,) of the density of each pair's fix under all models, of
    probabilities mu (p, M)."""
    with np.errstate(divide='ignore'):
        of_models = np.log(mu) + np.concatenate([each.log for each in compared], axis=1)
        best = of_models.max(axis=1, initial=-np.inf, keepdims=True)
        safe = np.where(np.isfinite(best), best, 0.0)
        return np.asarray(
            (best + np.log(np.exp(of_models - safe).sum(axis=1, keepdims=True)))[:, 0]
        )


def density(rows: Rows, z: FloatArray, R: FloatArray, models: ModelSet) -> float:
    """Return the logarithm of the density of a fix z (2,), R (2, 2) under one track."""
    every, scale = np.arange(len(rows)), rows.key['scale']
    many = np.tile(z, (len(rows), 1)), R * scale[:, None, None]
    compared = [
        bank.weigh(block, every, *many, part.measured)
        for block, part in zip(rows.blocks, models.parts)
    ]
    log = rows.logw + _of_mixture(rows.mu, compared)
    return float(log_sum(log, np.zeros(len(rows), np.int64))[0])


def _off(
    expected: list[tuple[FloatArray, FloatArray]],
    among: Assumptions,
    z: FloatArray,
    R: FloatArray,
) -> FloatArray:
    """Return how far each fix is from the box that the models of each assumption reach, (A, D), in
    halves of its width."""
    if not len(z):
        return np.empty((len(among.row), 0))
    widest = np.array([R[:, 0, 0].max(), R[:, 1, 1].max()])
    low, high = np.full((len(among.row), 2), np.inf), np.full((len(among.row), 2), -np.inf)
    for h, S in expected:
        spread = S[among.row][:, [0, 2]] + (among.scale[:, None] * widest)[..., None]
        reach = np.sqrt(FAR * np.maximum(spread, 0.0))
        place = h[among.row]
        low = np.minimum(low, (place - reach).min(axis=2))
        high = np.maximum(high, (place + reach).max(axis=2))
    middle, half = 0.5 * (low + high), np.maximum(0.5 * (high - low), 1e-300)
    return np.asarray((np.abs(z - middle[:, None]) / half[:, None]).max(axis=2))


def bound(group: Group) -> float:
    """Return the logarithm of the density from which it is more probable that a diver was seen
    than that he was missed and the fix is false."""
    p = group.config.detection_probability
    return math.log(group.clutter) + math.log1p(-p) - math.log(p)


def possible(group: Group, pairs: Pairs) -> BoolArray:
    """Return which pairs (T, D) may belong together."""
    if pairs.nis is not None:
        threshold = gate_threshold(group.config.gate_probability, 2)
        return np.asarray(pairs.nis <= threshold)
    ratio = 0.0 if group.seen is None else group.seen.log_ratio
    return np.asarray(pairs.whole + ratio > bound(group))


# -- associating ---------------------------------------------------------------------------------


def associating(models: ModelSet, pairing: str) -> Callable[[Known, Group], Known]:
    """Return the stage that compares and pairs: by names where fixes have them, else by
    `pairing`."""
    pair, opens = {'jipda': jointly, 'gnn': singly}[pairing], OPENS_GATE[pairing]

    def associate(known: Known, group: Group) -> Known:
        group.pairs = compare(known, group, models, opens)
        way = pair if group.target_id is None else by_name
        group.found = way(known, group, group.pairs)
        return known

    return associate


def by_name(known: Known, group: Group, pairs: Pairs) -> Association:
    """Give each fix to the track of its name, unless it is improbable there."""
    T, D = pairs.whole.shape
    own = known['target_id'][:, None] == group.target_id
    good = own & np.isfinite(pairs.whole)
    if pairs.nis is None:
        good &= pairs.whole > bound(group)
    fix = np.where(good.any(axis=1), good.argmax(axis=1) if D else -1, -1)
    free = ~own.any(axis=0)
    return Association(*_certain(fix, D), fix, free, None, known['score'])


def singly(known: Known, group: Group, pairs: Pairs) -> Association:
    """Take the likeliest joint event for true; confirmed tracks choose before tentative ones."""
    T, D = pairs.whole.shape
    seen, p = group.seen, group.config.detection_probability
    ratio = 0.0 if seen is None else seen.log_ratio
    fit = np.where(possible(group, pairs), pairs.whole + ratio, -np.inf)
    fix = assign_fits(fit, known.life.status == TENTATIVE, p, group.clutter)
    hit = np.flatnonzero(fix >= 0)
    missed = np.full(T, math.log1p(-p)) if seen is None else np.log1p(-seen.tracks)
    score = known['score'] + missed
    score[hit] += fit[hit, fix[hit]] + math.log(p / (1.0 - p)) - math.log(group.clutter)
    free = np.ones(D, np.bool_)
    free[fix[hit]] = False
    return Association(*_certain(fix, D), fix, free, None, score)


def _certain(fix: IntArray, D: int) -> tuple[FloatArray, FloatArray]:
    """Return beta (T, D) and missed (T,) where each track takes `fix` (T,), or nothing (-1)."""
    beta = np.zeros((len(fix), D))
    hit = np.flatnonzero(fix >= 0)
    beta[hit, fix[hit]] = 1.0
    return beta, np.where(fix >= 0, 0.0, 1.0)


def jointly(known: Known, group: Group, pairs: Pairs) -> Association:
    """Weigh all pairings of tracks and fixes."""
    T, D = pairs.whole.shape
    config, status, seen = group.config, known.life.status, group.seen
    may = possible(group, pairs)
    # Where as many divers are tracked as there may be, a fix is of none that is yet to come.
    full = int((status != TENTATIVE).sum()) >= config.max_tracks
    ratio = np.exp(pairs.whole) / (group.clutter + (0.0 if full else group.birth_density))
    detected = np.full(T, config.detection_probability)
    if seen is not None:
        detected = np.maximum(seen.tracks, LEAST_DETECTED)
        ratio = ratio * seen.fixes / detected[:, None]
    looked = group.whole | may.any(axis=1)
    before = known['existence']
    # Of a track that began otherwise existence is not known.
    guess = np.where(status == TENTATIVE, 0.5, CONFIRMS)
    before = np.where(np.isnan(before), guess, before)
    beta, missed, after = jipda.associate(ratio, may, before, np.where(looked, detected, 0.0))
    hit = beta.sum(axis=1) > 0.5 * after
    fix = np.where(hit, beta.argmax(axis=1), -1) if D else np.full(T, -1)
    claimed = beta.sum(axis=0)
    birth = group.birth_density / (group.birth_density + group.clutter) * (1.0 - claimed)
    score = jipda.log_odds(after)
    return Association(beta, missed, fix, claimed < 0.5, birth, score, True)


# -- updating ------------------------------------------------------------------------------------


def updating(
    models: ModelSet, estimated: Callable[[Known], tuple[BoolArray | None, ...]]
) -> Callable[[Known, Group], Known]:
    """Return the stage that updates rows, models and existence; estimated: what an update may
    move, for each block."""

    def update(known: Known, group: Group) -> Known:
        found, pairs = group.found, group.pairs
        assert found is not None and pairs is not None
        known = _watched(known, group, found, models)
        columns = {'score': found.score}
        if found.weighed:
            # The life of a named track hangs on its own fixes.
            named = known['target_id'] != NOBODY
            columns['existence'] = np.where(named, known['existence'], found.exists)
            columns['evidence'] = known['evidence'] + found.beta.sum(axis=1)
        known = known.put(**columns)
        if not (found.beta > 0.0).any():
            return known
        return updated(known, pairs, found, models, estimated(known))

    return update


def updated(
    known: Known,
    pairs: Pairs,
    found: Association,
    models: ModelSet,
    estimated: tuple[BoolArray | None, ...],
) -> Known:
    """Return the tracks after fixes that are theirs with the probabilities of `found`."""
    among = pairs.among
    exists = np.where(found.exists > 0.0, found.exists, 1.0)
    missed = np.where(found.beta.any(axis=1), found.missed / exists, 1.0)
    track = among.target[pairs.assumption]
    weight = found.beta[track, pairs.fix] / exists[track]
    used = np.flatnonzero((weight > 0.0) & (pairs.log > -np.inf))
    assumption, weight = pairs.assumption[used], weight[used]
    whole = pairs.whole[track[used], pairs.fix[used]]
    gain = np.bincount(assumption, weight * np.exp(pairs.log[used] - whole), len(among.row))
    rows, borrowed = _reweighed(known, among, missed[among.target] + gain)
    rows, borrowed, left = thinned(rows, borrowed, 'scale', _staying(rows))
    # The pairs of rows that are left, in the order of these.
    place = np.full(len(known.rows), -1)
    place[left] = np.arange(len(left))
    row = np.where(among.own, place[among.row], -1)[assumption]
    own = row >= 0
    row, used, weight, whole = row[own], used[own], weight[own, None], whole[own, None]
    blocks, factors = [], []
    for block, part, each, mask in zip(rows.blocks, models.parts, pairs.compared, estimated):
        chosen = each.only(used)
        ratio, none = weight * np.exp(chosen.log - whole), missed[rows.target]
        block, factor = bank.update(block, chosen, row, ratio, none, part.measured, mask)
        blocks.append(block)
        factors.append(factor)
    sound, repairs = repaired(tuple(blocks))
    rows, _ = rows.replace(blocks=sound).with_models(np.concatenate(factors, axis=1))
    rows, borrowed = revived(rows, borrowed, 'scale', _again(rows, borrowed))
    return known.replace(rows=rows, borrowed=borrowed).counted(repairs=repairs)


def _reweighed(known: Known, among: Assumptions, factor: FloatArray) -> tuple[Rows, Borrowed]:
    """Return the rows and the list of those without one after the weights of all assumptions were
    multiplied by `factor` (A,)."""
    with np.errstate(divide='ignore'):
        logw = among.logw + np.log(factor)
    logw = np.maximum(logw - log_sum(logw, among.target)[among.target], LEAST_LOG)
    rows, borrowed = known.rows, known.borrowed
    of_rows, of_list = np.empty(len(rows)), np.empty(len(borrowed))
    of_rows[among.row[among.own]] = logw[among.own]
    of_list[np.argsort(borrowed.target, kind='stable')] = logw[~among.own]
    return rows.replace(logw=of_rows), Borrowed(borrowed.target, borrowed.key, of_list)


def _staying(rows: Rows) -> BoolArray:
    """Return which rows (N,) stay whatever they weigh among all: those whose start is their state,
    of each track the heaviest, and those that weigh among the rows that say how well its place is
    known."""
    first, scale = rows.first, rows.key['scale']
    # A start is a state and no scale: all rows of such a track stay, also the first.
    stays = np.maximum.reduceat(rows.key['start'], first)[rows.target] > 0
    stays |= rows.logw == np.maximum.reduceat(rows.logw, first)[rows.target]
    return stays | (stated_weight(rows) >= ROW_LOST) & (scale >= STATED)


def _again(rows: Rows, borrowed: Borrowed) -> BoolArray:
    """Return which assumptions (B,) weigh enough for a row, among all or among those that say how
    well a place is known."""
    stated = np.where(rows.key['scale'] >= STATED, np.exp(rows.logw), 0.0)
    total = np.add.reduceat(stated, rows.first)[borrowed.target]
    least = np.where((borrowed.key >= STATED) & (total > 0.0), total, 1.0) * ROW_AGAIN
    return np.asarray(np.exp(borrowed.logw) > least)


def stated_weight(rows: Rows) -> FloatArray:
    """Return the weights (N,) of the rows that say how well a place is known."""
    return rows.weights_of(rows.key['scale'] >= STATED)


def scale_of(rows: Rows) -> FloatArray:
    """Return how many times what they state the covariances of measurements are, (T,), as the rows
    that say it tell."""
    if not len(rows):
        return np.empty(0)
    return np.asarray(np.add.reduceat(stated_weight(rows) * rows.key['scale'], rows.first))


def spread_over_scales(known: Known) -> Known:
    """Return the tracks after a little of the weight of the scales was spread over them: over
    those that are stated, over the others, and over these two, so that what the stated ones weigh
    among themselves does not depend on the others."""
    rows, borrowed = known.rows, known.borrowed
    target = np.concatenate([rows.target, borrowed.target])
    scale = np.concatenate([rows.key['scale'], borrowed.key])
    weight = np.exp(np.concatenate([rows.logw, borrowed.logw]))
    group = 2 * target + (scale >= STATED)
    total = np.bincount(group, weight, minlength=2 * len(known))
    size = np.bincount(group, minlength=2 * len(known))
    groups = (size.reshape(-1, 2) > 0).sum(axis=1)[target]
    after = (1.0 - SHARE) * total[group] + SHARE / groups
    logw = np.log(after * ((1.0 - SHARE) * weight / total[group] + SHARE / size[group]))
    N = len(rows)
    return known.replace(
        rows=rows.replace(logw=logw[:N]),
        borrowed=Borrowed(borrowed.target, borrowed.key, logw[N:]),
    )


def _watched(known: Known, group: Group, found: Association, models: ModelSet) -> Known:
    """Return the tracks with the whitened innovations of the fixes that are theirs, and what these
    say of the stated covariances."""
    tracks = np.flatnonzero(found.hit)
    if not len(tracks):
        return known
    fix = found.fix[tracks]
    seen = tuple(part.seen for part in models.parts)
    mean, covariance = known.rows.combine(*of_rows(known.rows, seen), stated_weight(known.rows))
    scale = scale_of(known.rows)[tracks] if len(models.scales) > 1 else np.ones(len(tracks))
    R = group.R[fix] * scale[:, None, None]
    tentative = (known.life.status == TENTATIVE)[tracks]
    before: FixConsistency = known.memory['fixes']
    white, after = watch(
        mean[tracks],
        covariance[tracks],
        group.z[fix],
        R,
        known['white'][tracks],
        tentative,
        before,
    )
    after = after.with_scale(scale, tentative)
    columns = {name: known[name].copy() for name in ('white', 'nis', 'nis_dof')}
    columns['white'][tracks] = white
    columns['nis'][tracks] += np.square(white).sum(axis=1)
    columns['nis_dof'][tracks] += np.uint16(2)
    # Where fixes say where divers are, nothing is assumed of the instruments.
    return known.put(**columns).remember(fixes=after, recent=RecentPairs())
