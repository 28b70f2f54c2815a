# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Divers in the field: covariances and stamps that are wrong, and two sensors that disagree.

    python -m benchmarks.diver_sensors --out docs/results/diver_sensors.json
    python -m benchmarks.diver_sensors --runs 4 --only 'diver, b 3 m off' 'boat, b 2 s late'

One target, 200 fixes, one a second; the tracker is told the kind of the target and that there is
one. `scales`: the fixes state a wrong covariance, or none. `lasting`: a part of their error is
correlated over 5 or 60 s and not stated as such. `sensors`: a and b report in turn, each states a
covariance of its own.

RMSE, NEES (2 is due) and the share in the 95 % ellipse are of all fixes after the tenth; `rows`:
mean number alive. `warned`: share of the runs in which the warning of the scene stands at the
end; `other`: mean number of other warnings.
"""

from __future__ import annotations

from collections.abc import Sequence
import time
from typing import Any, NamedTuple

import numpy as np

from benchmarks.diver_families import INSIDE, integrated, legs, smooth_turns
from benchmarks.study import mean_of, Parts, study
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Fix
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

COUNT, FIRST = 200, 10


class Scene(NamedTuple):
    """Fixes of one target, and what they state."""

    target: str
    std: float
    """Standard deviation of a fix on each axis, m."""
    warning: str = ''
    """Part of the warning that is due."""
    stated: float | None = 1.0
    """Stated variance relative to the true one; None: no covariance is stated."""
    every: float = 1.0
    """Seconds between fixes."""
    lasting: float = 0.0
    """Standard deviation of an error that lasts, m."""
    time: float = 60.0
    """Its correlation time, s."""
    sensors: bool = False
    """Whether sensors a and b report in turn."""
    off: tuple[float, float] = (0.0, 0.0)
    """Offset of sensor b, m."""
    late: float = 0.0
    """Delay of the stamps of sensor b, s."""
    times: float = 1.0
    """Standard deviation of sensor b relative to what it states."""


KINDS: dict[str, dict[str, Any]] = {
    'two sensors': {},
    'b 10 m off': {'off': (6.0, 8.0), 'warning': 'm apart'},
    'b 3 m off': {'off': (1.8, 2.4), 'warning': 'm apart'},
    'b 2 s late': {'late': 2.0, 'warning': 'stamps of sensor b are'},
    'b worse': {'times': 4.0, 'warning': 'of sensor b too small'},
    'b better': {'times': 0.2, 'warning': 'of sensor b are too small or'},
}
"""What two sensors do."""

SCENES: dict[str, dict[str, Scene]] = {
    'scales': {
        'diver, R true': Scene('diver', 1.0),
        'diver, 5 s, R true': Scene('diver', 1.0, every=5.0),
        'rov, R true': Scene('rov', 0.3),
        'boat, R true': Scene('boat', 1.0),
        'diver, R / 6': Scene('diver', 1.0, 'too small', 1.0 / 6.0),
        'diver, R / 100': Scene('diver', 1.0, 'too small', 1e-2),
        'diver, R / 1e4': Scene('diver', 1.0, 'too small', 1e-4),
        'boat, R / 1e4': Scene('boat', 1.0, 'too small', 1e-4),
        'diver, R / 1e6': Scene('diver', 1.0, 'too small', 1e-6),
        'diver, R times 50': Scene('diver', 1.0, 'too large', 50.0),
        'diver, 6 m, no covariance': Scene('diver', 6.0, 'no message states', None),
    },
    'lasting': {
        '1 m of 5 s': Scene('diver', 0.01, 'fix_bias_std', 1e4, lasting=1.0, time=5.0),
        '1 m of 60 s': Scene('diver', 0.01, 'fix_bias_std', 1e4, lasting=1.0),
        '.3 m, and 3 m of 60 s': Scene('diver', 0.3, 'fix_bias_std', 1.0 / 0.09, lasting=3.0),
    },
    'sensors': {
        f'{target}, {name}': Scene(target, std, sensors=True, **values)
        for target, std in (('diver', 0.3), ('rov', 0.3), ('boat', 1.0))
        for name, values in KINDS.items()
    },
}


def path(target: str, rng: np.random.Generator, seconds: float) -> FloatArray:
    """Places (k, 2) of a target each .1 s."""
    if target == 'boat':
        heading = smooth_turns(rng, seconds, 8.0, 10.0)
        return integrated(np.full(len(heading), 6.0), heading)
    speed, heading = legs(rng, seconds, *((0.75, 15.0) if target == 'diver' else (0.5, 8.0)), 90.0)
    if target == 'rov':
        speed = np.where(np.sin(0.005 * np.arange(len(speed))) > 0.7, 0.0, speed)
    return integrated(speed, heading)


def fixes_of(scene: Scene, seed: int) -> tuple[list[Fix], FloatArray]:
    """Fixes of a scene, and the places (COUNT, 2) of the target at their stamps."""
    rng = np.random.default_rng([seed, 47])
    places = path(scene.target, rng, COUNT * scene.every + 6.0)
    fine = 0.1 * np.arange(len(places))
    at = 5.0 + scene.every * np.arange(COUNT)
    kept, bias = np.exp(-scene.every / scene.time), scene.lasting * rng.normal(size=2)
    items, truth = [], np.column_stack([np.interp(at, fine, axis) for axis in places.T])
    for k, second in enumerate(at):
        of_b = scene.sensors and k % 2 == 1
        bias = kept * bias + scene.lasting * np.sqrt(1.0 - kept**2) * rng.normal(size=2)
        shown = second - scene.late if of_b else second
        z = [np.interp(shown, fine, axis) for axis in places.T]
        z = z + scene.std * (scene.times if of_b else 1.0) * rng.normal(size=2)
        z = z + bias + (scene.off if of_b else (0.0, 0.0))
        covariance = None
        if scene.stated is not None:
            covariance = np.diag([scene.std**2 * scene.stated] * 2 + [np.nan])
        items.append(
            Fix(
                stamp_ns=round((100.0 + second) * 1e9),
                position=np.append(z, 0.0),
                covariance=covariance,
                frame_id='map',
                sensor=('b' if of_b else 'a') if scene.sensors else '',
            )
        )
    return items, truth


def row(scene: Scene, seed: int) -> dict[str, float]:
    """The numbers of a run."""
    items, truth = fixes_of(scene, seed)
    tracker = DiverTracker(DiverConfig(target=scene.target, max_tracks=1))
    square, nees, rows, start = [], [], 0, time.process_time()
    for k, item in enumerate(items):
        last = tracker.process(item)[-1]
        rows += len(tracker._stream.state.rows)
        firm = np.flatnonzero(last.extras['track_state'] > 0)
        if k >= FIRST and len(firm):
            error = last.state[firm[0], :2] - truth[k]
            square.append(error @ error)
            nees.append(error @ np.linalg.solve(last.covariance[firm[0], :2, :2], error))
    spent, said = time.process_time() - start, tracker.warnings()
    due = [bool(scene.warning) and scene.warning in text for text in said]
    return {
        'square': float(np.mean(square)),
        'NEES': float(np.mean(nees)),
        'inside': float(np.mean(np.array(nees) <= INSIDE)),
        'followed': len(nees) / (COUNT - FIRST),
        'rows': rows / COUNT,
        'ms': 1e3 * spent / COUNT,
        'warned': float(any(due)),
        'other': float(len(said) - sum(due)),
    }


def main(runs: int = 10, first_seed: int = 100, only: Sequence[str] = ()) -> Parts:
    yield {'runs': runs}
    for table, scenes in SCENES.items():
        for name, scene in scenes.items():
            if only and name not in only:
                continue
            found: dict[str, Any] = mean_of(
                [row(scene, seed) for seed in range(first_seed, first_seed + runs)]
            )
            yield {table: {name: {'RMSE m': found.pop('square') ** 0.5, **found}}}


if __name__ == '__main__':
    names = [name for scenes in SCENES.values() for name in scenes]
    study(main, only={'choices': names})
