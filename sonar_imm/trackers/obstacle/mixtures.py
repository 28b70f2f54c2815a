# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Operations on the mixtures of obstacles: mix behaviours, update by an echo, weigh by the beam,
and the quantiles that are published.

A target is K components x (K, n), P (K, n, n) with weights mu (K,); all functions take all T
targets at once. A component of weight 0 is dropped: it takes no further part.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from scipy.special import ndtr, ndtri

from ...estimation.arrays import BoolArray, FloatArray, IndexArray
from ...estimation.covariance import are_sound, LIMIT, with_jitter
from .unscented import COMMON, NEGLIGIBLE

AHEAD = 0.2
"""Cosine to the axis of the sonar, 78 degrees: beyond, range and azimuth fix nothing."""

SMEAR = math.radians(1.2)
"""Standard deviation of the edges of the beam, rad; in range, as a share of the reach."""
UNSEEN = 0.01
"""Least probability to be in the beam: nothing is ever certain to be unseen."""
PARTS = 5
PART = ndtri((np.arange(PARTS) + 0.5) / PARTS)
"""Middles of equally probable parts of a normal distribution of variance 1."""
WITHIN = math.sqrt(1.0 - float(np.mean(np.square(PART))))
"""Standard deviation that is left within a part."""
OPENS = 1e-6
"""Least weight of a component that opens a gate."""

ROOT_2PI = math.sqrt(2.0 * math.pi)

NORMAL_95 = 1.645
"""Where the search for a quantile begins, standard deviations off the mean."""

ROUNDS = 100
"""Of the search for quantiles, at most; about six are needed."""


def moment_match(
    x: FloatArray, P: FloatArray, mu: FloatArray, n: int
) -> tuple[FloatArray, FloatArray]:
    """Return mean (T, n) and covariance (T, n, n) of the first n states of mixtures (T, K)."""
    x, P = x[..., :n], P[..., :n, :n]
    mean = np.einsum('tk,tka->ta', mu, x)
    off = x - mean[:, None]
    spread = P + off[..., :, None] * off[..., None, :]
    covariance = np.einsum('tk,tkab->tab', mu, spread)
    return mean, 0.5 * (covariance + np.swapaxes(covariance, 1, 2))


