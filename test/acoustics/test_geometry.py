# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Frames, projection and prediction against tables made elsewhere, scipy and closed forms."""

from pathlib import Path

import numpy as np
from numpy.testing import assert_allclose
from oracles.geometry import flip_pose, rates
import pytest
from scipy.spatial.transform import Rotation, Slerp

from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose

VECTORS = Path(__file__).parents[1] / 'vectors' / 'obstacle'
EXACT = {'rtol': 0.0, 'atol': 1e-9}


def table(name):
    return np.genfromtxt(
        VECTORS / f'{name}.csv', delimiter=',', names=True, dtype=None, encoding='utf-8',
        deletechars='',
    )  # fmt: skip


def columns(rows, *names):
    return np.column_stack([rows[name] for name in names])


@pytest.fixture(scope='module')
def seen():
    return table('projection')


@pytest.fixture(scope='module')
def moved():
    return table('prediction')


def sonar_pose(rows):
    """The sonar in NED, from vehicle pose, lever and mount."""
    vehicle = Pose(
        columns(rows, 'nav_n', 'nav_e', 'nav_d'),
        geometry.rotation(rows['roll'], rows['pitch'], rows['yaw']),
    )
    mount = geometry.rotation(rows['mount_roll'], rows['mount_pitch'], rows['mount_yaw'])
    return geometry.mounted(vehicle, columns(rows, 'lever_x', 'lever_y', 'lever_z'), mount)


def test_rotations_of_both_worlds():
    rows = table('rotation_table')
    angles = np.radians(columns(rows, 'roll_deg', 'pitch_deg', 'yaw_deg'))
    R = geometry.rotation(*angles.T)
    expected = {
        world: np.stack(
            [columns(rows, *(f'R{world}{i}{j}' for j in range(3))) for i in range(3)], 1
        )
        for world in ('ned', 'enu')
    }
    assert_allclose(R, expected['ned'], **EXACT)
    assert_allclose(geometry.flip_rotation(R), expected['enu'], **EXACT)
    for world in ('ned', 'enu'):
        q = columns(rows, *(f'q{world}_{part}' for part in 'xyzw'))
        assert_allclose(geometry.rotation_of_quaternion(3.0 * q), expected[world], **EXACT)
    ned, enu = (
        columns(rows, *(f'q{world}_{part}' for part in 'xyzw')) for world in ('ned', 'enu')
    )
    for first, other in ((ned, enu), (enu, ned)):
        same = geometry.flip_quaternion(first)  # q and -q are the same rotation
        same *= np.sign(np.sum(same * other, axis=1, keepdims=True))
        assert_allclose(same, other, **EXACT)
    enu_angles = geometry.euler_angles(expected['enu'])
    stated = columns(rows, 'rpy_enu_r', 'rpy_enu_p', 'rpy_enu_y')
    assert_allclose(np.exp(1j * enu_angles), np.exp(1j * stated), **EXACT)
    ros = np.column_stack([angles[:, 0], -angles[:, 1], 0.5 * np.pi - angles[:, 2]])
    assert_allclose(np.exp(1j * enu_angles), np.exp(1j * ros), **EXACT)


def test_sonar_pose_from_vehicle_lever_and_mount(seen):
    assert_allclose(
        sonar_pose(seen).position, columns(seen, 'sonar_n', 'sonar_e', 'sonar_d'), **EXACT
    )
    assert_allclose(sonar_pose(seen).R[:, 2], columns(seen, 'n_x', 'n_y', 'n_z'), **EXACT)


def test_sonar_pose_from_ros_odometry(seen):
    """Odometry in ENU and FLU, with lever and mount in FLU, is the same sonar."""
    vehicle = Pose(
        columns(seen, 'odom_x', 'odom_y', 'odom_z'),
        geometry.rotation_of_quaternion(columns(seen, 'qx', 'qy', 'qz', 'qw')),
    )
    lever = geometry.flip_body(columns(seen, 'lever_x', 'lever_y', 'lever_z'))
    # In FLU the same mount is turned by roll, -pitch, -yaw.
    mount = geometry.rotation(seen['mount_roll'], -seen['mount_pitch'], -seen['mount_yaw'])
    ours = flip_pose(geometry.mounted(vehicle, lever, mount))
    assert_allclose(ours.position, sonar_pose(seen).position, **EXACT)
    assert_allclose(ours.R, sonar_pose(seen).R, **EXACT)
    assert_allclose(
        geometry.flip_world(columns(seen, 'obst_enu_x', 'obst_enu_y', 'obst_enu_z')),
        columns(seen, 'obst_n', 'obst_e', 'obst_d'),
        **EXACT,
    )


def test_projection(seen):
    pose = sonar_pose(seen)
    m = geometry.to_body(pose, columns(seen, 'obst_n', 'obst_e', 'obst_d'))
    assert_allclose(m, columns(seen, 'm_x', 'm_y', 'm_z'), **EXACT)
    for model in geometry.AZIMUTH_MODELS:
        d, delta = geometry.project(m, model)
        assert_allclose(d, seen['d'], **EXACT)
        assert_allclose(delta, seen[f'delta_{model}'], **EXACT)
    assert_allclose(geometry.vertical_offset(m, pose.R), seen['d_st'], **EXACT)
    assert_allclose(np.arcsin(m[:, 2] / seen['d']), seen['eps_down'], **EXACT)


