# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Objects on the floor, what a ping sees of them, and ships that move above."""

import math

import numpy as np
import pytest

from benchmarks.bathymetry_paper import truth_of
from sonar_imm.acoustics import geometry, sounding
from sonar_imm.measurements import Navigation, Snapshot
from sonar_imm.parameters import ConfigError
from sonar_imm.soundings import soundings_of
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.evaluation.bathymetry.scoring import profiles_of, score
from sonar_imm_tools.simulation.bathymetry.objects import (
    above,
    FACE,
    facets_of,
    second_of,
    surfaces_of,
)
from sonar_imm_tools.simulation.bathymetry.ship import in_outline, ship_of, Terrain
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate, snr, SUMMER


def seen(**values):
    config = scenario('ledge', values)
    ranges = config.first_range + config.bin_width * np.arange(1200)
    ratio = snr(config, ranges)
    return ranges, ratio, *surfaces_of(facets_of(config, ranges, ratio), len(ranges))


@pytest.mark.parametrize('kind', ['ledge', 'box', 'wall', 'boulder'])
def test_the_floor_before_an_object_has_the_ratio_of_the_scene(kind):
    ranges, ratio, power, height = seen(object=kind, object_distance=50.0)
    near = (ranges > 18.0) & (ranges < 50.0)
    assert np.mean(power[near, 0] / ratio[near]) == pytest.approx(1.0, abs=0.01)
    assert np.abs(power[near, 0] / ratio[near] - 1.0).max() < 0.35  # whole facets
    assert np.abs(height[near, 0]).max() < 1e-12 and (power[near, 1:] == 0.0).all()


def test_a_ledge_has_its_face_before_the_foot_and_its_top_with_the_floor():
    ranges, _, power, height = seen(object_distance=30.0, object_size=2.0)
    foot, edge = math.hypot(30.0, 15.0), math.hypot(30.0, 13.0)
    face = np.flatnonzero(power[:, 1])
    assert ranges[face[0]] == pytest.approx(edge, abs=0.06)
    assert ranges[face[-1]] == pytest.approx(foot, abs=0.06)
    both = (ranges > edge + 0.1) & (ranges < foot - 0.1)
    assert (power[both][:, :3] > 0.0).all()
    # The face at range r is at the height where 15 - z = sqrt(r^2 - 30^2).
    expected = 15.0 - np.sqrt(ranges[both] ** 2 - 900.0)
    assert height[both, 1] == pytest.approx(expected, abs=0.08)
    number, main, second = second_of(power, height)
    assert (number[both] >= 2).mean() > 0.7 and number[ranges < 32.0].max() == 1
    beside = np.isfinite(second)
    assert (np.abs(second - main)[beside] >= 0.5).all()
    np.testing.assert_array_equal(beside, number > 1)


def test_a_level_sonar_hears_each_facet_from_its_height():
    config = scenario('ledge', {'object': 'wall', 'object_size': 3.0})
    ranges = config.first_range + config.bin_width * np.arange(1200)
    facets = facets_of(config, ranges, np.full(1200, 100.0))
    below = ranges[facets.bin] * np.sin(math.radians(config.tilt_deg) + np.arcsin(facets.sine))
    np.testing.assert_allclose(config.sonar_height - below, facets.height, atol=1e-9)
    assert facets.height.max() == 3.0


@pytest.mark.parametrize('kind', ['box', 'wall', 'boulder'])
def test_an_object_has_a_shadow(kind):
    ranges, _, power, _ = seen(object=kind, object_distance=30.0, object_size=3.0)
    dark = power.sum(axis=1) == 0.0
    begin, end = ranges[dark][[0, -1]]
    assert begin > 32.0
    if kind == 'wall':  # the ray over its far edge meets the floor there
        assert end == pytest.approx(math.hypot(30.2 * 15.0 / 12.0, 15.0), abs=0.1)
    assert (power[ranges > end + 0.1, 3] > 0.0).all()


