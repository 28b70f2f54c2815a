# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Latitude and longitude, and positions relative to a vessel, as the tracker places them."""

from attrs import evolve
from helpers.diver_runs import fix, run, SECOND
import numpy as np
import pymap3d
import pytest

from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.acoustics.geometry import rotation
from sonar_imm.measurements import (
    Fix,
    GeodeticFix,
    RelativeFix,
    VesselFix,
    VesselHeading,
    VesselPose,
)
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker

ORIGIN = Origin(59.0, 10.0)


def geodetic(second, enu, cls=GeodeticFix, origin=ORIGIN, **values):
    latitude, longitude, height = origin.geodetic(np.array(enu, float))
    return cls(
        stamp_ns=round(second * SECOND),
        latitude=latitude,
        longitude=longitude,
        **{'height': height, 'covariance': 0.04 * np.eye(3), **values},
    )


def pose(second, position, yaw, frame_id='odom', **values):
    return VesselPose(
        stamp_ns=round(second * SECOND), position=position,
        orientation=(0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)), frame_id=frame_id, **values,
    )  # fmt: skip


def relative(second, offset, **values):
    return RelativeFix(stamp_ns=round(second * SECOND), offset=offset, **values)


@pytest.mark.parametrize('away', [1e3, 1e5])
def test_positions_on_earth_give_the_track_of_the_same_positions_in_metres(away):
    """Also 100 km from the origin, where its plane is 785 m above the ellipsoid."""
    config = DiverConfig(origin=(59.0, 10.0, 0.0))
    path = [(away + 0.7 * k, 500.0 - 0.3 * k, 0.0) for k in range(30)]
    places = [ORIGIN.at_height(np.array(p[:2])) for p in path]
    ups = [ORIGIN.local(*place)[2] for place in places]
    whole = [(*p[:2], up) for p, up in zip(path, ups)]
    on_earth = run(DiverTracker(config), [geodetic(k + 1, p) for k, p in enumerate(whole)])
    flat = [fix(k + 1, *p[:2], 0.04 * np.eye(2)) for k, p in enumerate(path)]
    metres = run(DiverTracker(config), flat)
    assert on_earth[-1].frame_id == 'map'
    assert on_earth[-1].state == pytest.approx(metres[-1].state, abs=1e-6)
    assert on_earth[-1].covariance == pytest.approx(metres[-1].covariance, rel=1e-3)
    latitude, longitude = (on_earth[-1].extras[name][0] for name in ('latitude', 'longitude'))
    expected = ORIGIN.at_height(metres[-1].state[0, :2])
    assert [latitude, longitude] == pytest.approx(expected[:2], abs=1e-10)
    assert np.hypot(*Origin(*places[-1][:2]).local(latitude, longitude)[:2]) < 0.5


def test_the_first_position_is_the_origin_unless_one_is_stated_and_reset_forgets_it():
    tracker = DiverTracker(DiverConfig())
    assert tracker.origin is None
    estimates = run(tracker, [geodetic(k, (300.0, 40.0, 0.0)) for k in range(1, 5)])
    first = ORIGIN.geodetic(np.array([300.0, 40.0, 0.0])) * [1.0, 1.0, 0.0]
    assert tracker.origin.geodetic(np.zeros(3)) == pytest.approx(first, abs=1e-6)
    assert estimates[-1].state[0, :2] == pytest.approx([0.0, 0.0], abs=1e-6)
    tracker.reset()
    assert tracker.origin is None


