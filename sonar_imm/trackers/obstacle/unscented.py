# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The unscented transform of all components at once.

A target is K components of eight states (d, delta, z, s, psi, b_N, b_E, tau): range m, azimuth
rad positive to starboard, depth m of the obstacle, and the errors of the navigation
(`navigation_errors`); with behaviours of ten, e_N and e_E behind them (`filters`). Components with
some weight are gathered into one list of L, and every step is an operation on arrays of states (n,
L), covariances (n, n, L) and sigma points (2 k + 1, L).

Sigma points lie on the columns of the lower Cholesky root of the obstacle's own states, with kappa
= 1, so that no weight is negative. The root is triangular: points on the columns of e leave the
obstacle in its place, so that there are seven different places. A state that a function leaves as
it is needs no sigma points of its own: its covariance stays, and its covariance with an image is a
sum over the columns (`cross_covariance`). The errors of the navigation are small: they take part
by the derivatives of range and azimuth at the mean.

Everything is in NED and FRD. Where no point exists, as can happen at a sigma point, the nearest
existing one is taken.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray, IndexArray
from ...estimation.covariance import are_sound, semidefinite_roots, with_jitter

STATES, COMMON = 10, 8
"""States with behaviours, and those that all components have."""
NAV = slice(3, 8)
"""Of these the errors of the navigation, see `navigation_errors`."""

KAPPA = 1.0
PLACED = 3
"""The first so many states say where an obstacle is."""

DELAY_STEP = 0.05
"""Seconds by which poses are shifted to see what their lateness changes."""

LEAST_NOISE = 0.01
"""Share of the noise of e that is left where e is `slow`."""

NEGLIGIBLE = 1e-12
"""A component that weighs less plays no part in a quantile or a place."""


class Motion(NamedTuple):
    """What the components do in a step, each (C,): ``e' = keep e + w``, ``w ~ N(0, noise I)``, and
    the obstacle goes by ``step e + push w`` along north and east. slow: mean of e e' below which
    the noise falls in proportion to it, 0: nowhere. prior: variance of e before anything is known,
    0 for a behaviour without e."""

    keep: FloatArray
    step: FloatArray
    push: FloatArray
    noise: FloatArray
    slow: FloatArray
    prior: FloatArray

    @classmethod
    def none(cls, C: int) -> Motion:
        """Return the motion of C components that all stay where they are."""
        return cls(*np.zeros((6, C)))


class Step(NamedTuple):
    """Sonar poses before and after, position (3,) and rotation (3, 3); noise (3,): variances the
    time adds to horizontal position, azimuth and depth; cone: which azimuth. v0, v1 (3,): velocity
    of the sonar in the world, m/s; w0, w1 (3,): rate at which it turns, in its own axes, rad/s;
    walk (5,): variances the time `dt` s adds to the errors of the navigation."""

    p0: FloatArray
    R0: FloatArray
    p1: FloatArray
    R1: FloatArray
    noise: FloatArray
    cone: bool
    v0: FloatArray = np.zeros(3)
    w0: FloatArray = np.zeros(3)
    v1: FloatArray = np.zeros(3)
    w1: FloatArray = np.zeros(3)
    walk: FloatArray = np.zeros(5)
    dt: float = 0.0


def points(x: FloatArray, p: FloatArray, R: FloatArray, cone: bool) -> FloatArray:
    """Return where means (T, K, 4) lie, seen from the sonar at (p, R), or from one of each target,
    p (T, 3) and R (T, 3, 3): (T, K, 3)."""
    placed = np.moveaxis(x[..., :PLACED], -1, 0)
    return np.moveaxis(place(placed, *upright(p, R), cone), 0, -1)


