# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Simulated divers: reproducible, as accurate as stated, as late as stated."""

from collections import Counter

import numpy as np
import pytest

from sonar_imm.measurements import Fix
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm.trackers.diver.georeferencing import Georeferencer
from sonar_imm_tools.simulation.diver import simulator
from sonar_imm_tools.simulation.diver.fixes import CLOSEST, crossing_paths, ORIGIN
from sonar_imm_tools.simulation.diver.simulator import RECEIVERS, scenario, simulate


def run(name, seed=1, **overrides):
    return simulate(scenario(name, overrides), seed)


def errors_of(scene):
    """Errors (n, 3) of fixes of the first diver, one for each place."""
    return [
        item.measurement.position - place
        for item, place in zip(scene.measurements, scene.truth[0].position)
    ]


def test_table_1_starts_where_the_paper_says_at_its_speed():
    scene = run('table1')
    track = scene.truth[0]
    np.testing.assert_array_equal(track.position[0], [-40.0, 40.0, 0.0])
    np.testing.assert_allclose(np.hypot(*track.velocity.T), 1.0)
    assert len(track.stamp_ns) == len(scene.measurements) == 101
    steps = np.diff(track.position[:, :2], axis=0)
    np.testing.assert_allclose(steps, track.velocity[1:], atol=1e-9)
    assert np.abs(np.arctan2(*track.velocity.T[::-1])).max() <= np.pi / 2 + 1e-9
    # A turned scene keeps its distances.
    plain, turned = (
        run('table1', 9, random_rotation=rotation).truth[0].position[0]
        for rotation in (False, True)
    )
    assert np.hypot(*plain[:2]) == pytest.approx(np.hypot(*turned[:2]))
    assert not np.allclose(plain, turned)


def test_fixes_are_as_accurate_as_they_say():
    squared = []
    for seed in range(20):
        scene = run('table1', seed)
        for item, error in zip(scene.measurements, errors_of(scene)):
            R = item.measurement.covariance[:2, :2]
            squared.append(error[:2] @ np.linalg.solve(R, error[:2]))
    assert np.mean(squared) == pytest.approx(2.0, abs=0.15)
    plain = np.array(errors_of(run('table1', sensor='positions', duration=999.0)))
    assert np.std(plain[:, :2]) == pytest.approx(1.0, rel=0.07)  # metres, unless told otherwise


@pytest.mark.statistics
def test_misses_clutter_and_outliers_come_as_often_as_asked():
    missed = run('table1', 5, detection_probability=0.7, duration=2000.0)
    assert len(missed.measurements) == pytest.approx(0.7 * 2001, abs=80)
    cluttered = run('table1', 6, clutter=3.0, duration=400.0)
    assert len(cluttered.measurements) == pytest.approx(4.0 * 401, abs=150)
    scene = run('table1', 7, outlier_probability=0.1, duration=2000.0)
    error = np.linalg.norm(np.array(errors_of(scene))[:, :2], axis=1)
    # A bearing error of 2 degrees is never 8 times its size; most outliers are far off.
    far = np.linalg.norm(scene.truth[0].position[:, :2], axis=1) * np.deg2rad(16.0)
    assert np.mean(error > far) == pytest.approx(0.1, abs=0.03)


def test_late_scans_are_received_late_and_several_divers_are_several():
    scene = run('irregular', 8)
    received = np.array([item.received_ns for item in scene.measurements])
    stamps = np.array([item.measurement.stamp_ns for item in scene.measurements])
    delay = received - stamps
    assert (np.diff(received) >= 0).all() and (np.diff(stamps) < 0).any()
    assert (delay >= 0).all() and delay.max() <= 3e9
    assert np.mean(delay > 0) == pytest.approx(0.25, abs=0.12)
    scene = run('several', 10)
    assert [track.track_id for track in scene.truth] == [1, 2, 3, 4]
    starts = np.array([track.position[0, :2] for track in scene.truth])
    gaps = np.linalg.norm(starts[:, None] - starts, axis=-1) + 1e9 * np.eye(4)
    assert gaps.min() > 10.0
    assert all(isinstance(item.measurement, Fix) for item in scene.measurements)


def test_mistakes_get_a_sentence():
    for values, says in (
        ({'leg_min': 20.0}, 'leg_min cannot exceed'),
        ({'start': (1.0,)}, 'two values'),
        ({'motion': 'swim'}, 'one of'),
    ):
        with pytest.raises(ConfigError, match=says):
            scenario('table1', values)


