# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A side-scan array at sea: motion, refraction, unknown height, nadir, labels; with and without.

    python -m benchmarks.bathymetry_sea --out docs/results/bathymetry_sea.json

Prints RMSE of the height (m), the share of heights within two standard deviations (with navigation
those of the soundings), the overlap of rough patch and rough labels, and lost pings (RMSE above
1 m). Pings of moving scenes are 3.3 s apart: the errors of the navigation last seconds and are
common to a ping, so that closer pings would judge one error many times.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.bathymetry_paper import truth_of, WALKS
from benchmarks.study import Parts, study
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.evaluation.bathymetry.scoring import Profile, profiles_of, score
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate

APART: dict[str, Any] = {'ping_rate': 0.3, 'patch_along': []}
TERRAIN: dict[str, Any] = {'model_set': 'terrain'}
LOST = 1.0
"""Metres of RMSE from which a ping is lost."""


def unknown(height: float) -> dict[str, Any]:
    """A sonar at another height than it is told, the water column included."""
    return {**APART, 'sonar_height': height, 'first_range': 5.0}


STATED: dict[str, Any] = {'sonar_height': 15.0, 'sonar_height_std': 5.0}
LABELS = {
    'Gaussian .3 m': ('correlated', {'correlation_length': 0.3}),
    'Gaussian 1 m': ('correlated', {}),
    'undulation .5 m in 15 m': ('undulating', {}),
}
STAVES = ((0.5, 0.0, 0.0), (3.66, 0.2, 0.0), (3.66, 0.2, 0.2))
"""Spacing in wavelengths, and what staves differ by and are told to."""

# Name: scenario, what it changes, parameters beside those of the instruments.
CASES: dict[str, tuple[str, dict[str, Any], dict[str, Any]]] = {
    'motion, terrain': ('moving', APART, TERRAIN),
    'motion, walks': ('moving', APART, {}),
    'motion, navigation ignored': ('moving', APART, {'navigation': 'ignored'}),
    'summer profile, terrain': ('moving_profile', APART, TERRAIN),
    'summer profile ignored': ('moving_profile', APART, {'sound_speed_profile': []}),
    'height 10 m, told 15, terrain': ('moving', unknown(10.0), {**STATED, **TERRAIN}),
    'nadir, terrain': ('paper', {'first_range': 15.1}, TERRAIN),
    **{
        f'labels, {name}, terrain': (scene, changes, TERRAIN)
        for name, (scene, changes) in LABELS.items()
    },
    **{
        f'coupling {strength:g}, terrain': ('moving', {}, {**TERRAIN, 'ping_coupling': strength})
        for strength in (0.0, 0.15)
    },
    **{
        f'staves 2, {spacing:g} wavelengths, {share:.0%} differ, told {stated:.0%}': (
            'paper',
            {'staves': 2, 'spacing_wavelengths': spacing, 'decorrelation': share},
            {'decorrelation': stated},
        )
        for spacing, share, stated in STAVES
    },
}


def run(name: str, pings: int, seed: int) -> dict[str, float]:
    """Scores of one case."""
    scene_name, changes, values = CASES[name]
    config = scenario(scene_name, {'pings': pings, **changes})
    scene = simulate(config, seed)
    inputs = frozenset({'snapshot', 'nav'} if config.moving else {'snapshot'})
    given = {**config.instruments(), **WALKS, **values}
    settings = BathymetryConfig(**given).for_inputs(inputs)
    if settings.navigation == 'ignored' and settings.sound_speed_profile:
        raise ValueError('a profile needs navigation')
    tracker = BathymetryTracker(settings)
    estimates = [
        estimate for item in scene.measurements for estimate in tracker.process(item.measurement)
    ]
    estimates += tracker.finish()
    swath = profiles_of(estimates, truth_of(scene))
    if config.moving and settings.navigation == 'ignored':
        level = config.water_level - config.sonar_depth - config.sonar_height
        for profile in swath.profiles:
            assert profile.truth is not None
            profile.truth.height[:] -= level  # a sonar at rest counts from its reference floor
    metrics = score(swath)
    return {
        'rmse_m': metrics['height']['all']['rmse_m'],
        'inside_two_sd': metrics['inside_band']['all'],
        'iou': metrics.get('segmentation', {}).get('iou', float('nan')),
        'patch_rmse_m': metrics['height']['patch']['rmse_m'],
        'lost_pings': sum(_rmse(profile) > LOST for profile in swath.profiles),
        'pings': len(swath.profiles),
    }


def _rmse(profile: Profile) -> float:
    assert profile.truth is not None
    error = (profile.height - profile.truth.height)[profile.truth.echo]
    return float(np.sqrt(np.nanmean(np.square(error))))


def main(pings: int = 24, seed: int = 1, only: str = '') -> Parts:
    yield {'pings': pings, 'seed': seed}
    for name in CASES:
        if name.startswith(only):
            yield {'cases': {name: run(name, pings, seed)}}


if __name__ == '__main__':
    study(main, only={'help': 'cases whose name begins so'})
