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

"""The measurements of one ping and the hypotheses about one diver.

A hypothesis is a Gaussian: one model of one row. All functions take a flat list of L hypotheses, x
(L, n) and P (L, n, n), with ``height``, z of the diver where z is no state. mu (L,) weighs them.

*Expected measurements*: likelihood, residuals and their covariance under the mixture.

*All subsets* (`subset_ping`): the mathematics of `oracles.subset_update` of the tests, for
measurements that exclude or follow each other. Measurements of one *node*, the echoes of a
transmitter-receiver pair, exclude each other: an explanation takes one of them as good, or none,
which costs ``eps u`` for each. A measurement with a *parent*, the bearing that came with an echo,
is asked only where the echo is taken. The explanations of all hypotheses are one list that grows
node by node.

*Heavy tails* (`student_t_ping`): that of `oracles.student_t`, for many arrivals at once. Every
hypothesis starts from its own prediction and from the positions that the ping suggests by itself,
so that many good arrivals outvote any prior and no prior gates a ping away. The searches of all
hypotheses are one list; those that have arrived drop out of it.

Inside, the list is the last axis, along which numpy runs.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from ...acoustics.arrivals_3d import BEARING, EMISSION, observe, OFFSET, ONE_WAY, X, Y
from ...estimation.arrays import BoolArray, FloatArray, IndexArray, IntArray
from ...estimation.consider import (
    apply_gain,
    consider_scalar,
    innovation_variances,
    log_densities,
)
from ...estimation.covariance import JITTER, semidefinite_roots

PRUNE = 14.0
"""An explanation whose log-probability is this much below the best one's is dropped."""

MOST_EXPLANATIONS = 128
"""Explanations of a hypothesis at once; beyond, the worst give way."""

DEGREES = 4.0
"""Degrees of freedom of the Student-t density of a residual."""

MOST_ITERATIONS = 60

SMALLEST_GAIN = 1e-7
"""Gain in log-density that ends a search: far below what a model probability could show."""

SHORTER = 0.5 ** np.arange(1, 10)
"""Shares of a step that are tried where the whole of it does not climb."""

FEW = 8
"""Unknowns up to which the equations of all searches are solved together."""


class PingMeasurements(NamedTuple):
    """The C measurements of one ping, sorted by node, parents before their children."""

    node: IntArray
    """(C,) measurements of one node exclude each other."""
    parent: IntArray
    """(C,) index of the measurement that this one came with, -1 for none."""
    kind: IntArray
    """(C,) see `acoustics.arrivals_3d`."""
    value: FloatArray
    """(C,) m and rad."""
    variance: FloatArray
    """(C,), or (L, C) where each hypothesis assumes its own."""
    density: FloatArray
    """(C,) of a wild value, per unit."""
    tx: FloatArray
    """(C, 3) m."""
    rx: FloatArray
    """(C, 3) m."""
    columns: IntArray
    """(C, 7) see `arrivals_3d.observe`."""


def _residuals(
    x: FloatArray, measured: PingMeasurements, height: float, rows: slice = slice(None)
) -> tuple[FloatArray, FloatArray]:
    """Return the measurements `rows` less what states x (n, L) cause, (C, L), bearings within half
    a turn, and the gradients (C, n, L) of what they cause."""
    kind = measured.kind[rows]
    geometry = measured.columns[rows], measured.tx[rows], measured.rx[rows]
    value, gradient = observe(x, height, kind, *geometry)
    residual = measured.value[rows, None] - value
    turned = kind == BEARING
    if turned.any():
        turns = np.floor(residual[turned] / (2.0 * math.pi) + 0.5)
        residual[turned] -= 2.0 * math.pi * turns
    return residual, gradient


def _variances(measured: PingMeasurements) -> FloatArray:
    """Return the variances of the measurements, (C, L) or (C, 1)."""
    variance = measured.variance
    return variance.T if variance.ndim == 2 else variance[:, None]


def _last(P: FloatArray) -> FloatArray:
    """Return P (L, n, n) as (n, n, L)."""
    return np.ascontiguousarray(np.moveaxis(P, 0, -1))


