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

"""Scores of runs whose errors are known."""

import json

from helpers.dive_scenes import (
    covariance,
    estimate_at,
    legs,
    SECOND,
    single_run,
    stamps,
    START_NS,
    truth_estimate,
)
import numpy as np
import pytest

from sonar_imm.measurements import Fix
from sonar_imm_tools.evaluation.diver.scoring import fix_series, score
from sonar_imm_tools.evaluation.diver.series import series_of
from sonar_imm_tools.evaluation.diver.truth import Truth
from sonar_imm_tools.offline.run_folder import finite


def scored(estimates, truth, **options):
    return score(series_of(estimates), Truth.from_series(series_of(truth)), **options)


def test_errors_drawn_from_the_stated_covariance_are_believed():
    estimates, truth, _ = single_run(count=2000)
    metrics = scored(estimates, truth)
    consistency = metrics['consistency']
    assert consistency['nees_position']['believable'] and consistency['nees_state']['believable']
    assert consistency['nis']['believable'] and consistency['nis']['dof'] == 2
    for level, share in consistency['coverage'].items():
        # four binomial standard deviations
        p = float(level) / 100.0
        assert share == pytest.approx(p, abs=4.0 * np.sqrt(p * (1.0 - p) / 2000))
    trace = covariance()[0, 0] + covariance()[1, 1]
    assert metrics['position']['rmse_m'] == pytest.approx(np.sqrt(trace), rel=0.05)


def test_errors_twice_as_large_as_stated_are_not():
    estimates, truth, _ = single_run(count=500, spread=2.0)
    consistency = scored(estimates, truth)['consistency']
    assert not consistency['nees_position']['believable']
    assert consistency['nees_position']['mean'] == pytest.approx(8.0, rel=0.15)
    assert consistency['coverage']['95'] < 0.85


def test_numbers_of_three_known_errors():
    truth = [truth_estimate(START_NS + k * SECOND, [[0.0] * 4], [1]) for k in range(3)]
    errors = [[3.0, 4.0, 0.0, 1.0], [0.0, 1.0, 0.0, 1.0], [0.0, 2.0, 2.0, 1.0]]
    estimates = [
        estimate_at(START_NS + k * SECOND, [error], [1], stated=np.eye(4))
        for k, error in enumerate(errors)
    ]
    metrics = scored(estimates, truth)
    assert (metrics['stamps'], metrics['span_s']) == (3, 2.0)
    assert metrics['position']['rmse_m'] == pytest.approx(np.sqrt(30.0 / 3.0))
    assert metrics['position']['median_m'] == pytest.approx(2.0)
    assert metrics['velocity']['rmse_mps'] == pytest.approx(np.sqrt(7.0 / 3.0))
    assert metrics['consistency']['nees_position']['mean'] == pytest.approx(10.0)
    assert metrics['consistency']['nees_state']['mean'] == pytest.approx(37.0 / 3.0)


def test_raw_fixes_are_scored_beside_the_track():
    estimates, truth, times = single_run(count=40)
    fixes = [
        Fix(stamp_ns=stamp, position=[*(place + [0.0, 2.0]), 0.0])
        for stamp, place in zip(stamps(times), legs(times)[:, :2])
    ]
    metrics = scored(estimates, truth, fixes=fix_series(fixes))
    assert metrics['raw_fix']['rmse_m'] == pytest.approx(2.0)
    assert metrics['raw_fix']['n'] == 40


def test_a_lagging_track_tells_its_lag():
    times = np.arange(200) * 0.5
    truth = [
        truth_estimate(stamp, [state], [1]) for stamp, state in zip(stamps(times), legs(times))
    ]
    estimates = [
        estimate_at(stamp, [state], [1]) for stamp, state in zip(stamps(times + 3.0), legs(times))
    ]
    lag = scored(estimates, truth)['lag']
    assert lag['best_s'] == pytest.approx(-3.0, abs=0.05)
    assert lag['rmse_at_best_m'] < 0.1 < lag['rmse_at_zero_m']


def test_several_targets_are_scored_by_gospa():
    truth = [
        truth_estimate(START_NS + k, [[0.0] * 4, [50.0, 0.0, 0.0, 0.0]], [1, 2]) for k in range(2)
    ]
    estimates = [
        estimate_at(START_NS, [[3.0, 4.0, 0.0, 0.0]], [5]),
        estimate_at(START_NS + 1, [[0.0, 0.0, 0.0, 0.0], [50.0, 0.0, 0.0, 0.0]], [5, 6]),
    ]
    gospa = scored(estimates, truth, cutoff=10.0)['gospa']
    # one target 5 m off, one missed at 10^2 / 2; then two hits
    assert gospa['mean_m'] == pytest.approx(np.sqrt(25.0 + 50.0) / 2.0)
    assert gospa['missed_per_scan'] == pytest.approx(0.5)
    assert gospa['false_per_scan'] == 0.0


def test_a_singular_state_covariance_is_counted_not_believed():
    estimates, truth, _ = single_run(count=30)
    certain = covariance()
    certain[3] = certain[:, 3] = 0.0
    estimates[4] = estimate_at(estimates[4].stamp_ns, estimates[4].state, [7], stated=certain)
    consistency = scored(estimates, truth)['consistency']
    assert consistency['singular_state_covariances'] == 1
    assert consistency['nees_state']['n'] == 29 and consistency['nees_position']['n'] == 30


def test_hits_with_different_degrees_of_freedom_are_divided_by_them():
    estimates, truth, _ = single_run(count=60)
    rng = np.random.default_rng(5)
    for k, estimate in enumerate(estimates):
        estimate.extras['nis_dof'] = np.array([2 + k % 3], np.uint16)
        estimate.extras['nis'] = rng.chisquare(2 + k % 3, 1)
    nis = scored(estimates, truth)['consistency']['nis']
    assert nis['divided_by_dof'] and nis['believable']
    assert nis['low'] < 1.0 < nis['high']


def test_without_truth_only_what_needs_none_is_scored():
    estimates, _, _ = single_run(count=50)
    metrics = score(series_of(estimates))
    assert 'position' not in metrics and 'nees_position' not in metrics['consistency']
    assert metrics['consistency']['nis']['n'] == 50
    assert sum(metrics['models']['mean_probability'].values()) == pytest.approx(1.0)


@pytest.mark.parametrize('truth', [[], single_run(count=5)[1]])
def test_an_empty_run_gives_numbers_json_can_hold(truth):
    metrics = scored([], truth, fixes=fix_series([]))
    assert metrics['tracks_confirmed'] == 0
    json.dumps(finite(metrics), allow_nan=False)
