# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Scores of runs whose errors are known."""

import json

from attrs import evolve
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
from sonar_imm_tools.evaluation.diver import METRICS, summary_sentence
from sonar_imm_tools.evaluation.diver.scoring import fix_series, score
from sonar_imm_tools.evaluation.diver.series import series_of, Truth
from sonar_imm_tools.evaluation.numbers import lines
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
    eye = np.eye(4)
    estimates = [
        estimate_at(true.stamp_ns, [e], [1], stated=eye) for true, e in zip(truth, errors)
    ]
    metrics = scored(estimates, truth)
    assert (metrics['stamps'], metrics['span_s']) == (3, 2.0)
    assert metrics['position']['rmse_m'] == pytest.approx(np.sqrt(30.0 / 3.0))
    assert metrics['position']['median_m'] == pytest.approx(2.0)
    assert metrics['velocity']['rmse_mps'] == pytest.approx(np.sqrt(7.0 / 3.0))
    assert metrics['consistency']['nees_position']['mean'] == pytest.approx(10.0)
    assert metrics['consistency']['nees_state']['mean'] == pytest.approx(37.0 / 3.0)


def test_track_and_fixes_are_compared_at_the_same_stamps():
    """A track that begins late, and an outlier: of single fixes all count."""
    estimates, truth, times = single_run(count=40)
    fixes = [
        Fix(stamp_ns=stamp, position=[*(place + [0.0, 2.0 if k < 20 else 1.0]), 0.0])
        for k, (stamp, place) in enumerate(zip(stamps(times), legs(times)[:, :2]))
    ]
    fixes[30] = evolve(fixes[30], position=fixes[30].position + [90.0, 0.0, 0.0])
    metrics = scored(estimates[20:], truth, fixes=fix_series(fixes))
    same = metrics['same_stamps']
    assert same['n'] == 20 and metrics['raw_fix']['n'] == 40
    raw = np.sqrt((20 * 4.0 + 20 * 1.0 + 90.0**2) / 40.0)
    assert metrics['raw_fix']['rmse_m'] == pytest.approx(raw)
    assert same['raw_rmse_m'] == pytest.approx(np.sqrt(1.0 + 90.0**2 / 20.0))
    assert same['track_rmse_m'] == pytest.approx(metrics['position']['rmse_m'])


def test_a_lagging_track_tells_its_lag():
    times = np.arange(200) * 0.5
    truth = [truth_estimate(at, [x], [1]) for at, x in zip(stamps(times), legs(times))]
    estimates = [estimate_at(at, [x], [1]) for at, x in zip(stamps(times + 3.0), legs(times))]
    lag = scored(estimates, truth)['lag']
    assert lag['best_s'] == pytest.approx(-3.0, abs=0.05)
    assert lag['rmse_at_best_m'] < 0.1 < lag['rmse_at_zero_m']


def test_several_targets_are_scored_by_gospa():
    both = [[0.0] * 4, [50.0, 0.0, 0.0, 0.0]]
    truth = [truth_estimate(START_NS + k, both, [1, 2]) for k in range(2)]
    one = estimate_at(START_NS, [[3.0, 4.0, 0.0, 0.0]], [5])
    estimates = [one, estimate_at(START_NS + 1, both, [5, 6])]
    gospa = scored(estimates, truth, cutoff=10.0)['gospa']
    # one target 5 m off, one missed at 10^2 / 2; then two hits
    assert gospa['mean_m'] == pytest.approx(np.sqrt(25.0 + 50.0) / 2.0)
    assert gospa['missed_per_scan'] == pytest.approx(0.5)
    assert gospa['false_per_scan'] == 0.0


def two_divers(errors, stated_std, fix_std, seed=4):
    """Two divers 300 m apart, tracks with `errors` (n, 2, 2) m that state `stated_std`, and fixes
    with `fix_std`."""
    rng = np.random.default_rng(seed)
    there = np.array([[0.0] * 4, [300.0, 0.0, 0.0, 0.0]])
    stated = np.diag([stated_std**2] * 2 + [1.0] * 2)
    truth, estimates, fixes = [], [], []
    for k, error in enumerate(errors):
        stamp = START_NS + k * SECOND
        truth.append(truth_estimate(stamp, there, [1, 2]))
        state = there + np.pad(error, [(0, 0), (0, 2)])
        estimates.append(estimate_at(stamp, state, [5, 6], stated=stated))
        for place in there:
            noisy = [*(place[:2] + fix_std * rng.normal(size=2)), 0.0]
            fixes.append(Fix(stamp_ns=stamp, position=noisy))
    return estimates, truth, fix_series(fixes)


