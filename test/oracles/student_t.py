# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Many measurements with heavy tails: the most probable state with Student-t errors.

With more than a handful of numbers there are too many inlier/outlier subsets (`subset_update`),
and enough numbers to outvote the wild ones. Each residual r (in standard deviations) then has the
Student-t density with `DEGREES` degrees of freedom, whose tails are flat: the most probable state
maximises ``-1/2 (x-m)' P^-1 (x-m) - (nu+1)/2 sum log(1 + r_i^2/nu)``. Iteratively reweighted: a
number counts with the weight ``(nu+1)/(nu+r^2)``, that is, with its variance over the weight in a
Kalman update linearised at the last iterate, and a step that does not climb is halved.

The maximum is not the only one. Whoever calls gives the starts, among them those the numbers alone
suggest, so that many good numbers outvote any prior.

The information of the weighted update overstates what is known: residuals near the middle are
weighted by more than one. `trackers.diver.heavy_tails` therefore widens the variances by
``(nu+3)/(nu+1)``, the ratio of the curvature of the Gaussian to the Fisher information of the t
density, for the covariance, not for the mean.

Source: K. L. Lange, R. J. A. Little, J. M. G. Taylor, "Robust statistical modeling using the t
distribution", JASA 84, 1989.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import NamedTuple

import numpy as np

from oracles.subset_update import Observation
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.estimation.consider import consider_update

DEGREES = 4.0
MOST_ITERATIONS = 60
SMALLEST_STEP = 1e-9
"""Gain in log-density that ends the search."""


class Maximum(NamedTuple):
    """x (n,), the log-density there (with no constants of the prior), the weights (R,), P (n, n)
    after the weighted update and log_evidence (Laplace)."""

    x: FloatArray
    log_density: float
    weights: FloatArray
    P: FloatArray
    log_evidence: float


def student_t_maximum(
    mean: FloatArray,
    P: FloatArray,
    observations: Sequence[Observation],
    starts: Sequence[FloatArray],
    degrees: float = DEGREES,
) -> Maximum:
    """The best maximum reached from `starts` (n,) each, for a prior `mean` (n,),
    P (n, n)."""
    best: tuple[float, FloatArray] | None = None
    for start in starts:
        x = np.array(start, np.float64)
        value = _log_density(x, mean, P, observations, degrees)
        for _ in range(MOST_ITERATIONS):
            step = _update(x, mean, P, observations, degrees, 1.0)[0] - x
            length, trial = 1.0, -math.inf
            while length > 1e-3:
                trial = _log_density(x + length * step, mean, P, observations, degrees)
                if trial >= value:
                    break
                length *= 0.5
            gain = trial - value
            if gain > 0.0:
                x, value = x + length * step, trial
            if not gain > SMALLEST_STEP:
                break
        if best is None or value > best[0]:
            best = (value, x)
    assert best is not None
    value, x = best
    _, covariance, weights = _update(x, mean, P, observations, degrees, 1.0)
    evidence = value + 0.5 * (np.linalg.slogdet(covariance)[1] - np.linalg.slogdet(P)[1])
    return Maximum(x, value, weights, covariance, float(evidence))


def student_t_constant(variance: float, degrees: float = DEGREES) -> float:
    """Log of the height of the t density at zero, for a scale of sqrt(`variance`)."""
    half = 0.5 * (degrees + 1.0)
    return (
        math.lgamma(half)
        - math.lgamma(0.5 * degrees)
        - 0.5 * math.log(degrees * math.pi * variance)
    )


def _log_density(
    x: FloatArray,
    mean: FloatArray,
    P: FloatArray,
    observations: Sequence[Observation],
    degrees: float,
) -> float:
    gap = x - mean
    total = -0.5 * float(gap @ np.linalg.solve(P, gap))
    for measure, value, variance in observations:
        r2 = (value - measure(x)[0]) ** 2 / variance
        total += student_t_constant(variance, degrees)
        total -= 0.5 * (degrees + 1.0) * math.log1p(r2 / degrees)
    return total


def _update(
    x: FloatArray,
    mean: FloatArray,
    P: FloatArray,
    observations: Sequence[Observation],
    degrees: float,
    widen: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The weighted Kalman update of the prior, linearised at x: mean, covariance and weights."""
    H, innovation, R, weights = [], [], [], []
    for measure, value, variance in observations:
        expected, gradient = measure(x)
        residual = value - expected
        weight = (degrees + 1.0) / (degrees + residual**2 / variance)
        H.append(gradient)
        innovation.append(residual - gradient @ (mean - x))
        R.append(widen * variance / weight)
        weights.append(weight)
    every = np.ones(len(mean), bool)
    state, covariance = consider_update(
        mean, P, np.array(H), np.diag(R), np.array(innovation), every
    )
    return state, covariance, np.array(weights)
