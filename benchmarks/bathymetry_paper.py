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

"""The paper's claims at the paper's settings: sensitivity to its noises, and other laws.

    python -m benchmarks.bathymetry_paper --out docs/results/bathymetry_paper.json

`variant: paper` throughout the first part: the sets as printed, over noises of the rough random
walk from .05 to 5 m. The second part is the default tracker on scenes whose roughness and fading
are not drawn from the laws that it supposes. RMSE of the height (m) on smooth floor, in the patch
and in all, the share of heights within two standard deviations, and the overlap of the patch with
the bins labelled rough.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.tables import markdown, write_json
from msg_adapters.estimates import read_estimate
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.evaluation.bathymetry.profiles import profiles_of
from sonar_imm_tools.evaluation.bathymetry.scoring import score
from sonar_imm_tools.recordings.truth import records_of
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

SIGMAS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
PAPER = {'variant': 'paper'}
SETS = {
    'height_rw_ncs': lambda sigma: {'model_set': 'height_rw_ncs', 'sigmas': (sigma, 1.0)},
    'height_two_rw': lambda sigma: {'model_set': 'height_two_rw', 'sigmas': (0.01, sigma)},
}
BANK = {'model_set': 'height_bank'}
LAWS: dict[str, tuple[str, Mapping[str, Any], Mapping[str, Any]]] = {
    'as supposed': ('paper', {}, {}),
    'noise does not fade': ('thermal', {}, {}),
    'roughness with Laplace tails': ('paper', {'roughness_law': 'laplace'}, {}),
    'roughness fractal': ('paper', {'roughness_law': 'fractal'}, {}),
    'echoes with heavier tails': ('paper', {'law': 'k'}, {}),
    'all three, fractal': ('foreign', {}, {}),
    'all three, fractal, bank': ('foreign', {}, BANK),
}
CASES: dict[str, tuple[str, Mapping[str, Any], Mapping[str, Any]]] = {
    **{
        f'{name}, {sigma:g} m': ('paper', {}, {**PAPER, **values(sigma)})
        for name, values in SETS.items()
        for sigma in SIGMAS
    },
    'angle_two_rw': ('paper', {}, {**PAPER, 'model_set': 'angle_two_rw'}),
    **LAWS,
}


def run(name: str, pings: int, seed: int) -> dict[str, float]:
    """Scores of one case."""
    scene_name, changes, values = CASES[name]
    scene = simulate(scenario(scene_name, {'pings': pings, **changes}), seed)
    tracker = BathymetryTracker(BathymetryConfig(**values))
    estimates = [tracker.process(item.measurement)[0] for item in scene.measurements]
    records = [record for true in scene.truth for record in records_of(true, '')]
    metrics = score(profiles_of(estimates, [read_estimate(message) for *_, message in records]))
    return {
        **{f'{k}_m': metrics['height'][k]['rmse_m'] for k in ('smooth', 'patch', 'all')},
        'within': metrics['inside_band']['all'],
        'overlap': metrics['segmentation']['iou'],
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--pings', type=int, default=40)
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--only', default='', help='cases whose name begins so')
    parser.add_argument('--out', type=Path, help='write the numbers here, as JSON')
    options = parser.parse_args()
    names = [name for name in CASES if name.startswith(options.only)]
    rows = {name: run(name, options.pings, options.seed) for name in names}
    print(f'{options.pings} pings, seed {options.seed}')
    print(markdown(rows))
    run_of = {'pings': options.pings, 'seed': options.seed}
    write_json(options.out, {**run_of, 'cases': rows})


if __name__ == '__main__':
    main()
