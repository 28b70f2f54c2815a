# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The obstacle tracker as a whole: life of tracks, time, navigation, odd input."""

from helpers.obstacle_runs import (
    approach,
    AS_STATED,
    EXACT,
    FIXED,
    followed,
    lever,
    mean_nis,
    navigation,
    offset_at,
    rows,
    run,
    SECOND,
    track_approach,
    track_scene,
)
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.stats import norm

from benchmarks.real_navigation import dead_reckoned, FOLDER, summary
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.measurements import Altitude, Detections, Navigation
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.navigation import MOST_WAITING
from sonar_imm.trackers.obstacle.config import GRADES
from sonar_imm.trackers.obstacle.filters import DepthSlices, Sonar
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate

NAME = 'approach_dst+3_noisy'


def test_the_columns_of_an_estimate():
    estimate = track_approach(NAME)[20]
    columns = list(estimate.columns())
    covariance = 'range_range range_bearing range_vertical_offset bearing_bearing'
    covariance += ' bearing_vertical_offset vertical_offset_vertical_offset'
    first = [*'xyz', 'range', 'bearing', 'vertical_offset']
    assert columns[:12] == [*first, *(f'cov_{name}' for name in covariance.split())]
    assert columns[12:14] == ['prob_above', 'prob_below']
    assert {'track_id', 'track_state', 'vertical_offset_lo', 'vertical_offset_hi'} <= set(columns)
    assert estimate.frame_id == 'odom'
    assert_allclose(estimate.probabilities.sum(axis=1), 1.0)
    assert np.linalg.eigvalsh(estimate.covariance).min() > 0.0
    low, high = (estimate.extras[f'vertical_offset_{end}'] for end in ('lo', 'hi'))
    assert np.all((low < estimate.state[:, 2]) & (estimate.state[:, 2] < high))


def test_an_empty_ping_is_a_ping():
    tracker = ObstacleTracker(ObstacleConfig())
    first = rows(NAME)[0]
    tracker.process(navigation(first, SECOND))
    (estimate,) = tracker.process(Detections(stamp_ns=SECOND, range=[], bearing=[]))
    assert len(estimate) == 0
    assert list(estimate.columns())[:6] == [*'xyz', 'range', 'bearing', 'vertical_offset']


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
    assert abs(error) < 3.0 * np.sqrt(variance)
    assert variance < 1.0
    assert mean_nis(final) < 2.6


@pytest.mark.statistics
def test_the_offset_is_found_and_is_as_good_as_it_says():
    """Error, variance, band and P(above) of twelve approaches each, at 30 m."""
    found = {}
    for name, most in {'approach': 1.7, 'above': 1.8, 'rolling': 0.8}.items():
        results = [offset_at(*track_scene(name, seed, **EXACT), 30.0) for seed in range(12)]
        assert None not in results
        found[name] = np.array(results, float)
        assert np.sqrt(np.mean(found[name][:, 0] ** 2)) < most
    assert np.all(found['above'][:, 3] > 0.8)
    assert np.mean(found['above'][:, 3]) > 0.95
    assert np.all(found['rolling'][:, 3] < 0.1)
    every = np.concatenate(list(found.values()))
    squared = every[:, 0] ** 2 / every[:, 1]
    assert 0.5 < squared.mean() < 1.6  # chi-square mean of 36: 1 +- 0.24
    assert 0.75 <= every[:, 2].mean() <= 1.0


def test_an_obstacle_that_the_beam_left_behind_is_not_given_up():
    """Its offset is believed to be 2 m, two standard deviations from the 6 m at which it is."""
    assert offset_at(*track_scene('above', 5), 30.0) is not None


def test_a_dive_does_not_disturb():
    """What stays is the obstacle's depth, not its offset from a vehicle that dives."""
    scenes = (track_scene('diving', seed, {'dive': 5.0}, **FIXED) for seed in range(4))
    error, variance, *_ = np.array([offset_at(*scene, 30.0) for scene in scenes], float).T
    assert np.sqrt(np.mean(error**2)) < 1.0
    assert np.mean(error**2 / variance) < 3.0


def test_relief_of_the_sea_floor_does_not_disturb():
    """The altimeter bounds the offset, it does not stand for the depth."""

    def errors(relief):
        overrides = {'seabed_relief': relief}
        runs = (track_scene('approach', seed, overrides) for seed in range(2))
        return [offset_at(*run, 30.0)[0] for run in runs]

    assert errors(0.5) == pytest.approx(errors(0.0), abs=0.1)


