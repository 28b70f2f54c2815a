# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""Obstacles that leave the field of view and come back; closest approach and collision."""

from typing import NamedTuple

from attrs import evolve
from helpers.obstacle_runs import EXACT
from helpers.obstacle_sea import column, ENCOUNTERS, tracked
from helpers.tracked import resumed
from helpers.vector_files import load_vectors
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.spatial.transform import Rotation

from sonar_imm.acoustics import geometry
from sonar_imm.measurements import Altitude, Detections, Navigation
from sonar_imm.trackers.navigation import NavigationBuffer
from sonar_imm.trackers.obstacle import avoidance
from sonar_imm.trackers.obstacle.avoidance import Safety
from sonar_imm.trackers.obstacle.existence import PRIOR
from sonar_imm.trackers.obstacle.memory import kept
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker
from sonar_imm_tools.simulation.obstacle.simulator import scenario, Swing

DEPTH = 20.0
RADIUS = 12.0
SPEED = 1.5


class Ping(NamedTuple):
    """A ping: in which pass, which of the obstacles gave an echo, (n,), and where the navigation
    of that moment has them, (n, 3) ENU."""

    stamp_ns: int
    leg: int
    seen: np.ndarray
    place: np.ndarray


def lane(length, passes):
    """A vehicle that goes to and fro between two parallel lines, 2 RADIUS apart, each `length` m
    long: north, east, heading in rad and number of the pass (n,), twice a second."""
    step = 0.5 * SPEED
    north, east, heading, leg = [], [], [], []
    for k in range(passes):
        along = np.arange(0.0, length, step)
        out = k % 2 == 0
        north.append(along if out else length - along)
        east.append(np.full(len(along), 0.0 if out else 2.0 * RADIUS))
        heading.append(np.full(len(along), 0.0 if out else np.pi))
        turn = np.arange(0.0, np.pi, step / RADIUS)
        side = 1.0 if out else -1.0
        north.append((length if out else 0.0) + side * RADIUS * np.sin(turn))
        east.append(RADIUS - side * RADIUS * np.cos(turn))
        heading.append(turn + (0.0 if out else np.pi))
        leg.append(np.full(len(along) + len(turn), k))
    north, east, heading, leg = map(np.concatenate, (north, east, heading, leg))
    return north, east, np.unwrap(heading), leg


def survey(obstacles, seed, *, passes=3, clutter=0.2):
    """Measurements of a survey over obstacles (n, 3) NED, and its pings."""
    length, drift, yaw_drift_deg, P_D = 120.0, 0.01, 0.02, 0.9
    rng = np.random.default_rng(seed)
    north, east, heading, leg = lane(length, passes)
    n = len(north)
    t = 0.5 * np.arange(n)
    wave = [np.sin(2.0 * np.pi * t / period + rng.uniform(0, 6)) for period in (6.0, 8.0, 20.0)]
    roll, pitch, heave = np.radians(2.1) * wave[0], np.radians(1.4) * wave[1], 0.3 * wave[2]
    position = np.column_stack([north, east, DEPTH + heave])
    R = geometry.rotation(roll, pitch, heading)
    walk = np.sqrt(0.5) * drift * rng.normal(size=(n, 2)).cumsum(axis=0)
    turned = np.radians(yaw_drift_deg) * np.sqrt(0.5) * rng.normal(size=n).cumsum()
    seen_R = geometry.rotation(roll, pitch, heading + turned)
    seen_at = position + np.column_stack([walk, np.zeros(n)])
    q = Rotation.from_matrix(geometry.flip_rotation(seen_R)).as_quat()
    measurements, pings = [], []
    for k in range(n):
        stamp = (k + 2) * SECOND // 2
        measurements.append(Altitude(stamp_ns=stamp, altitude=10.0 - heave[k]))
        place = geometry.flip_world(seen_at[k])
        measurements.append(
            Navigation(stamp_ns=stamp, position=place, orientation=q[k], frame_id='odom')
        )
        m = geometry.to_body(geometry.Pose(position[k], R[k]), np.asarray(obstacles))
        d, azimuth = geometry.project(m)
        inside = (np.abs(azimuth) < np.radians(22.5)) & (d < 60.0) & (m[:, 0] > 0.0)
        inside &= np.abs(np.arcsin(m[:, 2] / d)) < np.radians(7.5)
        inside &= rng.uniform(size=len(d)) < P_D
        z = np.column_stack([d, azimuth])[inside]
        z = z + [0.15, np.radians(0.25)] * rng.normal(size=z.shape)
        false = rng.poisson(clutter)
        other = rng.uniform([1.0, -np.radians(22.5)], [60.0, np.radians(22.5)], (false, 2))
        z = np.vstack([z, other])
        measurements.append(Detections(stamp_ns=stamp, range=z[:, 0], bearing=-z[:, 1]))
        away = np.asarray(obstacles) - position[k]
        there = seen_at[k] + away @ (seen_R[k] @ R[k].T).T
        pings.append(Ping(stamp, int(leg[k]), inside, geometry.flip_world(there)))
    return measurements, pings


