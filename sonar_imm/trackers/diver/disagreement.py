# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Innovations of fixes: checks of their covariances, and sensors that disagree.

If two sensors are apart by a constant vector, large scales explain it before an offset does: with
the covariances that scales grant, no fix is far from the track. So if the means of the last
innovations of two sensors differ significantly, a row begins with scales 1 and an offset of the
sensor that reports. Both readings of an offset are even then (`bursts`).

Two sensors may report as one. If the last innovations of the only sensor lie in two groups that
take turns, rows begin whose offset turns: each fix has it or not.

Source: docs/diver.md, 'Several sensors'.
"""

from __future__ import annotations

from collections.abc import Sequence
import math

from attrs import evolve
import numpy as np

from ...estimation.arrays import BoolArray, FloatArray
from ...estimation.association import TENTATIVE
from ...estimation.bank import Gaussians
from ...estimation.rows import combine_fixes, Rows
from . import bursts
from .innovations import FixConsistency, whiten_innovations
from .known import Feature, Known
from .models import ModelSet, USUAL_SCALES
from .offsets import RecentPairs
from .pairs import OPEN, Ways
from .scales import estimated_scales, weight_without_small_scales
from .scan import Group
from .sensors import MOST_SENSORS

RECENT, LEAST_GROUP = 12, 4
"""Number of innovations that are compared with two places in turn, and minimum number of either,
and of changes between them."""

SEPARATE = 4.5
"""Minimum distance of two places, in standard deviations of the innovations of one."""

FEATURES = {
    'nis': Feature(math.nan),
    'nis_dof': Feature(0, kind=np.uint16),
    'white': Feature(math.nan, (MOST_SENSORS, 2)),
    'reported': Feature(math.nan, (3,)),
    'lately': Feature(0.0, (MOST_SENSORS, 4)),
    'innovations': Feature(math.nan, (RECENT, 2)),
}
"""nis, nis_dof: of this scan, NaN and 0 without a hit.

white: whitened innovation of the last fix of each sensor.

reported: covariance (xx, xy, yy) of the last fix, m^2, times the estimated scale.

lately: number of the last innovations of each sensor, and sums of their x, y, m, and variance,
m^2.

innovations: last innovations, m, those of outliers too.
"""

LATELY, ENOUGH = 10.0, 3.4
"""Number of innovations over which `lately` forgets, and minimum number for a comparison."""

DISAGREE = 25.0
"""Minimum chi-square of the difference of two means."""

VISIBLE = 0.1
"""Minimum variance of a fix, relative to that of its prediction, that innovations show."""

BEGINS = 0.01
"""Weight of a row with an offset between two sensors, when it begins."""


def record_innovations(known: Known, group: Group, models: ModelSet) -> Known:
    """Store the whitened innovations of associated fixes, and update the covariance checks."""
    association, pairs = group.association, group.pairs
    assert association is not None and pairs is not None
    if len(group.z):
        known = _with_consistency(
            known,
            group,
            known.memory['fixes']
            .of(group.number)
            .with_covariances(group.is_stated, group.config.has_usual_fix_std),
        )
    taken = np.flatnonzero(association.taken)
    if not len(taken):
        return known
    count = len(known.rows)
    seen = combine_fixes([(h[:count], S[:count]) for h, S in pairs.expected], known.rows.mu)
    mean, covariance = known.rows.combine(*seen, weight_without_small_scales(known.rows))
    new = group.z[association.beta[taken].argmax(axis=1)] - mean[taken]
    last = known['innovations'].copy()
    last[taken] = np.concatenate([last[taken, 1:], new[:, None]], axis=1)
    known = known.with_columns(innovations=last)
    tracks = np.flatnonzero(association.hit)
    if not len(tracks):
        return known
    fix = association.fix[tracks]
    scale = (
        estimated_scales(known.rows, group.number)[tracks]
        if len(models.scales) > 1
        else np.ones(len(tracks))
    )
    R = group.R[fix] * scale[:, None, None]
    # Of two places in turn, and of late stamps on a bend, innovations do not show covariances.
    late = np.where(known.rows.key['delay'].any(axis=1), known.rows.weight, 0.0)
    explained = (known.rows.total(late, len(known)) > 0.5) | bursts.turning(known)
    tentative = ((known.life.status == TENTATIVE) | explained)[tracks]
    motion = covariance[tracks].trace(axis1=1, axis2=2)
    hidden = R.trace(axis1=1, axis2=2) < VISIBLE * motion
    before: FixConsistency = known.memory['fixes'].of(group.number)
    white, after = whiten_innovations(
        mean[tracks],
        covariance[tracks],
        group.z[fix],
        R,
        known['white'][tracks, group.number],
        tentative,
        before,
    )
    after = after.with_scale(scale, tentative, hidden)
    names = 'white', 'nis', 'nis_dof', 'reported', 'lately'
    columns = {name: known[name].copy() for name in names}
    columns['white'][tracks, group.number] = white
    columns['reported'][tracks] = R[:, [0, 0, 1], [0, 1, 1]]
    columns['lately'][tracks, group.number] = _with_innovations(
        columns['lately'][tracks, group.number],
        group.z[fix] - mean[tracks],
        covariance[tracks] + group.R[fix],
    )
    columns['nis'][tracks] += np.square(white).sum(axis=1)
    columns['nis_dof'][tracks] += np.uint16(2)
    # With fixes, no instrument errors are assumed.
    return _with_consistency(known.with_columns(**columns), group, after).with_memory(
        recent=RecentPairs()
    )


def _with_consistency(known: Known, group: Group, consistency: FixConsistency) -> Known:
    """Return the state with the consistency of the sensor of a group."""
    fixes = known.memory['fixes'].with_sensor(group.number, consistency)
    return known.with_memory(fixes=fixes)


def _with_innovations(lately: FloatArray, v: FloatArray, S: FloatArray) -> FloatArray:
    """Add innovations v (k, 2) with covariances S (k, 2, 2) to the sums (k, 4)."""
    variance = 0.5 * S.trace(axis1=1, axis2=2)
    new = np.column_stack([np.ones(len(v)), v, variance])
    return np.asarray((1.0 - 1.0 / LATELY) * lately + new)


def sensors_disagree(lately: FloatArray, sensor: int) -> BoolArray:
    """Return which tracks (T,) have a sensor whose innovations differ from those of `sensor`.

    lately: (T, MOST_SENSORS, 4) see `FEATURES`.
    """
    number = lately[..., 0]
    enough = (number >= ENOUGH) & (number[:, sensor, None] >= ENOUGH)
    count = np.maximum(number, 1.0)
    mean, variance = lately[..., 1:3] / count[..., None], lately[..., 3] / count**2
    apart = np.square(mean - mean[:, sensor, None]).sum(axis=2)
    spread = variance + variance[:, sensor, None]
    return np.asarray((enough & (apart > DISAGREE * spread)).any(axis=1))


def two_places(innovations: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the distance (T,), m, of two places that innovations (T, n, 2) take in turns, and the
    standard deviation (T,), m, at one of them along it; 0 and infinite for other innovations."""
    apart = np.zeros(len(innovations)), np.full(len(innovations), np.inf)
    whole = np.flatnonzero(np.isfinite(innovations).all(axis=(1, 2)))
    v = innovations[whole]
    v = v - v.mean(axis=1, keepdims=True)
    axis = np.linalg.eigh(np.swapaxes(v, 1, 2) @ v)[1][..., -1]
    along = (v @ axis[..., None])[..., 0]
    middle = 0.5 * (along.min(axis=1) + along.max(axis=1))
    second = along > middle[:, None]
    count = second.sum(axis=1)
    changes = (second[:, 1:] != second[:, :-1]).sum(axis=1)
    least = np.minimum(np.minimum(count, along.shape[1] - count), changes)
    own = np.flatnonzero(least >= LEAST_GROUP)
    along, second, count = along[own], second[own], count[own, None]
    high = np.where(second, along, 0.0).sum(axis=1, keepdims=True) / count
    low = np.where(second, 0.0, along).sum(axis=1, keepdims=True) / (along.shape[1] - count)
    within = np.square(along - np.where(second, high, low)).mean(axis=1)
    apart[0][whole[own]], apart[1][whole[own]] = (high - low)[:, 0], np.sqrt(within)
    return apart


