# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Sonars that turn: each obstacle at the instant at which the beam met it."""

from attrs import evolve
from helpers.obstacle_runs import run, SECOND
import numpy as np
from numpy.testing import assert_allclose
import pytest

from sonar_imm.acoustics import geometry
from sonar_imm.measurements import Detections, Navigation
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker

SWEEP, RATE = 9.0, np.radians(60.0) / 9.0
OBSTACLES = {'above': (60.0, 6.0, -7.0), 'level': (70.0, -8.0, -10.0), 'below': (55.0, 0.0, -12.0)}
LATEST = 54.0
WIDE = {'horizontal_fov_deg': 90.0}


def vehicle(t):
    """Pose at t of a vehicle that swims, dives and rolls, ENU and FLU."""
    position = np.array([0.6 * t, 0.3 * np.sin(0.2 * t), -10.0 + 0.5 * np.sin(0.15 * t)])
    angles = 0.03 * np.sin(1.1 * t), 0.01 * np.sin(0.7 * t), 0.08 * np.sin(0.1 * t)
    return position, angles


def seen(place, t):
    """Range and bearing, positive to port, of a place at t."""
    position, angles = vehicle(t)
    m = geometry.rotation(*angles).T @ (np.array(place) - position)
    return np.linalg.norm(m), np.arctan2(m[1], m[0])


def met(place, start):
    """When a beam that turns from port to starboard within the scan meets a place."""
    t = start
    for _ in range(20):
        t = start + (np.radians(30.0) - seen(place, t)[1]) / RATE
    return t


def navigation(t):
    position, angles = vehicle(t)
    q = geometry.quaternion(*angles)
    return Navigation(stamp_ns=stamp(t), position=position, orientation=q, frame_id='odom')


def stamp(t):
    return SECOND + round(t * SECOND)


def dive(scans, obstacles=OBSTACLES, noise=0.0):
    """Navigation at 10 Hz, and what `scans` makes of times, ranges and bearings of each scan."""
    rng = np.random.default_rng(8)
    out = [(stamp(k / 10), navigation(k / 10)) for k in range(1, int(LATEST * 10) + 12)]
    for start in np.arange(0.2, LATEST - SWEEP, SWEEP):
        times = np.array([met(place, start) for place in obstacles.values()])
        places = np.array([seen(place, t) for place, t in zip(obstacles.values(), times)])
        places += noise * rng.normal(size=places.shape) * [0.1, np.radians(0.2)]
        out += [(ping.stamp_ns, ping) for ping in scans(start, times, places)]
    return [item for _, item in sorted(out, key=lambda pair: pair[0])]


def as_scan(start, times, places):
    """One message of the whole scan, with times after its first ray."""
    yield Detections(
        stamp_ns=stamp(start), range=places[:, 0], bearing=places[:, 1], time_offset=times - start
    )


def as_pings(start, times, places):
    """A message for each instant."""
    for t, place in zip(times, places):
        yield Detections(stamp_ns=stamp(t), range=place[:1], bearing=place[1:])


def as_one_instant(start, times, places):
    yield Detections(stamp_ns=stamp(start), range=places[:, 0], bearing=places[:, 1])


def places_of(estimate):
    sure = estimate.extras['track_state'] > 0
    return np.column_stack([estimate.extras[name][sure] for name in ('px', 'py')])


def last(scans, obstacles=OBSTACLES, noise=0.0, **values):
    config = ObstacleConfig(confirm_hits=1, **(WIDE | values))
    return list(run(ObstacleTracker(config), dive(scans, obstacles, noise)).values())[-1]


def test_obstacles_are_where_they_are_however_long_a_scan_takes():
    found = places_of(last(as_scan, noise=1.0))
    assert len(found) == len(OBSTACLES)
    for x, y, _ in OBSTACLES.values():
        assert np.hypot(*(found - [x, y]).T).min() < 0.4
    off = places_of(last(as_one_instant, noise=1.0))
    assert max(np.hypot(*(off - place[:2]).T).min() for place in OBSTACLES.values()) > 1.0


