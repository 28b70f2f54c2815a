# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What of errors of fixes that last can be found out in their first minute.

python -m benchmarks.diver_lasting --runs 100 --out docs/results/diver_lasting.json
"""

from __future__ import annotations

import numpy as np

from benchmarks.diver_sea import FIRST, STATED
from benchmarks.study import Parts, study
from sonar_imm.trackers.diver.tracker import DiverConfig
from sonar_imm_tools.evaluation.diver.predictive import for_tuning, Scored
from sonar_imm_tools.simulation.diver.simulator import scenario, simulate

FALSE_WARNINGS = (0.01, 0.05, 0.1)


def power(runs: int) -> dict[str, float]:
    """What the best test for lasting errors finds in a minute of fixes: the ratio of the
    likelihoods of what is true of them and of nothing, under the motions that the tracker knows.
    No test of these data finds more at the same rate of false warnings (Neyman and Pearson).
    Shares of the scenes with lasting errors, by that rate."""
    ratios = []
    for scene in ({}, {'fix_bias_std': 0.0}):
        found = []
        for seed in range(runs):
            made = simulate(scenario('lasting_errors', {'duration': FIRST, **scene}), seed)
            items = [item.measurement for item in made.measurements]
            log_likelihood = []
            for values in (STATED['lasting_errors'], {}):
                config = DiverConfig(max_tracks=1, **values)
                tracker = Scored(for_tuning(config), items)
                for item in items:
                    tracker.process(item)
                log_likelihood.append(sum(score for score, _ in tracker.scores.values()))
            found.append(log_likelihood[0] - log_likelihood[1])
        ratios.append(np.array(found))
    lasting, nothing = ratios
    levels = np.quantile(nothing, 1.0 - np.array(FALSE_WARNINGS))
    shares = {f'{r:g}': float(np.mean(lasting > x)) for r, x in zip(FALSE_WARNINGS, levels)}
    return {'runs': runs, **shares}


def main(runs: int = 100) -> Parts:
    yield {'power': {'found': power(runs)}}


if __name__ == '__main__':
    study(main)
