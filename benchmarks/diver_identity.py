# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Whose track is whose: two ways to pair fixes and divers on the same scans.

    python -m benchmarks.diver_identity --out docs/results/diver_identity.json

`buddies`: two divers swim legs the same way, 2 m apart, at .75 m/s for 120 s. A sonar sees them
without names: a scan per second, .5 m on each axis, P_D .9, two false fixes in a square of 120 m.
The transponder of the first is heard from the 20th second on, every four seconds, good to 2 m.
`crossing`: two pairs that cross within a metre (`simulate diver --scenario crossing`), a scan per
second, .7 m on each axis, P_D .7, ten false fixes in a square of 160 m. `harbour`: eight boats on
legs of 10 to 30 s at 3 m/s, 2 m on each axis, a scan each 2 s, P_D .9, 20 false fixes in a square
of 400 m.

In `untold` nothing is configured, in `table` the detection probability, the density of false fixes
and the speed of the boats (`--told`). Counted are confirmed tracks: GOSPA (10 m, 2; of boats
20 m), `with switches` half of the cutoff for each identity switch; switches and false tracks for
each hour. An identity is kept where both divers of a pair have the same track in scans 90 to 97 as
in scans 32 to 39. CPU of a scan is that of this process.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from benchmarks.study import Parts, rms, study, truths
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Fix, Fixes
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm.truth import Scene, TrueTrack
from sonar_imm_tools.evaluation.diver.scoring import score
from sonar_imm_tools.evaluation.diver.series import match, Series, series_of, Truth
from sonar_imm_tools.simulation.diver.simulator import scenario, simulate

ASSOCIATIONS = ('gnn', 'jipda')
SCENES = ('buddies', 'crossing', 'harbour')
CUTOFF = 10.0
BEFORE, AFTER = slice(32, 40), slice(90, 98)
HALF, FALSE, SCAN_STD, NAMED_STD, P_DETECTION = 60.0, 2.0, 0.5, 2.0, 0.9
NAMED_FROM, EVERY = 20, 4
HOUR = 3600.0
LEGS: dict[str, Any] = {
    'motion': 'legs',
    'sensor': 'scans',
    'start': [0.0, 0.0],
    'detection_probability': 0.9,
}
"""Scenes of several targets on straight legs."""


def true_paths(scene: Scene) -> Truth:
    tables = [table for true in scene.truth for table in true.tables('map')]
    rows = [
        Estimate.from_columns(table.columns, stamp_ns=table.stamp_ns, frame_id='map')
        for table in tables
    ]
    return Truth.from_series(series_of(rows))


def identities_kept(series: Series, truth: Truth) -> list[bool]:
    """For each pair whether both divers have the same track before and after they crossed."""
    followed = match(series.confirmed(), truth, cutoff=CUTOFF).followed_by
    before, after = ([_usual(row[when]) for row in followed] for when in (BEFORE, AFTER))
    same = [first == last and first >= 0 for first, last in zip(before, after)]
    return [same[k] and same[k + 1] for k in range(0, len(same), 2)]


def _usual(ids: np.ndarray) -> int:
    found, counts = np.unique(ids[ids >= 0], return_counts=True)
    return int(found[counts.argmax()]) if len(found) else -1


def buddies(seed: int) -> tuple[TrueTrack, TrueTrack]:
    """The paths of two divers who swim the same way 2 m apart."""
    values: dict[str, Any] = {
        'duration': 120.0,
        'speed': 0.75,
        'start': [-20.0, 0.0],
        'turn_deg': 60.0,
    }
    first = truths(simulate(scenario('table1', values), seed), TrueTrack)[0]
    aside = first.position + [0.0, 2.0, *([0.0] * (first.position.shape[1] - 2))]
    return first, TrueTrack(2, first.stamp_ns, aside, first.velocity)


def measured(truth: tuple[TrueTrack, ...], seed: int) -> list[Fix | Fixes]:
    """Scans without names, and fixes of the first diver with its name, in order."""
    rng = np.random.default_rng([seed, 7])
    measurements: list[Fix | Fixes] = []
    for k, stamp in enumerate(truth[0].stamp_ns.tolist()):
        there = np.array([path.position[k, :2] for path in truth])
        there = there[rng.uniform(size=len(there)) < P_DETECTION]
        seen = there + rng.normal(scale=SCAN_STD, size=there.shape)
        false = rng.uniform(-HALF, HALF, (rng.poisson(FALSE), 2))
        both = np.concatenate([seen, false])
        measurements.append(
            Fixes(
                stamp_ns=stamp,
                position=np.column_stack([both, np.zeros(len(both))]),
                covariance=np.tile(np.eye(2) * SCAN_STD**2, (len(both), 1, 1)),
                frame_id='map',
            )
        )
        if k < NAMED_FROM or (k - NAMED_FROM) % EVERY:
            continue
        place = truth[0].position[k, :2] + rng.normal(scale=NAMED_STD, size=2)
        measurements.append(
            Fix(
                stamp_ns=stamp + 300_000_000,
                position=[*place, 0.0],
                covariance=np.eye(2) * NAMED_STD**2,
                target_id=truth[0].track_id,
                frame_id='map',
            )
        )
    return measurements


