# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""Ways of a fix: used as it is, an outlier, or of an offset that begins, stays or ends.

`with_ways` extends the comparison of fixes with rows, see `bursts`.

Source: docs/diver.md, 'Bursts'.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

import numpy as np

from ...estimation import bank
from ...estimation.arrays import BoolArray, FloatArray, IndexArray, IntArray
from ...estimation.association import TENTATIVE
from ...estimation.rows import combine_fixes, log_sum, Rows
from .config import DiverConfig
from .known import Known, row_outputs
from .models import ModelSet
from .pairs import Groups, LEAVE, OPEN, OUTLIER, Pairs, Ways
from .scan import Group
from .sensors import scale_of

FARTHEST_OFFSET = 6.0
"""Standard deviations of a new offset beyond which no burst begins in scans of several targets."""

LEAVE_SHARE, ANEW_SHARE = 0.8, 0.2
"""Shares of `burst_end`: the offset ends, or another one begins."""

AGAIN, USED_AGAIN, OPEN_AGAIN = 0.8, 0.18, 0.02
"""Probabilities after an outlier: the next fix is one too, is used, or begins an offset."""

TAILS, TAIL_COST = (1.0, 10.0, 100.0, 1000.0), 2.3
"""Factors of the standard deviation of a new offset, and the log cost of each after the first."""

WIDER = 6.0
"""Minimum standard deviation of a new offset, relative to that of the innovation."""

REACH = 2.0
"""Standard deviations of the innovation within which no offset begins."""

BOUND = -40.0
"""Log density below which the bound of a far fix stands for all rows."""


def has_ways(group: Group, models: ModelSet) -> bool:
    """Return whether fixes of the group may be off by an offset (`bursts`)."""
    joint = is_alone(group) or group.config.pairing == 'jipda'
    return joint and models.families is not None and group.config.burst_rate > 0.0


def offset_factor(rows: Rows, sensor: int) -> FloatArray | None:
    """Return the factor (N,) of the offset in a fix of `sensor`; None where no row has one."""
    if not rows.tail:
        return None
    return np.where(rows.key['offset'] == sensor, 1.0, 0.0)


def with_ways(
    known: Known,
    group: Group,
    pairs: Pairs,
    models: ModelSet,
    openers: BoolArray | None = None,
) -> Pairs:
    """Add the ways of the fixes, and the groups of linked rows, to the comparison with the rows.

    :param openers: (T,) True for tracks of several targets on which a burst may begin; None for
        none of them.
    """
    return _with_groups(known, _add_ways(known, group, pairs, models, openers))


def _add_ways(
    known: Known, group: Group, pairs: Pairs, models: ModelSet, openers: BoolArray | None
) -> Pairs:
    """Return the pairs with the ways of the fixes; arguments as in `with_ways`."""
    rows, config, sensor = known.rows, group.config, group.number
    alone = is_alone(group)
    row, fix = _candidates(known, group, openers)
    if not len(row):
        return pairs
    offset, aside = rows.key['offset'][row], rows.key['aside'][row]
    own = offset == sensor
    turns = own & rows.key['turns'][row]
    scaled = group.R[fix] * scale_of(rows.key, sensor)[row, None, None]
    z = group.z[fix]
    excess, wide = _excess(*_row_fixes(pairs.expected, rows, row, nil=True), z, scaled)
    if own.any():
        shifted, _ = _excess(*_row_fixes(pairs.expected, rows, row, nil=False), z, scaled)
        excess = np.where(own, np.minimum(excess, shifted), excess)
    far = excess > 0.0
    some = np.flatnonzero(far)
    far[some] = excess[some] > _reach(known, group, models, row[some])
    if not alone:
        able = np.zeros(len(known), np.bool_) if openers is None else openers
        far &= able[rows.target[row]]
    if not (far.any() or aside.any() or own.any()):
        return pairs
    e, end = config.burst_rate, config.burst_end
    single = alone and (group.target_id is not None or len(group.z) == 1)
    other = (offset >= 0) & ~own
    free = ~own & ~other
    # Log prior of the fix used by the row as it is.
    used = np.zeros(len(row))
    used[far & free & ~aside] = math.log1p(-2.0 * e)
    used[free & aside] = math.log(USED_AGAIN)
    used[far & other] = math.log1p(-e)
    used[own] = np.where(turns, math.log(0.5), math.log1p(-end))[own]
    again = -np.inf, math.log(ANEW_SHARE * end), -np.inf, math.log(OPEN_AGAIN)
    opens = np.select([turns, own, other, aside], again, math.log(e))
    outliers = np.select([own & ~turns, aside], [-np.inf, math.log(AGAIN)], math.log(e))
    opens = np.where(far, opens, -np.inf)
    outliers = np.where(single & (far | aside), outliers, -np.inf)
    leaves = np.where(own, math.log(LEAVE_SHARE * end), -np.inf)
    leaves[turns] = math.log(0.5)
    log, variance = np.full(len(row), -np.inf), np.zeros(len(row))
    some = np.flatnonzero(np.isfinite(opens) | np.isfinite(outliers))
    std = np.maximum(config.burst_std, WIDER * wide[some])
    log[some], variance[some] = _opening_density(
        pairs.expected, rows, row[some], z[some], scaled[some], std, TAILS if alone else TAILS[:1]
    )
    found = []
    for way, prior in ((OPEN, opens), (OUTLIER, outliers)):
        chosen = np.flatnonzero(np.isfinite(prior))
        found.append((way, chosen, prior[chosen] + log[chosen]))
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


def _row_fixes(
    expected: Sequence[tuple[FloatArray, FloatArray]], rows: Rows, row: IndexArray, *, nil: bool
) -> tuple[FloatArray, FloatArray]:
    """Return mean (k, 2) and covariance (k, 2, 2) of the fix that rows (k,) expect. nil: without
    the offset."""
    at = row + len(rows) if nil and rows.tail else row
    return combine_fixes([(h[at], S[at]) for h, S in expected], rows.mu[row])


def _reach(known: Known, group: Group, models: ModelSet, row: IndexArray) -> FloatArray:
    """Return how far (k,) the target of each row can have moved since its last fix, m."""
    config, rows = group.config, known.rows
    if not len(row) or len(known.memory['sensors'].names) > 1:
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


def _excess(
    mean: FloatArray, covariance: FloatArray, z: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return by how much (k,) innovations exceed `REACH`, m, and their standard deviation (k,),
    m."""
    S = covariance + R
    apart = np.hypot(*(z - mean).T)
    widest = np.sqrt(np.linalg.eigvalsh(S)[:, -1])
    determinant = np.maximum(S[:, 0, 0] * S[:, 1, 1] - S[:, 0, 1] ** 2, 0.0)
    return apart - REACH * widest, determinant**0.25


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


def _with_groups(known: Known, pairs: Pairs) -> Pairs:
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
