# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Obstacles in clutter, seldom seen, with navigation that errs, and in scans that take seconds.

    python -m benchmarks.obstacle_clutter --runs 20 --out docs/results/obstacle_clutter.json

Each run is the whole tracker at its defaults, told where the sonar sits and of its navigation what
a `belief` says: nothing (`default`), that it has no errors that last (`exact`), or that it is a
good inertial system (`good`). Where not said otherwise one obstacle is approached for 56 s at 2 Hz
and shown in 19 of 20 pings.

Clutter is added to the scene: `30 false` all over, `ring of 12` at 55 to 59 m (the onset of a sea
floor), `sector of 12` between 10 and 16 degrees to starboard; each is a mean number in a ping.
`field of 14` has obstacles of three kinds, eight of them fixed. Navigation drifts in any
direction, the sonar is turned to either side, or poses come late, each untold. `scan of 9 s`: a
sonar that turns by 40 degrees/s, at .5 m/s; each row has its time, and `missed` counts pings at
which the tracker published something.

Of all pings in which the beam holds an obstacle: the share `missed` by confirmed tracks within
4 m, and `false` tracks a ping. `confirm` is the median time from the first ping in the beam to a
confirmed track, s, infinite where it was none; `P` the mean probability of the true behaviour
after 27 s. `offset`, `NEES` and `band` are of the vertical offset between 60 and 40, and 40 and
25 m. Pings of one encounter err alike: `band se` is the standard error of the band by encounters.
Encounters of one seed are the same but for what a scene names, so `fixed, +3 m` is `30 false`, and
`P_D .3` is `P_D .3, 5 false`, told which echoes are the obstacle's.
`said`: share of the encounters after which users are told of errors of the navigation, or that
obstacles move alike.

`reliability` compares what is stated with what is true, by bins of what is stated, over all rows
that are published of all scenes of a run: `existence`, of tentative tracks too, true where a real
obstacle is nearest and within the cut; and the `behaviours` of rows that follow one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from attrs import evolve
import numpy as np

from benchmarks.obstacle_accuracy import level, LEVER, true_level
from benchmarks.study import final_estimates, Parts, rms, study, truths
from sonar_imm.estimates import Estimate
from sonar_imm.estimation.consistency import gospa
from sonar_imm.measurements import Detections, Measurement, Navigation
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate, TrueObstacle

CUT = 4.0
BANDS = ((60.0, 40.0), (40.0, 25.0))
SETTLED = 27.0
HALF = np.radians(22.5)
SECOND = 1e9
SWEEP = 9.0
STATED = (0.0, 0.1, 0.3, 0.5, 0.7, 0.9, 0.98, 1.0)
"""Edges of the bins of a stated probability."""
BELIEFS: dict[str, dict[str, Any]] = {
    'default': {},
    'exact': {'drift_std': 0.0, 'yaw_error_std_deg': 0.0, 'navigation_delay_std': 0.0},
    'good': {'drift_std': 0.003, 'yaw_error_std_deg': 0.1, 'navigation_delay_std': 0.01},
}

COMPARED = {'drift .05': ('exact',)}
"""Beliefs that a scene has besides."""

Change = Callable[[list[Measurement], int], list[Measurement]]
"""The measurements of an encounter as they arrive; by seed."""


def each_ping(
    change: Callable[[Detections, float, np.random.Generator], Detections | None],
) -> Change:
    """One ping at a time, s; None where it is lost."""

    def changed(given: list[Measurement], seed: int) -> list[Measurement]:
        rng, start, out = np.random.default_rng(seed + 1000), None, []
        for item in given:
            if isinstance(item, Detections):
                start = item.stamp_ns if start is None else start
                if (ping := change(item, (item.stamp_ns - start) / SECOND, rng)) is None:
                    continue
                item = ping
            out.append(item)
        return out

    return changed


