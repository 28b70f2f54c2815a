# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Systematic errors in a Kalman filter: constants that are considered, and the update that leaves
them alone.

An error such as a receiver that stands a metre off, or a clock that is half a millisecond late, is
the same in every measurement. It does not average out, and a larger measurement variance does not
model it. It belongs into the state as a constant b. Where the measurements determine b it is
*estimated* like any state. Where they hardly can, or where its stated variance is a guess, it is
*considered* (Schmidt, 1966): b keeps its mean and its variance for ever, and only its covariance
with the rest of the state is kept up, so that the covariance of the rest is right. The gain
is the Kalman gain with the rows of b set to zero.

A considered b has the same mean and covariance in all models, targets and times. So models mix it
with no effect (`imm.mix` needs nothing new), and targets share it without counting data twice.

Source: S. F. Schmidt, "Application of state-space methods to navigation problems", Advances in
Control Systems 3, 1966; A. H. Jazwinski, *Stochastic Processes and Filtering Theory*, 1970,
sec. 8.3.
"""

from __future__ import annotations

import numpy as np

from .arrays import BoolArray, FloatArray
from .covariance import JITTER, LIMIT


def consider_update(
    x: FloatArray,
    P: FloatArray,
    H: FloatArray,
    R: FloatArray,
    innovation: FloatArray,
    estimated: BoolArray,
) -> tuple[FloatArray, FloatArray]:
    """The Schmidt-Kalman update of x (n,), P (n, n) with H (m, n), R (m, m), innovation (m,).

    estimated (n,): False where a component is only considered. S holds the considered errors, and
    ``P <- P - K H P - (K H P)' + K S K'`` is the covariance for any gain K; it is symmetrised,
    since the antisymmetric part of rounding grows tenfold in twenty steps. Gives x and P.
    """
    PHt = P @ H.T
    S = H @ PHt + R
    K = np.linalg.solve(S, PHt.T).T * np.asarray(estimated, np.float64)[:, None]
    KHP = K @ PHt.T
    updated = P - KHP - KHP.T + K @ S @ K.T
    return x + K @ innovation, 0.5 * (updated + updated.T)


def innovation_variances(
    P: FloatArray, H: FloatArray, R: FloatArray | float
) -> tuple[FloatArray, FloatArray]:
    """Return ``P h'`` (C, n, L) and ``S = h P h' + R`` (C, L) of C numbers in L filters.

    S is NaN where it is not positive and finite. The rule of `covariance` for numbers that are too
    good applies.

    :param P: (n, n, L) covariances.
    :param H: (C, n, L) rows of H.
    :param R: (C, L) variances of the numbers.
    """
    cross = np.zeros(H.shape)
    S = np.zeros(H[:, 0].shape) + R
    active = np.flatnonzero(H.any(axis=(0, 2)))
    for a in active:
        cross += H[:, a, None] * P[:, a]
    for a in active:
        S += H[:, a] * cross[:, a]
    if not (R > LIMIT * S).all():
        S = np.where(R > LIMIT * S, S, S + JITTER * S)
    return cross, S if ((S > 0.0) & (S < np.inf)).all() else _positive(S)


def _positive(S: FloatArray) -> FloatArray:
    return np.where((S > 0.0) & (S < np.inf), S, np.nan)


def log_densities(S: FloatArray, innovation: FloatArray) -> FloatArray:
    """Return the log-densities of innovations with variances S."""
    return np.asarray(-0.5 * (innovation * innovation / S + np.log(2.0 * np.pi * S)))


def consider_scalar(
    x: FloatArray,
    P: FloatArray,
    h: FloatArray,
    R: FloatArray | float,
    innovation: FloatArray,
    estimated: BoolArray,
) -> FloatArray:
    """`consider_update` L filters at once in place, by one number each.

    :param x: (n, L) states.
    :param P: (n, n, L) covariances, symmetric.
    :param h: (n, L) the row of H.
    :param R: (L,) the variance of the number, or one for all.
    :param innovation: (L,).
    :param estimated: (n,) False where a component is only considered.
    :returns: the log-densities (L,) of the innovations. These are -inf where the variance of the
        innovation is not positive and finite; x and P stay as they are there.
    """
    crosses, variances = innovation_variances(P, h[None], R)
    cross, S = crosses[0], variances[0]
    fit = log_densities(S, innovation)
    if np.isnan(S).any():
        lost = np.isnan(S)
        cross, S = np.where(lost, 0.0, cross), np.where(lost, 1.0, S)
        innovation, fit = np.where(lost, 0.0, innovation), np.where(lost, -np.inf, fit)
    apply_gain(x, P, cross, S, innovation, estimated)
    return fit


def apply_gain(
    x: FloatArray,
    P: FloatArray,
    cross: FloatArray,
    S: FloatArray,
    innovation: FloatArray,
    estimated: BoolArray,
) -> None:
    """Update x (n, L) and P (n, n, L) in place as `consider_scalar` does, by known cross ``P h'``
    (n, L) and variances S (L,)."""
    root = cross / np.sqrt(S)
    moved = root if estimated.all() else np.where(estimated[:, None], root, 0.0)
    x += moved * (innovation / np.sqrt(S))
    for a in range(len(x)):  # row by row: what one step needs stays at hand
        # K_a (HP)_b and its mirror image, plus K_a S K_b where both have a gain.
        P[a] -= root[a] * (root if estimated[a] else moved)
