# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Scores of divers whose errors are known; how they are matched and drawn."""

from itertools import permutations
import json

from attrs import evolve
from helpers import dive_scenes
from helpers.dive_scenes import estimate_at, SECOND, single_run, START_NS, truth_estimate
import numpy as np
import pytest
from scipy.stats import chi2, norm

from sonar_imm.measurements import Fix
from sonar_imm_tools.evaluation.diver import figures, METRICS, summary_sentence
from sonar_imm_tools.evaluation.diver.scoring import fix_series, score
from sonar_imm_tools.evaluation.diver.series import (
    assign,
    match,
    series_of,
    track_summary,
    Truth,
    TruthPath,
)
from sonar_imm_tools.evaluation.numbers import lines
from sonar_imm_tools.evaluation.plotting import view_of
from sonar_imm_tools.offline.run_folder import finite


def scored(estimates, truth, **options):
    return score(series_of(estimates), Truth.from_series(series_of(truth)), **options)


def test_errors_drawn_from_the_stated_covariance_are_believed_and_twice_as_large_ones_not():
    estimates, truth, _ = single_run(count=2000)
    metrics = scored(estimates, truth)
    consistency = metrics['consistency']
    for name in ('nees_position', 'nees_state', 'nis'):
        assert consistency[name]['believable']
    assert consistency['nis']['dof'] == 2
    for level, share in consistency['coverage'].items():
        # four binomial standard deviations
        p = float(level) / 100.0
        assert share == pytest.approx(p, abs=4.0 * np.sqrt(p * (1.0 - p) / 2000))
    trace = np.trace(dive_scenes.covariance()[:2, :2])
    assert metrics['position']['rmse_m'] == pytest.approx(np.sqrt(trace), rel=0.05)
    consistency = scored(*single_run(count=500, spread=2.0)[:2])['consistency']
    assert not consistency['nees_position']['believable']
    assert consistency['nees_position']['mean'] == pytest.approx(8.0, rel=0.15)
    assert consistency['coverage']['95'] < 0.85


def test_numbers_of_three_known_errors():
    truth = [truth_estimate(START_NS + k * SECOND, [[0.0] * 4], [1]) for k in range(3)]
    errors = [[3.0, 4.0, 0.0, 1.0], [0.0, 1.0, 0.0, 1.0], [0.0, 2.0, 2.0, 1.0]]
    pairs = zip(truth, errors)
    estimates = [estimate_at(true.stamp_ns, [e], [1], stated=np.eye(4)) for true, e in pairs]
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
    places = dive_scenes.legs(times)[:, :2] + np.repeat([[0.0, 2.0], [0.0, 1.0]], 20, axis=0)
    places[30, 0] += 90.0
    pairs = zip(dive_scenes.stamps(times), places)
    fixes = fix_series([Fix(stamp_ns=stamp, position=[*place, 0.0]) for stamp, place in pairs])
    metrics = scored(estimates[20:], truth, fixes=fixes)
    same = metrics['same_stamps']
    assert same['n'] == 20 and metrics['raw_fix']['n'] == 40
    raw = np.sqrt((20 * 4.0 + 20 * 1.0 + 90.0**2) / 40.0)
    assert metrics['raw_fix']['rmse_m'] == pytest.approx(raw)
    assert same['raw_rmse_m'] == pytest.approx(np.sqrt(1.0 + 90.0**2 / 20.0))
    assert same['track_rmse_m'] == pytest.approx(metrics['position']['rmse_m'])


def test_a_lagging_track_tells_its_lag():
    times = np.arange(200) * 0.5
    states = dive_scenes.legs(times)[:, None]
    now, late = dive_scenes.stamps(times), dive_scenes.stamps(times + 3.0)
    truth = [truth_estimate(at, x, [1]) for at, x in zip(now, states)]
    lag = scored([estimate_at(at, x, [1]) for at, x in zip(late, states)], truth)['lag']
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
    assert gospa['missed_per_scan'] == pytest.approx(0.5) and gospa['false_per_scan'] == 0.0


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
        for place in there[:, :2]:
            noisy = [*(place + fix_std * rng.normal(size=2)), 0.0]
            fixes.append(Fix(stamp_ns=stamp, position=noisy))
    return estimates, truth, fix_series(fixes)


