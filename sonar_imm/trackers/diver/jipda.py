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

"""Joint integrated probabilistic data association of a group of fixes: every pairing is weighed
(`estimation.jipda`).

What the hits and misses of `estimation.association.Tracks` are to a hard choice, the probability
of existence is here: it says when a track is confirmed, published and ended.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...estimation import jipda as joint_association
from ...estimation.arrays import BoolArray, FloatArray, IndexArray, IntArray
from ...estimation.association import COASTING, CONFIRMED, gate_threshold, TENTATIVE
from ...measurements import NOBODY
from . import families, names
from .clutter import Clutter, replaced
from .coverage import Seen
from .scan import Positions
from .state import DiverState
from .state_space import Layout

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
"""The same of a confirmed track and an older confirmed one: two tracks on one diver. There may be
more scans where two divers are seldom detected both, see `names.patience`."""

LEAST_DETECTED = 1e-9
"""Probability of detection of a track outside of all that the sensor covers: that of a fix is
divided by it."""

StatusArray = NDArray[np.uint8]


class JointWeights(NamedTuple):
    """Which fixes belong to which tracks, by probability: beta (T, D) of each pair; missed (T,)
    that a track has no fix; detected (T,) that it has one; existence (T,) now that this is
    known; excluded (T,): tracks that take no part."""

    beta: FloatArray
    missed: FloatArray
    detected: FloatArray
    existence: FloatArray
    excluded: BoolArray

    def likeliest(self) -> tuple[IndexArray, IntArray]:
        """The tracks (t,) for which a hit is likelier than a miss, and the likeliest fix (t,) of
        each."""
        hit = np.flatnonzero(self.detected > 0.5 * self.existence)
        return hit, self.beta[hit].argmax(axis=1) if len(hit) else hit

    @property
    def missed_share(self) -> FloatArray:
        """(T,) how probable it is that a track has no fix, if its diver exists."""
        return np.minimum(self.missed / np.maximum(self.existence, 1e-300), 1.0)


class Association(NamedTuple):
    """Which fixes of a group are of which tracks: tracks, detection (t,): pairs; expected
    (T, M, 2): the fix that each model expects; score (T,): of the tracks; free (D,): where a track
    may begin; existence (D,): of that track, None where its hits will tell; weights: of all pairs,
    where these and not the pairs update the tracks; densities: of all pairs, of `families`;
    seen: how probable detections are, where the sensor does not see everywhere."""

    tracks: IndexArray
    detection: IntArray
    expected: FloatArray
    score: FloatArray
    free: BoolArray
    existence: FloatArray | None = None
    weights: JointWeights | None = None
    densities: families.Densities | None = None
    seen: Seen | None = None

    @property
    def claimed(self) -> FloatArray:
        """(D,) the probability that each fix is a track's."""
        if self.weights is None:
            return np.asarray(1.0 - self.free)
        return np.asarray(self.weights.beta.sum(axis=0))


def joint_weights(
    now: DiverState,
    fixes: Positions,
    h: FloatArray,
    H: FloatArray,
    excluded: BoolArray,
    densities: families.Densities | None,
    seen: Seen | None = None,
) -> JointWeights:
    """Weigh all pairings of tracks and `fixes`; h (T, M, 2) expected by H (1, M, 2, n); densities:
    of the pairs, where these and no chi-square gate them; seen: how probable detections are, where
    the sensor does not see everywhere."""
    config = fixes.config
    if densities is None:
        threshold = gate_threshold(config.gate_probability, 2)
        mixture, nis = joint_association.likelihoods(
            h, H, now.P, now.mu, fixes.z, fixes.R, threshold
        )
    else:
        mixture = np.exp(densities.whole)
        # What a crowded cluster leaves out first is what is least probable.
        apart = 2.0 * (
            densities.whole.max(axis=1, keepdims=True, initial=-np.inf) - densities.whole
        )
        ratio = 0.0 if seen is None else seen.log_ratio
        nis = np.where(densities.whole + ratio > families.bound(fixes), apart, np.inf)
        threshold = float(nis[np.isfinite(nis)].max(initial=1.0))
    nis[excluded] = np.inf
    looked = ~excluded & (fixes.whole | (nis <= threshold).any(axis=1))
    # Where as many divers are tracked as there may be, a fix is of none that is yet to come.
    full = int((now.life.status != TENTATIVE).sum()) >= config.max_tracks
    ratio = mixture / (fixes.clutter + (0.0 if full else fixes.births))
    detected = np.ones(1) * config.detection_probability
    if seen is not None:
        detected = np.maximum(seen.tracks, LEAST_DETECTED)
        ratio = ratio * seen.fixes[None] / detected[:, None]
    beta, missed, existence = joint_association.associate(
        ratio,
        nis,
        known_existence(now.existence, now.life.status),
        np.where(looked, detected, 0.0),
        threshold,
    )
    return JointWeights(beta, missed, beta.sum(axis=1), existence, excluded)


