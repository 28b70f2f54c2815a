# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Will the vehicle hit it: closest approach and probability of a collision.

Both go straight on: the vehicle along the line through its last positions, the obstacle with the
velocity of each component. A collision is a time up to `cpa_horizon` at which the obstacle is
within `safety_radius` horizontally and `safety_height` vertically at once. The raw velocity of the
navigation would not do: a vehicle in swell swings about its course.

What decides a collision is g = (r_N, r_E, dz, v_N, v_E), see `unscented.relative`. Where a vehicle
keeps its depth and a course that is certain, the signed miss distance, the vertical offset and the
time of the closest approach are Gaussian, by sigma points, and the probability is a sum over
slices of the vertical offset. Else draws are counted.

Source: docs/obstacle.md, section Avoidance.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from functools import cache
import math
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr

from ...estimation.arrays import BoolArray, FloatArray
from ...estimation.covariance import semidefinite_roots
from ...measurements import nanoseconds
from ..navigation import NavigationBuffer
from .config import ObstacleConfig
from .unscented import covariances, cross_covariance, image_moments, KAPPA, RELATIVE, sigma_points

DRAWS = 256
CLIMBING = 0.15
"""m/s of the course from which a vehicle climbs or dives on purpose; heave is less."""
_SHORTEST = 1.0
"""Seconds of positions that make a course."""
SLICES = 16
"""Of the vertical offset, in the closed form, at most."""
FINE = 20.0
"""Slices for each standard deviation of the miss distance, given the offset, by which its mean
differs from one end of the offset to the other. Half as many change a probability by 1e-4."""
FAR = 8.0
"""Standard deviations off which nothing of a Gaussian is left, 1e-15."""
WEIGHT = 1e-6
"""A component that weighs less plays no part."""
LITTLE = 1e-18


class Safety(NamedTuple):
    """velocity: (3,) m/s of the vehicle, NED, the last one 0 unless it climbs or dives; std: m/s
    an axis, of its course; radius, half height m, horizon s; draws (n, 5): standard normal."""

    velocity: FloatArray
    std: float
    radius: float
    height: float
    horizon: float
    draws: FloatArray


def course(buffer: NavigationBuffer, stamp_ns: int, window: float) -> FloatArray:
    """Return the velocity (3,) m/s ENU of the vehicle: slope of the straight line through its
    positions of the last `window` seconds. NaN where there are too few."""
    first = bisect_left(buffer.stamps, stamp_ns - nanoseconds(window))
    last = bisect_right(buffer.stamps, stamp_ns)
    stamps = buffer.stamps[first:last]
    if len(stamps) < 2 or (stamps[-1] - stamps[0]) * 1e-9 < _SHORTEST:
        return np.full(3, np.nan)
    t = (np.array(stamps) - stamp_ns) * 1e-9
    positions = np.concatenate([sample.position for sample in buffer.samples[first:last]]).reshape(
        -1, 3
    )
    since = t - t.mean()
    return np.asarray(since @ (positions - positions[0]) / (since @ since))


def closest_approach(
    mean: FloatArray,
    covariance: FloatArray,
    mu: FloatArray,
    velocity: FloatArray,
    config: ObstacleConfig,
) -> dict[str, FloatArray]:
    """``cpa_distance`` m, ``cpa_time`` s and ``collision_probability``, each (T,), of mixtures
    mean (T, K, 5), covariance (T, K, 5, 5), mu (T, K) of g before a vehicle of that velocity
    (3,), NED. NaN where the velocity is."""
    names = ('cpa_distance', 'cpa_time', 'collision_probability')
    if not all(map(math.isfinite, velocity.tolist())):
        return {name: np.full(len(mu), np.nan) for name in names}
    return dict(zip(names, assess(mean, covariance, mu, _safety(velocity, config))))


def _safety(velocity: FloatArray, config: ObstacleConfig) -> Safety:
    climbs = abs(velocity[2]) > CLIMBING
    return Safety(
        np.array([velocity[0], velocity[1], velocity[2] if climbs else 0.0]),
        config.course_std,
        config.safety_radius,
        config.safety_height,
        config.cpa_horizon,
        draws(),
    )


@cache
def draws() -> FloatArray:
    """Return standard normal points (256, 5) that fill the space evenly: a Kronecker lattice on
    powers of the root of x^6 = x + 1."""
    from scipy.special import ndtri

    root = 1.0
    for _ in range(60):
        root = (1.0 + root) ** (1.0 / 6.0)
    steps = root ** -np.arange(1.0, 6.0)
    u = (0.5 + np.outer(np.arange(1, DRAWS + 1), steps)) % 1.0
    points = np.asarray(ndtri(u))
    return np.ascontiguousarray((points - points.mean(axis=0)) / points.std(axis=0))


