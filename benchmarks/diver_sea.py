# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The diver tracker at sea: depth, misplaced instruments, errors that last.

    python -m benchmarks.diver_sea --runs 30 --table depth --out docs/results/diver_sea.json

Every number is that of the whole tracker on simulated scenes, from the first fix through track
logic, one diver known to be there (`max_tracks: 1`). RMSE is horizontal, from 10 s on; NEES is of
the horizontal position (2 is due), for depth also of all three coordinates (3 is due).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.study import final_estimates, first_track, Parts, study, truths
from sonar_imm.estimates import Estimate
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm.truth import Scene, TrueTrack
from sonar_imm_tools.simulation.diver.simulator import scenario, simulate

SETTLED = 10.0
"""Seconds from the start that are not scored."""

Values = Mapping[str, Any]
Cells = list[tuple[str, str, str, Values, Values]]
"""Row, column, scenario, what it changes, parameters."""


def score(scene: Scene, config: DiverConfig) -> np.ndarray:
    """Rows (k, 4) of squared horizontal error, horizontal NEES, squared depth error and whole
    NEES; the last two NaN where depth is no state. A stamp without a track gives NaN."""
    final = final_estimates(DiverTracker(config), (i.measurement for i in scene.measurements))
    return score_of(final, scene)


def score_of(final: Mapping[int, Estimate], scene: Scene) -> np.ndarray:
    """As `score`, of estimates by stamp."""
    track = truths(scene, TrueTrack)[0]
    rows: list[list[Any]] = []
    for k, stamp in enumerate(track.stamp_ns.tolist()):
        if (stamp - track.stamp_ns[0]) * 1e-9 < SETTLED or stamp not in final:
            continue
        estimate = final[stamp]
        if (found := first_track(estimate, track.position[k, :2])) is None:
            rows.append([np.nan] * 4)
            continue
        error, flat = found
        deep = whole = np.nan
        if 'pz' in estimate.state_names:
            found = first_track(estimate, track.position[k, :3])
            assert found is not None
            deep, whole = found[0][2] ** 2, found[1]
        rows.append([error @ error, flat, deep, whole])
    return np.array(rows)


def errors(scene: Values, config: Values, runs: int, name: str) -> dict[str, Any]:
    """RMSE and NEES over `runs` scenes. `scene` and `config` may hold functions of the run."""
    rows: list[np.ndarray] = []
    for seed in range(1000, 1000 + runs):
        made = simulate(scenario(name, scene), seed)
        values = {key: v(made) if callable(v) else v for key, v in config.items()}
        # What is assumed of instruments is judged in the table of what is not stated.
        exact = not any(values.get(name) for name in OFF)
        values = {'model_set': 'heading_speed', **values}
        values |= {'systematic_errors': 'exact'} if exact else {}
        rows.append(score(made, DiverConfig(max_tracks=1, **values)))
    every = np.concatenate(rows)
    seen = np.isfinite(every[:, 0])
    mean = every[seen].mean(axis=0)
    return {
        'rmse': float(np.sqrt(mean[0])),
        'nees': float(mean[1]),
        'rmse_depth': float(np.sqrt(mean[2])),
        'nees_3d': float(mean[3]),
        'without_track': float(1.0 - seen.mean()),
    }


def middle_depth(scene: Scene) -> float:
    return float(truths(scene, TrueTrack)[0].position[:, 2].mean())


def depth_cells() -> Cells:
    rows = {
        '2, 5, 8, 12 m': (2.0, 5.0, 8.0, 12.0),
        '5 m': (5.0,) * 4,
        '0 m': (0.0,) * 4,
    }
    divers: dict[str, Values] = {
        'U(1, 19) m, swell': {'depth': (1.0, 19.0), 'swell_height': 1.0},
        '10 m': {'depth': (10.0, 10.0)},
    }
    configs: dict[str, tuple[Values, Values]] = {
        'told 0 m': ({}, {}),
        'told its depth without swell': ({}, {'target_z': middle_depth}),
        'pressure, .2 m': ({'depth_std': 0.2}, {'dimensions': 3}),
        'depth bank': ({}, {'dimensions': 3}),
    }
    cells: Cells = [
        (f'{row}, diver {diver}', column, 'multistatic', {'receiver_depths': at, **swims, **more},
         config)
        for row, at in rows.items()
        for diver, swims in divers.items()
        for column, (more, config) in configs.items()
    ]  # fmt: skip
    # How well depth is seen hangs on where the diver swims: not turned about the transmitter, from
    # the middle of the receivers, and along a line that passes near the transmitter.
    for where, start in {
        'from the middle': (10.0, 30.0),
        'past the transmitter': (-40.0, 40.0),
    }.items():
        for row, at in rows.items():
            scene = {'receiver_depths': at, **divers['U(1, 19) m, swell']}
            scene |= {'random_rotation': False, 'start': start}
            cells.append(
                (f'{row}, {where}', 'depth bank', 'multistatic', scene, {'dimensions': 3})
            )
    return cells


