# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Accuracy of the obstacle tracker on simulated approaches.

    python -m benchmarks.obstacle_accuracy --out docs/results/obstacle_accuracy.json

Each run is the whole tracker: gating, confirmation, track logic. The error of the vertical offset
is taken from the confirmed track when the range first falls to 50, 30 and 20 m, also where the
obstacle has left the beam by then. Obstacles are held for fixed (`behaviours: [fixed]`;
`benchmarks.obstacle_sea` has the others). What the paper does on the same measurements is in
`benchmarks.obstacle_paper`.

`images`: what the detector of images finds, misses and invents, in images of the simulated sonar
(256 beams, 600 ranges), which knows nothing of the detector; its margin was chosen on images of
other seeds. `found`: share of the images with a point at 25 to 90 m in which it is found within
2 m, by its level in dB and its fading, before the onset of the sea floor. `false detections per
image`: without a target, by the shape of the power of patches of the sea floor and their side.

The rest has the defaults, and obstacles one behind the other, `OBSTACLES` in a scene; `misses`
changes what is published and not the filter, so one run shows both.

`forecasts` compares stated probabilities of a collision with what happened, when the range first
falls to 60, 45, 30, 20 and 10 m, by five bins: fixed, swaying and moving obstacles, per altitude
of the vehicle, vertical offsets drawn evenly over 8 m to both sides (what would lie in the sea
floor does not count). `error` is the standard error of what happened less what was stated, from
the sums of scenes: forecasts of an obstacle, and obstacles of a scene, err together. `early` has
the forecasts at 60 and 45 m alone, `late` the others. `lost` is the share of the ranges at which
the obstacle is not followed: no forecast. `guess` is the Brier score of who knows nothing but how
often it happens.

`band` is the share of the pings of the last 35 m of range in which the 90 % band of the vertical
offset holds the truth, of fixed obstacles; `worst` that of the tenth of the obstacles of which it
holds least, `width` its mean width. `beam` is the same for obstacles 4 m above and below, where
the beam is not as high as the tracker was told.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from attrs import evolve
import numpy as np

from benchmarks.study import final_estimates, Parts, rms, study, truths
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.estimates import Estimate
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import SonarImage
from sonar_imm.trackers.obstacle.config import BEHAVIOURS, MISSES
from sonar_imm.trackers.obstacle.detector import detect, DetectorConfig
from sonar_imm.trackers.obstacle.state import Known
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker
from sonar_imm.truth import Scene
from sonar_imm_tools.simulation.obstacle.images import ImageSonar
from sonar_imm_tools.simulation.obstacle.simulator import (
    ObstacleScenario,
    scenario,
    simulate,
    TrueObstacle,
)

RANGES = (50.0, 30.0, 20.0)
CASES = (
    'approach',
    'nearly_level',
    'above',
    'float',
    'rolling',
    'calm',
    'stress',
    'rough_seabed',
    'diving',
)
LEVER = {'sonar_lever': (2.0, 0.0, -0.3)}
"""Where the study has its sonar, which is not where scenes have it."""
NEAR = 5.0
"""Metres in range and bearing within which a track follows the obstacle."""


def config_of(scene: ObstacleScenario, **values: object) -> ObstacleConfig:
    """The tracker told what the scene's vehicle and sonar are, and that obstacles are fixed."""
    names = ('sonar_lever', 'sonar_mount_rpy_deg', 'azimuth_model', 'ping_timing')
    own = {name: getattr(scene, name) for name in names}
    return ObstacleConfig(**{'behaviours': ('fixed',), **own, **values})


def track(
    scene: Scene, config: ObstacleConfig, kind: type[ObstacleTracker] = ObstacleTracker
) -> dict[int, Estimate]:
    """The last estimate of every ping, by stamp."""
    measurements = [item.measurement for item in scene.measurements]
    return final_estimates(kind(config), measurements)


def level(estimate: Estimate) -> tuple[np.ndarray, np.ndarray]:
    """Where the tracks (n, 2) lie seen from the sonar, bearings laid flat, and which are
    confirmed."""
    r, b = estimate.state[:, 0], estimate.state[:, 1]
    points = np.column_stack([r * np.cos(b), r * np.sin(b)])
    return points, estimate.extras['track_state'] > 0


def true_level(truth: TrueObstacle, ping: int) -> np.ndarray:
    r, b = truth.range[ping], truth.bearing[ping]
    return np.array([r * np.cos(b), r * np.sin(b)])