def _pick(part: Any, rows: IndexArray) -> Any:
    """Return the entries `rows` of the last axis, which stays the one that lies in a row: indexing
    puts it first."""
    return part.take(rows, axis=-1)


def _symmetric(P: FloatArray) -> FloatArray:
    return 0.5 * (P + np.swapaxes(P, 0, 1))


# -- expected measurements -----------------------------------------------------------------------


def fit_each(
    x: FloatArray, P: FloatArray, height: float, measured: PingMeasurements
) -> tuple[FloatArray, FloatArray]:
    """Return the likelihood and the NIS of each measurement under each hypothesis, (L, C) each."""
    nu, gradient = _residuals(x.T, measured, height)
    G = np.ascontiguousarray(np.moveaxis(gradient, -1, 0))
    S = measured.variance + ((G @ P) * G).sum(axis=2)
    nis = nu.T**2 / S
    return np.exp(-0.5 * nis) / np.sqrt(2.0 * math.pi * S), nis


def fit_measurements(
    x: FloatArray, P: FloatArray, mu: FloatArray, height: float, measured: PingMeasurements
) -> tuple[FloatArray, FloatArray]:
    """Return the log-likelihood (C,) of each measurement under the mixture, and its least NIS (C,)
    of any hypothesis."""
    likelihood, nis = fit_each(x, P, height, measured)
    return np.log(np.maximum(mu @ likelihood, 1e-300)), nis.min(axis=0, initial=np.inf)


def expect_residuals(
    x: FloatArray, mu: FloatArray, height: float, measured: PingMeasurements
) -> FloatArray:
    """Return residuals (C,), value less the one that the mixture expects."""
    return np.asarray(_residuals(x.T, measured, height)[0] @ mu)


def expect_measurements(
    x: FloatArray, P: FloatArray, mu: FloatArray, height: float, measured: PingMeasurements
) -> tuple[FloatArray, FloatArray]:
    """Return residuals (C,), value less the one that the mixture expects, and the covariance (C,
    C) of what is expected, without the variances of the measurements."""
    counts = mu > 0.0
    x, P, mu = x[counts], P[counts], mu[counts]
    nu, gradient = _residuals(x.T, measured, height)
    residual = nu @ mu
    G = np.ascontiguousarray(np.moveaxis(gradient, -1, 0))
    inside = np.tensordot(mu, G @ P @ np.swapaxes(G, 1, 2), 1)
    apart = nu - residual[:, None]
    covariance = inside + (apart * mu) @ apart.T
    return residual, 0.5 * (covariance + covariance.T)


# -- all subsets ---------------------------------------------------------------------------------


class _Explanations(NamedTuple):
    """B explanations, sorted by their hypothesis: of (B,), x (n, B), P (n, n, B), good (C, B) the
    measurements taken, weight (B,) log-probability."""

    of: IntArray
    x: FloatArray
    P: FloatArray
    good: BoolArray
    weight: FloatArray