def each_pose(change: Callable[[Navigation, float], Navigation]) -> Change:
    """One pose at a time, s; in the order of the stamps that they then have."""

    def changed(given: list[Measurement], seed: int) -> list[Measurement]:
        start = given[0].stamp_ns
        moved = [
            change(each, (each.stamp_ns - start) / SECOND)
            if isinstance(each, Navigation)
            else each
            for each in given
        ]
        return sorted(moved, key=lambda each: each.stamp_ns)

    return changed


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

    return each_ping(change)


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

    return each_ping(change)


def silent(first: float, last: float) -> Change:
    """No ping between two times, s."""
    return each_ping(lambda ping, t, rng: None if first <= t < last else ping)


def drifting(speed: float) -> Change:
    """Navigation that drifts by so much, m/s, in any direction."""

    def changed(given: list[Measurement], seed: int) -> list[Measurement]:
        way = np.random.default_rng(seed + 2000).uniform(0.0, 2.0 * np.pi)
        drift = speed * np.array([np.cos(way), np.sin(way), 0.0])
        drifts = each_pose(lambda each, t: evolve(each, position=each.position + t * drift))
        return drifts(given, seed)

    return changed


def turned(angle_deg: float) -> Change:
    """A sonar that is turned by so much to either side."""

    def changed(given: list[Measurement], seed: int) -> list[Measurement]:
        side = np.random.default_rng(seed + 2000).choice([-1.0, 1.0])
        off = np.radians(angle_deg) * side
        turns = each_ping(lambda each, t, rng: evolve(each, bearing=each.bearing + off))
        return turns(given, seed)

    return changed


def late(delay: float) -> Change:
    """Poses that are stamped so many seconds late."""
    return each_pose(lambda each, t: evolve(each, stamp_ns=each.stamp_ns + round(delay * SECOND)))


def scanned(given: list[Measurement], seed: int) -> list[Measurement]:
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


BOTH_SIDES = {'vertical_offset': 0.0, 'offset_spread': 6.0}
ALL_OVER = false_ones(30.0, 1.0, 100.0)
SLOW = {'speed': 0.5, 'ping_rate': 10.0}
FIELD = {'spacing': 5.0, 'passing_distance': 15.0, **BOTH_SIDES}
# As long on the way as those that stay, with other obstacles.
SWAYING = {**FIELD, 'first_range': 78.0, 'last_range': -6.0}
MOVING = {**FIELD, 'first_range': 66.0, 'last_range': -18.0}
SLOWLY = {'obstacle_speed': [0.1, 0.3]}
KINDS_OF_14 = [
    ('approach', {'obstacles': 8, **FIELD}),
    ('swaying', {'obstacles': 3, **SWAYING}),
    ('mover', {'obstacles': 3, **MOVING}),
]
SCENES: dict[str, tuple[Sequence[tuple[str, dict[str, Any]]], Change | None]] = {
    'fixed, +3 m': ([('approach', {})], None),
    'fixed, +-6 m': ([('approach', BOTH_SIDES)], None),
    'swaying, +-6 m': ([('swaying', BOTH_SIDES)], None),
    'moving .3-1.5 m/s': ([('mover', {})], None),
    'moving .1-.3 m/s': ([('mover', SLOWLY)], None),
    'moving .1-.3 m/s, 3 fixed': (
        [
            ('approach', {**FIELD, 'obstacles': 3}),
            ('mover', {**SLOWLY, 'first_range': 78.0, 'last_range': -6.0}),
        ],
        None,
    ),
    '4 fixed': ([('approach', {**FIELD, 'obstacles': 4})], None),
    '4 of 3 kinds': (
        [
            ('approach', {**FIELD, 'obstacles': 2}),
            ('swaying', {**SWAYING, 'obstacles': 1}),
            ('mover', {**MOVING, 'obstacles': 1}),
        ],
        None,
    ),
    '30 false': ([('approach', {})], ALL_OVER),
    'ring of 12': ([('approach', {})], false_ones(12.0, 55.0, 59.0)),
    'sector of 12': (
        [('approach', {})],
        false_ones(12.0, 1.0, 100.0, -np.radians(16.0), -np.radians(10.0)),
    ),
    'P_D .3': ([('approach', {'detection_probability': 0.3})], None),
    'P_D .3, 5 false': (
        [('approach', {'detection_probability': 0.3})],
        false_ones(5.0, 1.0, 100.0),
    ),
    'P_D .17': ([('approach', {'detection_probability': 0.17})], None),
    'no ping for 20 s': ([('approach', {})], silent(8.0, 28.0)),
    'R told x 9': ([('approach', {})], told(9.0)),
    'field of 14': (KINDS_OF_14, None),
    'field of 14, 30 false': (KINDS_OF_14, ALL_OVER),
    'drift .02': ([('approach', {})], drifting(0.02)),
    'drift .05': ([('approach', {})], drifting(0.05)),
    'drift .05, 4 fixed': ([('approach', {**FIELD, 'obstacles': 4})], drifting(0.05)),
    'drift .3': ([('approach', {})], drifting(0.3)),
    'drift .3, 4 fixed': ([('approach', {**FIELD, 'obstacles': 4})], drifting(0.3)),
    'yaw 2 deg': ([('approach', {})], turned(2.0)),
    '.5 s late': ([('approach', {})], late(0.5)),
    '1.5 s late': ([('approach', {})], late(1.5)),
    'scan of 9 s': ([('approach', {**SLOW, 'detection_probability': 1.0})], scanned),
}
"""Scenes of one seed, whose obstacles are all there, and what is done to the measurements."""
KINDS = {'approach': 'fixed', 'swaying': 'swaying', 'mover': 'moving'}


