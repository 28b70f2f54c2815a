# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Latitude and longitude, and positions relative to a vessel, as the tracker places them; where a
sensor sees, and who leaves it."""

from attrs import evolve
from helpers.diver_runs import arrivals, fix, followed, miss, run, scan, SECOND
import numpy as np
import pymap3d
import pytest
from scipy.stats import norm

from sonar_imm import measurements
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.acoustics.geometry import rotation
from sonar_imm.estimation.bank import Gaussians
from sonar_imm.measurements import GeodeticFix, RelativeFix, VesselFix, VesselHeading, VesselPose
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.diver import coverage
from sonar_imm.trackers.diver.coverage_map import configured_coverage
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm.trackers.state_file import json_parameters
from sonar_imm_tools.simulation.diver.simulator import RECEIVERS

ORIGIN = Origin(59.0, 10.0)
FAR = Origin(10.0, 60.0)
LEVER = {'transceiver_lever': (2.0, 0.0, -1.0), 'transceiver_mount_rpy_deg': (0.0, 0.0, 90.0)}
EXACT = {
    'relative_range_std': 0.01, 'relative_angle_std_deg': 0.001,
    'vessel_heading_std_deg': 0.0, 'vessel_attitude_std_deg': 0.0,
}  # fmt: skip
"""Instruments without errors: what errors turn is shorter on average, which is undone."""
PIER = {**LEVER, 'vessel': 'fixed', 'transceiver_lever': (5.0, 0.0, 0.0)}
TURNS = {
    'levelled': ({}, 1.0, True, [30.0, 0.0]),
    'declination of nav': ({'magnetic_declination_deg': 20.0}, 0.0, False, [30.0, 0.0]),
    'a pier needs no pose': (PIER, None, False, [5.0, 30.0]),
}
AHEAD = (0.0, 0.0, 0.0, 90.0, 0.0, 50.0)
"""A sonar at the origin that looks along x, 45 degrees to either side, 50 m far."""


def geodetic(second, enu, cls=GeodeticFix, origin=ORIGIN, **values):
    latitude, longitude, height = origin.geodetic(np.array(enu, float))
    known = {'latitude': latitude, 'longitude': longitude, 'height': height}
    known['covariance'] = 0.04 * np.eye(3)
    return cls(stamp_ns=round(second * SECOND), **{**known, **values})


def quaternion(yaw):
    return 0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2)


def heading(second, yaw=0.0):
    return VesselHeading(stamp_ns=round(second * SECOND), orientation=quaternion(yaw))


def poses(*seconds, **values):
    return [pose(second, **values) for second in seconds]


def pose(second, x=0.0, y=0.0, yaw=0.0, frame_id='odom', **values):
    known = {'position': (x, y, 0.0), 'orientation': quaternion(yaw), 'frame_id': frame_id}
    return VesselPose(stamp_ns=round(second * SECOND), **known, **values)


def relative(second, offset=(10.0, 0.0, 0.0), **values):
    return RelativeFix(stamp_ns=round(second * SECOND), offset=offset, **values)


def metres(second):
    return measurements.Fix(stamp_ns=second * SECOND, position=(5.0, 0.0, 0.0), frame_id='map')


@pytest.mark.parametrize('away', [1e3, 1e5])
def test_positions_on_earth_give_the_track_of_the_same_positions_in_metres(away):
    """Also 100 km from the origin, where its plane is 785 m above the ellipsoid."""
    config = DiverConfig(origin=(59.0, 10.0, 0.0))
    path = np.array([(away + 0.7 * k, 500.0 - 0.3 * k) for k in range(30)])
    places = [ORIGIN.at_height(place) for place in path]
    whole = [(*xy, ORIGIN.local(*place)[2]) for xy, place in zip(path, places)]
    on_earth = run(DiverTracker(config), [geodetic(k, p) for k, p in enumerate(whole, 1)])[-1]
    flat = [fix(k, *xy, 0.04 * np.eye(2)) for k, xy in enumerate(path, 1)]
    metres = run(DiverTracker(config), flat)[-1]
    assert on_earth.frame_id == 'map'
    assert on_earth.state == pytest.approx(metres.state, abs=1e-6)
    assert on_earth.covariance == pytest.approx(metres.covariance, rel=1e-3)
    found = [on_earth.extras[name][0] for name in ('latitude', 'longitude')]
    assert found == pytest.approx(ORIGIN.at_height(metres.state[0, :2])[:2], abs=1e-10)
    assert np.hypot(*Origin(*places[-1][:2]).local(*found)[:2]) < 0.5


def test_the_first_position_is_the_origin_unless_one_is_stated_and_reset_forgets_it():
    tracker = DiverTracker(DiverConfig())
    assert tracker.origin is None
    *_, last = run(tracker, [geodetic(k, (300.0, 40.0, 0.0)) for k in range(1, 5)])
    first = ORIGIN.geodetic(np.array([300.0, 40.0, 0.0])) * [1.0, 1.0, 0.0]
    assert tracker.origin.geodetic(np.zeros(3)) == pytest.approx(first, abs=1e-6)
    assert last.state[0, :2] == pytest.approx([0.0, 0.0], abs=1e-6)
    tracker.reset()
    assert tracker.origin is None


def test_metres_without_an_origin_and_latitudes_do_not_mix():
    first = DiverTracker(DiverConfig())
    assert run(first, [metres(1), geodetic(2, (0, 0, 0)), metres(3)])[-1].stamp_ns == 3 * SECOND
    assert first.counts['no_origin'] == 1 and first.origin is None
    assert 'latitude' not in run(first, [metres(4)])[-1].extras
    second = DiverTracker(DiverConfig())
    run(second, [geodetic(1, (0, 0, 0)), metres(2), pose(3)])
    assert second.counts['no_origin'] == 1
    run(second, [relative(3.5), pose(4)])
    assert second.counts['no_origin'] == 2
    assert 'parameter origin ' in second.warnings()[0]
    stated = DiverTracker(DiverConfig(origin=(59.0, 10.0, 0.0)))
    both = run(stated, [geodetic(1, (5.0, 0.2, 0.0)), metres(2)])
    assert not stated.counts['no_origin'] and len(both[-1]) == 1


def test_navigation_that_nothing_needs_decides_nothing():
    """A node hears nav, and the vessel's GPS, whoever they are for."""
    beside = [pose(1), geodetic(1, (900.0, 0, 0), VesselFix)]
    for last, origin in ((metres(2), False), (geodetic(2, (905.0, 0, 0)), True)):
        tracker = DiverTracker(DiverConfig())
        (estimate,) = run(tracker, [*beside, last])
        assert estimate.state[0, 0] == pytest.approx(5.0, abs=1e-3)
        assert (tracker.origin is not None) == origin and not tracker.counts['no_origin']
    both = DiverTracker(DiverConfig())
    (estimate,) = run(both, [beside[1], *poses(1, 2), relative(1.5)])
    assert estimate.frame_id == 'odom' and both.origin is None


