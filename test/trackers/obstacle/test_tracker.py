# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The obstacle tracker as a whole: life of tracks, time, navigation, odd input."""

from helpers import obstacle_runs as runs
from helpers.obstacle_runs import echoes, EXACT, offset_at, run, SECOND, still, track, track_scene
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.stats import norm

from benchmarks.real_navigation import dead_reckoned, FOLDER, summary
from sonar_imm.measurements import Altitude, Detections, Navigation
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.navigation import MOST_WAITING
from sonar_imm.trackers.obstacle.config import GRADES
from sonar_imm.trackers.obstacle.filters import DepthSlices
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate

NAME = 'approach_dst+3_noisy'


def test_the_columns_of_an_estimate():
    estimate = runs.track_approach(NAME)[20]
    columns = list(estimate.columns())
    covariance = 'range_range range_bearing range_vertical_offset bearing_bearing'
    covariance += ' bearing_vertical_offset vertical_offset_vertical_offset'
    first = [*'xyz', 'range', 'bearing', 'vertical_offset']
    assert columns[:12] == [*first, *(f'cov_{name}' for name in covariance.split())]
    assert columns[12:14] == ['prob_above', 'prob_below']
    assert {'track_id', 'track_state'} <= set(columns) and estimate.frame_id == 'odom'
    low, high = (estimate.extras[f'vertical_offset_{end}'] for end in ('lo', 'hi'))
    assert np.all((low < estimate.state[:, 2]) & (estimate.state[:, 2] < high))
    # An empty ping is a ping.
    (empty,) = track([still(SECOND), echoes(SECOND)])
    assert len(empty) == 0 and list(empty.columns())[:6] == first


@pytest.mark.parametrize('model', ['plane', 'cone'])
@pytest.mark.parametrize('timing', ['instant', 'two_way'])
def test_conventions_of_sonars(model, timing):
    """The offset is found when tracker and sonar agree on azimuth and timing."""
    overrides = {
        'azimuth_model': model, 'ping_timing': timing, 'roll_rms_deg': 4.0,
        'vertical_offset': -4.0, 'sonar_mount_rpy_deg': (2.0, 3.0, -4.0),
    }  # fmt: skip
    scene, final = track_scene('approach', 5, overrides)
    error, variance, _, _ = offset_at(scene, final, 40.0)
    assert abs(error) < 3.0 * np.sqrt(variance) and variance < 1.0
    nis = np.concatenate([estimate.extras['nis'] for estimate in final.values()])
    assert np.nanmean(nis) < 2.6  # 2 when all is right


@pytest.mark.statistics
def test_the_offset_is_found_and_is_as_good_as_it_says():
    """Error, variance, band and P(above) of twelve approaches each, at 30 m."""
    found = {}
    for name, most in {'approach': 1.7, 'above': 1.8, 'rolling': 0.8}.items():
        results = [offset_at(*track_scene(name, seed, **EXACT), 30.0) for seed in range(12)]
        assert None not in results
        found[name] = np.array(results, float)
        assert np.sqrt(np.mean(found[name][:, 0] ** 2)) < most
    assert np.all(found['above'][:, 3] > 0.8) and np.mean(found['above'][:, 3]) > 0.95
    assert np.all(found['rolling'][:, 3] < 0.1)
    error, variance, inside, _ = np.concatenate(list(found.values())).T
    assert 0.5 < np.mean(error**2 / variance) < 1.6  # chi-square mean of 36: 1 +- 0.24
    assert 0.75 <= inside.mean()


def test_neither_a_dive_nor_relief_of_the_sea_floor_disturbs():
    """What stays is the obstacle's depth, not its offset from a vehicle that dives; the altimeter
    bounds the offset, it does not stand for the depth."""
    scenes = (track_scene('diving', seed, {'dive': 5.0}, **runs.FIXED) for seed in range(4))
    error, variance, *_ = np.array([offset_at(*scene, 30.0) for scene in scenes], float).T
    assert np.sqrt(np.mean(error**2)) < 1.0 and np.mean(error**2 / variance) < 3.0
    rough, flat = (
        offset_at(*track_scene('approach', 1, {'seabed_relief': relief}), 30.0)[0]
        for relief in (0.5, 0.0)
    )
    assert rough == pytest.approx(flat, abs=0.1)


@pytest.mark.statistics
def test_the_scale_state_carries_an_error_of_the_log():
    """Alone: drift of the navigation, which is another state, would carry most of it as well."""
    worse = {'log_scale_error': 0.008, 'sound_speed_error': 0.0}

    def squared(**values):
        scenes = (track_scene('approach', seed, worse, **values, **EXACT) for seed in range(10))
        found = (offset_at(*each, 25.0) for each in scenes)
        return np.mean([error**2 / variance for error, variance, *_ in filter(None, found)])

    assert squared(scale_std=0.008) < 2.0
    assert squared(scale_std=0.0) > 2.0 * squared(scale_std=0.008)


