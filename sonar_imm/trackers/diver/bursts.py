# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""Offsets that last: bursts of fixes off the target by the same vector, and single outliers.

Multipath, a wrong baseline or a sensor that is off give fixes at the target plus a vector that
lasts. Each fix is weighed in several *ways*, and each way leaves a row of its own:

- used as it is;
- an outlier: the row does not change;
- an offset begins: the last two components b of the state get a prior, and the fix measures p + b;
- from a row with an offset of this sensor: the offset stays, ends (b is nil again), or another one
  begins;
- from a row whose offset *turns*: the fix has it or not, at even odds. Two sensors that report as
  one have such fixes (`disagreement`).

An offset begins only where the target cannot have come to, so rows of clean data are never
divided. A row with an offset has a second reading: the target is where the fixes are, and the
track was wrong before. Both readings have the same filter; `jump_log_odds` weighs them, and both
are published. Rows of the same assumptions are merged.

`ways` extends the comparison of fixes with rows; the functions of this module make the rows that
the ways lead to, and end them. All other stages see rows of a table.

Source: docs/diver.md, 'Bursts'.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

from attrs import evolve
import numpy as np

from ...estimation import bank
from ...estimation.arrays import BoolArray, FloatArray, IntArray
from ...estimation.bank import Gaussians
from ...estimation.rows import Borrowed, reduce_targets, ROW_LOST, Rows
from ...measurements import NOBODY
from .known import Known, repair_covariances, row_outputs
from .models import ModelSet, NO_OFFSET
from .pairs import LEAVE, OPEN, OUTLIER, Ways
from .scan import Group
from .sensors import scale_of

TAIL = 2
"""Number of components of an offset."""


ENDED = {name: value for name, value in NO_OFFSET.items() if name not in ('took', 'taken')}
"""Assumptions about offsets of a row without one."""


MOST_BURSTS, LONGEST_BURST = 8, 60
"""Scans of several targets: maximum number of burst rows of a track, and of fixes of a burst."""

PLAIN_LOST = math.log(1e-12)
"""Log weight below which the last row without an offset is dropped."""

JUMP_FLOOR = math.log(1e-3)
"""Log odds that an established track was wrong before, when a burst begins."""

SILENT = 20
"""Number of fixes in a row at one of two places after which the other one is given up."""

DISTINCT = 2.0
"""Distance of two places in turn, in standard deviations of a fix, from which they are two."""

JUMP_SURE = 0.99
"""Probability of this reading at which the track moves to the fixes."""


def jump_log_odds(
    before: np.ndarray, others: np.ndarray, fixes: np.ndarray, end: float
) -> FloatArray:
    """Return the log odds that the target is where the fixes are, not where the track is.

    :param before: (n,) number of fixes before the burst.
    :param others: (n,) number of fixes of other sensors since.
    :param fixes: (n,) number of fixes of the sensor in the burst.
    :param end: probability of leaving the burst at a fix.
    """
    stay = math.log1p(-end)
    return np.asarray(stay * (np.minimum(before, JUMP_FLOOR / stay) + others - fixes))


# -- after the update ----------------------------------------------------------------------------


