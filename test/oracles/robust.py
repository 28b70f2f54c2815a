# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Numbers each of which may be wild: every inlier/outlier subset with its probability.

A number that is rejected costs ``eps u`` in every explanation: without that charge the explanation
that rejects everything wins. `trackers.diver.explanations` is the same, for all hypotheses about a
diver at once.

Many measurements with heavy tails: the most probable state with Student-t errors.

Each residual r (in standard deviations) has the Student-t density, whose tails are flat: the most
probable state maximises ``-1/2 (x-m)' P^-1 (x-m) - (nu+1)/2 sum log(1 + r_i^2/nu)``. Iteratively
reweighted: a number counts with the weight ``(nu+1)/(nu+r^2)``, that is, with its variance over
the weight in a Kalman update linearised at the last iterate; a step that does not climb is halved.
The maximum is not the only one: whoever calls gives the starts. `trackers.diver.heavy_tails`
widens the variances for the covariance, not for the mean.

Source: K. L. Lange, R. J. A. Little, J. M. G. Taylor, "Robust statistical modeling using the t
distribution", JASA 84, 1989.
"""

import math
from typing import NamedTuple

import numpy as np

from sonar_imm.estimation.consider import consider_update

DEGREES = 4.0
MOST_ITERATIONS = 60
SMALLEST_STEP = 1e-9
"""Gain in log-density that ends the search."""


class Maximum(NamedTuple):
    """x (n,), the weights (R,), P (n, n) after the weighted update and log_evidence (Laplace)."""

    x: np.ndarray
    weights: np.ndarray
    P: np.ndarray
    log_evidence: float


def student_t_maximum(mean, P, observations, starts):
    """The best maximum reached from `starts` (n,) each, for a prior `mean` (n,), P (n, n); numbers
    as in `subset_update`."""
    best = (-math.inf, mean)
    for x in starts:
        value = log_density(x, mean, P, observations)
        for _ in range(MOST_ITERATIONS):
            step = weighted_update(x, mean, P, observations)[0] - x
            length, trial = 1.0, -math.inf
            while length > 1e-3:
                trial = log_density(x + length * step, mean, P, observations)
                if trial >= value:
                    break
                length *= 0.5
            gain = trial - value
            if gain > 0.0:
                x, value = x + length * step, trial
            if not gain > SMALLEST_STEP:
                break
        best = max(best, (value, x), key=lambda each: each[0])
    value, x = best
    _, covariance, weights = weighted_update(x, mean, P, observations)
    evidence = value + 0.5 * (np.linalg.slogdet(covariance)[1] - np.linalg.slogdet(P)[1])
    return Maximum(x, weights, covariance, float(evidence))


def student_t_constant(variance):
    """Log of the height of the t density at zero, for a scale of sqrt(`variance`)."""
    half = 0.5 * (DEGREES + 1.0)
    height = math.lgamma(half) - math.lgamma(0.5 * DEGREES)
    return height - 0.5 * math.log(DEGREES * math.pi * variance)


def log_density(x, mean, P, observations):
    """With no constants of the prior."""
    gap = x - mean
    total = -0.5 * float(gap @ np.linalg.solve(P, gap))
    for measure, value, variance in observations:
        r2 = (value - measure(x)[0]) ** 2 / variance
        total += student_t_constant(variance)
        total -= 0.5 * (DEGREES + 1.0) * math.log1p(r2 / DEGREES)
    return total


def weighted_update(x, mean, P, observations):
    """The weighted Kalman update of the prior, linearised at x: mean, covariance and weights."""
    rows = []
    for measure, value, variance in observations:
        expected, gradient = measure(x)
        residual = value - expected
        weight = (DEGREES + 1.0) / (DEGREES + residual**2 / variance)
        rows.append((gradient, residual - gradient @ (mean - x), variance / weight, weight))
    H, innovation, R, weights = (np.array(part) for part in zip(*rows))
    every = np.ones(len(mean), bool)
    return *consider_update(mean, P, H, np.diag(R), innovation, every), weights


class SubsetUpdate(NamedTuple):
    """Subsets (B, R) of good numbers, their probability (B,); x (n,) and P (n, n) of all of them
    together; log_evidence of all the numbers; good (R,): probability that each is no outlier."""

    subsets: np.ndarray
    probability: np.ndarray
    x: np.ndarray
    P: np.ndarray
    log_evidence: float
    good: np.ndarray


def subset_update(x, P, numbers, outlier_probability, outlier_density, estimated=None, prune=14.0):
    """Update x (n,), P (n, n) with numbers: h(x) and its gradient, the value, its variance.

    A number is linearised where the explanation so far stands. outlier_density is per unit of the
    numbers; estimated (n,): see `consider.consider_update`, None for all. Subsets whose log
    probability is `prune` below the best one's are dropped.
    """
    mask = np.ones(len(x), bool) if estimated is None else estimated
    log_bad = math.log(outlier_probability) + math.log(outlier_density)
    log_good = math.log1p(-outlier_probability)
    left = [((), x, P, 0.0)]
    for measure, value, variance in numbers:
        grown = []
        for good, x, P, log in left:
            expected, gradient = measure(x)
            S = float(gradient @ P @ gradient) + variance
            innovation = value - expected
            fit = -0.5 * (innovation**2 / S + math.log(2.0 * math.pi * S))
            row, noise = gradient[None], np.array([[variance]])
            after = consider_update(x, P, row, noise, np.array([innovation]), mask)
            grown.append(((*good, False), x, P, log + log_bad))
            grown.append(((*good, True), *after, log + log_good + fit))
        best = max(log for *_, log in grown)
        left = [each for each in grown if each[3] >= best - prune]
    subsets, states, covariances, log = (np.array(part) for part in zip(*left))
    share = np.exp(log - log.max())
    probability = share / share.sum()
    x = probability @ states
    P = np.einsum('b,bij->ij', probability, covariances)
    P += np.einsum('b,bi,bj->ij', probability, states - x, states - x)
    evidence = log.max() + math.log(share.sum())
    return SubsetUpdate(subsets, probability, x, P, evidence, probability @ subsets)
