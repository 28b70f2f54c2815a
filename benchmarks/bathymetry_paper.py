# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The paper's claims at the paper's settings: sensitivity to its noises, and other laws.

    python -m benchmarks.bathymetry_paper --out docs/results/bathymetry_paper.json

The first part runs the tracker as printed (`PrintedTracker` with the parameters `PRINTED`) over
noises of the rough random walk from .05 to 5 m. The second part is the default tracker on scenes
whose roughness and fading are not drawn from the laws that it supposes, and on difficult ones
without and with the remedy. RMSE of the height (m) on smooth floor, in the patch and in all, the
share of heights within two standard deviations, and the overlap of the patch with the bins
labelled rough.

`methods`: what is attainable on the scene of the paper, every method on the same pings: a flat
floor 15 m below an array of eight staves, with a white rough patch of 0.5 m; 30 to 10 dB.

    python -m benchmarks.bathymetry_paper --parts methods --pings 120 --add --out FILE
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
import math
from typing import Any, NamedTuple

from attrs import evolve
import numpy as np

from benchmarks.study import Parts, study, truths
from msg_adapters.estimates import read_estimate
from sonar_imm.acoustics import array, spatial
from sonar_imm.estimates import Estimate
from sonar_imm.trackers.bathymetry.ping import (
    Answer,
    Look,
    look,
    Ping,
    run_particles,
    summarise,
)
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm.truth import Scene, TrueProfile
from sonar_imm_tools.evaluation.bathymetry.scoring import profiles_of, score
from sonar_imm_tools.recordings.truth import records_of
from sonar_imm_tools.simulation.bathymetry.simulator import BathymetryScenario, scenario, simulate

EXACT_ARRAY: dict[str, Any] = {'tilt_std_deg': 0.0, 'spacing_std': 0.0, 'sound_speed_std': 0.0}
"""The array is what it is said to be: covariances are those of the filter."""
WALKS: dict[str, Any] = {'model_set': 'height_two_rw', **EXACT_ARRAY}
"""The models of the paper, for rows that name no others."""
PRINTED: dict[str, Any] = {
    **WALKS,
    'stay_probability': 0.98,
    'gate_false_alarm': 1.0,
    'layover': 'ignored',
    'angle_drift': False,
    'redrawn_slope_std': 0.0,
}
"""The paper's values of parameters that do not depend on the model set. What the paper does not
state, the first state and the variances, has its default."""
SETS: dict[str, Callable[[float], dict[str, Any]]] = {
    'height_rw_ncs': lambda sigma: {
        **PRINTED,
        'model_set': 'height_rw_ncs',
        'sigmas': (sigma, 1.0),
    },
    'height_two_rw': lambda sigma: {**PRINTED, 'sigmas': (0.01, sigma)},
}
"""The paper's sets of heights, by the noise of the rough walk, m; in the paper it is 1 m."""
ANGLES: dict[str, Any] = {**PRINTED, 'model_set': 'angle_two_rw'}


def as_printed(ping: Ping) -> Look:
    """Return the likelihood and the models of a ping with F_NCS as printed: dS^2/2 in place of the
    1 that keeps the slope."""
    seen = look(ping)
    F = seen.models.F.copy()
    if ping.config.model_set == 'height_rw_ncs':
        F[1, 1, 1] = 0.5 * float(np.median(np.diff(seen.likelihood.ranges))) ** 2
    return evolve(seen, models=evolve(seen.models, F=F))


class PrintedTracker(BathymetryTracker):
    """The tracker with the two formulas of the paper that no parameter has: F_NCS, and particles
    resampled after each update. For a sonar at rest, without `smoothing` and `ping_coupling`."""

    @staticmethod
    def work(task: Ping) -> Answer:
        """Return the answer of a ping, its models run by particles."""
        seen = as_printed(task)
        entropy = task.config.seed, task.snapshot.stamp_ns, int(seen.swath.side == 'port')
        particles = task.config.particles_per_model
        track = run_particles(seen.models, seen.likelihood, particles, entropy, resample=True)
        # They add up to one but for rounding: none may pass it for that.
        return summarise(seen, track._replace(probability=np.minimum(track.probability, 1.0)))


class Case(NamedTuple):
    """A scenario, what it changes, the parameters of the tracker, and which tracker."""

    scene: str
    changes: Mapping[str, Any]
    values: Mapping[str, Any]
    tracker: type[BathymetryTracker] = BathymetryTracker


