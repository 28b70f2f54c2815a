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

"""What is attainable on the scene of the paper: every method on the same pings.

    python -m benchmarks.bathymetry_accuracy --out docs/results/bathymetry_accuracy.json

A flat floor 15 m below an array of eight staves, with a white rough patch of 0.5 m; 30 to 10 dB.
Prints RMSE of the height over smooth floor, patch and all, RMSE of the angle, intersection over
union of the patch with the bins labelled rough, the share of true heights within two standard
deviations, and, in brackets, what an independent prototype found before.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from sonar_imm.acoustics import array, spatial
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

PAPER_CHAIN = (0.98, 0.02, 0.02, 0.98)
SLOPES_ONLY = {'transition_matrix': (1.0, 0.0, 0.0, 1.0), 'initial_probabilities': (0.0, 1.0)}
SLOPE_SET = {'model_set': 'height_rw_ncs', 'sigmas': (1.0, 1.0)}
TWO = {'sigmas': (0.01, 1.0)}
QUICK = {'sigmas': (0.01, 0.7)}
GRID = {'engine': 'grid'}

# Name: parameters that differ from `COMMON`, and smooth, patch, all (m), angle (deg), overlap as
# found before by an independent prototype; None where it was not measured.
COMMON = {'shadow_gate': False, 'initial_std': 1.0}
TRACKERS = {
    'random walk only': (
        {'model_set': 'height_bank', 'sigmas': (1.0,), 'engine': 'particles'},
        (0.401, 0.331, 0.391, 0.41, None),
    ),
    'constant slope only': ({**SLOPE_SET, **SLOPES_ONLY}, (0.119, 0.499, 0.231, 0.30, None)),
    'height_rw_ncs, paper': (
        {**SLOPE_SET, 'transition_matrix': PAPER_CHAIN, 'variant': 'paper'},
        (0.106, 0.328, 0.165, 0.20, 0.72),
    ),
    'height_rw_ncs, corrected': (
        {**SLOPE_SET, 'transition_matrix': PAPER_CHAIN},
        (0.153, 0.327, 0.194, 0.22, 0.72),
    ),
    'height_two_rw': (
        {**TWO, 'transition_matrix': PAPER_CHAIN},
        (0.110, 0.327, 0.167, 0.20, 0.72),
    ),
    'height_two_rw, exact grid': (
        {**TWO, **GRID, 'transition_matrix': PAPER_CHAIN},
        (0.110, 0.325, 0.166, 0.20, 0.73),
    ),
    'height_two_rw, stay .995': (TWO, (0.070, 0.334, 0.151, None, 0.79)),
    'the same, modes smoothed': ({**TWO, 'smoothing': 'modes'}, (None, None, None, None, 0.83)),
    'exact forward-backward, stay .995, 0.7 m': (
        {**QUICK, **GRID, 'smoothing': 'states'},
        (0.036, 0.302, 0.128, None, 0.90),
    ),
    'height_bank': (
        {
            'model_set': 'height_bank',
            'sigmas': (0.01, 0.05, 0.3, 1.5),
            'rough_sigma': 0.3,
            'engine': 'particles',
            'stay_probability': 0.995,
        },
        (None,) * 5,
    ),
    'angle_two_rw': (
        {'model_set': 'angle_two_rw', 'initial_std': 0.0, 'angle_drift': False},
        (None,) * 5,
    ),
    'defaults': ({'shadow_gate': True, 'initial_std': 0.0}, (None,) * 5),
}
CLASSICAL = {
    'phase difference of one pair': (1.71, 0.98, 1.61, 1.51, None),
    'music': (0.186, 0.527, 0.274, 0.34, None),
    'capon': (0.258, 0.529, 0.320, 0.37, None),
}


class Answer(NamedTuple):
    """Height and angle of every bin of every ping (pings, T); rough: labels; inside: the truth
    lies within two standard deviations. None for methods that do not say."""

    height: np.ndarray
    angle: np.ndarray
    rough: np.ndarray | None
    inside: np.ndarray | None


def classical(name: str, scene, config) -> Answer:
    """Directions from windows of +-5 bins, without a tracker."""
    heights, angles = [], []
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
        angles.append(angle)
    return Answer(np.array(heights), np.array(angles), None, None)


def tracked(values: dict, scene) -> Answer:
    config = BathymetryConfig(**{**COMMON, **values})
    tracker = BathymetryTracker(config)
    tables = [tracker.process(item.measurement)[0].columns() for item in scene.measurements]
    height = np.array([table['height'] for table in tables])
    angle = np.array([table['angle'] for table in tables])
    truth = np.array([profile.height for profile in scene.truth])
    inside = rough = None
    if 'cov_height_height' in tables[0]:
        sd = np.sqrt([table['cov_height_height'] for table in tables])
        inside = np.abs(height - truth) < 2.0 * sd
    names = [key for key in tables[0] if key.startswith('prob_')]
    if len(names) > 1 and 'initial_probabilities' not in values:
        of_rough = ['prob_rw'] if 'prob_rw' in names else names[len(names) // 2 :]
        rough = np.array([sum(table[key] for key in of_rough) > 0.5 for table in tables])
    return Answer(height, angle, rough, inside)


def score(answer: Answer, scene) -> dict[str, float | None]:
    patch = np.array([profile.patch for profile in scene.truth])
    square = np.square(answer.height - [profile.height for profile in scene.truth])
    angular = np.square(answer.angle - [profile.angle for profile in scene.truth])
    rough, inside = answer.rough, answer.inside
    return {
        'smooth': math.sqrt(square[~patch].mean()),
        'patch': math.sqrt(square[patch].mean()),
        'all': math.sqrt(square.mean()),
        'angle_deg': math.degrees(math.sqrt(np.nanmean(angular))),
        'iou': None if rough is None else float((rough & patch).sum() / (rough | patch).sum()),
        'inside_smooth': None if inside is None else float(inside[~patch].mean()),
        'inside_patch': None if inside is None else float(inside[patch].mean()),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--pings', type=int, default=120)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--out', type=Path, help='write the numbers here, as JSON')
    options = parser.parse_args()
    config = scenario('paper', {'pings': options.pings})
    scene = simulate(config, options.seed)
    keys = ('smooth', 'patch', 'all', 'angle_deg', 'iou')
    print(f'{options.pings} pings, seed {options.seed}; in brackets: prototype')
    print(f'{"":42}' + ''.join(f'{key:>15}' for key in keys) + '  within 2 sd')
    results = {}
    for name, (values, sheet) in {
        **{name: (None, sheet) for name, sheet in CLASSICAL.items()},
        **TRACKERS,
    }.items():
        answer = classical(name, scene, config) if values is None else tracked(values, scene)
        results[name] = {**score(answer, scene), 'prototype': dict(zip(keys, sheet))}
        print(row(name, results[name], keys), flush=True)
    if options.out:
        run = {'pings': options.pings, 'seed': options.seed, 'methods': results}
        options.out.write_text(json.dumps(run, indent=2) + '\n')


def row(name: str, result: dict, keys: tuple[str, ...]) -> str:
    cells = []
    for key in keys:
        value, before = result[key], result['prototype'][key]
        shown = '-' if value is None else f'{value:.3f}'
        cells.append(f'{shown + ("" if before is None else f" ({before:g})"):>15}')
    smooth, patch = result['inside_smooth'], result['inside_patch']
    inside = '' if smooth is None else f'  {smooth:.3f} {patch:.3f}'
    return f'{name:42}' + ''.join(cells) + inside


if __name__ == '__main__':
    main()
