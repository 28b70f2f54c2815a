# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Obstacles in clutter, seldom seen, or with variances that are not true: what is tracked.

    python -m benchmarks.obstacle_clutter --runs 20 --out docs/results/obstacle_clutter.json

Each run is the whole tracker at its defaults, told where the sonar sits. Where not said otherwise
one obstacle is approached for 56 s at 2 Hz and shown in 19 of 20 pings. Clutter is added to the
scene: `30 false` all over, `ring of 12` at 55 to 59 m (the onset of a sea floor), `sector of 12`
between 10 and 16 degrees to starboard; each is a mean number in a ping. `field of 14` has
obstacles of three kinds, eight of them fixed.

Of all pings in which the beam holds an obstacle: `GOSPA` of order 1 and cut 4 m, of confirmed
tracks (a missed or false one costs 2), the share `missed`, and `false` tracks a ping; `false/h`
counts tracks that follow nothing for more than half of their pings, in an hour. `confirm` is the
median time from the first ping in the beam to a confirmed track, s, infinite where it was none;
`place` the mean distance in the plane, m; `P` the mean probability of the true behaviour after 27
s. `offset`, `NEES` and `band` are of the vertical offset between 60 and 40, and 40 and 25 m.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from attrs import evolve
import numpy as np

from benchmarks.obstacle_accuracy import level, LEVER, true_level
from benchmarks.study import final_estimates, Parts, rms, study, truths
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Detections, Measurement
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate, TrueObstacle

CUT = 4.0
BANDS = ((60.0, 40.0), (40.0, 25.0))
SETTLED = 27.0
HALF = np.radians(22.5)

Change = Callable[[Detections, float, np.random.Generator], Detections | None]
"""A ping at a time, s, as it arrives; None where it is lost."""


def false_ones(
    number: float, near: float, far: float, left: float = -HALF, right: float = HALF
) -> Change:
    """A mean number of false detections a ping, by range, m, and bearing, rad to port."""

    def change(ping: Detections, t: float, rng: np.random.Generator) -> Detections:
        count = rng.poisson(number)
        more = Detections(
            stamp_ns=ping.stamp_ns,
            range=np.append(ping.range, rng.uniform(near, far, count)),
            bearing=np.append(ping.bearing, rng.uniform(left, right, count)),
        )
        return evolve(more, frame_id=ping.frame_id)

    return change


def told(factor: float) -> Change:
    """Detections that state so many times their variances."""

    def change(ping: Detections, t: float, rng: np.random.Generator) -> Detections:
        config = ObstacleConfig()
        n, bearing_std = len(ping), np.radians(config.bearing_std_deg)
        return evolve(
            ping,
            var_range=np.full(n, factor * config.range_std**2),
            var_bearing=np.full(n, factor * bearing_std**2),
        )

    return change


def silent(first: float, last: float) -> Change:
    """No ping between two times, s."""
    return lambda ping, t, rng: None if first <= t < last else ping


BOTH_SIDES = {'vertical_offset': 0.0, 'offset_spread': 6.0}
ALL_OVER = false_ones(30.0, 1.0, 100.0)
FIELD = {'spacing': 5.0, 'passing_distance': 15.0, **BOTH_SIDES}
KINDS_OF_14 = [
    ('approach', {'obstacles': 8, **FIELD}),
    # As long on the way, with other obstacles.
    ('swaying', {'obstacles': 3, 'first_range': 78.0, 'last_range': -6.0, **FIELD}),
    ('mover', {'obstacles': 3, 'first_range': 66.0, 'last_range': -18.0, **FIELD}),
]
SCENES: dict[str, tuple[Sequence[tuple[str, dict[str, Any]]], Change | None]] = {
    'fixed, +3 m': ([('approach', {})], None),
    'fixed, +-6 m': ([('approach', BOTH_SIDES)], None),
    'swaying, +-6 m': ([('swaying', BOTH_SIDES)], None),
    'moving .3-1.5 m/s': ([('mover', {})], None),
    'moving .1-.3 m/s': ([('mover', {'obstacle_speed': [0.1, 0.3]})], None),
    '30 false': ([('approach', {})], ALL_OVER),
    'ring of 12': ([('approach', {})], false_ones(12.0, 55.0, 59.0)),
    'sector of 12': (
        [('approach', {})],
        false_ones(12.0, 1.0, 100.0, -np.radians(16.0), -np.radians(10.0)),
    ),
    'P_D .3, 5 false': (
        [('approach', {'detection_probability': 0.3})],
        false_ones(5.0, 1.0, 100.0),
    ),
    'P_D .17': ([('approach', {'detection_probability': 0.17})], None),
    'no ping for 20 s': ([('approach', {})], silent(8.0, 28.0)),
    'R told x 9': ([('approach', {})], told(9.0)),
    'field of 14': (KINDS_OF_14, None),
    'field of 14, 30 false': (KINDS_OF_14, ALL_OVER),
}
"""Scenes of one seed, whose obstacles are all there, and what is done to the pings."""
KINDS = {'approach': 'fixed', 'swaying': 'swaying', 'mover': 'moving'}


