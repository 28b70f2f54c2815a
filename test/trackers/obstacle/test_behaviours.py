# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What obstacles do, through the whole tracker; echoes of bodies wander, and errors are common."""

from types import SimpleNamespace

from attrs import evolve
from helpers.estimates import same
from helpers.obstacle_runs import crossing, navigation, offset_at, rows, SECOND, track_scene
import numpy as np
from numpy.testing import assert_allclose
import pytest

from benchmarks.false_warnings import detected
from benchmarks.obstacle_sea import truth_tables
from benchmarks.study import final_estimates, truths
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.measurements import Detections, Navigation
from sonar_imm.trackers.obstacle import filters
from sonar_imm.trackers.obstacle.bodies import Bodies, CENTRE, with_common_errors
from sonar_imm.trackers.obstacle.config import ObstacleConfig
from sonar_imm.trackers.obstacle.filters import (
    behaviour_columns,
    BehaviourSlices,
    build_filter,
    Sonar,
    View,
)
from sonar_imm.trackers.obstacle.tracker import ObstacleTracker
from sonar_imm_tools.evaluation.obstacle.scoring import score
from sonar_imm_tools.evaluation.obstacle.series import series_of, truth_of
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate, TrueObstacle


def test_crossing_in_clutter_while_another_is_born():
    """Echoes are missed, three in a ping are false, a third obstacle comes into view."""
    estimates, true = crossing(detected=0.9, clutter=3.0, late=30)

    def confirmed(estimate):
        return set(estimate.extras['track_id'][estimate.extras['track_state'] > 0].tolist())

    two = confirmed(estimates[25])
    assert len(two) == 2
    assert sum(two <= confirmed(estimate) for estimate in estimates[25:]) == len(estimates[25:])
    born = confirmed(estimates[50]) - two
    assert len(born) == 1
    last = estimates[-1]
    known = two | born
    assert len(confirmed(last) - known) <= 1
    stated = {
        int(number): np.array([vx, vy])
        for number, vx, vy in zip(*(last.extras[name] for name in ('track_id', 'vx', 'vy')))
        if number in known
    }
    assert np.linalg.norm(stated[born.pop()] - true[2]) < 0.05
    north = sorted(v[1] for number, v in stated.items() if number in two)
    assert north == pytest.approx([-0.5, 0.5], abs=0.1)


def test_a_drifting_navigation_is_said():
    """The ground moves under a log that measures against the water: all obstacles move alike."""
    drift = np.array([0.3, 0.1, 0.0])
    scene = simulate(scenario('six', {'clutter': 0.0, 'detection_probability': 1.0}), 1)

    def run(v):
        tracker, first, message = ObstacleTracker(ObstacleConfig()), None, []
        for item in scene.measurements:
            measurement = item.measurement
            if isinstance(measurement, Navigation):
                first = first or measurement.stamp_ns
                seconds = (measurement.stamp_ns - first) * 1e-9
                measurement = evolve(measurement, position=measurement.position + seconds * v)
            tracker.process(measurement)
            message.append(tracker.health()['moving_alike'])
        return max(message), tracker.health()['pings_moving_alike']

    assert run(drift)[0] == 1 and run(drift)[1] > 10
    assert run(0.0 * drift) == (0, 0)


def test_the_order_of_the_behaviours_does_not_matter():
    _, first = track_scene('swaying', 1, {'last_range': 70.0}, behaviours=('fixed', 'swaying'))
    _, other = track_scene('swaying', 1, {'last_range': 70.0}, behaviours=('swaying', 'fixed'))
    assert list(first) == list(other) and all(same(first[k], other[k]) for k in first)


def test_what_sways_farther_counts_as_swaying():
    """Seen from outside there are three behaviours; how far an obstacle sways never changes."""
    filter_ = BehaviourSlices(ObstacleConfig())
    chain = filter_._transition(0.5)
    change = chain[0, 4]
    fixed, near, far, _, begun_moving = range(5)
    np.testing.assert_allclose(chain.sum(axis=1), 1.0, rtol=1e-15)
    assert chain[near, far] == chain[far, near] == 0.0
    assert chain[fixed, near] + chain[fixed, far] == pytest.approx(change)
    assert chain[near, begun_moving] == chain[far, begun_moving] == change
    assert change == pytest.approx(0.5 * 0.5 / 1000.0, rel=1e-3)
    sonar = Sonar(Pose(np.array([0.0, 0.0, 20.0]), np.eye(3)), 15.0)
    begun = filter_.begin(np.array([[60.0, 0.1]]), np.diag([0.02, 2e-5])[None], sonar)
    np.testing.assert_allclose(filter_.behaviour(begun.mu)[0], [0.54, 0.18, 0.18, 0.1])


