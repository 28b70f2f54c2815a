# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A ping of many arrivals and the hypotheses about one diver: residuals with heavy tails.

The mathematics of `oracles.robust` of the tests, for a list of L hypotheses as in
`explanations`. Every hypothesis starts from its own prediction and from the positions that the
ping suggests by itself, so that many good arrivals outvote any prior and no prior gates a ping
away. The searches of all hypotheses are one list; those that have arrived drop out of it.

Few arrivals, one of them wild, fit several places. Each place that a hypothesis reaches counts by
its evidence, and the updated Gaussian has the moments of all of them. The search climbs the
density of Student's t alone, which has a slope everywhere. The evidence of a place also knows wild
arrivals: ``(1 - e) t(r) + e u`` for each. With t alone, one late arrival costs more than a place
that the diver cannot have reached.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...acoustics.arrivals_3d import EMISSION, OFFSET, ONE_WAY, X, Y
from ...estimation.arrays import BoolArray, FloatArray, IndexArray, IntArray
from ...estimation.consider import consider_scalar
from ...estimation.covariance import JITTER, semidefinite_roots
from .explanations import (
    combine,
    in_parts,
    last_axis,
    pick,
    PingMeasurements,
    residuals_at,
    symmetric,
    Updated,
    variances_of,
)

DEGREES = 4.0
"""Degrees of freedom of the Student-t density of a residual."""

GOOD_RESIDUAL = 3.0
"""Residual, in standard deviations, of an arrival that is equally likely an outlier."""

MOST_ITERATIONS = 60

SMALLEST_GAIN = 1e-7
"""Gain in log-density that ends a search: far below what a model probability could show."""

SHORTER = 0.5 ** np.arange(1, 10)
"""Shares of a step that are tried where the whole of it does not climb."""

SAME = 4.0
"""Squared distance, in standard deviations of the updated state, within which two maxima are one
place."""

PRUNE = 14.0
"""A place whose log-density is this much below the best one of its hypothesis is dropped."""

FEW_ARRIVALS = 6
"""Measurements up to which each one may be the wild one that hides a place."""

NO_WEIGHT = 1e12
"""Factor on the variance of a measurement that is left out."""

LEAST_GOOD = 1e-9
"""Least probability that an arrival is good; keeps its variance finite."""

FEW = 8
"""Unknowns up to which the equations of all searches are solved together."""


def inlier_probability(squared: FloatArray) -> FloatArray:
    """Return the inlier probability of residuals by their squares, in variances."""
    return np.asarray(1.0 / (1.0 + squared / GOOD_RESIDUAL**2))


class _Prior(NamedTuple):
    """The hypotheses as the searches see them: the `a` components of the state on which a ping
    depends, whitened. The others follow from them."""

    measured: PingMeasurements
    """With columns that point at these components."""
    active: IndexArray
    """(a,) their places in the state."""
    mean: FloatArray
    """(a, L)"""
    root: FloatArray
    """(n, n, L) lower roots of the covariances, these components first."""
    variance: FloatArray
    """(C, L) of the measurements."""
    noise: FloatArray
    """(C, L) the same, not below what a covariance can hold beside the prior."""
    height: float
    degrees: float
    wild: FloatArray
    """(C, L) density of a wild arrival relative to the largest of a good one."""


class _Searches(NamedTuple):
    """S searches, and what they see where they stand."""

    of: IntArray
    """(S,) their hypotheses."""
    u: FloatArray
    """(a, S) whitened states."""
    square: FloatArray
    """(S,) squared distance of the rest of the state from what follows."""
    value: FloatArray
    """(S,) log-densities."""
    residual: FloatArray
    """(C, S)"""
    slope: FloatArray
    """(C, a, S) gradients by u."""
    weight: FloatArray
    """(C, S) weights of the residuals."""

    def only(self, kept: IndexArray) -> _Searches:
        return _Searches._make(pick(part, kept) for part in self)