def test_an_unknown_height_is_that_of_the_origin():
    config = DiverConfig(origin=(59.0, 10.0, 40.0))
    fixes = [geodetic(1, (2e4, 0.0, 0.0), height=height) for height in (40.0, np.nan)]
    known, unknown = (run(DiverTracker(config), [each])[0].state.tolist() for each in fixes)
    assert known == unknown


def way(count):
    return [geodetic(k + 1, (0.5 * k, 0.0, 0.0)) for k in range(count)]


def test_a_first_position_far_away_does_not_stay_the_origin():
    for wrong in (1, 2):
        far = [geodetic(k + 1, (0.0, 0.0, 0.0), origin=FAR) for k in range(wrong)]
        items = [*far, *way(20)[wrong:]]
        tracker = DiverTracker(DiverConfig())
        last = run(tracker, items)[-1]
        assert len(last) == 1 and last.extras['track_id'] == [2]
        assert last.extras['latitude'] == pytest.approx([items[-1].latitude], abs=1e-6)
        assert last.extras['longitude'] == pytest.approx([items[-1].longitude], abs=1e-6)
        assert np.abs(last.state[0, :2]).max() < 20.0
        assert tracker.counts['origin_moved'] == 1 and tracker.counts['far_from_origin'] == 2
        assert 'taken for wrong' in tracker.warnings()[0]


