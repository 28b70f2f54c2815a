# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Kinds of targets by name (`target`): boats, ships, ROVs and fish with and without it.

    python -m benchmarks.diver_targets --runs 4 --out docs/results/diver_targets.json

A fix per second for 120 s, good to 1 m on each axis (ROV and fish .3 m), without false ones. Each
target goes straight for so many seconds, then turns within 4 s (fish: at once) by up to so many
degrees. `default` is the tracker without a parameter, `named` has `target`, `cv` is one constant
velocity (noise 1 m/s^2, any speed up to 20 m/s). RMSE in m where there is a confirmed track, from
10 s on; seen: share of the scans with one within 20 m; tracks: identities of a run.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.study import Parts, study
from sonar_imm.measurements import Fix
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

SECONDS, SETTLED, FAR = 120, 10, 20.0

CASES: dict[str, tuple[str, float, float, int, int, float]] = {
    'boat, 12 m/s': ('boat', 12.0, 60.0, 15, 4, 1.0),
    'boat, 4 m/s': ('boat', 4.0, 60.0, 15, 4, 1.0),
    'ship, 6 m/s': ('ship', 6.0, 15.0, 40, 20, 1.0),
    'rov, .3 m/s': ('rov', 0.3, 90.0, 10, 4, 0.3),
    'fish, .6 m/s': ('fish', 0.6, 120.0, 4, 1, 0.3),
    'diver, .75 m/s': ('diver', 0.75, 80.0, 10, 1, 0.3),
}
"""Kind, speed, turn, seconds of a leg and of its turn, standard deviation of a fix."""


def path(
    speed: float, turn_deg: float, leg: int, turning: int, rng: np.random.Generator
) -> np.ndarray:
    """(seconds, 2) places."""
    turns = np.repeat(rng.uniform(-turn_deg, turn_deg, SECONDS // leg + 1), leg)[:SECONDS]
    rate = turns / turning * (np.arange(SECONDS) % leg < turning)
    heading = np.radians(rng.uniform(0.0, 360.0) + np.cumsum(rate))
    return np.cumsum(speed * np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)


def case(name: str, values: dict[str, Any], runs: int) -> dict[str, float]:
    _, speed, turn_deg, leg, turning, std = CASES[name]
    squared: list[float] = []
    ids, scans = 0, 0
    for seed in range(runs):
        rng = np.random.default_rng([63, seed])
        truth, seen = path(speed, turn_deg, leg, turning, rng), set()
        tracker = DiverTracker(DiverConfig(**values))
        for second, place in enumerate(truth, start=1):
            at = np.append(place + std * rng.normal(size=2), 0.0)
            fix = Fix(stamp_ns=second * 10**9, position=at, covariance=std**2 * np.eye(2))
            estimate = tracker.process(fix)[-1]
            rows = np.flatnonzero(estimate.extras['track_state'] > 0)
            if second <= SETTLED:
                continue
            scans += 1
            error = np.hypot(*(estimate.state[rows, :2] - place).T)
            if len(rows) and error.min() < FAR:
                squared.append(error.min() ** 2)
                seen.add(int(estimate.extras['track_id'][rows[error.argmin()]]))
        ids += len(seen)
    return {
        'rmse': float(np.sqrt(np.mean(squared))) if squared else float('nan'),
        'seen': len(squared) / scans,
        'tracks': ids / runs,
    }


def main(runs: int = 4) -> Parts:
    yield {'runs': runs}
    for name, (kind, *_) in CASES.items():
        ways: dict[str, dict[str, Any]] = {
            'default': {},
            'named': {'target': kind},
            'cv': {'model_set': 'bench_cv', 'acceleration_noise': (1.0,), 'velocity_std': 10.0},
        }
        for way, values in ways.items():
            yield {'table': {f'{name}, {way}': case(name, values, runs)}}


if __name__ == '__main__':
    study(main)
