# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Two obstacles that pass each other before a sonar, and a third that comes into view."""

import numpy as np

from helpers.obstacle_runs import run, SECOND
from sonar_imm.measurements import Detections, Navigation
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker


def crossing(pings=80, detected=1.0, clutter=0.0, late=10**6):
    """The estimates ping by ping, and the true velocities (3, 2), east and north. Every echo comes
    with the probability `detected`, among `clutter` false ones a ping on average; the third
    obstacle echoes from ping `late` on and does not move."""
    rng = np.random.default_rng(3)
    velocity = np.array([[0.0, 0.5], [0.0, -0.5], [0.0, 0.0]])
    start = np.array([[70.0, -10.0], [72.0, 10.0], [84.0, 12.0]])
    measurements = []
    for k in range(pings):
        t, stamp = 0.5 * k, SECOND + k * SECOND // 2
        measurements.append(
            Navigation(stamp_ns=stamp, position=[t, 0.0, -20.0], orientation=[0.0, 0.0, 0.0, 1.0])
        )
        off = start + t * velocity - [t, 0.0]
        z = np.column_stack([np.hypot(*off.T), np.arctan2(off[:, 1], off[:, 0])])
        z[:2] += rng.normal(size=(2, 2)) * [0.1, 0.003]
        echoes = [z[0], z[1]]
        if detected < 1.0 or k >= late:
            z[2] += rng.normal(size=2) * [0.1, 0.003]
            echoes = [item for item in z[: 3 if k >= late else 2] if rng.uniform() < detected]
            echoes += [
                rng.uniform([5.0, -0.39], [99.0, 0.39]) for _ in range(rng.poisson(clutter))
            ]
        seen = np.reshape(echoes, (-1, 2))
        measurements.append(Detections(stamp_ns=stamp, range=seen[:, 0], bearing=seen[:, 1]))
    return list(run(ObstacleTracker(ObstacleConfig()), measurements).values()), velocity