def test_positions_far_from_an_origin_that_is_known_are_left_out_and_said():
    for at in (3, 10):
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
        where = geodetic(k, (2.0 * k, 0.0, 0.0), VesselFix, origin=FAR if k == 1 else ORIGIN)
        items += [where, heading(k), relative(k + 0.5, (20.0 + 0.01 * k, 5.0, 0.0))]
    last = run(DiverTracker(DiverConfig()), items)[-1]
    there = ORIGIN.geodetic(np.array([2.0 * 28.5 + 20.28, 5.0, 0.0]))
    assert last.extras['latitude'] == pytest.approx([there[0]], abs=1e-5)
    assert last.extras['longitude'] == pytest.approx([there[1]], abs=2e-5)


def test_a_relative_fix_is_composed_with_the_pose_between_two_messages():
    tracker = DiverTracker(DiverConfig(**LEVER))
    assert run(tracker, [pose(1, 10.0), relative(1.5, (30.0, 0.0, -5.0))]) == []
    assert tracker.health()['waiting_for_vessel'] == 1
    (estimate,) = tracker.process(pose(2, 12.0, 2.0, yaw=0.4))
    R = rotation(0.0, 0.0, 0.2)
    arm = R @ (np.array([2.0, 0.0, -1.0]) + rotation(0, 0, np.pi / 2) @ [30.0, 0.0, -5.0])
    assert estimate.stamp_ns == 1.5 * SECOND and estimate.frame_id == 'odom'
    # The mean is a little longer, because what errors turn is shorter on average.
    assert estimate.state[0, :2] == pytest.approx([11.0 + arm[0], 1.0 + arm[1]], abs=0.06)
    assert tracker.health()['waiting_for_vessel'] == 0


def test_what_the_vessel_states_of_itself_counts_and_else_the_parameters():
    def covariance(pose_covariance=None, **config):
        tracker = DiverTracker(DiverConfig(covariance_scales=(1.0,), **config))
        near = poses(1, 2, pose_covariance=pose_covariance)
        (estimate,) = run(tracker, [*near, relative(1.5, (100.0, 0.0, 0.0))])
        return estimate.covariance[0, :2, :2]

    angle, bent = np.radians(2.0), 1.1
    P = covariance(np.diag([9.0, 16.0, 1.0, 1e-8, 1e-8, np.radians(3.0) ** 2]))
    assert P[0, 0] == pytest.approx(9.0 + 0.25, rel=0.05)
    across = 16.0 + 100.0**2 * (angle**2 + np.radians(3.0) ** 2)
    assert across < P[1, 1] < across * bent
    P = covariance(vessel_position_std=2.0, vessel_heading_std_deg=0.0)
    assert P[1, 1] == pytest.approx(4.0 + (100.0 * angle) ** 2, rel=0.02)
    P = covariance(np.diag([9.0, 16.0, 1.0, 0.0, 0.0, 0.0]), vessel_heading_std_deg=3.0)
    assert across < P[1, 1] < across * bent


@pytest.mark.parametrize('variance', [np.pi**2 / 3, 1.8e308])
def test_roll_and_pitch_that_are_not_measured_are_assumed(variance):
    def placed(variance):
        tracker = DiverTracker(DiverConfig())
        stated = np.diag([0.25] * 3 + [variance, variance, 1e-4])
        near = poses(4, 6, pose_covariance=stated)
        return tracker, *run(tracker, [*near, relative(5, (100.0, 0.0, -20.0))])

    tracker, made = placed(variance)
    _, expected = placed(np.radians(tracker.config.vessel_attitude_std_deg) ** 2)
    assert made.state == pytest.approx(expected.state)
    assert made.covariance == pytest.approx(expected.covariance)
    assert tracker.counts['attitude_unmeasured'] == 1
    assert 'roll or pitch is not measured' in tracker.warnings()[0]