def encounter(
    parts: Sequence[tuple[str, dict[str, Any]]], change: Change | None, seed: int
) -> tuple[list[Measurement], list[tuple[str, TrueObstacle]]]:
    """The measurements of an encounter, and the obstacles with what they do. Scenes of one seed
    have the same vehicle."""
    scenes = []
    for kind, values in parts:
        seen = {'detection_probability': 0.95, **values}
        scenes.append((KINDS[kind], simulate(scenario(kind, {**LEVER, **seen}), seed)))
    obstacles = [(does, truth) for does, scene in scenes for truth in truths(scene, TrueObstacle)]
    pings: dict[int, list[Detections]] = {}
    for _, scene in scenes:
        for item in scene.measurements:
            if isinstance(item.measurement, Detections):
                pings.setdefault(item.measurement.stamp_ns, []).append(item.measurement)
    rng = np.random.default_rng(seed + 1000)
    measurements, start = [], min(pings)
    for item in scenes[0][1].measurements:
        given = item.measurement
        if isinstance(given, Detections):
            together = pings[given.stamp_ns]
            ping = evolve(
                Detections(
                    stamp_ns=given.stamp_ns,
                    range=np.concatenate([each.range for each in together]),
                    bearing=np.concatenate([each.bearing for each in together]),
                ),
                frame_id=given.frame_id,
            )
            changed = change(ping, (given.stamp_ns - start) * 1e-9, rng) if change else ping
            if changed is None:
                continue
            given = changed
        measurements.append(given)
    return measurements, obstacles


def matched(points: np.ndarray, true: np.ndarray) -> np.ndarray:
    """The track (n,) at each true place (n, 2), -1 for none."""
    from scipy.optimize import linear_sum_assignment

    found = np.full(len(true), -1)
    if len(points) and len(true):
        distance = np.linalg.norm(true[:, None] - points[None], axis=2)
        for i, j in zip(*linear_sum_assignment(np.minimum(distance, CUT))):
            if distance[i, j] < CUT:
                found[i] = j
    return found


