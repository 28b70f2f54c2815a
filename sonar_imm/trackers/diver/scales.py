# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Covariance scales and delays: assumptions about how wrong reported covariances and stamps are.

Each sensor has its scale of `covariance_scales`, and at most one sensor a delay of
`sensor_delays`. Assumptions do not interact; the likelihoods of fixes weight them, and at each
scan a small fraction of the weight is redistributed by the priors. Only probable assumptions have
a row. Their neighbours, which differ in the sensor that reports, borrow (`estimation.rows`).

`Rows.key` has a column for each sensor (`sensors`): `scale`, 0 where the track did not hear it,
and `delay`, s.

Scales below 1 contribute to the mean of a track, but not to its covariance: errors of a source
that filters its output look like covariances that are reported too large.

Source: docs/diver.md, 'Scaled filters'.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from attrs import evolve
import numpy as np

from ...estimation import bank
from ...estimation.arrays import BoolArray, FloatArray, IndexArray, IntArray
from ...estimation.rows import Borrowed, normalise_weights, ROW_AGAIN, ROW_LOST, Rows
from .known import Known, track_positions, with_velocities_at_fix
from .models import ModelSet, USUAL_SCALES
from .scan import Group
from .sensors import lent_moves, scale_of

REDISTRIBUTED_FRACTION = 5e-4
"""Fraction of the scale weights that is redistributed at each scan, so that a change of the fix
quality is detected."""

MIN_PUBLISHED_SCALE = 1.0
"""Smallest scale whose rows contribute to the published covariance. Smaller scales also fit
time-correlated errors, so they contribute to the mean only."""

NEAR_WEIGHT = np.exp(-3.0)
"""Weight, relative to the heaviest, above which an assumption gets neighbours."""

MOST_BORROWED = 64
"""Maximum number of assumptions without a row, of one track."""

FARTHEST_HEARD = 400.0
"""Squared distance of a fix, relative to the variances, within which a track hears its sensor."""

RESCALED, HEAVY = 8, 0.5
"""Number of fixes after which rows with an offset get other scales, and their minimum weight."""

UNDECIDED = 5
"""Number of fixes after which the usual scales are compared, at most `YOUNG`."""

DELAYED = 1e-3
"""Prior of any delay of a sensor."""

YOUNG, FAR_SCALE = 6, 20.0
"""Number of fixes of a young track, and ratio of scales above which its state is not lent."""

RARE = 1e-3
"""Prior of the first scale beyond `USUAL_SCALES`, relative to the priors of those. Beyond, the
prior decreases with the scale."""


def scale_priors(scale: FloatArray) -> FloatArray:
    """Return the priors (k,) of scales (k,), not normalised."""
    most = USUAL_SCALES[1]
    return np.where(scale <= most, 1.0, RARE * most / scale)