@pytest.mark.parametrize('variance', [np.pi**2 / 3, 1e6])
def test_a_heading_that_is_not_measured_gives_no_position(variance):
    near = poses(4, 6, pose_covariance=np.diag([0.25] * 3 + [1e-4, 1e-4, variance]))
    tracker = DiverTracker(DiverConfig())
    assert not run(tracker, [*near, relative(5)])
    assert tracker.counts['heading_unmeasured'] == 1
    assert 'its heading is not measured' in tracker.warnings()[0]
    # A transceiver with a compass of its own needs no heading of the vessel.
    tracker = DiverTracker(DiverConfig())
    assert run(tracker, [*near, relative(5, levelled=True)])
    assert not tracker.counts['heading_unmeasured']


def test_gaps_and_leaps_of_poses_and_stamps_before_them_are_counted():
    tracker = DiverTracker(DiverConfig())
    assert not run(tracker, [pose(5), relative(4), relative(7), pose(9)])
    assert tracker.counts['vessel_pose_gap'] == 2
    leaping = DiverTracker(DiverConfig(vessel_max_extrapolation=0.6))
    assert not run(leaping, [pose(5.0), pose(5.00000001, 1e7), relative(5.05)])
    assert leaping.counts['vessel_pose_gap'] == 1
    assert run(leaping, [*poses(6, 7), relative(6.5)])


def test_waiting_is_bounded_and_said():
    tracker = DiverTracker(DiverConfig())
    assert not run(tracker, [relative(k) for k in range(1, 251)])
    assert tracker.health()['waiting_for_vessel'] == 200
    assert tracker.counts['vessel_pose_missing'] == 50
    assert 'wait for the pose of the vessel' in tracker.warnings()[0]


def test_extrapolation_is_as_far_as_allowed():
    tracker = DiverTracker(DiverConfig(vessel_max_extrapolation=0.6))
    (estimate,) = run(tracker, [pose(1), pose(2, 2.0), relative(2.5)])
    assert estimate.state[0, 0] == pytest.approx(13.0, abs=0.05)
    assert run(tracker, [relative(2.7)]) == []


def test_a_clock_that_was_set_back_forgets_the_vessel():
    tracker = DiverTracker(DiverConfig())
    run(tracker, [*poses(*range(10_000, 10_010)), relative(10_020), *poses(*range(1, 12), x=50.0)])
    assert tracker.health()['waiting_for_vessel'] == 0
    made = run(tracker, [relative(10.5)])
    assert made and made[-1].state[0, 0] == pytest.approx(60.0, abs=0.1)


def test_a_position_and_a_heading_make_a_pose():
    where = [geodetic(k, (98.0 + 2.0 * k, 0.0, 0.0), VesselFix) for k in (1, 2)]
    seen = relative(1.5, (0.0, 20.0, 0.0))
    items = [where[0], heading(1), seen, where[1], heading(2, np.pi / 2)]
    made = run(DiverTracker(DiverConfig(origin=(59.0, 10.0, 0.0))), items)
    half = np.pi / 4
    expected = [101.0 - 20.0 * np.sin(half), 20.0 * np.cos(half)]
    assert made[-1].state[0, :2] == pytest.approx(expected, abs=0.05)
    assert made[-1].frame_id == 'map' and 'latitude' in made[-1].extras


def placed(config, vessel, offset, yaw=0.0, **values):
    place = dict(zip(('latitude', 'longitude', 'height'), vessel), covariance=1e-4 * np.eye(3))
    items = [relative(1.5, offset, **values)]
    for second in (1, 2):
        items += [VesselFix(stamp_ns=second * SECOND, **place), heading(second, yaw)]
    (estimate,) = run(DiverTracker(config), items)
    return estimate


