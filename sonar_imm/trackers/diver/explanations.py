# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The measurements of one ping and the hypotheses about one diver.

A hypothesis is a Gaussian: one model of one row. All functions take a flat list of L hypotheses, x
(L, n) and P (L, n, n), with ``height``, z of the diver where z is no state. mu (L,) weighs them.

*Expected measurements*: likelihood, residuals and their covariance under the mixture.

*All subsets* (`subset_ping`): the mathematics of `oracles.robust` of the tests, for
measurements that exclude or follow each other. Measurements of one *node*, the echoes of a
transmitter-receiver pair, exclude each other: an explanation takes one of them as good, or none,
which costs ``eps u`` for each. A measurement with a *parent*, the bearing that came with an echo,
is asked only where the echo is taken. The explanations of all hypotheses are one list that grows
node by node.

Inside, the list is the last axis, along which numpy runs.
"""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import Any, NamedTuple

import numpy as np

from ...acoustics.arrivals_3d import BEARING, observe
from ...estimation.arrays import BoolArray, FloatArray, IndexArray, IntArray
from ...estimation.consider import apply_gain, innovation_variances, log_densities
from ...estimation.covariance import is_psd

PRUNE = 14.0
"""An explanation whose log-probability is this much below the best one's is dropped."""

MOST_EXPLANATIONS = 128
"""Explanations of a hypothesis at once; beyond, the worst give way."""

MOST_NUMBERS = 2**20
"""Numbers in the covariances of a list, about: a longer one is updated in parts, to spare
memory."""

USUAL = 16
"""Explanations of a hypothesis, about."""


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