class _Entries:
    """Rows and borrowed assumptions of all targets as one list, for one assumption of a sensor."""

    def __init__(self, rows: Rows, borrowed: Borrowed, name: str, sensor: int):
        self.target = np.concatenate([rows.target, borrowed.target])
        self.weight = np.exp(np.concatenate([rows.logw, borrowed.logw]))
        self.key = {
            each: np.concatenate([rows.key[each], column]) for each, column in borrowed.key.items()
        }
        self.value = self.key[name][:, sensor]
        self.heard = self.key['scale'][:, sensor] > 0.0
        """(E,) whether the track heard the sensor."""
        several = (self.key['scale'] > 0.0).sum(axis=1) > self.heard
        self.has_others = several
        """(E,) whether the track heard other sensors."""
        self.context = self.target
        """(E,) number of the target and of all assumptions except `name` of the sensor."""
        # A borrowed assumption has no offset.
        off = [np.append(rows.key[each], np.zeros(len(borrowed))) for each in ('since', 'aside')]
        self.is_plain = (off[0] == 0) & (off[1] == 0)
        """(E,) True for entries without an offset."""
        if several.any() or not self.is_plain.all():
            parts = [self.target[:, None], *(each[:, None] for each in off)]
            for each, table in self.key.items():
                parts.append(np.delete(table, sensor, axis=1) if each == name else table)
            whole = np.concatenate(parts, axis=1)
            self.context = np.unique(whole, axis=0, return_inverse=True)[1].ravel()

    def lacking(
        self,
        name: str,
        sensor: int,
        values: FloatArray,
        prior: FloatArray,
        can: BoolArray,
        new: BoolArray,
    ) -> Borrowed:
        """Return the `values` (k,) that contexts of sufficient weight lack.

        A `new` context gets them at their priors, another one at the redistributed fraction.

        :param can: (E,) True for entries whose value can be another one.
        :param new: (T,) True for targets that have only usual values.
        """
        weight = np.bincount(self.context, self.weight)
        first = np.unique(self.context, return_index=True)[1]
        target = self.target[first]
        best = np.zeros(int(target.max()) + 1)
        np.maximum.at(best, target, weight)
        there = np.zeros((len(weight), len(values)), np.bool_)
        place = np.abs(self.value[:, None] - values).argmin(axis=1)
        there[self.context[can], place[can]] = True
        fresh = new[target]
        possible = there.any(axis=1) & (fresh | (weight >= NEAR_WEIGHT * best[target]))
        share = prior / np.where(there, prior, 0.0).sum(axis=1, keepdims=True).clip(1e-300)
        fraction = np.where(fresh, 1.0, REDISTRIBUTED_FRACTION)
        own, missing = np.nonzero(~there & possible[:, None])
        key = {each: table[first[own]] for each, table in self.key.items()}
        key[name][:, sensor] = values[missing]
        logw = np.log(share[own, missing] * fraction[own] * weight[own])
        return Borrowed(target[own], key, logw)

    def redistributed(self, prior: FloatArray, half: IndexArray) -> FloatArray:
        """Return the logarithms (E,) of the weights, of which a small fraction is redistributed
        inside each context: by `prior` (E,) inside each `half` (E,) 0 or 1, and between them."""
        group = 2 * self.context + half
        size = 2 * (int(self.context.max(initial=-1)) + 1)
        total, share = (np.bincount(group, x, minlength=size) for x in (self.weight, prior))
        whole = total.reshape(-1, 2).sum(axis=1)[self.context]
        groups = (share.reshape(-1, 2) > 0).sum(axis=1)[self.context]
        after = (1.0 - REDISTRIBUTED_FRACTION) * total[group]
        after += REDISTRIBUTED_FRACTION * whole / groups
        kept = (1.0 - REDISTRIBUTED_FRACTION) * self.weight / total[group]
        return np.log(after * (kept + REDISTRIBUTED_FRACTION * prior / share[group]))


def redistribute_weights(
    known: Known, scales: Sequence[float], delays: Sequence[float] = (), sensor: int = 0
) -> Known:
    """Redistribute a small fraction of the weights of the scales and delays of a sensor by the
    priors. Other assumptions of a row stay.

    The fraction is spread over the scales from 1, over the smaller scales, and over these two
    groups. So the relative weights of the scales from 1 do not depend on the smaller scales.
    Contexts of sufficient weight get the `scales` that they lack, and the `delays` if the track
    has several sensors.
    """
    ladder = np.array(scales)
    new = np.bincount(known.borrowed.target, minlength=len(known)) == 0
    known = _redistribute(known, 'scale', sensor, ladder, scale_priors(ladder), new)
    if not delays:
        return known
    several = (known.rows.key['scale'] > 0.0).sum(axis=1) > 1
    if not several.any():
        return known
    ladder = np.array([0.0, *delays])
    prior = np.array([1.0 - DELAYED, *np.full(len(delays), DELAYED / len(delays))])
    late = np.zeros(len(known), np.bool_)
    for table in (known.rows, known.borrowed):
        late[table.target[table.key['delay'][:, sensor] > 0.0]] = True
    known = _redistribute(known, 'delay', sensor, ladder, prior, ~late)
    return _with_delays_beside_offsets(known, ladder[1:], sensor)


def _with_delays_beside_offsets(known: Known, delays: FloatArray, sensor: int) -> Known:
    """Return the state in which a delay has at least its prior beside each row with an offset.

    While a target keeps its course, an offset and a delay explain the same fixes. A turn decides,
    maybe long after.
    """
    rows, borrowed = known.rows, known.borrowed
    best = np.maximum.reduceat(rows.logw, rows.first)[rows.target]
    off = (rows.key['offset'] >= 0) & ~rows.key['delay'].any(axis=1)
    off &= (rows.key['scale'][:, sensor] > 0.0) & (rows.logw > best + np.log(NEAR_WEIGHT))
    chosen = np.flatnonzero(off)
    if not len(chosen):
        return known
    own = np.repeat(chosen, len(delays))
    new = Borrowed.from_rows(rows.select(own), borrowed.key)
    new.key['delay'][:, sensor] = np.tile(delays, len(chosen))
    new = evolve(new, logw=rows.logw[own] + np.log(DELAYED / len(delays)))
    place = {each: k for k, each in enumerate(_names(borrowed))}
    held = {each for each, plain in zip(_names(rows), rows.key['offset'] < 0) if plain}
    logw, fresh = borrowed.logw.copy(), np.ones(len(new), np.bool_)
    for k, each in enumerate(_names(new)):
        if each in place:
            logw[place[each]] = max(logw[place[each]], new.logw[k])
        fresh[k] = each not in place and each not in held
        held.add(each)
    lengthened = evolve(borrowed, logw=logw).append(new.select(fresh))
    return known.replace(borrowed=_without_least(lengthened))


