# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Bank of motion models with different states, for many filters at once.

Operations: mix, predict, weigh, update, combine. A *row* is one interacting multiple model filter
under one assumption, for example a covariance scale; a target may have several rows. The M models
of a row lie in blocks. The models of a block have the same state components. The arrays of a block
are

    x (N, n, m), P (N, n, n, m): N rows, n components, m models,

with the model last, because numpy is fastest along the last axis, and there are tens of models but
only three or four components. ``mu (N, M)`` holds the model probabilities, block by block.
``transition (N or 1, M, M)`` is ``Pr(model j now | model i before)``.

`mix` works on raw moments about a centre of the row, ``E[d]`` and ``E[d d']``, because the moments
of a mixture are weighted sums: one matrix product per row. Between blocks, the moments of a model
are first converted to the components of the other block (its *image*):

- heading or hover -> velocity: ``v = s u``, with the spread of a sector across. This is linear in
  the raw moments.
- velocity -> heading: the velocity is conditioned on the direction of the heading (a scalar
  update). The probability of a transition to a heading is distributed by the likelihood of each
  heading.
- velocity -> hover: the speed has its prior.

Source: docs/diver.md, 'Families'.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, lru_cache
import math
from typing import Annotated, NamedTuple

from attrs import field, frozen
import numpy as np
from scipy.special import erfc

from .arrays import BoolArray, FloatArray, IndexArray

__all__ = [
    'Bank',
    'combine',
    'compare',
    'Gaussians',
    'Innovations',
    'mix',
    'mixture_log_density',
    'move_along',
    'Moves',
    'predict',
    'predict_fix',
    'update',
    'weigh',
]

DEAD = 1e-300
"""Probability up to which a predicted model gets the mixture of all models."""

LEAST_ACROSS = 1e-9
"""Minimum variance of a velocity across a heading, (m/s)^2."""

X, Y, S, VX, VY = 0, 1, 2, 2, 3
"""Component indices: position and speed of a heading, position and velocity."""

LOG_2PI = math.log(2.0 * math.pi)


class Gaussians(NamedTuple):
    """Means and covariances of one block of models."""

    x: Annotated[FloatArray, 'Nnm']
    """(N, n, m)."""
    P: Annotated[FloatArray, 'Nnnm']
    """(N, n, n, m)."""

    def select(self, chosen: IndexArray | BoolArray) -> Gaussians:
        """Return the `chosen` rows."""
        return Gaussians(self.x[chosen], self.P[chosen])


@frozen(eq=False, slots=False)
class Moves:
    """One step of a block, x <- F x + B + N(0, Q). Components after the first n are constants."""

    F: FloatArray
    """(n, n, m)."""
    Q: FloatArray
    """(n, n, m)."""
    B: FloatArray
    """(n, m)."""

    @cached_property
    def changing(self) -> tuple[tuple[int, tuple[int, ...]], ...]:
        """Components that F changes, each with the components of its new value."""
        n = len(self.B)
        rows = [tuple(k for k in range(n) if self.F[i, k].any()) for i in range(n)]
        still = [(self.F[i, i] == 1.0).all() for i in range(n)]
        return tuple((i, row) for i, row in enumerate(rows) if row != (i,) or not still[i])


@frozen(eq=False)
class Bank:
    """Model data for `mix`.

    Without velocities there is one block, whose models have the same components.
    """

    units: FloatArray
    """(2, a) unit vectors of the a models of the first block; (0, 0) for a hover."""
    velocities: int = 0
    """Number of models of the second block."""
    speed: float = 0.0
    """Prior mean of the speed of a hover, m/s."""
    speed_variance: float = 1.0
    """Prior variance of the speed, (m/s)^2."""
    sector: float = 0.0
    """Variance of the direction in a heading sector, rad^2."""
    directions: FloatArray = field(init=False)
    """(2, D) distinct headings."""
    direction: IndexArray = field(init=False)
    """(a,) index of each model in `directions`; D for a hover."""

    def __attrs_post_init__(self) -> None:
        moving = np.hypot(*self.units) > 0.5
        vectors, place = np.unique(self.units[:, moving].round(12), axis=1, return_inverse=True)
        direction = np.full(self.units.shape[1], vectors.shape[1])
        direction[moving] = place.ravel()
        object.__setattr__(self, 'directions', vectors)
        object.__setattr__(self, 'direction', direction)

    @property
    def hovers(self) -> BoolArray:
        """(a,) True for models of the first block without a heading."""
        return self.direction == self.directions.shape[1]


# -- mixing --------------------------------------------------------------------------------------


def mix(
    bank: Bank,
    blocks: Sequence[Gaussians],
    mu: FloatArray,
    transition: FloatArray,
    tail: int = 0,
) -> tuple[list[Gaussians], FloatArray]:
    """Mix the models of each row. Return the blocks and the predicted probabilities c (N, M).

    ``c_j = sum_i W_ij``, ``W_ij = transition_ij mu_i``. Model j gets mean and covariance of the
    mixture of all images with weights ``W_ij / c_j``.

    :param tail: number of last components that a direction also conditions; others behind the
        velocity are considered.
    """
    W = transition * mu[:, :, None]
    a = bank.units.shape[1]
    centre = _centre(blocks[0], mu[:, :a])
    if bank.velocities:
        # A centre is needed for the digits of a position, not for those of a speed.
        centre[:, S] = 0.0
    moments = [_moments(block, _pad_centre(centre, k)) for k, block in enumerate(blocks)]
    images = None
    if bank.velocities:
        images, fit = _to_headings(bank, blocks[1], centre, tail)
        _share_by_direction(W, fit, bank, a)
    c = W.sum(axis=1)
    dead = c <= DEAD
    W = np.where(dead[:, None], mu[:, :, None], W / np.where(dead, 1.0, c)[:, None])
    mixed = moments[0] @ W[:, :a, :a]
    if images is None:
        return [_unpack_moments(mixed, _pad_centre(centre, 0))], c
    for k in range(bank.velocities):
        mixed += images[:, :, k, bank.direction] * W[:, None, a + k, :a]
    as_velocities = _to_velocities(bank, moments[0], blocks[0].x.shape[1])
    moving = moments[1] @ W[:, a:, a:] + as_velocities @ W[:, :a, a:]
    return [
        _unpack_moments(mixed, _pad_centre(centre, 0)),
        _unpack_moments(moving, _pad_centre(centre, 1)),
    ], c


def _centre(block: Gaussians, mu: FloatArray) -> FloatArray:
    """Return the mean (N, n) of the models of a block."""
    weight = np.maximum(mu, 1e-12)
    weight = weight / weight.sum(axis=1, keepdims=True)
    return np.asarray((block.x @ weight[..., None])[..., 0])


def _pad_centre(centre: FloatArray, block: int) -> FloatArray:
    """Return the centre (N, n, 1) in the components of a block: a velocity has one more."""
    if block == 0:
        return centre[..., None]
    return np.insert(centre, VY, 0.0, axis=1)[..., None]


@lru_cache(maxsize=64)
def _upper(n: int) -> tuple[IndexArray, IndexArray]:
    """Return the indices of the upper triangle."""
    return np.triu_indices(n)


def _moments(block: Gaussians, centre: FloatArray) -> FloatArray:
    """Return raw moments about `centre` (N, n, 1) as (N, n + n (n + 1) / 2, m): first, then the
    upper triangle of the second."""
    i, j = _upper(block.x.shape[1])
    d = block.x - centre
    return np.concatenate([d, block.P[:, i, j] + d[:, i] * d[:, j]], axis=1)


def _unpack_moments(moments: FloatArray, centre: FloatArray) -> Gaussians:
    """Return mean and covariance from raw moments about `centre` (N, n, 1)."""
    n = centre.shape[1]
    i, j = _upper(n)
    first = moments[:, :n]
    P = np.empty((len(moments), n, n, moments.shape[-1]))
    P[:, i, j] = moments[:, n:] - first[:, i] * first[:, j]
    P[:, j, i] = P[:, i, j]
    return Gaussians(centre + first, P)


@lru_cache(maxsize=16)
def _velocity_places(n: int) -> tuple[tuple[IndexArray, IndexArray], ...]:
    """Return pairs of indices (heading moment, velocity moment) of n heading components.

    Three pairs: moments without speed, moments to multiply by u_x, and by u_y.
    """
    i, j = _upper(n)
    of_velocity = zip(*(part.tolist() for part in _upper(n + 1)))
    big = {pair: place for place, pair in enumerate(of_velocity, start=n + 1)}

    def moved(component: int, axis: int) -> int:
        if component == S:
            return VX + axis
        return component + (component > S)

    plain = [(k, moved(k, 0)) for k in range(n) if k != S]
    linear = [[(S, VX + axis)] for axis in (0, 1)]
    for k, (p, q) in enumerate(zip(i.tolist(), j.tolist()), start=n):
        if p != S and q != S:
            plain.append((k, big[moved(p, 0), moved(q, 0)]))
        elif p != q:
            for axis in (0, 1):
                at = sorted((moved(p, axis), moved(q, axis)))
                linear[axis].append((k, big[at[0], at[1]]))
    pairs = (np.array(each, dtype=np.int64).T for each in (plain, *linear))
    return tuple((each[0], each[1]) for each in pairs)


def _to_velocities(bank: Bank, moments: FloatArray, n: int) -> FloatArray:
    """Return the moments (N, q', a) of headings and hovers in velocity components."""
    (source, target), *along = _velocity_places(n)
    size = n + 1
    out = np.zeros((len(moments), size + size * (size + 1) // 2, moments.shape[-1]))
    out[:, target] = moments[:, source]
    for u, (own, there) in zip(bank.units, along):
        out[:, there] = moments[:, own] * u
    u, v = bank.units
    half = np.where(bank.hovers, 0.5, 0.0)
    # E[s s] times u u' + sector w w', or half of it on each axis where there is no heading.
    spread = (
        u * u + bank.sector * v * v + half,
        (1.0 - bank.sector) * u * v,
        v * v + bank.sector * u * u + half,
    )
    i, j = _upper(n)
    speed = moments[:, n + int(np.flatnonzero((i == S) & (j == S))[0])]
    i, j = _upper(size)
    for (p, q), factor in zip(((VX, VX), (VX, VY), (VY, VY)), spread):
        out[:, size + int(np.flatnonzero((i == p) & (j == q))[0])] = speed * factor
    return out


def _to_headings(
    bank: Bank, block: Gaussians, centre: FloatArray, tail: int = 0
) -> tuple[FloatArray, FloatArray]:
    """Return the moments (N, q, b, D + 1) of b velocities as D headings and a hover, and the log
    likelihoods (N, b, D) of the headings."""
    x, P = block.x[..., None], block.P[..., None]  # (N, n', b, 1), (N, n', n', b, 1)
    ux, uy = bank.directions
    considered = slice(VY + 1, x.shape[1] - tail)
    g = ux * P[:, :, VY] - uy * P[:, :, VX]
    speed, across = ux * x[:, VX] + uy * x[:, VY], ux * x[:, VY] - uy * x[:, VX]
    along = ux * ux * P[:, VX, VX] + 2.0 * ux * uy * P[:, VX, VY] + uy * uy * P[:, VY, VY]
    variance = ux * g[:, VY] - uy * g[:, VX]
    variance = variance + bank.sector * (speed * speed + along) + LEAST_ACROSS
    gain = g / variance[:, None]
    x1 = x - gain * across[:, None]
    x1[:, considered] = x[:, considered]
    P1 = P - gain[:, :, None] * g[:, None]
    P1[:, considered, considered] = P[:, considered, considered]
    # From (.., vx, vy, ..) to (.., s, ..).
    x2, P2 = _with_speed(x1, P1, ux, uy)
    fit = -0.5 * (across * across / variance + LOG_2PI + np.log(variance))
    fit = fit + _log_positive_part(x2[:, S], P2[:, S, S])
    hover = _to_hover(bank, block)
    x2 = np.concatenate([x2, hover.x[..., None]], axis=-1)
    P2 = np.concatenate([P2, hover.P[..., None]], axis=-1)
    return _moments(Gaussians(x2, P2), centre[..., None, None]), fit


def _with_speed(
    x: FloatArray, P: FloatArray, ux: FloatArray, uy: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Replace the velocity of states (N, n', ...) and covariances (N, n', n', ...) by the speed
    along (ux, uy)."""
    kept = _without_velocity(x.shape[1])
    n, behind = x.shape[1] - 1, np.delete(np.arange(x.shape[1] - 1), S)
    x1 = np.empty((len(x), n, *x.shape[2:]))
    x1[:, behind], x1[:, S] = x[:, kept], ux * x[:, VX] + uy * x[:, VY]
    P1 = np.empty((len(x), n, n, *x.shape[2:]))
    P1[:, behind[:, None], behind] = P[:, kept[:, None], kept]
    with_s = ux * P[:, :, VX] + uy * P[:, :, VY]
    P1[:, behind, S] = P1[:, S, behind] = with_s[:, kept]
    P1[:, S, S] = ux * with_s[:, VX] + uy * with_s[:, VY]
    return x1, P1


@lru_cache(maxsize=16)
def _without_velocity(n: int) -> IndexArray:
    """Return the indices of all components except the velocity."""
    return np.delete(np.arange(n), [VX, VY])


def _to_hover(bank: Bank, block: Gaussians) -> Gaussians:
    """Replace the velocities by the prior speed, uncorrelated with other components."""
    N, n, m = block.x.shape
    kept, behind = _without_velocity(n), np.delete(np.arange(n - 1), S)
    x, P = np.empty((N, n - 1, m)), np.zeros((N, n - 1, n - 1, m))
    x[:, behind], x[:, S] = block.x[:, kept], bank.speed
    P[:, behind[:, None], behind] = block.P[:, kept[:, None], kept]
    P[:, S, S] = bank.speed_variance
    return Gaussians(x, P)


def _share_by_direction(W: FloatArray, fit: FloatArray, bank: Bank, a: int) -> None:
    """Distribute the transitions from velocities to headings in W (N, M, M) by likelihood, in
    place.

    Hovers do not change.
    """
    moving = np.flatnonzero(~bank.hovers)
    best = fit.max(axis=-1, keepdims=True)
    known = np.isfinite(best)
    share = np.exp(np.where(known, fit - best, 0.0))[..., bank.direction[moving]]
    share = share / share.sum(axis=-1, keepdims=True)
    going = W[:, a:, moving]
    W[:, a:, moving] = np.where(known, going.sum(axis=-1, keepdims=True) * share, going)


def _log_positive_part(mean: FloatArray, variance: FloatArray) -> FloatArray:
    """Return ln E[max(s, 0)] of normal s."""
    std = np.sqrt(np.maximum(variance, 1e-300))
    t = mean / std
    near = np.maximum(t, -30.0)
    value = np.exp(-0.5 * near * near - 0.5 * LOG_2PI) + 0.5 * near * erfc(-near / math.sqrt(2.0))
    far = -0.5 * (t * t + LOG_2PI) - 2.0 * np.log(np.maximum(-t, 1.0))
    return np.asarray(np.log(std) + np.where(t > -30.0, np.log(value), far))


# -- prediction ----------------------------------------------------------------------------------


def predict(block: Gaussians, moves: Moves) -> Gaussians:
    """Predict the block over a step: ``F x + B``, ``F P F' + Q``.

    Only entries of F outside the identity are computed. Components after those of `moves` are
    constant.
    """
    n, F, changing = len(moves.B), moves.F, moves.changing
    x, left = block.x.copy(), block.P.copy()
    for i, row in changing:
        x[:, i] = sum(F[i, k] * block.x[:, k] for k in row)
        left[:, i] = sum(F[i, k] * block.P[:, k] for k in row)
    x[:, :n] += moves.B
    P = left.copy()
    for j, row in changing:
        P[:, :, j] = sum(F[j, k] * left[:, :, k] for k in row)
    P[:, :n, :n] += moves.Q
    return Gaussians(x, P)


def move_along(block: Gaussians, velocity: FloatArray, dt: FloatArray) -> Gaussians:
    """Move the positions of each row by its velocity times `dt` (N,), without noise.

    :param velocity: (2, n, m) maps of the first n components to the velocity.
    """
    chosen = np.flatnonzero(dt)
    if not len(chosen):
        return block
    x, P, step = block.x.copy(), block.P.copy(), dt[chosen, None, None]
    n, place = velocity.shape[1], slice(X, Y + 1)
    x[chosen, place] += step * np.einsum('qnm,Nnm->Nqm', velocity, block.x[chosen, :n])
    half = block.P[chosen]
    half[:, place] += step[..., None] * np.einsum('qnm,Nnkm->Nqkm', velocity, half[:, :n])
    half[:, :, place] += step[..., None] * np.einsum('qnm,Nknm->Nkqm', velocity, half[:, :, :n])
    P[chosen] = 0.5 * (half + np.swapaxes(half, 1, 2))
    return Gaussians(x, P)


# -- measurements --------------------------------------------------------------------------------

Measured = tuple[tuple[int, ...], ...]
"""The components whose sum is each measured value: ((0,), (1,)) for a position, ((0, 4), (1, 5))
with a bias in the state."""

POSITION: Measured = ((X,), (Y,))


class Innovations(NamedTuple):
    """Comparison of p pairs of a row and a measurement of two values, for each of m models."""

    v: FloatArray
    """(p, 2, m) innovations."""
    S: FloatArray
    """(p, 3, m) xx, xy, yy of their covariance."""
    R: FloatArray
    """(p, 2, 2) measurement covariance."""
    nis: FloatArray
    """(p, m) normalised innovation squared; infinity if S is invalid."""
    log: FloatArray
    """(p, m) ln N(v; 0, S); -infinity if S is invalid."""

    def select(self, chosen: IndexArray | BoolArray) -> Innovations:
        """Return the `chosen` pairs."""
        return Innovations._make(part[chosen] for part in self)


def predict_fix(
    block: Gaussians, measured: Measured = POSITION, offset: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the predicted measurement (N, 2, m) of each model, and its covariance (N, 3, m): xx,
    xy, yy.

    :param offset: (N,) factor of the offset in the measurement of each row; the offset is the last
        two components. None for no offset.
    """
    PHt = np.swapaxes(_measure(block.P, measured, offset), 1, 2)
    HPHt = _measure(PHt, measured, offset)
    S = np.stack([HPHt[:, 0, 0], HPHt[:, 0, 1], HPHt[:, 1, 1]], axis=1)
    return _measure(block.x, measured, offset), S


def weigh(
    block: Gaussians,
    row: IndexArray,
    z: FloatArray,
    R: FloatArray,
    measured: Measured = POSITION,
) -> Innovations:
    """Compare the models of each row with a measurement: row (p,), z (p, 2), R (p, 2, 2)."""
    return compare(*predict_fix(block, measured), row, z, R)


def compare(
    h: FloatArray, S: FloatArray, row: IndexArray, z: FloatArray, R: FloatArray
) -> Innovations:
    """Compare measurements with predictions h, S of `predict_fix`; other arguments as in
    `weigh`."""
    v = z[..., None] - h[row]
    S = S[row] + np.stack([R[:, 0, 0], R[:, 0, 1], R[:, 1, 1]], axis=1)[..., None]
    a, b, d = S[:, 0], S[:, 1], S[:, 2]
    # By the Cholesky factor, written out: a determinant would lose digits.
    with np.errstate(divide='ignore', invalid='ignore', over='ignore'):
        left = d - b * b / a
        second = v[:, 1] - b / a * v[:, 0]
        nis = v[:, 0] * v[:, 0] / a + second * second / left
        log = -0.5 * (nis + np.log(a * left)) - LOG_2PI
        good = (a > 0.0) & (left > 0.0) & np.isfinite(log)
    return Innovations(v, S, R, np.where(good, nis, np.inf), np.where(good, log, -np.inf))


def mixture_log_density(mu: FloatArray, compared: Sequence[Innovations]) -> FloatArray:
    """Return the log density (p,) of each pair over all models. mu: (p, M) model probabilities."""
    with np.errstate(divide='ignore'):
        of_models = np.log(mu) + np.concatenate([each.log for each in compared], axis=1)
        best = of_models.max(axis=1, initial=-np.inf, keepdims=True)
        safe = np.where(np.isfinite(best), best, 0.0)
        return np.asarray(
            (best + np.log(np.exp(of_models - safe).sum(axis=1, keepdims=True)))[:, 0]
        )


def _measure(
    array: FloatArray, measured: Measured, offset: FloatArray | None = None
) -> FloatArray:
    """Return the measured values (p, 2, ...) of the components (p, n, ...).

    offset: (p,) factor of the last two components; None for zero.
    """
    if all(len(each) == 1 for each in measured):
        values = array[:, [each[0] for each in measured]]
    else:
        values = np.stack([array[:, list(each)].sum(axis=1) for each in measured], axis=1)
    if offset is None:
        return values
    factor = offset.reshape(-1, *(1,) * (array.ndim - 1))
    return np.asarray(values + factor * array[:, -2:])


def update(
    block: Gaussians,
    pairs: Innovations,
    row: IndexArray,
    ratio: FloatArray,
    missed: FloatArray,
    measured: Measured = POSITION,
    estimated: BoolArray | None = None,
    offset: FloatArray | None = None,
) -> tuple[Gaussians, FloatArray]:
    """Update the models of each row by its measurements.

    :param row: (p,) row of each pair, in rising order.
    :param ratio: (p, m) probability of the pair, times the likelihood ratio of each model to the
        whole target.
    :param missed: (N,) probability that no measurement belongs to the target.
    :param estimated: (n,) False for considered components (Schmidt), which an update does not
        change.
    :param offset: see `predict_fix`.
    :returns: the moment-matched block, and the factors (N, m) of the model probabilities and row
        weight.
    """
    weight = np.repeat(missed[:, None], ratio.shape[1], axis=1)
    if not len(row):
        return block, weight
    rows, first = np.unique(row, return_index=True)
    weight[rows] += np.add.reduceat(ratio, first)
    total = weight[rows]
    alive = total > 0.0
    scale = np.where(alive, total, 1.0)
    at = np.repeat(np.arange(len(rows)), np.diff([*first, len(row)]))
    share = np.where(alive[at], ratio / scale[at], 0.0)
    none = np.where(alive, missed[rows, None] / scale, 1.0)
    of_pairs = None if offset is None else offset[row]
    shift, after = _condition(block, pairs, row, measured, estimated, of_pairs)
    mean = np.add.reduceat(share[:, None] * shift, first)
    # Moments about the new mean: a small posterior variance is lost beside a squared shift.
    apart = shift - mean[at]
    spread = after + apart[:, :, None] * apart[:, None]
    P = none[:, None, None] * (block.P[rows] + mean[:, :, None] * mean[:, None])
    P += np.add.reduceat(share[:, None, None] * spread, first)
    x1, P1 = block.x.copy(), block.P.copy()
    x1[rows] += mean
    P1[rows] = 0.5 * (P + np.swapaxes(P, 1, 2))
    return Gaussians(x1, P1), weight


def _condition(
    block: Gaussians,
    pairs: Innovations,
    row: IndexArray,
    measured: Measured,
    estimated: BoolArray | None,
    offset: FloatArray | None,
) -> tuple[FloatArray, FloatArray]:
    """Return the mean shifts (p, n, m) and posterior covariances (p, n, n, m) of each pair, in
    Joseph form."""
    a, b, d = (pairs.S[:, None, k] for k in range(3))
    P = block.P[row]
    PHt = np.swapaxes(_measure(P, measured, offset), 1, 2)
    with np.errstate(divide='ignore', invalid='ignore'):
        left = d - b * b / a
        second = (PHt[:, :, 1] - b / a * PHt[:, :, 0]) / left
        K = np.stack([(PHt[:, :, 0] - b * second) / a, second], axis=2)
    K = np.where(np.isfinite(pairs.log)[:, None, None], K, 0.0)
    if estimated is not None:
        K[:, ~estimated] = 0.0
    shift = K[:, :, 0] * pairs.v[:, None, 0] + K[:, :, 1] * pairs.v[:, None, 1]
    # (I - K H) P, then times (I - K H)' and with K R K'.
    for r in range(2):
        P -= K[:, :, None, r] * PHt[:, None, :, r]
    PHt = np.swapaxes(_measure(np.swapaxes(P, 1, 2), measured, offset), 1, 2)
    for r in range(2):
        KR = K[:, :, 0] * pairs.R[:, None, 0, r, None] + K[:, :, 1] * pairs.R[:, None, 1, r, None]
        P += (KR - PHt[:, :, r])[:, :, None] * K[:, None, :, r]
    return shift, 0.5 * (P + np.swapaxes(P, 1, 2))


def combine(
    blocks: Sequence[Gaussians], mu: FloatArray, outputs: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return mean (N, q) and covariance (N, q, q) of the mixture of all models of each row.

    outputs: (q, n, m) output maps of each block.
    """
    means = [np.einsum('qnm,Nnm->Nqm', E, b.x) for E, b in zip(outputs, blocks)]
    # In two steps, because numpy would search the contraction order at each call.
    spreads = [
        np.einsum('Nqbm,rbm->Nqrm', np.einsum('qam,Nabm->Nqbm', E, b.P), E)
        for E, b in zip(outputs, blocks)
    ]
    mean, P = np.concatenate(means, axis=-1), np.concatenate(spreads, axis=-1)
    centre = (mean @ mu[..., None])[..., 0]
    d = mean - centre[..., None]
    total = ((P + d[:, :, None] * d[:, None]) @ mu[:, None, :, None])[..., 0]
    return centre, 0.5 * (total + np.swapaxes(total, 1, 2))