OBSTACLES = np.array([[60.0, 5.0, 22.0], [80.0, -4.0, 18.5], [50.0, 20.0, 21.0]])
SECOND = 10**9


def tracker_of(**values):
    return ObstacleTracker(ObstacleConfig(max_range=60.0, **values))


def followed(tracker, measurements, pings):
    """The numbers of the confirmed tracks at each obstacle in each pass, and the landmarks at
    every change."""
    at, numbers, memories = {ping.stamp_ns: ping for ping in pings}, {}, []
    for measurement in measurements:
        for estimate in tracker.process(measurement):
            ping = at[estimate.stamp_ns]
            sure = estimate.extras['track_state'] > 0
            for j in np.flatnonzero(ping.seen):
                off = np.linalg.norm((estimate.xyz - ping.place[j])[:, :2], axis=1)
                found = estimate.extras['track_id'][sure & (off < 3.0)].tolist()
                numbers.setdefault((j, ping.leg), set()).update(found)
        if not memories or tracker.landmarks is not memories[-1]:
            memories.append(tracker.landmarks)
    return numbers, memories


def test_what_was_passed_has_the_same_number_in_the_third_pass():
    measurements, pings = survey(OBSTACLES, 7)
    tracker = tracker_of()
    numbers, memories = followed(tracker, measurements, pings)
    for j in range(2):
        assert len(numbers[j, 0]) == 1 and numbers[j, 2] == numbers[j, 0]
    assert max(map(len, memories)) >= 2
    forgetful, _ = followed(tracker_of(max_landmarks=0), measurements, pings)
    assert forgetful[0, 0] == numbers[0, 0] and forgetful[0, 2].isdisjoint(numbers[0, 0])
    rows = {row['track_id']: row for row in tracker.known()}
    (first,) = numbers[0, 0]
    assert {first, *numbers[1, 0]} <= set(rows)
    assert rows[first]['existence'] > 0.75
    assert -24.0 < rows[first]['z_low'] < rows[first]['z_high'] < -19.5
    assert rows[first]['x'] == pytest.approx(pings[-1].place[0, 0], abs=1.0)