def _prior(
    x: FloatArray,
    P: FloatArray,
    height: float,
    measured: PingMeasurements,
    degrees: float,
    outlier_probability: float = 0.0,
) -> tuple[_Prior, IndexArray]:
    """Return the prior of the hypotheses whose covariances have roots, and which these are."""
    n, columns = x.shape[1], measured.columns
    offsets = columns[:, OFFSET]
    used = np.append(columns, offsets[offsets >= 0] + 1)
    active = np.unique(used[used >= 0])
    order = np.append(active, np.setdiff1d(np.arange(n), active))
    root = semidefinite_roots(last_axis(P)[order][:, order])
    known = np.flatnonzero((root[range(n), range(n)] > 0.0).all(axis=0))
    place = np.full(n + 1, -1)
    place[active] = np.arange(len(active))
    own = measured._replace(columns=place[columns])
    variance = np.broadcast_to(variances_of(measured), (len(columns), len(x)))
    variance = pick(variance, known)
    parts = own, active, x[np.ix_(known, active)].T.copy(), pick(root, known), variance
    peak = math.exp(math.lgamma(0.5 * degrees + 0.5) - math.lgamma(0.5 * degrees))
    peak /= math.sqrt(degrees * math.pi)
    odds = outlier_probability / (1.0 - outlier_probability)
    wild = odds * measured.density[:, None] * np.sqrt(variance) / peak
    prior = _Prior(*parts, variance, height, degrees, wild)
    nothing = np.zeros(prior.mean.shape)
    seen = (_look(prior, np.arange(len(known)), nothing, nothing[0]).slope ** 2).sum(axis=1)
    return prior._replace(noise=np.maximum(variance, JITTER * seen)), known


def _look(prior: _Prior, of: IntArray, u: FloatArray, square: FloatArray) -> _Searches:
    """Return the searches that stand at u (a, S)."""
    root = pick(prior.root[: len(u), : len(u)], of)
    x = pick(prior.mean, of) + np.einsum('abs,bs->as', root, u)
    residual, gradient = residuals_at(x, prior.measured, prior.height)
    slope = _whitened(gradient, root, prior.measured.columns)
    misfit = residual * residual / pick(prior.variance, of)
    weight = (prior.degrees + 1.0) / (prior.degrees + misfit)
    tails = np.log1p(misfit / prior.degrees).sum(axis=0)
    value = -0.5 * ((u * u).sum(axis=0) + square + (prior.degrees + 1.0) * tails)
    return _Searches(of, u, square, value, residual, slope, weight)


def _whitened(gradient: FloatArray, root: FloatArray, columns: IntArray) -> FloatArray:
    """Return gradients (C, a, S) by the whitened state; root (a, a, S)."""
    if len(root) <= FEW:
        return np.einsum('cas,abs->cbs', gradient, root)
    slope = np.zeros(gradient.shape)
    for each, own, row in zip(slope, gradient, columns.tolist()):
        used = {*row, row[OFFSET] + 1} if row[OFFSET] >= 0 else {*row}
        for k in used - {-1}:
            each[: k + 1] += own[k] * root[k, : k + 1]
    return slope


def _start(prior: _Prior, of: IntArray, positions: FloatArray | None) -> _Searches:
    """Return searches that start at `positions` (2, S), None for those of the prior; the
    emission, if any, at its median."""
    mean = pick(prior.mean, of)
    x = mean.copy()
    columns = prior.measured.columns[0]
    if positions is not None:
        x[columns[[X, Y]]] = positions
    emission, one_way = columns[EMISSION], prior.measured.kind == ONE_WAY
    if emission >= 0:
        x[emission] = 0.0
        if one_way.any():
            late = residuals_at(x, prior.measured, prior.height)[0][one_way]
            x[emission] = np.median(late, axis=0)
    a = len(mean)
    u = np.zeros((len(prior.root), len(of)))
    u[:a] = x - mean
    for k, row in enumerate(prior.root):
        own = row[: k + 1, of]
        u[k] = (u[k] - (own[:k] * u[:k]).sum(axis=0)) / own[k]
    return _look(prior, of, u[:a], (u[a:] * u[a:]).sum(axis=0))


def _step(prior: _Prior, now: _Searches) -> FloatArray:
    """Return the steps (a, S) to the weighted least squares."""
    heavy = now.slope * (now.weight / pick(prior.noise, now.of))[:, None]
    A = _information(now.slope, heavy)
    if len(A) == len(now.u):
        return _solve(A, np.einsum('cas,cs->as', heavy, now.residual) - now.u)
    there = now.residual + np.einsum('cas,as->cs', now.slope, now.u)
    return np.einsum('cas,cs->as', heavy, _solve(A, there)) - now.u


def _information(slope: FloatArray, heavy: FloatArray) -> FloatArray:
    """Return ``1 + H' W H`` (a, a, S) of slopes H (C, a, S) and W H, or, where that is smaller,
    ``1 + H H' W`` (C, C, S), which has the same determinant."""
    if len(slope) < slope.shape[1]:
        A = np.einsum('cas,das->cds', slope, heavy)
    else:
        A = np.einsum('cas,cbs->abs', heavy, slope)
    A[range(len(A)), range(len(A))] += 1.0
    return A