def test_metres_without_an_origin_and_latitudes_do_not_mix():
    def metres(second):
        return Fix(stamp_ns=second * SECOND, position=(5.0, 0.0, 0.0), frame_id='map')

    first = DiverTracker(DiverConfig())
    assert run(first, [metres(1), geodetic(2, (0, 0, 0)), metres(3)])[-1].stamp_ns == 3 * SECOND
    assert first.counts['no_origin'] == 1 and first.origin is None
    assert 'latitude' not in run(first, [metres(4)])[-1].extras
    second = DiverTracker(DiverConfig())
    run(second, [geodetic(1, (0, 0, 0)), metres(2), pose(3, (0, 0, 0), 0.0)])
    assert second.counts['no_origin'] == 1
    run(second, [relative(3.5, (9.0, 0.0, 0.0)), pose(4, (0, 0, 0), 0.0)])
    assert second.counts['no_origin'] == 2
    assert 'parameter origin ' in second.warnings()[0]
    stated = DiverTracker(DiverConfig(origin=(59.0, 10.0, 0.0)))
    both = run(stated, [geodetic(1, (5.0, 0.2, 0.0)), metres(2)])
    assert not stated.counts['no_origin'] and len(both[-1]) == 1


def test_navigation_that_nothing_needs_decides_nothing():
    """A node hears nav, and the vessel's GPS, whoever they are for."""
    tracker = DiverTracker(DiverConfig())
    beside = [
        pose(1, (0, 0, 0), 0.0),
        geodetic(1, (900.0, 0, 0), VesselFix),
        Fix(stamp_ns=2 * SECOND, position=(5.0, 0.0, 0.0), frame_id='map'),
    ]
    (estimate,) = run(tracker, beside)
    assert estimate.state[0, 0] == pytest.approx(5.0) and tracker.origin is None
    tracker = DiverTracker(DiverConfig())
    (estimate,) = run(tracker, [*beside[:2], geodetic(2, (905.0, 0, 0))])
    assert estimate.state[0, 0] == pytest.approx(5.0, abs=1e-3)
    assert not tracker.counts['no_origin']
    both = DiverTracker(DiverConfig())
    poses = [pose(s, (0, 0, 0), 0.0) for s in (1, 2)]
    (estimate,) = run(both, [*beside[1:2], *poses, relative(1.5, (30.0, 0, 0))])
    assert estimate.frame_id == 'odom' and both.origin is None


def test_an_unknown_height_is_that_of_the_origin():
    config = DiverConfig(origin=(59.0, 10.0, 40.0))
    known, unknown = (
        run(DiverTracker(config), [geodetic(1, (2e4, 0.0, 0.0), **height)])[0].state
        for height in ({'height': 40.0}, {'height': np.nan})
    )
    assert known.tolist() == unknown.tolist()


FAR = Origin(10.0, 60.0)


def way(count, **values):
    return [geodetic(k + 1, (0.5 * k, 0.0, 0.0), **values) for k in range(count)]


def test_a_first_position_far_away_does_not_stay_the_origin():
    for wrong in (1, 2):
        items = [
            geodetic(k + 1, (0.0, 0.0, 0.0), origin=FAR) if k < wrong else item
            for k, item in enumerate(way(20))
        ]
        tracker = DiverTracker(DiverConfig())
        last = run(tracker, items)[-1]
        assert len(last) == 1 and last.extras['track_id'] == [2]
        assert last.extras['latitude'] == pytest.approx([items[-1].latitude], abs=1e-6)
        assert last.extras['longitude'] == pytest.approx([items[-1].longitude], abs=1e-6)
        assert np.abs(last.state[0, :2]).max() < 20.0
        assert tracker.counts['origin_moved'] == 1 and tracker.counts['far_from_origin'] == 2
        assert 'taken for wrong' in tracker.warnings()[0]


@pytest.mark.parametrize('at', [3, 10])
def test_positions_far_from_an_origin_that_is_known_are_left_out_and_said(at):
    items = way(20)
    items[at] = geodetic(at + 1, (0.0, 0.0, 0.0), origin=FAR)
    tracker = DiverTracker(DiverConfig())
    last = run(tracker, items)[-1]
    assert last.extras['track_id'] == [1] and not tracker.counts['origin_moved']
    assert 'the parameter origin' in tracker.warnings()[0]
    for place, used in ((ORIGIN, 20), (FAR, 0)):
        stated = DiverTracker(DiverConfig(origin=(place.latitude, place.longitude, 0.0)))
        assert len(run(stated, way(20))) == used
        assert stated.counts['far_from_origin'] == 20 - used