def lost_for_a_while(count=200):
    """Errors of a metre, but the first diver's track is 25 m off for two scans of five."""
    errors = np.random.default_rng(1).normal(size=(count, 2, 2))
    errors[: 2 * count // 5, 0] += [25.0, 0.0]
    return errors


def test_no_verdict_is_given_that_pairs_beyond_the_cutoff_would_change():
    """Judged by the pairs within 10 m the tracker was too cautious, within 50 m overconfident."""
    estimates, truth, fixes = two_divers(lost_for_a_while(), 3.0, 1.0)
    within_10 = scored(estimates, truth, fixes=fixes)
    assert within_10['cutoff_m'] == 10.0 and within_10['position']['rmse_m'] < 1.6
    assert within_10['consistency']['coverage']['95'] > 0.99
    assert within_10['consistency']['verdict'] is None
    assert within_10['consistency']['nees_position']['believable'] is None
    assert within_10['beyond_cutoff'] == {'n': 80, 'share': 0.2}
    sentence = summary_sentence(within_10)
    assert sentence.startswith('The divers are found 80 % of the time, within 10 m; then ')
    assert 'cannot be said: 20 % of the estimates' in sentence
    assert 'cautious' not in sentence and 'removes' not in sentence
    assert lines(METRICS, within_10)[0][0] == 'divers found'
    within_50 = scored(estimates, truth, fixes=fixes, cutoff=50.0)
    assert within_50['consistency']['verdict'] == 'overconfident'
    assert within_50['tracks']['completeness'] == 1.0
    assert 'The tracker is overconfident' in summary_sentence(within_50)
    assert lines(METRICS, within_50)[0][0] != 'divers found'


def test_the_cutoff_follows_the_errors_of_the_fixes():
    """Errors of 8 m stated as 5: too cautious within 10 m, which is less than the 95 % radius."""
    errors = 8.0 * np.random.default_rng(2).normal(size=(300, 2, 2))
    estimates, truth, fixes = two_divers(errors, 5.0, 8.0)
    within_10 = scored(estimates, truth, fixes=fixes, cutoff=10.0)['consistency']
    assert within_10['coverage']['95'] == 1.0 and within_10['verdict'] is None
    for known in (fixes, None):  # without fixes the tracks themselves
        metrics = scored(estimates, truth, fixes=known)
        assert 45.0 < metrics['cutoff_m'] < 70.0
        assert metrics['consistency']['verdict'] == 'overconfident'
        assert metrics['beyond_cutoff']['n'] == 0 and metrics['tracks']['completeness'] == 1.0
        assert metrics['position']['rmse_m'] == pytest.approx(8.0 * np.sqrt(2.0), rel=0.1)


def test_a_verdict_that_no_pair_would_change_is_given():
    """A miss beside a false track for a few scans."""
    errors = 3.0 * np.random.default_rng(3).normal(size=(200, 2, 2))
    errors[:4, 0] += [40.0, 0.0]
    estimates, truth, fixes = two_divers(errors, 3.0, 3.0)
    metrics = scored(estimates, truth, fixes=fixes)
    assert metrics['beyond_cutoff']['n'] == 4
    assert metrics['consistency']['verdict'] == 'consistent'
    assert 'consistent with the errors' in summary_sentence(metrics)


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


def test_models_are_counted_by_how_probable_they_are_and_how_often_they_lead():
    """Of 17 estimates in four seconds east leads the first four."""
    series = series_of(single_run(count=17)[0])
    east = np.where(np.arange(17) < 4, 0.8, 0.4)
    shares = np.column_stack([east, 1.0 - east])
    models = score(evolve(series, model_names=('east', 'north'), probabilities=shares))['models']
    assert models['leads'] == {'east': 4 / 17, 'north': 13 / 17}
    assert models['mean_probability']['east'] == pytest.approx((4 * 0.8 + 13 * 0.4) / 17)
    assert models['leader_changes_per_minute'] == pytest.approx(15.0)


@pytest.mark.parametrize('truth', [[], single_run(count=5)[1]])
def test_an_empty_run_gives_numbers_json_can_hold(truth):
    metrics = scored([], truth, fixes=fix_series([]))
    assert metrics['tracks_confirmed'] == 0
    json.dumps(finite(metrics), allow_nan=False)


def in_depth(estimates, truth, *, spread=1.0, depth=25.0):
    """The same run with z estimated at a standard deviation of 2 m, and truth at a depth."""
    rng = np.random.default_rng(3)
    deep, there = [], []
    for estimate, true in zip(estimates, truth):
        n = len(estimate)
        z = -depth + spread * 2.0 * rng.normal(size=n)
        covariance = np.zeros((n, 5, 5))
        covariance[:, :4, :4], covariance[:, 4, 4] = estimate.covariance, 4.0
        names, state = (*estimate.state_names, 'pz'), np.column_stack([estimate.state, z])
        deep.append(evolve(estimate, state_names=names, state=state, covariance=covariance))
        xyz = np.array(true.xyz)
        xyz[:, 2] = -depth
        there.append(evolve(true, xyz=xyz))
    return deep, there


def test_depth_is_scored_where_both_have_it():
    estimates, truth, _ = single_run(count=1000)
    assert 'depth' not in scored(estimates, truth)
    deep, there = in_depth(estimates, truth)
    found = scored(deep, there)['depth']
    assert found['rmse_m'] == pytest.approx(2.0, rel=0.1) and found['nees_3d']['believable']
    assert found['nees_3d']['dof'] == 3 and found['n'] == 1000
    assert 'depth' not in scored(estimates, there) and 'depth' not in scored(deep, truth)
    wrong = scored(*in_depth(estimates, truth, spread=3.0))['depth']
    assert wrong['rmse_m'] == pytest.approx(6.0, rel=0.1) and not wrong['nees_3d']['believable']


def words_of(tracked, raw):
    return {
        'position': {'n': 5, 'rmse_m': tracked},
        'raw_fix': {'n': 5, 'rmse_m': raw, 'beyond': 0},
        'same_stamps': {'n': 5, 'track_rmse_m': tracked, 'raw_rmse_m': raw},
        'consistency': {'coverage': {'95': 0.95}, 'verdict': 'consistent'},
    }


def test_the_raw_fixes_may_be_the_truth_itself():
    assert 'the truth itself' in summary_sentence(words_of(0.5, 0.0))
    assert 'removes 75 %' in summary_sentence(words_of(0.5, 2.0))
    assert 'adds 100 %' in summary_sentence(words_of(2.0, 1.0))