def test_how_far_an_obstacle_sways_need_not_be_known(monkeypatch):
    """A metre, twice what `sway_std` says: eight obstacles at 30 m."""

    def nees():
        values = {'obstacle_sway': 1.0, 'obstacles': 8, 'spacing': 8.0, 'last_range': -30.0}
        scene, final = track_scene('swaying', 77, values)
        squared, inside = [], []
        for truth in scene.truth:
            error, variance, held, _ = offset_at(evolve(scene, truth=(truth,)), final, 30.0)
            squared.append(error**2 / variance)
            inside.append(held)
        return np.mean(squared), np.mean(inside)

    squared, inside = nees()
    assert squared < 1.7 and inside > 0.7
    monkeypatch.setattr(filters, 'WIDE_SHARE', 1e-12)
    assert nees()[0] > 1.5 * squared


def test_the_depth_of_the_sea_floor_is_that_of_the_first_sight():
    """Relief: the altitude is that of the floor below the vehicle, wherever the obstacle lies."""
    filter_ = build_filter(ObstacleConfig())
    first, later = (
        Sonar(Pose(np.array([north, 0.0, 20.0]), np.eye(3)), altitude)
        for north, altitude in ((0.0, 6.0), (1.0, 4.5))
    )
    begun = filter_.begin(np.array([[60.0, 0.1]]), np.diag([0.02, 2e-5])[None], first)
    after, _ = filter_.advance(begun, first, later, 0.5)
    assert begun.x[0, -1, 2] == pytest.approx(26.0)
    np.testing.assert_allclose(after.x[..., 2], begun.x[..., 2])


def test_north_and_east_become_y_and_x():
    view = SimpleNamespace(
        behaviour=np.array([[0.7, 0.3]]),
        velocity=np.array([[1.0, -2.0]]),
        velocity_covariance=np.array([[[4.0, 0.5], [0.5, 9.0]]]),
    )
    columns = behaviour_columns(view, ('fixed', 'moving'))
    names = 'prob_fixed prob_moving vx vy vel_cov_x_x vel_cov_x_y vel_cov_y_y'
    assert {name: float(value[0]) for name, value in columns.items()} == dict(
        zip(names.split(), (0.7, 0.3, -2.0, 1.0, 9.0, 0.5, 4.0), strict=True)
    )


@pytest.mark.parametrize(
    'moving, other, confirmed, alike',
    [
        (3, 0, 5, 1),
        (3, 0, 6, 0),
        (2, 0, 2, 0),
        (2, 1, 3, 0),
        (4, 2, 7, 1),
        (4, 2, 8, 0),
        (0, 0, 9, 0),
    ],
)
def test_it_takes_three_and_more_than_half_of_all_to_doubt_the_navigation(
    moving, other, confirmed, alike, monkeypatch
):
    """`moving` obstacles move alike, `other` elsewhere, the rest stands still."""
    count = moving + other
    mu = np.zeros((confirmed + 1, 2))
    mu[:, 0], mu[:count] = 1.0, (0.1, 0.9)
    v = np.zeros((count, 2))
    v[:moving] = (0.4, 0.0)
    v[moving:] = np.arange(other)[:, None] * 30.0 - 100.0
    monkeypatch.setattr(
        filters, '_velocity', lambda *_: (v, np.tile(1e-4 * np.eye(2), (count, 1, 1)))
    )
    filter_ = SimpleNamespace(moves=np.array([False, True]), behaviours=('fixed', 'moving'))
    mixture = SimpleNamespace(mu=mu)
    known = np.arange(confirmed + 1) < confirmed  # the last one is tentative
    assert filters.moving_alike(filter_, mixture, known) == alike


OWN = np.array([0.15, 0.004]) ** 2
Z = np.array([[40.0, 0.1]])


def stated(std_range, std_across, z=Z):
    return np.square([std_range, std_across / z[0, 0]])[None, :, None] * np.eye(2)


def test_an_echo_is_as_uncertain_as_those_of_its_track_were():
    bodies, given = Bodies.unknown(1), np.array([True])
    used = []
    for k in range(200):
        # Every other echo looks like that of a point.
        bodies, R = bodies.with_echoes(
            given, Z, stated(*((0.2, 0.4) if k % 2 else (0.02, 0.04))), OWN
        )
        used.append(np.sqrt(np.diagonal(R[0])) * [1.0, Z[0, 0]])
    assert_allclose(used[0], [(0.15 + 0.02) / 2.0, (0.004 * 40.0 + 0.04) / 2.0])
    assert_allclose(np.mean(used[100:], axis=0), [0.11, 0.22], rtol=0.02)
    assert np.ptp(used[100:], axis=0)[0] < 0.02


def test_detections_without_extent_are_as_uncertain_as_they_say():
    bodies, R = Bodies.unknown(2), np.array([0.3, 0.01])[:, None, None] * np.eye(2)
    after, used = bodies.with_echoes(np.array([False, False]), np.repeat(Z, 2, axis=0), R, OWN)
    assert after is bodies and used is R
    after, used = bodies.with_echoes(np.array([False, True]), np.repeat(Z, 2, axis=0), R, OWN)
    assert_allclose(used[0], R[0])
    assert after.number.tolist() == [0.0, 1.0] and not after.std[0].any()