def residuals_at(
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


def variances_of(measured: PingMeasurements) -> FloatArray:
    """Return the variances of the measurements, (C, L) or (C, 1)."""
    variance = measured.variance
    return variance.T if variance.ndim == 2 else variance[:, None]


def last_axis(P: FloatArray) -> FloatArray:
    """Return P (L, n, n) as (n, n, L)."""
    return np.ascontiguousarray(np.moveaxis(P, 0, -1))


def pick(part: Any, rows: IndexArray) -> Any:
    """Return the entries `rows` of the last axis, which stays the one that lies in a row: indexing
    puts it first."""
    return part.take(rows, axis=-1)


def symmetric(P: FloatArray) -> FloatArray:
    return 0.5 * (P + np.swapaxes(P, 0, 1))


Updated = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""x, P, log-evidence (L,), and how good each measurement is, (L, C)."""


def in_parts(
    update: Callable[[FloatArray, FloatArray, PingMeasurements], Updated],
    x: FloatArray,
    P: FloatArray,
    measured: PingMeasurements,
    each: int,
) -> Updated:
    """Return the update of a list, part by part where it is long; each: covariances that one
    hypothesis needs."""
    size = max(1, MOST_NUMBERS // (each * x.shape[1] ** 2))
    if len(x) <= size:
        return update(x, P, measured)
    parts = []
    for first in range(0, len(x), size):
        own, part = slice(first, first + size), measured
        if measured.variance.ndim == 2:
            part = measured._replace(variance=measured.variance[own])
        parts.append(update(x[own], P[own], part))
    x, P, evidence, good = (np.concatenate(column) for column in zip(*parts))
    return x, P, evidence, good


# -- expected measurements -----------------------------------------------------------------------


def fit_each(
    x: FloatArray, P: FloatArray, height: float, measured: PingMeasurements
) -> tuple[FloatArray, FloatArray]:
    """Return the likelihood and the NIS of each measurement under each hypothesis, (L, C) each."""
    nu, gradient = residuals_at(x.T, measured, height)
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
    return np.asarray(residuals_at(x.T, measured, height)[0] @ mu)


def expect_measurements(
    x: FloatArray, P: FloatArray, mu: FloatArray, height: float, measured: PingMeasurements
) -> tuple[FloatArray, FloatArray]:
    """Return residuals (C,), value less the one that the mixture expects, and the covariance (C,
    C) of what is expected, without the variances of the measurements."""
    counts = mu > 0.0
    x, P, mu = x[counts], P[counts], mu[counts]
    nu, gradient = residuals_at(x.T, measured, height)
    residual = nu @ mu
    G = np.ascontiguousarray(np.moveaxis(gradient, -1, 0))
    inside = np.tensordot(mu, G @ P @ np.swapaxes(G, 1, 2), 1)
    apart = nu - residual[:, None]
    covariance = inside + (apart * mu) @ apart.T
    return residual, 0.5 * (covariance + covariance.T)


def joint_nis(residual: FloatArray, covariance: FloatArray, variance: FloatArray) -> float:
    """Return ``residual' S^-1 residual`` with ``S = covariance + diag(variance)``; variance (C,).

    If rounding makes S singular, use eigenvalues in units of the variances.
    """
    S = covariance + np.diag(variance)
    if is_psd(S) or not np.isfinite(S).all():
        return float(residual @ np.linalg.solve(S, residual))
    weight = 1.0 / np.sqrt(variance)
    values, vectors = np.linalg.eigh(weight[:, None] * covariance * weight)
    whitened = vectors.T @ (weight * residual)
    return float((whitened**2 / (1.0 + np.maximum(values, 0.0))).sum())


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
) -> Updated:
    """Update the hypotheses about a diver by all subsets of what a ping measured.

    :param estimated: (n,) False for what is only considered.
    :param most: explanations of a hypothesis at once.
    :returns: x, P, the log-evidence (L,) of the ping and the probability (L, C) that each
        measurement is good.
    """

    def update(x: FloatArray, P: FloatArray, measured: PingMeasurements) -> Updated:
        return _subset_ping(x, P, estimated, height, measured, outlier_probability, most)

    return in_parts(update, x, P, measured, USUAL)


def _subset_ping(
    x: FloatArray,
    P: FloatArray,
    estimated: BoolArray,
    height: float,
    measured: PingMeasurements,
    outlier_probability: float,
    most: int,
) -> Updated:
    L, C = len(x), len(measured.value)
    every = np.arange(L)
    none = np.zeros((C, L), np.bool_)
    now = _Explanations(every, x.T.copy(), symmetric(last_axis(P)), none, np.zeros(L))
    first = 0
    while first < C:
        last = first + int((measured.node[first:] == measured.node[first]).sum())
        node = slice(first, last)
        now = _grow(now, estimated, height, measured, node, outlier_probability, most)
        first = last
    return combine(now.of, now.weight, now.x, now.P, now.good)


def combine(
    of: IntArray, log: FloatArray, x: FloatArray, P: FloatArray, good: np.ndarray
) -> Updated:
    """Return the moments of the B explanations of each hypothesis.

    :param of: (B,) their hypotheses, 0 to L - 1 in rising order, each at least once.
    :param log: (B,) log-probabilities.
    :param x: (n, B), P: (n, n, B), good: (C, B).
    """
    starts = np.flatnonzero(np.diff(of, prepend=-1))
    best = np.maximum.reduceat(log, starts)
    share = np.exp(log - best[of])
    total = np.add.reduceat(share, starts)
    share /= total[of]
    mean = np.add.reduceat(share * x, starts, axis=1)
    apart = x - pick(mean, of)
    covariance = np.empty((len(mean), len(mean), len(starts)))
    for a, own in enumerate(apart):
        second = share * (P[a] + own * apart)
        covariance[a] = np.add.reduceat(second, starts, axis=1)
    taken = np.add.reduceat(share * good, starts, axis=1)
    return mean.T, np.moveaxis(covariance, -1, 0), best + np.log(total), taken.T


def _grow(
    now: _Explanations,
    estimated: BoolArray,
    height: float,
    measured: PingMeasurements,
    node: slice,
    outlier_probability: float,
    most: int,
) -> _Explanations:
    """Return what takes none of a node, and what takes one of its measurements: of each hypothesis
    the `most` probable, but not what is all too improbable."""
    variance = variances_of(measured)[node]
    if variance.shape[1] > 1:
        variance = pick(variance, now.of)
    nu, gradient = residuals_at(now.x, measured, height, node)
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
    if len(old) > most:
        kept = _most_probable(now.of[old], score[old, option], most)
        old, option = old[kept], option[kept]
    taken = np.maximum(option - 1, 0)
    took = option > 0
    good = pick(now.good, old)
    good[node.start + taken, np.arange(len(old))] |= took
    # What takes none has no gain.
    cross = np.where(took, np.ascontiguousarray(cross[taken, :, old].T), 0.0)
    nu = nu[taken, old]
    S = np.where(took, S[taken, old], 1.0)
    x, P = pick(now.x, old), pick(now.P, old)
    apply_gain(x, P, cross, S, nu, estimated)
    return _Explanations(now.of[old], x, P, good, score[old, option])


def _most_probable(of: IntArray, weight: FloatArray, most: int) -> IndexArray:
    """Return where the `most` largest weights of each hypothesis stand, the earlier ones of
    equals; of (B,) in rising order."""
    count = np.bincount(of)
    if count.max() <= most:
        return np.arange(len(of))
    order = np.lexsort((-weight, of))
    rank = np.arange(len(of)) - (np.cumsum(count) - count)[of]
    return np.sort(order[rank < most])