@pytest.mark.parametrize('side, sign', [('port', 1.0), ('starboard', -1.0)])
def test_the_truth_of_an_object_has_its_range_height_and_side(side, sign):
    config = scenario('ledge', {'object': 'wall', 'object_size': 4.0, 'pings': 1, 'side': side})
    true = simulate(config, 1).truth[0]
    x, y, z = true.xyz[true.valid].T
    assert (x == 0.0).all() and (sign * y > 0.0).all() and true.height[true.valid].max() > 3.0
    np.testing.assert_allclose(np.hypot(y, z), true.range[true.valid])
    np.testing.assert_allclose(z, true.height[true.valid] - config.sonar_height)


def tracked(config, seed, **values):
    scene = simulate(config, seed)
    values = {**config.instruments(), **values}
    tracker = BathymetryTracker(BathymetryConfig.from_mapping(values))
    return scene, [y for item in scene.measurements for y in tracker.process(item.measurement)]


def test_a_wall_is_gated_and_scored():
    """The range of heights is no limit: walls of 4 m."""
    wall = {'object': 'wall', 'object_size': 4.0, 'object_distance': 26.0, 'pings': 4}
    scene, estimates = tracked(scenario('ledge', wall), 5, layover='gated')
    metrics = score(profiles_of(estimates, truth_of(scene)))
    assert metrics['layover']['bins'] > 80
    assert metrics['layover']['found'] > 0.75
    assert metrics['layover']['soundings'] < 0.2 and metrics['layover']['lost'] < 0.01
    assert 0.0 < metrics['two_share'] < 0.05


@pytest.mark.parametrize('side', ['port', 'starboard'])
def test_facets_below_a_ship_lie_where_the_geometry_of_soundings_puts_them(side):
    config = scenario('moving_ledge', {'object': 'wall', 'object_size': 3.0})
    ship = ship_of(config, config.sonar_depth, np.random.default_rng(1))
    ranges = config.first_range + config.bin_width * np.arange(1200)
    axes = sounding.array_axes(side, math.radians(config.tilt_deg), np.eye(3))
    received = ship.pose(3.0 + 2.0 * ranges / config.sound_speed)
    look = sounding.looks(axes, np.array([1.5, -0.4, -0.8]), ship.pose(np.array(3.0)), received)
    level = -config.sonar_depth - config.sonar_height
    over = above(look, ship.course, side, level)
    facets = facets_of(config, ranges, np.full(1200, 100.0), over)
    there = sounding.Looks(*(part[facets.bin] for part in look))
    place = there.position + ranges[facets.bin, None] * sounding.direction(there, facets.sine)
    assert np.abs(place[:, 2] - level - facets.height).max() < 0.06  # half a bin of range
    c, s = math.cos(ship.course), math.sin(ship.course)
    off = (c * place[:, 1] - s * place[:, 0]) * (1.0 if side == 'port' else -1.0)
    assert (np.abs(off - config.object_distance) < 0.2)[facets.surface == FACE].all()


def test_a_ledge_below_a_ship_becomes_soundings_of_both_surfaces():
    config = scenario('moving_ledge', {'pings': 3, 'object_size': 2.5})
    _, estimates = tracked(config, 4, navigation='required')
    off, upper = [], 0
    for estimate in estimates:
        columns = soundings_of(estimate).columns
        again = columns['surface'] == 2
        upper += int(again.sum())
        across = np.abs(columns['py'] * math.cos(math.pi / 6) - columns['px'] * 0.5)
        top = np.where(across < config.object_distance, 0.0, config.object_size)
        face = np.abs(across - config.object_distance) < 2.0
        error = np.where(face, np.nan, columns['pz'] + 20.0 - top)
        off.append(error / np.sqrt(columns['vertical_uncertainty']))
        assert (columns['existence'][again] >= 0.5).all()
    error = np.concatenate(off)
    assert len(estimates) == 3 and upper > 40
    assert np.nanmean(np.abs(error) < 2.0) > 0.9


@pytest.mark.parametrize('values', [{'multipath': True}, {'object_size': 20.0}])
def test_what_does_not_go_with_objects(values):
    with pytest.raises(ConfigError):
        scenario('ledge', values)


def test_the_second_surface_is_the_strongest_that_is_apart():
    power = np.array([[9.0, 2.0, 4.0, 8.0], [9.0, 0.0, 0.0, 8.0], [0.0, 0.0, 0.0, 0.0]])
    height = np.array([[0.0, 3.0, 2.0, 0.1]] * 3)
    number, main, second = second_of(power, height)
    assert number.tolist() == [3, 1, 0]
    assert main[:2].tolist() == [0.0, 0.0]
    np.testing.assert_array_equal(second, [2.0, np.nan, np.nan])