@pytest.mark.statistics
def test_the_scale_state_carries_an_error_of_the_log():
    """Alone: drift of the navigation, which is another state, would carry most of it as well."""
    worse = {'log_scale_error': 0.008, 'sound_speed_error': 0.0}

    def squared(scale_std):
        found = [
            offset_at(*track_scene('approach', seed, worse, scale_std=scale_std, **EXACT), 25.0)
            for seed in range(10)
        ]
        return np.mean([error**2 / variance for error, variance, _, _ in filter(None, found)])

    assert squared(0.008) < 2.0
    assert squared(0.0) > 2.0 * squared(0.008)


def test_six_obstacles_in_clutter():
    scene, final = track_scene('six', 2)
    followed_share, identities = [], set()
    for ping in range(10, 50):
        estimate = final[int(scene.truth[0].stamp_ns[ping])]
        for truth in scene.truth:
            if truth.in_beam[: ping + 1].sum() >= 6 and truth.bearing[ping] ** 2 < 0.6:
                row = followed(estimate, truth, ping, near=3.0)
                followed_share.append(row is not None)
                if row is not None:
                    identities.add((truth.track_id, int(estimate.extras['track_id'][row])))
    assert np.mean(followed_share) > 0.97
    assert len(identities) <= 7


def test_a_track_outlives_the_beam():
    """Below 24 m the beam passes over an obstacle 3 m down; the track goes on to where it is."""
    scene, final = track_scene('approach', 6)
    truth = scene.truth[0]
    gone = np.flatnonzero(truth.in_beam)[-1]
    assert truth.range[gone] > 15.0
    last = np.flatnonzero(truth.range > 8.0)[-1]
    assert last - gone > 12
    estimate = final[int(truth.stamp_ns[last])]
    row = followed(estimate, truth, last, near=1.5)
    before = final[int(truth.stamp_ns[gone])]
    same = before.extras['track_id'][followed(before, truth, gone)]
    assert estimate.extras['track_id'][row] == same


def test_an_obstacle_that_is_gone_is_given_up():
    name = 'approach_dst+0.5_noisefree'
    gone = [
        Detections(stamp_ns=item.stamp_ns, range=[], bearing=[])
        if isinstance(item, Detections) and item.stamp_ns > 31 * SECOND
        else item
        for item in approach(name)
    ]
    final = list(run(ObstacleTracker(ObstacleConfig(sonar_lever=lever(name))), gone).values())
    assert len(final[60]) == 1
    assert len(final[75]) == 0


def test_clutter_alone_confirms_nothing():
    scene, final = track_scene('approach', 1, {'detection_probability': 0.0, 'clutter': 8.0})
    confirmed = [int((item.extras['track_state'] > 0).sum()) for item in final.values()]
    assert np.mean(confirmed) < 0.2


def test_a_ping_waits_for_the_pose_after_it():
    scene = simulate(scenario('approach', {'ping_jitter': 0.5}), 1)
    tracker = ObstacleTracker(ObstacleConfig(sonar_lever=(2.0, 0.0, -0.3)))
    for item in scene.measurements[:100]:
        estimates = tracker.process(item.measurement)
        if isinstance(item.measurement, Detections):
            assert not estimates
            assert tracker.health()['pings_waiting'] == 1
        elif estimates:
            assert tracker.health()['pings_waiting'] == 0