CASES: dict[str, Case] = {
    **{
        f'{name}, {sigma:g} m': Case('paper', {}, values(sigma), PrintedTracker)
        for name, values in SETS.items()
        for sigma in (0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
    },
    'angle_two_rw': Case('paper', {}, ANGLES, PrintedTracker),
    'as supposed': Case('paper', {}, {}),
    'noise does not fade': Case('thermal', {}, {}),
    'roughness with Laplace tails': Case('paper', {'roughness_law': 'laplace'}, {}),
    'roughness fractal': Case('paper', {'roughness_law': 'fractal'}, {}),
    'echoes with heavier tails': Case('paper', {'law': 'k'}, {}),
    'all three, fractal': Case('foreign', {}, {}),
    'all three, fractal, terrain': Case('foreign', {}, {'model_set': 'terrain'}),
    'spikes, no gate': Case('spikes', {}, {'gate_false_alarm': 1.0}),
    'spikes, gate': Case('spikes', {}, {}),
    'surface echoes, not expected': Case('multipath', {}, {}),
    'surface echoes, expected': Case('multipath', {}, {'multipath': True}),
}


def judged(case: Case, pings: int, seed: int) -> dict[str, Any]:
    """Return the scores of a case."""
    scene = simulate(scenario(case.scene, {'pings': pings, **case.changes}), seed)
    tracker = case.tracker(BathymetryConfig(**{**WALKS, **case.values}))
    estimates = [tracker.process(item.measurement)[0] for item in scene.measurements]
    return score(profiles_of(estimates, truth_of(scene)))


def truth_of(scene: Scene) -> list[Estimate]:
    """Return the true floor of each ping, as a bag has it."""
    records = [record for true in scene.truth for record in records_of(true, '')]
    return [read_estimate(message) for *_, message in records]


def run(name: str, pings: int, seed: int) -> dict[str, float]:
    """Scores of one case."""
    metrics = judged(CASES[name], pings, seed)
    return {
        **{f'{k}_m': metrics['height'][k]['rmse_m'] for k in ('smooth', 'patch', 'all')},
        'within': metrics['inside_band']['all'],
        'overlap': metrics['segmentation']['iou'],
    }


# -- every method on the same pings ---------------------------------------------------------------

PAPER_CHAIN = (0.98, 0.02, 0.02, 0.98)
SLOPES_ONLY: dict[str, Any] = {
    'transition_matrix': (1.0, 0.0, 0.0, 1.0),
    'initial_probabilities': (0.0, 1.0),
}
SLOPE_SET: dict[str, Any] = {'model_set': 'height_rw_ncs', 'sigmas': (1.0, 1.0)}
COMMON: dict[str, Any] = {**WALKS, 'gate_false_alarm': 1.0, 'initial_std': 1.0}
METHODS: dict[str, dict[str, Any]] = {
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


class Found(NamedTuple):
    """Height of every bin of every ping (pings, T); rough: labels; inside: the truth lies within
    two standard deviations. None for methods that do not say."""

    height: np.ndarray
    rough: np.ndarray | None
    inside: np.ndarray | None


def classical(name: str, scene: Scene, config: BathymetryScenario) -> Found:
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
    return Found(np.array(heights), None, None)


def tracked(values: Mapping[str, Any], scene: Scene, printed: bool) -> Found:
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
    return Found(height, rough, inside)


def scores(answer: Found, scene: Scene) -> dict[str, Any]:
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


def main(
    pings: int = 40, seed: int = 1, only: str = '', parts: Sequence[str] = ('cases',)
) -> Parts:
    if 'cases' in parts:
        yield {'pings': pings, 'seed': seed}
        for name in CASES:
            if name.startswith(only):
                yield {'cases': {name: run(name, pings, seed)}}
    if 'methods' in parts:
        config = scenario('paper', {'pings': pings})
        scene = simulate(config, seed)
        yield {'pings of methods': pings}
        for name in CLASSICAL:
            yield {'methods': {name: scores(classical(name, scene, config), scene)}}
        for name, values in METHODS.items():
            answer = tracked(values, scene, printed=name.endswith(', paper'))
            yield {'methods': {name: scores(answer, scene)}}


if __name__ == '__main__':
    study(
        main,
        only={'help': 'cases whose name begins so'},
        parts={'choices': ('cases', 'methods')},
    )
