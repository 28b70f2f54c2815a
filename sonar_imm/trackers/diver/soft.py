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

"""Soft association of a scan of fixes: every pairing is weighed (`estimation.jipda`).

What the hits and misses of `estimation.association.Tracks` are to a hard choice, the probability
of existence is here: it says when a track is confirmed, published and ended.
"""

from __future__ import annotations

from typing import NamedTuple, TYPE_CHECKING

import numpy as np

from ...estimation import imm_kernels, jipda
from ...estimation.arrays import BoolArray, FloatArray, IntArray
from ...estimation.association import COASTING, CONFIRMED, gate_threshold, TENTATIVE
from ...measurements import NOBODY
from .config import DiverConfig
from .sensing import Positions

if TYPE_CHECKING:
    from .scan import Scan
    from .state import DiverState

CONFIRMS = 0.9
"""Existence above which a track may be confirmed."""

EVIDENCE = 2.5
"""Sum of the probabilities of its detections that a confirmed track has seen."""

PUBLISHES = 0.5
"""Existence above which a track is published."""

ENDS = 0.002
"""Existence below which a track ends."""

NEAR_TENTATIVE, SCANS_TENTATIVE = 4.0, 2
"""A tentative track ends when it is nearer than this (Mahalanobis distance squared) to an older
one in so many scans in a row."""

NEAR_CONFIRMED, SCANS_CONFIRMED = 0.3, 8
"""The same of a confirmed track and an older confirmed one: two tracks on one diver."""


def take_softly(scan: Scan, group: Positions) -> FloatArray:
    """Update the tracks of `scan` by all fixes they may have caused; gives the probability (D,)
    that a fix is of a diver that is tracked already."""
    config = scan.config
    z, R = np.ascontiguousarray(group.z), np.ascontiguousarray(group.R)
    H, h = scan.expected_fixes()
    threshold = gate_threshold(config.gate_probability, 2)
    mixture, nis = jipda.likelihoods(h, H, scan.P, scan.mu, z, R, threshold)
    nis[scan.named] = np.inf
    seen = ~scan.named & (group.whole | (nis <= threshold).any(axis=1))
    existence = known_existence(scan.existence, scan.before.life.status)
    beta, missed, after = jipda.associate(
        mixture / (config.clutter_density + config.birth_density),
        nis,
        existence,
        np.where(seen, config.detection_probability, 0.0),
        threshold,
    )
    detected = beta.sum(axis=1)
    hit = np.flatnonzero(detected > 0.5 * after)
    if len(hit):
        best = beta[hit].argmax(axis=1)
        scan.watch(group, hit, best, H)
        scan.nis[hit] += np.square(scan.white[hit]).sum(axis=1)
        scan.nis_dof[hit] += np.uint16(2)
    scan.x, scan.P, scan.mu, repairs = jipda.update(
        scan.x, scan.P, scan.mu, h, H, z, R, beta, missed, ~scan.layout.mask
    )
    scan.repairs += repairs
    scan.existence = np.where(scan.named, scan.existence, after)
    scan.evidence = scan.evidence + detected
    scan.score = np.where(scan.named, scan.score, jipda.log_odds(after))
    return np.asarray(beta.sum(axis=0))


def known_existence(existence: FloatArray, status: IntArray) -> FloatArray:
    """Existence (T,), where it is not known (a track that began otherwise) by the status."""
    guess = np.where(status == TENTATIVE, 0.5, CONFIRMS)
    return np.where(np.isnan(existence), guess, existence)


def birth_existence(config: DiverConfig, claimed: FloatArray) -> FloatArray:
    """Existence (D,) of tracks that begin at fixes which belong, with the probability `claimed`
    (D,), to others."""
    new = config.birth_density / (config.birth_density + config.clutter_density)
    return np.asarray(new * (1.0 - claimed))


def published(existence: FloatArray) -> BoolArray:
    """Which tracks (T,) are published: those that probably exist, or are counted by hits."""
    return np.asarray(~(existence <= PUBLISHES))


class Judged(NamedTuple):
    """What becomes of tracks (T,) that live by their existence: status; alive; near_to and
    near_for as in `DiverState`."""

    status: IntArray
    alive: BoolArray
    near_to: IntArray
    near_for: IntArray


def judge(now: DiverState, hit: BoolArray, looked: BoolArray, E: FloatArray) -> Judged:
    """Judge tracks by their existence and by how near they are to older ones.

    hit (T,): a detection is more probable than a miss; looked (T,): whether one would have been
    seen; E (M, 2, n): to the position.
    """
    was = now.life.status != TENTATIVE
    confirmed = was | (now.existence > CONFIRMS) & (now.evidence >= EVIDENCE)
    alive = ~(now.existence < ENDS)
    seen = np.where(looked, COASTING, now.life.status)
    seen = np.where(hit | (seen == TENTATIVE), CONFIRMED, seen)
    status = np.where(confirmed, seen, TENTATIVE).astype(np.uint8)
    if not looked.any():
        return Judged(status, alive, now.near_to, now.near_for)
    n = E.shape[-1]
    x, P = np.ascontiguousarray(now.x[..., :n]), np.ascontiguousarray(now.P[..., :n, :n])
    mean, covariance = imm_kernels.combine(x, P, now.mu, np.ascontiguousarray(E))
    near_to, near_for = coalescence(now, was, mean, covariance)
    patience = np.where(was, SCANS_CONFIRMED, SCANS_TENTATIVE)
    return Judged(status, alive & (near_for < patience), near_to, near_for)


def coalescence(
    now: DiverState, confirmed: BoolArray, mean: FloatArray, covariance: FloatArray
) -> tuple[IntArray, IntArray]:
    """The older track that each one is near (T,), 0 for none, and for how many scans (T,).

    mean (T, 2) and covariance (T, 2, 2) of the positions. Named tracks take no part.
    """
    ids, free = now.life.track_id.astype(np.int64), now.target_id == NOBODY
    partner, distance = jipda.nearest_older(mean, covariance, ids, free, confirmed)
    near = distance < np.where(confirmed, NEAR_CONFIRMED, NEAR_TENTATIVE)
    near_to = np.where(near, ids[partner], 0)
    near_for = np.where(near, np.where(near_to == now.near_to, now.near_for, 0) + 1, 0)
    return near_to, near_for