def nearest(truth: TrueObstacle, estimate: Estimate, ping: int) -> int | None:
    """The row of the confirmed track nearest to an obstacle at a ping; None when it is not
    followed."""
    points, confirmed = level(estimate)
    distance = np.linalg.norm(points - true_level(truth, ping), axis=1)
    distance[~confirmed] = np.inf
    if not len(distance) or distance.min() > NEAR:
        return None
    return int(np.argmin(distance))


def followed(
    truth: TrueObstacle, final: dict[int, Estimate], ping: int
) -> dict[str, float] | None:
    """The columns of the confirmed track nearest to an obstacle at a ping, None without one."""
    estimate = final.get(int(truth.stamp_ns[ping]))
    if estimate is None or (row := nearest(truth, estimate, ping)) is None:
        return None
    return {name: float(values[row]) for name, values in estimate.extras.items()}


def first_at(
    truth: TrueObstacle, final: dict[int, Estimate], at: float
) -> tuple[int, dict[str, float]] | None:
    """The ping at which the range first falls to `at` and the obstacle is followed."""
    for ping in np.flatnonzero(truth.range <= at)[:6].tolist():
        found = followed(truth, final, ping)
        if found is not None:
            return ping, found
    return None


def offset_at(truth: TrueObstacle, final: dict[int, Estimate], at: float) -> list[float] | None:
    """Error, NEES and band coverage when the range falls to `at`; None when not followed."""
    for ping in np.flatnonzero(truth.range <= at)[:6]:
        estimate = final.get(int(truth.stamp_ns[ping]))
        if estimate is None:  # a ping lost
            continue
        if (row := nearest(truth, estimate, ping)) is None:
            return None
        true = truth.vertical_offset[ping]
        error = estimate.state[row, 2] - true
        low, high = (estimate.extras[f'vertical_offset_{end}'][row] for end in ('lo', 'hi'))
        return [error, error**2 / estimate.covariance[row, 2, 2], float(low <= true <= high)]
    return None


def case(name: str, runs: int) -> dict[str, dict[str, float]]:
    """RMSE, bias, NEES, coverage of the 90 % band at each range."""
    rows = []
    for seed in range(runs):
        setting = scenario(name, LEVER)
        scene = simulate(setting, seed)
        final = track(scene, config_of(setting))
        truth = truths(scene, TrueObstacle)[0]
        rows.append([offset_at(truth, final, at) for at in RANGES])
    return {f'{name}, gaussian_sum': summary(rows)}


def summary(rows: list[list[list[float] | None]]) -> dict[str, float]:
    table: dict[str, float] = {}
    for column, at in enumerate(RANGES):
        if found := [row[column] for row in rows if row[column] is not None]:
            error, squared, inside = np.array(found).T
            table |= {
                f'RMSE {at:.0f} m': rms(error),
                f'bias {at:.0f} m': float(np.mean(error)),
                f'NEES {at:.0f} m': float(np.mean(squared)),
                f'cover {at:.0f} m': float(np.mean(inside)),
            }
        table[f'lost {at:.0f} m'] = 1.0 - len(found) / len(rows)
    return table


# -- images ---------------------------------------------------------------------------------------

DEPTH, FOUND = 20.0, 2.0
LEVEL = Pose(np.array([0.0, 0.0, DEPTH]), np.eye(3))
FLOORS = {
    'Rayleigh': (1000.0, 1.0),
    'K 4': (4.0, 1.0),
    'K 1.5': (1.5, 1.0),
    'K 1.5, patches of 5 m': (1.5, 5.0),
}
LEVELS, FADINGS = (12.0, 15.0, 18.0, 21.0), ('steady', 'rayleigh')


def image(sonar: ImageSonar, places: list[np.ndarray]) -> SonarImage:
    return SonarImage(
        stamp_ns=1,
        range=sonar.range,
        bearing=sonar.bearing,
        amplitude=sonar.image(LEVEL, places, 1.0).astype(float),
    )


def imaged(**values: float | str) -> ObstacleScenario:
    return ObstacleScenario.from_mapping(
        {'images': True, 'altitude': 6.0, 'depth': DEPTH, **values}
    )


def false_alarms(floor: str, images: int) -> float:
    """Detections per image without a target; the rough spots are others in every image."""
    shape, patch = FLOORS[floor]
    count = 0
    for number in range(images):
        rng = np.random.default_rng([1, number])
        sonar = ImageSonar(imaged(seabed_shape=shape, seabed_patch=patch), rng)
        count += len(detect(image(sonar, []), DetectorConfig()))
    return count / images