def scene_of(name: str, seed: int) -> tuple[list[Any], Scene, dict[str, Any], float]:
    """The measurements, the truth, what the tracker is told, and the cutoff of GOSPA in m."""
    if name == 'buddies':
        truth = buddies(seed)
        items: list[Any] = list(measured(truth, seed))
        stated = {
            'detection_probability': P_DETECTION,
            'clutter_density': FALSE / (2.0 * HALF) ** 2,
        }
        return items, Scene((), truth), stated, CUTOFF
    if name == 'harbour':
        values = LEGS | {
            'divers': 8,
            'speed': 3.0,
            'turn_deg': 180.0,
            'leg_min': 10.0,
            'leg_max': 30.0,
            'duration': 300.0,
            'step': 2.0,
            'spacing': 30.0,
            'fix_std': 2.0,
            'clutter': 20.0,
            'clutter_range': 200.0,
        }
        scene = simulate(scenario('table1', values), seed)
        stated = {'speed_mean': 3.0, 'speed_std': 1.0, 'velocity_std': 2.5}
        cutoff = 20.0
    else:
        values = {'detection_probability': 0.7, 'clutter': 10.0}
        scene = simulate(scenario('crossing', values), seed)
        stated, cutoff = {}, CUTOFF
    half = values.get('clutter_range', 80.0)
    stated |= {
        'detection_probability': values['detection_probability'],
        'clutter_density': values['clutter'] / (2.0 * half) ** 2,
    }
    return [item.measurement for item in scene.measurements], scene, stated, cutoff


def case(name: str, runs: int, nothing_stated: bool = False, **settings: Any) -> dict[str, Any]:
    """The scores of a way to pair, over all runs of a scene."""
    scored: list[dict[str, Any]] = []
    kept: list[bool] = []
    seconds, scans, rows, span = 0.0, 0, 0, 0.0
    for seed in range(runs):
        items, scene, stated, cutoff = scene_of(name, seed)
        tracker = DiverTracker(DiverConfig(**({} if nothing_stated else stated) | settings))
        if not seed:
            tracker.warm()
            tracker.reset()
        begin, made = time.process_time(), []
        for item in items:
            made.append(tracker.process(item)[-1])
            rows = max(rows, len(tracker._stream.state.life))
        seconds, scans = seconds + time.process_time() - begin, scans + len(items)
        series, truth = series_of(made), true_paths(scene)
        scored.append(score(series, truth, cutoff=cutoff))
        span += scored[-1]['span_s']
        if name == 'crossing':
            kept += identities_kept(series, truth)

    def mean(*names: str) -> float:
        values: list[Any] = scored
        for each in names:
            values = [value[each] for value in values]
        return float(np.mean(values))

    tracks = [each['tracks'] for each in scored]
    return {
        'switches/h': sum(each['identity_switches'] for each in tracks) / span * HOUR,
        'GOSPA, rms': rms([each['gospa']['rms_m'] for each in scored]),
        'with switches': mean('gospa', 'with_switches_m'),
        'completeness': mean('tracks', 'completeness'),
        'RMSE': rms([each['position']['rmse_m'] for each in scored]),
        'NEES': mean('consistency', 'nees_position', 'mean'),
        'false tracks/h': sum(each['false_tracks'] for each in tracks) / span * HOUR,
        'identities kept': float(np.mean(kept)) if kept else None,
        'ms a scan': 1e3 * seconds / scans,
        'rows at most': rows,
    }


def main(
    runs: int = 10,
    scenes: tuple[str, ...] = SCENES,
    associations: tuple[str, ...] = ASSOCIATIONS,
    told: bool = False,
) -> Parts:
    for name in scenes:
        for association in associations:
            count = min(runs, 3) if name == 'harbour' else runs
            found = case(name, count, nothing_stated=not told, association=association)
            table = 'table' if told else 'untold'
            yield {table: {f'{name}, {association}': {'runs': count, **found}}}


if __name__ == '__main__':
    study(main, scenes={'choices': list(SCENES)})