@pytest.mark.statistics
def test_places_of_landmarks_are_as_good_as_they_state():
    """Over 8 surveys, in the frame that the navigation has at that moment."""
    level, height, inside, same_number = [], [], [], []
    for seed in range(200, 208):
        measurements, pings = survey(OBSTACLES, seed)
        at = {ping.stamp_ns: ping.place for ping in pings}
        numbers, memories = followed(tracker_of(), measurements, pings)
        same_number += [numbers[j, 2] == numbers[j, 0] for j in range(2)]
        unique = {(mark.track_id, mark.stamp_ns): mark for memory in memories for mark in memory}
        for mark in unique.values():
            true = at[mark.stamp_ns]
            off = mark.place - true[np.argmin(np.linalg.norm((true - mark.place)[:, :2], axis=1))]
            if np.linalg.norm(off[:2]) > 10.0:
                continue  # of clutter
            level.append(off[:2] @ np.linalg.solve(mark.covariance[:2, :2], off[:2]))
            height.append(off[2] ** 2 / mark.covariance[2, 2])
            inside.append(mark.low <= mark.place[2] - off[2] <= mark.high)
    assert np.mean(same_number) >= 0.8
    assert 1.0 < np.mean(level) < 3.0
    assert 0.5 < np.mean(height) < 1.6
    assert 0.78 < np.mean(inside) < 0.98


