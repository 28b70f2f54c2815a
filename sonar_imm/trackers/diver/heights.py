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

"""Depth as a state (`dimensions: 3`): what fixes say of z, and when its copies are spread anew.

*Fixes.* Association and the update by x and y are the same with z and without. Then z is one more
number for the track that took the fix: z less what the errors of x and y, which are known by now,
have to do with its own. With ``R`` the covariance of the fix, split into that of x and y, of z,
and between them,

    z - g (x, y) = z_track - g (x, y)_track + e,    g = R_z,xy R_xy^-1,    var e = R_zz - g R_xy,z

where e has nothing to do with the errors of x and y. So the two updates in turn are the one by all
three coordinates. It weighs the models too, and with them the copies of the depth bank.

z has a gate of its own, one coordinate under the whole mixture: an echo from the surface is off in
z alone. What is refused is remembered; the next fix that agrees with it says that the depth was
wrong, and z begins there.

*Copies.* Arrivals see z by how paths bend, and what bends is blind to the side of the receivers.
Far away all copies of the depth bank (`state_space`) may come to agree on a depth that is not well
known. When the diver then comes near, one Gaussian cannot become two depths, and all copies may go
to the wrong one. So copies that agree are spread over what they believe, before a ping that bends
within it: the Gaussian becomes the sum of narrower ones with the same mean and variance, and the
arrivals choose.
"""

from __future__ import annotations

import math

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray
from ...estimation.association import gate_threshold
from ...estimation.small_matrices import add_jitter_all
from .config import DiverConfig
from .fix_kernels import update_heights
from .jipda import Association
from .scan import Height, Ping, Positions
from .state import DiverState, HeightCounts
from .state_space import Layout, ModelSet

BEYOND = 3.0
"""Standard deviations by which a fix lies above or below the water column, so that it was stated
wrong."""

AGREE = 0.5
"""Copies agree whose means vary by less than this share of the variance that they have."""

BENT = 0.1
"""Standard deviations of an arrival by which the path may bend within what is believed of z,
before the copies are spread. What one ping does not see many do: the bend is the same in all."""

APART, POSSIBLE = 2.0, 0.05
"""There are two depths where the copies above a gap and those below weigh more than `POSSIBLE`
each. A gap is wider than `APART` times the standard deviations of both its neighbours together."""


def begin(
    x: FloatArray,
    P: FloatArray,
    height: Height,
    covariance: FloatArray,
    place: int,
    config: DiverConfig,
) -> None:
    """Let a new track, x (M, n), P (M, n, n) in place, begin at the z that its fix states; its x
    and y have `covariance` (2, 2). Not where the water column, of `depth_min` to `depth_max`, says
    more than the fix, and does not contradict it: then z begins as without a fix."""
    variance = height.variance(covariance)
    width = config.depth_max - config.depth_min
    if variance <= width**2 / 12.0 or _outside(height.value, variance, config):
        _set(x, P, place, height.value, variance, config)
        P[:, :2, place] = P[:, place, :2] = covariance @ height.gain


def _outside(value: float, variance: float, config: DiverConfig) -> bool:
    room = BEYOND * math.sqrt(variance)
    return not -config.depth_max - room <= value <= -config.depth_min + room


def _set(
    x: FloatArray, P: FloatArray, place: int, value: float, variance: float, config: DiverConfig
) -> None:
    """Forget what x (M, n), P (M, n, n) know of z and its rate, which follows it."""
    own = slice(place, place + 2)
    P[:, own, :] = P[:, :, own] = 0.0
    x[:, place], x[:, place + 1] = value, 0.0
    P[:, place, place], P[:, place + 1, place + 1] = variance, config.vertical_speed_std**2


def update(
    now: DiverState,
    fixes: Positions,
    association: Association,
    layout: Layout,
    place: int,
    config: DiverConfig,
) -> DiverState:
    """The tracks after the heights of the `fixes` that are theirs; place: of z in the state."""
    heights, tracks, detection = fixes.heights, association.tracks, association.detection
    if heights is None or not len(tracks):
        return now
    weight, weights = np.ones(len(tracks)), association.weights
    if weights is not None:
        share = weights.beta[tracks, detection] / weights.existence[tracks]
        weight = np.minimum(share, 1.0)
    stated = np.isfinite(heights.value[detection])
    tracks, detection, weight = tracks[stated], detection[stated], weight[stated]
    if not len(tracks):
        return now
    value = heights.value[detection] - (heights.gain[detection] * fixes.z[detection]).sum(axis=1)
    threshold = gate_threshold(config.gate_probability, 1)
    x, P, mu, nis = update_heights(
        now.x,
        now.P,
        now.mu,
        layout.H,
        place,
        value,
        heights.gain[detection],
        heights.rest[detection],
        tracks,
        weight,
        layout.mask,
        threshold,
    )
    good = nis <= threshold
    hit = tracks[good]
    repairs = 0
    for track in hit.tolist():
        repairs += add_jitter_all(P[track])
    all_nis, nis_dof, refused = now.nis.copy(), now.nis_dof.copy(), now.refused_z.copy()
    all_nis[hit] += nis[good]
    nis_dof[hit] += np.uint16(1)
    refused[hit] = np.nan
    seen, doubted, outside = now.heights
    for track, row in zip(tracks[~good].tolist(), detection[~good].tolist()):
        own = heights.row(row)
        assert own is not None
        variance = own.variance(fixes.R[row])
        stamp, before, its = refused[track].tolist()
        moved = config.vertical_speed_std * (now.stamp_ns - stamp) * 1e-9
        if (own.value - before) ** 2 <= threshold * (variance + its + moved**2):
            _set(x[track], P[track], place, own.value, variance, config)
            refused[track] = np.nan
        else:
            refused[track] = now.stamp_ns, own.value, variance
            doubted += 1
    for row in detection.tolist():
        own = heights.row(row)
        assert own is not None
        outside += _outside(own.value, own.variance(fixes.R[row]), config)
    return now._replace(
        x=x,
        P=P,
        mu=mu,
        nis=all_nis,
        nis_dof=nis_dof,
        refused_z=refused,
        heights=HeightCounts(seen + len(tracks), doubted, outside),
        repairs=now.repairs + repairs,
    )