@pytest.mark.parametrize('latitude, levelled', [
    (0.0, False), (60.0, True), (-60.0, False), (88.0, True), (-88.0, False),
])  # fmt: skip
def test_relative_positions_far_from_the_origin_are_exact_up_to_88_degrees(latitude, levelled):
    """A vessel 10 km from the origin, a diver 1 km from the vessel; against pymap3d."""
    origin = (latitude, 170.0, 12.0)
    config = DiverConfig(origin=origin, **EXACT)
    for east, north, yaw in ((1e4, 0.0, 0.3), (-7e3, 7e3, 2.0), (0.0, -1e4, -1.0)):
        vessel = tuple(float(part) for part in pymap3d.enu2geodetic(east, north, 0.0, *origin))
        offset = np.array([800.0, -600.0, -40.0])
        seen = offset if levelled else rotation(0.0, 0.0, yaw) @ offset
        there = pymap3d.enu2geodetic(*seen, *vessel)
        expected = np.array(pymap3d.geodetic2enu(*there, *origin))[:2]
        found = placed(config, vessel, offset, yaw, levelled=levelled)
        assert found.state[0, :2] == pytest.approx(expected, abs=0.01)
        if abs(latitude) > 50.0 and abs(east) > 1.0:  # it matters there
            flat = np.array(pymap3d.geodetic2enu(*vessel, *origin))[:2] + seen[:2]
            assert np.hypot(*(flat - expected)) > 1.8


@pytest.mark.parametrize('levelled', [False, True])
def test_magnetic_north_is_turned_to_true_north(levelled):
    """20 degrees east of it: what a compass shows as due north is at 20 degrees clockwise."""
    config = DiverConfig(magnetic_declination_deg=20.0, origin=(70.0, 10.0, 0.0), **EXACT)
    ahead = (0.0, 500.0, 0.0) if levelled else (500.0, 0.0, 0.0)
    found = placed(config, (70.0, 10.0, 0.0), ahead, np.pi / 2, levelled=levelled)
    east, north = 500.0 * np.sin(np.radians(20.0)), 500.0 * np.cos(np.radians(20.0))
    assert found.state[0, :2] == pytest.approx([east, north], abs=0.01)


def test_covariances_turn_with_the_axes():
    """At 88 degrees of latitude, 90 degrees of longitude from the origin, north is west."""
    config = DiverConfig(model_set='heading_speed', origin=(88.0, 1.0, 0.0), **EXACT)
    seen = {'covariance': np.diag([25.0, 1.0, 1.0]), 'levelled': True}
    found = placed(config, (88.0, 91.0, 0.0), (10.0, 0.0, 0.0), **seen)
    assert np.diag(found.covariance[0, :2, :2]) == pytest.approx([1.0, 25.0], rel=0.05)


@pytest.mark.parametrize('what', TURNS)
def test_what_does_not_turn_with_the_vessel(what):
    config, yaw, levelled, place = TURNS[what]
    near = [] if yaw is None else poses(1, 2, yaw=yaw)
    seen = relative(1.5, (30.0, 0.0, 0.0), levelled=levelled)
    (estimate,) = run(DiverTracker(DiverConfig(**config)), [*near, seen])
    assert estimate.state[0, :2] == pytest.approx(place, abs=0.05)