def upright(p: FloatArray, R: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return depth and vertical (3,) of the sonar at (p, R), or depths (T, 1) and verticals (3, T,
    1) of those of T targets."""
    if p.ndim == 1:
        return p[2], R[2]
    return p[:, 2, None], R[:, 2].T[..., None]


def place(x: FloatArray, depth: FloatArray, down: FloatArray, cone: bool) -> FloatArray:
    """Return the points (3, ...) of ranges, azimuths and depths x (3, ...), seen from a sonar at
    that depth, from which the vertical is `down` (3, ...): `geometry.reconstruct`, where no point
    exists the nearest one."""
    d, drop = x[0], x[2] - depth
    cosine, sine = np.cos(x[1]), np.sin(x[1])
    a, b, c = down
    if cone:
        r, across, k = d * cosine, d * sine, a
        drop = drop - b * across
    else:
        r, k = d, a * cosine + b * sine
    # Length r at the elevation asin(drop / (r A)) - atan2(k, c): by sines and cosines alone.
    A = np.hypot(k, c)
    upright = A > 0.0
    size = np.where(upright, A, 1.0)
    k, steady = np.where(upright, k / size, 0.0), np.where(upright, c / size, 1.0)
    with np.errstate(divide='ignore', invalid='ignore'):
        up = np.clip(drop / (r * A), -1.0, 1.0)
    flat = np.sqrt((1.0 - up) * (1.0 + up))
    level, down = r * (flat * steady + up * k), r * (up * steady - flat * k)
    if cone:
        return np.stack([level, across, down])
    return np.stack([level * cosine, level * sine, down])


def sigma_points(y: FloatArray, F: FloatArray) -> FloatArray:
    """Return the points (n, 1 + 2 k, L) of states y (n, L) on k columns F (n, k, L): the centre,
    those ahead on each column, those behind."""
    return np.concatenate([y[:, None], y[:, None] + F, y[:, None] - F], axis=1)


def image_moments(
    image: FloatArray, centre: FloatArray, weight: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the mean (q, L) of images (q, 1 + 2 k, L) of sigma points, and the images without it.

    :param centre: (L,) weight of the centre.
    :param weight: (k, L) weight of each point on a column.
    """
    k = len(weight)
    sides = image[:, 1 : k + 1] + image[:, k + 1 :]
    mean = centre * image[:, 0] + (weight * sides).sum(axis=1)
    return mean, image - mean[:, None]


def covariances(image: FloatArray, centre: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the covariances (q, q, L) of images (q, 1 + 2 k, L) without their means."""
    weights = np.concatenate([centre[None], weight, weight])
    found = (weights * image[:, None] * image[None]).sum(axis=2)
    return 0.5 * (found + np.swapaxes(found, 0, 1))


def cross_covariance(image: FloatArray, F: FloatArray, weight: FloatArray) -> FloatArray:
    """Return the covariance (q, n, L) of images (q, 1 + 2 k, L) with states that stay as they are:
    F (n, k, L) their rows of the root; weight (L,) of each point but the centre."""
    k = F.shape[1]
    difference = image[:, 1 : k + 1] - image[:, k + 1 :]
    return (difference[:, None] * F[None]).sum(axis=2) * weight


# -- prediction ----------------------------------------------------------------------------------


def advance(
    x: FloatArray, P: FloatArray, mu: FloatArray, motion: Motion, step: Step
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Predict what the sonar will see.

    :param x: (T, C, 8) of obstacles that are all fixed, or (T, C, 10).
    :param P: (T, C, n, n).
    :param mu: (T, C) weights; components of weight 0 take no part.
    :returns: x, P, and where P (T, C) was repaired (`estimation.covariance`). Dropped components
        are given the numbers of the most probable one of their target, so that all stay finite.
    """
    T, C, size = x.shape
    x1, P1 = np.zeros((T, C, size)), np.zeros((T, C, size, size))
    repaired = np.zeros((T, C), np.bool_)
    live = np.nonzero(~(mu <= 0.0))
    if len(live[0]):
        y, S = _predicted(x[live].T, np.moveaxis(P[live], 0, -1), motion, step, live[1])
        bad = ~are_sound(S)
        if bad.any():
            S, bad = _repaired(S, motion.prior[live[1]] > 0.0, bad)
        x1[live], P1[live] = y.T, np.moveaxis(S, -1, 0)
        repaired[live] = bad
    _fill_dropped(x1, P1, mu)
    return x1, P1, repaired


def _predicted(
    y: FloatArray, S: FloatArray, motion: Motion, step: Step, component: IndexArray
) -> tuple[FloatArray, FloatArray]:
    """Return states (n, L) and covariances (n, n, L) after a step of the components (L,)."""
    size = len(y)
    private = np.array([*range(PLACED), *range(COMMON, size)])
    own = motion.prior[component] > 0.0
    n = np.where(own, len(private), PLACED)
    centre, apart = KAPPA / (n + KAPPA), 0.5 / (n + KAPPA)
    weight = apart * ((private[:, None] < PLACED) | own)
    order = np.concatenate([private, np.arange(size)[NAV]])
    F = np.empty((size, len(private), y.shape[1]))
    F[order] = semidefinite_roots(S[order[:, None], order], len(private)) * np.sqrt(n + KAPPA)
    seen = _moved(y, F[private], motion, step, component)
    echo = np.stack(_echoes(seen, step.cone))
    early, late, echo = echo[:, -2], echo[:, -1], echo[:, :-2]
    J = _slopes(seen[:, 0], step)
    D = _error_slopes(y, J, step)
    D[:, -1] = (late - early) / (2.0 * DELAY_STEP)
    mean, image = image_moments(echo, centre, weight)
    both = cross_covariance(image, F, apart)
    errors = both[:, NAV]
    twice = (errors[:, None] * D[None]).sum(axis=2)
    through = (D[:, :, None] * S[None, NAV]).sum(axis=1)
    out = S.copy()
    out[:2, :2] = covariances(image, centre, weight) + twice + np.swapaxes(twice, 0, 1)
    linear = (through[:, None, NAV] * D[None]).sum(axis=2)
    out[:2, :2] += 0.5 * (linear + np.swapaxes(linear, 0, 1))
    out[:2, 2:] = both[:, 2:] + through[:, 2:]
    out[2:, :2] = np.swapaxes(out[:2, 2:], 0, 1)
    position, azimuth, depth = step.noise
    out[0, 0] += position
    out[1, 1] += position / (mean[0] * mean[0]) + azimuth
    out[2, 2] += depth
    for a, variance in enumerate(step.walk, NAV.start):
        out[a, a] += variance
    y1 = np.concatenate([mean, y[2:]])
    if size > COMMON:
        _add_behaviour(y1, out, J, motion, component)
    return y1, out


def _moved(
    y: FloatArray, F: FloatArray, motion: Motion, step: Step, component: IndexArray
) -> FloatArray:
    """Return where the sigma points of the obstacle's own states lie, seen by the sonar after the
    step, (3, 1 + 2 k + 2, L), F (k, k, L); the last two: the centre, with poses `DELAY_STEP`
    earlier and later."""
    k = len(F)
    s, psi, north, east, tau = y[NAV]
    placed = sigma_points(y[:PLACED], F[:PLACED, :PLACED])
    # Points on other columns lie at the centre.
    side = [*range(1, PLACED + 1), *[0] * (k - PLACED)]
    back = [*range(PLACED + 1, 2 * PLACED + 1), *[0] * (k - PLACED)]
    shift = np.zeros((2 * PLACED + 3, 1))
    shift[-2:] = [[-DELAY_STEP], [DELAY_STEP]]
    delay = tau + shift
    down = step.R0[2, :, None, None] + delay * np.cross(step.R0[2], step.w0)[:, None, None]
    placed = np.concatenate([placed, placed[:, :1], placed[:, :1]], axis=1)
    m = place(placed, step.p0[2] + delay * step.v0[2], down, step.cone)
    m += delay * np.tensordot(_cross_matrix(step.w0), m, axes=1)
    last = len(shift) - 2
    points = [0, *side, *back, last, last + 1]
    m = np.tensordot(step.R1.T @ step.R0, m[:, points], axes=1)
    delay = delay[points]
    gone = (step.p1 - step.p0)[:, None, None]
    gone = gone + delay * (step.v1 - step.v0)[:, None, None]
    stretch = 1.0 + s
    world = np.empty((3, *delay.shape))
    world[0] = -stretch * (gone[0] - psi * gone[1]) - north * step.dt
    world[1] = -stretch * (gone[1] + psi * gone[0]) - east * step.dt
    world[2] = -gone[2]
    if len(y) > COMMON:
        e = sigma_points(y[COMMON:], F[PLACED:]) * motion.step[component]
        world[:2, : 2 * k + 1] += e
        world[:2, 2 * k + 1 :] += e[:, :1]
    m += np.tensordot(step.R1.T, world, axes=1)
    return m - delay * np.tensordot(_cross_matrix(step.w1), m, axes=1)


def _cross_matrix(w: FloatArray) -> FloatArray:
    """Return the matrix (3, 3) of ``w x``."""
    return np.array([[0.0, -w[2], w[1]], [w[2], 0.0, -w[0]], [-w[1], w[0], 0.0]])


def _slopes(m: FloatArray, step: Step) -> FloatArray:
    """Return how range and azimuth change with the obstacle's north and east, (2, 2, L); m (3, L):
    where it is seen."""
    X, Y, Z = m
    d = np.sqrt(X * X + Y * Y + Z * Z)
    axes = step.R1[:2]
    along = axes @ m / d
    if step.cone:
        turn = (axes[:, 1:2] - Y / d * along) / np.sqrt(d * d - Y * Y)
    else:
        turn = (axes[:, 1:2] * X - axes[:, 0:1] * Y) / (X * X + Y * Y)
    return np.stack([along, turn])


def _error_slopes(y: FloatArray, J: FloatArray, step: Step) -> FloatArray:
    """Return how range and azimuth change with the errors of the navigation, (2, 5, L), but for
    its lateness; J: `_slopes`."""
    s, psi, _, _, tau = y[NAV]
    gone = (step.p1 - step.p0)[:, None] + tau * (step.v1 - step.v0)[:, None]
    D = np.empty((2, 5, y.shape[1]))
    D[:, 0] = -J[:, 0] * (gone[0] - psi * gone[1]) - J[:, 1] * (gone[1] + psi * gone[0])
    D[:, 1] = (1.0 + s) * (J[:, 0] * gone[1] - J[:, 1] * gone[0])
    D[:, 2:4] = -step.dt * J
    return D


def _echoes(m: FloatArray, cone: bool) -> tuple[FloatArray, FloatArray]:
    """Return range and azimuth (k, L) of points m (3, k, L), the first of which is the centre; the
    others lie near it, and on the same side of 180 degrees."""
    distance = np.sqrt((m * m).sum(axis=0))
    if cone:
        return distance, np.arcsin(np.clip(m[1] / distance, -1.0, 1.0))
    x, y = m[0, :1], m[1, :1]
    beside = np.arctan2(x * m[1] - y * m[0], x * m[0] + y * m[1])
    beside[0] = 0.0
    return distance, np.arctan2(y, x) + beside


def _add_behaviour(
    y: FloatArray, S: FloatArray, J: FloatArray, motion: Motion, component: IndexArray
) -> None:
    """Add what w brings, to e, to range and azimuth, and to both together, in place; J:
    `_slopes`."""
    keep, push, noise, slow = (
        part[component] for part in (motion.keep, motion.push, motion.noise, motion.slow)
    )
    square = np.square(y[COMMON:]).sum(axis=0) + S[COMMON, COMMON] + S[COMMON + 1, COMMON + 1]
    noise = noise * np.clip(square / np.maximum(slow, 1e-300), LEAST_NOISE, 1.0)
    y[COMMON:] *= keep
    S[COMMON:] *= keep
    S[:, COMMON:] *= keep
    S[:2, :2] += push * push * noise * (J[:, None] * J[None]).sum(axis=2)
    S[:2, COMMON:] += push * noise * J
    S[COMMON:, :2] = np.swapaxes(S[:2, COMMON:], 0, 1)
    for a in (COMMON, COMMON + 1):
        S[a, a] += noise


def _repaired(S: FloatArray, own: BoolArray, bad: BoolArray) -> tuple[FloatArray, BoolArray]:
    """Return the covariances (n, n, L), those that are `bad` (L,) with jitter, of as many states
    as a component has (all where it has its `own`); and which were repaired."""
    S, found = S.copy(), np.zeros(len(bad), np.bool_)
    for size, lanes in ((len(S), bad & own), (COMMON, bad & ~own)):
        which = np.flatnonzero(lanes)
        if len(which):
            S[:size, :size, which], found[which] = with_jitter(S[:size, :size, which])
    return S, found


def _fill_dropped(x: FloatArray, P: FloatArray, mu: FloatArray) -> None:
    """Give the dropped components of each target the numbers of its most probable one, in
    place."""
    t, j = np.nonzero(mu <= 0.0)
    if len(t):
        best = mu.argmax(axis=1)[t]
        x[t, j], P[t, j] = x[t, best], P[t, best]


# -- where it is ---------------------------------------------------------------------------------

RELATIVE = 5
"""Components of g = (r_N, r_E, dz, v_N, v_E): where the obstacle lies from the sonar, m, depth
downwards, and its velocity, m/s."""


def relative(
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    moves: BoolArray,
    p: FloatArray,
    R: FloatArray,
    cone: bool,
) -> tuple[FloatArray, FloatArray]:
    """Return mean (T, K, 5) and covariance (T, K, 5, 5) of g, of components whose first states are
    (d, delta, z) and, where `moves` (K,), the last ones the velocity; zeros where the weight mu
    (T, K) is negligible."""
    T, K, size = x.shape
    mean, covariance = np.zeros((T, K, RELATIVE)), np.zeros((T, K, RELATIVE, RELATIVE))
    live = np.nonzero(mu > NEGLIGIBLE)
    if not len(live[0]):
        return mean, covariance
    y, S = x[live].T.copy(), np.moveaxis(P[live], 0, -1).copy()
    still = ~moves[live[1]]
    y[COMMON:, still] = 0.0
    S[COMMON:, :, still] = S[:, COMMON:, still] = 0.0
    F = semidefinite_roots(S, PLACED) * np.sqrt(PLACED + KAPPA)
    placed = sigma_points(y[:PLACED], F[:PLACED])
    world = np.tensordot(R[:2], place(placed, p[2], R[2], cone), axes=1)
    apart = np.full(y.shape[1], 0.5 / (PLACED + KAPPA))
    centre = np.full(y.shape[1], KAPPA / (PLACED + KAPPA))
    level, world = image_moments(world, centre, np.tile(apart, (PLACED, 1)))
    others = [2, *range(COMMON, size)]
    filled = 3 + size - COMMON
    g, C = np.zeros((RELATIVE, y.shape[1])), np.zeros((RELATIVE, RELATIVE, y.shape[1]))
    g[:2], g[2:filled] = level, y[others]
    g[2] -= p[2]
    C[:2, :2] = covariances(world, centre, np.tile(apart, (PLACED, 1)))
    C[:2, 2:filled] = cross_covariance(world, F[others], apart)
    C[2:filled, :2] = np.swapaxes(C[:2, 2:filled], 0, 1)
    C[2:filled, 2:filled] = S[np.ix_(others, others)]
    mean[live], covariance[live] = g.T, np.moveaxis(C, -1, 0)
    return mean, covariance
