# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Depth as a state (`dimensions: 3`): update by fix heights, and depth hypotheses.

*Fixes.* Association and the update by x and y ignore z. Then z updates the track of the fix as one
more scalar, corrected by the known errors of x and y. With ``R`` the covariance of the fix, split
into (x, y), z and their cross-covariance,

    z - g (x, y) = z_track - g (x, y)_track + e,    g = R_z,xy R_xy^-1,    var e = R_zz - g R_xy,z

where e is uncorrelated with the errors of x and y. The two updates equal one update by all three
coordinates. The likelihood of z also weights models and rows.

z has a gate of its own with one coordinate, because a surface echo is wrong in z only. A rejected
z is stored; if the next rejected z agrees, the depth restarts there.

*Rows.* Path lengths depend on (z - z_receiver)^2, so arrivals cannot tell a target above the
receivers from one below. At long range all rows may agree on an uncertain depth. When the target
then comes near, one Gaussian cannot split into two depths, and all rows may converge to the wrong
one. Therefore rows that agree are spread before a ping whose paths bend within their variance. The
Gaussian becomes a sum of narrower ones with the same mean and variance, and the arrivals weight
them.
"""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import NamedTuple

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray
from ...estimation.association import gate_threshold
from ...estimation.bank import Gaussians, LOG_2PI
from ...estimation.covariance import add_jitter
from ...estimation.rows import LEAST_LOG, Rows
from . import bursts, ways
from .config import DiverConfig
from .instruments import Layout
from .known import Feature, Known, repair_covariances, row_outputs
from .models import ModelSet
from .scan import Group, Height, Ping

FEATURES = {
    'rejected_z': Feature(math.nan, (3,)),
    'respreads': Feature(0, kind=np.int64),
}
"""rejected_z: stamp, z and variance of the last rejected fix height, NaN for none; respreads:
number of times the rows were spread."""

DOUBTED = 0.1
"""Fraction of implausible fix heights that triggers a warning, once `MANY` heights were
received."""

MANY = 20
"""Minimum number of fix heights for a warning."""

BEYOND = 3.0
"""Standard deviations outside the water column at which a height is implausible."""

AGREE = 0.5
"""Rows agree if the variance of their means is below this fraction of their variance."""

BENT = 0.1
"""Path curvature over the z uncertainty, in standard deviations of an arrival, at which rows are
spread. It is below 1 because the effect is equal in all pings."""

APART, POSSIBLE = 2.0, 0.05
"""A depth is ambiguous if the rows above and below a gap each weigh more than `POSSIBLE`. A gap is
wider than `APART` times the summed standard deviations of its neighbours."""


class HeightCounts(NamedTuple):
    """Counters of the fix heights of tracks."""

    seen: int = 0
    """Number of heights."""
    rejected: int = 0
    """Number of heights rejected by the gate."""
    outside: int = 0
    """Number of heights outside `depth_min` to `depth_max`."""

    def warnings(self, config: DiverConfig) -> list[str]:
        """Return warnings about implausible heights."""
        if self.seen < MANY:
            return []
        found = []
        if self.outside > DOUBTED * self.seen:
            found.append(
                f'{self.outside} of {self.seen} fix heights are outside depth_min '
                f'({config.depth_min:g} m) to depth_max ({config.depth_max:g} m). Set these, or '
                'origin_height for positions in latitude and longitude'
            )
        if self.rejected > DOUBTED * self.seen:
            found.append(
                f'{self.rejected} of {self.seen} fix heights were rejected: their variances are '
                'too small, or targets move faster than vertical_speed_std. Check both'
            )
        return found


def begin_depth(
    x: FloatArray,
    P: FloatArray,
    height: Height,
    covariance: FloatArray,
    place: int,
    config: DiverConfig,
) -> None:
    """Set the depth of a new track to the z of its fix: x (M, n), P (M, n, n), in place.

    Keep the depth hypotheses if the water column is narrower than the fix uncertainty and contains
    the fix. covariance: (2, 2) of x and y.
    """
    variance = height.variance(covariance)
    width = config.depth_max - config.depth_min
    if variance <= width**2 / 12.0 or _is_outside(height.value, variance, config):
        reset_depth(x, P, place, height.value, variance, config)
        P[:, :2, place] = P[:, place, :2] = covariance @ height.gain


def _is_outside(value: float, variance: float, config: DiverConfig) -> bool:
    """Return whether a height is outside the water column."""
    room = BEYOND * math.sqrt(variance)
    return not -config.depth_max - room <= value <= -config.depth_min + room


def reset_depth(
    x: FloatArray, P: FloatArray, place: int, value: float, variance: float, config: DiverConfig
) -> None:
    """Reset z and its rate in x (M, n), P (M, n, n), in place."""
    own = slice(place, place + 2)
    P[:, own, :] = P[:, :, own] = 0.0
    x[:, place], x[:, place + 1] = value, 0.0
    P[:, place, place], P[:, place + 1, place + 1] = variance, config.vertical_speed_std**2


def depth_stage(
    models: ModelSet, layouts: Callable[[Known], Layout], config: DiverConfig
) -> Callable[[Known, Group], Known]:
    """Return the stage that updates tracks by the heights of their fixes."""

    def update_heights(known: Known, group: Group) -> Known:
        return update_depth(known, group, models, layouts(known), config)

    return update_heights


def update_depth(
    known: Known, group: Group, models: ModelSet, layout: Layout, config: DiverConfig
) -> Known:
    """Update tracks by the heights of their fixes."""
    heights, association = group.heights, group.association
    assert association is not None
    tracks = np.flatnonzero(association.hit)
    if heights is None or not len(tracks):
        return known
    tracks = tracks[np.isfinite(heights.value[association.fix[tracks]])]
    threshold = gate_threshold(config.gate_probability, 1)
    columns = {name: known[name].copy() for name in ('nis', 'nis_dof', 'rejected_z')}
    counts: HeightCounts = known.memory['heights']
    seen, doubted, outside = counts
    for track in tracks.tolist():
        fix = int(association.fix[track])
        own = heights.row(fix)
        assert own is not None
        share = 1.0
        if association.is_joint:
            share = min(association.beta[track, fix] / association.exists[track], 1.0)
        known, nis = _update_track(known, track, own, group, fix, share, models, layout)
        variance = own.variance(group.R[fix])
        outside += _is_outside(own.value, variance, config)
        if nis <= threshold:
            columns['nis'][track] += nis
            columns['nis_dof'][track] += np.uint16(1)
            columns['rejected_z'][track] = np.nan
            continue
        stamp, before, its = columns['rejected_z'][track].tolist()
        moved = config.vertical_speed_std * (known.stamp_ns - stamp) * 1e-9
        if (own.value - before) ** 2 <= threshold * (variance + its + moved**2):
            known = _restart_depth(known, track, own.value, variance, models, config)
            columns['rejected_z'][track] = np.nan
        else:
            columns['rejected_z'][track] = known.stamp_ns, own.value, variance
            doubted += 1
    after = HeightCounts(seen + len(tracks), doubted, outside)
    return known.with_columns(**columns).with_memory(heights=after)


def _restart_depth(
    known: Known, track: int, value: float, variance: float, models: ModelSet, config: DiverConfig
) -> Known:
    """Restart the depth of one track at `value`."""
    own, rows = known.row_indices(track), known.track_rows(track)
    x, P = models.to_common(rows.blocks)
    for row in range(len(rows)):
        reset_depth(x[row], P[row], models.height, value, variance, config)
    return known.replace(
        rows=replace_rows(known.rows, own, models.to_blocks(x, P), rows.mu, rows.logw)
    )


def replace_rows(
    rows: Rows, own: np.ndarray, blocks: tuple[Gaussians, ...], mu: FloatArray, logw: FloatArray
) -> Rows:
    """Return the table with other states, models and weights of the rows `own` (k,)."""
    merged = []
    for block, new in zip(rows.blocks, blocks):
        x, P = block.x.copy(), block.P.copy()
        x[own], P[own] = new
        merged.append(Gaussians(x, P))
    all_mu, all_logw = rows.mu.copy(), rows.logw.copy()
    all_mu[own], all_logw[own] = mu, logw
    return rows.replace(blocks=tuple(merged), mu=all_mu, logw=all_logw)


def _update_track(
    known: Known,
    track: int,
    height: Height,
    group: Group,
    fix: int,
    share: float,
    models: ModelSet,
    layout: Layout,
) -> tuple[Known, float]:
    """Update one track by a scalar: z of a fix less its `gain` times x and y (2,) of the fix.

    :param share: probability that the fix belongs to the track. Below 1, each model becomes a
        mixture.
    :returns: the new state and the NIS of the mixture. A NIS outside the gate changes nothing.
    """
    own, threshold = known.row_indices(track), gate_threshold(group.config.gate_probability, 1)
    rows, value = known.track_rows(track), height.value - float(height.gain @ group.z[fix])
    offset = ways.offset_factor(rows, group.number)
    weight = rows.weight[:, None] * rows.mu
    masks = layout.estimated_masks(models)
    parts = [
        _depth_innovations(block, part.fix_matrix, part.height, height, value, offset)
        for part, block in zip(models.parts, rows.blocks)
    ]
    v, S = (np.concatenate([part[k] for part in parts], axis=1) for k in (1, 2))
    mean, square = float((weight * v).sum()), float((weight * (S + v * v)).sum())
    nis = mean * mean / (square - mean * mean)
    good = (S > 0.0) & np.isfinite(S)
    if not nis <= threshold or not (good & (weight > 0.0)).any():
        return known, nis if not nis <= threshold else math.inf
    log = np.where(good, -0.5 * (v * v / np.where(good, S, 1.0) + LOG_2PI + np.log(S)), -np.inf)
    density = np.exp(log - log[weight > 0.0].max())
    factor = share * density / (weight * density).sum() + (1.0 - share)
    blocks = []
    for part, block, mask, (PHt, nu, s) in zip(models.parts, rows.blocks, masks, parts):
        mask = bursts.with_tail_mask(mask, rows.tail)
        certain = share * density[:, part.models] / (weight * density).sum()
        blocks.append(_update_scalar(block, PHt, nu, s, height.rest, certain, 1.0 - share, mask))
    sound, repairs = repair_covariances(tuple(blocks), rows.tail)
    rows, total = rows.replace(blocks=sound).multiply_models(factor)
    with np.errstate(divide='ignore'):
        logw = np.maximum(rows.logw + np.log(total), LEAST_LOG)
    known = known.replace(rows=replace_rows(known.rows, own, rows.blocks, rows.mu, logw))
    return known.add_counts(repairs=repairs), nis


def _depth_innovations(
    block: Gaussians,
    seen: FloatArray,
    place: int,
    height: Height,
    value: float,
    offset: FloatArray | None,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return PHt (N, n, m), innovation (N, m) and innovation variance (N, m) of ``z - gain (x,
    y)``."""
    h = np.zeros(block.x.shape)
    h[:, : len(seen[0])] = -height.gain[0] * seen[0] - height.gain[1] * seen[1]
    h[:, place] += 1.0
    if offset is not None:
        h[:, -bursts.TAIL :] = -(offset[:, None] * height.gain)[..., None]
    PHt = (block.P * h[:, None]).sum(axis=2)
    return PHt, value - (h * block.x).sum(axis=1), (h * PHt).sum(axis=1) + height.rest


