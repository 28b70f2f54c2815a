# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

import numpy as np
import pytest

from sonar_imm.acoustics import geometry, rays, sounding
from sonar_imm.measurements import Navigation, Snapshot
from sonar_imm.parameters import ConfigError
from sonar_imm_tools.simulation.bathymetry.ship import in_outline, Terrain
from sonar_imm_tools.simulation.bathymetry.simulator import scenario, simulate, SUMMER


def exact(**more):
    """No errors in the navigation."""
    none = {
        'nav_attitude_error_deg': 0.0,
        'nav_heading_error_deg': 0.0,
        'nav_heave_error': 0.0,
        'nav_position_error': 0.0,
    }
    return scenario('moving', {'pings': 6, 'bin_width': 0.5, 'patch_std': 0.0, **none, **more})


def poses(scene):
    nav = [
        item.measurement for item in scene.measurements if isinstance(item.measurement, Navigation)
    ]
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
    profile = rays.profile_of(config.sound_speed_profile)
    far = np.hypot(*(true.xyz[-1] - ship)[:2])
    launch = rays.launch_table(profile, 5.0, 77.0, 1500.0)
    assert 60.0 < far < 90.0 and launch.value.shape[0] == 78


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
    config = scenario(
        'moving', {'patch_outline': 2.0, 'patch_outline_length': 8.0, 'patch_along': []}
    )
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
    right, wrong = (
        poses(
            simulate(
                exact(
                    pings=200, bin_width=10.0, nav_heave_error=heave, nav_attitude_error_deg=turn
                ),
                5,
            )
        )
        for heave, turn in ((0.0, 0.0), (0.05, 0.5))
    )
    off = wrong[1] - right[1]
    assert np.std(off[:, 2]) == pytest.approx(0.05, rel=0.25) and (off[:, :2] == 0.0).all()
    angles = [
        geometry.euler_angles(geometry.rotation_of_quaternion(item[2])) for item in (right, wrong)
    ]
    assert np.degrees(np.std(angles[1] - angles[0], axis=0)[:2]) == pytest.approx(
        [0.5, 0.5], rel=0.3
    )
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
        ({'patch_along': [5.0, 5.0]}, 'patch_along needs two increasing values'),
        ({'moving': True, 'multipath': True}, 'multipath'),
    ],
)
def test_mistakes_are_named(values, word):
    with pytest.raises(ConfigError, match=word):
        scenario('paper', values)


def test_positions_of_an_array_ahead_of_the_reference():
    pose = geometry.Pose(np.zeros(3), geometry.rotation(0.0, 0.0, 0.5 * np.pi))
    axes = sounding.array_axes('port', 0.5, np.eye(3))
    look = sounding.looks(axes, np.array([2.0, 0.0, 0.0]), pose, pose)
    assert look.position == pytest.approx([0.0, 2.0, 0.0])


def test_the_floor_is_known_by_places_along_the_track_and_off_it():
    terrain = Terrain(-9.0, np.radians(30.0), lambda a, off: a + 100.0 * off, lambda a, off: a > 4)
    ahead, port = (
        np.array([np.sqrt(3.0), 1.0, 0.0]) / 2.0,
        np.array([-1.0, np.sqrt(3.0), 0.0]) / 2.0,
    )
    places = np.array([5.0 * ahead + 2.0 * port, 3.0 * ahead - 2.0 * port, 3.0 * ahead])
    z, rough = terrain.at(places + [0.0, 0.0, 7.0], np.array([0.5, 0.5, 0.5]))
    assert z == pytest.approx([-9.0 + 5.0 + 200.0 + 0.5, -9.0 + 3.0 + 200.0, -9.0 + 3.0])
    assert rough.tolist() == [True, False, False]