def test_no_verdict_is_given_that_pairs_beyond_the_cutoff_would_change():
    """The first diver's track is 25 m off for two scans of five: judged by the pairs within 10 m
    the tracker was too cautious, within 50 m overconfident."""
    errors = np.random.default_rng(1).normal(size=(200, 2, 2))
    errors[:80, 0] += [25.0, 0.0]
    estimates, truth, fixes = two_divers(errors, 3.0, 1.0)
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
    within_50 = scored(estimates, truth, fixes=fixes, cutoff=50.0)
    assert within_50['consistency']['verdict'] == 'overconfident'
    assert within_50['tracks']['completeness'] == 1.0
    assert 'The tracker is overconfident' in summary_sentence(within_50)
    first = [lines(METRICS, metrics)[0][0] for metrics in (within_10, within_50)]
    assert first[0] == 'divers found' != first[1]


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


def test_singular_covariances_are_counted_and_hits_divided_by_their_degrees_of_freedom():
    estimates, truth, _ = single_run(count=60)
    certain = dive_scenes.covariance()
    certain[3] = certain[:, 3] = 0.0
    estimates[4] = estimate_at(estimates[4].stamp_ns, estimates[4].state, [7], stated=certain)
    rng = np.random.default_rng(5)
    for k, estimate in enumerate(estimates):
        estimate.extras['nis_dof'] = np.array([2 + k % 3], np.uint16)
        estimate.extras['nis'] = rng.chisquare(2 + k % 3, 1)
    consistency = scored(estimates, truth)['consistency']
    assert consistency['singular_state_covariances'] == 1
    assert consistency['nees_state']['n'] == 59 and consistency['nees_position']['n'] == 60
    nis = consistency['nis']
    assert nis['divided_by_dof'] and nis['believable'] and nis['low'] < 1.0 < nis['high']


def test_without_truth_or_estimates_only_what_needs_none_is_scored():
    estimates, truth, _ = single_run(count=50)
    metrics = score(series_of(estimates))
    assert 'position' not in metrics and 'nees_position' not in metrics['consistency']
    assert metrics['consistency']['nis']['n'] == 50
    assert sum(metrics['models']['mean_probability'].values()) == pytest.approx(1.0)
    for known in ([], truth):
        metrics = scored([], known, fixes=fix_series([]))
        assert metrics['tracks_confirmed'] == 0
        json.dumps(finite(metrics), allow_nan=False)


def test_models_are_counted_by_how_probable_they_are_and_how_often_they_lead():
    """Of 17 estimates in four seconds east leads the first four."""
    series = series_of(single_run(count=17)[0])
    east = np.where(np.arange(17) < 4, 0.8, 0.4)
    shares = np.column_stack([east, 1.0 - east])
    models = score(evolve(series, model_names=('east', 'north'), probabilities=shares))['models']
    assert models['leads'] == {'east': 4 / 17, 'north': 13 / 17}
    assert models['mean_probability']['east'] == pytest.approx((4 * 0.8 + 13 * 0.4) / 17)
    assert models['leader_changes_per_minute'] == pytest.approx(15.0)


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


@pytest.mark.parametrize(
    'tracked, raw, said',
    [(0.5, 0.0, 'the truth itself'), (0.5, 2.0, 'removes 75 %'), (2.0, 1.0, 'adds 100 %')],
)
def test_the_raw_fixes_may_be_the_truth_itself(tracked, raw, said):
    metrics = {
        'position': {'n': 5, 'rmse_m': tracked}, 'raw_fix': {'n': 5, 'rmse_m': raw, 'beyond': 0},
        'same_stamps': {'n': 5, 'track_rmse_m': tracked, 'raw_rmse_m': raw},
        'consistency': {'coverage': {'95': 0.95}, 'verdict': 'consistent'},
    }  # fmt: skip
    assert said in summary_sentence(metrics)


