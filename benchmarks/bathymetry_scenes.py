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

"""What goes wrong on difficult floors, and what helps: the same pings without and with the remedy.

    python -m benchmarks.bathymetry_scenes --out docs/results/bathymetry_scenes.json

Prints RMSE of the height over smooth floor, patch and all bins with an echo (m), the overlap of
the rough patch with the bins labelled rough, and the share of heights within two standard
deviations. The first two rows are the errata of the paper at work.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from benchmarks.bathymetry_accuracy import PAPER_CHAIN, SLOPE_SET, SLOPES_ONLY
from benchmarks.study import Parts, Row, study
from msg_adapters.estimates import read_estimate
from sonar_imm.estimates import Estimate
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm.truth import Scene
from sonar_imm_tools.evaluation.bathymetry.profiles import profiles_of
from sonar_imm_tools.evaluation.bathymetry.scoring import score
from sonar_imm_tools.recordings.truth import records_of
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

BANK: dict[str, Any] = {
    'model_set': 'height_bank',
    'sigmas': (0.01, 0.05, 0.3, 1.5),
    'rough_sigma': 0.3,
    'engine': 'particles',
    'stay_probability': 0.995,
}
"""The coarse bank; for the default one see `bathymetry_sea`."""
OPEN: dict[str, Any] = {'shadow_gate': False}
SLOPE: dict[str, Any] = {**OPEN, **SLOPE_SET, **SLOPES_ONLY}
FLAT: dict[str, Any] = {'patch_std': 0.0, 'slope': 0.1}

# Name: scenario, what it changes, parameters.
CASES: dict[str, tuple[str, Mapping[str, Any], Mapping[str, Any]]] = {
    'slope .1, constant slope only, paper': ('slope', FLAT, {**SLOPE, 'variant': 'paper'}),
    'slope .1, constant slope only, corrected': ('slope', FLAT, SLOPE),
    'slope .1 and patch, height_rw_ncs, paper': (
        'slope',
        {},
        {**OPEN, **SLOPE_SET, 'transition_matrix': PAPER_CHAIN, 'variant': 'paper'},
    ),
    'slope .1 and patch, height_rw_ncs, corrected': (
        'slope',
        {},
        {**OPEN, **SLOPE_SET, 'transition_matrix': PAPER_CHAIN},
    ),
    'shadows, no gate': ('shadow', {}, OPEN),
    'shadows, gate': ('shadow', {}, {}),
    'spikes, no gate': ('spikes', {}, OPEN),
    'spikes, gate': ('spikes', {}, {}),
    'multipath, not expected': ('multipath', {}, {}),
    'multipath, expected': ('multipath', {}, {'multipath': True}),
    'noise not stated': ('water_column', {}, {}),
    'Gaussian echoes, Laplace law': ('gaussian', {}, {}),
    'Gaussian echoes, Gaussian law': ('gaussian', {}, {'likelihood': 'gaussian'}),
    'Laplace echoes, Gaussian law': ('paper', {}, {'likelihood': 'gaussian'}),
    'undulating, two walks': ('undulating', {}, {}),
    'undulating, bank': ('undulating', {}, BANK),
    'roughness correlated, .01 and 1 m': ('correlated', {}, {'sigmas': (0.01, 1.0)}),
    'roughness correlated, defaults': ('correlated', {}, {}),
    'roughness correlated, .01 and .15 m': ('correlated', {}, {'sigmas': (0.01, 0.15)}),
    'bins four times as fine': ('paper', {'bin_width': 0.0125}, {'sigma_reference_bin': 0.05}),
}


def judged(
    scene_name: str, changes: Mapping[str, Any], values: Mapping[str, Any], pings: int, seed: int
) -> dict[str, Any]:
    """Scores of a tracker with `values` on a scene with `changes`."""
    scene = simulate(scenario(scene_name, {'pings': pings, **changes}), seed)
    tracker = BathymetryTracker(BathymetryConfig(**values))
    estimates = [tracker.process(item.measurement)[0] for item in scene.measurements]
    return score(profiles_of(estimates, truth_of(scene)))


def truth_of(scene: Scene) -> list[Estimate]:
    """The true floor of each ping, as a recording has it."""
    records = [record for true in scene.truth for record in records_of(true, '')]
    return [read_estimate(message) for *_, message in records]


def main(pings: int = 60, seed: int = 1) -> Parts:
    yield {'pings': pings, 'seed': seed}
    for name, case in CASES.items():
        yield {'cases': {name: judged(*case, pings, seed)}}


def shown(metrics: Row) -> dict[str, float]:
    """What is printed of the scores."""
    errors = {place: metrics['height'][place]['rmse_m'] for place in ('smooth', 'patch', 'all')}
    iou = metrics.get('segmentation', {}).get('iou', float('nan'))
    return errors | {'iou': iou, 'within 2 sd': metrics['inside_band']['all']}


if __name__ == '__main__':
    study(main, shown=shown)
