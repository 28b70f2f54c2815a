# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Do the stated probabilities of a collision come true, and does the 90 % band hold the truth?

    python -m benchmarks.obstacle_calibration --out docs/results/obstacle_calibration.json

All runs are of the whole tracker, with its defaults, of which `--tracker name=value` replaces
some. `misses` changes what is published and not the filter (`beam`), so one run shows both.

Each scene has `OBSTACLES` one behind the other, for as many runs from a third of the time.

`forecasts` compares stated probabilities of a collision with what happened, when the range first
falls to 60, 45, 30, 20 and 10 m, by five bins: fixed, swaying and moving obstacles in `scenes`
each, per altitude of the vehicle. `within 8 m` draws the vertical offset evenly over 8 m to both
sides, at altitudes of 6 and 25 m (what would lie in the sea floor does not count). `error` is the
standard error of what happened less what was stated, from the sums of scenes: forecasts of an
obstacle, and obstacles of a scene, err together. `early` has the forecasts at 60 and 45 m alone,
`late` the others. `lost` is the share of the ranges at which the obstacle is not followed: no
forecast. `guess` is the Brier score of who knows nothing but how often it happens.

`band` is the share of the pings of the last 35 m of range in which the 90 % band of the vertical
offset holds the truth, over the fixed obstacles of `approaches` scenes per offset; `worst` that of
the tenth of the obstacles of which it holds least, `width` its mean width. `beam` is the same for
obstacles 4 m above and below, where the beam is not as high as the tracker was told:

    python -m benchmarks.obstacle_calibration --cases band --add --out FILE
    python -m benchmarks.obstacle_calibration --cases beam --approaches 2 --add --out FILE
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from attrs import evolve
import numpy as np

from benchmarks.obstacle_accuracy import config_of, LEVER, nearest, parsed
from benchmarks.obstacle_sea import first_at
from benchmarks.study import Parts, rms, study, truths
from sonar_imm.estimates import Estimate
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.trackers.obstacle.config import BEHAVIOURS, MISSES, ObstacleConfig
from sonar_imm.trackers.obstacle.state import Known
from sonar_imm.trackers.obstacle.tracker import ObstacleTracker
from sonar_imm.truth import Scene
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate, TrueObstacle

ALTITUDES = (6.0, 25.0)
DRAWN, REACH = 'within 8 m', 8.0
"""The case of forecasts, and the greatest vertical offset of its obstacles, m."""
AT = (60.0, 45.0, 30.0, 20.0, 10.0)
LATE = 30.0
BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
KINDS = ('approach', 'swaying', 'mover')
OFFSETS = (-8.0, -6.0, -4.0, -2.0, -0.5, 0.5, 2.0, 4.0, 6.0, 8.0)
OBSTACLES, SPACING = 8, 8.0
"""In a scene, and m from one to the next."""
BEAMS = (12.0, 15.0, 18.0, 20.0)
"""True heights of the beam, degrees, where the tracker believes in 15."""
LAST = 35.0
"""m of range over which the band is judged."""
DEEPEST = 0.2
"""m above the sea floor: no obstacle lies lower."""


Forecast = tuple[float, float, float, int]
"""Range m, stated probability, whether it happened, and the number of its scene."""
Found = dict[str, dict[int, Estimate]]
"""The last estimate of every ping, by stamp, for each way to take misses."""


class _Both(ObstacleTracker):
    """Publishes what each way to take misses would."""

    def __init__(self, config: ObstacleConfig):
        super().__init__(evolve(config, misses='evidence'))
        self.ignoring = ObstacleTracker(evolve(config, misses='ignored'))
        self.found: Found = {misses: {} for misses in MISSES}

    def _estimate(self, ping: Known) -> Estimate:
        evidence = super()._estimate(ping)
        self.found['ignored'][ping.stamp_ns] = self.ignoring._estimate(ping)
        self.found['evidence'][ping.stamp_ns] = evidence
        return evidence


