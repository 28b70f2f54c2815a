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


"""What the bank of behaviours costs on the scene of each behaviour, against that behaviour alone.

    python -m benchmarks.obstacle_regret --runs 20

Bank and single behaviour see the same measurements. Numbers are the RMSE of the vertical offset
when the range first falls to 50, 30 and 20 m, its NEES, and the share of runs in the 90 % band,
over the runs in which all followed the obstacle. `sway .5`, `sway .7` and `sway 1` have that
`sway_std`, m; the sea floor has no behaviour without `fixed`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from benchmarks.obstacle_accuracy import config_of, LEVER, offset_at, RANGES, track
from benchmarks.study import Parts, rms, study, truths
from sonar_imm.trackers.obstacle.config import BEHAVIOURS
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate, TrueObstacle

FIRST = 5000
ROLL = {'roll_rms_deg': 4.0}
WIDE = {'obstacle_sway': 1.0}
FLOOR = {'altitude': 6.0, 'vertical_offset': 5.7, 'offset_spread': 0.5}
BANK: dict[str, dict[str, Any]] = {
    f'bank, sway {std:g}': {'behaviours': BEHAVIOURS, 'sway_std': std} for std in (0.5, 0.7)
}
ALONE: dict[str, dict[str, Any]] = {
    'fixed alone': {'behaviours': ('fixed',)},
    'sway .5 alone': {'behaviours': ('swaying',), 'sway_std': 0.5},
    'sway 1 alone': {'behaviours': ('swaying',), 'sway_std': 1.0},
    'moving alone': {'behaviours': ('moving',)},
    'fixed and sea floor': {'behaviours': ('fixed', 'seabed')},
}
CASES: dict[str, tuple[str, dict[str, Any], tuple[str, ...]]] = {
    'fixed': ('approach', {}, ('fixed alone',)),
    'swaying .5 m': ('swaying', {}, ('sway .5 alone',)),
    'swaying .5 m, roll 4 deg': ('swaying', ROLL, ('sway .5 alone',)),
    'swaying 1 m': ('swaying', WIDE, ('sway .5 alone', 'sway 1 alone')),
    'swaying 1 m, roll 4 deg': ('swaying', {**WIDE, **ROLL}, ('sway 1 alone',)),
    'moving': ('mover', {}, ('moving alone',)),
    'on the sea floor': ('approach', FLOOR, ('fixed and sea floor',)),
}
"""Scene, what differs from it, and the behaviours it is tried with alone."""


def case(name: str, runs: int) -> dict[str, dict[str, float]]:
    kind, changes, single = CASES[name]
    setting = scenario(kind, {**LEVER, 'last_range': 17.5, **changes})
    methods = BANK | {each: ALONE[each] for each in single}
    found: dict[str, list[list[list[float]]]] = {method: [] for method in methods}
    for seed in range(FIRST, FIRST + runs):
        scene = simulate(setting, seed)
        truth = truths(scene, TrueObstacle)[0]
        for method, values in methods.items():
            final = track(scene, config_of(setting, **values))
            at = [offset_at(truth, final, distance) for distance in RANGES]
            found[method].append([each or [np.nan] * 3 for each in at])
    every = {method: np.array(rows) for method, rows in found.items()}
    followed = np.all([np.isfinite(rows[..., 0]) for rows in every.values()], axis=0)
    table: dict[str, dict[str, float]] = {}
    for method, rows in every.items():
        row = table[f'{name}, {method}'] = {}
        for k, distance in enumerate(RANGES):
            error, squared, inside = rows[followed[:, k], k].T
            row[f'RMSE {distance:.0f} m'] = rms(error)
            row[f'NEES {distance:.0f} m'] = float(squared.mean())
            row[f'cover {distance:.0f} m'] = float(inside.mean())
    return table


def main(runs: int = 20, cases: Sequence[str] = tuple(CASES)) -> Parts:
    yield {'runs': runs}
    for name in cases:
        yield {name: case(name, runs)}


if __name__ == '__main__':
    study(main, cases={'choices': list(CASES)})
