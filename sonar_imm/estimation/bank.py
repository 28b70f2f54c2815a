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

"""A bank of motion models with different states, for many filters at once: mix, predict, weigh,
update, combine.

A *row* is one interacting multiple model filter under one assumption, for example one scale of the
measurement covariances; a target may have several rows. The M models of a row lie in blocks, and
the models of a block share the components of their state. The arrays of a block are

    x (N, n, m), P (N, n, n, m): N rows, n components, m models,

with the model last, because numpy runs along the last axis: every operation below runs along tens
of models instead of three or four components. ``mu (N, M)`` holds the probabilities of all models,
block by block, and ``transition (N or 1, M, M)`` is ``Pr(model j now | model i before)``.

`mix` works on raw moments about a centre of the row, ``E[d]`` and ``E[d d']``, because these are
what a mixture adds up: the moments of all models times the mixing weights are one matrix product
per row. Between blocks, the moments of a model are first expressed in the components of the other
block (its *image*):

- heading or hover -> velocity: ``v = s u``, with the spread of a sector across. This is linear in
  the raw moments.
- velocity -> heading: the velocity is conditioned on pointing along the heading (a scalar update),
  and the probability of going to a heading is shared among the headings by how well they fit.
- velocity -> hover: the speed is drawn from its prior.

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
    'Moves',
    'predict',
    'predict_fix',
    'update',
    'weigh',
]

DEAD = 1e-300
"""A model that is reached with no more than this probability is given the mixture of all."""

LEAST_ACROSS = 1e-9
"""Variance, (m/s)^2, that a velocity across a heading has at least."""

X, Y, S, VX, VY = 0, 1, 2, 2, 3
"""Places of the components: position and speed of a heading, position and velocity."""

LOG_2PI = math.log(2.0 * math.pi)


class Gaussians(NamedTuple):
    """Means x (N, n, m) and covariances P (N, n, n, m) of one block of models."""

    x: Annotated[FloatArray, 'Nnm']
    P: Annotated[FloatArray, 'Nnnm']

    def select(self, chosen: IndexArray | BoolArray) -> Gaussians:
        """Return the `chosen` rows."""
        return Gaussians(self.x[chosen], self.P[chosen])


@frozen(eq=False, slots=False)
class Moves:
    """One step of a block, x <- F x + B + N(0, Q): F, Q (n, n, m), B (n, m). Components of the
    state behind the first n are constants."""

    F: FloatArray
    Q: FloatArray
    B: FloatArray

    @cached_property
    def changing(self) -> tuple[tuple[int, tuple[int, ...]], ...]:
        """The components that F changes, and those of which each is then made."""
        n = len(self.B)
        rows = [tuple(k for k in range(n) if self.F[i, k].any()) for i in range(n)]
        still = [(self.F[i, i] == 1.0).all() for i in range(n)]
        return tuple((i, row) for i, row in enumerate(rows) if row != (i,) or not still[i])


@frozen(eq=False)
class Bank:
    """What `mix` has to know of the models.

    Without velocities there is one block, whose models share all components.

    units: (2, a) unit vectors of the a models of the first block: (0, 0) for a hover. velocities:
    number of models of the second block. speed, speed_variance: prior of the speed, for what
    becomes a hover. sector: half the width of a heading's sector, as a variance, rad^2.
    """

    units: FloatArray
    velocities: int = 0
    speed: float = 0.0
    speed_variance: float = 1.0
    sector: float = 0.0
    directions: FloatArray = field(init=False)
    """(2, D) the headings that differ."""
    direction: IndexArray = field(init=False)
    """(a,) of each model its place among `directions`, D for a hover."""

    def __attrs_post_init__(self) -> None:
        moving = np.hypot(*self.units) > 0.5
        vectors, place = np.unique(self.units[:, moving].round(12), axis=1, return_inverse=True)
        direction = np.full(self.units.shape[1], vectors.shape[1])
        direction[moving] = place.ravel()
        object.__setattr__(self, 'directions', vectors)
        object.__setattr__(self, 'direction', direction)

    @property
    def hovers(self) -> BoolArray:
        """(a,) True for models of the first block that have no heading."""
        return self.direction == self.directions.shape[1]


# -- mixing --------------------------------------------------------------------------------------


def mix(
    bank: Bank, blocks: Sequence[Gaussians], mu: FloatArray, transition: FloatArray
) -> tuple[list[Gaussians], FloatArray]:
    """Mix the models of each row: return the blocks, and the predicted probabilities c (N, M).

    ``c_j = sum_i W_ij``, ``W_ij = transition_ij mu_i``, and model j gets mean and covariance of
    the mixture of all images with the weights ``W_ij / c_j``.
    """
    W = transition * mu[:, :, None]
    a = bank.units.shape[1]
    centre = _centre(blocks[0], mu[:, :a])
    if bank.velocities:
        # Moments about the origin lose the digits of a position, but not those of a speed, and
        # those of a velocity follow from them.
        centre[:, S] = 0.0
    moments = [_moments(block, _pad_centre(centre, k)) for k, block in enumerate(blocks)]
    images = None
    if bank.velocities:
        images, fit = _to_headings(bank, blocks[1], centre)
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
    return np.triu_indices(n)


def _moments(block: Gaussians, centre: FloatArray) -> FloatArray:
    """Return first and second raw moments about `centre` (N, n, 1) as (N, n + n (n + 1) / 2, m),
    of the second the upper triangle."""
    i, j = _upper(block.x.shape[1])
    d = block.x - centre
    return np.concatenate([d, block.P[:, i, j] + d[:, i] * d[:, j]], axis=1)


def _unpack_moments(moments: FloatArray, centre: FloatArray) -> Gaussians:
    """Return mean and covariance of raw moments about `centre` (N, n, 1)."""
    n = centre.shape[1]
    i, j = _upper(n)
    first = moments[:, :n]
    P = np.empty((len(moments), n, n, moments.shape[-1]))
    P[:, i, j] = moments[:, n:] - first[:, i] * first[:, j]
    P[:, j, i] = P[:, i, j]
    return Gaussians(centre + first, P)


@lru_cache(maxsize=16)
def _velocity_places(n: int) -> tuple[tuple[IndexArray, IndexArray], ...]:
    """Return where the packed moments of n components of a heading stand among those of a
    velocity, as pairs (place in the heading's, place in the velocity's): what has no speed in it,
    what is multiplied by u_x, what by u_y."""
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
    """Return the moments (N, q', a) of headings and hovers in the components of a velocity."""
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
    bank: Bank, block: Gaussians, centre: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return the moments (N, q, b, D + 1) of b velocities as each of D headings and as a hover,
    and the logarithms (N, b, D) of how well each heading fits."""
    x, P = block.x[..., None], block.P[..., None]  # (N, n', b, 1), (N, n', n', b, 1)
    ux, uy = bank.directions
    own = slice(0, VY + 1)  # what stands behind the velocity is not conditioned
    g = ux * P[:, :, VY] - uy * P[:, :, VX]
    speed, across = ux * x[:, VX] + uy * x[:, VY], ux * x[:, VY] - uy * x[:, VX]
    along = ux * ux * P[:, VX, VX] + 2.0 * ux * uy * P[:, VX, VY] + uy * uy * P[:, VY, VY]
    variance = ux * g[:, VY] - uy * g[:, VX]
    variance = variance + bank.sector * (speed * speed + along) + LEAST_ACROSS
    gain = g / variance[:, None]
    x1 = np.broadcast_to(x, g.shape).copy()
    x1[:, own] -= gain[:, own] * across[:, None]
    P1 = P - gain[:, :, None] * g[:, None]
    P1[:, VY + 1 :, VY + 1 :] = P[:, VY + 1 :, VY + 1 :]
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
    """Return states (N, n', ...) and covariances (N, n', n', ...) with the speed along (ux, uy) in
    place of the velocity."""
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
    return np.delete(np.arange(n), [VX, VY])


def _to_hover(bank: Bank, block: Gaussians) -> Gaussians:
    """Return the velocities with the speed of the prior, uncorrelated with all else."""
    N, n, m = block.x.shape
    kept, behind = _without_velocity(n), np.delete(np.arange(n - 1), S)
    x, P = np.empty((N, n - 1, m)), np.zeros((N, n - 1, n - 1, m))
    x[:, behind], x[:, S] = block.x[:, kept], bank.speed
    P[:, behind[:, None], behind] = block.P[:, kept[:, None], kept]
    P[:, S, S] = bank.speed_variance
    return Gaussians(x, P)


def _share_by_direction(W: FloatArray, fit: FloatArray, bank: Bank, a: int) -> None:
    """Share what goes from each velocity to headings in W (N, M, M) by how well each heading fits,
    in place; hovers keep their own."""
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
    """Return the block after a step: ``F x + B``, ``F P F' + Q``.

    Most entries of F are 0 or on the diagonal, so that only the others cost anything. What stands
    behind the components of `moves` is constant.
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


# -- measurements --------------------------------------------------------------------------------

Measured = tuple[tuple[int, ...], ...]
"""Of each measured value, the components whose sum it is: ((0,), (1,)) for a position, ((0, 4),
(1, 5)) for one with an error that is part of the state."""

POSITION: Measured = ((X,), (Y,))


class Innovations(NamedTuple):
    """What p pairs of a row and a measurement of two values say of each of m models.

    v (p, 2, m): innovations; S (p, 3, m): xx, xy, yy of their covariance; R (p, 2, 2); nis, log
    (p, m): normalised squares and ln N(v; 0, S), infinity and -infinity where S is no covariance.
    """

    v: FloatArray
    S: FloatArray
    R: FloatArray
    nis: FloatArray
    log: FloatArray

    def select(self, chosen: IndexArray | BoolArray) -> Innovations:
        """Return the `chosen` pairs."""
        return Innovations._make(part[chosen] for part in self)


def predict_fix(block: Gaussians, measured: Measured = POSITION) -> tuple[FloatArray, FloatArray]:
    """Return what each model expects of a measurement, (N, 2, m), and the covariance of that, (N,
    3, m): xx, xy, yy."""
    PHt = np.swapaxes(_measure(block.P, measured), 1, 2)
    HPHt = _measure(PHt, measured)
    S = np.stack([HPHt[:, 0, 0], HPHt[:, 0, 1], HPHt[:, 1, 1]], axis=1)
    return _measure(block.x, measured), S


def weigh(
    block: Gaussians,
    row: IndexArray,
    z: FloatArray,
    R: FloatArray,
    measured: Measured = POSITION,
) -> Innovations:
    """Compare the models of each pair's row with its measurement: row (p,), z (p, 2), R (p, 2,
    2)."""
    return compare(*predict_fix(block, measured), row, z, R)


def compare(
    h: FloatArray, S: FloatArray, row: IndexArray, z: FloatArray, R: FloatArray
) -> Innovations:
    """Compare each pair's measurement with what its row expects: h, S as of `predict_fix`, the rest
    as in `weigh`."""
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


def _measure(array: FloatArray, measured: Measured) -> FloatArray:
    """Return the measured values (p, 2, ...) of the components (p, n, ...)."""
    if all(len(each) == 1 for each in measured):
        return array[:, [each[0] for each in measured]]
    values = [array[:, list(each)].sum(axis=1) for each in measured]
    return np.stack(values, axis=1)


def update(
    block: Gaussians,
    pairs: Innovations,
    row: IndexArray,
    ratio: FloatArray,
    missed: FloatArray,
    measured: Measured = POSITION,
    estimated: BoolArray | None = None,
) -> tuple[Gaussians, FloatArray]:
    """Update the models of each row by all measurements that may be its own.

    :param row: (p,) of each pair, in rising order.
    :param ratio: (p, m) probability that the pair is true, times the density of its measurement
        under each model over that under the whole target.
    :param missed: (N,) probability that none of the measurements is the target's.
    :param estimated: (n,) False for components that are only considered (Schmidt): an update does
        not move them.
    :returns: the block, moment-matched over the measurements and none, and the weights (N, m) by
        which the probabilities of models and row have to be multiplied.
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
    shift, after = _condition(block, pairs, row, measured, estimated)
    mean = np.add.reduceat(share[:, None] * shift, first)
    # About the new mean: what a sharp measurement leaves is lost beside the square of a shift.
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
) -> tuple[FloatArray, FloatArray]:
    """Return by how much each pair moves the means (p, n, m), and the covariances (p, n, n, m)
    after it, in Joseph's form."""
    a, b, d = (pairs.S[:, None, k] for k in range(3))
    P = block.P[row]
    PHt = np.swapaxes(_measure(P, measured), 1, 2)
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
    PHt = np.swapaxes(_measure(np.swapaxes(P, 1, 2), measured), 1, 2)
    for r in range(2):
        KR = K[:, :, 0] * pairs.R[:, None, 0, r, None] + K[:, :, 1] * pairs.R[:, None, 1, r, None]
        P += (KR - PHt[:, :, r])[:, :, None] * K[:, None, :, r]
    return shift, 0.5 * (P + np.swapaxes(P, 1, 2))


def combine(
    blocks: Sequence[Gaussians], mu: FloatArray, outputs: Sequence[FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return mean (N, q) and covariance (N, q, q) of the mixture of all models of each row.

    outputs: of each block (q, n, m), the outputs of each model in its components.
    """
    means = [np.einsum('qnm,Nnm->Nqm', E, b.x) for E, b in zip(outputs, blocks)]
    # In two steps: numpy would look for the order at each call.
    spreads = [
        np.einsum('Nqbm,rbm->Nqrm', np.einsum('qam,Nabm->Nqbm', E, b.P), E)
        for E, b in zip(outputs, blocks)
    ]
    mean, P = np.concatenate(means, axis=-1), np.concatenate(spreads, axis=-1)
    centre = (mean @ mu[..., None])[..., 0]
    d = mean - centre[..., None]
    total = ((P + d[:, :, None] * d[:, None]) @ mu[:, None, :, None])[..., 0]
    return centre, 0.5 * (total + np.swapaxes(total, 1, 2))