def track(scene: Scene, config: ObstacleConfig) -> Found:
    tracker = _Both(config)
    for item in scene.measurements:
        tracker.process(item.measurement)
    return tracker.found


def several(last_range: float) -> dict[str, Any]:
    """What is other in a scene of several obstacles, of which the last comes as near."""
    reached = last_range - SPACING * (OBSTACLES - 1)
    return {**LEVER, 'obstacles': OBSTACLES, 'spacing': SPACING, 'last_range': reached}


def happened(truth: TrueObstacle, ping: int, radius: float, height: float) -> bool:
    """Whether the obstacle is ever within the radius and the half height at once from a ping on;
    what the scene does not reach has passed."""
    offset = truth.vertical_offset[ping:]
    level_distance = np.sqrt(np.maximum(truth.range[ping:] ** 2 - offset**2, 0.0))
    return bool(np.any((level_distance <= radius) & (np.abs(offset) <= height)))


def forecasts(scenes: int, first: int, values: dict[str, Any]) -> dict[str, Any]:
    """Tables of what was stated and what happened, and Brier scores."""
    config = ObstacleConfig(**values)
    found: dict[str, list[Forecast]] = {misses: [] for misses in MISSES}
    asked, block = 0, 0
    for kind in KINDS:
        for altitude in ALTITUDES:
            drawn = {'vertical_offset': 0.0, 'offset_spread': REACH, 'altitude': altitude}
            setting = scenario(kind, {**several(-10.0), **drawn})
            # Seeds of their own: those of other kinds have the same geometry.
            for seed in range(first + 10000 * block, first + 10000 * block + scenes):
                scene = simulate(setting, seed)
                every = track(scene, config_of(setting, behaviours=BEHAVIOURS, **values))
                for truth in truths(scene, TrueObstacle):
                    if truth.vertical_offset[0] > altitude - 0.3 - DEEPEST:
                        continue
                    asked += len(AT)
                    for misses, final in every.items():
                        rows = _stated(truth, final, config)
                        found[misses] += [(*row, seed) for row in rows]
            block += 1
    return {misses: {DRAWN: _calibration(rows, asked)} for misses, rows in found.items()}


def _stated(
    truth: TrueObstacle, final: dict[int, Estimate], config: ObstacleConfig
) -> list[tuple[float, float, float]]:
    """The forecasts of an obstacle: range, probability, and whether it happened."""
    rows = []
    for at in AT:
        seen = first_at(truth, final, at)
        if seen is not None and np.isfinite(seen[1]['collision_probability']):
            ends = happened(truth, seen[0], config.safety_radius, config.safety_height)
            rows.append((at, seen[1]['collision_probability'], float(ends)))
    return rows


def _calibration(found: list[Forecast], asked: int) -> dict[str, Any]:
    """What became of forecasts."""
    ranges, p, hit, scene = (np.array(column) for column in zip(*found))
    late = ranges <= LATE
    brier = {}
    for at in AT:
        rows = ranges == at
        often = hit[rows].mean()
        brier[f'{at:.0f} m'] = {
            'forecasts': int(rows.sum()),
            'Brier': float(np.mean((p[rows] - hit[rows]) ** 2)),
            'guess': float(often * (1.0 - often)),
        }
    return {
        'reliability': _reliability(p, hit, scene),
        'early': _reliability(p[~late], hit[~late], scene[~late]),
        'late': _reliability(p[late], hit[late], scene[late]),
        'brier': brier,
        'lost': 1.0 - len(found) / asked,
    }