def encounter(name: str, seed: int) -> tuple[list[Measurement], list[tuple[str, TrueObstacle]]]:
    """The measurements of a scene, and its obstacles with what they do. Parts of one seed have the
    same vehicle."""
    parts, change = SCENES[name]
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
    measurements = []
    for item in scenes[0][1].measurements:
        given = item.measurement
        if isinstance(given, Detections):
            together = pings[given.stamp_ns]
            ping = Detections(
                stamp_ns=given.stamp_ns,
                range=np.concatenate([each.range for each in together]),
                bearing=np.concatenate([each.bearing for each in together]),
            )
            given = evolve(ping, frame_id=given.frame_id)
        measurements.append(given)
    return change(measurements, seed) if change else measurements, obstacles


class Sums:
    """What is summed over the pings of several encounters."""

    def __init__(self) -> None:
        self.due = self.missed = self.pings = self.false = 0
        self.confirm: list[float] = []
        self.behaviour: dict[str, list[float]] = {}
        self.offset: list[list[tuple[float, float, float]]] = [[] for _ in BANDS]
        self.held: list[list[float]] = [[] for _ in BANDS]
        self.existence: list[tuple[float, bool]] = []
        self.stated: list[tuple[float, bool]] = []

    def add(self, final: dict[int, Estimate], obstacles: list[tuple[str, TrueObstacle]]) -> None:
        """Add one encounter."""
        stamps = obstacles[0][1].stamp_ns
        first = {k: int(np.argmax(truth.in_beam)) for k, (_, truth) in enumerate(obstacles)}
        confirmed: dict[int, float] = {}
        before = [len(rows) for rows in self.offset]
        for ping, stamp in enumerate(stamps.tolist()):
            estimate = final.get(stamp)
            if estimate is None:
                continue
            t = (stamp - stamps[0]) * 1e-9
            points, sure = level(estimate)
            rows = np.flatnonzero(sure)
            true = np.array([true_level(truth, ping) for _, truth in obstacles])
            real = gospa(true, points, CUT, 1.0).estimate_of
            for row, r in enumerate(estimate.extras['existence'].tolist()):
                self.existence.append((r, row in real))
            found = gospa(true, points[rows], CUT, 1.0).estimate_of
            inside = np.array([truth.in_beam[ping] for _, truth in obstacles])
            if inside.any():
                self.due += int(inside.sum())
                self.missed += int((inside & (found < 0)).sum())
                self.pings += 1
                self.false += len(rows) - int((found >= 0).sum())
            for k in np.flatnonzero(found >= 0).tolist():
                confirmed.setdefault(k, t - (stamps[first[k]] - stamps[0]) * 1e-9)
                self._add_row(estimate, int(rows[found[k]]), obstacles[k], ping, t)
        for held, offsets, start in zip(self.held, self.offset, before):
            if new := offsets[start:]:
                held.append(float(np.mean([inside for *_, inside in new])))
        self.confirm += [confirmed.get(k, np.inf) for k in range(len(obstacles))]

    def _add_row(
        self,
        estimate: Estimate,
        row: int,
        obstacle: tuple[str, TrueObstacle],
        ping: int,
        t: float,
    ) -> None:
        does, truth = obstacle
        for kind in KINDS.values():
            self.stated.append((float(estimate.extras[f'prob_{kind}'][row]), kind == does))
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
            'missed': self.missed / self.due,
            'false': self.false / self.pings,
            'confirm': float(np.median(self.confirm)),
            **{f'P {does}': float(np.mean(p)) for does, p in self.behaviour.items()},
        }
        for (far, near), rows, held in zip(BANDS, self.offset, self.held):
            error, nees, inside = np.array(rows or [(np.nan,) * 3]).T
            name = f'{far:.0f}-{near:.0f}'
            found |= {
                f'offset {name}': rms(error.tolist()),
                f'NEES {name}': float(nees.mean()),
                f'band {name}': float(inside.mean()),
            }
            if len(held) > 1:
                found[f'band se {name}'] = float(np.std(held, ddof=1) / np.sqrt(len(held)))
        return found


