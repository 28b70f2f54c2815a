# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Whether `sonar-imm tune` finds the true parameters of simulated bags, or reports that the data
do not determine them. Most rows are fitted to `runs` bags: the value found in each, how many of
the fits were determined, and how many of those hold the truth within two standard errors.

    python -m benchmarks.tune --out docs/results/tune.json
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
import tempfile
from typing import Any, NamedTuple

import numpy as np

from benchmarks.study import DATA, Parts, study
from sonar_imm.trackers.diver.models import build_models
from sonar_imm.trackers.diver.tracker import DiverConfig
from sonar_imm_tools.cli import main as sonar_imm
from sonar_imm_tools.cli.track import Plan
from sonar_imm_tools.evaluation.tuning import prepared, tune, Tuned
from sonar_imm_tools.recordings.convert import convert_fixes

Settings = dict[str, str]


class Case(NamedTuple):
    """System, scene, its settings, parameters to begin with, what is fitted, and what is true:
    None where the scene has no such number; scenes of `MADE` are no scenarios."""

    system: str
    scene: str
    settings: Settings
    begin: Settings
    fitted: str = 'covariance_scale'
    true: Any = 1.0


HEADINGS = {'model_set': 'heading_speed'}
SMALL = {'covariance_scale': '0.25', **HEADINGS}
ROWS: dict[str, Case] = {
    'diver, covariances 4 times too small': Case(
        'diver', 'random_heading', {'duration': '300'}, SMALL
    ),
    'diver, covariances as stated': Case('diver', 'random_heading', {'duration': '300'}, HEADINGS),
    'diver who moves as the model says, covariances 4 times too small': Case(
        'diver', 'as modelled', {'fixes': '300'}, SMALL
    ),
    'diver, velocities that wander by 0.1, covariances 6 times too small': Case(
        'diver',
        'wandering',
        {'fixes': '400', 'noise': '0.1'},
        {'covariance_scale': '0.1666667', 'model_set': 'bench_cv', 'acceleration_noise': '0.3'},
        'covariance_scale,acceleration_noise',
        (1.0, 0.1),
    ),
    **{
        f'diver who moves as the model says, covariances {factor} times too small': Case(
            'diver', 'as modelled', {'fixes': '100', 'factor': str(factor)}, {}, true=factor
        )
        for factor in (25, 60, 1000)
    },
    'tow tag, a fix in 29 s': Case(
        'diver', 'tow tag', {}, {'max_coast': '600', 'target_z': '-1', **HEADINGS}, true=None
    ),
    'obstacle, ranges 3 times as noisy': Case(
        'obstacle',
        'approach',
        {'range_std': '0.45', 'first_range': '60'},
        {'behaviours': 'fixed'},
        'range_std',
        0.45,
    ),
    'fathometer, walk taken for 0.4 m': Case(
        'fathometer',
        'drift_traces',
        {'records': '60'},
        {'depth_std': '0.4', 'particles': '2000'},
        'depth_std',
        None,
    ),
    'bathymetry, rough patch': Case(
        'bathymetry',
        'paper',
        {'pings': '2', 'patch_std': '0.5'},
        {'model_set': 'height_two_rw', 'sigmas': '0.01,0.1'},
        'sigmas',
        None,
    ),
}
"""Reflectors of the drift move by .01 m from record to record, by the tilt of the array and by
.03 m of its depth; the heights of the rough patch are white, with a standard deviation of .5 m,
and the floor beside it is flat."""


ONCE = ('tow tag, a fix in 29 s',)
"""Rows with one recording only: there is no other."""


def wandering(out: Path, seed: int, fixes: str, noise: str) -> None:
    """A target with a velocity that wanders by `noise` m/s in the root of a second."""
    rng = np.random.default_rng(seed)
    q = float(noise) ** 2 * np.array([[1.0 / 3.0, 0.5], [0.5, 1.0]])
    F, L = np.array([[1.0, 1.0], [0.0, 1.0]]), np.linalg.cholesky(q)
    x, places = np.array([[0.0, 0.0], [0.5, 0.3]]), []
    for _ in range(int(fixes)):
        x = F @ x + L @ rng.normal(size=(2, 2))
        places.append(x[0] + rng.normal(size=2))
    _written(out, places)


