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

"""Whether `sonar-imm tune` finds what is true of simulated recordings that are not as the defaults
have it, or says that it cannot. One scene of each row, from the seed on.

    python -m benchmarks.tune --out docs/results/tune.json
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
import tempfile
import time

from benchmarks.study import Parts, study
from sonar_imm_tools.cli import main as sonar_imm
from sonar_imm_tools.cli.track import Plan
from sonar_imm_tools.evaluation.tuning import prepared, tune

ROWS: dict[str, tuple[str, str, dict[str, str], dict[str, str], str, float | None]] = {
    'diver, covariances 4 times too small': (
        'diver',
        'random_heading',
        {'duration': '300'},
        {'covariance_scale': '0.25', 'model_set': 'heading_speed'},
        'covariance_scale',
        1.0,
    ),
    'diver, covariances as stated': (
        'diver',
        'random_heading',
        {'duration': '300'},
        {'model_set': 'heading_speed'},
        'covariance_scale',
        1.0,
    ),
    'obstacle, ranges 3 times as noisy': (
        'obstacle',
        'approach',
        {'range_std': '0.45', 'first_range': '60'},
        {'behaviours': 'fixed'},
        'range_std',
        0.45,
    ),
    'fathometer, walk taken for 0.4 m': (
        'fathometer',
        'drift_traces',
        {'records': '60'},
        {'depth_std': '0.4', 'particles': '2000'},
        'depth_std',
        None,
    ),
    'bathymetry, rough patch': (
        'bathymetry',
        'paper',
        {'pings': '2', 'patch_std': '0.5'},
        {'sigmas': '0.01,0.1'},
        'sigmas',
        None,
    ),
}
"""System, scene, its settings, parameters to begin with, what is fitted, and what is true:
None where the scene has no such number. Reflectors of the drift move by .01 m from record to
record, by the tilt of the array and by .03 m of its depth; the heights of the rough patch are
white, with a standard deviation of .5 m, and the floor beside it is flat."""


def main(seed: int = 1, rows: Sequence[str] = tuple(ROWS)) -> Parts:
    yield {'seed': seed}
    for name in rows:
        system, scene, settings, begin, parameter, truth = ROWS[name]
        with tempfile.TemporaryDirectory() as folder:
            bag = Path(folder) / 'scene.bag'
            pairs = [text for k, v in settings.items() for text in ('--set', f'{k}={v}')]
            arguments = ['simulate', system, str(bag), '--scenario', scene, '--seed', str(seed)]
            if status := sonar_imm([*arguments, *pairs]):
                raise SystemExit(status)
            jobs = Plan(system=system, overrides=begin).jobs(bag, Path(folder))
            fitting, measurements = prepared(jobs, [parameter])
            start = time.process_time()
            found = tune(fitting, measurements)
        for row in found.parameters:
            yield {
                'rows': {
                    f'{name}: {row.name}': {
                        'before': row.before,
                        'true': truth,
                        'after': row.after,
                        'low': row.low,
                        'high': row.high,
                        'verdict': row.verdict,
                        'held_out_gain': found.held_out_gain,
                        'measurements': found.measurements,
                        'evaluations': found.evaluations,
                        'cpu_s': time.process_time() - start,
                    }
                }
            }


if __name__ == '__main__':
    study(main, rows={'choices': list(ROWS)})