def _solve(A: FloatArray, b: FloatArray) -> FloatArray:
    """Solve A (a, a, S), positive definite but for a scale of its columns, for b (a, S)."""
    if len(A) > FEW:
        solution = np.linalg.solve(np.moveaxis(A, -1, 0), b.T[..., None])[..., 0]
        return np.ascontiguousarray(solution.T)
    A, b = A.copy(), b.copy()
    for k in range(len(A)):
        for i in range(k + 1, len(A)):
            share = A[i, k] / A[k, k]
            b[i] -= share * b[k]
            A[i, k + 1 :] -= share * A[k, k + 1 :]
    for k in range(len(A) - 1, -1, -1):
        b[k] = (b[k] - (A[k, k + 1 :] * b[k + 1 :]).sum(axis=0)) / A[k, k]
    return b


def _shortened(prior: _Prior, old: _Searches, step: FloatArray) -> tuple[_Searches, FloatArray]:
    """Return where searches stand after the longest of `SHORTER` steps that climbs, else after the
    shortest, and their gains (S,)."""
    every, many = np.repeat(np.arange(len(old.of)), len(SHORTER)), len(old.of)
    share = np.tile(SHORTER, many)
    u = pick(old.u, every) + share * pick(step, every)
    square = old.square[every] * (1.0 - share) ** 2
    tried = _look(prior, old.of[every], u, square)
    gain = (tried.value - old.value[every]).reshape(many, -1)
    climbs = gain >= 0.0
    climbs[:, -1] = True
    chosen = climbs.argmax(axis=1) + len(SHORTER) * np.arange(many)
    return tried.only(chosen), gain.ravel()[chosen]


def _climb(prior: _Prior, now: _Searches) -> tuple[FloatArray, FloatArray]:
    """Return the maxima uphill of the searches, u (a, S), and their log-densities (S,)."""
    u, value, live = now.u.copy(), now.value.copy(), np.arange(len(now.of))
    for _ in range(MOST_ITERATIONS):
        step = _step(prior, now)
        trial = _look(prior, now.of, now.u + step, np.zeros(len(live)))
        gain = trial.value - now.value
        lost = np.flatnonzero(~(gain >= 0.0))
        if len(lost):
            shorter, gain[lost] = _shortened(prior, now.only(lost), step[:, lost])
            for part, new in zip(trial, shorter):
                part[..., lost] = new
        better = gain > 0.0
        u[:, live[better]], value[live[better]] = trial.u[:, better], trial.value[better]
        climbs = np.flatnonzero(gain > SMALLEST_GAIN)
        if not len(climbs):
            break
        live, now = live[climbs], trial if len(climbs) == len(live) else trial.only(climbs)
    return u, value


def student_t_maxima(
    mean: FloatArray,
    P: FloatArray,
    positions: FloatArray,
    measured: PingMeasurements,
    height: float,
    degrees: float,
) -> tuple[FloatArray, FloatArray]:
    """Return where the searches end that start at `positions` (S, 2), (S, 2), and their
    log-densities (S,), for one prior `mean` (n,), P (n, n)."""
    prior, known = _prior(mean[None], P[None], height, measured, degrees)
    if not len(known):
        return positions, np.full(len(positions), -np.inf)
    of = np.zeros(len(positions), np.intp)
    u, value = _climb(prior, _start(prior, of, positions.T))
    a = len(u)
    x = prior.mean + prior.root[:a, :a, 0] @ u
    return x[prior.measured.columns[0, [X, Y]]].T, value


def student_t_ping(
    x: FloatArray,
    P: FloatArray,
    estimated: BoolArray,
    height: float,
    measured: PingMeasurements,
    positions: FloatArray,
    degrees: float,
    outlier_probability: float,
) -> Updated:
    """Update the hypotheses about a diver by all that a ping measured at once, with heavy tails.

    :param estimated: (n,) False for what is only considered.
    :param positions: (S, 2) where to start besides the predictions.
    :param outlier_probability: of each measurement to be wild, see `PingMeasurements.density`.
    :returns: x, P, the log-evidence (L,) up to a constant common to the hypotheses, and the inlier
        probability (L, C) of each measurement: the mean of those at the places of a hypothesis, so
        that arrivals which fit different places are not all good. A hypothesis whose covariance
        has no root stays as it is, with evidence -inf.
    """

    def update(x: FloatArray, P: FloatArray, measured: PingMeasurements) -> Updated:
        law = degrees, outlier_probability
        return _student_t_ping(x, P, estimated, height, measured, positions, *law)

    return in_parts(update, x, P, measured, 1 + len(positions) + FEW_ARRIVALS)