def test_a_vessel_whose_first_position_is_wrong_places_its_targets():
    items = []
    for k in range(1, 30):
        items += [
            geodetic(k, (2.0 * k, 0.0, 0.0), VesselFix, origin=FAR if k == 1 else ORIGIN),
            VesselHeading(stamp_ns=k * SECOND, orientation=(0.0, 0.0, 0.0, 1.0)),
            relative(k + 0.5, (20.0 + 0.01 * k, 5.0, 0.0)),
        ]
    tracker = DiverTracker(DiverConfig())
    last = run(tracker, items)[-1]
    there = ORIGIN.geodetic(np.array([2.0 * 28.5 + 20.28, 5.0, 0.0]))
    assert last.extras['latitude'] == pytest.approx([there[0]], abs=1e-5)
    assert last.extras['longitude'] == pytest.approx([there[1]], abs=2e-5)


def test_a_relative_fix_is_composed_with_the_pose_between_two_messages():
    config = DiverConfig(
        transceiver_lever=(2.0, 0.0, -1.0), transceiver_mount_rpy_deg=(0.0, 0.0, 90.0)
    )
    tracker = DiverTracker(config)
    assert run(tracker, [pose(1, (10.0, 0.0, 0.0), 0.0), relative(1.5, (30.0, 0.0, -5.0))]) == []
    assert tracker.health()['waiting_for_vessel'] == 1
    (estimate,) = tracker.process(pose(2, (12.0, 2.0, 0.0), 0.4))
    R = rotation(0.0, 0.0, 0.2)
    arm = R @ (np.array([2.0, 0.0, -1.0]) + rotation(0, 0, np.pi / 2) @ [30.0, 0.0, -5.0])
    assert estimate.stamp_ns == 1.5 * SECOND and estimate.frame_id == 'odom'
    # The mean is a little longer, because what errors turn is shorter on average.
    assert estimate.state[0, :2] == pytest.approx([11.0 + arm[0], 1.0 + arm[1]], abs=0.06)
    assert tracker.health()['waiting_for_vessel'] == 0


def test_what_the_vessel_states_of_itself_counts_and_else_the_parameters():
    def covariance(config=None, **values):
        tracker = DiverTracker(evolve(config or DiverConfig(), covariance_scales=(1.0,)))
        near = [pose(s, (0, 0, 0), 0.0, **values) for s in (1, 2)]
        (estimate,) = run(tracker, [*near, relative(1.5, (100.0, 0.0, 0.0))])
        return estimate.covariance[0, :2, :2]

    stated = np.diag([9.0, 16.0, 1.0, 1e-8, 1e-8, np.radians(3.0) ** 2])
    angle, bent = np.radians(2.0), 1.1
    P = covariance(pose_covariance=stated)
    assert P[0, 0] == pytest.approx(9.0 + 0.25, rel=0.05)
    across = 16.0 + 100.0**2 * (angle**2 + np.radians(3.0) ** 2)
    assert across < P[1, 1] < across * bent
    P = covariance(DiverConfig(vessel_position_std=2.0, vessel_heading_std_deg=0.0))
    assert P[1, 1] == pytest.approx(4.0 + (100.0 * angle) ** 2, rel=0.02)
    zero_attitude = np.diag([9.0, 16.0, 1.0, 0.0, 0.0, 0.0])
    P = covariance(DiverConfig(vessel_heading_std_deg=3.0), pose_covariance=zero_attitude)
    assert across < P[1, 1] < across * bent