@pytest.mark.parametrize('model', geometry.AZIMUTH_MODELS)
def test_reconstruction_inverts_projection(seen, model):
    pose = sonar_pose(seen)
    m = geometry.reconstruct(seen['d'], seen[f'delta_{model}'], seen['d_st'], pose.R, model)
    assert_allclose(m, columns(seen, 'm_x', 'm_y', 'm_z'), **EXACT)
    assert_allclose(
        geometry.to_world(pose, m), columns(seen, 'obst_n', 'obst_e', 'obst_d'), **EXACT
    )


@pytest.mark.parametrize('model', geometry.AZIMUTH_MODELS)
def test_an_obstacle_further_off_than_its_range_is_infeasible(model):
    level = geometry.rotation(0.0, 0.0, 0.3)
    assert np.isnan(geometry.reconstruct(10.0, 0.1, 10.01, level, model)).any()
    assert np.isfinite(geometry.reconstruct(10.0, 0.1, 9.9, level, model)).all()


def two_poses(rows):
    lever = columns(rows, 'lever_x', 'lever_y', 'lever_z')
    return [
        geometry.mounted(
            Pose(
                columns(rows, f'n{i}', f'e{i}', f'd{i}'),
                geometry.rotation(rows[f'roll{i}'], rows[f'pitch{i}'], rows[f'yaw{i}']),
            ),
            lever,
            np.eye(3),
        )
        for i in (0, 1)
    ]


@pytest.mark.parametrize('model', geometry.AZIMUTH_MODELS)
def test_exact_prediction(moved, model):
    before, after = two_poses(moved)
    m0 = geometry.reconstruct(
        moved['range0'], moved[f'delta_{model}0'], moved['dst0'], before.R, model
    )
    m1 = geometry.predict(m0, before, after)
    d, delta = geometry.project(m1, model)
    assert_allclose(d, moved['range1'], **EXACT)
    assert_allclose(delta, moved[f'delta_{model}1'], **EXACT)
    assert_allclose(geometry.vertical_offset(m1, after.R), moved['dst1'], **EXACT)


def sonar_motion(rows):
    """Velocity and turn rate of the sonar, and the point it looks at."""
    before = two_poses(rows)[0]
    turn = columns(rows, 'p', 'q', 'r')
    velocity = columns(rows, 'Vr_x', 'Vr_y', 'Vr_z') + np.cross(
        turn, columns(rows, 'lever_x', 'lever_y', 'lever_z')
    )
    m = geometry.reconstruct(rows['range0'], rows['delta_plane0'], rows['dst0'], before.R)
    return m, velocity, turn, before.R


@pytest.mark.parametrize('model', geometry.AZIMUTH_MODELS)
def test_differential_form_is_the_derivative_of_the_exact_one(moved, model):
    """Poses a microsecond apart, turned by the exponential map."""
    m, velocity, turn, R = sonar_motion(moved)
    h = 1e-5
    images = []
    for step in (-h, h):
        after = Pose(
            geometry.apply(R, velocity) * step, R @ Rotation.from_rotvec(turn * step).as_matrix()
        )
        seen = geometry.predict(m, Pose(np.zeros(3), R), after)
        images.append([*geometry.project(seen, model), geometry.vertical_offset(seen, after.R)])
    slope = (np.array(images[1]) - np.array(images[0])) / (2.0 * h)
    assert_allclose(slope, np.array(rates(m, velocity, turn, R, model)), atol=1e-7)


def test_slerp_against_scipy():
    rng = np.random.default_rng(4)
    for _ in range(20):
        q0, q1 = rng.normal(size=(2, 4))
        between = Slerp([0.0, 1.0], Rotation.from_quat([q0, q1]))(0.3).as_matrix()
        assert_allclose(
            geometry.rotation_of_quaternion(geometry.slerp(q0, q1, 0.3)), between, **EXACT
        )
    q = rng.normal(size=4)
    for same in (q, -q, q + 1e-14):
        assert_allclose(
            geometry.rotation_of_quaternion(geometry.slerp(q, same, 0.7)),
            geometry.rotation_of_quaternion(q),
            **EXACT,
        )


def test_slerp_of_many_is_that_of_each_pair():
    rng = np.random.default_rng(5)
    q0, q1, fraction = rng.normal(size=(60, 4)), rng.normal(size=(60, 4)), rng.uniform(-1, 2, 60)
    q1[:5] = q0[:5]
    each = [geometry.slerp(*pair) for pair in zip(q0, q1, fraction)]
    assert_allclose(geometry.slerp(q0, q1, fraction), each, **EXACT)


def test_slerp_goes_on_at_the_same_rate():
    q0, q1 = Rotation.from_euler('z', [[0.0], [10.0]], degrees=True).as_quat()
    on = geometry.euler_angles(geometry.rotation_of_quaternion(geometry.slerp(q0, q1, 1.5)))
    assert_allclose(np.degrees(on), [0.0, 0.0, 15.0], atol=1e-12)
