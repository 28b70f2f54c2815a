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

from collections.abc import Callable, Mapping
from typing import Any

from benchmarks.bathymetry_scenes import judged
from benchmarks.study import Parts, study

SIGMAS = (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
PAPER = {'variant': 'paper'}
SETS: dict[str, Callable[[float], dict[str, Any]]] = {
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
    metrics = judged(*CASES[name], pings, seed)
    return {
        **{f'{k}_m': metrics['height'][k]['rmse_m'] for k in ('smooth', 'patch', 'all')},
        'within': metrics['inside_band']['all'],
        'overlap': metrics['segmentation']['iou'],
    }


def main(pings: int = 40, seed: int = 1, only: str = '') -> Parts:
    yield {'pings': pings, 'seed': seed}
    for name in CASES:
        if name.startswith(only):
            yield {'cases': {name: run(name, pings, seed)}}


if __name__ == '__main__':
    study(main, only={'help': 'cases whose name begins so'})