@pytest.mark.parametrize('variance', [np.pi**2 / 3, 99.0, 1e6, 1.8e308])
def test_roll_and_pitch_that_are_not_measured_are_assumed(variance):
    def placed(whole):
        tracker = DiverTracker(DiverConfig())
        poses = [pose(k, (0, 0, 0), 0.0, pose_covariance=whole) for k in (4, 6)]
        (made,) = run(tracker, [*poses, relative(5, (100.0, 0.0, -20.0))])
        return tracker, made

    tracker, made = placed(np.diag([0.25] * 3 + [variance, variance, 1e-4]))
    std = np.radians(tracker.config.vessel_attitude_std_deg)
    _, expected = placed(np.diag([0.25] * 3 + [std**2, std**2, 1e-4]))
    assert made.state == pytest.approx(expected.state)
    assert made.covariance == pytest.approx(expected.covariance)
    assert tracker.counts['attitude_unmeasured'] == 1
    assert 'roll or pitch is not measured' in tracker.warnings()[0]


@pytest.mark.parametrize('variance', [np.pi**2 / 3, 99.0, 1e6])
def test_a_heading_that_is_not_measured_gives_no_position(variance):
    whole = np.diag([0.25] * 3 + [1e-4, 1e-4, variance])
    poses = [pose(k, (0, 0, 0), 0.0, pose_covariance=whole) for k in (4, 6)]
    tracker = DiverTracker(DiverConfig())
    assert not run(tracker, [*poses, relative(5, (100.0, 0.0, 0.0))])
    assert tracker.counts['heading_unmeasured'] == 1
    assert 'its heading is not measured' in tracker.warnings()[0]
    # A transceiver with a compass of its own needs no heading of the vessel.
    tracker = DiverTracker(DiverConfig())
    assert run(tracker, [*poses, relative(5, (100.0, 0.0, 0.0), levelled=True)])
    assert not tracker.counts['heading_unmeasured']


def test_a_gap_in_the_poses_and_a_stamp_before_them_are_counted():
    tracker = DiverTracker(DiverConfig())
    between = [relative(4, (10.0, 0.0, 0.0)), relative(7, (10.0, 0.0, 0.0))]
    made = run(tracker, [pose(5, (0, 0, 0), 0.0), *between, pose(9, (0, 0, 0), 0.0)])
    assert not made and tracker.counts['vessel_pose_gap'] == 2


def test_poses_that_leap_cost_the_fixes_between_and_nothing_later():
    tracker = DiverTracker(DiverConfig(vessel_max_extrapolation=0.6))
    leap = [pose(5.0, (0, 0, 0), 0.0), pose(5.00000001, (1e7, 0, 0), 0.0)]
    assert not run(tracker, [*leap, relative(5.05, (10.0, 0.0, 0.0))])
    assert tracker.counts['vessel_pose_gap'] == 1
    after = [pose(6, (0, 0, 0), 0.0), pose(7, (0, 0, 0), 0.0), relative(6.5, (10.0, 0.0, 0.0))]
    assert run(tracker, after)


def test_waiting_is_bounded_and_said():
    tracker = DiverTracker(DiverConfig())
    for k in range(1, 251):
        assert tracker.process(relative(k, (10.0, 0.0, 0.0))) == []
    assert tracker.health()['waiting_for_vessel'] == 200
    assert tracker.counts['vessel_pose_missing'] == 50
    assert 'wait for the pose of the vessel' in tracker.warnings()[0]


def test_extrapolation_is_as_far_as_allowed():
    tracker = DiverTracker(DiverConfig(vessel_max_extrapolation=0.6))
    poses = [pose(1, (0, 0, 0), 0.0), pose(2, (2.0, 0, 0), 0.0)]
    (estimate,) = run(tracker, [*poses, relative(2.5, (10.0, 0.0, 0.0))])
    assert estimate.state[0, 0] == pytest.approx(13.0, abs=0.05)
    assert run(tracker, [relative(2.7, (10.0, 0.0, 0.0))]) == []


def test_a_clock_that_was_set_back_forgets_the_vessel():
    tracker = DiverTracker(DiverConfig())
    run(tracker, [pose(k, (0, 0, 0), 0.0) for k in range(10_000, 10_010)])
    run(tracker, [relative(10_020, (10.0, 0.0, 0.0))])
    run(tracker, [pose(k, (50.0, 0, 0), 0.0) for k in range(1, 12)])
    assert tracker.health()['waiting_for_vessel'] == 0
    made = run(tracker, [relative(10.5, (10.0, 0.0, 0.0))])
    assert made and made[-1].state[0, 0] == pytest.approx(60.0, abs=0.1)