def test_extrapolation_stops_at_its_limit():
    first, second = rows(NAME)[:2]
    for limit, expected in ((0.3, 1), (0.1, 0)):
        tracker = ObstacleTracker(ObstacleConfig(max_extrapolation=limit))
        tracker.process(navigation(first, SECOND))
        tracker.process(navigation(second, SECOND + SECOND // 2))
        late = Detections(stamp_ns=SECOND + 700_000_000, range=[50.0], bearing=[0.0])
        assert len(tracker.process(late)) == expected


def test_pings_in_a_gap_of_the_navigation_are_skipped():
    measurements = [
        item
        for item in approach(NAME)
        if not (isinstance(item, Navigation) and 20 * SECOND < item.stamp_ns < 23 * SECOND)
    ]
    tracker = ObstacleTracker(ObstacleConfig(sonar_lever=lever(NAME)))
    final = run(tracker, measurements)
    assert tracker.health()['pings_skipped'] == 5
    assert not [stamp for stamp in final if 20 * SECOND < stamp < 23 * SECOND]
    identities = {int(i) for item in final.values() for i in item.extras['track_id']}
    assert identities == {1}


FALLS = {'detection_profile': [20.0, 1.0, 40.0, 0.6, 60.0, 0.15]}


def test_the_probability_of_a_detection_falls_with_range():
    config = ObstacleConfig(detection_probability=0.8, **FALLS)
    distance = np.array([5.0, 30.0, 60.0, 90.0])
    assert_allclose(config.detection_at(distance), [0.8, 0.64, 0.12, 0.12])
    assert ObstacleConfig().detection_at(distance).tolist() == [0.9] * 4


def test_misses_count_where_the_sonar_would_see():
    """55 m ahead, six echoes and then none: expected of a sonar that hardly sees that far."""
    ended = {}
    for values in ({}, FALLS):
        tracker = ObstacleTracker(ObstacleConfig(max_offset=2.0, **values))
        for k in range(1, 27):
            stamp = k * SECOND // 2
            tracker.process(
                Navigation(
                    stamp_ns=stamp, position=[0.0, 0.0, -20.0], orientation=[0.0, 0.0, 0.0, 1.0]
                )
            )
            seen = [55.0] if k <= 6 else []
            (estimate,) = tracker.process(
                Detections(stamp_ns=stamp, range=seen, bearing=[0.0] * len(seen))
            )
        ended[bool(values)] = len(estimate)
    assert ended == {False: 0, True: 1}


def test_the_edges_of_the_beam_are_smeared():
    """By 1.2 degrees; nothing is ever certain to be unseen."""
    filter_ = DepthSlices(ObstacleConfig(behaviours=('fixed',), components=1, max_offset=0.01))
    sonar = Sonar(Pose(np.array([0.0, 0.0, 20.0]), np.eye(3)))
    azimuth = np.radians([0.0, 21.3, 22.5, 23.7, 40.0])
    z = np.column_stack([np.full(5, 30.0), azimuth])
    mixture = filter_.begin(z, np.tile(np.diag([0.02, 1e-9]), (5, 1, 1)), sonar)
    V, ahead = filter_.visible(mixture, sonar.pose)
    due = 0.01 + 0.99 * norm.cdf([99.0, 1.0, 0.0, -1.0, -99.0])
    assert_allclose(V[:, 0].mean(axis=1), due, atol=1e-4)
    assert ahead.all()


@pytest.mark.statistics
@pytest.mark.skipif(
    not (FOLDER / 'dvl.csv').exists(),
    reason='the recorded navigation is not there (SONAR_IMM_DATA)',
)
def test_the_band_holds_the_offset_under_real_motion():
    found = summary(dead_reckoned(), runs=20)
    assert found['tracked'] == 20
    assert found['band_coverage'] >= 0.8
    assert found['nees'] < 2.0
    # It knows more than where obstacles are drawn, and than its own first answer. At 0.2 m/s the
    # drift that it allows for is a tenth of the speed, and costs 7 % of the RMSE.
    assert found['rmse_m'] < 0.95 * found['spread_of_truth_m']
    assert found['rmse_m'] < 0.8 * found['answering_zero_rmse_m']
    assert found['rmse_m'] < 0.8 * found['first_answer_rmse_m']


def twice(tracker, **columns):
    """What is published after the same ping twice, a tenth of a second apart, of a vehicle that
    lies still: an obstacle has a track from its second echo on."""
    for stamp in (SECOND, SECOND + SECOND // 10):
        tracker.process(navigation(rows(NAME)[0], stamp))
        (estimate,) = tracker.process(Detections(stamp_ns=stamp, **columns))
    return estimate


def test_rows_that_are_no_echo_are_ignored():
    tracker = ObstacleTracker(ObstacleConfig(confirm_hits=1))
    estimate = twice(
        tracker,
        range=[np.nan, 50.0, -3.0, 0.0, np.inf, 40.0, 30.0],
        bearing=[0.0, np.nan, 0.0, 0.0, 0.1, 0.1, 3.0],
    )
    assert len(estimate) == 1
    assert estimate.state[0, 0] == pytest.approx(40.0, abs=0.01)


def test_variances_of_the_detections_win():
    def first(**columns):
        tracker = ObstacleTracker(
            ObstacleConfig(confirm_hits=1, range_scale_std=0.0, behaviours=('fixed',))
        )
        estimate = twice(tracker, range=[40.0], bearing=[0.1], **columns)
        # Two echoes are twice as good as one.
        return 2.0 * estimate.covariance[0]

    own = first()
    assert own[0, 0] == pytest.approx(0.15782**2, rel=0.02)
    assert own[1, 1] == pytest.approx(np.radians(0.25534) ** 2, rel=0.02)
    stated = first(var_range=[0.5], var_bearing=[1e-4])
    assert stated[0, 0] == pytest.approx(0.5, rel=0.02)
    assert stated[1, 1] == pytest.approx(1e-4, rel=0.02)
    assert_allclose(first(var_range=[0.0], var_bearing=[np.nan]), own)


def still(seconds, x=0.0):
    """A level vehicle, bow to the east, 20 m deep."""
    return Navigation(
        stamp_ns=seconds * SECOND, position=[x, 0.0, -20.0], orientation=[0.0, 0.0, 0.0, 1.0]
    )


def test_an_echo_that_is_as_uncertain_as_it_is_far_says_nothing():
    for std, begun in ((4.9, 1), (5.1, 0)):
        tracker = ObstacleTracker(ObstacleConfig(confirm_hits=1))
        tracker.process(still(1))
        ping = Detections(stamp_ns=SECOND, range=[10.0], bearing=[0.1], var_range=[std**2])
        tracker.process(ping)
        assert tracker.health()['seeds'] == begun


def test_no_more_obstacles_than_allowed_are_followed():
    tracker = ObstacleTracker(ObstacleConfig(confirm_hits=1, max_tracks=2))
    for second in (1, 2, 3):
        tracker.process(still(second))
        bearing = [0.4, 0.2, 0.0, -0.2]
        ping = Detections(stamp_ns=second * SECOND, range=[40.0] * 4, bearing=bearing)
        (estimate,) = tracker.process(ping)
    assert estimate.extras['track_id'].tolist() == [1, 2]


@pytest.mark.parametrize('side', [1, -1])
def test_range_and_bearing_are_correlated_as_the_place_is(side):
    """The vehicle passes by: what it knew of the range before becomes knowledge of the bearing."""
    config = ObstacleConfig(confirm_hits=1, range_scale_std=0.0, **AS_STATED)
    tracker = ObstacleTracker(config)
    for second in range(1, 13):
        tracker.process(still(second, x=1.5 * second))
        east, north = 80.0 - 1.5 * second, 40.0 * side
        ping = Detections(
            stamp_ns=second * SECOND, range=[np.hypot(east, north)],
            bearing=[np.arctan2(north, east)], var_range=[25.0], var_bearing=[1e-4],
        )  # fmt: skip
        (estimate,) = tracker.process(ping)
    place = {name: value[0] for name, value in estimate.extras.items() if name.startswith('p')}
    P = [[place[f'place_cov_{min(a, b)}_{max(a, b)}'] for b in 'xyz'] for a in 'xyz']
    x, y, z = place['px'] - 18.0, place['py'], place['pz'] + 20.0
    far, level = np.sqrt(x**2 + y**2 + z**2), x**2 + y**2
    J = np.array([[x / far, y / far, z / far], [-y / level, x / level, 0.0]])
    for covariance in (J @ P @ J.T, estimate.covariance[0]):
        correlation = covariance[0, 1] / np.sqrt(covariance[0, 0] * covariance[1, 1])
        assert correlation == pytest.approx(-0.25 * side, abs=0.05)


def test_detections_of_another_frame_are_counted():
    tracker = ObstacleTracker(ObstacleConfig())
    run(tracker, approach(NAME)[:6])
    tracker.process(Detections(stamp_ns=SECOND, range=[2.0], bearing=[0.0], frame_id='sonar'))
    other = Detections(stamp_ns=2 * SECOND, range=[1.0], bearing=[0.0], frame_id='other')
    assert not tracker.process(other) and tracker.counts['other_frame'] == 1


def test_detections_without_navigation_wait_and_do_not_pile_up_results():
    tracker = ObstacleTracker(ObstacleConfig())
    for k in range(20):
        ping = Detections(stamp_ns=SECOND * (k + 1), range=[50.0], bearing=[0.0])
        assert not tracker.process(ping)
    assert tracker.health()['pings_waiting'] == 20


def test_the_newest_pings_are_those_that_are_kept():
    tracker = ObstacleTracker(ObstacleConfig(max_navigation_gap=1000.0, history=0.0))
    for k in range(MOST_WAITING + 3):
        tracker.process(Detections(stamp_ns=SECOND * (k + 1), range=[50.0], bearing=[0.0]))
    last = SECOND * (MOST_WAITING + 3)
    stamps = []
    for stamp_ns in (last + 1, last + 2):
        pose = Navigation(stamp_ns=stamp_ns, position=[0, 0, -5], orientation=[0, 0, 0, 1])
        stamps += [estimate.stamp_ns for estimate in tracker.process(pose)]
    assert not stamps and tracker.health()['pings_skipped'] == MOST_WAITING
    assert tracker.health()['navigation_missing'] == 3


def test_an_old_altitude_no_longer_bounds_the_offset():
    """Obstacles lie above the sea floor: a fresh altitude of 3 m cuts off what lies deeper."""

    def deepest(age):
        tracker, stamp = ObstacleTracker(ObstacleConfig(max_altitude_age=2.0)), 100 * SECOND
        tracker.process(Altitude(stamp_ns=stamp - round(age * SECOND), altitude=3.0))
        for later in (0, SECOND // 10):
            tracker.process(navigation(rows(NAME)[0], stamp + later))
            ping = Detections(stamp_ns=stamp + later, range=[60.0], bearing=[0.1])
            (estimate,) = tracker.process(ping)
        return estimate.extras['vertical_offset_hi'][0]

    assert deepest(0.0) < 4.5 and deepest(1.9) < 4.5 and deepest(2.1) > 6.0


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
    def stages(**values):
        return {stage.__name__ for stage in ObstacleTracker(ObstacleConfig(**values)).stages}

    assert stages(misses='evidence') - stages() == {'_predict_misses', '_weigh_misses'}
    assert stages() - stages(max_landmarks=0) == {'_remember'}
    tracker = ObstacleTracker(ObstacleConfig())
    tracker.reconfigure(ObstacleConfig(max_landmarks=0))
    assert {stage.__name__ for stage in tracker.stages} == stages(max_landmarks=0)


def pings(variance, count=25):
    """A vehicle heads for one obstacle and stops for the last pings."""
    for k in range(count):
        x = float(min(k, count - 8))
        stamp = (k + 1) * SECOND
        yield Navigation(
            stamp_ns=stamp, position=[x, 0.0, -20.0], orientation=[0.0, 0.0, 0.0, 1.0]
        )
        yield Altitude(stamp_ns=stamp, altitude=12.0)
        yield Detections(
            stamp_ns=stamp, range=[np.hypot(60.0 - x, 2.0)], bearing=[0.0], var_range=[variance],
            var_bearing=[1e-11 * max(variance, 0.2)],
        )  # fmt: skip


@pytest.mark.parametrize('variance', [0.03, 2e-12])
def test_covariances_and_probabilities_stay_what_they_are(variance):
    tracker = ObstacleTracker(ObstacleConfig(scale_std=0.0))
    for item in pings(variance):
        for estimate in tracker.process(item):
            assert np.isfinite(estimate.state).all()
            assert (np.linalg.eigvalsh(estimate.covariance) >= 0.0).all()
            assert (estimate.probabilities >= 0.0).all()
            np.testing.assert_array_equal(estimate.probabilities.sum(axis=1), 1.0)
    health = tracker.health()
    assert health['broken_tracks'] == 0
    assert health['tracks'] == 1


def test_repairs_add_up_in_health(monkeypatch):
    """Variances that senders may state need none, so the filter is made to report some."""
    tracker = ObstacleTracker(ObstacleConfig())
    predict, update = tracker.filter.predict_unchanged, tracker.filter.update
    monkeypatch.setattr(
        tracker.filter, 'predict_unchanged', lambda *given: (predict(*given)[0], 2)
    )
    monkeypatch.setattr(tracker.filter, 'update', lambda *given: (*update(*given)[:2], 1))
    assert tracker.health()['covariance_repairs'] == 0
    for item in pings(0.03, count=5):
        tracker.process(item)
    assert tracker.health()['covariance_repairs'] == 2 * 5 + 4 + 4