def mix(
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    prior: FloatArray,
    slices: int,
    transition: FloatArray,
    same: BoolArray,
    floor: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the components before a step in which an obstacle may change its behaviour.

    Component ``k M + a`` is behaviour a of slice k; components after the last slice are on their
    own. The M components of a slice interact by transition (M, M), ``[i, j]`` the probability of j
    after i. States that all have are mixed. A displacement is no velocity: to e, what is of the
    same behaviour, same (M, M), brings its own, any other its prior, uncorrelated. Slices and
    components below the weight `floor` are dropped.

    :param prior: (C,) variance of e before anything is known, 0 for a behaviour without e.
    """
    T, C, n = x.shape
    M = len(transition)
    inside = slices * M
    mu1 = np.where(mu < floor, 0.0, mu)
    own = mu[:, :inside].reshape(T, slices, M)
    heavy = own.sum(axis=2) >= floor
    if M == 1:
        mu1[:, :inside] = np.where(heavy, own[..., 0], 0.0)
        return x.copy(), P.copy(), _normalised(mu1, mu)
    W = own[..., :, None] * transition
    total = W.sum(axis=2)
    mixed = heavy[..., None] & (total >= floor)
    mu1[:, :inside] = np.where(mixed, total, 0.0).reshape(T, inside)
    share = W / np.where(total > 0.0, total, 1.0)[:, :, None]
    share = np.where((total > 0.0)[:, :, None], share, np.eye(M))
    x1, P1 = x.copy(), P.copy()
    xs, Ps = x[:, :inside].reshape(T, slices, M, n), P[:, :inside].reshape(T, slices, M, n, n)
    mean, spread = np.empty(xs.shape), np.empty(Ps.shape)
    variance = prior[:inside].reshape(slices, M)
    for a in range(M):
        mean[:, :, a], spread[:, :, a] = _as_behaviour(
            xs, Ps, share[..., a], variance[:, a], same[a]
        )
    # A behaviour without e has none after the mixing either.
    extra = (variance == 0.0)[None, :, :, None] & (np.arange(n) >= COMMON)
    mean = np.where(mixed[..., None] & ~extra, mean, xs)
    apart = extra[..., :, None] | extra[..., None, :]
    spread = np.where(mixed[..., None, None] & ~apart, spread, Ps)
    x1[:, :inside], P1[:, :inside] = mean.reshape(T, inside, n), spread.reshape(T, inside, n, n)
    return x1, P1, _normalised(mu1, mu)


def _as_behaviour(
    x: FloatArray, P: FloatArray, share: FloatArray, prior: FloatArray, same: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Return mean (T, S, n) and covariance (T, S, n, n) of the mixture of the behaviours x (T, S,
    M, n) of each slice with `share` (T, S, M), as a behaviour sees them to which some (M,) are the
    same."""
    n = x.shape[-1]
    if n > COMMON:
        others = ~same
        x, P = x.copy(), P.copy()
        x[:, :, others, COMMON:] = 0.0
        P[:, :, others, COMMON:] = P[:, :, others, :, COMMON:] = 0.0
        for i in range(COMMON, n):
            P[:, :, others, i, i] = prior[:, None]
    mean = np.einsum('tsm,tsma->tsa', share, x)
    off = x - mean[:, :, None]
    covariance = np.einsum('tsm,tsmab->tsab', share, P + off[..., :, None] * off[..., None, :])
    return mean, 0.5 * (covariance + np.swapaxes(covariance, -1, -2))


def _normalised(weight: FloatArray, before: FloatArray) -> FloatArray:
    """Return weights (T, K) that sum to one; those before where nothing is left."""
    total = weight.sum(axis=1, keepdims=True)
    return np.where(total > 0.0, weight / np.where(total > 0.0, total, 1.0), before)


# -- an echo -------------------------------------------------------------------------------------


def gate(
    h: FloatArray, C: FloatArray, mu: FloatArray, z: FloatArray, R: FloatArray, threshold: float
) -> BoolArray:
    """Return which detections (T, D) lie in the gate of some component of each target.

    :param h: (T, K, 2) expected, with covariance C (T, K, 2, 2).
    :param mu: (T, K) weights; components below `OPENS` open no gate.
    :param z: (D, 2) with covariance R (D, 2, 2).
    """
    near = np.zeros((len(h), len(z)), np.bool_)
    t, k = np.nonzero(mu >= OPENS)
    if not len(t) or not len(z):
        return near
    a, b, d = (C[t, k, i, j][:, None] + R[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    v, w = (z[:, i] - h[t, k, i][:, None] for i in (0, 1))
    inside = d * v * v - 2.0 * b * v * w + a * w * w <= threshold * (a * d - b * b)
    which, first = np.unique(t, return_index=True)
    near[which] = np.logical_or.reduceat(inside, first, axis=0)
    return near


def update(
    x: FloatArray, P: FloatArray, mu: FloatArray, h: FloatArray, z: FloatArray, R: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, BoolArray]:
    """Update with one detection per target, which is its own; range and azimuth are states.

    h (T, K, 2) expected, z (T, 2) measured, R (T, 2, 2). Return x, P, mu (T, K), the log density
    (T,) of the detection, and where P (T, K) was repaired (`estimation.covariance`).
    """
    x1, P1, log = x.copy(), P.copy(), np.full(mu.shape, -np.inf)
    repaired = np.zeros(mu.shape, np.bool_)
    live = np.nonzero(mu > 0.0)
    if len(live[0]):
        S, v, noise = np.moveaxis(P[live], 0, -1), (z[:, None] - h)[live].T, R[live[0]]
        noise = np.moveaxis(noise, 0, -1)
        density, gain = _gain(S, v, noise)
        shift = (gain * v).sum(axis=1)
        after = _joseph(S, gain, noise)
        after = 0.5 * (after + np.swapaxes(after, 0, 1))
        bad = ~are_sound(after)
        usable = np.isfinite(shift).all(axis=0) & np.isfinite(density)
        if bad.any():
            after, bad = with_jitter(after)
            usable &= ~bad | are_sound(after)
        x1[live] += np.where(usable, shift, 0.0).T
        P1[live] = np.moveaxis(np.where(usable, after, 0.5 * (S + np.swapaxes(S, 0, 1))), -1, 0)
        log[live] = np.log(mu[live]) + np.where(np.isfinite(density), density, -np.inf)
        repaired[live] = bad | ~usable
    return x1, P1, *weights(log, mu), repaired


def weights(log: FloatArray, before: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return weights (T, K) proportional to exp log (T, K), those before where nothing is left,
    and the log of the sums (T,)."""
    best = log.max(axis=1, initial=-np.inf)
    known = best > -np.inf
    weight = np.exp(log - np.where(known, best, 0.0)[:, None])
    total = weight.sum(axis=1)
    sums = np.where(known, best + np.log(np.where(known, total, 1.0)), -np.inf)
    return _normalised(weight, before), sums


def combine(
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    given: tuple[FloatArray, FloatArray, FloatArray],
    target: IndexArray,
    share: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return mixtures (T, K) of which none of several detections is the target's, or one,
    moment-matched component by component.

    :param given: x (M, K, n), P (M, K, n, n) and mu (M, K) given that detection m is the target's.
    :param target: (M,) rising, of which target each is.
    :param share: (M,) probability that it is.
    """
    T = len(mu)
    none = np.maximum(1.0 - np.bincount(target, share, T), 0.0)
    own, weight = none[:, None] * mu, share[:, None] * given[2]
    total = own + _summed(weight, target, T)
    left = total > 0.0
    safe = np.where(left, total, 1.0)
    own, weight = np.where(left, own / safe, 1.0), weight / safe[target]
    mean = own[..., None] * x + _summed(weight[..., None] * given[0], target, T)
    off, theirs = x - mean, given[0] - mean[target]
    spread = own[..., None, None] * (P + off[..., :, None] * off[..., None, :])
    more = weight[..., None, None] * (given[1] + theirs[..., :, None] * theirs[..., None, :])
    covariance = spread + _summed(more, target, T)
    return mean, 0.5 * (covariance + np.swapaxes(covariance, -1, -2)), _normalised(total, mu)


def _summed(values: FloatArray, target: IndexArray, T: int) -> FloatArray:
    """Return the sums (T, ...) of values (M, ...) of each target (M,), which rise."""
    out = np.zeros((T, *values.shape[1:]))
    first = np.searchsorted(target, target)
    rank = np.arange(len(target)) - first
    for turn in range(int(rank.max(initial=-1)) + 1):
        rows = np.flatnonzero(rank == turn)
        out[target[rows]] += values[rows]
    return out


def _gain(S: FloatArray, v: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the log density (L,) of innovations v (2, L), and the gain (n, 2, L) of the first two
    states with covariances S (n, n, L) and noise R (2, 2, L)."""
    # A perfect measurement leaves a variance, and can be repeated.
    a, b, d = (S[i, j] + R[i, j] for i, j in ((0, 0), (0, 1), (1, 1)))
    a, d = (np.where(R[i, i] > LIMIT * c, c, c * (1.0 + LIMIT)) for i, c in ((0, a), (1, d)))
    rest = d - b * b / a
    rest = np.where(rest > LIMIT * d, rest, LIMIT * d)
    second = v[1] - b / a * v[0]
    nis = v[0] * v[0] / a + second * second / rest
    density = -0.5 * nis - np.log(2.0 * math.pi * np.sqrt(a * rest))
    K1 = (S[:, 1] - b / a * S[:, 0]) / rest
    return density, np.stack([(S[:, 0] - b * K1) / a, K1], axis=1)


def _joseph(S: FloatArray, K: FloatArray, R: FloatArray) -> FloatArray:
    """Return (I - K H) S (I - K H)' + K R K' of the first two states, (n, n, L)."""
    left = S - K[:, 0, None] * S[0] - K[:, 1, None] * S[1]
    a, b = (left[:, r] - K[:, 0] * R[0, r] - K[:, 1] * R[1, r] for r in (0, 1))
    return left - a[:, None] * K[:, 0] - b[:, None] * K[:, 1]


def innovations(
    mu: FloatArray, r: FloatArray, S: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return mean (T, 2), covariance (T, 2, 2) and normalised square (T,) of innovations r (T, K,
    2) with covariances S (T, K, 2, 2) of mixtures with weights mu (T, K)."""
    mean = np.einsum('tk,tka->ta', mu, r)
    off = r - mean[:, None]
    whole = np.einsum('tk,tkab->tab', mu, S + off[..., :, None] * off[..., None, :])
    a, b, d = whole[:, 0, 0], whole[:, 0, 1], whole[:, 1, 1]
    determinant = np.maximum(a * d - b * b, LIMIT * a * d)
    v, w = mean.T
    return mean, whole, np.asarray((d * v * v - 2.0 * b * v * w + a * w * w) / determinant)


# -- the beam ------------------------------------------------------------------------------------


class Beam(NamedTuple):
    """Half height and half width of the beam, rad, and its reach, m."""

    vertical: float
    horizontal: float
    reach: float


def visible(
    m: FloatArray, P: FloatArray, mu: FloatArray, beam: Beam
) -> tuple[FloatArray, BoolArray]:
    """Return the probability (T, K, E) that a beam holds the `PARTS` by height of components at m
    (T, K, 3), seen from the sonar, with covariances P (T, K, n, n), at least `UNSEEN`; and whether
    (T,) the targets lie `AHEAD`."""
    x, y, z = np.moveaxis(m, -1, 0)
    d = np.sqrt(x * x + y * y + z * z)
    smear = SMEAR * SMEAR
    up, side = np.arcsin(z / d), np.arctan2(np.abs(y), x)
    std = np.sqrt(smear + P[..., 2, 2] / (d * d))
    above, below = ((edge - up) / std for edge in (beam.vertical, -beam.vertical))
    above, below = (edge[..., None] - PART for edge in (above, below))
    inside = ndtr(above / WITHIN) - ndtr(below / WITHIN)
    level = ndtr((beam.horizontal - side) / np.sqrt(smear + P[..., 1, 1]))
    level *= ndtr((beam.reach - d) / np.sqrt(smear * beam.reach**2 + P[..., 0, 0]))
    inside *= level[..., None]
    mean = np.einsum('tk,tka->ta', mu, m)
    ahead = mean[:, 0] > AHEAD * np.sqrt((mean * mean).sum(axis=1))
    return UNSEEN + (1.0 - UNSEEN) * inside, ahead


def weight_by_beam(
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    m: FloatArray,
    floor: FloatArray,
    slope: FloatArray,
    beam: Beam,
    soft: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the density of mixtures (T, K) times `floor + slope B`, moment-matched component by
    component, and the mean (T,) of B beforehand (`beam`).

    m (T, K, 3): where the means lie, seen from the sonar; floor, slope (T,); beam: of the pattern
    B, and soft, rad, the standard deviation of its edges. Sector and reach fade out likewise.
    """
    X, Y, Z = np.moveaxis(m, -1, 0)
    d = np.sqrt(X * X + Y * Y + Z * Z)
    off = beam.horizontal - np.arctan2(np.abs(Y), X)
    share = np.clip(0.5 + 0.25 * off / soft, 0.0, 1.0)
    share *= np.clip(0.5 + 0.25 * (beam.reach / d - 1.0) / soft, 0.0, 1.0)
    std = np.sqrt(soft * soft + P[..., 2, 2] / (d * d))
    elevation, rate = np.arcsin(Z / d), 1.0 / (std * d)
    above, below = (beam.vertical - elevation) / std, (-beam.vertical - elevation) / std
    upper, lower = (np.exp(-0.5 * side * side) / ROOT_2PI for side in (above, below))
    inside = share * (ndtr(above) - ndtr(below))
    first = share * rate * (lower - upper)
    second = share * rate * rate * (below * lower - above * upper)
    live = mu > NEGLIGIBLE
    weight = floor[:, None] + slope[:, None] * inside
    first = np.where(live, first * slope[:, None] / weight, 0.0)
    second = np.where(live, slope[:, None] * second / weight - first * first, 0.0)
    to_depth = P[..., 2]
    x1 = x + to_depth * first[..., None]
    P1 = P + to_depth[..., :, None] * to_depth[..., None, :] * second[..., None, None]
    mu1 = np.where(live, mu * weight, mu)
    return x1, P1, _normalised(mu1, mu), (mu * np.where(live, inside, 0.0)).sum(axis=1)


# -- what is published ---------------------------------------------------------------------------


def bands(
    mean: FloatArray, std: FloatArray, mu: FloatArray, tail: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the quantiles `tail` and 1 - `tail` (T,) of mixtures (T, K), and the probability (T,)
    below zero. Quantiles by Halley's method inside a bracket, all at once."""
    T = len(mean)
    weight = np.where(mu > NEGLIGIBLE, mu, 0.0)
    # Weights add up to one but for rounding: no probability may leave [0, 1] for it.
    negative = np.minimum((weight * ndtr(-mean / std)).sum(axis=1), 1.0)
    centre = (mu * mean).sum(axis=1)
    square = (mu * (std * std + mean * mean)).sum(axis=1) - centre * centre
    far = NORMAL_95 * np.sqrt(np.maximum(square, 0.0))
    low = np.where(weight > 0.0, mean - 9.0 * std, np.inf).min(axis=1, initial=np.inf)
    high = np.where(weight > 0.0, mean + 9.0 * std, -np.inf).max(axis=1, initial=-np.inf)
    # The search begins where the quantiles of a Gaussian as wide as the mixture would be.
    value = np.clip(np.stack([centre - far, centre + far], axis=1), low[:, None], high[:, None])
    bracket = np.stack([np.repeat(low[:, None], 2, 1), np.repeat(high[:, None], 2, 1)])
    due = np.tile([tail, 1.0 - tail], (T, 1))
    t, side = (part.ravel() for part in np.indices((T, 2)))
    for _ in range(ROUNDS):
        if not len(t):
            break
        own = value[t, side]
        d = (own[:, None] - mean[t]) / std[t]
        height = weight[t] * np.exp(-0.5 * d * d) / (std[t] * ROOT_2PI)
        missing = due[t, side] - (weight[t] * ndtr(d)).sum(axis=1)
        density, slope = height.sum(axis=1), -(height * d / std[t]).sum(axis=1)
        raised = missing > 0.0
        bracket[0, t[raised], side[raised]] = own[raised]
        bracket[1, t[~raised], side[~raised]] = own[~raised]
        value[t, side], done = _halley(own, bracket[:, t, side], missing, density, slope)
        t, side = t[~done], side[~done]
    return value[:, 0], value[:, 1], negative


def _halley(
    value: FloatArray,
    bracket: FloatArray,
    missing: FloatArray,
    density: FloatArray,
    slope: FloatArray,
) -> tuple[FloatArray, BoolArray]:
    """Return the next values (q,) of Halley's method towards quantiles of mixtures that have this
    density there, with this slope, and are `missing` so much probability below; halfway through
    the bracket (2, q) where it would leave it; and which (q,) are the last."""
    known = density > 0.0
    safe = np.where(known, density, 1.0)
    newton = np.where(known, missing / safe, 0.0)
    bend = 0.5 * newton * np.where(known, slope / safe, 0.0)
    # A step e leaves an error of e^3, but where the density bends within it.
    small = np.abs(bend) < 0.5
    step = np.where(known, newton / np.where(small, 1.0 + bend, 1.0), np.inf)
    done = known & (np.abs(newton) <= 1e-5 * (1.0 + np.abs(value))) & (np.abs(bend) <= 1e-3)
    after = value + step
    inside = (bracket[0] < after) & (after < bracket[1])
    return np.where(done | inside, after, 0.5 * (bracket[0] + bracket[1])), done
