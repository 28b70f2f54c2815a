# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Divers that cross in pairs, seen as scans of fixes in clutter.

Each pair meets near the middle of the scene: straight paths at an angle of 20 to 90 degrees, .5
to .9 m/s, that pass each other within a metre about half way through. A scan is one `Fixes`, also
when it is empty.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.random import Generator

from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Fixes

ANGLE = np.deg2rad([20.0, 90.0])
SPEED = (0.5, 0.9)
CLOSEST = 1.0
MEETING = (0.46, 0.58)
"""When a pair is closest, in lengths of the scene."""

MIDDLE = 20.0
"""Metres from the origin, on each axis, within which pairs meet."""

CROSSING = (
    'two pairs of divers that cross within a metre, scans of fixes in clutter',
    {
        'motion': 'crossing',
        'sensor': 'scans',
        'divers': 4,
        'duration': 119.0,
        'detection_probability': 0.9,
        'fix_std': 0.7,
        'clutter': 10.0,
        'clutter_range': 80.0,
    },
)
"""The scene of `simulator.SCENARIOS`."""


def crossing_paths(divers: int, times: FloatArray, rng: Generator) -> list[FloatArray]:
    """States (n, 4), px py vx vy, of `divers` at `times`; with an odd number the last one swims
    as if it had met a partner."""
    paths: list[FloatArray] = []
    for _ in range((divers + 1) // 2):
        meeting = rng.uniform(*MEETING) * times[-1]
        place = rng.uniform(-MIDDLE, MIDDLE, 2)
        heading = rng.uniform(0.0, 2.0 * np.pi)
        between = rng.uniform(*ANGLE) * rng.choice([-1.0, 1.0])
        side = rng.uniform(0.0, 2.0 * np.pi)
        apart = rng.uniform(0.0, CLOSEST) * np.array([np.cos(side), np.sin(side)])
        for angle, start in ((heading, place), (heading + between, place + apart)):
            velocity = rng.uniform(*SPEED) * np.array([np.cos(angle), np.sin(angle)])
            position = start + (times - meeting)[:, None] * velocity
            paths.append(np.hstack([position, np.tile(velocity, (len(times), 1))]))
    return paths[:divers]


def sense_scan(config: Any, stamp_ns: int, present: FloatArray, rng: Generator) -> list[Fixes]:
    """All fixes of one scan in no particular order: of divers at `present` (n, 3), and false ones
    in the square; config: a `DiverScenario`."""
    half, std = config.clutter_range, config.fix_std
    seen = present[:, :2][rng.uniform(size=len(present)) < config.detection_probability]
    false = rng.uniform(-half, half, (rng.poisson(config.clutter), 2))
    points = rng.permutation(np.vstack([seen + std * rng.normal(size=seen.shape), false]))
    return [
        Fixes(
            stamp_ns=stamp_ns,
            position=np.column_stack([points, np.zeros(len(points))]),
            covariance=np.tile(std**2 * np.eye(2), (len(points), 1, 1)),
            frame_id='map',
        )
    ]


def instruments_of_scans(config: Any) -> dict[str, float]:
    """What a user knows of such a sensor, by the names of the tracker's parameters."""
    return {
        'clutter_density': max(config.clutter, 1e-3) / (2.0 * config.clutter_range) ** 2,
        'detection_probability': min(max(config.detection_probability, 0.01), 0.999),
    }
