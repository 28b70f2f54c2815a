# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What the obstacle tracker does with input and parameters that are wrong, odd or missing."""

from attrs import evolve
from helpers.obstacle_runs import approach, AS_STATED, navigation, rows, run, SECOND
import numpy as np
from numpy.testing import assert_allclose
import pytest

from sonar_imm.measurements import Altitude, Detections, Fix, Navigation
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.navigation import MOST_WAITING
from sonar_imm.trackers.obstacle.config import GRADES
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker

NAME = 'approach_dst+3_noisy'

# NaN without an echo, and where the vehicle's course is not known.
MAY_BE_UNKNOWN = {'nis', 'cpa_distance', 'cpa_time', 'collision_probability'}


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


def test_strangers_are_counted():
    tracker = ObstacleTracker(ObstacleConfig())
    run(tracker, approach(NAME)[:6])
    tracker.process(Detections(stamp_ns=SECOND, range=[2.0], bearing=[0.0], frame_id='sonar'))
    assert not tracker.process(Fix(stamp_ns=SECOND, position=[0.0, 0.0, 0.0]))
    assert not tracker.process(
        Detections(stamp_ns=2 * SECOND, range=[1.0], bearing=[0.0], frame_id='other')
    )
    assert tracker.counts['unknown_type'] == 1
    assert tracker.counts['other_frame'] == 1


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


def test_parameters_are_checked_together():
    with pytest.raises(ConfigError, match='sonar_lever needs three values'):
        ObstacleConfig(sonar_lever=(1.0, 2.0))
    with pytest.raises(ConfigError, match='did you mean'):
        ObstacleConfig.from_mapping({'sonar_leaver': [0.0, 0.0, 0.0]})


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


def test_rules_may_change_while_running():
    tracker = ObstacleTracker(ObstacleConfig())
    tracker.reconfigure(ObstacleConfig(birth_rate=1.0))
    assert tracker.config.birth_rate == 1.0
    with pytest.raises(ValueError, match='components'):
        tracker.reconfigure(ObstacleConfig(components=5))


@pytest.mark.parametrize('timing', ['instant', 'two_way'])
@pytest.mark.parametrize('model', ['plane', 'cone'])
@pytest.mark.filterwarnings('error')
def test_nonsense_gives_finite_numbers(model, timing):
    """A vehicle that tumbles and leaps, absurd ranges, bearings and variances."""
    rng = np.random.default_rng(1)
    tracker = ObstacleTracker(
        ObstacleConfig(
            azimuth_model=model, ping_timing=timing, confirm_hits=1, max_navigation_gap=5.0,
        )
    )  # fmt: skip
    estimates = []
    for k in range(1, 60):
        q = rng.normal(size=4)
        pose = Navigation(
            stamp_ns=k * SECOND,
            position=rng.normal(size=3) * 10 ** rng.uniform(-2.0, 6.0),
            orientation=q / np.linalg.norm(q),
        )
        D = int(rng.integers(0, 40))
        ping = Detections(
            stamp_ns=k * SECOND + 1000,
            range=10 ** rng.uniform(-6.0, 5.0, D),
            bearing=rng.uniform(-1.7, 1.7, D),
            var_range=10 ** rng.uniform(-14.0, 6.0, D),
            var_bearing=10 ** rng.uniform(-14.0, 2.0, D),
        )
        again = evolve(ping, stamp_ns=k * SECOND + 2000)  # what is seen again has tracks
        height = Altitude(stamp_ns=k * SECOND, altitude=float(10 ** rng.uniform(-3.0, 4.0)))
        estimates += [
            estimate for item in (height, pose, ping, again) for estimate in tracker.process(item)
        ]
    assert sum(map(len, estimates)) > 50
    for estimate in estimates:
        for name, column in estimate.columns().items():
            assert name in MAY_BE_UNKNOWN or np.isfinite(column).all()


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