def test_a_landmark_that_is_not_there_any_more_goes():
    """It lay in the first pass; in the third its place is in plain view and there is nothing."""
    there, _ = survey(OBSTACLES[:1], 3, clutter=0.0)
    gone, pings = survey(OBSTACLES[:0], 3, clutter=0.0)
    first_pass = pings[len(pings) // 3].stamp_ns
    tracker = tracker_of()
    for measurement in there:
        if measurement.stamp_ns < first_pass:
            tracker.process(measurement)
    assert len(tracker.landmarks) == 1 and tracker.landmarks[0].existence(first_pass, 1e9) > 0.5
    seen = 0
    for measurement in gone:
        if measurement.stamp_ns >= first_pass:
            seen += sum(len(estimate) for estimate in tracker.process(measurement))
    assert seen > 5  # it came back, coasting, and ended by its misses
    assert tracker.landmarks == () and tracker.known() == []


@pytest.fixture(scope='module')
def half(tmp_path_factory):
    """A tracker with landmarks, which stays as it is, one that goes on from its file, and what was
    left to hear."""
    measurements, pings = survey(OBSTACLES, 11)
    middle = pings[len(pings) // 2].stamp_ns
    tracker = tracker_of()
    for measurement in measurements:
        if measurement.stamp_ns < middle:
            tracker.process(measurement)
    again = resumed(tmp_path_factory.mktemp('memory') / 'state', tracker, 'obstacle')
    assert again.landmarks and again.known() == tracker.known()
    return tracker, again, [each for each in measurements if each.stamp_ns >= middle]


def test_the_oldest_and_least_certain_landmarks_are_given_up_first(half):
    mark = half[0].landmarks[0]
    config = ObstacleConfig(max_landmarks=2, landmark_time=1000.0)
    hour = 3600 * SECOND
    there = [(0, 0.9999), (hour, 0.7), (hour, 0.8), (hour // 2, 0.9999)]
    memory = tuple(
        mark._replace(track_id=k, stamp_ns=stamp, classes=r * PRIOR)
        for k, (stamp, r) in enumerate(there)
    )
    assert [each.track_id for each in kept(memory, hour, config)] == [1, 2]
    sure = evolve(config, landmark_time=1e8)
    assert [each.track_id for each in kept(memory, hour, sure)] == [0, 3]
    assert [each.track_id for each in kept(memory, hour // 4, config)] == [0]  # not of the future
    drifted = mark.spread(mark.stamp_ns + hour, config) - mark.covariance
    np.testing.assert_allclose(np.sqrt(np.diag(drifted)), 0.6)  # .01 m/sqrt(s) for an hour


def test_landmarks_outlive_a_silence_but_not_a_clock_that_goes_back(half):
    """What is in view when the clock jumps ahead is kept as well."""
    _, tracker, rest = half
    known = {row['track_id'] for row in tracker.known()}
    for measurement in rest[:300]:
        tracker.process(evolve(measurement, stamp_ns=measurement.stamp_ns + 7200 * SECOND))
    assert tracker.counts['restarts'] == 1
    after = {row['track_id'] for row in tracker.known()}
    assert known & after
    back, _ = survey(OBSTACLES[:0], 11)
    for measurement in back[:60]:
        tracker.process(measurement)
    assert tracker.counts['restarts'] == 2 and not tracker.landmarks


def test_what_moves_is_no_landmark():
    tracker, most = tracker_of(), 0
    for k in range(84):
        away = k >= 80  # the vehicle turns round
        stamp = (k + 2) * SECOND // 2
        where = 40.0 - 0.25 * k  # towards a vehicle that stands still
        m = np.array([where, 12.0 - 0.4 * k, 1.0])
        d, azimuth = geometry.project(m)
        tracker.process(Altitude(stamp_ns=stamp, altitude=10.0))
        turned = [0.0, 0.0, 1.0 * away, 1.0 - away]
        tracker.process(Navigation(stamp_ns=stamp, position=[0.0, 0.0, -20.0], orientation=turned))
        seen = [(d, -azimuth)] if abs(azimuth) < np.radians(22.5) and not away else []
        z = np.reshape(seen, (-1, 2))
        tracker.process(Detections(stamp_ns=stamp, range=z[:, 0], bearing=z[:, 1]))
        most = max(most, tracker.health()['confirmed'])
    assert most == 1 and tracker.health()['tracks'] == 0 and tracker.landmarks == ()


def test_late_pings_change_what_is_remembered_as_in_order():
    measurements, _ = survey(OBSTACLES, 5, passes=1)
    rng = np.random.default_rng(1)
    delay = rng.uniform(0.0, 2.0, len(measurements)) * SECOND
    arrival = np.array([each.stamp_ns for each in measurements]) + delay
    in_order, shuffled = tracker_of(), tracker_of()
    for measurement in measurements:
        in_order.process(measurement)
    for k in np.argsort(arrival, kind='stable'):
        shuffled.process(measurements[k])
    assert in_order.known() and shuffled.known() == in_order.known()


@pytest.fixture(scope='module')
def golden():
    return load_vectors('obstacle_sea/cpa_golden')


def test_closest_approach_is_exact(golden):
    for k in range(len(golden['dz'])):
        time, distance = avoidance.closest(*golden['r'][k], *golden['w'][k], golden['horizon'][k])
        assert time == pytest.approx(golden['cpa_time'][k], abs=1e-9)
        assert distance == pytest.approx(golden['cpa_distance'][k], abs=1e-9)


def test_collision_of_a_point_is_exact(golden):
    inside = [
        avoidance.collides(
            *golden['r'][k], golden['dz'][k], *golden['w'][k], golden['wz'][k],
            golden['radius'][k], golden['half_height'][k], golden['horizon'][k],
        )
        for k in range(len(golden['dz']))
    ]  # fmt: skip
    assert np.array_equal(inside, golden['inside'])


def safety_of(golden, k):
    V = golden['g_vehicle'][k]
    return Safety(
        np.array([V[0], V[1], V[2]]), float(golden['g_vehicle_std'][k]),
        float(golden['g_radius'][k]), float(golden['g_half_height'][k]),
        float(golden['g_horizon']), avoidance.draws(),
    )  # fmt: skip


def probability(g, C, safety):
    """That one component collides."""
    return avoidance.assess(g[None, None], C[None, None], np.ones((1, 1)), safety)[2][0]


@pytest.mark.parametrize('k', range(9))
def test_collision_of_a_gaussian(golden, k):
    stated = probability(golden['g_mean'][k], golden['g_cov'][k], safety_of(golden, k))
    assert stated == pytest.approx(golden['g_probability'][k], abs=0.02 if k == 7 else 0.01)


def test_the_closed_form_agrees_with_sampling():
    rng = np.random.default_rng(1)
    errors = []
    for _ in range(40):
        g = np.array([rng.uniform(15.0, 80.0), rng.normal(0.0, 4.0), rng.normal(0.0, 2.5), 0, 0])
        g[3:] = rng.normal(0.0, 0.3, 2)
        A = rng.normal(size=(5, 5)) * np.array([0.1, 0.4, 0.5, 0.03, 0.03])[:, None]
        C = A @ A.T + np.diag([0.01, 0.05, 0.05, 1e-4, 1e-4])
        many = rng.normal(size=(20_000, 5))
        settings = np.array([1.5, 0.0, 0.0]), 0.05, 3.0, 2.0, 120.0
        L = np.linalg.cholesky(C + np.diag([0, 0, 0, 0.05**2, 0.05**2]))
        exact = avoidance.sampled(g[:, None], L[..., None], Safety(*settings, many))[0]
        stated = probability(g, C, Safety(*settings, avoidance.draws()))
        errors.append(stated - exact)
    assert np.sqrt(np.mean(np.square(errors))) < 0.01
    assert np.max(np.abs(errors)) < 0.04


def pose(seconds, position):
    return Navigation(
        stamp_ns=round(seconds * 1e9), position=position, orientation=[0.0, 0.0, 0.0, 1.0]
    )


def test_the_course_is_the_line_and_not_the_swing():
    buffer = NavigationBuffer()
    for t in np.arange(0.1, 20.0, 0.1):
        swing = 0.1 * np.sin(2.0 * np.pi * t / 5.0)
        buffer = buffer.added(pose(t, [1.2 * t, -0.9 * t + swing, -20.0 + 0.05 * t]))
    stamp = 20 * 10**9
    velocity = avoidance.course(buffer, stamp, 10.0)
    assert_allclose(velocity, [1.2, -0.9, 0.05], atol=0.03)
    assert np.isnan(avoidance.course(NavigationBuffer(), stamp, 10.0)).all()
    assert np.isnan(avoidance.course(buffer, 2 * stamp, 10.0)).all()


def test_the_course_is_as_sure_as_its_default_says():
    """The sway of the simulated vehicle, and of the study's, is what makes a course wrong."""
    setting = scenario('approach')
    across = []
    for seed in range(60):
        sway = Swing(setting.sway_rms, setting.sway_period, np.random.default_rng(seed))
        t = np.arange(0.0, 10.05, 0.1)
        across.append(np.polyfit(t, sway(t), 1)[0])
    assert np.sqrt(np.mean(np.square(across))) == pytest.approx(
        ObstacleConfig().course_std, rel=0.2
    )


def test_the_tracker_says_what_an_independent_one_does():
    """With its `course_std` and navigation without errors that last."""
    off = {'cpa_distance': [], 'cpa_time': [], 'collision_probability': []}
    for name, number in ENCOUNTERS:
        data, estimates = tracked(name, number, course_std=0.05, **EXACT)
        given = np.flatnonzero(np.isfinite(data['ref_collision']))
        for key, reference in zip(off, ('cpa_distance', 'cpa_time', 'collision')):
            off[key].extend(column(estimates, key, given) - data[f'ref_{reference}'][given])
    rms = {key: float(np.sqrt(np.mean(np.square(values)))) for key, values in off.items()}
    assert len(off['cpa_time']) == 15
    assert rms['cpa_distance'] < 0.4
    assert rms['cpa_time'] < 0.1
    assert rms['collision_probability'] < 0.02
    assert np.abs(off['collision_probability']).max() < 0.06


@pytest.mark.parametrize('seconds', [(), (5.0,), (4.5, 5.0), (5.0, 5.0 + 2e-9)])
def test_positions_of_less_than_a_second_are_no_course(seconds):
    buffer = NavigationBuffer()
    for k, second in enumerate(seconds):
        buffer = buffer.added(pose(second, [k, 0.0, 0.0]))
    assert np.isnan(avoidance.course(buffer, 6 * 10**9, 10.0)).all()
    whole = NavigationBuffer()
    for second in (4.0, 5.0):
        whole = whole.added(pose(second, [3.0 * second, -second, 0.5]))
    assert_allclose(avoidance.course(whole, 5 * 10**9, 10.0), [3.0, -1.0, 0.0], atol=1e-9)