def test_ellipses_hold_the_probability_they_claim():
    covariance, mean = np.array([[[4.0, 1.2], [1.2, 1.0]]]), np.array([[3.0, -2.0]])
    outline = figures.outlines(mean, covariance, probability=0.9)
    assert np.isnan(outline[-1]).all()
    offset = outline[:-1] - mean
    distance = np.einsum('ni,ij,nj->n', offset, np.linalg.inv(covariance[0]), offset)
    np.testing.assert_allclose(distance, chi2.ppf(0.9, 2), rtol=1e-12)


def test_models_are_ordered_by_heading_which_of_two_families_is_one_row():
    names = ('heading_090', 'hover', 'heading_000')
    assert [names[i] for i in figures.model_order(names)] == [
        'hover',
        'heading_000',
        'heading_090',
    ]
    assert figures.model_label('heading_022') == '22°'
    names = ('steady_heading_000', 'steady_hover', 'brisk_heading_000', 'brisk_hover', 'quiet')
    found, added = figures.headings_together(names, np.array([[0.1, 0.2, 0.3, 0.25, 0.15]]))
    assert found == ('heading_000', 'hover', 'quiet')
    np.testing.assert_allclose(added, [[0.4, 0.45, 0.15]])
    alone = figures.headings_together(('heading_000', 'hover'), np.eye(2))
    assert alone[0] == ('heading_000', 'hover') and np.array_equal(alone[1], np.eye(2))


def test_the_map_shows_tracks_and_truth_but_not_the_clutter_and_names_of_targets():
    estimates, true_rows, _ = single_run(count=60)
    truth, series = Truth.from_series(series_of(true_rows)), series_of(estimates)
    fixes = fix_series([Fix(stamp_ns=1, position=[500.0, 500.0, 0.0])])
    assert fixes.place_covariance.shape == (1, 3, 3)
    figure = figures.map_figure(series, truth, fixes)
    low, high = figure.layout.xaxis.range
    assert low < series.state[:, 0].min() and series.state[:, 0].max() < high < 500.0
    assert figure.layout.yaxis.scaleanchor == 'x'
    assert view_of(np.empty((0, 2))) == (None, None)
    series.target_id[:] = 4
    drawn = figures.map_figure(series, None, None, {'4': 'Schmidt <b>'})
    assert 'Schmidt &lt;b&gt; (track 7)' in {each.name for each in drawn.data}
    section = next(iter(figures.sections({}, series, names={'4': 'Schmidt'})))
    assert 'Schmidt (track 7)' in {each.name for each in section.figure.data}


def test_the_error_of_a_track_is_drawn_over_the_seconds_of_the_run_in_its_band():
    estimates, true_rows, times = single_run(count=60)
    series = series_of(estimates)
    series.track_id[:10] = 6  # another track goes before
    matching = match(series, Truth.from_series(series_of(true_rows)), cutoff=10.0)
    figure = figures.error_figure(matching, 7)
    axes = {name for name in figure.to_dict()['layout'] if name.startswith('yaxis')}
    assert axes == {'yaxis', 'yaxis2'}
    names = 'error of the track', 'predicted 95 % band'
    drawn, bands = ([line for line in figure.data if line.name == name] for name in names)
    for axis, (line, band) in enumerate(zip(drawn, bands, strict=True)):
        np.testing.assert_allclose(line.x, times[10:], atol=1e-3)
        np.testing.assert_allclose(line.y, matching.error[10:, axis], atol=1e-3)
        half = norm.ppf(0.975) * np.sqrt(dive_scenes.covariance()[axis, axis])
        np.testing.assert_allclose(np.sort(band.y), np.repeat([-half, half], 50), rtol=1e-3)
    assert len(drawn) == 2


# -- who follows whom, against brute force and by hand --------------------------------------------