@pytest.mark.statistics
def test_the_tracker_is_consistent_with_all_errors_drawn():
    """A diver that rests is seen by a transceiver on a vessel that circles it: NEES."""
    rng, nees = np.random.default_rng(5), []
    stds = {'vessel_position_std': 0.5, 'vessel_heading_std_deg': 1.0, 'relative_range_std': 0.5}
    for _ in range(12):
        tracker, made = DiverTracker(DiverConfig(**stds)), []
        for k in range(1, 41):
            angle = 0.05 * k
            where = np.array([60.0 * np.cos(angle), 60.0 * np.sin(angle), 0.0])
            yaw = angle + np.pi / 2
            seen = rotation(0, 0, yaw).T @ (-where)
            turn = rotation(0.0, *np.radians(2.0) * rng.normal(size=2))
            offset = turn @ seen * (1.0 + 0.5 * rng.normal() / np.linalg.norm(seen))
            at = where + 0.5 * rng.normal(size=3) * [1, 1, 0]
            noisy = pose(k, *at[:2], yaw + np.radians(rng.normal()), frame_id='map')
            made += run(tracker, [noisy, relative(k, offset, frame_id='usbl')])
        nees.append(miss(made[-1], np.zeros(2))[1])
    assert 0.5 < np.mean(nees) < 4.0  # 2 is due, for 24 numbers


def written(tmp_path, name, header, rows):
    file = tmp_path / name
    file.write_text('\n'.join([header, *(','.join(map(str, row)) for row in rows)]) + '\n')
    return str(file)


def ids_by_scan(config, scans):
    made = followed(DiverTracker(config), scans)
    return [each.extras['track_id'][each.extras['track_state'] > 0].tolist() for each in made]


@pytest.mark.parametrize('association, model_set', [
    ('gnn', 'families'), ('jipda', 'heading_speed'), ('gnn', 'linear'),
])  # fmt: skip
def test_who_leaves_the_sector_keeps_his_track(association, model_set):
    there = np.concatenate([np.arange(35.0, 50.0, 0.75), 49.8 - np.arange(0.0, 15.0, 0.75)])
    seen = {second: (x, 0.3) for second, x in zip([*range(1, 21), *range(36, 56)], there)}
    scans = [scan(k, seen[k]) if k in seen else scan(k) for k in range(1, 56)]
    plain = DiverConfig(association=association, model_set=model_set)
    for config, tracks in ((plain, 2), (evolve(plain, coverage_sector=AHEAD), 1)):
        found = ids_by_scan(config, scans)
        assert len({number for ids in found for number in ids}) == tracks
    assert found[-1] and found[30] == found[15]


@pytest.mark.parametrize('association', ['gnn', 'jipda'])
def test_who_is_inside_and_not_seen_ends_as_soon_as_without_a_sector(association):
    scans = [scan(k, (20.0, 0.2 * k)) if k < 12 else scan(k) for k in range(1, 40)]
    plain = DiverConfig(association=association)
    configs = plain, evolve(plain, coverage_sector=AHEAD)
    without, stated = (sum(map(bool, ids_by_scan(config, scans))) for config in configs)
    assert without == stated < 20


def test_an_echo_sounder_that_covers_a_sector_misses_nobody_outside():
    def ping(second):
        rows = slice(0, 4 if second <= 20 else 0)
        leg = np.linalg.norm(RECEIVERS - [35.0 + 0.75 * second, 5.0, 0.0], axis=1)
        toa = ((leg + leg[0]) / 1500.0)[rows]
        return arrivals(second * SECOND, RECEIVERS[rows], toa, tx=np.zeros(3), frame_id='')

    pings = list(map(ping, range(1, 60)))
    for config, count in ((DiverConfig(), 0), (DiverConfig(coverage_sector=AHEAD), 1)):
        assert len(ids_by_scan(config, pings)[-1]) == count


def test_existence_of_a_diver_who_is_not_seen_is_the_closed_recursion(tmp_path):
    """Where the probability is the same all over the track, r' = r (1 - p) / (1 - r p)."""
    corners = [(x, y, 0.4) for x in (-500.0, 500.0) for y in (-500.0, 500.0)]
    file = written(tmp_path, 'grid.csv', 'x,y,probability', corners)
    config = DiverConfig(association='jipda', coverage_file=file, survival_time=300.0)
    tracker = DiverTracker(config)
    *_, estimate = run(tracker, [scan(k, (5.0, 0.1 * k)) for k in range(1, 15)])
    r = float(estimate.extras['existence'][0])
    assert r > 0.99
    for estimate in run(tracker, [scan(second) for second in range(15, 24)]):
        r *= np.exp(-1.0 / 300.0)
        r *= (1.0 - 0.4) / (1.0 - r * 0.4)
        assert estimate.extras['existence'][0] == pytest.approx(r, abs=1e-12)