def begin_rows(
    known: Known,
    group: Group,
    ways: Ways,
    logw: FloatArray,
    link: IntArray,
    models: ModelSet,
    estimated: Sequence[BoolArray | None],
) -> list[Rows]:
    """Return the rows that the ways lead to, with the log weights `logw` (E,), if any.

    link: (D,) link of a burst that begins with each fix.
    """
    kept = np.flatnonzero(logw > -np.inf)
    if not len(kept):
        return []
    # A delay may have stood for the offset that begins: half of the weight is without it.
    late = (known.rows.key['delay'][ways.row[kept]] > 0.0).any(axis=1) & (ways.way[kept] == OPEN)
    logw = logw[kept] - math.log(2.0) * late
    again = np.flatnonzero(late)
    on_time = np.append(np.zeros(len(kept), np.bool_), late[again])
    kept, logw = np.append(kept, kept[again]), np.append(logw, logw[again])
    row, fix, way = ways.row[kept], ways.fix[kept], ways.way[kept]
    rows = known.rows.with_tail(TAIL).select(row)
    opens, outliers = way == OPEN, way == OUTLIER
    sensor, key = group.number, dict(rows.key)
    without = (way == LEAVE) & key['turns']
    plain = opens | (way == LEAVE) & ~without
    key['offset'] = np.where(opens, sensor, np.where(plain, -1, key['offset']))
    key['since'] = np.where(opens, known.stamp_ns, np.where(plain, 0, key['since']))
    before = key['taken'] + key['fixes'] + key['others']
    key['taken'] = np.where(plain, before + ~opens, key['taken'])
    key['fixes'] = np.where(opens, 1, np.where(plain | without, 0, key['fixes']))
    key['others'] = np.where(plain, 0, key['others'] + without)
    key['took'] = np.where(outliers, key['took'], known.stamp_ns)
    key['aside'] = outliers & (key['offset'] < 0)
    key['delay'] = np.where(on_time[:, None], 0.0, key['delay'])
    late, velocities = key['delay'][:, sensor], [part.outputs[2:4] for part in models.parts]
    started = _with_prior(rows.blocks, plain, np.where(opens, ways.variance[kept], 0.0))
    key['link'] = np.where(opens, link[fix], np.where(plain, 0, key['link']))
    rows = rows.replace(
        blocks=tuple(bank.move_along(b, v, -late) for b, v in zip(started, velocities))
    )
    each = np.flatnonzero(~outliers)
    R = group.R[fix[each]] * scale_of(key, sensor)[each, None, None]
    factor = np.where(opens, 1.0, 0.0)
    compared = [
        bank.compare(*bank.predict_fix(block, part.measured, factor), each, group.z[fix[each]], R)
        for block, part in zip(rows.blocks, models.parts)
    ]
    whole = bank.mixture_log_density(rows.mu[each], compared)[:, None]
    blocks, factors = [], []
    for block, part, pairs, mask in zip(rows.blocks, models.parts, compared, estimated):
        ratio = np.exp(pairs.log - whole)
        none = outliers.astype(np.float64)
        wide = with_tail_mask(mask, TAIL)
        done = bank.update(block, pairs, each, ratio, none, part.measured, wide, factor)
        blocks.append(bank.move_along(done[0], part.outputs[2:4], late))
        factors.append(done[1])
    sound, _ = repair_covariances(tuple(blocks), TAIL)
    rows, _ = rows.replace(blocks=sound).multiply_models(np.concatenate(factors, axis=1))
    return [rows.replace(key=key, logw=logw, parent=known.rows.parent[row])]


def with_tail_mask(mask: BoolArray | None, tail: int) -> BoolArray | None:
    """Return the mask of estimated components with those of the offset, which are estimated."""
    if mask is None or not tail:
        return mask
    return np.append(mask, np.ones(tail, np.bool_))


def _with_prior(
    blocks: Sequence[Gaussians], chosen: BoolArray, variance: FloatArray
) -> tuple[Gaussians, ...]:
    """Return the blocks with a new offset, of mean 0 and `variance` (N,), in the `chosen` rows
    (N,)."""
    found = []
    for block in blocks:
        x, P = block.x.copy(), block.P.copy()
        x[chosen, -TAIL:] = 0.0
        P[chosen, -TAIL:] = P[chosen, :, -TAIL:] = 0.0
        for k in range(1, TAIL + 1):
            P[chosen, -k, -k] = variance[chosen, None]
        found.append(Gaussians(x, P))
    return tuple(found)


def count_fixes(rows: Rows, sensor: int, used: BoolArray, stamp_ns: int) -> Rows:
    """Count the fix of a sensor in the rows that `used` (N,) it."""
    key = dict(rows.key)
    bursting = key['offset'] >= 0
    own = key['offset'] == sensor
    key['took'] = np.where(used, stamp_ns, key['took'])
    key['fixes'] = key['fixes'] + (used & own)
    others = np.where(used & own & key['turns'], 0, key['others'])
    key['others'] = others + (used & bursting & ~own)
    key['taken'] = key['taken'] + (used & ~bursting)
    key['aside'] = key['aside'] & ~used
    return rows.replace(key=key)


MERGED = ('scale', 'delay', 'start', 'side', 'offset', 'since', 'aside', 'turns', 'link')
"""Assumptions that rows which are merged have in common."""