class Sums:
    """What is summed over the pings of several encounters."""

    def __init__(self) -> None:
        self.gospa: list[float] = []
        self.due = self.missed = self.pings = self.false = self.false_ids = 0
        self.seconds = 0.0
        self.confirm: list[float] = []
        self.place: list[float] = []
        self.behaviour: dict[str, list[float]] = {}
        self.offset: list[list[tuple[float, float, float]]] = [[] for _ in BANDS]
        self.switches = 0

    def add(self, final: dict[int, Estimate], obstacles: list[tuple[str, TrueObstacle]]) -> None:
        """Add one encounter."""
        stamps = obstacles[0][1].stamp_ns
        first = {k: int(np.argmax(truth.in_beam)) for k, (_, truth) in enumerate(obstacles)}
        confirmed: dict[int, float] = {}
        follows: dict[int, list[bool]] = {}
        last_id: dict[int, int] = {}
        for ping, stamp in enumerate(stamps.tolist()):
            estimate = final.get(stamp)
            if estimate is None:
                continue
            t = (stamp - stamps[0]) * 1e-9
            points, sure = level(estimate)
            rows = np.flatnonzero(sure)
            ids = estimate.extras['track_id'][rows]
            true = np.array([true_level(truth, ping) for _, truth in obstacles])
            found = matched(points[rows], true)
            inside = np.array([truth.in_beam[ping] for _, truth in obstacles])
            for row, track in enumerate(ids.tolist()):
                follows.setdefault(track, []).append(bool((found == row).any()))
            missed, false = inside & (found < 0), len(rows) - int((found >= 0).sum())
            there = np.flatnonzero(found >= 0)
            off = np.linalg.norm(points[rows[found[there]]] - true[there], axis=1)
            if inside.any():
                self.due += int(inside.sum())
                self.missed += int(missed.sum())
                self.pings += 1
                self.false += false
                self.gospa.append(float(off.sum()) + 0.5 * CUT * (missed.sum() + false))
            self.place += off.tolist()
            for k, j in enumerate(found.tolist()):
                if j < 0:
                    continue
                confirmed.setdefault(k, t - (stamps[first[k]] - stamps[0]) * 1e-9)
                track = int(ids[j])
                self.switches += last_id.get(k, track) != track
                last_id[k] = track
                self._add_row(estimate, int(rows[j]), obstacles[k], ping, t)
        self.confirm += [confirmed.get(k, np.inf) for k in range(len(obstacles))]
        self.false_ids += sum(1 for each in follows.values() if np.mean(each) < 0.5)
        self.seconds += (stamps[-1] - stamps[0]) * 1e-9

    def _add_row(
        self,
        estimate: Estimate,
        row: int,
        obstacle: tuple[str, TrueObstacle],
        ping: int,
        t: float,
    ) -> None:
        does, truth = obstacle
        if t > SETTLED:
            p = float(estimate.extras[f'prob_{does}'][row])
            self.behaviour.setdefault(does, []).append(p)
        for (far, near), rows in zip(BANDS, self.offset):
            if near <= truth.range[ping] < far:
                offset = truth.vertical_offset[ping]
                error = estimate.state[row, 2] - offset
                low = estimate.extras['vertical_offset_lo'][row]
                high = estimate.extras['vertical_offset_hi'][row]
                inside = float(low <= offset <= high)
                rows.append((error, error**2 / estimate.covariance[row, 2, 2], inside))

    def row(self) -> dict[str, float]:
        """The row of the table."""
        found = {
            'GOSPA': float(np.mean(self.gospa)),
            'missed': self.missed / self.due,
            'false': self.false / self.pings,
            'false/h': 3600.0 * self.false_ids / self.seconds,
            'confirm': float(np.median(self.confirm)),
            'place': float(np.mean(self.place)) if self.place else np.nan,
            **{f'P {does}': float(np.mean(p)) for does, p in self.behaviour.items()},
        }
        for (far, near), rows in zip(BANDS, self.offset):
            error, nees, inside = np.array(rows or [(np.nan,) * 3]).T
            name = f'{far:.0f}-{near:.0f}'
            found |= {
                f'offset {name}': rms(error.tolist()),
                f'NEES {name}': float(nees.mean()),
                f'band {name}': float(inside.mean()),
            }
        return {**found, 'switches': float(self.switches)}


def scene(name: str, runs: int, first: int = 0) -> dict[str, float]:
    """One row of the table."""
    sums = Sums()
    for seed in range(first, first + runs):
        measurements, obstacles = encounter(*SCENES[name], seed)
        config = ObstacleConfig(sonar_lever=LEVER['sonar_lever'])
        sums.add(final_estimates(ObstacleTracker(config), measurements), obstacles)
    return {'runs': runs, **sums.row()}


def main(runs: int = 20, first: int = 0, scenes: Sequence[str] = tuple(SCENES)) -> Parts:
    """Yield a row for each scene."""
    for name in scenes:
        yield {'scenes': {name: scene(name, runs, first)}}


if __name__ == '__main__':
    study(main, first={'help': 'first seed'}, scenes={'choices': list(SCENES)})
