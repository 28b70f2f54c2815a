# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The interacting multiple model filter (Blom and Bar-Shalom 1988), for many targets at once.

Four verbs make one cycle, each a pure function of arrays::

    mixed = mix(x, P, mu, transition)                        # who could have become model j
    x, P = predict(mixed.x, mixed.P, F, Q, B)                # each model moves
    step = update(x, P, mixed.c, innovation, H, R)           # each model meets the measurement
    mean, covariance = combine(step.x, step.P, step.mu, E)   # one answer

Shapes: T targets, M models, n states, m measured values. ``x (T, M, n)``, ``P (T, M, n, n)``, ``mu
(T, M)``, ``transition (T or 1, M, M)`` with ``transition[t, i, j] = Pr(j at k | i at k-1)``, ``F,
Q (M, n, n)``, ``B (M, n)``. A scan without a measurement for a target is mix and predict alone,
with ``mu <- c``: the chain moves on, the transition matrix does not learn.

Models whose states differ in meaning or size share one state (`motion.Joint`), and the output maps
``E (M, q, n)`` bring every model to the same outputs, e.g. position and velocity.

This is the form to read, for any measurement. `bank` does the same for position fixes with the
model as the last axis, for many targets at once; the tests compare the two.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .arrays import BoolArray, FloatArray
from .covariance import (
    add_jitter,
    correct,
    is_psd,
    propagate,
    semidefinite_roots,
    symmetrise,
    with_jitter,
)
from .kalman import log_density

DEAD = 1e-200
"""A model that can be reached with no more than this probability counts as unreachable."""

MIN_GATE_PROBABILITY = 1e-6
"""A model less probable than this opens no gate."""


class Mixed(NamedTuple):
    """x (T, M, n) and P (T, M, n, n) mixed for each model, and its predicted probability c (T,
    M)."""

    x: FloatArray
    P: FloatArray
    c: FloatArray


class Predicted(NamedTuple):
    """x (T, M, n), P (T, M, n, n); repaired (T, M) where P was, see `covariance`."""

    x: FloatArray
    P: FloatArray
    repaired: BoolArray


class Updated(NamedTuple):
    """x (T, M, n), P (T, M, n, n), mu (T, M); log_likelihood (T,) of the measurement; nis (T,) of
    the mixture's moment-matched innovation; ok (T,) False where no model could be updated and the
    prediction was kept; repaired (T, M) where P was, see `covariance`."""

    x: FloatArray
    P: FloatArray
    mu: FloatArray
    log_likelihood: FloatArray
    nis: FloatArray
    ok: BoolArray
    repaired: BoolArray


def mix(x: FloatArray, P: FloatArray, mu: FloatArray, transition: FloatArray) -> Mixed:
    """c_j = sum_i P_ij mu_i; x0_j = sum_i W_ij x_i; P0_j = sum_i W_ij [P_i +
    (x_i - x0_j)(.)^T], W_ij = P_ij mu_i / c_j.

    A model that nothing can become (c_j = 0) is given the mixture of all, so that it stays finite
    and can come back when the chain allows.

    >>> import numpy as np
    >>> x, P = np.array([[[0.0], [10.0]]]), np.ones((1, 2, 1, 1))  # one target, two models
    >>> mixed = mix(x, P, np.array([[0.5, 0.5]]), np.array([[0.9, 0.1], [0.2, 0.8]]))
    >>> mixed.c.round(3).tolist(), mixed.x.round(3).tolist()
    ([[0.55, 0.45]], [[[1.818], [8.889]]])
    """
    joint = transition * mu[:, :, None]
    c = joint.sum(axis=1)
    dead = c <= DEAD
    W = np.where(dead[:, None, :], mu[:, :, None], joint / np.where(dead, 1.0, c)[:, None, :])
    x0 = np.einsum('tij,tia->tja', W, x)
    spread = x[:, :, None, :] - x0[:, None, :, :]
    P0 = np.einsum('tij,tiab->tjab', W, P) + np.einsum('tij,tija,tijb->tjab', W, spread, spread)
    return Mixed(x0, P0, c)


def predict(
    x: FloatArray,
    P: FloatArray,
    F: FloatArray,
    Q: FloatArray,
    B: FloatArray | float = 0.0,
) -> Predicted:
    """x <- F x + B, P <- F P F^T + Q for each model."""
    return Predicted(np.einsum('jab,tjb->tja', F, x) + B, *propagate(F, P, Q))


def update(
    x: FloatArray,
    P: FloatArray,
    c: FloatArray,
    innovation: FloatArray,
    H: FloatArray,
    R: FloatArray,
) -> Updated:
    """Kalman update of each model in Joseph form, and mu_j proportional to c_j N(nu_j; 0, S_j) in
    the log domain.

    innovation (T, M, m); H (T or 1, M, m, n), the Jacobian at each model's own prediction for a
    nonlinear measurement; R (T or 1, m, m). A model whose S is not finite, or has a component
    without any variance, keeps its prediction and gets no weight.
    """
    after = correct(P, np.broadcast_to(H, (len(x), *H.shape[1:])), R[:, None])
    log_likelihood = log_density(innovation, after.factor)[1]
    log_weight = np.log(np.where(c > 0.0, c, 1.0)) + log_likelihood
    log_weight = np.where((c > 0.0) & after.usable & np.isfinite(log_weight), log_weight, -np.inf)
    best = log_weight.max(axis=1)
    ok = np.isfinite(best)
    weight = np.exp(log_weight - np.where(ok, best, 0.0)[:, None])
    total = weight.sum(axis=1)
    mu = np.where(ok[:, None], weight / np.where(ok, total, 1.0)[:, None], c)
    x_new = x + np.einsum('tjam,tjm->tja', after.gain, innovation)
    nis = _mixture_nis(c, innovation, after.S)
    return Updated(
        np.where(ok[:, None, None], x_new, x),
        np.where(ok[:, None, None, None], after.P, P),
        mu,
        np.where(ok, best + np.log(np.where(ok, total, 1.0)), -np.inf),
        np.where(ok, nis, np.nan),
        ok,
        after.repaired,
    )