def test_six_obstacles_in_clutter():
    scene, final = track_scene('six', 2)
    held, identities = [], set()
    for ping in range(10, 50):
        estimate = final[int(scene.truth[0].stamp_ns[ping])]
        for truth in scene.truth:
            if truth.in_beam[: ping + 1].sum() >= 6 and truth.bearing[ping] ** 2 < 0.6:
                row = runs.followed(estimate, truth, ping, near=3.0)
                held.append(row is not None)
                if row is not None:
                    identities.add((truth.track_id, int(estimate.extras['track_id'][row])))
    assert np.mean(held) > 0.97 and len(identities) <= 7


def test_a_track_outlives_the_beam():
    """Below 24 m the beam passes over an obstacle 3 m down; the track goes on to where it is."""
    scene, final = track_scene('approach', 6)
    truth = scene.truth[0]
    gone, last = (np.flatnonzero(each)[-1] for each in (truth.in_beam, truth.range > 8.0))
    assert truth.range[gone] > 15.0 and last - gone > 12
    before, after = (final[int(truth.stamp_ns[ping])] for ping in (gone, last))
    same = before.extras['track_id'][runs.followed(before, truth, gone)]
    assert after.extras['track_id'][runs.followed(after, truth, last, near=1.5)] == same


def test_an_obstacle_that_is_gone_is_given_up():
    name = 'approach_dst+0.5_noisefree'
    given = runs.approach(name)
    given[2::3] = [each if k < 61 else echoes(each.stamp_ns) for k, each in enumerate(given[2::3])]
    final = track(given, sonar_lever=runs.lever(name))
    assert len(final[60]) == 1 and len(final[75]) == 0


def test_a_ping_waits_for_the_pose_after_it():
    scene = simulate(scenario('approach', {'ping_jitter': 0.5}), 1)
    tracker = ObstacleTracker(ObstacleConfig(sonar_lever=(2.0, 0.0, -0.3)))
    for item in scene.measurements[:100]:
        estimates = tracker.process(item.measurement)
        is_ping = isinstance(item.measurement, Detections)
        assert not (is_ping and estimates)
        if is_ping or estimates:
            assert tracker.health()['pings_waiting'] == int(is_ping)