def test_a_position_and_a_heading_make_a_pose():
    config = DiverConfig(origin=(59.0, 10.0, 0.0))
    tracker = DiverTracker(config)
    made = run(
        tracker,
        [
            geodetic(1.0, (100.0, 0.0, 0.0), VesselFix),
            VesselHeading(stamp_ns=1 * SECOND, orientation=(0, 0, 0, 1.0)),
            relative(1.5, (0.0, 20.0, 0.0)),
            geodetic(2.0, (102.0, 0.0, 0.0), VesselFix),
            VesselHeading(
                stamp_ns=2 * SECOND, orientation=(0, 0, np.sin(np.pi / 4), np.cos(np.pi / 4))
            ),
        ],
    )
    half = np.pi / 4
    expected = [101.0 - 20.0 * np.sin(half), 20.0 * np.cos(half)]
    assert made[-1].state[0, :2] == pytest.approx(expected, abs=0.05)
    assert made[-1].frame_id == 'map' and 'latitude' in made[-1].extras


EXACT = {
    'relative_range_std': 0.01, 'relative_angle_std_deg': 0.001,
    'vessel_heading_std_deg': 0.0, 'vessel_attitude_std_deg': 0.0,
}  # fmt: skip
"""Instruments without errors: what errors turn is shorter on average, which is undone."""


def towards_north(yaw):
    return (0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2))


def placed(config, vessel, offset, yaw=0.0, **values):
    """Where (2,) a vessel at latitude, longitude and height places a target."""
    tracker = DiverTracker(config)
    latitude, longitude, height = vessel
    for second in (1, 2):
        heading = VesselHeading(stamp_ns=second * SECOND, orientation=towards_north(yaw))
        where = VesselFix(
            stamp_ns=second * SECOND, latitude=latitude, longitude=longitude, height=height
        )
        run(tracker, [where, heading])
    (estimate,) = run(tracker, [relative(1.5, offset, **values)])
    return estimate.state[0, :2]


def on_earth_and_back(origin, vessel, east_north_up):
    """The same (2,) by latitude and longitude of the target."""
    there = pymap3d.enu2geodetic(*east_north_up, *vessel)
    return np.array(pymap3d.geodetic2enu(*there, *origin))[:2]


@pytest.mark.parametrize(
    'latitude, levelled',
    [(0.0, False), (60.0, True), (-60.0, False), (80.0, False), (88.0, True), (-88.0, False)],
)
def test_relative_positions_far_from_the_origin_are_exact_up_to_88_degrees(latitude, levelled):
    """A vessel 10 km from the origin, a diver 1 km from the vessel."""
    origin = (latitude, 170.0, 12.0)
    config = DiverConfig(origin=origin, **EXACT)
    for east, north, yaw in ((1e4, 0.0, 0.3), (-7e3, 7e3, 2.0), (0.0, -1e4, -1.0)):
        vessel = tuple(float(part) for part in pymap3d.enu2geodetic(east, north, 0.0, *origin))
        offset = np.array([800.0, -600.0, -40.0])
        seen = offset if levelled else rotation(0.0, 0.0, yaw) @ offset
        expected = on_earth_and_back(origin, vessel, seen)
        found = placed(config, vessel, offset, yaw, levelled=levelled)
        assert found == pytest.approx(expected, abs=0.01)
        if abs(latitude) > 50.0 and abs(east) > 1.0:  # it matters there
            flat = np.array(pymap3d.geodetic2enu(*vessel, *origin))[:2] + seen[:2]
            assert np.hypot(*(flat - expected)) > 1.8