def combine(
    x: FloatArray, P: FloatArray, mu: FloatArray, E: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """The mixture's mean (T, q) and covariance (T, q, q) of the outputs E x; E (M, q, n)."""
    y = np.einsum('jqa,tja->tjq', E, x)
    mean = np.einsum('tj,tjq->tq', mu, y)
    spread = y - mean[:, None, :]
    covariance = np.einsum('tj,tjqr->tqr', mu, E @ P @ np.swapaxes(E, -1, -2)) + np.einsum(
        'tj,tjq,tjr->tqr', mu, spread, spread
    )
    return mean, 0.5 * (covariance + np.swapaxes(covariance, -1, -2))


def gate(
    h: FloatArray,
    H: FloatArray,
    P: FloatArray,
    c: FloatArray,
    z: FloatArray,
    R: FloatArray,
    threshold: float,
) -> FloatArray:
    """How well each detection (D, m) with covariance R (D, m, m) fits each
    target: (T, D) log-likelihoods ln sum_j c_j N(nu_j; 0, S_j), -inf outside the gate.

    h (T, M, m): what each model expects; H (T or 1, M, m, n) its Jacobian; P (T, M, n, n) and
    c (T, M) predicted. A detection is inside when it is inside the gate of *some* model that is
    not impossible: the moment-matched gate of the mixture is too small for a sharp turn seen by a
    sensor that is accurate in one direction, and loses the track there.
    """
    fit = np.full((len(h), len(z)), -np.inf)
    if not fit.size:
        return fit
    possible = c >= MIN_GATE_PROBABILITY
    S = H @ P @ np.swapaxes(H, -1, -2)
    t, d = _near(h, S, possible, z, R, threshold)
    total = np.moveaxis(S[t] + R[d, None], (-2, -1), (0, 1))  # (m, m, pairs, M)
    shape = total.shape[2:]
    total, _ = with_jitter(total.reshape(*total.shape[:2], -1))
    v = np.moveaxis(z[d, None] - h[t], -1, 0).reshape(h.shape[-1], -1)
    log, nis = (part.reshape(shape) for part in _log_density(v, total))
    inside = ((nis <= threshold) & possible[t]).any(axis=-1)
    density = (np.where(possible, c, 0.0)[t] * np.exp(log)).sum(axis=-1)
    with np.errstate(divide='ignore'):
        fit[t[inside], d[inside]] = np.log(density[inside])
    return fit


def _near(
    h: FloatArray,
    S: FloatArray,
    possible: BoolArray,
    z: FloatArray,
    R: FloatArray,
    threshold: float,
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Targets and detections (pairs,) that lie in the box that the gates of all models reach: a
    detection is far from most targets. S (T, M, m, m): without the errors of detections."""
    widest = np.diagonal(R, axis1=-2, axis2=-1).max(axis=0)
    reach = np.sqrt(threshold * np.maximum(np.diagonal(S, axis1=-2, axis2=-1) + widest, 0.0))
    low = np.where(possible[..., None], h - reach, np.inf).min(axis=1)
    high = np.where(possible[..., None], h + reach, -np.inf).max(axis=1)
    inside = (z[None] >= low[:, None]) & (z[None] <= high[:, None])
    t, d = np.nonzero(inside.all(axis=-1))
    return t, d


def _log_density(v: FloatArray, S: FloatArray) -> tuple[FloatArray, FloatArray]:
    """ln N(v; 0, S) and the normalised squares (L,) of v (m, L) under S (m, m, L); -inf and
    infinity where S is singular."""
    root = semidefinite_roots(S)
    white = np.zeros_like(v)
    singular = np.zeros(v.shape[1], np.bool_)
    log = np.full(v.shape[1], -0.5 * len(v) * np.log(2.0 * np.pi))
    for a in range(len(v)):
        pivot = root[a, a]
        singular |= ~(pivot > 0.0)
        safe = np.where(pivot > 0.0, pivot, 1.0)
        white[a] = (v[a] - (root[a, :a] * white[:a]).sum(axis=0)) / safe
        log -= np.log(safe)
    nis = np.where(singular, np.inf, (white * white).sum(axis=0))
    return np.where(singular, -np.inf, log - 0.5 * nis), nis


def pairs_inside(fit: FloatArray) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Target and detection (pairs,) of the finite entries of a table from `gate`, in order."""
    # Flat indices: for a million entries several times faster than two-dimensional ones.
    target, detection = np.divmod(np.flatnonzero(fit > -np.inf), max(fit.shape[1], 1))
    return target, detection


def _mixture_nis(c: FloatArray, innovation: FloatArray, S: FloatArray) -> FloatArray:
    mean = np.einsum('tj,tjm->tm', c, innovation)
    spread = innovation - mean[:, None, :]
    total = np.einsum('tj,tjmk->tmk', c, S) + np.einsum('tj,tjm,tjk->tmk', c, spread, spread)
    total, _ = add_jitter(symmetrise(total))
    total = np.where(is_psd(total)[:, None, None], total, np.nan)
    return np.asarray(np.einsum('tm,tm->t', mean, np.linalg.solve(total, mean[..., None])[..., 0]))