@pytest.mark.parametrize('name', OBSTACLES)
@pytest.mark.parametrize('timing', ['instant', 'two_way'])
def test_a_scan_of_one_obstacle_says_what_pings_at_its_instants_say(name, timing):
    """They differ by the prediction, which is taken in two steps, and by the late poses."""
    obstacle = {name: OBSTACLES[name]}
    one, many = (last(kind, obstacle, ping_timing=timing) for kind in (as_scan, as_pings))
    assert one.stamp_ns > many.stamp_ns - SWEEP * SECOND
    assert_allclose(places_of(one), places_of(many), atol=0.02)
    height = [each.xyz[0, 2] for each in (one, many)]
    width = [np.ptp([each.extras[f'vertical_offset_{end}'][0] for end in ('lo', 'hi')])
             for each in (one, many)]  # fmt: skip
    assert height[0] == pytest.approx(height[1], abs=0.1)
    assert width[0] == pytest.approx(width[1], rel=0.05)


def test_rows_are_those_of_the_end_of_the_scan():
    estimate = last(as_scan, noise=1.0)
    t = estimate.stamp_ns / SECOND - 1.0
    for place, r, b in zip(
        places_of(estimate), *estimate.state[estimate.extras['track_state'] > 0, :2].T
    ):
        nearest = min(OBSTACLES.values(), key=lambda each: np.hypot(*(place - each[:2])))
        there = seen(nearest, t)
        assert (r, b) == (pytest.approx(there[0], abs=0.5), pytest.approx(there[1], abs=0.02))


def test_messages_of_scans_may_come_in_any_order():
    messages = dive(as_scan, noise=1.0)
    late = messages[:-40] + messages[-40:][::-1]
    final = [
        list(run(ObstacleTracker(ObstacleConfig(**WIDE)), items).values())[-1]
        for items in (messages, late)
    ]
    for name, column in final[0].columns().items():
        assert_allclose(column, final[1].columns()[name], err_msg=name)


def test_a_row_without_a_time_has_that_of_its_neighbours():
    whole, holed = (
        last(lambda *scan, lost=lost: spoilt(*scan, lost), noise=1.0) for lost in (False, True)
    )
    assert_allclose(places_of(whole), places_of(holed), atol=0.3)


def test_some_rows_of_a_scan_may_have_elevations():
    """Here those of one obstacle, whose height they show."""

    def with_elevation(start, times, places):
        (ping,) = as_scan(start, times, places)
        deepest = np.array(list(OBSTACLES)) == 'below'
        drop = OBSTACLES['below'][2] - np.array([vehicle(t)[0][2] for t in times])
        elevation = np.where(deepest, np.arcsin(drop / places[:, 0]), np.nan)
        yield evolve(ping, elevation=elevation)

    def height_std(estimate):
        sure = estimate.extras['track_state'] > 0
        x, y, _ = OBSTACLES['below']
        row = np.hypot(*(places_of(estimate) - [x, y]).T).argmin()
        return np.sqrt(estimate.covariance[sure][row, 2, 2])

    some, none = (last(kind, noise=1.0) for kind in (with_elevation, as_scan))
    assert len(places_of(some)) == len(places_of(none)) == len(OBSTACLES)
    assert height_std(some) < 0.8 * height_std(none)


def spoilt(start, times, places, lost):
    """A scan in which each echo comes twice, the second time without its time."""
    times = np.concatenate([times, np.where(lost, np.nan, times)])
    twice = np.concatenate([places, places + [20.0, 0.0]])
    yield Detections(
        stamp_ns=stamp(start), range=twice[:, 0], bearing=twice[:, 1], time_offset=times - start
    )


def warnings(scan_time, speed=0.6):
    def untimed(start, times, places):
        yield Detections(
            stamp_ns=stamp(start), range=places[:, 0], bearing=places[:, 1], untimed=scan_time
        )

    tracker = ObstacleTracker(ObstacleConfig(**WIDE))
    run(tracker, dive(untimed))
    return [sentence for sentence in tracker.warnings() if 'no times' in sentence]


def test_a_slow_scan_without_times_is_said():
    assert warnings(0.2) == []
    assert warnings(9.0) == [
        'a scan takes 9.0 s and its detections have no times: one instant is taken for all, '
        'wrong by up to 5.4 m'
    ]