def assess(
    mean: FloatArray, covariance: FloatArray, mu: FloatArray, safety: Safety
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return distance (T,) m and time (T,) s of the closest approach of mixtures (T, K) of g, and
    the probability (T,) of a collision."""
    live = np.nonzero(mu >= WEIGHT)
    found = np.zeros((4, len(mu)))
    if len(live[0]):
        g, S = mean[live].T, np.moveaxis(covariance[live], 0, -1).copy()
        for a in (3, 4):
            S[a, a] += safety.std * safety.std
        w0, w1 = _apart(g, safety)
        time, near = closest(g[0], g[1], w0, w1, safety.horizon)
        weight = mu[live]
        for row, value in zip(found, (near, time, _chances(g, S, safety), np.ones(len(weight)))):
            np.add.at(row, live[0], weight * value)
    with np.errstate(invalid='ignore'):
        distance, when, risk = found[:3] / found[3]
    return distance, when, np.clip(risk, 0.0, 1.0)


def _apart(g: FloatArray, safety: Safety) -> FloatArray:
    """Return the horizontal velocity (2, ...) of the obstacle past the vehicle."""
    return np.stack([g[3] - safety.velocity[0], g[4] - safety.velocity[1]])


def closest(
    r0: FloatArray, r1: FloatArray, w0: FloatArray, w1: FloatArray, horizon: float
) -> tuple[FloatArray, FloatArray]:
    """Return when (s) and how near (m) points at r that move with w come to the origin."""
    square = w0 * w0 + w1 * w1
    moving = square > LITTLE
    t = np.where(moving, -(r0 * w0 + r1 * w1) / np.where(moving, square, 1.0), 0.0)
    t = np.clip(t, 0.0, horizon)
    return t, np.hypot(r0 + w0 * t, r1 + w1 * t)


def _chances(g: FloatArray, S: FloatArray, safety: Safety) -> FloatArray:
    """Return the probability (L,) that each component collides: g (5, L), S (5, 5, L) with the
    error of the course."""
    L = semidefinite_roots(S)
    w0, w1 = _apart(g, safety)
    # A course that may be any has no miss distance to be Gaussian in.
    unsure = w0 * w0 + w1 * w1 <= 4.0 * (S[3, 3] + S[4, 4])
    unsure |= g[0] * g[0] + g[1] * g[1] <= safety.radius * safety.radius
    unsure |= safety.velocity[2] != 0.0
    chance, sure = np.zeros(g.shape[1]), ~unsure
    if unsure.any():
        chance[unsure] = sampled(g[:, unsure], L[..., unsure], safety)
    if sure.any():
        chance[sure] = _closed_form(g[:, sure], S[..., sure], L[..., sure], safety)
    return chance


def sampled(g: FloatArray, L: FloatArray, safety: Safety) -> FloatArray:
    """Return the share (L,) of the draws of components, g (5, L) with the roots L (5, 5, L) of
    their covariances, that collide; the error of the course is in the roots."""
    y = g[:, None] + np.einsum('abl,kb->akl', L, safety.draws)
    w0, w1 = _apart(y, safety)
    hit = collides(
        y[0], y[1], y[2], w0, w1, np.full(w0.shape, -safety.velocity[2]),
        safety.radius, safety.height, safety.horizon,
    )  # fmt: skip
    return np.asarray(hit.mean(axis=0))


def collides(
    r0: FloatArray,
    r1: FloatArray,
    dz: FloatArray,
    w0: FloatArray,
    w1: FloatArray,
    wz: FloatArray,
    radius: float,
    height: float,
    horizon: float,
) -> BoolArray:
    """Return whether at some time up to the horizon points are within the radius and the half
    height at once: two intervals of time that overlap."""
    square = w0 * w0 + w1 * w1
    towards, moving = r0 * w0 + r1 * w1, square > LITTLE
    # b^2 - a c, without the cancellation: the miss distance squared against the radius.
    cross = r0 * w1 - r1 * w0
    root = square * radius * radius - cross * cross
    half = np.sqrt(np.maximum(root, 0.0))
    size = np.where(moving, square, 1.0)
    first = np.where(moving, np.maximum((-towards - half) / size, 0.0), 0.0)
    last = np.where(moving, np.minimum((-towards + half) / size, horizon), horizon)
    possible = np.where(moving, root >= 0.0, r0 * r0 + r1 * r1 <= radius * radius)
    rising = np.abs(wz) > 1e-12
    speed = np.where(rising, wz, 1.0)
    ends = (-height - dz) / speed, (height - dz) / speed
    first = np.where(rising, np.maximum(first, np.minimum(*ends)), first)
    last = np.where(rising, np.minimum(last, np.maximum(*ends)), last)
    possible = possible & (rising | (np.abs(dz) <= height))
    return np.asarray(possible & (first <= last))


def _closed_form(g: FloatArray, S: FloatArray, L: FloatArray, safety: Safety) -> FloatArray:
    """Return the probability (L,) of components whose course is certain."""
    F = np.sqrt(RELATIVE + KAPPA) * L
    r0, r1, v0, v1 = sigma_points(g, F)[[0, 1, 3, 4]]
    v, w = v0 - safety.velocity[0], v1 - safety.velocity[1]
    square = np.maximum(v * v + w * w, LITTLE)
    # Signed miss distance and time of the closest approach of all sigma points.
    image = np.stack([(r0 * w - r1 * v) / np.sqrt(square), -(r0 * v + r1 * w) / square])
    lanes = g.shape[1]
    centre = np.full(lanes, KAPPA / (RELATIVE + KAPPA))
    weight = np.full((RELATIVE, lanes), 0.5 / (RELATIVE + KAPPA))
    (b, t), image = image_moments(image, centre, weight)
    spread = covariances(image, centre, weight)
    both = cross_covariance(image[:1], F[2:3], weight[0])[0, 0]
    near = _within(g[2], S[2, 2], b, spread[0, 0], both, safety)
    return near * _in_time(t, spread[1, 1], safety)


def _in_time(t: FloatArray, variance: FloatArray, safety: Safety) -> FloatArray:
    """Return the probability (L,) that the closest approach is ahead and before the horizon."""
    std = np.sqrt(variance)
    share = ndtr(_off(safety.horizon - t, std, True)) - ndtr(_off(-t, std, False))
    return np.where(share >= LITTLE, share, 0.0)


def _within(
    z: FloatArray,
    var_z: FloatArray,
    b: FloatArray,
    var_b: FloatArray,
    both: FloatArray,
    safety: Safety,
) -> FloatArray:
    """Return the probability (L,) that miss distance b and vertical offset z, with covariance
    `both`, are within the radius and the half height: slice by slice of the offset, inside which
    the mean of b hardly changes."""
    std_z, R = np.sqrt(var_z), safety.radius
    low = np.maximum(-safety.height, z - 6.0 * std_z)
    high = np.minimum(safety.height, z + 6.0 * std_z)
    chance = np.zeros(len(z))
    # Most obstacles are passed far off: what follows would find the same.
    near = np.flatnonzero((low <= high) & (np.abs(b) - R <= FAR * np.sqrt(var_b)))
    if not len(near):
        return chance
    z, var_z, b, var_b, both = (part[near] for part in (z, var_z, b, var_b, both))
    std_z, low, high = std_z[near], low[near], high[near]
    slope = np.where(var_z > LITTLE, both / np.where(var_z > LITTLE, var_z, 1.0), 0.0)
    rest = np.sqrt(np.maximum(var_b - slope * both, 0.0))
    known = std_z <= 1e-9
    change = np.abs(slope) * (high - low) * FINE
    with np.errstate(divide='ignore', invalid='ignore'):
        count = np.where(change >= SLICES * rest, SLICES, 1 + np.floor(change / rest))
    count = np.where(known, 1, count)
    k = np.arange(int(count.max()))[:, None]
    width = (high - low) / count
    end = low + (k + 1) * width
    std = np.where(known, 1.0, std_z)
    share = ndtr((end - z) / std) - ndtr((end - width - z) / std)
    share = np.where(known, 1.0, share)
    given = np.where(known, b, b + slope * (end - 0.5 * width - z))
    inside = ndtr(_off(R - given, rest, True)) - ndtr(_off(-R - given, rest, False))
    used = (k < count) & (share > LITTLE)
    chance[near] = (share * inside * used).sum(axis=0)
    return chance


def _off(edge: FloatArray, std: FloatArray, inside: bool) -> FloatArray:
    """Return how many standard deviations an edge lies above the mean; one that is on it, where
    there is no spread, as if the mean were `inside` below it or not."""
    spread = std > 1e-12
    certain = np.where((edge > 0.0) | ((edge == 0.0) & inside), np.inf, -np.inf)
    return np.where(spread, edge / np.where(spread, std, 1.0), certain)
