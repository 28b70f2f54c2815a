# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Obstacles seen from a vehicle whose navigation errs, and in scans that take seconds.

    python -m benchmarks.obstacle_navigation --runs 20 --out docs/results/obstacle_navigation.json

Encounters and what is summed are those of `benchmarks.obstacle_clutter`; the tracker is told where
the sonar sits and else of its navigation what a `belief` says: nothing (`default`), that it has
no errors that last (`exact`), or that it is a good inertial system (`good`).

The navigation drifts in any direction, the sonar is turned to either side, or poses come late,
each untold. `scan of 9 s`: a sonar that turns by 40 degrees/s, at .5 m/s; each row has its time.
There `GOSPA` and `missed` count pings at which the tracker published something.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from attrs import evolve
import numpy as np

from benchmarks import obstacle_clutter as clutter
from benchmarks.obstacle_accuracy import LEVER
from benchmarks.study import final_estimates, Parts, study
from sonar_imm.measurements import Detections, Measurement, Navigation
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker

SECOND = 1e9
SWEEP = 9.0
BELIEFS: dict[str, dict[str, Any]] = {
    'default': {},
    'exact': {'drift_std': 0.0, 'yaw_error_std_deg': 0.0, 'navigation_delay_std': 0.0},
    'good': {'drift_std': 0.003, 'yaw_error_std_deg': 0.1, 'navigation_delay_std': 0.01},
}
FOUR = {'obstacles': 4, 'spacing': 5.0, 'passing_distance': 15.0, **clutter.BOTH_SIDES}
SLOW = {'speed': 0.5, 'ping_rate': 10.0}
KINDS_OF_4 = [
    ('approach', {**FOUR, 'obstacles': 2}),
    ('swaying', {**FOUR, 'obstacles': 1, 'first_range': 78.0, 'last_range': -6.0}),
    ('mover', {**FOUR, 'obstacles': 1, 'first_range': 66.0, 'last_range': -18.0}),
]

Fault = Callable[[list[Measurement], np.random.Generator], list[Measurement]]


def drifting(speed: float) -> Fault:
    """Navigation that drifts by so much, m/s, in any direction."""

    def change(given: list[Measurement], rng: np.random.Generator) -> list[Measurement]:
        way, start = rng.uniform(0.0, 2.0 * np.pi), given[0].stamp_ns
        drift = speed * np.array([np.cos(way), np.sin(way), 0.0])
        return [
            evolve(each, position=each.position + (each.stamp_ns - start) / SECOND * drift)
            if isinstance(each, Navigation)
            else each
            for each in given
        ]

    return change


def turned(angle_deg: float) -> Fault:
    """A sonar that is turned by so much to either side."""

    def change(given: list[Measurement], rng: np.random.Generator) -> list[Measurement]:
        off = np.radians(angle_deg) * rng.choice([-1.0, 1.0])
        return [
            evolve(each, bearing=each.bearing + off) if isinstance(each, Detections) else each
            for each in given
        ]

    return change


def late(delay: float) -> Fault:
    """Poses that are stamped so many seconds late."""

    def change(given: list[Measurement], rng: np.random.Generator) -> list[Measurement]:
        moved = [
            evolve(each, stamp_ns=each.stamp_ns + round(delay * SECOND))
            if isinstance(each, Navigation)
            else each
            for each in given
        ]
        return sorted(moved, key=lambda each: each.stamp_ns)

    return change


def scanned(given: list[Measurement], rng: np.random.Generator) -> list[Measurement]:
    """The pings of which a beam that turns from port to starboard, once in `SWEEP` s, sees the
    echo, as scans that are stamped at their end."""
    pings = [each for each in given if isinstance(each, Detections)]
    others: list[Measurement] = [each for each in given if not isinstance(each, Detections)]
    rate = 2.0 * np.pi / SWEEP
    count, scans = round(SWEEP * SLOW['ping_rate']), []
    for first in range(0, len(pings) - count, count):
        scan = pings[first : first + count]
        end = scan[-1].stamp_ns
        ago = np.array([(each.stamp_ns - end) / SECOND for each in scan])
        beam = np.pi - (ago - ago[0]) * rate
        rows = [
            (each.range[i], each.bearing[i], t)
            for each, t, b in zip(scan, ago, beam)
            for i in range(len(each))
            if abs(each.bearing[i] - b) <= 0.5 * rate / SLOW['ping_rate']
        ]
        r, b, t = np.array(rows).reshape(-1, 3).T
        scans.append(
            evolve(
                Detections(stamp_ns=end, range=r, bearing=b, time_offset=t),
                frame_id=scan[0].frame_id,
            )
        )
    return sorted([*others, *scans], key=lambda each: each.stamp_ns)


SCENES: dict[str, tuple[Sequence[tuple[str, dict[str, Any]]], Fault | None]] = {
    'clean, +3 m': ([('approach', {})], None),
    'clean, 4 obstacles': ([('approach', FOUR)], None),
    'clean, 4 of 3 kinds': (KINDS_OF_4, None),
    'drift .02': ([('approach', {})], drifting(0.02)),
    'drift .05': ([('approach', {})], drifting(0.05)),
    'drift .05, 4 obstacles': ([('approach', FOUR)], drifting(0.05)),
    'yaw 2 deg': ([('approach', {})], turned(2.0)),
    '.5 s late': ([('approach', {})], late(0.5)),
    '1.5 s late': ([('approach', {})], late(1.5)),
    'swaying': ([('swaying', clutter.BOTH_SIDES)], None),
    'moving .3-1.5 m/s': ([('mover', {})], None),
    'moving .1-.3 m/s': ([('mover', {'obstacle_speed': [0.1, 0.3]})], None),
    '.1-.3 m/s beside 3 fixed': (
        [
            ('approach', {**FOUR, 'obstacles': 3}),
            ('mover', {'obstacle_speed': [0.1, 0.3], 'first_range': 78.0, 'last_range': -6.0}),
        ],
        None,
    ),
    'scan of 9 s': ([('approach', {**SLOW, 'detection_probability': 1.0})], scanned),
}


def scene(name: str, belief: str, runs: int, first: int = 0) -> dict[str, float]:
    """One row of the table."""
    parts, fault = SCENES[name]
    sums, good, said = clutter.Sums(), [], 0
    for seed in range(first, first + runs):
        given, obstacles = clutter.encounter(parts, None, seed)
        if fault is not None:
            given = fault(given, np.random.default_rng(seed + 2000))
        config = ObstacleConfig(sonar_lever=LEVER['sonar_lever'], **BELIEFS[belief])
        tracker = ObstacleTracker(config)
        sums.add(final_estimates(tracker, given), obstacles)
        good.append(tracker.health()['navigation_good'])
        said += any('navigation drifts' in each or 'poses' in each for each in tracker.warnings())
    row = {'runs': runs, **sums.row(), 'said': said / runs}
    known = [value for value in good if np.isfinite(value)]
    return row | ({'good': float(np.median(known))} if known else {})


def main(
    runs: int = 20,
    first: int = 0,
    scenes: Sequence[str] = tuple(SCENES),
    beliefs: Sequence[str] = tuple(BELIEFS),
) -> Parts:
    """Yield a row for each scene and belief."""
    for name in scenes:
        for belief in beliefs:
            yield {'scenes': {f'{name}, {belief}': scene(name, belief, runs, first)}}


if __name__ == '__main__':
    study(
        main,
        first={'help': 'first seed'},
        scenes={'choices': list(SCENES)},
        beliefs={'choices': list(BELIEFS)},
    )
