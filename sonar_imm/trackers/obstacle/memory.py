# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Obstacles that have left the field of view: landmarks in the world.

A track of an obstacle ends when the sonar no longer looks its way, or when nothing was seen of it
for `max_coast`. What is known of the obstacle is kept, and when its place comes into the field of
view again the track goes on under its own number, without an echo at first. Nothing else of the
tracker knows of landmarks: a landmark that comes back is a track like any other, which an echo
continues and misses end.

**Existence.** A landmark keeps the existence and the class of detectability that its track had
(`existence`). A track that ends by its misses is no landmark, nor is one that ends with less than
one half. While nobody looks, the probability falls with `landmark_time`.

**Drift.** The errors of navigation between two stamps are those between two pings, only more of
them: coming back is one step of the prediction (`filters`), from the pose of the sonar when the
track ended to that of now. The grade `ins` makes a landmark uncertain by 0.6 m in an hour. A
landmark stays where it is: components that move are left out, and what mostly moves is not kept.
Moored ones swing on.

Source: docs/obstacle.md, section Memory.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np

from ...acoustics import geometry
from ...acoustics.geometry import Pose
from ...estimation.arrays import FloatArray
from .config import ObstacleConfig
from .filters import Mixture, Sonar

LEAST_WEIGHT = 1e-3
"""Components that weigh less are not kept."""
RETURNS = 0.4
"""Cosine to the axis of the sonar, 66 degrees, from which a landmark may come back; a track ends
beyond 78."""


class Landmark(NamedTuple):
    """An obstacle that is not in view, as it was when its track ended."""

    track_id: int
    stamp_ns: int
    """When its track ended."""
    seen_ns: int
    """Its last echo."""
    classes: Annotated[FloatArray, 'C']
    """(C,) existence by class of detectability (`existence`)."""
    sonar: Pose
    """NED and FRD."""
    which: Annotated[np.ndarray, 'k']
    """(k,) the components that are kept, of the filter's."""
    x: Annotated[FloatArray, 'kn']
    P: Annotated[FloatArray, 'knn']
    mu: Annotated[FloatArray, 'k']
    body: tuple[float, FloatArray]
    """Number of echoes with an extent, and their standard deviations (2,) m."""
    place: Annotated[FloatArray, '3']
    """(3,) m, ENU, with its covariance (3, 3)."""
    covariance: Annotated[FloatArray, '33']
    low: float
    """m, 90 % band of its height, up to `high`."""
    high: float

    def mixture(self, K: int) -> Mixture:
        """Return the components as a mixture of one obstacle with `K`."""
        n = self.x.shape[1]
        x, P = np.zeros((1, K, n)), np.tile(np.eye(n), (1, K, 1, 1))
        mu = np.zeros((1, K))
        x[0], P[0] = self.x[0], self.P[0]  # those that weigh nothing: any numbers that are finite
        x[0, self.which], P[0, self.which], mu[0, self.which] = self.x, self.P, self.mu
        return Mixture(x, P, mu)

    def existence(self, stamp_ns: int, landmark_time: float) -> float:
        """Return the probability that it is still there at `stamp_ns`."""
        age = max(stamp_ns - self.stamp_ns, 0) * 1e-9
        return float(self.classes.sum()) * math.exp(-age / landmark_time)

    def spread(self, stamp_ns: int, config: ObstacleConfig) -> FloatArray:
        """Return the covariance (3, 3) of its place at `stamp_ns`, ENU, with what navigation
        drifted."""
        age = max(stamp_ns - self.stamp_ns, 0) * 1e-9
        position, _, depth = config.drift()
        drift = np.square([position, position, depth])
        return self.covariance + np.diag(drift * age)

    def row(self, stamp_ns: int, config: ObstacleConfig) -> dict[str, float]:
        """Return it as plain values: where it is at `stamp_ns`, ENU, m, with covariance and the
        band of its height, and the probability that it is there."""
        spread = self.spread(stamp_ns, config)
        return {
            'track_id': self.track_id,
            **dict(zip('xyz', self.place.tolist())),
            'cov_x_x': float(spread[0, 0]),
            'cov_x_y': float(spread[0, 1]),
            'cov_y_y': float(spread[1, 1]),
            'cov_z_z': float(spread[2, 2]),
            'z_low': self.low,
            'z_high': self.high,
            'existence': self.existence(stamp_ns, config.landmark_time),
            'seen_ns': self.seen_ns,
        }


Memory = tuple[Landmark, ...]
"""In the order in which their tracks ended."""


def kept(memory: Memory, stamp_ns: int, config: ObstacleConfig) -> Memory:
    """Return at most `max_landmarks`: those that are most probably still there. None is newer than
    `stamp_ns`: across a clock that went back nothing is known of the drift."""
    memory = tuple(each for each in memory if each.stamp_ns <= stamp_ns)
    if len(memory) <= config.max_landmarks:
        return memory
    chance = [each.existence(stamp_ns, config.landmark_time) for each in memory]
    # Of equal ones the oldest goes first.
    best = np.argsort(chance, kind='stable')[len(memory) - config.max_landmarks :]
    return tuple(memory[i] for i in sorted(best.tolist()))


def in_view(memory: Memory, stamp_ns: int, sonar: Sonar, config: ObstacleConfig) -> list[int]:
    """The landmarks that a ping of `sonar` may show, three standard deviations beside the sector
    included, the nearest first."""
    place = geometry.flip_world([each.place for each in memory])
    m = geometry.to_body(sonar.pose, place)
    away = np.linalg.norm(m, axis=1)
    reach = np.array([3.0 * math.sqrt(np.trace(each.covariance[:2, :2])) for each in memory])
    age = np.array([max(stamp_ns - each.stamp_ns, 0) * 1e-9 for each in memory])
    reach += 3.0 * config.drift()[0] * np.sqrt(age)
    sector = np.radians(0.5 * config.horizontal_fov_deg) + reach / np.maximum(away, 1e-6)
    seen = (np.abs(np.arctan2(m[:, 1], m[:, 0])) <= sector) & (m[:, 0] >= RETURNS * away)
    seen &= away <= config.max_range + reach
    return [int(i) for i in np.argsort(away, kind='stable') if seen[i]]