# -- below a ship that moves ----------------------------------------------------------------------


def exact(**more):
    """No errors in the navigation."""
    errors = 'attitude_error_deg', 'heading_error_deg', 'heave_error', 'position_error'
    none = {f'nav_{error}': 0.0 for error in errors}
    return scenario('moving', {'pings': 6, 'bin_width': 0.5, 'patch_std': 0.0, **none, **more})


def poses(scene):
    received = [item.measurement for item in scene.measurements]
    nav = [item for item in received if isinstance(item, Navigation)]
    stamps = np.array([item.stamp_ns for item in nav])
    return stamps, np.array([n.position for n in nav]), np.array([n.orientation for n in nav])


def test_every_point_lies_at_its_range_in_the_fan_of_the_array():
    config = exact()
    scene = simulate(config, 4)
    stamps, position, q = poses(scene)
    mount = geometry.rotation(*np.radians(config.sonar_mount_rpy_deg))
    for true in scene.truth:
        arrival = true.stamp_ns + 2e9 * true.range / config.sound_speed
        for k in (0, 60, -1):
            near = np.argmin(np.abs(stamps - arrival[k]))
            R = geometry.rotation_of_quaternion(q[near])
            array = position[near] + R @ np.array(config.sonar_lever)
            m = (R @ mount).T @ (true.xyz[k] - array)
            assert np.linalg.norm(m) == pytest.approx(true.range[k], abs=0.15)
            assert abs(m[0]) < 0.25 and m[1] < 0.0  # in the fan, to starboard
            # The stave axis of a starboard array points outward and up, with the sign turned.
            u = m @ np.array([0.0, np.sin(np.radians(30)), -np.cos(np.radians(30))])
            assert np.arcsin(u / true.range[k]) == pytest.approx(true.angle[k], abs=0.004)


def test_the_floor_is_level_and_depth_is_told_from_the_water_line():
    true = simulate(exact(water_level=3.0), 4).truth[0]
    assert true.height == pytest.approx(np.full(len(true.range), 3.0 - 5.0 - 15.0))
    assert true.xyz[:, 2] == pytest.approx(true.height)


def test_under_a_profile_the_points_are_where_rays_end():
    config = exact(sound_speed_profile=list(SUMMER))
    scene = simulate(config, 4)
    straight = simulate(exact(), 4)
    true, other = scene.truth[2], straight.truth[2]
    ship = scene.measurements[0].measurement.position
    assert np.linalg.norm(true.xyz[-1] - other.xyz[-1]) < 1.0  # the place hardly moves
    assert np.degrees(abs(true.angle[-1] - other.angle[-1])) > 2.0  # the direction does
    assert 60.0 < np.hypot(*(true.xyz[-1] - ship)[:2]) < 90.0


@pytest.mark.parametrize('profile', [[], list(SUMMER)])
def test_what_is_nearer_than_the_floor_is_no_echo(profile):
    level = {'roll_deg': 0.0, 'pitch_deg': 0.0, 'yaw_deg': 0.0, 'sonar_mount_rpy_deg': (0.0,) * 3}
    config = exact(first_range=8.0, sound_speed_profile=profile, pings=1, **level)
    (true,) = simulate(config, 4).truth
    echoes = true.range > config.sonar_height + 0.5
    assert np.isfinite(true.angle[echoes]).all() and true.valid[echoes].any()
    early = true.range < config.sonar_height - 0.5
    assert early.sum() > 10 and not true.valid[early].any() and np.isnan(true.angle[early]).all()


def test_the_outline_of_the_patch_waves_by_its_length_and_height():
    outline = {'patch_outline': 2.0, 'patch_outline_length': 8.0, 'patch_along': []}
    config = scenario('moving', outline)
    along, off = np.meshgrid(np.arange(0.0, 24.0, 0.25), np.arange(0.0, 40.0, 0.25))
    inside = in_outline(config, along, off, 10.0, 20.0)
    alike = [(inside[:, :-shift] == inside[:, shift:]).mean() for shift in (32, 16)]
    assert alike[0] > 0.995 and alike[1] < 0.95
    inner = off[inside.argmax(axis=0), 0]
    assert (inner.min(), inner.max()) == pytest.approx((8.0, 12.0), abs=0.25)
    assert (inside[60:72].all(), inside[:30].any(), inside[90:].any()) == (True, False, False)


