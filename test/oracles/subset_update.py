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
"""

import math
from typing import NamedTuple

import numpy as np

from sonar_imm.estimation.consider import consider_update


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
