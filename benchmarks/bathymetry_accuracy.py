# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What is attainable on the scene of the paper: every method on the same pings.

    python -m benchmarks.bathymetry_accuracy --out docs/results/bathymetry_accuracy.json

A flat floor 15 m below an array of eight staves, with a white rough patch of 0.5 m; 30 to 10 dB.
Prints RMSE of the height over smooth floor, patch and all, intersection over union of the patch
with the bins labelled rough, and the share of true heights within two standard deviations.
"""

from __future__ import annotations

from collections.abc import Mapping
import math
from typing import Any, NamedTuple

import numpy as np

from benchmarks.bathymetry_paper import PRINTED, PrintedTracker, WALKS
from benchmarks.study import Parts, study, truths
from sonar_imm.acoustics import array, spatial
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm.truth import Scene, TrueProfile
from sonar_imm_tools.simulation.bathymetry.simulator import BathymetryScenario, scenario, simulate

PAPER_CHAIN = (0.98, 0.02, 0.02, 0.98)
SLOPES_ONLY: dict[str, Any] = {
    'transition_matrix': (1.0, 0.0, 0.0, 1.0),
    'initial_probabilities': (0.0, 1.0),
}
SLOPE_SET: dict[str, Any] = {'model_set': 'height_rw_ncs', 'sigmas': (1.0, 1.0)}
COMMON: dict[str, Any] = {**WALKS, 'gate_false_alarm': 1.0, 'initial_std': 1.0}
TRACKERS: dict[str, dict[str, Any]] = {
    'random walk only': {
        'sigmas': (0.01, 1.0),
        'transition_matrix': (1.0, 0.0, 0.0, 1.0),
        'initial_probabilities': (0.0, 1.0),
    },
    'constant slope only': {**SLOPE_SET, **SLOPES_ONLY},
    'height_rw_ncs, paper': {**PRINTED, **SLOPE_SET, 'transition_matrix': PAPER_CHAIN},
    'defaults': {'model_set': 'terrain', 'gate_false_alarm': 1e-3, 'initial_std': 0.0},
}
"""Name: parameters that differ from `COMMON`."""
CLASSICAL = ('phase difference of one pair', 'music', 'capon')


class Answer(NamedTuple):
    """Height of every bin of every ping (pings, T); rough: labels; inside: the truth lies within
    two standard deviations. None for methods that do not say."""

    height: np.ndarray
    rough: np.ndarray | None
    inside: np.ndarray | None


def classical(name: str, scene: Scene, config: BathymetryScenario) -> Answer:
    """Directions from windows of +-5 bins, without a tracker."""
    heights = []
    tilt, spacing = math.radians(config.tilt_deg), config.spacing_wavelengths
    largest = array.largest_sine(spacing)
    grid = np.linspace(-largest, largest, 257)
    for item in scene.measurements:
        iq = np.asarray(item.measurement.iq, np.complex128)
        if name.startswith('phase'):
            sine = spatial.phase_difference_sines(iq, spacing)
        else:
            sine = spatial.peak_sines(spatial.ping_spectrum(iq, grid, spacing, method=name), grid)
        angle = np.arcsin(np.clip(sine, -1.0, 1.0))
        depth = array.depth_of_angle(angle, item.measurement.range, tilt)
        heights.append(config.sonar_height - depth)
    return Answer(np.array(heights), None, None)


def tracked(values: Mapping[str, Any], scene: Scene, printed: bool) -> Answer:
    config = BathymetryConfig(**{**COMMON, **values})
    tracker = PrintedTracker(config) if printed else BathymetryTracker(config)
    tables = [tracker.process(item.measurement)[0].columns() for item in scene.measurements]
    height = np.array([table['height'] for table in tables])
    truth = np.array([profile.height for profile in truths(scene, TrueProfile)])
    inside = rough = None
    if 'cov_height_height' in tables[0]:
        sd = np.sqrt([table['cov_height_height'] for table in tables])
        inside = np.abs(height - truth) < 2.0 * sd
    names = [key for key in tables[0] if key.startswith('prob_')]
    if 'rough' in tables[0]:
        rough = np.array([table['rough'] > 0.5 for table in tables])
    elif len(names) > 1 and 'initial_probabilities' not in values:
        of_rough = ['prob_rw'] if 'prob_rw' in names else names[len(names) // 2 :]
        rough = np.array([sum(table[key] for key in of_rough) > 0.5 for table in tables])
    return Answer(height, rough, inside)


def score(answer: Answer, scene: Scene) -> dict[str, Any]:
    truth = truths(scene, TrueProfile)
    patch = np.array([profile.patch for profile in truth])
    square = np.square(answer.height - np.array([profile.height for profile in truth]))
    rough, inside = answer.rough, answer.inside
    return {
        'smooth': math.sqrt(square[~patch].mean()),
        'patch': math.sqrt(square[patch].mean()),
        'all': math.sqrt(square.mean()),
        'iou': None if rough is None else float((rough & patch).sum() / (rough | patch).sum()),
        'inside_smooth': None if inside is None else float(inside[~patch].mean()),
        'inside_patch': None if inside is None else float(inside[patch].mean()),
    }


def main(pings: int = 120, seed: int = 1) -> Parts:
    config = scenario('paper', {'pings': pings})
    scene = simulate(config, seed)
    yield {'pings': pings, 'seed': seed}
    for name in CLASSICAL:
        yield {'methods': {name: score(classical(name, scene, config), scene)}}
    for name, values in TRACKERS.items():
        answer = tracked(values, scene, printed=name.endswith(', paper'))
        yield {'methods': {name: score(answer, scene)}}


if __name__ == '__main__':
    study(main)
