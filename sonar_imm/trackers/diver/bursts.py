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


"""Offsets that last: bursts of fixes off the target by the same vector, and single outliers.

Multipath, a wrong baseline or a sensor that is off give fixes at the target plus a vector that
lasts. Each fix is weighed in several *ways*, and each way leaves a row of its own:

- used as it is;
- nobody's: an outlier, the row does not change;
- an offset begins: the last two components b of the state get a prior, and the fix measures p + b;
- from a row with an offset of this sensor: the offset stays, ends (b is nil again), or begins
  anew.

An offset begins only where the target cannot have come to (`Row.far`), so rows of clean data are
never divided. A row with an offset has a second reading: the target is where the fixes are, and
the track was wrong before. Both readings have the same filter; `jump_log_odds` weighs them, and
both are published. Rows of the same assumptions are merged.

`add_ways` extends the comparison of fixes with rows, `finish_update` adds the new rows after the
update. All other stages see rows of a table.

Source: docs/diver.md, 'Bursts'.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
import math

from attrs import evolve
import numpy as np

from ...estimation import bank
from ...estimation.arrays import BoolArray, FloatArray, IndexArray, IntArray
from ...estimation.association import TENTATIVE
from ...estimation.bank import Gaussians
from ...estimation.rows import Borrowed, log_sum, reduce_targets, ROW_LOST, Rows
from ...measurements import NOBODY
from .config import DiverConfig
from .known import Known, repair_covariances, row_outputs
from .models import ModelSet, NO_OFFSET
from .pairs import Association, Groups, LEAVE, NOBODYS, OPEN, Pairs, Ways
from .scan import Group, Scan
from .sensors import scale_of

TAIL = 2
"""Number of components of an offset."""

LEAVE_SHARE, ANEW_SHARE = 0.8, 0.2
"""Shares of `burst_end`: the offset ends, or another one begins."""

AGAIN, USED_AGAIN, OPEN_AGAIN = 0.8, 0.18, 0.02
"""After a fix that was nobody's: probabilities that the next is nobody's, used, or begins an
offset."""

TAILS, TAIL_COST = (1.0, 10.0, 100.0, 1000.0), 2.3
"""Factors of the standard deviation of a new offset, and the log cost of each after the first."""

WIDER = 6.0
"""Minimum standard deviation of a new offset, relative to that of the innovation."""

REACH = 2.0
"""Standard deviations of the innovation within which no offset begins."""

ENDED = {name: value for name, value in NO_OFFSET.items() if name not in ('took', 'taken')}
"""Assumptions about offsets of a row without one."""

FARTHEST_OFFSET = 6.0
"""Standard deviations of a new offset beyond which no burst begins in scans of several targets."""

MISSED, DIRECT_FIXES = 0.02, 10
"""Scans of several targets: share of a miss, and number of fixes before, for a burst to begin."""

OPEN_ODDS, OPEN_WEIGHT = 1e-3, 2e-4
"""Scans of several targets: odds to a miss, and weight, of a burst that begins."""

CLAIM = 0.3
"""Probability above which a tentative track has the fix of a burst."""

MOST_BURSTS, LONGEST_BURST = 4, 60
"""Scans of several targets: maximum number of burst rows of a track, and of fixes of a burst."""

PLAIN_LOST = math.log(1e-12)
"""Log weight below which the last row without an offset is dropped."""

BOUND = -40.0
"""Log density below which the bound of a far fix stands for all rows."""

JUMP_FLOOR = math.log(1e-3)
"""Log odds that an established track was wrong before, when a burst begins."""

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


# -- comparison ----------------------------------------------------------------------------------


def offset_factor(rows: Rows, sensor: int) -> FloatArray | None:
    """Return the factor (N,) of the offset in a fix of `sensor`; None where no row has one."""
    if not rows.tail:
        return None
    return np.where(rows.key['offset'] == sensor, 1.0, 0.0)


def add_ways(
    known: Known,
    group: Group,
    pairs: Pairs,
    models: ModelSet,
    openers: BoolArray | None = None,
) -> Pairs:
    """Add the ways of the fixes to the comparison with the rows.

    :param openers: (T,) True for tracks of several targets on which a burst may begin; None for
        none of them.
    """
    rows, config = known.rows, group.config
    sensor = known.memory['sensors'].number(group.sensor)
    alone = is_alone(group)
    row, fix = _candidates(known, group, openers)
    if not len(row):
        return pairs
    key = {name: column[row] for name, column in rows.key.items()}
    own = key['offset'] == sensor
    scaled = group.R[fix] * scale_of(key, sensor)[:, None, None]
    z = group.z[fix]
    plain = _row_fixes(pairs.expected, rows, row, nil=True)
    reach = _reach(known, group, models, row)
    far, wide = _is_far(*plain, z, scaled, reach)
    if own.any():
        shifted = _row_fixes(pairs.expected, rows, row, nil=False)
        far_shifted, wide_shifted = _is_far(*shifted, z, scaled, reach)
        far &= far_shifted | ~own
    aside = key['aside']
    if not alone:
        able = np.zeros(len(known), np.bool_) if openers is None else openers
        far &= able[rows.target[row]]
    if not (far.any() or aside.any() or own.any()):
        return pairs
    e, end = config.burst_rate, config.burst_end
    single = alone and (group.target_id is not None or len(group.z) == 1)
    other = (key['offset'] >= 0) & ~own
    free = ~own & ~other
    # Log prior of the fix used by the row as it is.
    used = np.zeros(len(row))
    used[far & free & ~aside] = math.log1p(-2.0 * e)
    used[free & aside] = math.log(USED_AGAIN)
    used[far & other] = math.log1p(-e)
    used[own] = math.log1p(-end)
    again = math.log(ANEW_SHARE * end), -np.inf, math.log(OPEN_AGAIN)
    opens = np.select([own, other, aside], again, math.log(e))
    nobodys = np.select([own, aside], [-np.inf, math.log(AGAIN)], math.log(e))
    opens = np.where(far, opens, -np.inf)
    nobodys = np.where(single & (far | aside), nobodys, -np.inf)
    leaves = np.where(own, math.log(LEAVE_SHARE * end), -np.inf)
    asked = np.isfinite(opens) | np.isfinite(nobodys)
    log, variance = np.full(len(row), -np.inf), np.zeros(len(row))
    some = np.flatnonzero(asked)
    std = np.maximum(config.burst_std, WIDER * wide[some])
    log[some], variance[some] = _opening_density(
        pairs.expected, rows, row[some], z[some], scaled[some], std, TAILS if alone else TAILS[:1]
    )
    found = []
    for way, prior, density in ((OPEN, opens, log), (NOBODYS, nobodys, log)):
        chosen = np.flatnonzero(np.isfinite(prior))
        found.append((way, chosen, prior[chosen] + density[chosen]))
    chosen = np.flatnonzero(own)
    direct = _log_density(pairs.expected, rows, row[chosen], z[chosen], scaled[chosen])
    found.append((LEAVE, chosen, leaves[chosen] + direct))
    at = np.concatenate([chosen for _, chosen, _ in found])
    ways = Ways(
        row[at],
        fix[at],
        np.concatenate([np.full(len(chosen), way) for way, chosen, _ in found]),
        variance[at],
        np.concatenate([each for *_, each in found]),
        np.ones(pairs.track_log.shape),
    )
    return _with_ways(rows, pairs, ways, row, fix, used)


def is_alone(group: Group) -> bool:
    """Return whether a fix is of one target only: a single one, or one with an ID."""
    return group.target_id is not None or group.config.max_tracks == 1


def _candidates(
    known: Known, group: Group, openers: BoolArray | None
) -> tuple[IndexArray, IndexArray]:
    """Return the rows and fixes (k,) that are compared in several ways."""
    rows, T = known.rows, len(known)
    if group.target_id is not None:
        own = known['target_id'][:, None] == group.target_id
    else:
        firm = known.life.status != TENTATIVE
        if not is_alone(group):
            bursting = np.zeros(T, np.bool_)
            bursting[rows.target[rows.key['offset'] >= 0]] = True
            firm = firm & (bursting if openers is None else bursting | openers)
        own = np.broadcast_to(firm[:, None], (T, len(group.z)))
    row, fix = np.nonzero(own[rows.target])
    if not is_alone(group):
        # A fix far beyond a usual offset is of another target: spare its comparison.
        place = np.stack([block.x[:, :2].mean(axis=2) for block in rows.blocks]).mean(axis=0)
        spread = np.sqrt(np.max([block.P[:, 0, 0].max(axis=1) for block in rows.blocks], axis=0))
        reach = FARTHEST_OFFSET * np.maximum(group.config.burst_std, WIDER * spread)
        near = np.hypot(*(group.z[fix] - place[row]).T) < reach[row]
        row, fix = row[near], fix[near]
    return row, fix


def openers(known: Known, association: Association) -> BoolArray:
    """Return the tracks (T,) on which a burst may begin in a scan of several targets."""
    rows = known.rows
    taken = np.zeros(len(known), np.int64)
    np.maximum.at(taken, rows.target, rows.key['taken'])
    missed = association.missed > MISSED * np.maximum(association.exists, 1e-300)
    firm = (known.life.status != TENTATIVE) & (known['target_id'] == NOBODY)
    return np.asarray(firm & missed & (taken >= DIRECT_FIXES))


def _row_fixes(
    expected: Sequence[tuple[FloatArray, FloatArray]], rows: Rows, row: IndexArray, *, nil: bool
) -> tuple[FloatArray, FloatArray]:
    """Return mean (k, 2) and covariance (k, 2, 2) of the fix that rows (k,) expect. nil: without
    the offset."""
    at = row + len(rows) if nil and rows.tail else row
    return bank.combine_fixes([(h[at], S[at]) for h, S in expected], rows.mu[row])


def _reach(known: Known, group: Group, models: ModelSet, row: IndexArray) -> FloatArray:
    """Return how far (k,) the target of each row can have moved since its last fix, m."""
    config, rows = group.config, known.rows
    if len(known.memory['sensors'].names) > 1:
        return np.zeros(len(row))
    outputs = tuple(part.outputs[velocity_outputs(models)] for part in models.parts)
    velocity, _ = row_outputs(rows.select(row), outputs)
    speed = fastest_speed(velocity, config)
    took = np.maximum(rows.key['took'], 0)[row]
    took = np.where(took > 0, took, known.life.last_hit_ns[rows.target[row]])
    return np.asarray(speed * (known.stamp_ns - took) * 1e-9)


def velocity_outputs(models: ModelSet) -> slice:
    """Return the outputs that are the horizontal velocity."""
    return slice(2, 4) if models.height < 0 else slice(3, 5)


def fastest_speed(velocity: FloatArray, config: DiverConfig) -> FloatArray:
    """Return the highest speed (...,), m/s, of a target with `velocity` (..., 2): it may turn
    round."""
    moving = np.hypot(velocity[..., 0], velocity[..., 1])
    return np.asarray(config.speed_mean + 3.0 * config.speed_std + moving)


def _is_far(
    mean: FloatArray, covariance: FloatArray, z: FloatArray, R: FloatArray, reach: FloatArray
) -> tuple[BoolArray, FloatArray]:
    """Return whether a fix (k,) is where the target cannot be, and the standard deviation (k,) of
    the innovation, m."""
    S = covariance + R
    apart = np.hypot(*(z - mean).T)
    widest = np.sqrt(np.linalg.eigvalsh(S)[:, -1])
    determinant = np.maximum(S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] ** 2, 0.0)
    return apart > reach + REACH * widest, determinant**0.25


def _log_density(
    expected: Sequence[tuple[FloatArray, FloatArray]],
    rows: Rows,
    row: IndexArray,
    z: FloatArray,
    R: FloatArray,
) -> FloatArray:
    """Return the log density (k,) of fixes under rows without their offset."""
    at = row + len(rows) if rows.tail else row
    compared = tuple(bank.compare(h, S, at, z, R) for h, S in expected)
    return bank.mixture_log_density(rows.mu[row], compared)


def _opening_density(
    expected: Sequence[tuple[FloatArray, FloatArray]],
    rows: Rows,
    row: IndexArray,
    z: FloatArray,
    R: FloatArray,
    std: FloatArray,
    tails: Sequence[float],
) -> tuple[FloatArray, FloatArray]:
    """Return the log density (k,) of fixes with a new offset, and the variance (k,) of the offset.

    std: (k,) standard deviation of an offset, m. The best of `tails` counts.
    """
    best, variance = np.full(len(row), -np.inf), np.zeros(len(row))
    for k, factor in enumerate(tails):
        own = np.square(factor * std)
        log = _log_density(expected, rows, row, z, R + own[:, None, None] * np.eye(2))
        log = log - k * TAIL_COST
        better = log > best
        best, variance = np.where(better, log, best), np.where(better, own, variance)
    return best, variance


def _with_ways(
    rows: Rows, pairs: Pairs, ways: Ways, row: IndexArray, fix: IntArray, used: FloatArray
) -> Pairs:
    """Return the pairs with `ways`, and with the log priors `used` (k,) of rows and fixes."""
    among, D = pairs.among, pairs.track_log.shape[1]
    prior = np.zeros((len(rows), D))
    prior[row, fix] = used
    own = among.has_row[pairs.assumption]
    log = pairs.log.copy()
    log[own] += prior[among.row[pairs.assumption[own]], pairs.fix[own]]
    track = among.target[pairs.assumption], rows.target[ways.row]
    compared = pairs._replace(log=log)
    whole = _whole_density(rows, compared, ways, *track, pairs.track_log)
    strange = np.zeros(whole.size)
    new = ways.way != LEAVE
    at = rows.target[ways.row[new]] * D + ways.fix[new]
    np.add.at(strange, at, np.exp(rows.logw[ways.row] + ways.log)[new] / np.exp(whole.ravel()[at]))
    direct = np.clip(1.0 - strange.reshape(whole.shape), 0.0, 1.0)
    return compared._replace(track_log=whole, ways=ways._replace(direct=direct))


def _whole_density(
    rows: Rows, pairs: Pairs, ways: Ways | None, of: IntArray, of_ways: IntArray, bound: FloatArray
) -> FloatArray:
    """Return the log density (G, D) of each fix, over all pairs of each of G groups and all ways.

    :param of: (p,) group of each pair.
    :param of_ways: (E,) group of each way.
    :param bound: (G, D) bound of the density of a fix that is far from all rows.
    """
    D = bound.shape[1]
    every = pairs.among.logw[pairs.assumption] + pairs.log
    place = of * D + pairs.fix
    compared = np.zeros(bound.size, np.bool_)
    compared[place] = True
    if ways is not None:
        every = np.concatenate([every, rows.logw[ways.row] + ways.log])
        place = np.concatenate([place, of_ways * D + ways.fix])
    places, number = np.unique(place, return_inverse=True)
    order = np.argsort(number, kind='stable')
    whole = bound.copy()
    rest = np.where(compared[places], -np.inf, bound.ravel()[places])
    whole.ravel()[places] = np.logaddexp(log_sum(every[order], number[order]), rest)
    return whole


def with_groups(known: Known, pairs: Pairs) -> Pairs:
    """Return the pairs with the groups of linked rows, if there are any."""
    rows, among, T = known.rows, pairs.among, len(known)
    ids = {int(each): k for k, each in enumerate(known.life.track_id)}
    link = np.array([ids.get(each, -1) for each in rows.key['link'].tolist()], np.int64)
    linked = np.flatnonzero(link >= 0)
    if not len(linked):
        return pairs
    of_row = rows.target.copy()
    of_row[linked] = T + np.arange(len(linked))
    of = np.where(among.has_row, of_row[among.row], among.target)
    target = np.concatenate([np.arange(T), rows.target[linked]])
    bound = np.full((len(target), pairs.track_log.shape[1]), -np.inf)
    bound[:T] = np.where(pairs.track_log < BOUND, pairs.track_log, -np.inf)
    ways = pairs.ways
    of_ways = np.empty(0, np.int64) if ways is None else of_row[ways.row]
    log = _whole_density(rows, pairs, ways, of[pairs.assumption], of_ways, bound)
    weight = np.bincount(of, np.exp(among.logw), minlength=len(target)).astype(np.float64)
    links = np.concatenate([np.full(T, -1), link[linked]])
    return pairs._replace(groups=Groups(of, target, links, weight, log))


# -- after the update ----------------------------------------------------------------------------


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
    marks = birth_marks(known, group)
    tentative = np.flatnonzero(known.life.status == TENTATIVE)
    if not len(tentative):
        return marks
    claims = association.beta[tentative]
    ids = known.life.track_id[tentative].astype(np.int64)[claims.argmax(axis=0)]
    return np.where(association.free, marks, ids)


def birth_marks(known: Known, group: Group) -> IntArray:
    """Return a number (D,) below -1 for the track that each fix may begin."""
    sensor = known.memory['sensors'].number(group.sensor)
    return -2 - np.arange(len(group.z)) - sensor * 10**6


def begin_rows(
    known: Known,
    group: Group,
    ways: Ways,
    logw: FloatArray,
    models: ModelSet,
    estimated: Sequence[BoolArray | None],
) -> Rows | None:
    """Return the rows that the ways lead to, with the weights `logw` (E,); None for none."""
    kept = np.flatnonzero(logw > -np.inf)
    if not len(kept):
        return None
    row, fix, way = ways.row[kept], ways.fix[kept], ways.way[kept]
    rows = known.rows.with_tail(TAIL).select(row)
    opens, nobodys = way == OPEN, way == NOBODYS
    sensor = known.memory['sensors'].number(group.sensor)
    key = dict(rows.key)
    plain = opens | (way == LEAVE)
    key['offset'] = np.where(opens, sensor, np.where(plain, -1, key['offset']))
    key['since'] = np.where(opens, known.stamp_ns, np.where(plain, 0, key['since']))
    before = key['taken'] + key['fixes'] + key['others']
    key['taken'] = np.where(plain, before + ~opens, key['taken'])
    key['fixes'] = np.where(opens, 1, np.where(plain, 0, key['fixes']))
    key['others'] = np.where(plain, 0, key['others'])
    key['took'] = np.where(nobodys, key['took'], known.stamp_ns)
    key['aside'] = nobodys & (key['offset'] < 0)
    late, velocities = key['delay'][:, sensor], [part.outputs[2:4] for part in models.parts]
    started = _with_prior(rows.blocks, plain, np.where(opens, ways.variance[kept], 0.0))
    key['link'] = np.where(
        opens, links_of_fixes(known, group)[fix], np.where(plain, 0, key['link'])
    )
    rows = rows.replace(
        blocks=tuple(bank.move_along(b, v, -late) for b, v in zip(started, velocities))
    )
    each = np.flatnonzero(~nobodys)
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
        none = nobodys.astype(np.float64)
        wide = with_tail_mask(mask, TAIL)
        done = bank.update(block, pairs, each, ratio, none, part.measured, wide, factor)
        blocks.append(bank.move_along(done[0], part.outputs[2:4], late))
        factors.append(done[1])
    sound, _ = repair_covariances(tuple(blocks), TAIL)
    rows, _ = rows.replace(blocks=sound).multiply_models(np.concatenate(factors, axis=1))
    return rows.replace(key=key, logw=logw[kept], parent=known.rows.parent[row])


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
    key['others'] = key['others'] + (used & bursting & ~own)
    key['taken'] = key['taken'] + (used & ~bursting)
    key['aside'] = key['aside'] & ~used
    return rows.replace(key=key)


MERGED = ('scale', 'delay', 'start', 'offset', 'since', 'aside', 'link')
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


# -- links ---------------------------------------------------------------------------------------


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
    return known.replace(rows=_end_rows(rows.replace(key={**rows.key, 'link': link}), ended))


def update_links(known: Known, _: Scan) -> Known:
    """End rows whose linked track is confirmed, and rows of long bursts. A stage of the tracker.

    A row whose linked track has ended is linked to none (-1).
    """
    rows = known.rows
    if not rows.tail or not (rows.key['link'] != 0).any():
        return known
    key = rows.key
    status = dict(zip(known.life.track_id.tolist(), known.life.status.tolist()))
    state = np.array([status.get(each, -1) for each in key['link'].tolist()])
    link = np.where((key['link'] > 0) & (state < 0), -1, key['link'])
    rows = rows.replace(key={**key, 'link': link})
    wrong = (key['link'] > 0) & (state > TENTATIVE)
    if wrong.any():
        kept = np.where(wrong, -np.inf, rows.logw)
        left = rows.log_sum(kept)[rows.target]
        # A row stays where it is the last.
        kept = np.where(np.isfinite(left), kept - left, rows.logw)
        some = np.flatnonzero(np.isfinite(kept))
        rows = evolve(rows.replace(logw=kept).select(some), parent=rows.parent[some])
    long = (rows.key['link'] != 0) & (
        rows.key['fixes'] >= np.minimum(LONGEST_BURST, rows.key['taken'])
    )
    return known.replace(rows=_end_rows(rows, long))


def _end_rows(rows: Rows, ended: BoolArray) -> Rows:
    """Return the rows with the offsets of `ended` rows (N,) ended."""
    if not ended.any():
        return without_unused_tail(rows)
    key = {
        name: np.where(ended, ENDED[name], column) if name in ENDED else column
        for name, column in rows.key.items()
    }
    blocks = _with_prior(rows.blocks, ended, np.zeros(len(rows)))
    return without_unused_tail(merge_rows(rows.replace(key=key, blocks=blocks)))


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


# -- two readings --------------------------------------------------------------------------------


def reading_weights(rows: Rows, end: float) -> FloatArray:
    """Return the probability (N,) that the target of a row is where its fixes are, not where the
    offset says."""
    key = rows.key
    odds = jump_log_odds(key['taken'], key['others'], key['fixes'], end)
    # A linked track is the other reading of its row.
    two = (rows.key['offset'] >= 0) & (rows.key['link'] == 0)
    return np.where(two, 1.0 / (1.0 + np.exp(-odds)), 0.0)


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
    key = dict(rows.key)
    key['taken'] = np.where(chosen & (key['offset'] >= 0), key['fixes'], key['taken'])
    for name in ('offset', 'since', 'fixes', 'others'):
        key[name] = np.where(chosen, NO_OFFSET[name], key[name])
    return rows.replace(blocks=_with_prior(blocks, chosen, np.zeros(len(rows))), key=key)


def jump(known: Known, group: Group) -> Known:
    """Move tracks to their fixes where the track was wrong before, almost surely.

    A track without a target ID gets a new track ID. A stage of the tracker.
    """
    rows = known.rows
    if not rows.tail:
        return known
    sure = reading_weights(rows, group.config.burst_end) >= JUMP_SURE
    if not sure.any():
        return known
    share = rows.total(np.where(sure, rows.weight, 0.0), len(known))
    moved = move_to_fixes(rows, sure)
    # The path before is that of another place.
    parent = np.where(share[rows.target] > 0.5, -1, rows.parent)
    merged = without_unused_tail(merge_rows(moved.replace(parent=parent)))
    renamed = (share > 0.5) & (known['target_id'] == NOBODY)
    return known.replace(rows=merged, life=known.life.renamed(renamed))


def without_offsets(rows: Rows) -> Rows:
    """Return the rows with all offsets ended: pings do not have them."""
    if not rows.tail:
        return rows
    ended = {name: np.full(len(rows), value) for name, value in ENDED.items()}
    return merge_rows(rows.with_tail(0).replace(key={**rows.key, **ended}))


def _heaviest(rows: Rows, counted: BoolArray, most: int) -> BoolArray:
    """Return the rows (N,) that are not `counted` (N,), or among the `most` heaviest of these of
    their target."""
    kept = np.ones(len(rows), np.bool_)
    own = np.flatnonzero(counted)
    order = own[np.lexsort((-rows.logw[own], rows.target[own]))]
    first = np.searchsorted(rows.target[order], rows.target[order])
    kept[order] = np.arange(len(order)) - first < most
    return kept


def divided(rows: Rows, began: Rows | None) -> BoolArray:
    """Return the rows (N,) of targets with several rows of a scale: `drop_rows` drops them."""
    strange = (rows.key['offset'] >= 0) | rows.key['aside']
    targets = rows.target[strange]
    if began is not None:
        targets = np.concatenate([targets, began.target])
    return np.isin(rows.target, targets)


def without_unused_tail(rows: Rows) -> Rows:
    """Return the rows without the components of offsets if no row has one."""
    return rows.with_tail(TAIL if (rows.key['offset'] >= 0).any() else 0)