def _names(table: Rows | Borrowed) -> list[bytes]:
    """Return a name of the target and of the assumptions that can borrow, of each entry."""
    key = table.key
    each = np.column_stack([table.target, key['scale'], key['delay']]).astype(np.float64)
    return [row.tobytes() for row in each]


def _redistribute(
    known: Known,
    name: str,
    sensor: int,
    values: FloatArray,
    prior: FloatArray,
    new: BoolArray,
) -> Known:
    """Redistribute the weights of one assumption; arguments as in `_Entries.lacking`."""
    rows, borrowed = known.rows, known.borrowed
    entries = _Entries(rows, borrowed, name, sensor)
    can = entries.heard & entries.is_plain
    if name == 'delay':
        others = np.delete(entries.key['delay'], sensor, axis=1)
        can = can & entries.has_others & ~others.any(axis=1)
    complete = len(values) * (int(entries.context.max(initial=-1)) + 1)
    if not (entries.is_plain.all() and len(entries.context) == complete):
        lacking = entries.lacking(name, sensor, values, prior, can, new)
        borrowed = borrowed.append(lacking)
        entries = _Entries(rows, borrowed, name, sensor)
    value, half = entries.value, np.zeros(len(entries.value), np.int64)
    if name == 'scale':
        half = (value >= MIN_PUBLISHED_SCALE).astype(np.int64)
    own = np.abs(value[:, None] - values).argmin(axis=1)
    logw = entries.redistributed(prior[own], half)
    N = len(rows)
    return known.replace(
        rows=rows.replace(logw=logw[:N]),
        borrowed=_without_least(evolve(borrowed, logw=logw[N:])),
    )


def _without_least(borrowed: Borrowed) -> Borrowed:
    """Return the list without the least assumptions of targets that have more than
    `MOST_BORROWED`."""
    if np.bincount(borrowed.target, minlength=1).max() <= MOST_BORROWED:
        return borrowed
    order = np.lexsort([-borrowed.logw, borrowed.target])
    target = borrowed.target[order]
    rank = np.arange(len(order)) - np.searchsorted(target, target)
    return borrowed.select(np.sort(order[rank < MOST_BORROWED]))


def hearing_stage(models: ModelSet) -> Callable[[Known, Group], Known]:
    """Return the stage by which tracks near a fix hear its sensor."""

    def hear(known: Known, group: Group) -> Known:
        if known.memory['reporting'] != group.number:
            known = known.with_memory(reporting=group.number)
        if (known.rows.key['scale'][:, group.number] > 0.0).all() or not len(group.z):
            return known
        if group.target_id is not None:
            near = np.isin(known['target_id'], group.target_id)
        elif len(group.z) == 1:
            near = np.ones(len(known), np.bool_)
        else:
            mean, P = track_positions(known, models)
            reach = P.trace(axis1=1, axis2=2)[:, None] + group.R.trace(axis1=1, axis2=2)
            apart = np.square(mean[:, None] - group.z).sum(axis=2)
            near = (apart < FARTHEST_HEARD * reach).any(axis=1)
        return hear_sensor(known, near, models.scales, group.number)

    return hear


def hear_sensor(known: Known, heard: BoolArray, scales: Sequence[float], sensor: int) -> Known:
    """Return the state in which the tracks `heard` (T,) know a sensor.

    A row that does not know it is split: it continues with scale 1, and the other scales borrow.
    """
    rows, borrowed, ladder = known.rows, known.borrowed, np.array(scales)
    ours, theirs = (
        heard[table.target] & (table.key['scale'][:, sensor] == 0.0) for table in (rows, borrowed)
    )
    if not ours.any():
        return known
    usual = int(np.abs(np.log(ladder)).argmin())
    others = np.delete(np.arange(len(ladder)), usual)
    share = np.log(scale_priors(ladder) / scale_priors(ladder).sum())
    best = np.maximum.reduceat(rows.logw, rows.first)[rows.target]
    split = np.flatnonzero(ours & (rows.logw >= best + np.log(NEAR_WEIGHT)))
    own, k = np.repeat(split, len(others)), np.tile(others, len(split))
    new = Borrowed.from_rows(rows.select(own), borrowed.key)
    new.key['scale'][:, sensor] = ladder[k]
    new = evolve(new, logw=rows.logw[own] + share[k])
    logw = rows.logw.copy()
    logw[split] += share[usual]
    tables = []
    for table, chosen in ((rows, ours), (borrowed, theirs)):
        scale = table.key['scale'].copy()
        scale[chosen, sensor] = ladder[usual]
        tables.append({**table.key, 'scale': scale})
    return known.replace(
        rows=rows.replace(logw=logw, key=tables[0]),
        borrowed=_without_least(evolve(borrowed, key=tables[1]).append(new)),
    )