def test_positions_on_earth_lie_where_the_truth_does():
    scene = run('geodetic', 2, fix_std=0.5)
    truth = dict(zip(scene.truth[0].stamp_ns.tolist(), scene.truth[0].position))
    entries = [item.measurement for item in scene.measurements]
    places = [ORIGIN.local(each.latitude, each.longitude, each.height)[:2] for each in entries]
    error = np.array(places) - [truth[each.stamp_ns][:2] for each in entries]
    np.testing.assert_allclose(error.std(axis=0), 0.5, rtol=0.25)


def test_what_a_vessel_sees_is_consistent_where_it_is_placed():
    config, nees = scenario('usbl'), []
    for seed in range(4):
        scene = simulate(config, seed)
        truth = {each.track_id: dict(zip(each.stamp_ns, each.position)) for each in scene.truth}
        georeferencer = Georeferencer(DiverConfig(**config.instruments()), Counter())
        for item in scene.measurements:
            for fix in georeferencer.georeference(item.measurement):
                error = (fix.position - truth[fix.target_id][fix.stamp_ns])[:2]
                nees.append(error @ np.linalg.solve(fix.covariance[:2, :2], error))
    # 2 is due; a pose between two messages is the mean of both, and better than each.
    assert len(nees) > 700 and 1.4 < np.mean(nees) < 2.2


# -- what the sensors say of divers, by geometry and statistics of its own ------------------------


def arrivals(scene):
    """(arrivals, where the divers are (n, 3)) of each ping."""
    at = {int(stamp): k for k, stamp in enumerate(scene.truth[0].stamp_ns)}
    pings = [item.measurement for item in scene.measurements]
    return [(ping, [t.position[at[ping.stamp_ns]] for t in scene.truth]) for ping in pings]


CLEAN = {'detection_probability': 1.0, 'outlier_probability': 0.0}


def test_errors_of_arrival_times_are_independent_and_as_large_as_told():
    scene = run('multistatic', sound_speed=1480.0, toa_std=3e-4, duration=600.0, **CLEAN)
    errors = []
    for ping, (place,) in arrivals(scene):
        path = np.linalg.norm(place - simulator.TRANSMITTER) + np.linalg.norm(
            place - RECEIVERS, axis=1
        )
        assert ping.rx_id.tolist() == [0, 1, 2, 3] and (ping.var_toa == 3e-4**2).all()
        errors.append((ping.toa - path / 1480.0) / 3e-4)
    errors = np.array(errors)
    assert errors.shape == (601, 4) and np.abs(errors.mean(axis=0)).max() < 4.0 / np.sqrt(601)
    assert np.std(errors) == pytest.approx(1.0, abs=0.06)
    assert np.abs(np.corrcoef(errors.T) - np.eye(4)).max() < 0.17


def test_receivers_miss_and_hear_reflections_each_for_itself():
    told = {'detection_probability': 0.6, 'outlier_probability': 0.2, 'toa_std': 1e-7}
    scene = run('multistatic', **told, duration=1500.0, sound_speed=1480.0)
    received, late = np.zeros(4), []
    for ping, (place,) in arrivals(scene):
        received[ping.rx_id] += 1
        direct = np.linalg.norm(place) + np.linalg.norm(place - RECEIVERS[ping.rx_id], axis=1)
        late += (ping.toa * 1480.0 - direct).tolist()
    assert received / 1501 == pytest.approx([0.6] * 4, abs=0.05)
    late = np.array(late)
    reflected = late > 1.0
    assert reflected.mean() == pytest.approx(0.2, abs=0.03)
    assert 4.99 <= late[reflected].min() < 6.0 and 49.0 < late[reflected].max() <= 50.01
    assert late[reflected].mean() == pytest.approx(27.5, abs=2.5)
    assert np.abs(late[~reflected]).max() < 0.01


def test_false_arrivals_come_after_the_direct_sound():
    clutter = {'clutter': 2.0, 'clutter_range': 30.0, 'detection_probability': 0.0}
    scene = run('multistatic', **clutter, duration=500.0, sound_speed=1480.0)
    pings = [ping for ping, _ in arrivals(scene)]
    heard = np.concatenate([ping.rx_id for ping in pings]).astype(int)
    toa = np.concatenate([ping.toa for ping in pings])
    direct = np.linalg.norm(RECEIVERS - simulator.TRANSMITTER, axis=1)
    late = toa * 1480.0 - direct[heard]
    assert 0.0 <= late.min() < 1.0 and 59.0 < late.max() <= 60.0  # twice the range
    assert np.bincount(heard, minlength=4) / 501 == pytest.approx([2.0] * 4, abs=0.26)


