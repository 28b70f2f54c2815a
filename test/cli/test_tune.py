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

"""What `sonar-imm tune` makes of recordings, and of what a user can get wrong."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import yaml

from sonar_imm.measurements import Fix
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm_tools.cli import main
from sonar_imm_tools.evaluation.diver.predictive import Scored
from sonar_imm_tools.evaluation.tuning import Tunable

QUICK = ['--system', 'diver', '--set', 'model_set=cv', '--parameters', 'covariance_scale']


def dive(folder: Path, duration: int) -> Path:
    bag = folder / f'dive_{duration}.bag'
    settings = ['--set', f'duration={duration}']
    assert main(['simulate', 'diver', str(bag), '--scenario', 'straight', *settings]) == 0
    return bag


def test_covariances_that_are_too_small_are_found_and_written(tmp_path: Path) -> None:
    bag, out = dive(tmp_path, 100), tmp_path / 'tuned.yaml'
    assert (
        main(['tune', str(bag), *QUICK, '--set', 'covariance_scale=0.1', '--out', str(out)]) == 0
    )
    written = yaml.safe_load(out.read_text())['/**']['ros__parameters']
    assert written['model_set'] == 'cv' and 0.5 < written['covariance_scale'] <= 1.0
    assert main(['track', str(bag), str(tmp_path / 'run'), '--params', str(out)]) == 0


def test_what_cannot_be_told_is_not_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag, out = dive(tmp_path, 60), tmp_path / 'tuned.yaml'
    assert main(['tune', str(bag), *QUICK, '--out', str(out)]) == 0
    assert 'covariance_scale: flat' in capsys.readouterr().out
    assert not out.exists()


@pytest.mark.parametrize(
    ('duration', 'name', 'sentence'),
    [
        (5, 'covariance_scale', 'too little to fit'),
        (30, 'covariance_scal', "did you mean 'covariance_scale'"),
        (30, 'max_tracks', 'cannot be fitted'),
    ],
)
def test_bad_input_is_named(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    duration: int,
    name: str,
    sentence: str,
) -> None:
    bag = dive(tmp_path, duration)
    options = ['--system', 'diver', '--set', 'model_set=cv']
    assert main(['tune', str(bag), *options, '--parameters', name]) == 2
    assert sentence in capsys.readouterr().err


def test_bounds_are_those_of_the_parameter() -> None:
    tunable = Tunable(name='covariance_scale', start=1.0, least=1.0)
    assert tunable.bounds(DiverConfig())[0] == 0.0
    stay = Tunable(name='stay_probability', start=0.9, kind='logit')
    assert stay.value(stay.coordinate(0.9)) == pytest.approx(0.9)


def kalman(z: np.ndarray, R: float, noise: float) -> float:
    """Log likelihood of fixes (n, 2) once a second, of one constant velocity."""
    F = np.array([[1.0, 1.0], [0.0, 1.0]])
    Q = noise**2 * np.array([[1.0 / 3.0, 0.5], [0.5, 1.0]])
    total = 0.0
    for axis in z.T:
        x, P = np.array([axis[0], 0.0]), np.diag([R, 0.49])
        for value in axis[1:]:
            x, P = F @ x, F @ P @ F.T + Q
            S, innovation = P[0, 0] + R, value - x[0]
            total -= 0.5 * (innovation**2 / S + math.log(2.0 * math.pi * S))
            K = P[:, 0] / S
            x, P = x + K * innovation, P - np.outer(K, P[0])
    return total


def test_the_score_of_one_model_is_the_likelihood_of_a_kalman_filter() -> None:
    rng = np.random.default_rng(3)
    z = np.cumsum(rng.normal(0.3, 0.05, (40, 2)), axis=0) + rng.normal(0.0, 0.5, (40, 2))

    def score(scale: float, noise: float) -> float:
        config = DiverConfig(
            model_set='cv',
            acceleration_noise=(noise,),
            covariance_scale=scale,
            max_tracks=1,
            clutter_density=1e-12,
            birth_density=1e-12,
            gate_probability=0.9999999,
        )
        tracker = Scored(config)
        for second, place in enumerate(z, start=1):
            position = np.array([*place, 0.0])
            fix = Fix(stamp_ns=second * 10**9, position=position, covariance=0.25 * np.eye(2))
            tracker.process(fix)
        return math.fsum(value for value, _ in tracker.scores.values())

    for scale, noise in ((2.0, 0.1), (1.0, 0.3)):
        expected = kalman(z, 0.25 * scale, noise) - kalman(z, 0.25, 0.1)
        assert score(scale, noise) - score(1.0, 0.1) == pytest.approx(expected, abs=1e-6)
