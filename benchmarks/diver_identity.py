# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Whose track is whose: two ways to pair fixes and divers on the same scans.

    python -m benchmarks.diver_identity --out docs/results/diver_identity.json

`buddies` is the scene of `diver_named`, `crossing` that of `diver_crossing`; `harbour`: eight
boats on legs of 10 to 30 s at 3 m/s, 2 m on each axis, a scan each 2 s, P_D .9, 20 false fixes in
a square of 400 m.

All are told the detection probability, the density of false fixes and the speed of the boats;
everything else is at its default, `model_set: families` too. In `untold` nobody is told anything.
Counted are confirmed tracks: GOSPA (10 m, 2; of boats 20 m), `with switches` half of the cutoff
for each identity switch; switches for each hour of the scene; false tracks for each hour;
`identities kept` as in `diver_crossing`, `named m` the error of the rows with a name against the
diver of that name in the last minute; `clutter` the density of false fixes that was learnt at the
end, over the true one. CPU of a scan is that of this process. In `single` a diver is alone:
`clean` a swimmer heard every second to 1 m, `usbl` and `wild` as in `diver_families`. `cost` is
of four divers 10 m apart, .7 m on each axis, and two false fixes in a square of 160 m. `recorded`
are the boats of `real_recordings`.
"""

from __future__ import annotations

from itertools import product
import time
from typing import Any

import numpy as np

from benchmarks.diver_crossing import identities_kept, true_paths
from benchmarks.diver_families import mean_over, robust, swimmer, usbl, wild
from benchmarks.diver_named import FALSE, HALF, measured, named_errors, P_DETECTION, truth_of
from benchmarks.real_recordings import boat_scores
from benchmarks.recordings import autoferry, DATA
from benchmarks.study import final_estimates, Parts, rms, study, truths
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm.truth import Scene, TrueTrack
from sonar_imm_tools.evaluation.diver.scoring import score
from sonar_imm_tools.evaluation.diver.series import series_of
from sonar_imm_tools.simulation.diver.simulator import scenario, simulate

ASSOCIATIONS = ('gnn', 'jipda')
SCENES = ('buddies', 'crossing', 'harbour')
ALONE = ('clean', 'usbl', 'usbl, named', 'wild')
HOUR = 3600.0
LEGS: dict[str, Any] = {
    'motion': 'legs',
    'sensor': 'scans',
    'start': [0.0, 0.0],
    'detection_probability': 0.9,
}
"""Scenes of several targets on straight legs."""


def scene_of(name: str, seed: int) -> tuple[list[Any], Scene, dict[str, Any], float]:
    """The measurements, the truth, what the tracker is told, and the cutoff of GOSPA in m."""
    if name == 'buddies':
        truth = truth_of('buddies', seed)
        items: list[Any] = list(measured('buddies', truth, seed))
        stated = {
            'detection_probability': P_DETECTION,
            'clutter_density': FALSE / (2.0 * HALF) ** 2,
        }
        return items, Scene((), truth), stated, 10.0
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
        stated, cutoff = {}, 10.0
    half = values.get('clutter_range', 80.0)
    stated |= {
        'detection_probability': values['detection_probability'],
        'clutter_density': values['clutter'] / (2.0 * half) ** 2,
    }
    return [item.measurement for item in scene.measurements], scene, stated, cutoff


def case(name: str, runs: int, nothing_stated: bool = False, **settings: Any) -> dict[str, Any]:
    """The scores of a way to pair, over all runs of a scene."""
    learnt: list[float] = []
    scored: list[dict[str, Any]] = []
    kept: list[bool] = []
    named: list[float] = []
    seconds, scans, rows, span = 0.0, 0, 0, 0.0
    for seed in range(runs):
        items, scene, stated, cutoff = scene_of(name, seed)
        density = stated['clutter_density']
        tracker = DiverTracker(DiverConfig(**({} if nothing_stated else stated) | settings))
        if not seed:
            tracker.warm()
            tracker.reset()
        begin, made = time.process_time(), []
        for item in items:
            made.append(tracker.process(item)[-1])
            rows = max(rows, len(tracker._stream.state.life))
        seconds, scans = seconds + time.process_time() - begin, scans + len(items)
        if settings['association'] != 'gnn':
            learnt += [
                found.density / density
                for _, found in tracker._stream.state.memory['clutter'].by_sensor
            ]
        series, truth = series_of(made), true_paths(scene)
        scored.append(score(series, truth, cutoff=cutoff))
        span += scored[-1]['span_s']
        late = made[-1].stamp_ns - 60 * 10**9
        named += named_errors((e for e in made if e.stamp_ns >= late), truths(scene, TrueTrack))
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
        'named m': rms(named) if named else None,
        'ms a scan': 1e3 * seconds / scans,
        'rows at most': rows,
        'clutter': float(np.mean(learnt)) if learnt else None,
    }


def single(scene: str, association: str, runs: int) -> dict[str, float]:
    """The scores of a diver who is alone, as `diver_families` counts them."""
    made = {'clean': lambda seed: swimmer(np.random.default_rng(seed), 1.0, 1.0), 'wild': wild}
    name = 7 if scene == 'usbl, named' else None
    path = made.get(scene, usbl)
    found = [robust(path(seed), name=name, association=association) for seed in range(runs)]
    kept = 'rmse_m', 'coverage', 'nees', 'followed', 'tracks'
    return {key: value for key, value in mean_over(found).items() if key in kept}


def recorded(sensor: str, association: str) -> dict[str, float]:
    """The scores of two boats recorded in clutter (`real_recordings`), nothing stated but how good
    the sensor is."""
    items, truth = autoferry(sensor)
    fix_std = 4.0 if sensor == 'radar' else 2.0
    tracker = DiverTracker(DiverConfig(fix_std=fix_std, association=association))
    found = boat_scores(final_estimates(tracker, items), truth)
    return dict(zip(('GOSPA', 'missed', 'false', 'tracks', 'RMSE'), map(float, found)))


def cost(association: str, minutes: int = 10) -> dict[str, float]:
    """What an hour of four divers in clutter costs, from the first minutes of it."""
    values = LEGS | {
        'divers': 4,
        'speed': 0.75,
        'turn_deg': 60.0,
        'duration': 60.0 * minutes,
        'step': 1.0,
        'spacing': 10.0,
        'fix_std': 0.7,
        'clutter': 2.0,
        'clutter_range': 80.0,
    }
    scene = simulate(scenario('table1', values), 3)
    tracker, rows = DiverTracker(DiverConfig(association=association)), 0
    tracker.warm()
    tracker.reset()
    begin = time.process_time()
    for item in scene.measurements:
        tracker.process(item.measurement)
        rows += len(tracker._stream.state.life)
    seconds, count = time.process_time() - begin, len(scene.measurements)
    return {'CPU s per hour': seconds / count * HOUR, 'rows': rows / count}


def main(
    runs: int = 3,
    nothing_stated: int = 10,
    scenes: tuple[str, ...] = SCENES,
    associations: tuple[str, ...] = ASSOCIATIONS,
) -> Parts:
    yield {'runs': runs, 'untold_runs': nothing_stated}
    for name in scenes:
        for association in associations:
            found = case(name, runs, association=association)
            yield {'table': {f'{name}, {association}': found}}
    for name in scenes:
        for association in associations:
            count = runs if name == 'harbour' else nothing_stated
            found = case(name, count, nothing_stated=True, association=association)
            yield {'untold': {f'{name}, {association}': {'runs': count, **found}}}
    for scene in ALONE:
        for association in associations:
            yield {'single': {f'{scene}, {association}': single(scene, association, runs)}}
    if (DATA / 'autoferry').is_dir():
        for sensor, association in product(('radar', 'lidar'), associations):
            yield {'recorded': {f'{sensor}, {association}': recorded(sensor, association)}}
    for association in associations:
        yield {'cost': {association: cost(association)}}


if __name__ == '__main__':
    study(main)