def found(fading: str, level: float, runs: int) -> float:
    rng, hits = np.random.default_rng(2), 0
    config = imaged(target_fading=fading, target_snr_db=level, altitude=5000.0)
    sonar = ImageSonar(config, rng)
    for _ in range(runs):
        r, b = rng.uniform(25.0, 90.0), rng.uniform(-0.3, 0.3)
        place = np.array([r * np.cos(b), -r * np.sin(b), DEPTH])  # NED, level with the sonar
        ping = detect(image(sonar, [place]), DetectorConfig())
        hits += bool((np.hypot(ping.range - r, (ping.bearing - b) * r) < FOUND).any())
    return hits / runs


def images(runs: int) -> dict[str, Any]:
    """Tables of the detector; a fifth of the runs for false detections."""
    return {
        'runs': runs,
        'found': {
            fading: {f'{level:g} dB': found(fading, level, runs) for level in LEVELS}
            for fading in FADINGS
        },
        'false detections per image': {
            'without a target': {floor: false_alarms(floor, runs // 5) for floor in FLOORS}
        },
    }


# -- calibration --------------------------------------------------------------------------------

ALTITUDES = (6.0, 25.0)
DRAWN, REACH = 'within 8 m', 8.0
"""The case of forecasts, and the greatest vertical offset of its obstacles, m."""
AT = (60.0, 45.0, 30.0, 20.0, 10.0)
LATE = 30.0
BINS = (0.0, 0.2, 0.4, 0.6, 0.8, 1.0)
SORTS = ('approach', 'swaying', 'mover')
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


def both(scene: Scene, config: ObstacleConfig) -> Found:
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


def forecasts(scenes: int, first: int) -> dict[str, Any]:
    """Tables of what was stated and what happened, and Brier scores."""
    config = ObstacleConfig()
    found: dict[str, list[Forecast]] = {misses: [] for misses in MISSES}
    asked, block = 0, 0
    for kind in SORTS:
        for altitude in ALTITUDES:
            drawn = {'vertical_offset': 0.0, 'offset_spread': REACH, 'altitude': altitude}
            setting = scenario(kind, {**several(-10.0), **drawn})
            # Seeds of their own: those of other kinds have the same geometry.
            for seed in range(first + 10000 * block, first + 10000 * block + scenes):
                scene = simulate(setting, seed)
                every = both(scene, config_of(setting, behaviours=BEHAVIOURS))
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
    settings: Sequence[dict[str, Any]], approaches: int, first: int
) -> dict[str, dict[str, float]]:
    """How much of the last 35 m the 90 % band holds, of fixed obstacles in scenes that differ by
    `settings`, for each way to take misses."""
    runs: dict[str, list[tuple[TrueObstacle, dict[int, Estimate]]]] = {m: [] for m in MISSES}
    for changes in settings:
        setting = scenario('approach', {**several(6.0), **changes})
        for seed in range(first, first + approaches):
            scene = simulate(setting, seed)
            config = config_of(setting, behaviours=BEHAVIOURS)
            for misses, final in both(scene, config).items():
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


PARTS = (*CASES, 'images', 'forecasts', 'band', 'beam')


def main(
    runs: int = 300,
    pictures: int = 120,
    scenes: int = 28,
    approaches: int = 5,
    first: int = 300000,
    parts: Sequence[str] = PARTS,
) -> Parts:
    """runs: of each case; pictures: with a point; scenes: of a kind of obstacle and an altitude,
    for forecasts; approaches: for each offset, for the band; first: seed of these two."""
    yield {'runs': runs, 'obstacles': OBSTACLES * scenes, 'approaches': OBSTACLES * approaches}
    for name in CASES:
        if name in parts:
            yield {name: case(name, runs)}
    if 'images' in parts:
        yield {'images': images(pictures)}
    if 'forecasts' in parts:
        yield forecasts(scenes, first)
    for altitude in ALTITUDES if 'band' in parts else ():
        for offset in OFFSETS:
            if offset <= altitude - 0.3 - DEEPEST:
                setting = {'altitude': altitude, 'vertical_offset': offset}
                for misses, row in band([setting], approaches, first).items():
                    yield {misses: {'band': {f'{altitude:g} m': {f'{offset:g} m': row}}}}
    for height in BEAMS if 'beam' in parts else ():
        settings = [
            {'altitude': 25.0, 'vertical_offset': offset, 'vertical_fov_deg': height}
            for offset in (-4.0, 4.0)
        ]
        for misses, row in band(settings, (approaches + 1) // 2, first).items():
            yield {misses: {'beam': {f'{height:g} deg': row}}}


if __name__ == '__main__':
    study(main, digits=2, parts={'choices': PARTS})