@pytest.mark.parametrize('levelled', [False, True])
def test_magnetic_north_is_turned_to_true_north(levelled):
    """20 degrees east of it: what a compass shows as due north is at 20 degrees clockwise."""
    stated = {'origin': (70.0, 10.0, 0.0), **EXACT}
    config = DiverConfig(magnetic_declination_deg=20.0, **stated)
    ahead = (0.0, 500.0, 0.0) if levelled else (500.0, 0.0, 0.0)
    found = placed(config, (70.0, 10.0, 0.0), ahead, np.pi / 2, levelled=levelled)
    east, north = 500.0 * np.sin(np.radians(20.0)), 500.0 * np.cos(np.radians(20.0))
    assert found == pytest.approx([east, north], abs=0.01)


def test_covariances_turn_with_the_axes():
    """At 88 degrees of latitude, 90 degrees of longitude from the origin, north is west."""
    place = {'origin': (88.0, 1.0, 0.0)}
    config = DiverConfig(model_set='heading_speed', **place, **EXACT)
    tracker = DiverTracker(config)
    for second in (1, 2):
        where = VesselFix(
            stamp_ns=second * SECOND, latitude=88.0, longitude=91.0, height=0.0,
            covariance=np.diag([1e-4, 1e-4, 1e-4]),
        )  # fmt: skip
        heading = VesselHeading(stamp_ns=second * SECOND, orientation=towards_north(0.0))
        run(tracker, [where, heading])
    spread = np.diag([25.0, 1.0, 1.0])
    (estimate,) = run(tracker, [relative(1.5, (10.0, 0.0, 0.0), covariance=spread, levelled=True)])
    P = estimate.covariance[0, :2, :2]
    assert np.diag(P) == pytest.approx([1.0, 25.0], rel=0.05)


PIER = {'vessel': 'fixed', 'transceiver_lever': (5.0, 0.0, 0.0)}
PIER |= {'transceiver_mount_rpy_deg': (0.0, 0.0, 90.0)}


@pytest.mark.parametrize(
    'config, yaw, levelled, place',
    [
        ({}, 1.0, True, [30.0, 0.0]),
        ({'magnetic_declination_deg': 20.0}, 0.0, False, [30.0, 0.0]),
        (PIER, None, False, [5.0, 30.0]),
    ],
    ids=['levelled', 'declination turns no pose of nav', 'a pier needs no pose'],
)
def test_what_does_not_turn_with_the_vessel(config, yaw, levelled, place):
    poses = [] if yaw is None else [pose(s, (0, 0, 0), yaw) for s in (1, 2)]
    seen = relative(1.5, (30.0, 0.0, 0.0), levelled=levelled)
    (estimate,) = run(DiverTracker(DiverConfig(**config)), [*poses, seen])
    assert estimate.state[0, :2] == pytest.approx(place, abs=0.05)


@pytest.mark.statistics
def test_the_tracker_is_consistent_with_all_errors_drawn():
    """A diver that rests is seen by a transceiver on a vessel that circles it: NEES."""
    rng = np.random.default_rng(5)
    config = DiverConfig(
        relative_range_std=0.5, vessel_position_std=0.5, vessel_heading_std_deg=1.0
    )
    nees = []
    for _ in range(12):
        tracker = DiverTracker(config)
        last = None
        for k in range(1, 41):
            angle = 0.05 * k
            where = np.array([60.0 * np.cos(angle), 60.0 * np.sin(angle), 0.0])
            yaw = angle + np.pi / 2
            seen = rotation(0, 0, yaw).T @ (-where)
            distance = np.linalg.norm(seen)
            turn = rotation(0.0, *np.radians(2.0) * rng.normal(size=2))
            offset = turn @ seen * (1.0 + 0.5 * rng.normal() / distance)
            at = where + 0.5 * rng.normal(size=3) * [1, 1, 0]
            noisy = pose(k, at, yaw + np.radians(rng.normal()), frame_id='map')
            made = run(tracker, [noisy, relative(k, offset, frame_id='usbl')])
            last = made[-1] if made else last
        error, P = last.state[0, :2], last.covariance[0, :2, :2]
        nees.append(error @ np.linalg.solve(P, error))
    assert 0.5 < np.mean(nees) < 4.0  # 2 is due, for 24 numbers