def test_the_size_is_kept_in_metres_while_the_range_closes():
    bodies, given = Bodies.unknown(1), np.array([True])
    for distance in np.linspace(50.0, 10.0, 60):
        z = np.array([[distance, 0.0]])
        bodies, R = bodies.with_echoes(given, z, stated(0.1, 0.3, z), OWN)
    assert_allclose(np.sqrt(R[0, 1, 1]) * 10.0, 0.3, rtol=0.05)


def test_an_error_of_the_scale_lies_along_the_line_of_sight():
    """Sampling: all that is seen is too far by the same unknown factor."""
    rng = np.random.default_rng(0)
    sonar = Sonar(Pose(np.array([5.0, -3.0, 20.0]), np.eye(3)))
    away = np.array([30.0, 12.0, 4.0])
    state = np.array([np.linalg.norm(away), np.arctan2(12.0, 30.0), 4.0])
    view = view_of(state, sonar.pose.position + away)
    found = with_common_errors(view, sonar, Bodies.unknown(1), 0.01)
    factor = 1.0 + 0.01 * rng.normal(size=(200_000, 1))
    seen = factor * state * [1.0, 0.0, 1.0]
    assert_allclose(found.covariance[0], np.cov(seen.T), atol=2e-3)
    assert_allclose(found.place_covariance[0], np.cov((factor * away).T), atol=2e-3)
    assert not view.covariance.any() and not view.place_covariance.any()


def test_the_centre_of_a_body_lies_beside_its_echoes():
    sonar = Sonar(Pose(np.zeros(3), np.eye(3)))
    away = 20.0 * np.array([np.cos(0.5), np.sin(0.5), 0.0])
    view = view_of(np.array([20.0, 0.5, 0.0]), away)
    found = with_common_errors(view, sonar, Bodies(np.ones(1), np.array([[0.2, 0.6]])), 0.0)
    assert_allclose(np.diagonal(found.covariance[0]), CENTRE * np.array([0.04, 0.36 / 400.0, 0.0]))
    along = away / 20.0
    across = np.array([-along[1], along[0], 0.0])
    assert_allclose(along @ found.place_covariance[0] @ along, CENTRE * 0.04)
    assert_allclose(across @ found.place_covariance[0] @ across, CENTRE * 0.36)


def view_of(state, place):
    nothing = np.zeros((1, 1))
    return View(
        state=state[None], covariance=np.zeros((1, 3, 3)), low=nothing[0], high=nothing[0],
        above=nothing[0], place=place[None], place_covariance=np.zeros((1, 3, 3)),
        behaviour=nothing, velocity=np.zeros((1, 2)), velocity_covariance=np.zeros((1, 2, 2)),
        near=(np.zeros((1, 1, 5)), np.zeros((1, 1, 5, 5))),
    )  # fmt: skip


def test_a_track_that_was_missed_keeps_its_size():
    tracker = ObstacleTracker(ObstacleConfig(confirm_hits=1))
    for k, echoes in enumerate(([40.0], [39.25], [], [37.75])):
        stamp = (k + 1) * SECOND
        tracker.process(navigation(rows('approach_dst+3_noisy')[2 * k], stamp))
        n = len(echoes)
        tracker.process(
            Detections(
                stamp_ns=stamp, range=echoes, bearing=[0.1] * n, var_range=[0.01] * n,
                var_bearing=[1e-5] * n, extent_range=[0.1] * n, extent_bearing=[0.003] * n,
            )
        )  # fmt: skip
        number = tracker._stream.state.known.obstacles.bodies.number
        assert number.tolist() == [[], [2.0], [2.0], [3.0]][k]


def image_run(setting, seed):
    """NEES of range, bearing and offset alone, of all together over 3, and coverage, of the track
    through the images of a scene."""
    scene = simulate(setting, seed)
    given = detected(setting, [item.measurement for item in scene.measurements])
    config = ObstacleConfig(max_range=setting.max_range)
    final = final_estimates(ObstacleTracker(config), given)
    truth = [table for true in truths(scene, TrueObstacle) for table in truth_tables(true)]
    metrics, found = score(series_of(final.values()), truth_of(truth), cutoff=5.0, gap=60.0)
    variance = np.diagonal(found.series.covariance[found.row], axis1=1, axis2=2)
    consistency = metrics['consistency']
    return (
        *np.mean(found.error**2 / variance, axis=0),
        consistency['nees_state']['mean'] / 3.0,
        consistency['band_coverage'],
    )


@pytest.mark.statistics
def test_tracks_of_images_are_as_good_as_they_say():
    """24 scenes: how far glints are apart does not tell how far the centroid is off."""
    setting = scenario(
        'images',
        {
            'image_beams': 96, 'image_bins': 192, 'max_range': 32.0, 'first_range': 30.0,
            'last_range': 15.0, 'passing_distance': 3.0, 'vertical_offset': 1.5,
        },
    )  # fmt: skip
    runs = np.array([image_run(setting, seed) for seed in range(24)])
    range_, bearing, offset, state, cover = runs.mean(axis=0)
    assert 0.4 < state < 1.5
    assert range_ < 1.6 and bearing < 1.6 and offset < 1.5
    assert 0.84 < cover
    assert np.quantile(runs[:, 3], 0.9) < 3.0  # none is far too sure
