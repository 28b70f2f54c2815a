# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What obstacles do, through the whole tracker: clutter, several at once, drift, settings."""

from types import SimpleNamespace

from attrs import evolve
from helpers.obstacle_runs import offset_at, track_scene
import numpy as np
import pytest

from sonar_imm.acoustics.geometry import Pose
from sonar_imm.measurements import Navigation
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.obstacle import filters
from sonar_imm.trackers.obstacle.config import ObstacleConfig
from sonar_imm.trackers.obstacle.filters import (
    behaviour_columns,
    BehaviourSlices,
    build_filter,
    Sonar,
)
from sonar_imm.trackers.obstacle.tracker import ObstacleTracker
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate


def velocity_errors(scene, final, ping):
    """Error of the velocity, m/s, of the confirmed track nearest to each obstacle within 3 m."""
    errors = []
    estimate = final[int(scene.truth[0].stamp_ns[ping])]
    for truth in scene.truth:
        r, b = truth.range[ping], truth.bearing[ping]
        ours = estimate.state[:, 0], estimate.state[:, 1]
        off = np.hypot(
            ours[0] * np.cos(ours[1]) - r * np.cos(b), ours[0] * np.sin(ours[1]) - r * np.sin(b)
        )
        off = np.where(estimate.extras['track_state'] > 0, off, np.inf)
        if truth.in_beam[: ping + 1].sum() > 40 and len(off) and off.min() < 3.0:
            row = int(np.argmin(off))
            stated = np.array([estimate.extras[name][row] for name in ('vx', 'vy')])
            errors.append(float(np.linalg.norm(stated - truth.velocity[ping])))
    return errors


def test_movers_are_followed_through_clutter():
    """Born, confirmed and followed among false echoes, each by one track."""
    errors, tracks, obstacles = [], 0, 0
    for seed in range(3):
        scene, final = track_scene('movers', seed)
        errors += velocity_errors(scene, final, len(scene.truth[0].stamp_ns) - 12)
        ids = {
            int(number)
            for item in final.values()
            for number in item.extras['track_id'][item.extras['track_state'] > 0]
        }
        tracks, obstacles = tracks + len(ids), obstacles + len(scene.truth)
    assert len(errors) >= 5
    assert np.median(errors) < 0.12
    assert tracks <= obstacles + 3


def test_crossing_in_clutter_while_another_is_born():
    """Echoes are missed, three in a ping are false, a third obstacle comes into view."""
    from helpers.obstacle_crossing import crossing

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


@pytest.mark.parametrize(
    'behaviours, word',
    [(('seabed',), 'one of fixed'), (('fixed', 'fixed'), 'twice'), (('sway',), 'must be one of')],
)
def test_behaviours_that_make_no_sense_are_refused(behaviours, word):
    with pytest.raises(ConfigError, match=word):
        ObstacleConfig.from_mapping({'behaviours': list(behaviours)})


def test_the_order_of_the_behaviours_does_not_matter():
    _, first = track_scene('swaying', 1, {'last_range': 70.0}, behaviours=('fixed', 'swaying'))
    _, other = track_scene('swaying', 1, {'last_range': 70.0}, behaviours=('swaying', 'fixed'))
    for a, b in zip(first.values(), other.values(), strict=True):
        assert list(a.columns()) == list(b.columns())
        for name, values in a.columns().items():
            assert np.array_equal(values, b.columns()[name], equal_nan=True)


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
    assert {name: float(value[0]) for name, value in columns.items()} == {
        'prob_fixed': 0.7,
        'prob_moving': 0.3,
        'vx': -2.0,
        'vy': 1.0,
        'vel_cov_x_x': 9.0,
        'vel_cov_x_y': 0.5,
        'vel_cov_y_y': 4.0,
    }


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
