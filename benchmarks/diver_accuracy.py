# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Accuracy of the whole diver tracker on simulated scenes, with gating and track logic.

    python -m benchmarks.diver_accuracy --runs 60 --out docs/results/diver_accuracy.json

`heading_speed` is the set after the paper; other programs on its scenes are in `diver_paper`. RMSE
is over all stamps from the first fix on.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.study import final_estimates, first_track, Parts, study, truths
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm.truth import TrueTrack
from sonar_imm_tools.simulation.diver.simulator import scenario, simulate


def whole_tracker(runs: int, **values: Any) -> dict[str, dict[str, float]]:
    """Gating, track logic and all, defaults but for `values`: RMSE of the confirmed track, scans
    without one, identities."""
    table = {}
    for name in ('table1', 'irregular', 'multistatic', 'multistatic_fixes'):
        squared, absent, names, total = [], 0, [], 0
        for seed in range(runs):
            scene = simulate(scenario(name), seed)
            measurements = [item.measurement for item in scene.measurements]
            tracker = DiverTracker(DiverConfig(max_tracks=1, **values))
            final = final_estimates(tracker, measurements)
            path = truths(scene, TrueTrack)[0]
            at = {int(stamp): k for k, stamp in enumerate(path.stamp_ns)}
            ids = set()
            for stamp, estimate in final.items():
                found = first_track(estimate, path.position[at[stamp], :2])
                total += 1
                absent += found is None
                if found is not None:
                    confirmed = estimate.extras['track_state'] > 0
                    ids.add(int(estimate.extras['track_id'][confirmed][0]))
                    squared.append(found[0] @ found[0])
            names.append(len(ids))
        table[name] = {
            'RMSE': float(np.sqrt(np.mean(squared))),
            'unconfirmed scans': absent / total,
            'identities': float(np.mean(names)),
        }
    return table


def main(runs: int = 60) -> Parts:
    yield {'runs': runs}
    yield {'the whole tracker': whole_tracker(runs, model_set='heading_speed')}
    yield {'the whole tracker, by default': whole_tracker(runs)}


if __name__ == '__main__':
    study(main)
