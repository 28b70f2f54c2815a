# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Joint integrated probabilistic data association with the IMM filter (Musicki and Evans 2004).

With crossing targets and clutter, a single assignment loses track identities. Instead, every joint
event, in which each track has at most one detection and each detection belongs to at most one
track, has the weight

    Pr(event) ~ prod_assigned r_t P_D f_ti / lambda * prod_missed (1 - r_t P_D),

with r_t the existence probability of track t, ``f_ti = sum_j c_j N(z_i; h_j, S_j)`` the likelihood
of detection i in the model mixture of the track, and lambda the density of false detections and
new targets. The sums over the events are

    beta_ti         the target exists and caused detection i,
    missed_t        it exists and was not detected: Pr(no detection) r (1 - P_D) / (1 - r P_D),
    r_t             the new probability of existence: beta summed, plus missed.

`associate` computes these sums exactly, without enumerating events (`marginals`). Within a track,
model j shares detection i in proportion to N_ji (`bank.update`), ``beta_i|j ~ beta_i N_ji / f_i``
and ``mu_j ~ c_j (beta_0 + sum_i beta_i N_ji / f_i)``, moment-matched in each model.
"""

from __future__ import annotations

import numpy as np

from .arrays import BoolArray, FloatArray, IntArray
from .marginals import marginals


def associate(
    ratio: FloatArray,
    possible: BoolArray,
    existence: FloatArray,
    detection_probability: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return beta (T, D), missed (T,) and the new existence (T,) of the joint events.

    :param ratio: (T, D) f / lambda.
    :param possible: (T, D) False for pairs outside the gate.
    :param existence: (T,) before the scan.
    :param detection_probability: (T,) of an existing target.
    """
    detected = existence * detection_probability
    beta, none = marginals(detected[:, None] * ratio, 1.0 - detected, possible)
    missed = none * existence * (1.0 - detection_probability) / (1.0 - detected)
    # Rounding errors can give slightly more than 1.
    return beta, missed, np.minimum(missed + beta.sum(axis=1), 1.0)


def associate_classes(
    ratio: FloatArray,
    possible: BoolArray,
    existence: FloatArray,
    detection_probability: FloatArray,
    visible: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return beta (T, D), none (T,) = Pr(no detection is the track's, whether it exists or not),
    and the new existence (T, C) by class of detectability.

    :param ratio: (T, D) f / lambda, f with the probability of each model to be visible.
    :param possible: (T, D) False for pairs outside the gate.
    :param existence: (T, C) probability that the target exists and is of each class.
    :param detection_probability: (T, C) of a visible target of each class.
    :param visible: (T, 1) or (T, C) probability that the target is visible.
    """
    seen = existence * detection_probability
    detected, missed = seen.sum(axis=1), 1.0 - (seen * visible).sum(axis=1)
    beta, none = marginals(detected[:, None] * ratio, missed, possible)
    silent = existence * (1.0 - detection_probability * visible)
    after = (none / missed)[:, None] * silent
    share = seen / np.where(detected > 0.0, detected, 1.0)[:, None]
    return beta, none, after + beta.sum(axis=1)[:, None] * share


def nearest_older(
    mean: FloatArray, covariance: FloatArray, ids: IntArray, free: BoolArray, firm: BoolArray
) -> tuple[IntArray, FloatArray]:
    """Return the nearest older track of each track (T,), -1 for none, and the squared Mahalanobis
    distance.

    :param mean: (T, 2).
    :param covariance: (T, 2, 2).
    :param ids: (T,) rising with age.
    :param free: (T,) True for tracks that are compared.
    :param firm: (T,) True for tracks that are compared with firm tracks only.
    """
    if not len(ids):
        return np.empty(0, np.int64), np.empty(0)
    compared = free[:, None] & free & (ids < ids[:, None]) & (firm | ~firm[:, None])
    x, y = np.moveaxis(mean[:, None] - mean, -1, 0)
    a, b, d = (
        (covariance[:, r, c])[:, None] + covariance[:, r, c] for r, c in ((0, 0), (0, 1), (1, 1))
    )
    # By the Cholesky factor, written out.
    y = y - b / a * x
    squared = np.where(compared, x * x / a + y * y / (d - b / a * b), np.inf)
    squared = np.where(np.isnan(squared), np.inf, squared)
    partner, least = squared.argmin(axis=1), squared.min(axis=1)
    return np.where(np.isfinite(least), partner, -1), least


def log_odds(existence: FloatArray) -> FloatArray:
    """Return ln r / (1 - r) of probabilities (T,), minus infinity at 0."""
    with np.errstate(divide='ignore'):
        return np.asarray(np.log(existence) - np.log(np.maximum(1.0 - existence, 1e-300)))
