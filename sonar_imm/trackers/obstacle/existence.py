# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Whether a track is an obstacle, and how often this obstacle is seen.

The existence of a track is kept by class of detectability: q (T, C) is the probability that it
exists and gives an echo in a share ``pd_k`` of the pings in which the beam holds it: `CLASSES` of
`detection_probability`. A ping changes q by its joint events
(`estimation.jipda.associate_classes`); between pings an obstacle may change its class,

    q <- f q + (1 - f) r q0,    f = exp(-dt / CHANGES),    r = sum q.

The beam holds component c with the probability V_c, and whether it does hardly changes from ping
to ping, nor does it for the upper and the lower parts of a component that reaches across an edge.
So misses are counted part by part, c of weight w_c, since the last echo, which says that the beam
held the obstacle then: with h the probability of a hit,

    s_ck <- (1 - h) s_ck (1 - pd_k V_c) / sum_c w_c s_ck (1 - pd_k V_c) + h V_c / sum_c w_c V_c.

The probability that class k is visible is sum_c w_c s_ck V_c. What may have left the beam above or
below is not given up for it; the weights w of the filter are not touched.

So an obstacle that is seen in one ping of six is tracked as well as one that is always seen, and
misses end a track as soon as its own detectability says. A track is confirmed for good at
`confirm_existence` and `confirm_hits` expected hits. Of two tracks in one place the younger ends.

Source: docs/obstacle.md, section Tracks; Musicki and Evans 2004, 'Joint integrated probabilistic
data association', for existence.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray, IntArray
from ...estimation.association import COASTING, CONFIRMED, TENTATIVE
from ...estimation.jipda import nearest_older
from .config import LEAST_DETECTION, ObstacleConfig
from .mixtures import PARTS

CLASSES = np.array([1.0, 5.0 / 9.0, 2.0 / 9.0])
"""Shares of the stated detection probability, and how probable each is for a new obstacle."""
PRIOR = np.array([0.8, 0.15, 0.05])
CHANGES = 100.0
"""Mean time, s, for which an obstacle keeps its class."""
SUREST = 0.999
"""Bound of the existence: a few misses in plain view are enough to give up what was seen a hundred
times."""
SUREST_DETECTION = 0.999
END_CONFIRMED, END_TENTATIVE = 0.05, 0.001
"""Existence below which tracks end."""
NEAR, MAHALANOBIS, MERGED = 1.0, 4.0, 5
"""Two tracks within so many metres along and across, and closer than this squared Mahalanobis
distance, in so many pings are one."""