def test_the_patch_has_an_outline_on_the_map():
    config = scenario('moving', {'pings': 40, 'bin_width': 0.25})
    scene = simulate(config, 1)
    share = np.array([true.patch.mean() for true in scene.truth])
    assert share[0] == 0.0 and share[-1] == 0.0 and share.max() > 0.1  # begins and ends
    begin = [true.range[true.patch].min() for true in scene.truth if true.patch.any()]
    assert np.ptp(begin) > 1.0  # its edge waves


def test_what_the_navigation_says_differs_from_the_truth_by_its_errors():
    small, errors = (
        {'pings': 200, 'bin_width': 10.0},
        ('nav_heave_error', 'nav_attitude_error_deg'),
    )
    right, wrong = (
        poses(simulate(exact(**small, **dict(zip(errors, values))), 5))
        for values in ((0.0, 0.0), (0.05, 0.5))
    )
    off = wrong[1] - right[1]
    assert np.std(off[:, 2]) == pytest.approx(0.05, rel=0.25) and (off[:, :2] == 0.0).all()
    a, b = (geometry.euler_angles(geometry.rotation_of_quaternion(q)) for *_, q in (right, wrong))
    assert np.degrees(np.std(b - a, axis=0)[:2]) == pytest.approx([0.5, 0.5], rel=0.3)
    # They last seconds: within a ping of 0.1 s they hardly change.
    assert np.abs(off[5:, 2] - off[:-5, 2]).max() < 0.02


def test_the_sides_look_apart():
    scene = simulate(scenario('moving_two_sides', {'pings': 1, 'bin_width': 1.0}), 1)
    assert sorted({item.namespace for item in scene.measurements}) == ['', 'port', 'starboard']
    port, starboard = (
        next(t for t in scene.truth if t.namespace == s) for s in ('port', 'starboard')
    )
    course = np.radians(30.0)
    left = np.array([-np.sin(course), np.cos(course), 0.0])
    assert (port.xyz @ left > 0.0).all() and (starboard.xyz @ left < 0.0).all()
    snapshots = [item for item in scene.measurements if isinstance(item.measurement, Snapshot)]
    assert len(snapshots) == 2


@pytest.mark.parametrize(
    'values, word',
    [
        ({'sound_speed_profile': [0.0, 1500.0]}, 'moving'),
        ({'moving': True, 'sound_speed_profile': [0.0]}, 'in turn'),
        ({'sonar_lever': [1.0]}, 'sonar_lever needs 3'),
        ({'patch_along': [5.0, 1.0]}, 'patch_along'),
        ({'patch_outline_length': 10001.0}, 'patch_outline_length'),
        ({'patch_along': [5.0, 5.0]}, 'patch_along needs two increasing values'),
        ({'moving': True, 'multipath': True}, 'multipath'),
    ],
)
def test_mistakes_in_a_ship_are_named(values, word):
    with pytest.raises(ConfigError, match=word):
        scenario('paper', values)


def test_the_floor_is_known_by_places_along_the_track_and_off_it():
    terrain = Terrain(-9.0, np.radians(30.0), lambda a, off: a + 100.0 * off, lambda a, off: a > 4)
    ahead, port = 0.5 * np.array([[np.sqrt(3.0), 1.0, 0.0], [-1.0, np.sqrt(3.0), 0.0]])
    places = np.array([5.0 * ahead + 2.0 * port, 3.0 * ahead - 2.0 * port, 3.0 * ahead])
    z, rough = terrain.at(places + [0.0, 0.0, 7.0], np.array([0.5, 0.5, 0.5]))
    assert z == pytest.approx([-9.0 + 5.0 + 200.0 + 0.5, -9.0 + 3.0 + 200.0, -9.0 + 3.0])
    assert rough.tolist() == [True, False, False]
