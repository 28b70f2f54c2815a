# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Obstacles that stay, sway, move or lie on the sea floor: accuracy with and without behaviours.

    python -m benchmarks.obstacle_sea --runs 100 --out docs/results/obstacle_sea.json

Each run is the whole tracker: gating, confirmation, track logic. `fixed` holds every obstacle for
fixed, `all` has the default behaviours; both see the same measurements. Errors are those of the
vertical offset when the range first falls to 50, 30 and 20 m, of the track that is confirmed and
nearest, at most 5 m off; `lost` counts the runs without one. P is the mean probability of each
behaviour at 30 m, v the RMSE of the velocity of each axis there.
`velocity` is the RMSE of the velocity of each axis at times after an obstacle is seen first or,
while it is followed, begins to move or stops, of those in the beam.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from benchmarks.obstacle_accuracy import (
    config_of,
    first_at,
    followed,
    LEVER,
    offset_at,
    RANGES,
    summary,
    track,
)
from benchmarks.study import Parts, rms, study, truths
from sonar_imm.estimates import Estimate
from sonar_imm.trackers.obstacle.config import BEHAVIOURS
from sonar_imm_tools.simulation.obstacle.scenario import SCENARIOS
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate, TrueObstacle

CALM = {
    name: value
    for name, value in SCENARIOS['calm'][1].items()
    if name not in ('vertical_offset', 'offset_spread')
}
FLOOR = {'altitude': 6.0}
"""The sonar of the study is 0.3 m below the navigation reference, and the floor 5.7 m below it, in
its recordings; its table does not say."""
CASES: dict[str, tuple[str, dict[str, Any]]] = {
    'fixed': ('approach', {}),
    'swaying': ('swaying', {}),
    'swaying, roll 4 deg': ('swaying', {'roll_rms_deg': 4.0}),
    'swaying, calm': ('swaying', CALM),
    'smooth sway': ('swaying', {'obstacle_motion': 'swinging'}),
    'moving .3-1.5 m/s': ('mover', {}),
    'moving .1-.3 m/s': ('mover', {'obstacle_speed': [0.1, 0.3]}),
    'on the sea floor': ('approach', {**FLOOR, 'vertical_offset': 5.7, 'offset_spread': 0.5}),
}
VELOCITY: dict[str, tuple[dict[str, Any], float, tuple[float, ...]]] = {
    'moves': ({}, 0.0, (5.0, 10.0, 20.0)),
    'starts to move': ({'obstacle_starts': 20.0}, 20.0, (2.0, 5.0, 10.0)),
    'stops': ({'obstacle_stops': 20.0}, 20.0, (2.0, 5.0, 10.0)),
}
"""What differs from a mover, when something happens, s, and how long after it is looked at, s."""
METHODS: dict[str, dict[str, Any]] = {
    'fixed': {'behaviours': ('fixed',)},
    'all': {'behaviours': BEHAVIOURS},
}
AT = 30.0
EVERY = (*CASES, 'velocity')


def off_velocity(truth: TrueObstacle, ping: int, found: dict[str, float]) -> list[float]:
    return [found[name] - truth.velocity[ping, i] for i, name in enumerate(('vx', 'vy'))]


def behaviour_at(truth: TrueObstacle, final: dict[int, Estimate]) -> list[float] | None:
    """Probability of each behaviour and the error of vx and vy when the range falls to `AT`."""
    seen = first_at(truth, final, AT)
    if seen is None:
        return None
    ping, found = seen
    return [found[f'prob_{name}'] for name in BEHAVIOURS] + off_velocity(truth, ping, found)


def velocity(runs: int) -> dict[str, dict[str, float]]:
    """RMSE of the velocity of each axis after what happens, by the time since."""
    table: dict[str, dict[str, float]] = {}
    for name, (changes, when, after) in VELOCITY.items():
        setting = scenario('mover', {**LEVER, **changes})
        errors: dict[float, list[float]] = {seconds: [] for seconds in after}
        for seed in range(runs):
            scene = simulate(setting, seed)
            truth = truths(scene, TrueObstacle)[0]
            final = track(scene, config_of(setting, behaviours=BEHAVIOURS))
            t = (truth.stamp_ns - truth.stamp_ns[0]) * 1e-9
            seen = when or t[np.argmax(truth.in_beam)]
            if when and followed(truth, final, int(np.argmin(np.abs(t - when)))) is None:
                continue
            for seconds, off in errors.items():
                ping = int(np.argmin(np.abs(t - seen - seconds)))
                found = followed(truth, final, ping)
                if found is not None and truth.in_beam[ping]:
                    off += off_velocity(truth, ping, found)
        table[name] = {f'{s:.0f} s': rms(e) for s, e in errors.items()}
    return table


def case(name: str, runs: int, first: int = 0) -> dict[str, dict[str, float]]:
    kind, changes = CASES[name]
    setting = scenario(kind, {**LEVER, **changes})
    offsets: dict[str, list[list[list[float] | None]]] = {method: [] for method in METHODS}
    does, tracks = [], dict.fromkeys(METHODS, 0)
    for seed in range(first, first + runs):
        scene = simulate(setting, seed)
        truth = truths(scene, TrueObstacle)[0]
        for method, values in METHODS.items():
            final = track(scene, config_of(setting, **values))
            offsets[method].append([offset_at(truth, final, at) for at in RANGES])
            extras = [estimate.extras for estimate in final.values()]
            confirmed = [e['track_id'][e['track_state'] > 0] for e in extras]
            tracks[method] += len(np.unique(np.concatenate(confirmed)))
            if method == 'all':
                does.append(behaviour_at(truth, final))
    table = {}
    for method, rows in offsets.items():
        table[f'{name}, {method}'] = {
            **{key: value for key, value in summary(rows).items() if 'bias' not in key},
            'tracks per obstacle': tracks[method] / runs,
        }
    known = np.array([row for row in does if row is not None])
    if len(known):
        mean = known.mean(axis=0)
        table[f'{name}, all'] |= {f'P {b}': float(mean[i]) for i, b in enumerate(BEHAVIOURS)}
        table[f'{name}, all']['v'] = rms(known[:, 4:])
    return table


def truth_tables(truth: TrueObstacle) -> Iterator[Estimate]:
    """The truth of an obstacle as `evaluate` reads it from a recording."""
    for table in truth.tables('odom'):
        yield Estimate.from_columns(table.columns, stamp_ns=table.stamp_ns)


def main(runs: int = 100, first: int = 0, cases: Sequence[str] = EVERY) -> Parts:
    yield {'runs': runs}
    for name in cases:
        yield {name: case(name, runs, first) if name in CASES else velocity(runs)}


if __name__ == '__main__':
    study(
        main,
        first={'help': 'first seed of the cases'},
        cases={'choices': EVERY},
    )