def begin_disagreement(
    known: Known, group: Group, models: ModelSet, estimated: Sequence[BoolArray | None]
) -> list[Rows]:
    """Return rows with an offset of the sensor, for tracks whose sensors disagree, or whose sensor
    shows two places in turn, if any.

    A track that has a row with an offset gets none; for two places, one of weight.

    estimated: as for `fixes.update_tracks`.
    """
    association, rows, T = group.association, known.rows, len(known)
    if association is None or not T:
        return []
    off, heavy = rows.key['offset'] >= 0, rows.logw > math.log(BEGINS)
    held, firm = (np.bincount(rows.target, each, T) > 0 for each in (off, off & heavy))
    fix = association.beta.argmax(axis=1) if len(group.z) else association.fix
    distance, std = two_places(known['innovations'])
    R = group.R[fix].trace(axis1=1, axis2=2) / 2.0 if len(group.z) else std
    turns = association.taken & ~firm & (len(known.memory['sensors'].names) == 1)
    turns &= (distance > SEPARATE * std) & (np.square(distance) > DISAGREE * R)
    turns &= np.bincount(rows.target, rows.key['turns'], T) == 0
    found = association.hit & ~held & ~turns & sensors_disagree(known['lately'], group.number)
    track = np.flatnonzero(found | turns)
    if not len(track):
        return []
    # Of two places in turn, scales explain what is stated too small besides.
    usual = [s for s in models.scales if 1.0 <= s <= USUAL_SCALES[1]]
    each = [(t, s) for t in track.tolist() for s in (usual if turns[t] else [1.0])]
    track, scale = (np.array(column) for column in zip(*each))
    heaviest = np.lexsort((rows.logw, rows.target))[np.cumsum(np.bincount(rows.target)) - 1]
    row, turn = heaviest[track], turns[track]
    started = rows.select(row)
    key = dict(started.key)
    key['scale'] = np.where(key['scale'] > 0.0, 1.0, 0.0)
    key['scale'][:, group.number] = scale
    key |= {'delay': np.zeros_like(key['delay']), 'turns': turn}
    # The track lies between the two places.
    blocks, wider = [], np.where(turn, 0.25 * distance[track] ** 2, 0.0)
    for block in started.blocks:
        P = block.P.copy()
        P[:, [0, 1], [0, 1]] += wider[:, None, None]
        blocks.append(Gaussians(block.x, P))
    N = len(row)
    ways = Ways(
        np.arange(N),
        fix[track],
        np.full(N, OPEN),
        np.maximum(group.config.burst_std, np.where(turn, distance[track], 0.0)) ** 2,
        np.zeros(N),
        np.ones((T, len(group.z))),
    )
    stated = known.replace(rows=started.replace(key=key, blocks=tuple(blocks)))
    weight, link = np.full(N, math.log(BEGINS)), np.zeros(len(group.z), np.int64)
    (began,) = bursts.begin_rows(stated, group, ways, weight, link, models, estimated)
    taken = np.zeros_like(began.key['taken'])
    return [evolve(began, key={**began.key, 'taken': taken}, parent=rows.parent[row])]
