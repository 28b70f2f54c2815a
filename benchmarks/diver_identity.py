# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Whose track is whose: three ways to pair fixes and divers on the same scans.

    python -m benchmarks.diver_identity --runs 3 --out docs/results/diver_identity.json

`buddies` (see `diver_named`): two divers 2 m apart, a scan per second, .5 m on each axis, P_D .9,
two false fixes in a square of 120 m; from the 20th second on the transponder of the first is heard
every four seconds, good to 2 m. `crossing` (see `diver_crossing`): two pairs of divers that cross
within a metre, .7 m on each axis, P_D .7, 10 false fixes in a square of 160 m. `harbour`: eight
boats on legs of 10 to 30 s at 3 m/s, 2 m on each axis, a scan each 2 s, P_D .9, 20 false fixes in
a square of 400 m.

All are told the detection probability, the density of false fixes and the speed of the boats;
everything else is at its default, `model_set: families` too. Counted are confirmed tracks: GOSPA
(10 m, 2; of boats 20 m), `with switches` half of the cutoff for each identity switch; switches for
each hour of the scene; false tracks for each hour; `identities kept` as in `diver_crossing`,
`named m` the error of the rows with a name against the diver of that name in the last minute. CPU
of a scan is that of this process. `hypotheses` repeats `buddies` with other numbers of hypotheses
and `model_set: heading_speed`.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from benchmarks.diver_crossing import identities_kept, true_paths
from benchmarks.diver_named import FALSE, HALF, measured, named_errors, P_DETECTION, truth_of
from benchmarks.study import Parts, rms, study, truths
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm.truth import Scene, TrueTrack
from sonar_imm_tools.evaluation.diver.scoring import score
from sonar_imm_tools.evaluation.diver.series import series_of
from sonar_imm_tools.simulation.diver.simulator import scenario, simulate

ASSOCIATIONS = ('gnn', 'jipda', 'kbest')
SCENES = ('buddies', 'crossing', 'harbour')
COUNTS = (1, 10, 30)
HOUR = 3600.0


def scene_of(name: str, seed: int) -> tuple[list[Any], Scene, dict[str, Any], float]:
    """The measurements, the truth, what the tracker is told, and the cutoff of GOSPA in m."""
    if name == 'buddies':
        truth = truth_of('buddies', seed)
        items: list[Any] = list(measured('buddies', truth, seed))
        told = {
            'detection_probability': P_DETECTION,
            'clutter_density': FALSE / (2.0 * HALF) ** 2,
        }
        return items, Scene((), truth), told, 10.0
    if name == 'harbour':
        values: dict[str, Any] = {
            'motion': 'legs',
            'sensor': 'scans',
            'divers': 8,
            'speed': 3.0,
            'start': [0.0, 0.0],
            'turn_deg': 180.0,
            'leg_min': 10.0,
            'leg_max': 30.0,
            'duration': 300.0,
            'step': 2.0,
            'spacing': 30.0,
            'detection_probability': 0.9,
            'fix_std': 2.0,
            'clutter': 20.0,
            'clutter_range': 200.0,
        }
        scene = simulate(scenario('table1', values), seed)
        told = {'speed_mean': 3.0, 'speed_std': 1.0, 'velocity_std': 2.5}
        cutoff = 20.0
    else:
        values = {'detection_probability': 0.7, 'clutter': 10.0}
        scene = simulate(scenario('crossing', values), seed)
        told, cutoff = {}, 10.0
    half = values.get('clutter_range', 80.0)
    told |= {
        'detection_probability': values['detection_probability'],
        'clutter_density': values['clutter'] / (2.0 * half) ** 2,
    }
    return [item.measurement for item in scene.measurements], scene, told, cutoff


def case(name: str, runs: int, **settings: Any) -> dict[str, Any]:
    """The scores of a way to pair, over all runs of a scene."""
    scored: list[dict[str, Any]] = []
    kept: list[bool] = []
    named: list[float] = []
    seconds, scans, rows, span = 0.0, 0, 0, 0.0
    for seed in range(runs):
        items, scene, told, cutoff = scene_of(name, seed)
        tracker = DiverTracker(DiverConfig.from_mapping(told | settings))
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
    }


def main(
    runs: int = 3,
    scenes: tuple[str, ...] = SCENES,
    associations: tuple[str, ...] = ASSOCIATIONS,
    counts: tuple[int, ...] = COUNTS,
) -> Parts:
    yield {'runs': runs}
    for name in scenes:
        for association in associations:
            found = case(name, runs, association=association)
            yield {'table': {f'{name}, {association}': found}}
    for count in counts:
        settings = {'hypotheses': count, 'model_set': 'heading_speed'}
        yield {'hypotheses': {str(count): case('buddies', runs, association='kbest', **settings)}}


if __name__ == '__main__':
    study(main)