def test_polar_fixes_have_the_errors_of_a_polar_sonar():
    """Along the line of sight the error of the range, across it that of the bearing."""
    error, place = [], np.array([-60.0, 25.0])
    for seed in range(8):
        error += errors_of(run('still', seed, range_std=0.3, bearing_std_deg=1.5, start=(-60, 25)))
    error, n = np.array(error)[:, :2], len(error)
    along, across = error @ place / 65.0, error @ [-place[1], place[0]] / 65.0**2
    # The converted fix is shrunk by exp(-s^2 / 2) of its range, 22 mm here.
    assert np.mean(along) == pytest.approx(-65.0 * np.radians(1.5) ** 2, abs=4 * 0.3 / np.sqrt(n))
    assert np.std(along) == pytest.approx(0.3, rel=0.1)
    assert np.mean(across) == pytest.approx(0.0, abs=4.0 * np.radians(1.5) / np.sqrt(n))
    assert np.std(across) == pytest.approx(np.radians(1.5), rel=0.1)


@pytest.mark.statistics
def test_fixes_from_arrivals_are_as_accurate_as_they_say():
    squared = []
    for seed in range(5):
        scene = run('multistatic_fixes', seed)
        at = dict(zip(scene.truth[0].stamp_ns.tolist(), scene.truth[0].position[:, :2]))
        for item in scene.measurements:
            error = item.measurement.position[:2] - at[item.measurement.stamp_ns]
            squared.append(error @ np.linalg.solve(item.measurement.covariance[:2, :2], error))
    assert len(squared) > 450
    assert np.mean(squared) == pytest.approx(2.0, abs=4.0 * 2.0 / np.sqrt(len(squared)))


def test_clutter_fills_the_square_evenly():
    scene = run('table1', detection_probability=0.0, clutter=5.0, clutter_range=50.0,
                duration=300.0, range_std=1e-3, bearing_std_deg=1e-3)  # fmt: skip
    points = np.array([item.measurement.position[:2] for item in scene.measurements])
    assert len(points) == pytest.approx(1505, abs=160)
    counts, _, _ = np.histogram2d(*points.T, bins=3, range=[[-50, 50], [-50, 50]])
    assert counts.sum() >= len(points) - 2
    expected = len(points) / 9
    assert ((counts - expected) ** 2 / expected).sum() < 26.1  # chi-square of 8, 99.9 %


# -- motions --------------------------------------------------------------------------------------


def test_a_circle_closes_and_positions_are_the_sum_of_the_velocities_at_any_step():
    track = run('circle', duration=160.0, step=0.1).truth[0]
    place = track.position[:, :2]
    np.testing.assert_allclose(place[800], place[0], atol=1e-6)
    radius = 0.75 * 80.0 / (2.0 * np.pi)
    assert np.linalg.norm(place[400] - place[0]) == pytest.approx(2.0 * radius, rel=1e-3)
    heading = np.unwrap(np.arctan2(*track.velocity.T[::-1]))
    np.testing.assert_allclose(np.diff(heading), 2.0 * np.pi / 800.0, rtol=1e-6)
    track = run('table1', step_jitter=0.8, duration=50.0).truth[0]
    dt = np.diff(track.stamp_ns) * 1e-9
    assert dt.std() > 0.2 and dt.min() > 0.0
    moved = np.diff(track.position[:, :2], axis=0)
    np.testing.assert_allclose(moved, track.velocity[1:] * dt[:, None], atol=1e-8)


def test_a_zigzag_turns_every_ten_seconds_one_leg_of_three_is_a_rest_and_legs_last_as_told():
    scene = run('zigzag', random_rotation=False, heading_deg=20.0)
    degrees = np.degrees(np.arctan2(*scene.truth[0].velocity.T[::-1]))
    assert sorted(set(np.round(degrees, 6))) == [-40.0, 80.0]
    np.testing.assert_array_equal(np.diff(np.flatnonzero(np.diff(degrees))), 10)
    speeds = np.hypot(*run('stop_and_go', duration=5000.0).truth[0].velocity.T)
    assert set(np.round(speeds, 9)) == {0.0, 0.75}
    assert np.mean(speeds == 0.0) == pytest.approx(1.0 / 3.0, abs=0.03)
    track = run('table1', duration=3000.0, step=0.5, leg_min=4.0, leg_max=6.0).truth[0]
    turned = np.flatnonzero(np.abs(np.diff(track.velocity[:, 0])) > 1e-9)
    seconds = np.diff(turned) * 0.5
    assert seconds.min() >= 3.5 and seconds.max() <= 6.5
    assert seconds.mean() == pytest.approx(5.0, abs=0.15)


