"""How long the obstacle tracker takes over a ping: everything, from measurement to estimate.

    python -m benchmarks.obstacle_speed --obstacles 20

A field of obstacles ahead, all in the sector; the pose of each ping comes with it, so that its
estimate is there when `process` returns. Wants a quiet core: the median is of one process at one
moment.
"""

from __future__ import annotations

import argparse
from pathlib import Path
import time

import numpy as np

from benchmarks.tables import write_json
from sonar_imm.acoustics import geometry
from sonar_imm.measurements import Detections, Navigation
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker

WANTED_MS = 2.0
SECOND = 10**9


def field(obstacles: int, pings: int, clutter: int, seed: int = 0) -> list[tuple]:
    """Pose and detections of each ping, on a straight course past obstacles that stay ahead."""
    rng = np.random.default_rng(seed)
    r, b = rng.uniform(45.0, 95.0, obstacles), np.radians(np.linspace(-18.0, 18.0, obstacles))
    places = np.column_stack([r * np.cos(b), r * np.sin(b), rng.uniform(-3.0, 3.0, obstacles)])
    out = []
    for k in range(pings):
        stamp = SECOND + k * SECOND // 2
        roll = 0.03 * np.sin(0.5 * k)
        R = geometry.rotation(roll, 0.0, 0.0)
        position = np.array([0.2 * k, 0.0, 0.0])
        d, azimuth = geometry.project((places - position) @ R)
        d = np.append(d + 0.15 * rng.normal(size=obstacles), rng.uniform(5.0, 100.0, clutter))
        azimuth = azimuth + np.radians(0.25) * rng.normal(size=obstacles)
        azimuth = np.append(azimuth, rng.uniform(-0.39, 0.39, clutter))
        q = np.array([np.sin(0.5 * roll), 0.0, 0.0, np.cos(0.5 * roll)])
        pose = Navigation(
            stamp_ns=stamp,
            position=geometry.flip_world(position + [0, 0, 30]),
            orientation=geometry.flip_quaternion(q),
        )
        out.append((pose, Detections(stamp_ns=stamp, range=d, bearing=-azimuth)))
    return out


def measure(config: ObstacleConfig, pings: list[tuple]) -> dict[str, float]:
    """Milliseconds a ping."""
    tracker = ObstacleTracker(config)
    tracker.warm()
    took, rows = [], []
    for pose, detections in pings:
        tracker.process(pose)
        begin = time.perf_counter()
        estimates = tracker.process(detections)
        took.append(1e3 * (time.perf_counter() - begin))
        rows += [len(estimate) for estimate in estimates]
    settled = np.array(took[10:])
    return {
        'tracks': float(np.mean(rows[10:])),
        'confirmed': float(tracker.health()['confirmed']),
        'median_ms': float(np.median(settled)),
        'p99_ms': float(np.percentile(settled, 99)),
        'worst_ms': float(settled.max()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--obstacles', type=int, default=20)
    parser.add_argument('--pings', type=int, default=110)
    parser.add_argument('--out', type=Path, help='write the numbers as JSON')
    options = parser.parse_args()
    base = {'depth_is_absolute': False}
    cases = {
        'gaussian_sum': ({}, 0),
        'gaussian_sum, 5 clutter': ({}, 5),
        'gaussian_sum, 5 slices': ({'components': 5}, 0),
        'gaussian_sum, two_way': ({'ping_timing': 'two_way', 'max_extrapolation': 0.2}, 0),
        'landmark': ({'method': 'landmark'}, 0),
    }
    table = {}
    for name, (values, clutter) in cases.items():
        pings = field(options.obstacles, options.pings, clutter)
        table[name] = measure(ObstacleConfig(**base, **values), pings)
        numbers = ', '.join(f'{key} {value:.2f}' for key, value in table[name].items())
        print(f'{name}: {numbers}', flush=True)
    good = table['gaussian_sum']['median_ms'] <= WANTED_MS
    print(f'{options.obstacles} obstacles within {WANTED_MS} ms: {"yes" if good else "no"}')
    write_json(options.out, table)


if __name__ == '__main__':
    main()