def update_jointly(
    now: DiverState,
    fixes: Positions,
    weights: JointWeights,
    hit: IndexArray,
    h: FloatArray,
    layout: Layout,
    considered: BoolArray,
    densities: families.Densities | None,
) -> DiverState:
    """Update the tracks by all fixes they may have caused; hit (t,): those whose whitened
    innovation is new; considered (n,): what an update does not move; densities: of the pairs,
    where the models run in copies."""
    nis, nis_dof = now.nis.copy(), now.nis_dof.copy()
    nis[hit] += np.square(now.white[hit]).sum(axis=1)
    nis_dof[hit] += np.uint16(2)
    if densities is None:
        x, P, mu, repairs = joint_association.update(
            now.x,
            now.P,
            now.mu,
            h,
            layout.H,
            fixes.z,
            fixes.R,
            weights.beta,
            weights.missed,
            considered,
        )
    else:
        x, P, mu, repairs = families.update_jointly(
            now, fixes, h, layout, considered, weights.beta, weights.missed, densities
        )
    # The life of a named track hangs on its own fixes.
    named = now.target_id != NOBODY
    return now._replace(
        x=x,
        P=P,
        mu=mu,
        nis=nis,
        nis_dof=nis_dof,
        repairs=now.repairs + repairs,
        existence=np.where(named, now.existence, weights.existence),
        evidence=now.evidence + weights.detected,
        score=np.where(weights.excluded, now.score, joint_association.log_odds(weights.existence)),
    )


def known_existence(existence: FloatArray, status: StatusArray) -> FloatArray:
    """Existence (T,), where it is not known (a track that began otherwise) by the status."""
    guess = np.where(status == TENTATIVE, 0.5, CONFIRMS)
    return np.where(np.isnan(existence), guess, existence)


def birth_existence(fixes: Positions, claimed: FloatArray) -> FloatArray:
    """Existence (D,) of tracks that begin at fixes which belong, with the probability `claimed`
    (D,), to others."""
    return np.asarray(fixes.births / (fixes.births + fixes.clutter) * (1.0 - claimed))


class Judged(NamedTuple):
    """What becomes of tracks (T,) that live by their existence: status; alive; near_to and
    near_for as in `DiverState`."""

    status: StatusArray
    alive: BoolArray
    near_to: IntArray
    near_for: IntArray


def judge(
    now: DiverState,
    hit: BoolArray,
    looked: BoolArray,
    E: FloatArray,
    fixes: Sequence[Positions],
) -> Judged:
    """Judge tracks by their existence and by how near they are to older ones.

    hit (T,): a detection is more probable than a miss; looked (T,): whether one would have been
    seen; E (M, 2, n): to the position; fixes: of this scan.
    """
    was = now.life.status != TENTATIVE
    confirmed = was | (now.existence > CONFIRMS) & (now.evidence >= EVIDENCE)
    alive = ~(now.existence < ENDS)
    status = status_of(now.life.status, confirmed, hit, looked)
    if not looked.any():
        return Judged(status, alive, now.near_to, now.near_for)
    nameless = [group for group in fixes if group.target_id is None]
    near_to, near_for = coalescence(now, was, *now.positions(E), nameless)
    near_for = np.where(looked, near_for, np.where(near_to == now.near_to, now.near_for, 0))
    scans = [names.patience(group.config.detection_probability) for group in nameless]
    patience = np.where(was, max([SCANS_CONFIRMED, *scans]), SCANS_TENTATIVE)
    return Judged(status, alive & (near_for < patience), near_to, near_for)