def test_existence_at_the_edge_is_that_of_particles_told_the_true_probability():
    """40,000 particles with the motion of the tracker, weighed by 1 - p(x) with each scan."""
    linear = {'model_set': 'linear', 'acceleration_noise': (0.1,), 'association': 'jipda'}
    config = DiverConfig(coverage_sector=AHEAD, **linear)
    tracker, rng, p = DiverTracker(config), np.random.default_rng(3), 0.9
    *_, estimate = run(tracker, [scan(k, (36.0 + 0.75 * k, 0.4)) for k in range(1, 16)])
    r = float(estimate.extras['existence'][0])
    x = rng.multivariate_normal(estimate.state[0], estimate.covariance[0], 40_000)
    motion = tracker.models.motion(1.0)
    noise, differences, reference = np.linalg.cholesky(motion.Q[0] + 1e-12 * np.eye(4)), [], []
    for estimate in run(tracker, [scan(second) for second in range(16, 46)]):
        x = x @ motion.F[0].T + rng.normal(size=x.shape) @ noise.T
        here = np.hypot(x[:, 0], x[:, 1]) <= 50.0
        here &= np.abs(np.arctan2(x[:, 1], x[:, 0])) <= np.pi / 4.0
        r *= np.exp(-1.0 / config.survival_time)
        r *= (1.0 - p * here.mean()) / (1.0 - r * p * here.mean())
        weight = 1.0 - p * here
        x = x[rng.choice(len(x), len(x), p=weight / weight.sum())]
        reference.append(r)
        differences.append(float(estimate.extras['existence'][0]) - r)
    assert 0.2 < min(reference) < 0.9  # doubtful at the edge, and then no longer asked
    assert np.abs(differences).max() < 0.05


@pytest.mark.parametrize('edge', [-1.5, 0.3])
def test_what_is_left_of_a_track_by_a_half_plane_is_the_truncated_normal(edge):
    sector = (-1e6, 0.0, 0.0, 360.0, 0.0, 1e6 + edge)
    config = DiverConfig(model_set='linear', coverage_sector=sector, max_tracks=1)
    tracker = DiverTracker(config)
    tracker.process(scan(1, (0.0, 0.0)))
    known = tracker._stream.state
    P = np.diag([4.0, 1.0, 1.0, 1.0])
    P[0, 2] = P[2, 0] = 1.2
    block = Gaussians(np.zeros((1, 4, 1)), P[None, ..., None])
    life = evolve(known.life, status=np.ones(1, np.uint8))
    known = known.replace(rows=known.rows.replace(blocks=(block,)), life=life)
    area = configured_coverage(config)['']
    seen = coverage.detection_probability(known, tracker.models, area, 0.9)
    after = coverage.apply_misses(known, tracker.models, seen, np.ones(1), True)
    x, P = (part[0, ..., 0] for part in after.rows.blocks[0])
    a = edge / 2.0
    inside = norm.cdf(a)
    assert seen.tracks[0] == pytest.approx(0.9 * inside, abs=0.07)
    left = 1.0 - 0.9 * inside
    mean = 2.0 * 0.9 * norm.pdf(a) / left
    square = 4.0 * (1.0 - 0.9 * (inside - a * norm.pdf(a))) / left
    assert x[0] == pytest.approx(mean, abs=0.25)
    assert P[0, 0] == pytest.approx(square - mean**2, abs=0.7)
    assert x[2] == pytest.approx(1.2 / 4.0 * x[0], abs=1e-9)
    assert np.linalg.eigvalsh(P).min() > 0.0


