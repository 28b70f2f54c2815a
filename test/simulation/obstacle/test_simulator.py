# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Obstacle scenes: the same for the same seed, and physically what they say."""

import numpy as np
from numpy.testing import assert_allclose
import pytest

from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.measurements import Altitude, Detections, Navigation
from sonar_imm.parameters import ConfigError
from sonar_imm_tools.simulation.obstacle.simulator import scenario, SCENARIOS, simulate

EXACT = {
    'ideal_navigation': True,
    'sound_speed_error': 0.0,
    'range_std': 0.0,
    'bearing_std_deg': 0.0,
    'range_step': 0.0,
    'bearing_step_deg': 0.0,
    'navigation_rate': 50.0,
}


def of(scene, kind):
    return [one.measurement for one in scene.measurements if isinstance(one.measurement, kind)]


@pytest.mark.parametrize('name', SCENARIOS)
def test_scenes_repeat_and_differ_by_seed(name):
    config = scenario(name)
    one, same, other = simulate(config, 3), simulate(config, 3), simulate(config, 4)
    for a, b in zip(one.measurements, same.measurements, strict=True):
        assert a.received_ns == b.received_ns
        for key in ('range', 'bearing', 'position', 'orientation', 'altitude'):
            if hasattr(a.measurement, key):
                assert np.array_equal(getattr(a.measurement, key), getattr(b.measurement, key))
    assert len(one.truth) == config.obstacles
    assert any(
        not np.array_equal(a.position, b.position)
        for a, b in zip(of(one, Navigation), of(other, Navigation))
    )
    received = [each.received_ns for each in one.measurements]
    assert received == sorted(received)


@pytest.mark.parametrize('model', geometry.AZIMUTH_MODELS)
def test_detections_point_at_the_obstacle_from_the_navigation(model):
    """Everything in ROS axes, by the definitions and nothing of the tracker."""
    config = scenario(
        'rolling',
        {
            **EXACT,
            'azimuth_model': model,
            'sonar_mount_rpy_deg': [3.0, -2.0, 5.0],
            'course_deg': 70,
        },
    )
    scene = simulate(config, 1)
    truth = scene.truth[0]
    poses = {one.stamp_ns: one for one in of(scene, Navigation)}
    roll, pitch, yaw = np.radians(config.sonar_mount_rpy_deg)
    checked = 0
    for ping in of(scene, Detections):
        if ping.stamp_ns not in poses or not len(ping):
            continue
        pose = poses[ping.stamp_ns]
        vehicle = Pose(pose.position, geometry.rotation_of_quaternion(pose.orientation))
        sonar = geometry.mounted(
            vehicle, np.array(config.sonar_lever), geometry.rotation(roll, pitch, yaw)
        )
        seen = geometry.to_body(sonar, truth.position[0])
        d, bearing = geometry.project(seen, model)
        assert ping.range[0] == pytest.approx(d, abs=1e-9)
        assert ping.bearing[0] == pytest.approx(bearing, abs=1e-9)
        k = int(np.searchsorted(truth.stamp_ns, ping.stamp_ns))
        assert truth.vertical_offset[k] == pytest.approx(
            sonar.position[2] - truth.position[0, 2], abs=1e-9
        )
        checked += 1
    assert checked > 40


def test_the_offset_is_the_one_asked_for():
    for name, offset in {'approach': 3.0, 'nearly_level': 0.5, 'above': -6.0}.items():
        truth = simulate(scenario(name), 2).truth[0]
        assert truth.vertical_offset[0] == pytest.approx(offset, abs=1e-9)
        assert truth.range[0] == pytest.approx(90.0, abs=1e-9)


def test_tethers_stand_on_the_sea_floor():
    config = scenario('tethers')
    for truth, tether in zip(simulate(config, 2).truth, (15.0, 12.0)):
        assert -truth.position[0, 2] == pytest.approx(20.0 + 15.5 - tether)
    seabed, surface = (simulate(scenario(name), 1).truth for name in ('seabed', 'surface'))
    assert all(-truth.position[0, 2] == pytest.approx(25.5) for truth in seabed)
    assert all(-truth.position[0, 2] == pytest.approx(0.5) for truth in surface)


def test_the_beam_has_the_stated_size():
    config = scenario('above', EXACT)
    scene = simulate(config, 5)
    truth = scene.truth[0]
    assert not truth.in_beam[truth.range < 40.0].any()  # sin(7.5 deg) = 6 / 46, less pitch
    assert truth.in_beam[truth.range > 70.0].all()
    echoes = {one.stamp_ns: len(one) for one in of(scene, Detections)}
    assert [echoes[int(stamp)] for stamp in truth.stamp_ns] == truth.in_beam.astype(int).tolist()


@pytest.mark.statistics
def test_swings_have_the_stated_size():
    rolls = []
    for seed in range(12):
        poses = of(simulate(scenario('rolling', EXACT), seed), Navigation)
        R = geometry.rotation_of_quaternion([one.orientation for one in poses])
        rolls.append(np.std(geometry.euler_angles(R)[:, 0]))
    assert np.degrees(np.mean(rolls)) == pytest.approx(4.0, abs=0.4)


def test_twist_is_the_derivative_of_the_pose():
    poses = of(simulate(scenario('rolling', EXACT), 1), Navigation)
    for before, now, after in list(zip(poses, poses[1:], poses[2:]))[100:110]:
        dt = (after.stamp_ns - before.stamp_ns) * 1e-9
        R = geometry.rotation_of_quaternion(now.orientation)
        assert_allclose(R @ now.velocity, (after.position - before.position) / dt, atol=2e-3)
        R0, R1 = (geometry.rotation_of_quaternion(one.orientation) for one in (before, after))
        turned = (R.T @ R1 - R.T @ R0) / dt
        skew = 0.5 * (turned - turned.T)
        assert_allclose(now.turn_rate, [skew[2, 1], skew[0, 2], skew[1, 0]], atol=2e-3)


def test_navigation_drifts_as_told():
    """Half a per cent of 84 m, besides bias: end points off by tenths of metres."""
    off = []
    for seed in range(10):
        poses = of(simulate(scenario('approach'), seed), Navigation)
        ideal = of(simulate(scenario('approach', {'ideal_navigation': True}), seed), Navigation)
        off.append(np.linalg.norm((poses[-1].position - ideal[-1].position)[:2]))
    assert 0.1 < np.mean(off) < 1.0


def test_the_altimeter_measures_the_sea_floor():
    altitudes = [one.altitude for one in of(simulate(scenario('approach'), 1), Altitude)]
    assert np.mean(altitudes) == pytest.approx(15.0, abs=0.3)
    relief = [one.altitude for one in of(simulate(scenario('rough_seabed'), 1), Altitude)]
    assert np.std(relief) > np.std(altitudes) + 0.1
    assert not of(simulate(scenario('approach', {'altimeter': False}), 1), Altitude)


def test_clutter_misses_and_gaps():
    counts = [len(one) for one in of(simulate(scenario('six'), 1), Detections)]
    assert 7.0 < np.mean(counts[:40]) < 12.0
    stress = simulate(scenario('stress'), 2)
    assert len(of(stress, Detections)) < 112
    config = scenario('stress', {'navigation_gaps': 4.0})
    steps = np.diff([one.stamp_ns for one in of(simulate(config, 1), Navigation)]) * 1e-9
    assert steps.max() > 2.9


def test_wrong_names_are_told():
    with pytest.raises(ConfigError, match='did you mean'):
        scenario('aproach')
    with pytest.raises(ConfigError, match='vertical_ofset'):
        scenario('approach', {'vertical_ofset': 1.0})