def scene(rows_by_scan, ids_by_scan, *, targets=((0.0, 0.0), (30.0, 0.0)), cutoff=10.0):
    """Standing targets; estimates at the given places with the given track ids."""
    estimates, truths = [], []
    for k, (places, ids) in enumerate(zip(rows_by_scan, ids_by_scan)):
        stamp = START_NS + k * SECOND
        states = np.array([[*place, 0.0, 0.0] for place in places]).reshape(-1, 4)
        estimates.append(estimate_at(stamp, states, ids))
        there = [[*target, 0, 0] for target in targets]
        truths.append(truth_estimate(stamp, there, range(len(targets))))
    return match(series_of(estimates), Truth.from_series(series_of(truths)), cutoff=cutoff)


@pytest.mark.parametrize('seed', range(20))
def test_assignment_has_the_least_total_of_all_assignments(seed):
    distance = np.random.default_rng(seed).uniform(0.0, 10.0, (3, 4))
    best = min(sum(distance[i, p[i]] for i in range(3)) for p in permutations(range(4), 3))
    pairs = assign(distance, np.inf)
    assert sum(distance[pair] for pair in pairs) == pytest.approx(best)
    # Pairs beyond the cutoff are none.
    assert assign(np.array([[9.9, 50.0], [50.0, 10.0]]), 10.0) == [(0, 0)]


def test_errors_are_estimate_minus_truth_and_what_is_left_over_is_kept_apart():
    matching = scene([[(31.0, -2.0), (0.5, 0.0)]], [[2, 1]])
    order = np.argsort(matching.target)
    np.testing.assert_allclose(matching.error[order, :2], [[0.5, 0.0], [1.0, -2.0]])
    matching = scene([[(1.0, 0.0), (60.0, 0.0)], [(30.0, 0.0)]], [[1, 2], [2]])
    assert matching.distance.tolist() == [1.0, 0.0] and matching.beyond_row.tolist() == [1]
    assert matching.beyond_truth[:, 0].tolist() == [30.0]
    # One target with one track is matched however far.
    alone = scene([[(1000.0, 0.0)]], [[7]], targets=[(0.0, 0.0)])
    assert alone.distance.tolist() == [1000.0]


def test_a_switch_is_counted_once_a_gap_is_none_and_a_track_on_nothing_is_false():
    places = [[(0, 0), (30, 0)]] * 3 + [[(30, 0)]] + [[(0, 0), (30, 0)]] * 2
    summary = track_summary(scene(places, [[1, 2], [1, 2], [2, 1], [1], [2, 1], [2, 1]]))
    assert (summary['identity_switches'], summary['fragmentations']) == (2, 1)
    assert summary['completeness'] == pytest.approx(11 / 12) and summary['false_tracks'] == 0
    summary = track_summary(scene([[(0, 0), (30, 0), (15, 200)]] * 4, [[1, 2, 3]] * 4))
    assert summary['false_tracks'] == 1 and summary['tracks'] == 3
    assert summary['false_rows_per_scan'] == 1.0 and summary['true_targets'] == 2
    matching = scene([[]], [[]])
    assert len(matching.row) == 0 and track_summary(matching)['completeness'] == 0.0


# -- estimates as flat arrays ---------------------------------------------------------------------

STATES = np.array([[1.0, 2.0, 0.5, -0.5], [3.0, 4.0, 0.0, 0.8]])


def test_rows_come_out_by_stamp_with_their_columns():
    late = estimate_at(START_NS + 5, STATES, [4, 9], nis=[1.5, np.nan])
    series = series_of([late, estimate_at(START_NS, STATES[:1], [4], tentative=True)])
    assert series.stamp_ns.tolist() == [START_NS, START_NS + 5, START_NS + 5]
    assert series.track_id.tolist() == [4, 4, 9]
    np.testing.assert_array_equal(series.state[1:], STATES)
    np.testing.assert_array_equal(series.covariance[2], dive_scenes.covariance())
    assert series.model_names == dive_scenes.HEADINGS
    assert series.nis[1] == 1.5 and np.isnan(series.nis[0])
    assert series.confirmed().stamp_ns.tolist() == [START_NS + 5] * 2
    truth = series_of([truth_estimate(START_NS, STATES, [1, 2])])
    np.testing.assert_array_equal(truth.state, STATES)
    assert np.isnan(truth.covariance).all()