# -- copies --------------------------------------------------------------------------------------


def _copies(now: DiverState, models: ModelSet) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Weight, mean and variance of z of each copy, (T, K) each."""
    T, K, place = len(now.x), models.copies, models.height
    mu = now.mu.reshape(T, K, len(models.names))
    weight = mu.sum(axis=2)
    share = mu / np.where(weight > 0.0, weight, 1.0)[..., None]
    z, variance = now.x[..., place], now.P[..., place, place]
    mean = (share * z.reshape(mu.shape)).sum(axis=2)
    square = (share * (variance + z * z).reshape(mu.shape)).sum(axis=2)
    return weight, mean, np.maximum(square - mean * mean, 0.0)


def ambiguous(now: DiverState, models: ModelSet) -> BoolArray:
    """Which divers (T,) may be at another depth as well."""
    two = np.zeros(len(now.x), bool)
    for track, (weight, mean, variance) in enumerate(zip(*_copies(now, models))):
        counts = np.flatnonzero(weight > POSSIBLE / 10.0)
        order = counts[np.argsort(mean[counts], kind='stable')]
        reach = APART * np.sqrt(variance[order])
        gap = np.diff(mean[order]) > reach[1:] + reach[:-1]
        below = np.cumsum(weight[order])[:-1]
        two[track] = (gap & (np.minimum(below, weight.sum() - below) > POSSIBLE)).any()
    return two


def spread(now: DiverState, seen: Ping, layout: Layout, models: ModelSet) -> DiverState:
    """The tracks as `seen` will find them: with the copies spread where they agree and the paths
    bend within what they believe."""
    echo = seen.echo
    if models.height < 0 or models.copies == 1 or not len(now.x) or not echo.any():
        return now
    weight, mean, variance = _copies(now, models)
    middle = (weight * mean).sum(axis=1)
    between = (weight * (mean - middle[:, None]) ** 2).sum(axis=1)
    within = (weight * variance).sum(axis=1)
    measured = seen.measured
    x, P, mu, spreads = now.x.copy(), now.P.copy(), now.mu.copy(), now.spreads.copy()
    for track in np.flatnonzero(between < AGREE * within).tolist():
        place = np.append(now.mu[track] @ now.x[track, :, :2], middle[track])
        bend = _bend(place, measured.rx[echo])
        if not seen.passive:
            bend = bend + _bend(place, measured.tx[echo])
        deviation = 0.5 * bend * (within + between)[track] / np.sqrt(measured.variance[echo])
        if deviation.max() > BENT:
            x[track], P[track], mu[track] = _spread(
                x[track], P[track], mu[track], layout.mask, models
            )
            spreads[track] += 1
    return now._replace(x=x, P=P, mu=mu, spreads=spreads)


def _bend(place: FloatArray, instrument: FloatArray) -> FloatArray:
    """Second derivative (C,) in z of the distance from `place` (3,) to instruments (C, 3), not
    nearer than a metre, 1/m."""
    apart = instrument - place
    distance = np.maximum(np.sqrt((apart * apart).sum(axis=1)), 1.0)
    return np.asarray((1.0 - np.minimum(apart[:, 2] / distance, 1.0) ** 2) / distance)


def _spread(
    x: FloatArray, P: FloatArray, mu: FloatArray, estimated: BoolArray, models: ModelSet
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """One diver, x (K M, n), P (K M, n, n), mu (K M,), with what all copies believe spread over
    them; estimated (n,): see `estimation.consider`."""
    K, M, n, place = models.copies, len(models.names), x.shape[-1], models.height
    each = mu.reshape(K, M)
    total = each.sum(axis=0)
    share = np.where(total > 0.0, each / np.where(total > 0.0, total, 1.0), 1.0 / K)
    x, P = x.reshape(K, M, n), P.reshape(K, M, n, n)
    mean = np.einsum('km,kma->ma', share, x)
    apart = x - mean
    whole = np.einsum('km,kmab->mab', share, P + apart[..., :, None] * apart[..., None, :])
    line = whole[:, place] / np.sqrt(whole[:, place, place])[:, None]
    moved = estimated[:, None] | estimated[None, :]
    # Standard deviations: what lies between the copies does not lie within them.
    steps = np.linspace(-1.0, 1.0, K)
    narrow = whole - (steps**2).mean() * line[:, :, None] * line[:, None, :] * moved
    places = mean + steps[:, None, None] * np.where(estimated, line, 0.0)
    covariance = np.tile(narrow, (K, 1, 1))
    add_jitter_all(covariance)
    return places.reshape(K * M, n), covariance, np.tile(total / K, K)