def merge_rows(rows: Rows) -> Rows:
    """Merge rows of the same target and assumptions, model by model, by their moments."""
    table = np.column_stack([rows.target, *(rows.key[name] for name in MERGED)])
    _, group = np.unique(table, axis=0, return_inverse=True)
    group = group.ravel()
    count = np.bincount(group)
    if count.max(initial=0) < 2:
        return rows
    # The last of each group in order of group and weight.
    order = np.lexsort((rows.logw, group))
    heaviest = order[np.cumsum(count) - 1]
    kept = np.sort(heaviest)
    parents = rows.parent
    merged = rows.select(kept)
    blocks = [Gaussians(x.copy(), P.copy()) for x, P in merged.blocks]
    mu, logw = merged.mu.copy(), merged.logw.copy()
    for place, row in enumerate(kept.tolist()):
        own = np.flatnonzero(group == group[row])
        if len(own) < 2:
            continue
        total = np.logaddexp.reduce(rows.logw[own])
        share = np.exp(rows.logw[own] - total)[:, None] * rows.mu[own]
        whole = share.sum(axis=0)
        weight = np.where(whole > 0.0, share / np.where(whole > 0.0, whole, 1.0), 1.0 / len(own))
        first_model = 0
        for block, (x, P) in zip(rows.blocks, blocks):
            m = block.x.shape[2]
            w = weight[:, first_model : first_model + m]
            mean = (w[:, None] * block.x[own]).sum(axis=0)
            d = block.x[own] - mean
            spread = block.P[own] + d[:, :, None] * d[:, None]
            x[place], P[place] = mean, (w[:, None, None] * spread).sum(axis=0)
            first_model += m
        mu[place], logw[place] = whole / whole.sum(), total
    return merged.replace(blocks=tuple(blocks), mu=mu, logw=logw, parent=parents[kept])


def drop_rows(rows: Rows, borrowed: Borrowed, stays: BoolArray) -> tuple[Rows, Borrowed]:
    """Drop rows of negligible weight, except rows that `stays` (N,). A scale without a row is
    borrowed."""
    bursting = rows.key['offset'] >= 0
    plain = np.where(~bursting & ~rows.key['aside'], rows.logw, -np.inf)
    last = (plain == reduce_targets(np.maximum, plain, rows.target)[rows.target]) & (
        plain > PLAIN_LOST
    )
    lost = (rows.logw < math.log(ROW_LOST)) & ~stays & ~last
    lost |= bursting & ~_heaviest(rows, bursting & (rows.key['link'] != 0), MOST_BURSTS)
    if not lost.any():
        return rows, borrowed
    left = np.flatnonzero(~lost)
    table = np.column_stack([rows.target, *(rows.key[name] for name in borrowed.key)])
    have = {each.tobytes() for each in table[left]}
    gone: dict[bytes, int] = {}
    for row in np.flatnonzero(lost).tolist():
        pair = table[row].tobytes()
        if pair not in have and rows.logw[row] >= rows.logw[gone.get(pair, row)]:
            gone[pair] = row
    if gone:
        borrowed = borrowed.append(
            Borrowed.from_rows(rows.select(np.array(sorted(gone.values()))), borrowed.key)
        )
    return evolve(rows.select(left), parent=rows.parent[left]), borrowed


def end_rows(rows: Rows, ended: BoolArray) -> Rows:
    """Return the rows with the offsets of `ended` rows (N,) ended."""
    if not ended.any():
        return without_unused_tail(rows)
    return without_unused_tail(merge_rows(_without_offset(rows, ended)))


def _without_offset(rows: Rows, chosen: BoolArray) -> Rows:
    """Return the rows with the offset of the `chosen` rows (N,) set to zero."""
    ended = {name: np.where(chosen, value, rows.key[name]) for name, value in ENDED.items()}
    blocks = _with_prior(rows.blocks, chosen, np.zeros(len(rows)))
    return rows.replace(blocks=blocks, key={**rows.key, **ended})


# -- two readings --------------------------------------------------------------------------------


def reading_weights(rows: Rows, end: float) -> FloatArray:
    """Return the probability (N,) that the target of a row is where its fixes are, not where the
    offset says."""
    key = rows.key
    odds = jump_log_odds(key['taken'], key['others'], key['fixes'], end)
    # A linked track is the other reading of its row. Neither place of two in turn is the better.
    two = (key['offset'] >= 0) & (key['link'] == 0)
    return np.where(two, np.where(key['turns'], 0.5, 1.0 / (1.0 + np.exp(-odds))), 0.0)


def row_readings(rows: Rows, models: ModelSet, end: float) -> tuple[FloatArray, FloatArray]:
    """Return mean (N, q) and covariance (N, q, q) of the outputs of rows, over both readings of an
    offset."""
    maps = tuple(part.outputs for part in models.parts)
    mean, covariance = row_outputs(rows, maps)
    if not rows.tail:
        return mean, covariance
    shifted, spread = row_outputs(move_to_fixes(rows, np.ones(len(rows), np.bool_)), maps)
    q = reading_weights(rows, end)[:, None]
    centre = (1.0 - q) * mean + q * shifted
    whole = np.zeros(covariance.shape)
    for weight, m, P in ((1.0 - q, mean, covariance), (q, shifted, spread)):
        d = m - centre
        whole = whole + weight[..., None] * (P + d[:, :, None] * d[:, None])
    return centre, whole