def as_modelled(out: Path, seed: int, fixes: str, factor: str = '1') -> None:
    """A diver drawn from the models of `heading_speed`; the variances of the fixes are `factor`
    times what the messages contain."""
    rng, models = np.random.default_rng(seed), build_models(DiverConfig(model_set='heading_speed'))
    P, (F, Q, _) = models.chain.transition(1.0), models.motion(1.0)
    x, model, places = np.array([0.0, 0.0, 0.75]), 0, []
    for _ in range(int(fixes)):
        model = rng.choice(len(P), p=P[model])
        x = rng.multivariate_normal(F[model] @ x, Q[model])
        places.append(x[:2] + rng.normal(size=2))
    _written(out, places, 1.0 / float(factor))


def _written(out: Path, places: list[np.ndarray], variance: float = 1.0) -> None:
    """Write a bag of fixes, one a second, with this variance per axis."""
    csv = out.with_suffix('.csv')
    lines = ['stamp_s,east_m,north_m,var_east_m2,cov_east_north_m2,var_north_m2']
    for second, (east, north) in enumerate(places):
        lines.append(f'{1_700_000_000 + second},{east:.4f},{north:.4f},{variance},0.0,{variance}')
    csv.write_text('\n'.join(lines) + '\n', encoding='utf-8')
    convert_fixes(csv, out)


def tow_tag(out: Path, seed: int) -> None:
    """The fixes of the towed tag (`recordings`)."""
    if not DATA.is_dir():
        raise SystemExit(f'no recordings at {DATA}: set SONAR_IMM_DATA')
    convert_fixes(DATA / 'yaps_ssu1' / 'fixes.csv', out)


MADE: dict[str, Callable[..., None]] = {
    'wandering': wandering,
    'as modelled': as_modelled,
    'tow tag': tow_tag,
}


def fitted(name: str, seed: int) -> Tuned:
    """What is found in a recording of a row."""
    system, scene, settings, begin, parameter, _ = ROWS[name]
    with tempfile.TemporaryDirectory() as folder:
        bag = Path(folder) / 'scene.bag'
        pairs = [text for k, v in settings.items() for text in ('--set', f'{k}={v}')]
        arguments = ['simulate', system, str(bag), '--scenario', scene, '--seed', str(seed)]
        if scene in MADE:
            MADE[scene](bag, seed, **settings)
        elif status := sonar_imm([*arguments, *pairs]):
            raise SystemExit(status)
        jobs = Plan(system=system, overrides=begin).jobs(bag, Path(folder))
        return tune(*prepared(jobs, parameter.split(',')))


def main(runs: int = 3, rows: Sequence[str] = tuple(ROWS)) -> Parts:
    yield {'runs': runs}
    for name in rows:
        seeds = range(1, 1 + (1 if name in ONCE else runs))
        found = [fitted(name, seed) for seed in seeds]
        truth = ROWS[name].true
        true = truth if isinstance(truth, tuple) else [truth] * len(found[0].parameters)
        for place, value in enumerate(true):
            each = [one.parameters[place] for one in found]
            determined = [one for one in each if one.determined]
            yield {
                'rows': {
                    f'{name}: {each[0].name}': {
                        'before': each[0].before,
                        'true': value,
                        **{f'after {i}': one.after for i, one in enumerate(each, start=1)},
                        'intervals': [[one.low, one.high] for one in each],
                        'determined': len(determined),
                        'inside': None
                        if value is None
                        else sum(one.low <= value <= one.high for one in determined),
                    }
                }
            }


if __name__ == '__main__':
    study(main, rows={'choices': list(ROWS)})
