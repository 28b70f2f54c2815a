# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How fast the obstacle tracker is: whole pings of many obstacles, association included."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from benchmarks.speed import Bench
from sonar_imm.measurements import Altitude, Detections, Navigation
from sonar_imm.trackers.obstacle.config import ObstacleConfig
from sonar_imm.trackers.obstacle.tracker import ObstacleTracker

OBSTACLES = 16
FALSE, WANTED_MS, WANTED_FALSE_MS = 30, 15.0, 30.0
"""False echoes a ping, and goals without and with them: plain numpy, without a compiler."""
STEP_NS = 500_000_000


def bench_ping(
    rounds: int = 7,
    pings: int = 40,
    obstacles: int = OBSTACLES,
    clutter: int = 0,
    wanted_ms: float = WANTED_MS,
    **parameters: Any,
) -> dict[str, Any]:
    """Milliseconds of CPU per ping with `obstacles` tracked obstacles: median over all rounds."""
    times, tracked = [], []
    for _ in range(rounds):
        spent, followed = _approach(pings, obstacles, clutter, ObstacleConfig(**parameters))
        times += spent
        tracked.append(followed)
    median = float(np.median(times))
    return {
        'obstacles': obstacles,
        'false': clutter,
        'pings': len(times),
        'median_ms': median,
        'p99_ms': float(np.percentile(times, 99.0)),
        'tracked': float(np.mean(tracked)),
        'wanted_ms': wanted_ms,
        'good': median <= wanted_ms and float(np.mean(tracked)) >= obstacles,
    }


def bench_clutter(rounds: int = 7) -> dict[str, Any]:
    """Milliseconds as in `bench_ping`, with false echoes all over."""
    return bench_ping(rounds, clutter=FALSE, wanted_ms=WANTED_FALSE_MS)


def _approach(
    pings: int, obstacles: int, clutter: int, config: ObstacleConfig
) -> tuple[list[float], int]:
    """Approach a wall of obstacles. Gives the milliseconds of each ping after confirmation, and
    the number of tracks at the end."""
    rng = np.random.default_rng(0)
    tracker = ObstacleTracker(config)
    tracker.warm()
    # A lattice ahead, with spacings that the sonar resolves.
    ahead = 60.0 + 5.0 * (np.arange(obstacles) // 5)
    aside = 5.0 * (np.arange(obstacles) % 5 - 2.0)
    down = rng.uniform(-2.0, 2.0, obstacles)
    times, confirmed = [], 0
    for ping in range(pings):
        stamp = (ping + 1) * STEP_NS
        east = 1.5 * stamp * 1e-9
        tracker.process(Altitude(stamp_ns=stamp, altitude=15.0))
        tracker.process(
            Navigation(
                stamp_ns=stamp, position=(east, 0.0, -20.0), orientation=(0.0, 0.0, 0.0, 1.0)
            )
        )
        away = np.column_stack([ahead - east, aside, -down])
        noise = rng.normal(size=(obstacles, 2)) * (0.1, np.radians(0.2))
        distance = np.linalg.norm(away, axis=1) + noise[:, 0]
        bearing = np.arctan2(away[:, 1], away[:, 0]) + noise[:, 1]
        echoes = Detections(
            stamp_ns=stamp,
            range=np.append(distance, rng.uniform(5.0, 100.0, clutter)),
            bearing=np.append(bearing, rng.uniform(-0.39, 0.39, clutter)),
        )
        begin = time.process_time()
        estimates = tracker.process(echoes)  # none while it waits for a pose
        if ping >= 10:
            times.append(1e3 * (time.process_time() - begin))
        for estimate in estimates:
            confirmed = int((estimate.extras['track_state'] > 0).sum())
    return times, confirmed


BENCHES = Bench('ping', bench_ping), Bench('clutter', bench_clutter)