def protected_rows(rows: Rows) -> BoolArray:
    """Return which rows (N,) are kept at any total weight.

    These are depth hypotheses, rows of tracks whose side is in doubt, the heaviest row of each
    track, and rows of sufficient weight among scales of at least `MIN_PUBLISHED_SCALE`.
    """
    first, scale = rows.first, least_scale(rows.key)
    # A start depth or a side is a state: all rows of such a track are kept, also the first.
    state = np.maximum(rows.key['start'], rows.key['side'])
    protected = np.maximum.reduceat(state, first)[rows.target] > 0
    protected &= (rows.key['offset'] < 0) & ~rows.key['aside']
    protected |= rows.logw == np.maximum.reduceat(rows.logw, first)[rows.target]
    is_published = scale >= MIN_PUBLISHED_SCALE
    return protected | (weight_without_small_scales(rows) >= ROW_LOST) & is_published


def rescaled_rows(rows: Rows, scales: Sequence[float], sensor: int) -> list[Rows]:
    """Return copies of rows with an offset at the usual scales of a sensor that they lack, if any.

    Such a row keeps the scale it began with, which stood for the offset, maybe: nothing borrows
    from it. Each `RESCALED` fixes of the sensor, the heaviest rows get the copies.
    """
    if not rows.tail:
        return []
    key, own = rows.key, rows.key['scale'][:, sensor]
    number = np.where(key['offset'] == sensor, key['fixes'], key['others'])
    due = (key['offset'] >= 0) & (own > 0.0) & (number % RESCALED == 0) & (number > 0)
    due &= ~key['turns'] & (rows.logw > np.log(HEAVY))
    if not due.any():
        return []
    others = np.delete(key['scale'], sensor, axis=1), key['delay'], key['offset'], key['since']
    alike = np.column_stack([rows.target, *others])
    usual = [s for s in scales if MIN_PUBLISHED_SCALE <= s <= USUAL_SCALES[1]]
    row, scale = [], []
    for k in np.flatnonzero(due).tolist():
        held = own[(alike == alike[k]).all(axis=1)]
        lacking = [s for s in usual if not np.isclose(held, s).any()]
        row += [k] * len(lacking)
        scale += lacking
    if not row:
        return []
    new = rows.select(np.array(row))
    table = new.key['scale'].copy()
    table[:, sensor] = scale
    logw, parent = new.logw + np.log(ROW_AGAIN), rows.parent[new.parent]
    return [evolve(new, logw=logw, parent=parent, key={**new.key, 'scale': table})]


def can_restore(rows: Rows, borrowed: Borrowed) -> BoolArray:
    """Return which assumptions (B,) have sufficient weight for a row.

    For scales of at least `MIN_PUBLISHED_SCALE`, the weight among these scales is sufficient.
    """
    is_published = least_scale(rows.key) >= MIN_PUBLISHED_SCALE
    total = np.add.reduceat(np.where(is_published, np.exp(rows.logw), 0.0), rows.first)
    total = total[borrowed.target]
    is_published = least_scale(borrowed.key) >= MIN_PUBLISHED_SCALE
    least = np.where(is_published & (total > 0.0), total, 1.0) * ROW_AGAIN
    return np.asarray(np.exp(borrowed.logw) > least)


