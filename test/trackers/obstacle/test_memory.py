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
from helpers.obstacle_runs import column, echoes, ENCOUNTERS, EXACT, met, run, SECOND, still
from helpers.tracked import resumed
from helpers.vector_files import load_vectors
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.spatial.transform import Rotation

from sonar_imm.acoustics import geometry
from sonar_imm.measurements import Altitude, Navigation
from sonar_imm.trackers.navigation import NavigationBuffer
from sonar_imm.trackers.obstacle import avoidance
from sonar_imm.trackers.obstacle.avoidance import Safety
from sonar_imm.trackers.obstacle.existence import PRIOR
from sonar_imm.trackers.obstacle.memory import kept
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker
from sonar_imm_tools.simulation.obstacle.simulator import scenario, Swing

DEPTH, RADIUS, SPEED = 20.0, 12.0, 1.5
OBSTACLES = np.array([[60.0, 5.0, 22.0], [80.0, -4.0, 18.5], [50.0, 20.0, 21.0]])
GOLDEN = load_vectors('obstacle_sea/cpa_golden')


class Ping(NamedTuple):
    """In which pass, which of the obstacles gave an echo, (n,), and where the navigation of that
    moment has them, (n, 3) ENU."""

    stamp_ns: int
    leg: int
    seen: np.ndarray
    place: np.ndarray


def lane(length, passes):
    """A vehicle that goes to and fro between two parallel lines, 2 RADIUS apart, each `length` m
    long: north, east, heading in rad and number of the pass (n,), twice a second."""
    step, parts = 0.5 * SPEED, []
    along, turn = np.arange(0.0, length, step), np.arange(0.0, np.pi, step / RADIUS)
    north = np.append(along, length + RADIUS * np.sin(turn))
    east = np.append(0.0 * along, RADIUS - RADIUS * np.cos(turn))
    heading = np.append(0.0 * along, turn)
    for k in range(passes):
        place = [length - north, 2.0 * RADIUS - east] if k % 2 else [north, east]
        parts.append([*place, heading + np.pi * (k % 2), np.full(len(north), k)])
    north, east, heading, leg = np.concatenate(parts, axis=1)
    return north, east, np.unwrap(heading), leg


