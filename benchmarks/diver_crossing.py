# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Divers that cross in clutter: hard and soft association on the same scans.

    python -m benchmarks.diver_crossing --runs 16 --out docs/results/diver_crossing.json

Four divers, two pairs crossing within a metre (`simulate diver --scenario crossing`), a scan of
fixes per second, .7 m on each axis, 160 m square, 120 scans. Both are told the detection
probability and the density of false fixes; everything else is at its default. GOSPA (10 m, 2)
counts confirmed tracks that are published. An identity is kept where both divers of a pair have
the same track in scans 90 to 97 as in scans 32 to 39.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from benchmarks.study import Parts, rms, study
from sonar_imm.estimates import Estimate
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm.truth import Scene
from sonar_imm_tools.evaluation.diver.matching import match
from sonar_imm_tools.evaluation.diver.scoring import score
from sonar_imm_tools.evaluation.diver.series import Series, series_of, Truth
from sonar_imm_tools.simulation.diver.simulator import scenario, simulate

CASES = ((0.9, 2.0), (0.9, 10.0), (0.7, 2.0), (0.7, 10.0))
ASSOCIATIONS = ('gnn', 'jipda')
CUTOFF = 10.0
BEFORE, AFTER = slice(32, 40), slice(90, 98)
HOUR = 3600.0


def true_paths(scene: Scene) -> Truth:
    tables = [table for true in scene.truth for table in true.tables('map')]
    rows = [
        Estimate.from_columns(table.columns, stamp_ns=table.stamp_ns, frame_id='map')
        for table in tables
    ]
    return Truth.from_series(series_of(rows))


def track(scene: Scene, config: DiverConfig) -> tuple[Series, float]:
    """The estimates, and the CPU seconds they took."""
    tracker = DiverTracker(config)
    begin = time.process_time()
    made = [tracker.process(item.measurement)[-1] for item in scene.measurements]
    return series_of(made), time.process_time() - begin


def identities_kept(series: Series, truth: Truth) -> list[bool]:
    """For each pair whether both divers have the same track before and after they crossed."""
    followed = match(series.confirmed(), truth, cutoff=CUTOFF).followed_by
    before, after = ([_usual(row[when]) for row in followed] for when in (BEFORE, AFTER))
    same = [first == last and first >= 0 for first, last in zip(before, after)]
    return [same[k] and same[k + 1] for k in range(0, len(same), 2)]


def _usual(ids: np.ndarray) -> int:
    found, counts = np.unique(ids[ids >= 0], return_counts=True)
    return int(found[counts.argmax()]) if len(found) else -1


def scans_to_confirm(series: Series, truth: Truth) -> list[float]:
    """For each diver the number of the first scan with a confirmed track on it, from 0."""
    followed = match(series.confirmed(), truth, cutoff=CUTOFF).followed_by
    return [float(np.flatnonzero(row >= 0)[0]) for row in followed if (row >= 0).any()]


def case(probability: float, clutter: float, association: str, runs: int) -> dict[str, float]:
    config = DiverConfig.from_mapping(
        {
            'model_set': 'heading_speed',
            'association': association,
            'detection_probability': probability,
            'clutter_density': clutter / 160.0**2,
        }
    )
    DiverTracker(config).warm()
    scored: list[dict[str, Any]] = []
    kept: list[bool] = []
    confirmed: list[float] = []
    seconds, scans = 0.0, 0
    for seed in range(runs):
        scene = simulate(
            scenario('crossing', {'detection_probability': probability, 'clutter': clutter}), seed
        )
        truth = true_paths(scene)
        series, spent = track(scene, config)
        seconds, scans = seconds + spent, scans + len(scene.measurements)
        scored.append(score(series, truth, cutoff=CUTOFF))
        kept += identities_kept(series, truth)
        confirmed += scans_to_confirm(series, truth)

    def mean(*names: str) -> float:
        values: list[Any] = scored
        for name in names:
            values = [each[name] for each in values]
        return float(np.mean(values))

    return {
        'GOSPA, rms': rms([each['gospa']['rms_m'] for each in scored]),
        'with switches': mean('gospa', 'with_switches_m'),
        'GOSPA, mean': mean('gospa', 'mean_m'),
        'RMSE': rms([each['position']['rmse_m'] for each in scored]),
        'NEES': mean('consistency', 'nees_position', 'mean'),
        'identities kept': float(np.mean(kept)),
        'false tracks/h': sum(each['tracks']['false_tracks'] for each in scored) / scans * HOUR,
        'scans to confirm': float(np.mean(confirmed)),
        'ms a scan': 1e3 * seconds / scans,
    }


def main(runs: int = 16) -> Parts:
    yield {'runs': runs}
    for probability, clutter in CASES:
        for association in ASSOCIATIONS:
            name = f'P_D {probability}, {clutter:g} false, {association}'
            yield {'table': {name: case(probability, clutter, association, runs)}}


if __name__ == '__main__':
    study(main)