def row_offsets(rows: Rows) -> FloatArray:
    """Return the mean offset (N, 2) of each row."""
    if not rows.tail:
        return np.zeros((len(rows), TAIL))
    x = np.concatenate([block.x[:, -TAIL:] for block in rows.with_tail(TAIL).blocks], axis=-1)
    return np.asarray((x @ rows.mu[..., None])[..., 0])


def move_to_fixes(rows: Rows, chosen: BoolArray) -> Rows:
    """Move the targets of the `chosen` rows (N,) by the offset, and end it."""
    if not rows.tail:
        return rows
    blocks = []
    for block in rows.blocks:
        x, P = block.x.copy(), block.P.copy()
        x[chosen, :2] += x[chosen, -TAIL:]
        P[chosen, :2] += P[chosen, -TAIL:]
        P[chosen, :, :2] += P[chosen, :, -TAIL:]
        blocks.append(Gaussians(x, P))
    off = chosen & (rows.key['offset'] >= 0)
    taken = np.where(off, rows.key['fixes'], rows.key['taken'])
    moved = rows.replace(blocks=tuple(blocks), key={**rows.key, 'taken': taken})
    return _without_offset(moved, chosen)


def turning(known: Known) -> BoolArray:
    """Return the tracks (T,) whose fixes are rather those of two places in turn.

    Two places nearer than `DISTINCT` standard deviations of a fix only fill the gap between two
    covariance scales.
    """
    rows, T = known.rows, len(known)
    variance = 0.5 * known['reported'][:, [0, 2]].sum(axis=1)
    square = np.square(row_offsets(rows)).sum(axis=1)
    counted = rows.key['turns'] & ~(square < DISTINCT**2 * variance[rows.target])
    return np.asarray(rows.total(np.where(counted, rows.weight, 0.0), T) > 0.5)


def jump(known: Known, group: Group) -> Known:
    """Move tracks to their fixes where the track was wrong before, almost surely.

    A track without a target ID gets a new track ID. Of two places in turn, the one without recent
    fixes is given up. A stage of the tracker.
    """
    rows = known.rows
    if not rows.tail:
        return known
    sure = reading_weights(rows, group.config.burst_end) >= JUMP_SURE
    there, here = (rows.key['turns'] & (rows.key[n] >= SILENT) for n in ('fixes', 'others'))
    if not (sure | there | here).any():
        return known
    share = rows.total(np.where(sure, rows.weight, 0.0), len(known))
    moved = _without_offset(move_to_fixes(rows, sure | there), here)
    # The path before is that of another place.
    parent = np.where(share[rows.target] > 0.5, -1, rows.parent)
    merged = without_unused_tail(merge_rows(moved.replace(parent=parent)))
    renamed = (share > 0.5) & (known['target_id'] == NOBODY)
    return known.replace(rows=merged, life=known.life.renamed(renamed))


def without_offsets(rows: Rows) -> Rows:
    """Return the rows with all offsets ended: pings do not have them."""
    return end_rows(rows, np.ones(len(rows), np.bool_)) if rows.tail else rows


def _heaviest(rows: Rows, counted: BoolArray, most: int) -> BoolArray:
    """Return the rows (N,) that are not `counted` (N,), or among the `most` heaviest of these of
    their target."""
    kept = np.ones(len(rows), np.bool_)
    own = np.flatnonzero(counted)
    order = own[np.lexsort((-rows.logw[own], rows.target[own]))]
    first = np.searchsorted(rows.target[order], rows.target[order])
    kept[order] = np.arange(len(order)) - first < most
    return kept


def divided(rows: Rows, began: Sequence[Rows]) -> BoolArray:
    """Return the rows (N,) of targets with several rows of a scale: `drop_rows` drops them."""
    strange = (rows.key['offset'] >= 0) | rows.key['aside']
    targets = [rows.target[strange], *(new.target for new in began)]
    return np.isin(rows.target, np.concatenate(targets))


def without_unused_tail(rows: Rows) -> Rows:
    """Return the rows without the components of offsets if no row has one."""
    return rows.with_tail(TAIL if (rows.key['offset'] >= 0).any() else 0)
