# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Divers that are heard by name and seen without one: one track or two?

    python -m benchmarks.diver_named --runs 8 --out docs/results/diver_named.json

Two divers swim legs at .75 m/s for 120 s (`simulate diver`). A sonar sees them without names: a
scan per second, .5 m on each axis, P_D .9, two false fixes in a square of 120 m. Transponders are
heard in turn from the 20th second on, each every four seconds, good to 2 m. In `apart` they are
30 m apart and both have a transponder; in `buddies` they swim the same way 2 m apart, and only the
first has one. GOSPA (10 m, 2) counts confirmed tracks. The scenes and the tracker were not tuned
on this; the scans before two tracks are one follow from P_D (`names.patience`).
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import product
from typing import Any

import numpy as np

from benchmarks.diver_crossing import true_paths
from benchmarks.study import mean_of, Parts, rms, study, truths
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Fix, Fixes
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm.truth import Scene, TrueTrack
from sonar_imm_tools.evaluation.diver.scoring import score
from sonar_imm_tools.evaluation.diver.series import series_of
from sonar_imm_tools.simulation.diver.simulator import scenario, simulate

SCENES = ('apart', 'buddies')
HALF, FALSE, SCAN_STD, NAMED_STD, P_DETECTION = 60.0, 2.0, 0.5, 2.0, 0.9
NAMED_FROM, EVERY = 20, 4


def truth_of(scene: str, seed: int) -> tuple[TrueTrack, ...]:
    """The paths of the two divers."""
    values: dict[str, Any] = {
        'duration': 120.0,
        'speed': 0.75,
        'start': [-20.0, 0.0],
        'turn_deg': 60.0,
    }
    values |= {'divers': 2, 'spacing': 30.0} if scene == 'apart' else {}
    made = truths(simulate(scenario('table1', values), seed), TrueTrack)
    first = made[0]
    if scene == 'apart':
        return made
    aside = first.position + [0.0, 2.0, *([0.0] * (first.position.shape[1] - 2))]
    return first, TrueTrack(2, first.stamp_ns, aside, first.velocity)


def measured(scene: str, truth: tuple[TrueTrack, ...], seed: int) -> list[Fix | Fixes]:
    """Scans without names and fixes with names, in order."""
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
        speaks = (k - NAMED_FROM) % EVERY // 2
        if k < NAMED_FROM or (k - NAMED_FROM) % 2 or (scene == 'buddies' and speaks):
            continue
        place = truth[speaks].position[k, :2] + rng.normal(scale=NAMED_STD, size=2)
        measurements.append(
            Fix(
                stamp_ns=stamp + 300_000_000,
                position=[*place, 0.0],
                covariance=np.eye(2) * NAMED_STD**2,
                target_id=truth[speaks].track_id,
                frame_id='map',
            )
        )
    return measurements


def named_errors(made: Iterable[Estimate], truth: Iterable[TrueTrack]) -> list[float]:
    """Errors in m of the rows with a name, against the diver of that name."""
    paths = {path.track_id: path for path in truth}
    error = []
    for estimate in made:
        for row in np.flatnonzero(estimate.extras['target_id'] >= 0):
            own = paths[int(estimate.extras['target_id'][row])]
            at = [
                np.interp(estimate.stamp_ns, own.stamp_ns, own.position[:, axis])
                for axis in (0, 1)
            ]
            error.append(float(np.hypot(*(estimate.state[row, :2] - at))))
    return error


def run(scene: str, association: str, seed: int) -> dict[str, float]:
    """The scores of one run."""
    truth = truth_of(scene, seed)
    config = DiverConfig(
        model_set='heading_speed',
        association=association,
        detection_probability=P_DETECTION,
        clutter_density=FALSE / (2.0 * HALF) ** 2,
    )
    tracker = DiverTracker(config)
    made = [tracker.process(item)[-1] for item in measured(scene, truth, seed)]
    over = truth[0].stamp_ns[-1]
    error = named_errors([each for each in made[-120:] if each.stamp_ns <= over], truth)
    found = score(series_of(made), true_paths(Scene((), truth)), cutoff=10.0)
    hours = found['span_s'] / 3600.0
    return {
        'gospa_m': found['gospa']['rms_m'],
        'rmse_m': found['position']['rmse_m'],
        'named_rmse_m': rms(error),
        'tracks': float(found['tracks_confirmed']),
        'switches_per_hour': found['tracks']['identity_switches'] / hours,
    }


def main(runs: int = 8) -> Parts:
    yield {'runs': runs}
    for scene, association in product(SCENES, ('gnn', 'jipda')):
        scores = mean_of([run(scene, association, seed) for seed in range(runs)])
        yield {'rows': [{'scene': scene, 'association': association} | scores]}


if __name__ == '__main__':
    study(main, digits=2)