def test_tables_are_read_between_their_points(tmp_path):
    grid = [(x, y, 0.1 * x + 0.01 * y) for y in (0.0, 10.0, 30.0) for x in (0.0, 2.0, 5.0)]
    by_place = DiverConfig(coverage_file=written(tmp_path, 'a.csv', 'x,y,probability', grid))
    at = configured_coverage(by_place)[''].probability
    places = np.array([[0.0, 0.0], [3.5, 20.0], [5.0, 30.0], [5.1, 0.0], [1.0, -0.1]])
    assert at(places, 0.9) == pytest.approx([0.0, 0.55, 0.8, 0.0, 0.0])
    ranges = written(tmp_path, 'b.csv', 'range,probability', [(40, 0.5), (10, 0.9), (60, 0.0)])
    by_range = DiverConfig(coverage_file=ranges, coverage_sector=(100, 0, 180, 20, 0, 1e6))
    at = configured_coverage(by_range)[''].probability
    places = np.array([[98.0, 0.0], [75.0, 0.0], [50.0, 0.0], [30.0, 0.0], [125.0, 0.0]])
    assert at(places, 0.9) == pytest.approx([0.9, 0.7, 0.25, 0.0, 0.0])


def test_each_sensor_has_its_own():
    sectors = {'left.coverage_sector': AHEAD, 'right.coverage_sector': [0, 0, 180, 90, 0, 50]}
    config = DiverConfig.from_mapping({'sensors': ['left', 'right'], **sectors})
    found = configured_coverage(config)
    assert sorted(found) == ['left', 'right']
    place = np.array([-20.0, 1.0])
    assert [found[name].probability(place, 0.9) for name in ('left', 'right')] == [0.0, 0.9]
    scans = [scan(k, (20.0, 0.3 * k), sensor='left') for k in range(1, 11)]
    tracks, gone = (
        ids_by_scan(config, scans + [scan(k, sensor=sensor) for k in range(11, 31)])
        for sensor in ('right', 'left')
    )
    assert tracks[-1] == tracks[8] != [] and not gone[-1]


def test_two_divers_outside_are_not_taken_for_one():
    config = DiverConfig(association='jipda', coverage_sector=AHEAD)
    scans = [scan(k, (42.0 + 0.75 * k, 0.0), (42.0 + 0.75 * k, 3.0)) for k in range(1, 11)]
    scans += [scan(k) for k in range(11, 41)]
    assert len(ids_by_scan(config, scans)[-1]) == 2


@pytest.mark.parametrize('header, rows, problem', [
    ('x,y,p', [(0, 0, 0.5)], 'its first line has to be x,y,probability or range,probability'),
    ('range,probability', [(0, 0.5)], 'at least two values on each axis'),
    ('range,probability', [(0, 0.5), (0, 0.4), (1, 0.1)], 'each place once'),
    ('range,probability', [(0, 0.5), (1, 1.5)], 'a probability is not between 0 and 0.9999'),
    ('range,probability', [(0, 0.5), (1, 'x')], 'could not convert'),
    ('x,y,probability', [(0, 0, 0.5), (1, 0.5)], 'inhomogeneous'),
])  # fmt: skip
def test_files_that_hold_no_table_are_refused(tmp_path, header, rows, problem):
    file = written(tmp_path, 'table.csv', header, rows)
    for name, said in ((file, problem), (file + '.no', 'table.csv.no')):
        with pytest.raises(ConfigError, match=said):
            DiverTracker(DiverConfig(coverage_file=name))


def test_a_running_tracker_takes_another_sector():
    tracker = DiverTracker(DiverConfig(coverage_sector=AHEAD))
    run(tracker, [scan(second, (20.0, 0.1 * second)) for second in range(1, 11)])
    turned = DiverConfig(coverage_sector=(0.0, 0.0, 180.0, 90.0, 0.0, 50.0))
    tracker.reconfigure(turned)
    *_, estimate = run(tracker, [scan(second) for second in range(11, 31)])
    assert len(estimate.state) == 1
    assert json_parameters(turned)['coverage_sector'][2] == 180.0