def binned(stated: Sequence[tuple[float, bool]]) -> dict[str, dict[str, float]]:
    """By bins of what is stated: number of rows, mean of it, and share that is true."""
    p, true = np.array(stated, float).reshape(-1, 2).T
    which = np.digitize(p, STATED[1:-1])
    found = {}
    for k, (low, high) in enumerate(zip(STATED, STATED[1:])):
        if (own := which == k).any():
            found[f'{low:g}-{high:g}'] = {
                'rows': int(own.sum()),
                'stated': float(p[own].mean()),
                'true': float(true[own].mean()),
            }
    return found


def scene(name: str, belief: str, runs: int, first: int = 0) -> tuple[dict[str, float], Sums]:
    """One row of the table, and its sums."""
    sums, said = Sums(), 0
    for seed in range(first, first + runs):
        given, obstacles = encounter(name, seed)
        config = ObstacleConfig(sonar_lever=LEVER['sonar_lever'], **BELIEFS[belief])
        tracker = ObstacleTracker(config)
        sums.add(final_estimates(tracker, given), obstacles)
        words = 'navigation drifts', 'poses', 'seems to be turned'
        said += bool(tracker.health()['pings_moving_alike']) or any(
            word in each for each in tracker.warnings() for word in words
        )
    return {'runs': runs, **sums.row(), 'said': said / runs}, sums


def main(
    runs: int = 20,
    first: int = 0,
    scenes: Sequence[str] = tuple(SCENES),
    beliefs: Sequence[str] = ('default',),
) -> Parts:
    """Yield a row for each scene and belief, then how reliable what is stated was. A field has a
    fifth of the runs."""
    existence: list[tuple[float, bool]] = []
    stated: list[tuple[float, bool]] = []
    for name in scenes:
        for belief in (*beliefs, *COMPARED.get(name, ())):
            few = name.startswith('field')
            row, sums = scene(name, belief, max(1, runs // 5) if few else runs, first)
            if belief != 'default':
                yield {'scenes': {f'{name}, {belief}': row}}
                continue
            existence += sums.existence
            stated += sums.stated
            yield {'scenes': {name: row}}
    yield {'reliability': {'existence': binned(existence), 'behaviours': binned(stated)}}


if __name__ == '__main__':
    study(
        main,
        first={'help': 'first seed'},
        scenes={'choices': list(SCENES)},
        beliefs={'choices': list(BELIEFS)},
    )