def status_of(
    before: StatusArray, confirmed: BoolArray, hit: BoolArray, looked: BoolArray
) -> StatusArray:
    """The status (T,) of tracks, of which some are `confirmed`."""
    seen = np.where(looked, COASTING, before)
    seen = np.where(hit | (seen == TENTATIVE), CONFIRMED, seen)
    return np.where(confirmed, seen, TENTATIVE).astype(np.uint8)


def coalescence(
    now: DiverState,
    confirmed: BoolArray,
    mean: FloatArray,
    covariance: FloatArray,
    fixes: Sequence[Positions],
) -> tuple[IntArray, IntArray]:
    """The older track that each one is near (T,), 0 for none, and for how many scans (T,).

    mean (T, 2) and covariance (T, 2, 2) of the positions. Named tracks take no part. Tracks that
    are seen in the same scan are two divers, however near they are.
    """
    ids, free = now.life.track_id.astype(np.int64), now.target_id == NOBODY
    partner, distance = joint_association.nearest_older(mean, covariance, ids, free, confirmed)
    near = distance < np.where(confirmed, NEAR_CONFIRMED, NEAR_TENTATIVE)
    for track in np.flatnonzero(near):
        pair = [track, partner[track]]
        near[track] = not any(_both_seen(group, mean[pair], covariance[pair]) for group in fixes)
    near_to = np.where(near, ids[partner], 0)
    near_for = np.where(near, np.where(near_to == now.near_to, now.near_for, 0) + 1, 0)
    return near_to, near_for


def _both_seen(fixes: Positions, mean: FloatArray, covariance: FloatArray) -> bool:
    """Whether a scan has two fixes near two tracks, mean (2, 2) and covariance (2, 2, 2). Two that
    are as near to each other as tracks of one diver are one that came twice."""
    near = names.near(fixes, mean, covariance)
    z, R = fixes.z[near], fixes.R[near]
    distance = names.squared(z[:, None] - z[None], R[:, None] + R[None])
    return bool((distance >= NEAR_CONFIRMED).any())


# -- false fixes ---------------------------------------------------------------------------------


def counted(now: DiverState, fixes: Positions, claimed: FloatArray) -> DiverState:
    """With the false ones of a scan, of which each fix is a track's with the probability `claimed`
    (D,)."""
    if fixes.config.clutter_density or fixes.target_id is not None or not fixes.whole:
        return now
    before = dict(now.clutter).get(fixes.sensor, Clutter())
    after = before.after(fixes.z, np.clip(1.0 - claimed, 0.0, 1.0))
    return now._replace(clutter=replaced(now.clutter, fixes.sensor, after))


def without_first_fixes(
    before: DiverState, now: DiverState, fixes: Sequence[Positions]
) -> DiverState:
    """Without the first fixes of tracks that were confirmed since `before` by `fixes`, which were
    counted as false ones."""
    known = dict(now.clutter)
    sensor = next((group.sensor for group in fixes if group.sensor in known), None)
    if sensor is None:
        return now
    firm = now.life.track_id[(now.life.status != TENTATIVE) & (now.target_id == NOBODY)]
    was = before.life.track_id[before.life.status != TENTATIVE]
    new = len(np.setdiff1d(firm, was))
    if not new:
        return now
    after = known[sensor]._replace(false=max(known[sensor].false - new, 0.0))
    return now._replace(clutter=replaced(now.clutter, sensor, after))