def systematic_cells() -> Cells:
    off: dict[str, Values] = {
        'receivers': {'receiver_position_std': 1.0},
        'clocks': {'receiver_clock_std': 5e-4},
        'sound': {'sound_speed_std': 5.0},
    }
    every: Values = {key: value for error in off.values() for key, value in error.items()}
    cells: Cells = []
    for row, scene in {'nothing, told all three': {}, **off, 'all': every}.items():
        stated = scene or every
        for column, config in {
            'ignore': {},
            'consider': {**stated, 'systematic_errors': 'consider'},
            'mixed': {**stated, 'systematic_errors': 'mixed'},
            'estimate': {**stated, 'systematic_errors': 'estimate'},
        }.items():
            cells.append((row, column, 'multistatic', scene, config))
    return cells


def lasting_cells() -> Cells:
    cells: Cells = []
    for std, tau, white in ((1.0, 60.0, 0.5), (2.0, 60.0, 0.05), (2.0, 600.0, 0.05),
                            (1.0, 10.0, 0.5)):  # fmt: skip
        scene = {'fix_bias_std': std, 'fix_bias_time': tau, 'fix_std': white}
        total = (std**2 + white**2) / white**2
        bias = {'fix_bias_std': std}
        for column, config in {
            'white part alone stated': {},
            'stated total, as white': {'covariance_scale': total},
            'its variance x 6': {'covariance_scale': 6.0 * total},
            'Gauss-Markov, right': {**bias, 'fix_bias_time': tau},
            'tau x 3': {**bias, 'fix_bias_time': 3.0 * tau},
            'tau / 3': {**bias, 'fix_bias_time': tau / 3.0},
        }.items():
            cells.append((f'{std:g} m, {tau:g} s, {white:g} m', column, 'lasting_errors', scene,
                          config))  # fmt: skip
    return cells


UNTOLD = 'untold'
FIRST, GOOD_NEES = 60.0, 4.0
"""Seconds within which what is not stated has to warn, and the mean NEES that needs no warning."""
OFF: Values = {
    'receiver_position_std': 1.0,
    'receiver_clock_std': 5e-4,
    'sound_speed_std': 5.0,
}
STATED: dict[str, Values] = {
    'multistatic': {},
    'at_depth': {'dimensions': 3},
    'misplaced_receivers': OFF,
    'lasting_errors': {'fix_bias_std': 1.0},
}


def warned(name: str, config: Values, runs: int) -> dict[str, Any]:
    """Of the first minute of `runs` scenes with default parameters and `config`: how many warn,
    after what time in the median, how many have a mean NEES of `GOOD_NEES` at most, and how many
    either."""
    after, nees = [], []
    for seed in range(runs):
        made = simulate(scenario(name, {'duration': FIRST}), seed)
        tracker, when = DiverTracker(DiverConfig(**config)), np.nan
        first = made.measurements[0].measurement.stamp_ns
        final: dict[int, Any] = {}
        for item in made.measurements:
            estimates = tracker.process(item.measurement)
            final.update((each.stamp_ns, each) for each in estimates)
            if np.isnan(when) and tracker.warnings():
                when = (item.measurement.stamp_ns - first) * 1e-9
        after.append(when)
        nees.append(float(np.nanmean(score_of(final, made)[:, 1])))
    good = np.array(nees) <= GOOD_NEES
    return {
        'runs': runs,
        'warn': int(np.isfinite(after).sum()),
        'after s': float(np.nanmedian(after)) if np.isfinite(after).any() else None,
        'NEES good': int(good.sum()),
        'either': int((good | np.isfinite(after)).sum()),
        'NEES': nees,
    }


TABLES = {
    'depth': depth_cells,
    'systematic': systematic_cells,
    'lasting': lasting_cells,
}


def main(runs: int = 30, table: Sequence[str] | None = None, only: str = '') -> Parts:
    if table != [UNTOLD]:
        yield {'runs': runs}  # the table of what is not stated has its own
    for name in table or TABLES:
        if name == UNTOLD:
            for scene_name, config in STATED.items():
                for column, given in {'nothing stated': {}, 'stated': config}.items():
                    row = f'{scene_name}, {column}'
                    if only in row and (given or column != 'stated'):
                        yield {name: {row: warned(scene_name, given, runs)}}
            continue
        for row, column, scene_name, scene, config in TABLES[name]():
            if only in row + column:
                yield {name: {row: {column: errors(scene, config, runs, scene_name)}}}


if __name__ == '__main__':
    study(
        main,
        shown=lambda row: {k: value for k, value in row.items() if not isinstance(value, list)},
        table={'action': 'append', 'choices': [*TABLES, UNTOLD]},
        only={'help': 'columns or rows whose name holds this'},
    )