def with_far_scales(rows: Rows, borrowed: Borrowed, sensor: int) -> tuple[Rows, Borrowed]:
    """Return the rows and the list in which scales of a sensor above the usual ones have enough
    weight for a row, for tracks of `UNDECIDED` fixes that the usual scales explain equally well.

    Either the fixes are far more accurate than the motion, or only their covariances say so. A row
    that lends shows no difference: it took the noise of the fixes for motion.
    """
    scale, first, lender = rows.key['scale'][:, sensor], rows.first, rows.heaviest
    usual = (scale >= MIN_PUBLISHED_SCALE) & (scale <= USUAL_SCALES[1])
    logw = np.where(usual, rows.logw, np.nan)
    with np.errstate(invalid='ignore'):
        spread = np.fmax.reduceat(logw, first) - np.fmin.reduceat(logw, first)
    count = np.add.reduceat(usual.astype(np.int64), first)
    undecided = (rows.key['taken'][lender] == UNDECIDED) & (count > 1) & (spread < np.log(2.0))
    if not undecided.any() or not len(borrowed):
        return rows, borrowed
    far = borrowed.key['scale'][:, sensor] > USUAL_SCALES[1]
    values = borrowed.key['scale'][far, sensor].tolist()
    chosen = far & usual_assumptions(rows, borrowed, values, sensor)
    chosen &= undecided[borrowed.target]
    least = rows.logw[lender][borrowed.target] + np.log(2.0 * ROW_AGAIN)
    logw = np.where(chosen, np.maximum(borrowed.logw, least), borrowed.logw)
    return normalise_weights(rows, evolve(borrowed, logw=logw))


def weight_without_small_scales(rows: Rows) -> FloatArray:
    """Return row weights (N,) normalised over scales of at least `MIN_PUBLISHED_SCALE`."""
    return rows.weights_among(least_scale(rows.key) >= MIN_PUBLISHED_SCALE)


def usual_assumptions(
    rows: Rows, borrowed: Borrowed, usual: Sequence[float], sensor: int
) -> BoolArray:
    """Return which assumptions (B,) have a usual scale of a sensor, and otherwise those of their
    lender."""
    same, lender = np.ones(len(borrowed), np.bool_), borrowed.find_lenders(rows)
    for name, table in borrowed.key.items():
        differs = table != rows.key[name][lender]
        if name == 'scale':
            differs[:, sensor] = ~np.isin(table[:, sensor], usual)
        same &= ~differs.any(axis=1)
    return same


def lending(models: ModelSet, group: Group, fix: IntArray) -> Callable[[Rows, Borrowed], Rows]:
    """Return the function that changes copies of lenders where an assumption changes the state.

    A delay moves the state (`sensors.lent_moves`). A scale changes the state of a young track: its
    lender took the first fixes for far more accurate than they are under the scale, so the copy
    begins anew at the last fix.

    :param fix: (T,) last fix of each track; -1 for none.
    """

    def lend(copies: Rows, borrowed: Borrowed) -> Rows:
        moved = lent_moves(copies.key, np.arange(len(copies)), borrowed.key)
        blocks = tuple(
            bank.move_along(block, part.outputs[2:4], moved)
            for block, part in zip(copies.blocks, models.parts)
        )
        its = scale_of(borrowed.key, group.number)
        excess = its / scale_of(copies.key, group.number)
        young = (copies.key['taken'] <= YOUNG) & (excess > FAR_SCALE)
        young &= (fix[copies.target] >= 0) & (
            blocks[0].x.shape[1] == len(models.parts[0].components)
        )
        chosen = np.flatnonzero(young)
        if not len(chosen):
            return copies.replace(blocks=blocks)
        last = fix[copies.target[chosen]]
        R = group.R[last] * its[chosen, None, None]
        x, P, mu = models.initial_states(group.z[last], R, measured=False)
        with_velocities_at_fix(P, models, group.config)
        for block, new in zip(blocks, models.to_blocks(x[:, 0], P[:, 0])):
            block.x[chosen], block.P[chosen] = new.x, new.P
        probabilities = copies.mu.copy()
        probabilities[chosen] = mu[:, 0]
        return copies.replace(blocks=blocks, mu=probabilities)

    return lend


def least_scale(key: dict[str, np.ndarray]) -> FloatArray:
    """Return the least scale (k,) of any sensor that the track heard."""
    scale = key['scale']
    return np.asarray(np.where(scale > 0.0, scale, np.inf).min(axis=1))


def estimated_scales(rows: Rows, sensor: int) -> FloatArray:
    """Return the estimated covariance scale (T,) of a sensor, from rows with scales of at least
    `MIN_PUBLISHED_SCALE`; 1 for tracks that did not hear it."""
    if not len(rows):
        return np.empty(0)
    weight = weight_without_small_scales(rows) * scale_of(rows.key, sensor)
    return np.asarray(np.add.reduceat(weight, rows.first))


def delay_probabilities(rows: Rows, sensor: int) -> tuple[FloatArray, FloatArray]:
    """Return the mean delay (T,) of a sensor over the rows with a delay, s, and their weight
    (T,)."""
    delay = rows.key['delay'][:, sensor]
    if not len(rows):
        return delay, delay
    late = np.where(delay > 0.0, rows.weight, 0.0)
    total = np.add.reduceat(late, rows.first)
    return np.add.reduceat(late * delay, rows.first) / np.maximum(total, 1e-300), total