def test_scans_without_rows_are_remembered_and_without_truth_not_scored():
    nothing = estimate_at(START_NS, np.empty((0, 4)), [])
    series = series_of([nothing, estimate_at(START_NS + 1, STATES[:1], [4])])
    assert series.scan_ns.tolist() == [START_NS, START_NS + 1] and len(series) == 1
    series = series_of([])
    assert len(series) == len(series.scan_ns) == 0 and series.longest_track() is None
    estimates = [estimate_at(START_NS + k * SECOND, [[0.0] * 4], [1]) for k in range(5)]
    truths = [truth_estimate(START_NS + k * SECOND, [[0.0] * 4], [1]) for k in (1, 2)]
    matching = match(series_of(estimates), Truth.from_series(series_of(truths)), cutoff=10.0)
    assert len(matching.scan_ns) == 2 and matching.scored.sum() == 2


def test_a_table_of_something_else_and_two_runs_in_one_are_refused():
    other = truth_estimate(START_NS, STATES, [1, 2])
    del other.extras['py']
    with pytest.raises(ValueError, match="no column 'py'"):
        series_of([other])
    first = estimate_at(START_NS, STATES[:1], [4])
    second = {'stamp_ns': START_NS + 1, 'model_names': ('cv',), 'probabilities': np.ones((1, 1))}
    with pytest.raises(ValueError, match='more than one run'):
        series_of([first, evolve(first, **second)])


# -- truth ----------------------------------------------------------------------------------------

PLACES = np.array([[0.0, 0.0, 1.0, 0.0], [4.0, -2.0, 3.0, 1.0], [9.0, 9.0, 0.0, 0.0]])
PATH = TruthPath(1, START_NS + np.array([0, 2, 100]) * SECOND, PLACES)


def at(seconds, **options):
    stamps = START_NS + np.round(np.atleast_1d(seconds) * SECOND).astype(np.int64)
    return PATH.at(stamps, **{'max_gap': 10.0, **options})


def test_truth_is_a_straight_line_between_two_points_and_unknown_beyond_and_across_gaps():
    np.testing.assert_allclose(at(0.5)[0], [1.0, -0.5, 1.5, 0.25], atol=1e-12)
    assert np.isnan(at([-0.001, 50.0, 100.001])).all()
    np.testing.assert_array_equal(at([2.0, 100.0])[:, 0], [4.0, 9.0])
    assert np.isfinite(at(50.0, max_gap=98.0)).all()
    fast = TruthPath(1, START_NS + np.array([0, 1000]), np.array([[0.0] * 4, [1000.0] * 4]))
    assert fast.at(np.array([START_NS + 7]), max_gap=1.0)[0, 0] == pytest.approx(7.0, abs=1e-9)
    later = Truth((PATH,)).shifted(0.5)
    np.testing.assert_allclose(later.at(np.array([START_NS]))[0, 0], at(0.5)[0])


def test_targets_are_told_apart_bad_rows_left_out_and_of_repeated_stamps_the_last_counts():
    rows = [
        truth_estimate(START_NS + k, [[k, 0, 0, 0], [5, k if k else np.nan, 0, 0]], [1, 2])
        for k in range(3)
    ]
    truth = Truth.from_series(series_of([*rows, truth_estimate(START_NS, [[7, 0, 0, 0]], [1])]))
    assert [path.track_id for path in truth.paths] == [1, 2]
    assert [len(path.stamp_ns) for path in truth.paths] == [3, 2]
    assert truth.paths[0].state[:, 0].tolist() == [7.0, 1.0, 2.0]