def _update_scalar(
    block: Gaussians,
    PHt: FloatArray,
    v: FloatArray,
    S: FloatArray,
    R: float,
    certain: FloatArray,
    without: float,
    estimated: BoolArray | None,
) -> Gaussians:
    """Update a block by a scalar, as a mixture with weights `certain` (N, m) and `without`."""
    K = PHt / np.where(S > 0.0, S, 1.0)[:, None]
    if estimated is not None:
        K[:, ~estimated] = 0.0
    shift = K * v[:, None]
    P = block.P - K[:, :, None] * PHt[:, None] - PHt[:, :, None] * K[:, None]
    P = P + K[:, :, None] * K[:, None] * S[:, None, None]
    total = certain + without
    share = np.where(total > 0.0, certain / np.where(total > 0.0, total, 1.0), 0.0)[:, None]
    x = block.x + share * shift
    both = share[:, None] * P + (1.0 - share[:, None]) * block.P
    both = both + (share * (1.0 - share))[:, None] * shift[:, :, None] * shift[:, None]
    return Gaussians(x, both)


# -- rows ----------------------------------------------------------------------------------------


def _row_depths(rows: Rows, models: ModelSet) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return weight, mean z and variance of z of each row, (N,) each."""
    z, variance = (
        np.concatenate(parts, axis=1)
        for parts in zip(
            *(
                (block.x[:, part.height], block.P[:, part.height, part.height])
                for part, block in zip(models.parts, rows.blocks)
            )
        )
    )
    mean = (rows.mu * z).sum(axis=1)
    square = (rows.mu * (variance + z * z)).sum(axis=1)
    return rows.weight, mean, np.maximum(square - mean * mean, 0.0)


def ambiguous_depths(known: Known, models: ModelSet) -> BoolArray:
    """Return which tracks (T,) have a second possible depth."""
    two = np.zeros(len(known), bool)
    weights, means, variances = _row_depths(known.rows, models)
    for track in range(len(known)):
        own = known.row_indices(track)
        weight, mean, variance = weights[own], means[own], variances[own]
        counts = np.flatnonzero(weight > POSSIBLE / 10.0)
        order = counts[np.argsort(mean[counts], kind='stable')]
        reach = APART * np.sqrt(variance[order])
        gap = np.diff(mean[order]) > reach[1:] + reach[:-1]
        below = np.cumsum(weight[order])[:-1]
        two[track] = (gap & (np.minimum(below, weight.sum() - below) > POSSIBLE)).any()
    return two


def respread_depths(known: Known, seen: Ping, layout: Layout, models: ModelSet) -> Known:
    """Spread the rows of each side of a track that agree, if the paths of the ping bend within
    their uncertainty."""
    echo = seen.echo
    if models.height < 0 or models.rows_per_track == 1 or not len(known) or not echo.any():
        return known
    weights, means, variances = _row_depths(known.rows, models)
    maps = tuple(part.outputs[:2] for part in models.parts)
    positions, _ = row_outputs(known.rows, maps)
    measured, side = seen.measured, known.rows.key['side']
    for track, each in np.unique([known.rows.target, side], axis=1).T.tolist():
        own = np.flatnonzero((known.rows.target == track) & (side == each))
        weight, mean, variance = weights[own], means[own], variances[own]
        whole = float(weight.sum())
        if not whole > 0.0:
            continue
        weight = weight / whole
        middle = float(weight @ mean)
        between, within = float(weight @ (mean - middle) ** 2), float(weight @ variance)
        if not between < AGREE * within:
            continue
        place = np.append(weight @ positions[own], middle)
        bend = _path_curvature(place, measured.rx[echo])
        if not seen.passive:
            bend = bend + _path_curvature(place, measured.tx[echo])
        deviation = 0.5 * bend * (within + between) / np.sqrt(measured.variance[echo])
        if deviation.max() > BENT:
            rows = known.rows.select(own)
            rows = rows.replace(target=np.zeros(len(own), np.int64))
            blocks, mu, logw = _spread_rows(rows, layout.mask, models)
            logw = logw + math.log(whole)
            known = known.replace(rows=replace_rows(known.rows, own, blocks, mu, logw))
            known = count_respread(known, track)
    return known


def count_respread(known: Known, track: int) -> Known:
    """Return the state with one more spread of a track."""
    spreads = known['respreads'].copy()
    spreads[track] += 1
    return known.with_columns(respreads=spreads)


def _path_curvature(place: FloatArray, instrument: FloatArray) -> FloatArray:
    """Return d^2(distance)/dz^2 (C,), 1/m, from `place` (3,) to instruments (C, 3); distances from
    1 m."""
    apart = instrument - place
    distance = np.maximum(np.sqrt((apart * apart).sum(axis=1)), 1.0)
    return np.asarray((1.0 - np.minimum(apart[:, 2] / distance, 1.0) ** 2) / distance)


def _spread_rows(
    rows: Rows, estimated: BoolArray, models: ModelSet
) -> tuple[tuple[Gaussians, ...], FloatArray, FloatArray]:
    """Return states, models (K, M) and log weights (K,) of K rows spread over the depth of a
    track.

    estimated: (n,) mask, see `estimation.consider`.
    """
    place = models.height
    each = rows.weight[:, None] * rows.mu
    K, total = len(each), each.sum(axis=0)
    share = np.where(total > 0.0, each / np.where(total > 0.0, total, 1.0), 1.0 / K)
    x, P = models.to_common(rows.blocks)
    mean = np.einsum('km,kma->ma', share, x)
    apart = x - mean
    whole = np.einsum('km,kmab->mab', share, P + apart[..., :, None] * apart[..., None, :])
    line = whole[:, place] / np.sqrt(whole[:, place, place])[:, None]
    moved = estimated[:, None] | estimated[None, :]
    # The variance between the rows is subtracted from the variance within them.
    steps = np.linspace(-1.0, 1.0, K)
    narrow = whole - (steps**2).mean() * line[:, :, None] * line[:, None, :] * moved
    at = mean + steps[:, None, None] * np.where(estimated, line, 0.0)
    covariance = np.tile(add_jitter(narrow)[0], (K, 1, 1, 1))
    return models.to_blocks(at, covariance), np.tile(total, (K, 1)), np.full(K, -math.log(K))