def test_divers_rise_and_sink_with_the_swell_by_its_height_and_period():
    config = scenario('table1', {'depth': [4.0, 4.0], 'swell_height': 0.5, 'swell_period': 8.0})
    times = 0.5 * np.arange(160)
    (height,) = simulator.draw_errors(config, times, np.random.default_rng(3)).height.T
    assert np.ptp(height) == pytest.approx(1.0, abs=0.05)
    assert height.mean() == pytest.approx(-4.0, abs=1e-9)
    np.testing.assert_allclose(height[16:], height[:-16], atol=1e-9)


def test_positions_have_the_errors_they_state_and_a_height_where_it_is_measured():
    """White errors of half a metre, and nothing else, in 500 fixes."""
    scene = {'sensor': 'positions', 'fix_std': 0.5, 'duration': 499.0, 'depth': (-8.0, -8.0)}
    for height_std, stated in ((0.0, [0.25, 0.25]), (0.2, [0.25, 0.25, 0.04])):
        simulated = run('table1', 3, **scene, fix_height_std=height_std)
        for item in simulated.measurements:
            variances = np.diag(item.measurement.covariance)
            np.testing.assert_allclose(variances[np.isfinite(variances)], stated)
        measured = np.array(errors_of(simulated))[:, : len(stated)]  # NaN: not measured
        np.testing.assert_allclose(np.cov(measured.T), np.diag(stated), atol=0.05)


def test_a_scan_holds_the_divers_that_are_seen_and_clutter_in_no_order():
    """Nearly exact fixes of a crossing: those at a diver are of divers, the others fill a square
    of 160 m."""
    told = scenario('crossing').instruments()
    assert told == {'clutter_density': 10.0 / 160.0**2, 'detection_probability': 0.9}
    assert 'clutter_density' not in scenario('table1').instruments()
    simulated = run('crossing', 4, fix_std=1e-3, clutter=6.0)
    truth = np.array([track.position for track in simulated.truth])
    seen, first, false = 0, 0, []
    for each, places in zip(simulated.measurements, truth.swapaxes(0, 1)):
        fixes = each.measurement.position
        assert (fixes[:, 2] == 0.0).all()
        off = np.linalg.norm(fixes[:, None, :2] - places[None, :, :2], axis=2).min(axis=1)
        seen, first = seen + (off < 0.01).sum(), first + (off[0] < 0.01)
        false.append(fixes[off >= 0.01, :2])
    scans, false = len(simulated.measurements), np.concatenate(false)
    assert seen / scans == pytest.approx(4 * 0.9, abs=0.2)
    assert len(false) / scans == pytest.approx(6.0, abs=0.6)
    assert np.abs(false).max() == pytest.approx(80.0, abs=1.0)
    assert 0.2 < first / scans < 0.6  # a diver is not always the first


@pytest.mark.parametrize('divers, std, stated', [(1, 0.2, True), (1, 0.0, False), (2, 0.2, False)])
def test_a_depth_is_stated_where_it_is_measured_and_there_is_one_it_can_be_of(divers, std, stated):
    scene = run('at_depth', 3, divers=divers, depth_std=std, duration=5.0)
    for each in scene.measurements:
        assert np.isfinite(each.measurement.depth).all() == stated
        if stated:
            index = np.searchsorted(scene.truth[0].stamp_ns, each.measurement.stamp_ns)
            true = -scene.truth[0].position[index, 2]
            assert each.measurement.depth == pytest.approx(true, abs=0.8)


def test_divers_who_cross_come_as_near_as_they_are_said_to():
    for seed in range(8):
        paths = crossing_paths(6, np.linspace(0.0, 100.0, 2001), np.random.default_rng(seed))
        for first, other in zip(paths[::2], paths[1::2]):
            assert np.linalg.norm(first[:, :2] - other[:, :2], axis=1).min() < CLOSEST + 0.05