class Existence(NamedTuple):
    """Existence of T tracks."""

    classes: Annotated[FloatArray, 'TC']
    """q (T, C), see the module."""
    silence: Annotated[FloatArray, 'TKEC']
    """s (T, K, E, C), see the module; E: `mixtures.PARTS`."""
    hits: Annotated[FloatArray, 'T']
    """Expected number of hits so far."""
    near_to: Annotated[IntArray, 'T']
    """Number of the older track in the same place, 0 for none."""
    near_for: Annotated[IntArray, 'T']
    """Number of pings in which it was there."""

    @staticmethod
    def of(classes: FloatArray, K: int, hits: float = 1.0) -> Existence:
        """Return the existence of tracks of K components that begin."""
        T, C = classes.shape
        none = np.zeros((2, T), np.int64)
        return Existence(classes, np.ones((T, K, PARTS, C)), np.full(T, hits), *none)

    def probability(self) -> FloatArray:
        """Return the probability (T,) that each track is an obstacle."""
        return np.asarray(self.classes.sum(axis=1))

    def detectability(self, config: ObstacleConfig) -> FloatArray:
        """Return the share (T,) of pings that show each obstacle, at full detectability."""
        seen = self.classes @ (config.detection_probability * CLASSES)
        return np.asarray(seen / np.maximum(self.probability(), 1e-300))

    def later(self, dt: float) -> Existence:
        """Return the existence `dt` seconds later, without a ping."""
        keep = np.exp(-dt / CHANGES)
        changed = (1.0 - keep) * self.probability()[:, None] * PRIOR
        return self._replace(classes=keep * self.classes + changed)

    def visible(self, mu: FloatArray, V: FloatArray) -> FloatArray:
        """Return the probability (T, C) that the beam holds the obstacles, of weights mu (T, K)
        whose parts it holds with V (T, K, E)."""
        weight = mu[:, :, None, None] * self.silence
        inside = (weight * V[..., None]).sum(axis=(1, 2))
        return np.asarray(inside / np.maximum(weight.sum(axis=(1, 2)), 1e-300))

    def since_hit(self, p: FloatArray) -> FloatArray:
        """Return s (T, K, E) of obstacles that give an echo with p (T, C) in the beam, as the
        classes that give one have it."""
        share = self.classes * p
        share = share / np.maximum(share.sum(axis=1), 1e-300)[:, None]
        return np.asarray((self.silence * share[:, None, None]).sum(axis=3))

    def with_ping(
        self, classes: FloatArray, hits: FloatArray, mu: FloatArray, V: FloatArray, p: FloatArray
    ) -> Existence:
        """Return the existence after a ping that left `classes` (T, C) and gave `hits` (T,), of
        obstacles that are detected with p (T, C) in the beam; mu, V: see `visible`."""
        r = classes.sum(axis=1)
        sure = np.minimum(SUREST / np.maximum(r, 1e-300), 1.0)
        w = mu[:, :, None] / PARTS
        missed = self.silence * (1.0 - p[:, None, None] * V[..., None])
        total = (w[..., None] * missed).sum(axis=(1, 2), keepdims=True)
        missed /= np.maximum(total, 1e-300)
        held = V / np.maximum((w * V).sum(axis=(1, 2), keepdims=True), 1e-300)
        h = np.minimum(hits / np.maximum(r, 1e-300), 1.0)[:, None, None, None]
        return self._replace(
            classes=classes * sure[:, None],
            silence=(1.0 - h) * missed + h * held[..., None],
            hits=self.hits + hits,
        )

    def near(self, partner: IntArray) -> Existence:
        """Return the existence with one more ping in which each track (T,) was in the place of the
        older track `partner` (T,), 0 for none."""
        before = np.where(partner == self.near_to, self.near_for, 0)
        return self._replace(near_to=partner, near_for=np.where(partner > 0, before + 1, 0))

    def ended(self, confirmed: BoolArray) -> BoolArray:
        """Return which tracks (T,) end."""
        least = np.where(confirmed, END_CONFIRMED, END_TENTATIVE)
        return (self.probability() < least) | (self.near_for >= MERGED)

    def status(self, before: np.ndarray, hit: BoolArray, config: ObstacleConfig) -> np.ndarray:
        """Return the status (T,) of the tracks, of which some were hit (T,)."""
        sure = self.probability() > config.confirm_existence
        confirmed = (before != TENTATIVE) | (sure & (self.hits > config.confirm_hits - 0.5))
        return np.where(confirmed, np.where(hit, CONFIRMED, COASTING), TENTATIVE).astype(np.uint8)


def detection(distance: FloatArray, config: ObstacleConfig) -> FloatArray:
    """Return the detection probability (T, C) of each class at ranges (T,)."""
    found = config.detection_at(distance)[:, None] * CLASSES
    return np.clip(found, LEAST_DETECTION, SUREST_DETECTION)


def older_nearby(
    mean: FloatArray, covariance: FloatArray, ids: IntArray, confirmed: BoolArray, hit: BoolArray
) -> IntArray:
    """Return the number of the older track in the same place as each track (T,), 0 for none.

    Two tracks with an echo each are two obstacles.

    :param mean: (T, 2) range, m, and azimuth, rad.
    :param covariance: (T, 2, 2).
    :param ids: (T,) rising with age.
    """
    free = np.ones(len(ids), np.bool_)
    partner, squared = nearest_older(mean, covariance, ids, free, confirmed)
    apart = np.abs(mean - mean[partner]) * np.column_stack([np.ones(len(mean)), mean[:, 0]])
    same = (partner >= 0) & (squared < MAHALANOBIS) & (apart < NEAR).all(axis=1)
    return np.where(same & ~(hit & hit[partner]), ids[partner], 0)