def _reliability(p: FloatArray, hit: FloatArray, scene: FloatArray) -> dict[str, dict[str, float]]:
    """Stated and happened by bins of what was stated."""
    table: dict[str, dict[str, float]] = {}
    for low, high in zip(BINS, BINS[1:]):
        rows = (p >= low) & ((p < high) | (high == 1.0))
        if rows.any():
            _, number = np.unique(scene[rows], return_inverse=True)
            off = np.bincount(number, hit[rows] - p[rows])
            table[f'{low:g} to {high:g}'] = {
                'forecasts': int(rows.sum()),
                'stated': float(p[rows].mean()),
                'happened': float(hit[rows].mean()),
                'error': float(np.sqrt(np.sum(off**2)) / rows.sum()),
            }
    return table


def band(
    settings: Sequence[dict[str, Any]], approaches: int, first: int, values: dict[str, Any]
) -> dict[str, dict[str, float]]:
    """How much of the last 35 m the 90 % band holds, of fixed obstacles in scenes that differ by
    `settings`, for each way to take misses."""
    runs: dict[str, list[tuple[TrueObstacle, dict[int, Estimate]]]] = {m: [] for m in MISSES}
    for changes in settings:
        setting = scenario('approach', {**several(6.0), **changes})
        for seed in range(first, first + approaches):
            scene = simulate(setting, seed)
            config = config_of(setting, behaviours=BEHAVIOURS, **values)
            for misses, final in track(scene, config).items():
                runs[misses] += [(truth, final) for truth in truths(scene, TrueObstacle)]
    return {misses: _held(tracked) for misses, tracked in runs.items()}


def _held(runs: list[tuple[TrueObstacle, dict[int, Estimate]]]) -> dict[str, float]:
    held, widths, errors, followed, pings = [], [], [], 0, 0
    for truth, final in runs:
        inside = []
        for ping in np.flatnonzero(truth.range <= LAST).tolist():
            pings += 1
            estimate = final.get(int(truth.stamp_ns[ping]))
            row = None if estimate is None else nearest(truth, estimate, ping)
            if estimate is None or row is None:
                continue
            low, high = (float(estimate.extras[f'vertical_offset_{e}'][row]) for e in ('lo', 'hi'))
            true = float(truth.vertical_offset[ping])
            inside.append(low <= true <= high)
            widths.append(high - low)
            errors.append(float(estimate.state[row, 2]) - true)
        followed += len(inside)
        if inside:
            held.append(float(np.mean(inside)))
    return {
        'held': float(np.mean(held)),
        'worst': float(np.mean(sorted(held)[: max(1, len(held) // 10)])),
        'width': float(np.mean(widths)),
        'RMSE': rms(errors),
        'lost': 1.0 - followed / pings,
    }


def main(
    scenes: int = 28,
    approaches: int = 5,
    first: int = 300000,
    cases: Sequence[str] = (DRAWN,),
    tracker: Sequence[str] = (),
) -> Parts:
    yield {'obstacles': OBSTACLES * scenes, 'approaches': OBSTACLES * approaches, 'first': first}
    values = dict(map(parsed, tracker))
    rows: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for name in cases:
        if name == DRAWN:
            yield forecasts(scenes, first, values)
            continue
        if name == 'band':
            every = [(altitude, offset) for altitude in ALTITUDES for offset in OFFSETS]
            rows = {
                (f'{altitude:g} m', f'{offset:g} m'): [
                    {'altitude': altitude, 'vertical_offset': offset}
                ]
                for altitude, offset in every
                if offset <= altitude - 0.3 - DEEPEST
            }
        else:
            rows = {
                (f'{height:g} deg',): [
                    {'altitude': 25.0, 'vertical_offset': offset, 'vertical_fov_deg': height}
                    for offset in (-4.0, 4.0)
                ]
                for height in BEAMS
            }
        for keys, settings in rows.items():
            for misses, row in band(settings, approaches, first, values).items():
                part: dict[str, Any] = dict(row)
                for key in reversed(keys):
                    part = {key: part}
                yield {misses: {name: part}}


if __name__ == '__main__':
    study(
        main,
        first={'help': 'first seed'},
        cases={'choices': (DRAWN, 'band', 'beam')},
        tracker={'help': 'name=value of the tracker'},
    )
