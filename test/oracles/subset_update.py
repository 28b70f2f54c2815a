# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Measurements some of which may be wild: the update over all inlier/outlier subsets.

A late echo is not a large error of a good measurement, it is another measurement. With a few
numbers y_1 .. y_R at once, each good with probability 1 - eps and else spread with a flat density
u, there are 2^R explanations, and all of them can be computed: a Gaussian each, weighted by its
evidence, one Gaussian of the same mean and covariance at the end. A sequential gate picks one of
these explanations, and which one depends on the order of the numbers.

Explanations are grown number by number (`Explanation`), and those that fall `PRUNE` below the best
are dropped. A number that is rejected costs ``eps u`` in every explanation: without that charge
the explanation that rejects everything wins.

This is the mathematics as it reads; `trackers.diver.explanations` is the same, for all
hypotheses about a diver at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
import math

from attrs import frozen
import numpy as np

from sonar_imm.estimation.arrays import BoolArray, FloatArray
from sonar_imm.estimation.consider import consider_update

PRUNE = 14.0
"""An explanation whose log-probability is this much below the best one's is dropped."""

Observation = tuple[Callable[[FloatArray], tuple[float, FloatArray]], float, float]
"""A number: what gives h(x) and its gradient (n,) at a state, the value, its variance."""


@frozen(eq=False)
class Explanation:
    """Which numbers (R,) are good, the state given that, and the log of its joint probability."""

    good: tuple[bool, ...]
    x: FloatArray
    P: FloatArray
    log_weight: float


@frozen(eq=False)
class SubsetUpdate:
    """The explanations left, best known by `probability` (B,); x (n,) and P (n, n) of all of them
    together; log_evidence of all the numbers; good (R,): probability that each is no outlier."""

    explanations: Sequence[Explanation]
    probability: FloatArray
    x: FloatArray
    P: FloatArray
    log_evidence: float
    good: FloatArray


def subset_update(
    x: FloatArray,
    P: FloatArray,
    observations: Sequence[Observation],
    *,
    outlier_probability: float,
    outlier_density: float,
    estimated: BoolArray | None = None,
    prune: float = PRUNE,
) -> SubsetUpdate:
    """Update x (n,), P (n, n) with numbers each of which may be wild.

    A number is linearised where the explanation so far stands. outlier_density is per unit of the
    numbers; estimated (n,): see `consider.consider_update`, None for all.
    """
    mask = np.ones(len(x), bool) if estimated is None else estimated
    log_bad = _log(outlier_probability) + math.log(outlier_density)
    log_good = math.log1p(-outlier_probability)
    left = [Explanation((), np.array(x, np.float64), np.array(P, np.float64), 0.0)]
    for measure, value, variance in observations:
        grown = []
        for old in left:
            expected, gradient = measure(old.x)
            S = float(gradient @ old.P @ gradient) + variance
            innovation = value - expected
            fit = -0.5 * (innovation**2 / S + math.log(2.0 * math.pi * S))
            row, noise = gradient[None], np.array([[variance]])
            x_b, P_b = consider_update(old.x, old.P, row, noise, np.array([innovation]), mask)
            grown.append(Explanation((*old.good, False), old.x, old.P, old.log_weight + log_bad))
            grown.append(Explanation((*old.good, True), x_b, P_b, old.log_weight + log_good + fit))
        best = max(new.log_weight for new in grown)
        left = [new for new in grown if new.log_weight >= best - prune]
    return _together(left, len(observations))


def _together(left: Sequence[Explanation], count: int) -> SubsetUpdate:
    weight = np.array([each.log_weight for each in left])
    best = float(weight.max())
    share = np.exp(weight - best)
    probability = share / share.sum()
    states = np.stack([each.x for each in left])
    x = probability @ states
    spread = states - x
    P = np.einsum('b,bij->ij', probability, np.stack([each.P for each in left]))
    P = P + np.einsum('b,bi,bj->ij', probability, spread, spread)
    good = np.array([each.good for each in left], np.float64).reshape(len(left), count)
    return SubsetUpdate(
        left, probability, x, P, best + math.log(float(share.sum())), probability @ good
    )


def _log(value: float) -> float:
    return math.log(value) if value > 0.0 else -math.inf