def survey(obstacles, seed, *, passes=3, clutter=0.2):
    """Measurements of a survey over obstacles (n, 3) NED, and its pings."""
    rng, edge = np.random.default_rng(seed), np.radians(22.5)
    north, east, heading, leg = lane(120.0, passes)
    n = len(north)
    t = 0.5 * np.arange(n)
    wave = [np.sin(2.0 * np.pi * t / period + rng.uniform(0, 6)) for period in (6.0, 8.0, 20.0)]
    roll, pitch, heave = np.radians(2.1) * wave[0], np.radians(1.4) * wave[1], 0.3 * wave[2]
    position = np.column_stack([north, east, DEPTH + heave])
    R = geometry.rotation(roll, pitch, heading)
    # Drift of the place and of the heading.
    walk = 0.01 * np.sqrt(0.5) * rng.normal(size=(n, 2)).cumsum(axis=0)
    turned = np.radians(0.02) * np.sqrt(0.5) * rng.normal(size=n).cumsum()
    seen_R = geometry.rotation(roll, pitch, heading + turned)
    seen_at = position + np.column_stack([walk, np.zeros(n)])
    q = Rotation.from_matrix(geometry.flip_rotation(seen_R)).as_quat()
    measurements, pings = [], []
    for k in range(n):
        stamp, place = (k + 2) * SECOND // 2, geometry.flip_world(seen_at[k])
        m = geometry.to_body(geometry.Pose(position[k], R[k]), np.asarray(obstacles))
        d, azimuth = geometry.project(m)
        inside = (np.abs(azimuth) < edge) & (d < 60.0) & (m[:, 0] > 0.0)
        inside &= np.abs(np.arcsin(m[:, 2] / d)) < np.radians(7.5)
        inside &= rng.uniform(size=len(d)) < 0.9
        z = np.column_stack([d, azimuth])[inside]
        z = z + [0.15, np.radians(0.25)] * rng.normal(size=z.shape)
        other = rng.uniform([1.0, -edge], [60.0, edge], (rng.poisson(clutter), 2))
        measurements += [
            Altitude(stamp_ns=stamp, altitude=10.0 - heave[k]),
            Navigation(stamp_ns=stamp, position=place, orientation=q[k], frame_id='odom'),
            echoes(stamp, np.vstack([z, other]) * [1.0, -1.0]),
        ]
        away = np.asarray(obstacles) - position[k]
        there = seen_at[k] + away @ (seen_R[k] @ R[k].T).T
        pings.append(Ping(stamp, int(leg[k]), inside, geometry.flip_world(there)))
    return measurements, pings


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
    (first,), (second,) = numbers[0, 0], numbers[1, 0]
    assert numbers[0, 2] == {first} and numbers[1, 2] == {second}
    assert max(map(len, memories)) >= 2
    forgetful, _ = followed(tracker_of(max_landmarks=0), measurements, pings)
    assert forgetful[0, 0] == {first} and first not in forgetful[0, 2]
    rows = {row['track_id']: row for row in tracker.known()}
    row = rows[first]
    assert second in rows and row['existence'] > 0.75
    assert -24.0 < row['z_low'] < row['z_high'] < -19.5
    assert row['x'] == pytest.approx(pings[-1].place[0, 0], abs=1.0)


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
    first_pass, tracker = pings[len(pings) // 3].stamp_ns, tracker_of()
    run(tracker, [each for each in there if each.stamp_ns < first_pass])
    (landmark,) = tracker.landmarks
    assert landmark.existence(first_pass, 1e9) > 0.5
    later = run(tracker, [each for each in gone if each.stamp_ns >= first_pass])
    assert sum(map(len, later.values())) > 5  # it came back, coasting, and ended by its misses
    assert tracker.landmarks == () and tracker.known() == []


@pytest.fixture(scope='module')
def half(tmp_path_factory):
    """A tracker with landmarks, which stays as it is, one that goes on from its file, and what was
    left to hear."""
    measurements, pings = survey(OBSTACLES, 11)
    middle, tracker = pings[len(pings) // 2].stamp_ns, tracker_of()
    run(tracker, [each for each in measurements if each.stamp_ns < middle])
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
    sure = evolve(config, landmark_time=1e8)
    # Those of the future are none.
    for now, given, left in (hour, config, [1, 2]), (hour, sure, [0, 3]), (hour // 4, config, [0]):
        assert [each.track_id for each in kept(memory, now, given)] == left
    drifted = mark.spread(mark.stamp_ns + hour, config) - mark.covariance
    assert_allclose(np.sqrt(np.diag(drifted)), 0.6)  # .01 m/sqrt(s) for an hour


def test_landmarks_outlive_a_silence_but_not_a_clock_that_goes_back(half):
    """What is in view when the clock jumps ahead is kept as well."""
    _, tracker, rest = half
    known = {row['track_id'] for row in tracker.known()}
    run(tracker, [evolve(m, stamp_ns=m.stamp_ns + 7200 * SECOND) for m in rest[:300]])
    assert tracker.counts['restarts'] == 1
    assert known & {row['track_id'] for row in tracker.known()}
    run(tracker, survey(OBSTACLES[:0], 11)[0][:60])
    assert tracker.counts['restarts'] == 2 and not tracker.landmarks


def test_what_moves_is_no_landmark():
    """It comes towards a vehicle that stands still, and in the end turns round."""
    tracker, most = tracker_of(), 0
    for k in range(84):
        away, stamp = k >= 80, (k + 2) * SECOND // 2
        d, azimuth = geometry.project(np.array([40.0 - 0.25 * k, 12.0 - 0.4 * k, 1.0]))
        seen = [(d, -azimuth)] if abs(azimuth) < np.radians(22.5) and not away else []
        turned = [0.0, 0.0, 1.0 * away, 1.0 - away]
        given = [Altitude(stamp_ns=stamp, altitude=10.0), still(stamp, orientation=turned)]
        run(tracker, [*given, echoes(stamp, seen)])
        most = max(most, tracker.health()['confirmed'])
    assert most == 1 and tracker.health()['tracks'] == 0 and tracker.landmarks == ()


def test_late_pings_change_what_is_remembered_as_in_order():
    measurements, _ = survey(OBSTACLES, 5, passes=1)
    delay = np.random.default_rng(1).uniform(0.0, 2.0, len(measurements)) * SECOND
    arrival = np.array([each.stamp_ns for each in measurements]) + delay
    in_order, shuffled = tracker_of(), tracker_of()
    run(in_order, measurements)
    run(shuffled, [measurements[k] for k in np.argsort(arrival, kind='stable')])
    assert in_order.known() and shuffled.known() == in_order.known()


def test_closest_approach_and_collision_of_a_point_are_exact():
    for k in range(len(GOLDEN['dz'])):
        r, dz, w, wz, *size, horizon, inside = (
            GOLDEN[name][k] for name in 'r dz w wz radius half_height horizon inside'.split()
        )
        time, distance = avoidance.closest(*r, *w, horizon)
        assert time == pytest.approx(GOLDEN['cpa_time'][k], abs=1e-9)
        assert distance == pytest.approx(GOLDEN['cpa_distance'][k], abs=1e-9)
        assert avoidance.collides(*r, dz, *w, wz, *size, horizon) == inside


@pytest.mark.parametrize('k', range(9))
def test_collision_of_a_gaussian(k):
    names = 'mean cov vehicle vehicle_std radius half_height probability'
    mean, P, V, std, radius, half_height, exact = (GOLDEN[f'g_{n}'][k] for n in names.split())
    limits = (float(each) for each in (std, radius, half_height, GOLDEN['g_horizon']))
    stated = probability(mean, P, Safety(V.copy(), *limits, avoidance.draws()))
    assert stated == pytest.approx(exact, abs=0.02 if k == 7 else 0.01)


def probability(g, C, safety):
    return avoidance.assess(g[None, None], C[None, None], np.ones((1, 1)), safety)[2][0]


def test_the_closed_form_agrees_with_sampling():
    rng, errors = np.random.default_rng(1), []
    for _ in range(40):
        g = np.array([rng.uniform(15.0, 80.0), rng.normal(0.0, 4.0), rng.normal(0.0, 2.5), 0, 0])
        g[3:] = rng.normal(0.0, 0.3, 2)
        A = rng.normal(size=(5, 5)) * np.array([0.1, 0.4, 0.5, 0.03, 0.03])[:, None]
        C = A @ A.T + np.diag([0.01, 0.05, 0.05, 1e-4, 1e-4])
        settings = np.array([1.5, 0.0, 0.0]), 0.05, 3.0, 2.0, 120.0
        L = np.linalg.cholesky(C + np.diag([0, 0, 0, 0.05**2, 0.05**2]))
        many = Safety(*settings, rng.normal(size=(20_000, 5)))
        exact = avoidance.sampled(g[:, None], L[..., None], many)[0]
        errors.append(probability(g, C, Safety(*settings, avoidance.draws())) - exact)
    assert np.sqrt(np.mean(np.square(errors))) < 0.01 and np.max(np.abs(errors)) < 0.04


def course(seconds, positions, stamp_ns):
    buffer = NavigationBuffer()
    for t, position in zip(seconds, positions):
        pose = {'position': position, 'orientation': [0.0, 0.0, 0.0, 1.0]}
        buffer = buffer.added(Navigation(stamp_ns=round(t * 1e9), **pose))
    return avoidance.course(buffer, stamp_ns, 10.0)


def test_the_course_is_the_line_and_not_the_swing():
    """Positions of less than a second are none."""
    t = np.arange(0.1, 20.0, 0.1)
    swing = np.outer(0.1 * np.sin(2.0 * np.pi * t / 5.0), [0.0, 1.0, 0.0])
    positions = np.outer(t, [1.2, -0.9, 0.05]) - [0.0, 0.0, 20.0] + swing
    assert_allclose(course(t, positions, 20 * 10**9), [1.2, -0.9, 0.05], atol=0.03)
    assert np.isnan(course(t, positions, 40 * 10**9)).all()
    whole = course((4.0, 5.0), [[12.0, -4.0, 0.5], [15.0, -5.0, 0.5]], 5 * 10**9)
    assert_allclose(whole, [3.0, -1.0, 0.0], atol=1e-9)
    for seconds in ((), (5.0,), (4.5, 5.0), (5.0, 5.0 + 2e-9)):
        assert np.isnan(course(seconds, positions, 6 * 10**9)).all()


def test_the_course_is_as_sure_as_its_default_says():
    """The sway of the simulated vehicle, and of the study's, is what makes a course wrong."""
    setting, t = scenario('approach'), np.arange(0.0, 10.05, 0.1)
    swings = (
        Swing(setting.sway_rms, setting.sway_period, np.random.default_rng(seed))
        for seed in range(60)
    )
    across = np.polyfit(t, np.transpose([sway(t) for sway in swings]), 1)[0]
    stated = ObstacleConfig().course_std
    assert np.sqrt(np.mean(np.square(across))) == pytest.approx(stated, rel=0.2)


def test_the_tracker_says_what_an_independent_one_does():
    """With its `course_std` and navigation without errors that last."""
    off = {'cpa_distance': [], 'cpa_time': [], 'collision_probability': []}
    for name, number in ENCOUNTERS:
        data, estimates = met(name, number, course_std=0.05, **EXACT)
        given = np.flatnonzero(np.isfinite(data['ref_collision']))
        for key, reference in zip(off, ('cpa_distance', 'cpa_time', 'collision')):
            off[key].extend(column(estimates, key, given) - data[f'ref_{reference}'][given])
    for values, most in zip(off.values(), (0.4, 0.1, 0.02)):
        assert len(values) == 15 and np.sqrt(np.mean(np.square(values))) < most
    assert np.abs(off['collision_probability']).max() < 0.06
