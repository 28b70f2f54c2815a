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

"""Will the vehicle hit it: closest approach and probability of a collision.

Both go straight on: the vehicle along the line through its last positions, the obstacle with the
velocity of each component. A collision is a time up to `cpa_horizon` at which the obstacle is
within `safety_radius` horizontally and `safety_height` vertically at once. The raw velocity of the
navigation would not do: a vehicle in swell swings about its course.

Source: docs/obstacle.md, section Avoidance.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from functools import cache
import math

import numpy as np

from ...estimation.arrays import FloatArray
from ...measurements import nanoseconds
from ..navigation import NavigationBuffer
from . import avoidance_kernels
from .avoidance_kernels import Safety
from .config import ObstacleConfig
from .ping_kernels import slope

DRAWS = 256
CLIMBING = 0.15
"""m/s of the course from which a vehicle climbs or dives on purpose; heave is less."""
_SHORTEST = 1.0
"""Seconds of positions that make a course."""


def course(buffer: NavigationBuffer, stamp_ns: int, window: float) -> FloatArray:
    """Velocity (3,) m/s ENU of the vehicle: slope of the straight line through its positions of
    the last `window` seconds. NaN where there are too few."""
    first = bisect_left(buffer.stamps, stamp_ns - nanoseconds(window))
    last = bisect_right(buffer.stamps, stamp_ns)
    stamps = buffer.stamps[first:last]
    if len(stamps) < 2 or (stamps[-1] - stamps[0]) * 1e-9 < _SHORTEST:
        return np.full(3, np.nan)
    t = (np.array(stamps) - stamp_ns) * 1e-9
    positions = np.concatenate([sample.position for sample in buffer.samples[first:last]]).reshape(
        -1, 3
    )
    return slope(t, positions)


def closest_approach(
    mean: FloatArray,
    covariance: FloatArray,
    mu: FloatArray,
    velocity: FloatArray,
    config: ObstacleConfig,
) -> dict[str, FloatArray]:
    """``cpa_distance`` m, ``cpa_time`` s and ``collision_probability``, each (T,), of mixtures
    mean (T, K, 5), covariance (T, K, 5, 5), mu (T, K) (`avoidance_kernels`) before a vehicle of
    that velocity (3,), NED. NaN where the velocity is."""
    names = ('cpa_distance', 'cpa_time', 'collision_probability')
    if not all(map(math.isfinite, velocity.tolist())):
        return {name: np.full(len(mu), np.nan) for name in names}
    return dict(
        zip(names, avoidance_kernels.assess(mean, covariance, mu, _safety(velocity, config)))
    )


def _safety(velocity: FloatArray, config: ObstacleConfig) -> Safety:
    climbs = abs(velocity[2]) > CLIMBING
    return Safety(
        np.array([velocity[0], velocity[1], velocity[2] if climbs else 0.0]),
        config.course_std,
        config.safety_radius,
        config.safety_height,
        config.cpa_horizon,
        draws(),
    )


@cache
def draws() -> FloatArray:
    """Standard normal points (256, 5) that fill the space evenly: a Kronecker lattice on powers of
    the root of x^6 = x + 1."""
    from scipy.special import ndtri

    root = 1.0
    for _ in range(60):
        root = (1.0 + root) ** (1.0 / 6.0)
    steps = root ** -np.arange(1.0, 6.0)
    u = (0.5 + np.outer(np.arange(1, DRAWS + 1), steps)) % 1.0
    points = np.asarray(ndtri(u))
    return np.ascontiguousarray((points - points.mean(axis=0)) / points.std(axis=0))