def _student_t_ping(
    x: FloatArray,
    P: FloatArray,
    estimated: BoolArray,
    height: float,
    measured: PingMeasurements,
    positions: FloatArray,
    degrees: float,
    outlier_probability: float,
) -> Updated:
    L, C = len(x), len(measured.value)
    x1, P1, evidence, good = x.copy(), P.copy(), np.full(L, -np.inf), np.zeros((L, C))
    prior, known = _prior(x, P, height, measured, degrees, outlier_probability)
    if not len(known):
        return x1, P1, evidence, good
    own = np.arange(len(known))
    starts = [_start(prior, own, None)]
    for place in positions:
        starts.append(_start(prior, own, np.broadcast_to(place[:, None], (2, len(own)))))
    u, _ = _climb(prior, _Searches(*(np.concatenate(p, axis=-1) for p in zip(*starts))))
    if C <= FEW_ARRIVALS and outlier_probability > 0.0:
        u = np.concatenate([u, _without_one(prior)], axis=1)
    now = _distinct(prior, u)
    of, every = now.of, known[now.of]
    noise = pick(prior.noise, of)
    information = _information(now.slope, now.slope * (now.weight / noise)[:, None])
    log = now.value - 0.5 * np.linalg.slogdet(np.moveaxis(information, -1, 0))[1]
    place = pick(prior.mean, of)
    place += np.einsum('abs,bs->as', pick(prior.root[: len(u), : len(u)], of), now.u)
    mean = x[every].T.copy()
    there = mean.copy()
    there[prior.active] = place
    residual, gradient = residuals_at(there, measured, height)
    # The mean, then the covariance, which is that of wider weights.
    wider = np.repeat([1.0, (degrees + 3.0) / (degrees + 1.0)], len(of))
    there, residual, gradient, weight, variance = (
        np.concatenate([part, part], axis=-1)
        for part in (there, residual, gradient, now.weight, pick(prior.variance, of))
    )
    means, covariances = np.tile(mean, 2), np.tile(symmetric(last_axis(P[every])), 2)
    for c in range(C):
        innovation = residual[c] + (gradient[c] * (there - means)).sum(axis=0)
        noise = wider * variance[c] / weight[c]
        consider_scalar(means, covariances, gradient[c], noise, innovation, estimated)
    inlier = inlier_probability((degrees + 1.0) / np.maximum(now.weight, 1e-300) - degrees)
    each = means[:, : len(of)], covariances[..., len(of) :], inlier
    x1[known], P1[known], evidence[known], good[known] = combine(of, log, *each)
    return x1, P1, evidence, good


def _without_one(prior: _Prior) -> FloatArray:
    """Return the maxima (a, C L) of all measurements but one each, uphill of the predictions."""
    C, L = prior.variance.shape
    of = np.tile(np.arange(L), C)
    variance = pick(prior.variance, of)
    variance[np.repeat(np.arange(C), L), np.arange(C * L)] *= NO_WEIGHT
    own = prior._replace(
        mean=pick(prior.mean, of),
        root=pick(prior.root, of),
        variance=variance,
        noise=np.maximum(pick(prior.noise, of), variance),
    )
    return _climb(own, _start(own, np.arange(C * L), None))[0]


def _distinct(prior: _Prior, u: FloatArray) -> _Searches:
    """Return the distinct places among u (a, S L) by hypothesis.

    Their weights and log-densities know wild measurements.
    """
    L = prior.mean.shape[1]
    of = np.arange(L)
    every = _look(prior, np.tile(of, u.shape[1] // L), u, np.zeros(u.shape[1]))
    misfit = every.residual**2 / pick(prior.variance, every.of)
    tail = -0.5 * (prior.degrees + 1.0) * np.log1p(misfit / prior.degrees)
    fit = np.logaddexp(tail, np.log(np.maximum(pick(prior.wild, every.of), 1e-300)))
    good = np.maximum(np.exp(tail - fit), LEAST_GOOD)
    every = every._replace(
        value=every.value + (fit - tail).sum(axis=0), weight=every.weight * good
    )
    order = np.argsort(-every.value.reshape(-1, L), axis=0, kind='stable') * L + of
    kept = np.zeros(order.shape, np.bool_)
    found: list[_Searches] = []
    for new, row in zip(kept, order):
        now = every.only(row)
        new[:] = now.value >= (found or [now])[0].value - PRUNE
        for other, was in zip(found, kept):
            apart = now.u - other.u
            along = np.einsum('cas,as->cs', other.slope, apart)
            distance = (apart**2).sum(axis=0)
            distance += (along**2 * other.weight / prior.noise).sum(axis=0)
            new &= ~was | (distance > SAME)
        found.append(now)
    return every.only(order.T[kept.T])
