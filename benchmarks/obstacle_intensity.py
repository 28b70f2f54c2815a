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

"""What the intensity of echoes tells of the height of an obstacle, on a level and a nodding sonar.

    python -m benchmarks.obstacle_intensity --runs 20 --out docs/results/obstacle_intensity.json

Echoes are as loud as a Gaussian beam makes them, from an obstacle of unknown strength that fades
from ping to ping by a Rayleigh law and slowly by 3 dB.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from attrs import evolve
import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.study import Parts, study, truths
from sonar_imm.acoustics import geometry
from sonar_imm.measurements import Detections, Navigation
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker
from sonar_imm.truth import Scene
from sonar_imm_tools.simulation.obstacle import scenario, simulate
from sonar_imm_tools.simulation.obstacle.images import vertical_pattern
from sonar_imm_tools.simulation.obstacle.simulator import TrueObstacle

WIDTH_DEG = 15.0
NODDING = {'pitch_rms_deg': 3.54, 'pitch_period': 10.0}
CALM = {
    'roll_rms_deg': 0.3,
    'yaw_rms_deg': 0.3,
    'heave_rms': 0.042,
    'sway_rms': 0.028,
}
CASES: dict[str, tuple[dict[str, Any], float, str, str]] = {
    'level': ({}, 1.0, '1.96/1.21/.84', '1.84/1.16/.75'),
    'nodding': (NODDING, 1.0, '1.90/1.24/.84', '1.21/.86/.62'),
    'calm, nodding': ({**CALM, **NODDING}, 1.0, '3.27/3.09/2.75', '1.46/1.03/.87'),
    'nodding, beam 13 % wider than believed': (NODDING, 1.13, '', ''),
}
"""Scene, true width over believed width, and what a study has without and with intensity."""
AT = (50.0, 30.0, 20.0)


def with_intensities(scene: Scene, seed: int, width: float) -> Iterator[Any]:
    """The measurements of a scene, detections with intensities."""
    rng = np.random.default_rng([seed, 9])
    truth = truths(scene, TrueObstacle)[0]
    index = {int(stamp): k for k, stamp in enumerate(truth.stamp_ns)}
    strength = rng.normal(scale=10.0)
    slow = 3.0 * rng.normal()
    attitude = None
    received = [item.measurement for item in scene.measurements]
    poses = [item for item in received if isinstance(item, Navigation)]
    stamps = np.array([pose.stamp_ns for pose in poses])
    for measurement in received:
        if isinstance(measurement, Detections) and len(measurement):
            nearest = poses[int(np.argmin(np.abs(stamps - measurement.stamp_ns)))]
            attitude = Rotation.from_quat(nearest.orientation).as_matrix()
            R = geometry.flip_rotation(attitude)
            k = index[measurement.stamp_ns]
            m = geometry.reconstruct(
                np.array(truth.range[k]),
                np.array(-truth.bearing[k]),
                np.array(truth.vertical_offset[k]),
                R,
            )
            elevation = np.arcsin(np.clip(m[2] / np.linalg.norm(m), -1.0, 1.0))
            slow = 0.97 * slow + np.sqrt(1.0 - 0.97**2) * 3.0 * rng.normal()
            level = strength + slow + 10.0 * np.log10(rng.exponential())
            level += 10.0 * np.log10(vertical_pattern(elevation, width))
            amplitude = np.full(len(measurement), 10.0 ** (level / 20.0))
            measurement = evolve(measurement, intensity=amplitude)
        yield measurement


def run(values: dict[str, Any], seed: int, factor: float, config: ObstacleConfig) -> np.ndarray:
    """Error of the offset, its variance, and whether the band holds, at `AT`: (3, 3)."""
    draw = {'vertical_offset': float(np.random.default_rng(seed).uniform(-4.0, 4.0))}
    scene = simulate(scenario('approach', {**draw, 'altitude': 30.0, **values}), seed)
    truth = truths(scene, TrueObstacle)[0]
    tracker = ObstacleTracker(config)
    found = np.full((3, 3), np.nan)
    index = {int(stamp): k for k, stamp in enumerate(truth.stamp_ns)}
    width = factor * np.radians(WIDTH_DEG)
    for measurement in with_intensities(scene, seed, width):
        for estimate in tracker.process(measurement):
            k = index[estimate.stamp_ns]
            sure = np.flatnonzero(estimate.extras['track_state'] >= 1)
            if not len(sure):
                continue
            i = sure[np.argmin(np.abs(estimate.state[sure, 0] - truth.range[k]))]
            low, high = (estimate.extras[f'vertical_offset_{end}'][i] for end in ('lo', 'hi'))
            error = estimate.state[i, 2] - truth.vertical_offset[k]
            inside = low <= truth.vertical_offset[k] <= high
            for row, at in enumerate(AT):
                if truth.range[k] >= at:
                    found[row] = error, estimate.covariance[i, 2, 2], inside
    return found


def main(runs: int = 20, cases: Sequence[str] = tuple(CASES)) -> Parts:
    plain = ObstacleConfig(behaviours=('fixed',))
    configs = {'without': plain, 'with': evolve(plain, vertical_beam_width_deg=WIDTH_DEG)}
    for name in cases:
        values, factor, study_off, study_on = CASES[name]
        row: dict[str, Any] = {'runs': runs, 'study': [study_off, study_on]}
        for label, config in configs.items():
            found = np.array([run(values, seed, factor, config) for seed in range(runs)])
            error, variance, inside = found[..., 0], found[..., 1], found[..., 2]
            row[label] = {
                'rmse_m': np.sqrt(np.nanmean(np.square(error), axis=0)).round(3).tolist(),
                'nees': np.nanmean(np.square(error) / variance, axis=0).round(3).tolist(),
                'band_holds': np.nanmean(inside, axis=0).round(3).tolist(),
            }
        print(name, row)
        yield {name: row}


if __name__ == '__main__':
    study(main, cases={'choices': list(CASES)})