@pytest.mark.parametrize('limit, expected', [(0.3, 1), (0.1, 0)])
def test_extrapolation_stops_at_its_limit(limit, expected):
    late = echoes(SECOND + 700_000_000, [(50.0, 0.0)])
    given = [still(SECOND), still(SECOND + SECOND // 2, 0.7), late]
    assert len(track(given, max_extrapolation=limit)) == expected


def test_pings_in_a_gap_of_the_navigation_are_skipped():
    def in_gap(stamp_ns):
        return 20 * SECOND < stamp_ns < 23 * SECOND

    tracker = ObstacleTracker(ObstacleConfig(sonar_lever=runs.lever(NAME)))
    given = (m for m in runs.approach(NAME) if type(m) is not Navigation or not in_gap(m.stamp_ns))
    final = run(tracker, given)
    assert tracker.health()['pings_skipped'] == 5 and not any(map(in_gap, final))
    assert {int(i) for item in final.values() for i in item.extras['track_id']} == {1}


FALLS = {'detection_profile': [20.0, 1.0, 40.0, 0.6, 60.0, 0.15]}


@pytest.mark.parametrize('values, left', [({}, 0), (FALLS, 1)])
def test_misses_count_where_the_sonar_would_see(values, left):
    """55 m ahead, six echoes and then none: expected of a sonar that hardly sees that far."""
    given = []
    for stamp in range(SECOND // 2, 27 * SECOND // 2, SECOND // 2):
        given += [still(stamp), echoes(stamp, [(55.0, 0.0)] * (stamp <= 3 * SECOND))]
    assert len(track(given, max_offset=2.0, **values)[-1]) == left


def test_the_edges_of_the_beam_are_smeared():
    """By 1.2 degrees; nothing is ever certain to be unseen."""
    filter_ = DepthSlices(ObstacleConfig(behaviours=('fixed',), components=1, max_offset=0.01))
    z = np.column_stack([np.full(5, 30.0), np.radians([0.0, 21.3, 22.5, 23.7, 40.0])])
    mixture = filter_.begin(z, np.tile(np.diag([0.02, 1e-9]), (5, 1, 1)), runs.level())
    V, ahead = filter_.visible(mixture, runs.level().pose)
    due = 0.01 + 0.99 * norm.cdf([99.0, 1.0, 0.0, -1.0, -99.0])
    assert_allclose(V[:, 0].mean(axis=1), due, atol=1e-4)
    assert ahead.all()


@pytest.mark.statistics
@pytest.mark.skipif(not (FOLDER / 'dvl.csv').exists(), reason='no SONAR_IMM_DATA')
def test_the_band_holds_the_offset_under_real_motion():
    found = summary(dead_reckoned(), runs=20)
    assert found['tracked'] == 20 and found['band_coverage'] >= 0.8 and found['nees'] < 2.0
    # It knows more than where obstacles are drawn, and than its own first answer. At 0.2 m/s the
    # drift that it allows for is a tenth of the speed, and costs 7 % of the RMSE.
    assert found['rmse_m'] < 0.95 * found['spread_of_truth_m']
    assert found['rmse_m'] < 0.8 * found['answering_zero_rmse_m']
    assert found['rmse_m'] < 0.8 * found['first_answer_rmse_m']


def several(z, number=2, columns=(), **values):
    """What is published after the same ping several times, a tenth of a second apart, of a vehicle
    that lies still: an obstacle has a track from its second echo on."""
    given = []
    for stamp in SECOND + np.arange(number) * SECOND // 10:
        given += [still(int(stamp)), echoes(int(stamp), z, **dict(columns))]
    return track(given, confirm_hits=1, **values)[-1]


def test_rows_that_are_no_echo_are_ignored():
    none = [(np.nan, 0.0), (50.0, np.nan), (-3.0, 0.0), (0.0, 0.0), (np.inf, 0.1), (30.0, 3.0)]
    assert several([*none, (40.0, 0.1)]).state[:, 0] == pytest.approx([40.0], abs=0.01)


def test_variances_of_the_detections_win():
    def first(**columns):
        values = {'range_scale_std': 0.0, 'behaviours': ('fixed',)}
        # Two echoes are twice as good as one.
        return 2.0 * np.diag(several([(40.0, 0.1)], 2, columns, **values).covariance[0])[:2]

    own = [0.15782**2, np.radians(0.25534) ** 2]
    assert first() == pytest.approx(own, rel=0.02)
    assert first(var_range=[0.5], var_bearing=[1e-4]) == pytest.approx([0.5, 1e-4], rel=0.02)
    assert_allclose(first(var_range=[0.0], var_bearing=[np.nan]), first())


@pytest.mark.parametrize('std, begun', [(4.9, 1), (5.1, 0)])
def test_an_echo_that_is_as_uncertain_as_it_is_far_says_nothing(std, begun):
    tracker = ObstacleTracker(ObstacleConfig(confirm_hits=1))
    run(tracker, [still(SECOND), echoes(SECOND, [(10.0, 0.1)], var_range=[std**2])])
    assert tracker.health()['seeds'] == begun


def test_no_more_obstacles_than_allowed_are_followed():
    z = [(40.0, bearing) for bearing in (0.4, 0.2, 0.0, -0.2)]
    assert several(z, 3, max_tracks=2).extras['track_id'].tolist() == [1, 2]


@pytest.mark.parametrize('side', [1, -1])
def test_range_and_bearing_are_correlated_as_the_place_is(side):
    """The vehicle passes by: what it knew of the range before becomes knowledge of the bearing."""
    given = []
    for second in range(1, 13):
        east, north, stamp = 80.0 - 1.5 * second, 40.0 * side, second * SECOND
        z = [(np.hypot(east, north), np.arctan2(north, east))]
        given += [still(stamp, 1.5 * second), echoes(stamp, z, var_range=[25], var_bearing=[1e-4])]
    estimate = track(given, confirm_hits=1, range_scale_std=0.0, **runs.AS_STATED)[-1]
    place = {name: value[0] for name, value in estimate.extras.items() if name.startswith('p')}
    P = [[place[f'place_cov_{min(a, b)}_{max(a, b)}'] for b in 'xyz'] for a in 'xyz']
    x, y, z = place['px'] - 18.0, place['py'], place['pz'] + 20.0
    far, across = np.sqrt(x**2 + y**2 + z**2), x**2 + y**2
    J = np.array([[x / far, y / far, z / far], [-y / across, x / across, 0.0]])
    for covariance in (J @ P @ J.T, estimate.covariance[0]):
        correlation = covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])
        assert correlation == pytest.approx(-0.25 * side, abs=0.05)


def test_detections_of_another_frame_are_counted():
    tracker = ObstacleTracker(ObstacleConfig())
    run(tracker, [*runs.approach(NAME)[:6], echoes(SECOND, [(2.0, 0.0)], frame_id='sonar')])
    assert not tracker.process(echoes(2 * SECOND, [(1.0, 0.0)], frame_id='other'))
    assert tracker.counts['other_frame'] == 1


def test_pings_without_navigation_wait_and_the_newest_are_those_that_are_kept():
    tracker = ObstacleTracker(ObstacleConfig(max_navigation_gap=1000.0, history=0.0))
    for k in range(1, MOST_WAITING + 4):
        assert not tracker.process(echoes(SECOND * k, [(50.0, 0.0)]))
        assert tracker.health()['pings_waiting'] == min(k, MOST_WAITING)
    assert not run(tracker, [still(SECOND * k + 1), still(SECOND * k + 2)])
    assert tracker.health()['pings_skipped'] == MOST_WAITING
    assert tracker.health()['navigation_missing'] == 3


@pytest.mark.parametrize('age, bounds', [(0.0, True), (1.9, True), (2.1, False)])
def test_an_old_altitude_no_longer_bounds_the_offset(age, bounds):
    """Obstacles lie above the sea floor: a fresh altitude of 3 m cuts off what lies deeper."""
    given = [Altitude(stamp_ns=SECOND, altitude=3.0)]
    for stamp in (SECOND + round(age * SECOND), SECOND + round((age + 0.1) * SECOND)):
        given += [still(stamp), echoes(stamp, [(60.0, 0.1)])]
    deepest = track(given, max_altitude_age=2.0)[-1].extras['vertical_offset_hi'][0]
    assert deepest < 4.5 if bounds else deepest > 6.0


@pytest.mark.parametrize(
    'values, word',
    [
        ({'sonar_lever': [1.0, 2.0]}, 'sonar_lever needs three values'),
        ({'behaviours': ['seabed']}, 'one of fixed'),
        ({'behaviours': ['fixed', 'fixed']}, 'twice'),
        ({'detection_profile': [5.0]}, 'pairs'),
        ({'detection_profile': [5.0, 1.0, 5.0, 0.5]}, 'rise'),
        ({'detection_profile': [5.0, 2.0]}, 'shares'),
    ],
)
def test_parameters_are_checked_together(values, word):
    with pytest.raises(ConfigError, match=word):
        ObstacleConfig.from_mapping(values)


def test_a_grade_of_the_navigation_is_three_random_walks():
    walks = [ObstacleConfig(navigation_grade=grade).drift() for grade in GRADES]
    assert walks[0] == ObstacleConfig().drift() == (0.01, np.radians(0.02), 0.01)
    assert walks == sorted(walks) and len(set(walks)) == len(walks)
    exact = ObstacleConfig(navigation_grade='dvl', navigation_noise=(0.0, 0.0, 0.0))
    assert exact.drift() == (0.0, 0.0, 0.0)


def test_a_feature_that_is_off_has_no_stage():
    def stages(changed=None, **values):
        tracker = ObstacleTracker(ObstacleConfig(**values))
        tracker.reconfigure(ObstacleConfig(**(values | (changed or {}))))
        return {stage.__name__ for stage in tracker.stages}

    assert stages(misses='evidence') - stages() == {'_predict_misses', '_weigh_misses'}
    for off in (stages(max_landmarks=0), stages({'max_landmarks': 0})):
        assert stages() - off == {'_remember'}


def pings(variance, count=25):
    """A vehicle heads for one obstacle and stops for the last pings."""
    stated = {'var_range': [variance], 'var_bearing': [1e-11 * max(variance, 0.2)]}
    for k in range(count):
        x, stamp = float(min(k, count - 8)), (k + 1) * SECOND
        yield still(stamp, x)
        yield Altitude(stamp_ns=stamp, altitude=12.0)
        yield echoes(stamp, [(np.hypot(60.0 - x, 2.0), 0.0)], **stated)


@pytest.mark.parametrize('variance', [0.03, 2e-12])
def test_covariances_and_probabilities_stay_what_they_are(variance):
    tracker = ObstacleTracker(ObstacleConfig(scale_std=0.0))
    for estimate in run(tracker, pings(variance)).values():
        assert np.isfinite(estimate.state).all()
        assert (np.linalg.eigvalsh(estimate.covariance) >= 0.0).all()
        assert (estimate.probabilities >= 0.0).all()
        np.testing.assert_array_equal(estimate.probabilities.sum(axis=1), 1.0)
    assert tracker.health()['broken_tracks'] == 0 and tracker.health()['tracks'] == 1


def test_repairs_add_up_in_health(monkeypatch):
    """Variances that senders may state need none, so the filter is made to report some."""
    tracker = ObstacleTracker(ObstacleConfig())
    filter_ = tracker.filter
    predict, update = filter_.predict_unchanged, filter_.update
    monkeypatch.setattr(filter_, 'predict_unchanged', lambda *given: (predict(*given)[0], 2))
    monkeypatch.setattr(filter_, 'update', lambda *given: (*update(*given)[:2], 1))
    assert tracker.health()['covariance_repairs'] == 0
    run(tracker, pings(0.03, count=5))
    assert tracker.health()['covariance_repairs'] == 2 * 5 + 4 + 4
