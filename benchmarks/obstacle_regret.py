# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""What the bank of behaviours costs on the scene of each behaviour, against that behaviour alone.

    python -m benchmarks.obstacle_regret --out docs/results/obstacle_regret.json

Bank and single behaviour see the same measurements, of `OBSTACLES` one behind the other in each
scene: as many errors from a third of the time. Numbers are the RMSE of the vertical offset
when the range first falls to 50, 30 and 20 m, its NEES, and the share of runs in the 90 % band,
over the obstacles that all followed. `regret` is by how much the RMSE of a bank is
above that of the true behaviour alone, told how far it sways: the sea floor has no behaviour
without `fixed`. Banks differ in `sway_std`, m. `--jobs` cases are run at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import Any

import numpy as np

from benchmarks.obstacle_accuracy import config_of, LEVER, offset_at, RANGES, track
from benchmarks.study import Parts, rms, study, truths
from sonar_imm.trackers.obstacle.config import BEHAVIOURS
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate, TrueObstacle

OBSTACLES, SPACING = 4, 12.0
"""In a scene, and m from one to the next."""
ROLL = {'roll_rms_deg': 4.0}
WIDE = {'obstacle_sway': 1.0}
FLOOR = {'altitude': 6.0, 'vertical_offset': 5.7, 'offset_spread': 0.5}
SWAYS = {'behaviours': ('swaying',), 'sway_std': 0.5}
CASES: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    'fixed': ('approach', {}, {'behaviours': ('fixed',)}),
    'swaying .5 m': ('swaying', {}, SWAYS),
    'swaying .5 m, roll 4 deg': ('swaying', ROLL, SWAYS),
    'swaying 1 m': ('swaying', WIDE, {**SWAYS, 'sway_std': 1.0}),
    'swaying 1 m, roll 4 deg': ('swaying', {**WIDE, **ROLL}, {**SWAYS, 'sway_std': 1.0}),
    'moving': ('mover', {}, {'behaviours': ('moving',)}),
    'on the sea floor': ('approach', FLOOR, {'behaviours': ('fixed', 'seabed')}),
}
"""Scene, what differs from it, and the behaviour that is the true one, alone."""


def case(
    name: str, scenes: int, first: int, sways: Sequence[float]
) -> tuple[dict[str, dict[str, float]], dict[str, float]]:
    """Numbers by method, and the regret of each bank at each range."""
    kind, changes, single = CASES[name]
    several = {
        'obstacles': OBSTACLES,
        'spacing': SPACING,
        'last_range': 17.5 - SPACING * (OBSTACLES - 1),
    }
    setting = scenario(kind, {**LEVER, **several, **changes})
    methods = {'alone': single}
    for std in sways:
        methods[f'bank {std:g}'] = {'behaviours': BEHAVIOURS, 'sway_std': std}
    found: dict[str, list[list[list[float]]]] = {method: [] for method in methods}
    for seed in range(first, first + scenes):
        scene = simulate(setting, seed)
        for method, values in methods.items():
            final = track(scene, config_of(setting, **values))
            for truth in truths(scene, TrueObstacle):
                at = [offset_at(truth, final, distance) for distance in RANGES]
                found[method].append([each or [np.nan] * 3 for each in at])
    every = {method: np.array(rows) for method, rows in found.items()}
    followed = np.all([np.isfinite(rows[..., 0]) for rows in every.values()], axis=0)
    table: dict[str, dict[str, float]] = {}
    regret: dict[str, float] = {}
    for method, rows in every.items():
        row = table[method] = {}
        for k, distance in enumerate(RANGES):
            # A mover comes within 20 m of few vehicles.
            if 4 * np.count_nonzero(followed[:, k]) < len(followed):
                continue
            error, squared, inside = rows[followed[:, k], k].T
            row[f'RMSE {distance:.0f} m'] = rms(error)
            row[f'NEES {distance:.0f} m'] = float(squared.mean())
            row[f'cover {distance:.0f} m'] = float(inside.mean())
            if method != 'alone':
                ratio = rms(error) / table['alone'][f'RMSE {distance:.0f} m']
                regret[f'{method}, {distance:.0f} m'] = ratio - 1.0
    return table, regret


def main(
    scenes: int = 10,
    first: int = 9000,
    sways: Sequence[float] = (0.5,),
    cases: Sequence[str] = tuple(CASES),
    jobs: int = 1,
) -> Parts:
    yield {'obstacles': OBSTACLES * scenes, 'first': first}
    numbers = partial(case, scenes=scenes, first=first, sways=sways)
    with ProcessPoolExecutor(jobs) as pool:
        for name, (table, regret) in zip(cases, pool.map(numbers, cases)):
            yield {'methods': {name: table}, 'regret': {name: regret}}


if __name__ == '__main__':
    study(main, first={'help': 'first seed'}, cases={'choices': list(CASES)})
