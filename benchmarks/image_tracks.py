# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Images, detector, tracker: how well the offset is known, and whether the covariance is right.

    python -m benchmarks.image_tracks --runs 62 --out docs/results/image_tracks.json
    python -m benchmarks.image_tracks --runs 24 --first 1001 --cases beam --centre 0 .1 .2 .4

Each run is the scene `images` under a seed of its own, through `fls_detector_node`'s detector and
the whole tracker, scored as `sonar-imm evaluate` does. NEES are means over a run, then over the
runs: right are 1 for one number and 3 for range, bearing and offset together, if the truth is
drawn as the tracker believes it to be. In the scene it never is, as the obstacle always lies 3 m
below; `over the beam` draws it over what the first images can show.
`--centre` tracks the same detections with other shares of `bodies.CENTRE`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from attrs import evolve
import numpy as np

from benchmarks.obstacle_sea import truth_tables
from benchmarks.study import final_estimates, Parts, study, truths
from sonar_imm.measurements import Measurement, SonarImage
from sonar_imm.trackers.obstacle import bodies
from sonar_imm.trackers.obstacle.config import ObstacleConfig
from sonar_imm.trackers.obstacle.detector import DetectorConfig, ImageDetector
from sonar_imm.trackers.obstacle.tracker import ObstacleTracker
from sonar_imm.truth import Scene
from sonar_imm_tools.evaluation.obstacle.scoring import motion_metrics, score
from sonar_imm_tools.evaluation.obstacle.series import series_of, truth_of
from sonar_imm_tools.simulation.obstacle.simulator import (
    ObstacleScenario,
    scenario,
    simulate,
    TrueObstacle,
)

_POINT = {'target': 'point', 'target_snr_db': 18.0}
_OVER_THE_BEAM = {'vertical_offset': 0.0, 'offset_spread': 5.5}
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    'float, 3 m below': ('images', {}),
    'float, over the beam': ('images', _OVER_THE_BEAM),
    'point of 18 dB, 3 m below': ('images', _POINT),
    'point of 18 dB, over the beam': ('images', {**_POINT, **_OVER_THE_BEAM}),
    'chain, rough sea floor': ('rough_chain', {}),
    'wreck on a rough sea floor': ('rough_wreck', {}),
}
"""Scene, and what differs from it."""
NUMBERS = ('range', 'bearing', 'offset')


def detected(setting: ObstacleScenario, given: list[Measurement]) -> list[Measurement]:
    """The measurements of a scene with detections in place of its images."""
    feeder = setting.feeder_instruments()
    detector = ImageDetector(
        DetectorConfig(
            beam_width_deg=feeder['beam_width_deg'], range_resolution=feeder['range_resolution']
        )
    )
    found = [detector.process(item) if isinstance(item, SonarImage) else item for item in given]
    return [item for item in found if item is not None]


def tracked(
    setting: ObstacleScenario, scene: Scene, measurements: list[Measurement]
) -> dict[str, float]:
    """The scores of one run."""
    config = evolve(ObstacleConfig(), max_range=setting.max_range)
    final = final_estimates(ObstacleTracker(config), measurements)
    truth = truth_of(
        [table for true in truths(scene, TrueObstacle) for table in truth_tables(true)]
    )
    metrics, found = score(series_of(final.values()), truth, cutoff=5.0, gap=60.0)
    tracks, near = metrics['tracks'], metrics['vertical_offset_near']
    row = {
        'found': tracks['found_obstacles'] / tracks['true_obstacles'],
        'tracks': float(tracks['tracks']),
        'false tracks': float(tracks['false_tracks']),
    }
    if found is None or not near['n']:
        return row
    covariance = found.series.covariance[found.row]
    alone = np.mean(found.error**2 / np.diagonal(covariance, axis1=1, axis2=2), axis=0)
    row |= {'RMSE within 50 m': near['rmse_m']}
    row |= {f'NEES {name}': float(value) for name, value in zip(NUMBERS, alone)}
    row |= {
        'NEES state': metrics['consistency']['nees_state']['mean'],
        'cover': metrics['consistency']['band_coverage'],
    }
    if collisions := motion_metrics(found, truth, config).get('collisions'):
        row |= {'Brier': collisions['brier'], 'happened': collisions['happened']}
    return row


def summary(rows: list[dict[str, float]]) -> dict[str, float]:
    table = {
        name: float(np.mean([row.get(name, np.nan) for row in rows if name in row]))
        for name in max(rows, key=len)
    }
    table |= {'runs': float(len(rows))}
    rmse = np.array([row['RMSE within 50 m'] for row in rows if 'RMSE within 50 m' in row])
    nees = np.array([row['NEES state'] for row in rows if 'NEES state' in row])
    if len(rmse):
        table['RMSE median'] = float(np.median(rmse))
        table['RMSE of all'] = float(np.sqrt(np.mean(rmse**2)))
        table['NEES state, worst'] = float(nees.max())
        table['NEES state, error'] = float(nees.std() / np.sqrt(len(nees)))
    return table


def main(
    runs: int = 62,
    first: int = 1,
    cases: Sequence[str] = ('',),
    centre: Sequence[float] = (bodies.CENTRE,),
) -> Parts:
    yield {'first seed': first}
    for name, (kind, changes) in CASES.items():
        if not any(part in name for part in cases):
            continue
        setting = scenario(kind, changes)
        rows: dict[float, list[dict[str, float]]] = {share: [] for share in centre}
        for seed in range(first, first + runs):
            scene = simulate(setting, seed)
            measurements = detected(setting, [item.measurement for item in scene.measurements])
            for share, each in rows.items():
                bodies.CENTRE = share
                each.append(tracked(setting, scene, measurements))
        for share, each in rows.items():
            yield {name if len(rows) == 1 else f'{name}, centre {share:g}': summary(each)}


if __name__ == '__main__':
    study(
        main,
        digits=2,
        first={'help': 'first seed'},
        cases={'help': 'parts of names of cases'},
    )
