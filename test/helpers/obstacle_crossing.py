"""Two obstacles that pass each other before a sonar."""

import numpy as np

from helpers.obstacle_runs import run, SECOND
from sonar_imm.measurements import Detections, Navigation
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker


def crossing(pings=80):
    """The estimates ping by ping, and the true velocities (2, 2), east and north."""
    rng = np.random.default_rng(3)
    velocity = np.array([[0.0, 0.5], [0.0, -0.5]])
    start = np.array([[70.0, -10.0], [72.0, 10.0]])
    measurements = []
    for k in range(pings):
        t, stamp = 0.5 * k, SECOND + k * SECOND // 2
        measurements.append(
            Navigation(stamp_ns=stamp, position=[t, 0.0, -20.0], orientation=[0.0, 0.0, 0.0, 1.0])
        )
        off = start + t * velocity - [t, 0.0]
        z = np.column_stack([np.hypot(*off.T), np.arctan2(off[:, 1], off[:, 0])])
        z += rng.normal(size=(2, 2)) * [0.1, 0.003]
        measurements.append(Detections(stamp_ns=stamp, range=z[:, 0], bearing=z[:, 1]))
    return list(run(ObstacleTracker(ObstacleConfig()), measurements).values()), velocity
