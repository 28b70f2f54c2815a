# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What goes wrong on difficult floors, and what helps: the same pings without and with the remedy.

    python -m benchmarks.bathymetry_scenes --out docs/results/bathymetry_scenes.json

Prints RMSE of the height over smooth floor, patch and all bins with an echo (m), the overlap of
the rough patch with the bins labelled rough, and the share of heights within two standard
deviations. The first two rows are the errata of the paper at work.
"""

from __future__ import annotations

from typing import Any

from benchmarks.bathymetry_accuracy import PAPER_CHAIN, SLOPE_SET, SLOPES_ONLY
from benchmarks.bathymetry_paper import Case, judged, PRINTED, PrintedTracker
from benchmarks.study import Parts, Row, study

OPEN: dict[str, Any] = {'gate_false_alarm': 1.0}
SLOPE: dict[str, Any] = {**OPEN, **SLOPE_SET, **SLOPES_ONLY}
FLAT: dict[str, Any] = {'patch_std': 0.0, 'slope': 0.1}

CASES: dict[str, Case] = {
    'slope .1, constant slope only, paper': Case(
        'slope',
        FLAT,
        {**PRINTED, **SLOPE_SET, **SLOPES_ONLY},
        PrintedTracker,
    ),
    'slope .1, constant slope only, corrected': Case('slope', FLAT, SLOPE),
    'slope .1 and patch, height_rw_ncs, paper': Case(
        'slope',
        {},
        {**PRINTED, **SLOPE_SET, 'transition_matrix': PAPER_CHAIN},
        PrintedTracker,
    ),
    'slope .1 and patch, height_rw_ncs, corrected': Case(
        'slope',
        {},
        {**OPEN, **SLOPE_SET, 'transition_matrix': PAPER_CHAIN},
    ),
    'shadows, no gate': Case('shadow', {}, OPEN),
    'shadows, gate': Case('shadow', {}, {}),
    'spikes, no gate': Case('spikes', {}, OPEN),
    'spikes, gate': Case('spikes', {}, {}),
    'multipath, not expected': Case('multipath', {}, {}),
    'multipath, expected': Case('multipath', {}, {'multipath': True}),
    'noise not stated': Case('water_column', {}, {}),
    'Gaussian echoes, Laplace law': Case('gaussian', {}, {}),
    'Gaussian echoes, Gaussian law': Case('gaussian', {}, {'likelihood': 'gaussian'}),
    'Laplace echoes, Gaussian law': Case('paper', {}, {'likelihood': 'gaussian'}),
    'undulating, two walks': Case('undulating', {}, {}),
    'undulating, terrain': Case('undulating', {}, {'model_set': 'terrain'}),
    'roughness correlated, .01 and 1 m': Case('correlated', {}, {'sigmas': (0.01, 1.0)}),
    'roughness correlated, defaults': Case('correlated', {}, {}),
    'roughness correlated, .01 and .15 m': Case('correlated', {}, {'sigmas': (0.01, 0.15)}),
    'bins four times as fine': Case('paper', {'bin_width': 0.0125}, {'sigma_reference_bin': 0.05}),
}


def main(pings: int = 60, seed: int = 1) -> Parts:
    yield {'pings': pings, 'seed': seed}
    for name, case in CASES.items():
        yield {'cases': {name: judged(case, pings, seed)}}


def shown(metrics: Row) -> dict[str, float]:
    """What is printed of the scores."""
    errors = {place: metrics['height'][place]['rmse_m'] for place in ('smooth', 'patch', 'all')}
    iou = metrics.get('segmentation', {}).get('iou', float('nan'))
    return errors | {'iou': iou, 'within 2 sd': metrics['inside_band']['all']}


if __name__ == '__main__':
    study(main, shown=shown)