def subset_ping(
    x: FloatArray,
    P: FloatArray,
    estimated: BoolArray,
    height: float,
    measured: PingMeasurements,
    outlier_probability: float,
    most: int,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Update the hypotheses about a diver by all subsets of what a ping measured.

    :param estimated: (n,) False for what is only considered.
    :param most: explanations of a hypothesis at once.
    :returns: x, P, the log-evidence (L,) of the ping and the probability (L, C) that each
        measurement is good.
    """
    L, C = len(x), len(measured.value)
    every = np.arange(L)
    none = np.zeros((C, L), np.bool_)
    now = _Explanations(every, x.T.copy(), _symmetric(_last(P)), none, np.zeros(L))
    first = 0
    while first < C:
        last = first + int((measured.node[first:] == measured.node[first]).sum())
        now = _grow(now, estimated, height, measured, slice(first, last), outlier_probability)
        now = _best(now, most)
        first = last
    starts = np.searchsorted(now.of, every)
    best = np.maximum.reduceat(now.weight, starts)
    share = np.exp(now.weight - best[now.of])
    total = np.add.reduceat(share, starts)
    share /= total[now.of]
    mean = np.add.reduceat(share * now.x, starts, axis=1)
    apart = now.x - _pick(mean, now.of)
    covariance = np.empty((len(mean), len(mean), L))
    for a, own in enumerate(apart):
        second = share * (now.P[a] + own * apart)
        covariance[a] = np.add.reduceat(second, starts, axis=1)
    taken = np.add.reduceat(share * now.good, starts, axis=1)
    return mean.T, np.moveaxis(covariance, -1, 0), best + np.log(total), taken.T


def _grow(
    now: _Explanations,
    estimated: BoolArray,
    height: float,
    measured: PingMeasurements,
    node: slice,
    outlier_probability: float,
) -> _Explanations:
    """Return what takes none of a node, and what takes one of its measurements, but not what is
    all too improbable."""
    variance = _variances(measured)[node]
    if variance.shape[1] > 1:
        variance = _pick(variance, now.of)
    nu, gradient = _residuals(now.x, measured, height, node)
    cross, S = innovation_variances(now.P, gradient, variance)
    wild = math.log(measured.density[node].sum())
    parent = measured.parent[node.start]
    refused = math.log(max(outlier_probability, 1e-300)) + (wild if parent < 0 else 0.0)
    score = np.empty((len(now.of), 1 + len(nu)))
    score[:, 0] = now.weight + refused
    fit = now.weight + math.log1p(-outlier_probability) + log_densities(S, nu)
    if parent >= 0:
        fit = np.where(now.good[parent], fit - wild, -np.inf)
        score[~now.good[parent], 0] = now.weight[~now.good[parent]]
    score[:, 1:] = np.where(np.isfinite(fit), fit, -np.inf).T
    starts = np.flatnonzero(np.diff(now.of, prepend=-1))
    best = np.maximum.reduceat(score.max(axis=1), starts)
    old, option = np.nonzero(score >= (best[now.of] - PRUNE)[:, None])
    taken = np.maximum(option - 1, 0)
    took = option > 0
    good = _pick(now.good, old)
    good[node.start + taken, np.arange(len(old))] |= took
    # What takes none has no gain.
    cross = np.where(took, np.ascontiguousarray(cross[taken, :, old].T), 0.0)
    nu = nu[taken, old]
    S = np.where(took, S[taken, old], 1.0)
    x, P = _pick(now.x, old), _pick(now.P, old)
    apply_gain(x, P, cross, S, nu, estimated)
    return _Explanations(now.of[old], x, P, good, score[old, option])


def _best(now: _Explanations, most: int) -> _Explanations:
    """Return the `most` probable explanations of each hypothesis, the earlier ones of equals."""
    count = np.bincount(now.of)
    if count.max() <= most:
        return now
    order = np.lexsort((-now.weight, now.of))
    rank = np.arange(len(order)) - (np.cumsum(count) - count)[now.of]
    kept = np.sort(order[rank < most])
    return _Explanations._make(_pick(part, kept) for part in now)


# -- heavy tails ---------------------------------------------------------------------------------


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
        return _Searches._make(_pick(part, kept) for part in self)


def _prior(
    x: FloatArray, P: FloatArray, height: float, measured: PingMeasurements, degrees: float
) -> tuple[_Prior, IndexArray]:
    """Return the prior of the hypotheses whose covariances have roots, and which these are."""
    n, columns = x.shape[1], measured.columns
    offsets = columns[:, OFFSET]
    used = np.append(columns, offsets[offsets >= 0] + 1)
    active = np.unique(used[used >= 0])
    order = np.append(active, np.setdiff1d(np.arange(n), active))
    root = semidefinite_roots(_last(P)[order][:, order])
    known = np.flatnonzero((root[range(n), range(n)] > 0.0).all(axis=0))
    place = np.full(n + 1, -1)
    place[active] = np.arange(len(active))
    own = measured._replace(columns=place[columns])
    variance = np.broadcast_to(_variances(measured), (len(columns), len(x)))
    variance = _pick(variance, known)
    parts = own, active, x[np.ix_(known, active)].T.copy(), _pick(root, known), variance
    prior = _Prior(*parts, variance, height, degrees)
    nothing = np.zeros(prior.mean.shape)
    seen = (_look(prior, np.arange(len(known)), nothing, nothing[0]).slope ** 2).sum(axis=1)
    return prior._replace(noise=np.maximum(variance, JITTER * seen)), known


def _look(prior: _Prior, of: IntArray, u: FloatArray, square: FloatArray) -> _Searches:
    """Return the searches that stand at u (a, S)."""
    root = _pick(prior.root[: len(u), : len(u)], of)
    x = _pick(prior.mean, of) + np.einsum('abs,bs->as', root, u)
    residual, gradient = _residuals(x, prior.measured, prior.height)
    slope = _whitened(gradient, root, prior.measured.columns)
    misfit = residual * residual / _pick(prior.variance, of)
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
    mean = _pick(prior.mean, of)
    x = mean.copy()
    columns = prior.measured.columns[0]
    if positions is not None:
        x[columns[[X, Y]]] = positions
    emission, one_way = columns[EMISSION], prior.measured.kind == ONE_WAY
    if emission >= 0:
        x[emission] = 0.0
        if one_way.any():
            late = _residuals(x, prior.measured, prior.height)[0][one_way]
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
    heavy = now.slope * (now.weight / _pick(prior.noise, now.of))[:, None]
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
    u = _pick(old.u, every) + share * _pick(step, every)
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
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """Update the hypotheses about a diver by all that a ping measured at once, with heavy tails.

    :param estimated: (n,) False for what is only considered.
    :param positions: (S, 2) where to start besides the predictions.
    :returns: x, P, the log-evidence (L,) up to a constant common to the hypotheses, and the
        weights (L, C). A hypothesis whose covariance has no root stays as it is, with evidence
        -inf.
    """
    L, C = len(x), len(measured.value)
    x1, P1, evidence, weights = x.copy(), P.copy(), np.full(L, -np.inf), np.zeros((L, C))
    prior, known = _prior(x, P, height, measured, degrees)
    if not len(known):
        return x1, P1, evidence, weights
    own = np.arange(len(known))
    starts = [_start(prior, own, None)]
    for place in positions:
        starts.append(_start(prior, own, np.broadcast_to(place[:, None], (2, len(own)))))
    u, value = _climb(prior, _Searches(*(np.concatenate(p, axis=-1) for p in zip(*starts))))
    u, value = u.reshape(len(u), len(starts), -1), value.reshape(len(starts), -1)
    at, best = u[:, 0], value[0]
    for k in range(1, len(starts)):
        better = value[k] > best + SMALLEST_GAIN
        at, best = np.where(better, u[:, k], at), np.where(better, value[k], best)
    now = _look(prior, own, at, np.zeros(len(own)))
    information = _information(now.slope, now.slope * (now.weight / prior.noise)[:, None])
    evidence[known] = best - 0.5 * np.linalg.slogdet(np.moveaxis(information, -1, 0))[1]
    weights[known] = now.weight.T
    place = prior.mean + np.einsum('abs,bs->as', prior.root[: len(at), : len(at)], at)
    mean = x[known].T.copy()
    there = mean.copy()
    there[prior.active] = place
    residual, gradient = _residuals(there, measured, height)
    # The mean, then the covariance, which is that of wider weights.
    wider = np.repeat([1.0, (degrees + 3.0) / (degrees + 1.0)], len(own))
    there, residual, gradient, weight, variance = (
        np.concatenate([part, part], axis=-1)
        for part in (there, residual, gradient, now.weight, prior.variance)
    )
    means, covariances = np.tile(mean, 2), np.tile(_symmetric(_last(P[known])), 2)
    for c in range(C):
        innovation = residual[c] + (gradient[c] * (there - means)).sum(axis=0)
        noise = wider * variance[c] / weight[c]
        consider_scalar(means, covariances, gradient[c], noise, innovation, estimated)
    x1[known], P1[known] = means[:, : len(own)].T, np.moveaxis(covariances[..., len(own) :], -1, 0)
    return x1, P1, evidence, weights
