# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Frames, projection, prediction and places against tables made elsewhere and closed forms."""

import math
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.spatial.transform import Rotation, Slerp
from scipy.stats import chi2

from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.acoustics.geometry import Pose, rotation
from sonar_imm.acoustics.polar import unbiased_polar_to_cartesian
from sonar_imm.acoustics.relative_position import Mounting, place, Uncertainty

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
    ours, due = geometry.mounted(vehicle, lever, mount), sonar_pose(seen)
    assert_allclose(geometry.flip_world(ours.position), due.position, **EXACT)
    assert_allclose(geometry.flip_rotation(ours.R), due.R, **EXACT)
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


def test_slerp_against_scipy():
    rng = np.random.default_rng(4)
    q0, q1, fraction = rng.normal(size=(60, 4)), rng.normal(size=(60, 4)), rng.uniform(-1, 2, 60)
    q1[:5] = q0[:5] * [[1.0], [-1.0], [1.0], [1.0], [1.0 + 1e-14]]
    each = [geometry.slerp(*pair) for pair in zip(q0, q1, fraction)]
    assert_allclose(geometry.slerp(q0, q1, fraction), each, **EXACT)
    same = geometry.rotation_of_quaternion(q0[:5])
    assert_allclose(geometry.rotation_of_quaternion(np.array(each[:5])), same, **EXACT)
    for pair, found in list(zip(zip(q0, q1), geometry.slerp(q0, q1, 0.3)))[5:]:
        between = Slerp([0.0, 1.0], Rotation.from_quat(pair))(0.3).as_matrix()
        assert_allclose(geometry.rotation_of_quaternion(found), between, **EXACT)
    # It goes on at the same rate.
    q0, q1 = Rotation.from_euler('z', [[0.0], [10.0]], degrees=True).as_quat()
    on = geometry.euler_angles(geometry.rotation_of_quaternion(geometry.slerp(q0, q1, 1.5)))
    assert_allclose(np.degrees(on), [0.0, 0.0, 15.0], atol=1e-12)


# -- latitude and longitude against the closed form of the ellipsoid, written out here ------------

A, F = 6378137.0, 1.0 / 298.257223563
E2 = F * (2.0 - F)


def earth(latitude, longitude, height):
    """Earth-centred metres: the textbook formula."""
    phi, lam = math.radians(latitude), math.radians(longitude)
    N = A / math.sqrt(1.0 - E2 * math.sin(phi) ** 2)
    out, up = (N + height) * math.cos(phi), (N * (1.0 - E2) + height) * math.sin(phi)
    return np.array([out * math.cos(lam), out * math.sin(lam), up])


def numeric_axes(latitude, longitude, height=0.0, step=1e-4):
    """East, north, up (3, 3) as columns, by differences of the formula above."""
    there = earth(latitude, longitude, height)
    columns = [
        earth(latitude, longitude + step, height) - earth(latitude, longitude - step, height),
        earth(latitude + step, longitude, height) - earth(latitude - step, longitude, height),
        earth(latitude, longitude, height + 1.0) - there,
    ]
    return np.array([column / np.linalg.norm(column) for column in columns]).T


PLACES = [(59.1, 10.2, 0.0), (-33.9, 151.2, 20.0), (0.001, -179.9999, -5.0), (78.2, 15.6, 3.0)]


@pytest.mark.parametrize('place', PLACES)
def test_metres_are_those_of_the_ellipsoid_and_come_back(place):
    origin = Origin(*place)
    rng = np.random.default_rng(3)
    for scale in (10.0, 3e3, 3e4):
        east, north, up = rng.normal(scale=scale, size=3) * [1.0, 1.0, 0.001]
        there = earth(*place) + numeric_axes(*place) @ [east, north, up]
        latitude, longitude, height = origin.geodetic(np.array([east, north, up]))
        assert earth(latitude, longitude, height) == pytest.approx(there, abs=2e-3)
        back = origin.local(latitude, longitude, height)
        assert back == pytest.approx([east, north, up], abs=1e-6)


def test_many_places_at_once():
    origin = Origin(59.1, 10.2)
    enu = np.arange(12.0).reshape(4, 3) * 100.0
    assert origin.geodetic(enu)[2] == pytest.approx(origin.geodetic(enu[2]))
    assert origin.geodetic(np.empty((0, 3))).shape == (0, 3)


def test_axes_turn_with_the_place():
    origin = Origin(59.1, 10.2)
    assert origin.turn(59.1, 10.2) == pytest.approx(np.eye(3))
    turn = origin.turn(59.15, 10.5)
    expected = numeric_axes(59.1, 10.2).T @ numeric_axes(59.15, 10.5)
    assert origin.axes(59.15, 10.5) == pytest.approx(expected, abs=1e-8)
    # Up to the tilt of the vertical, a height of 20 km over the radius of the Earth.
    assert turn == pytest.approx(expected, abs=20.0 / 6371.0)
    assert turn[:2, :2] == pytest.approx(expected[:2, :2], abs=1e-5)
    assert turn @ turn.T == pytest.approx(np.eye(3), abs=1e-12)
    # The meridians converge: what is east there points a little north here.
    assert math.degrees(math.atan2(turn[1, 0], turn[0, 0])) == pytest.approx(0.257, abs=0.005)


@pytest.mark.parametrize('place', PLACES)
def test_a_place_without_height_lies_on_the_ellipsoid_and_not_in_the_plane(place):
    """In the plane 100 km away: 785 m above the ellipsoid, 12 m too near to the origin."""
    origin = Origin(*place)
    there, expected = [], []
    for north, east in ((0.0, 0.0), (0.9, 0.2), (-0.3, 1.1), (6.0, -4.0)):
        latitude, longitude = place[0] + north, place[1] + east
        step = earth(latitude, longitude, place[2] - 3.0) - earth(*place)
        there.append((numeric_axes(*place).T @ step)[:2])
        expected.append(earth(latitude, longitude, place[2] - 3.0))
    found = origin.at_height(np.array(there), -3.0)
    assert [earth(*each) for each in found] == [pytest.approx(e, abs=0.01) for e in expected]
    assert found[:, 2] == pytest.approx(place[2] - 3.0, abs=1e-3)
    longitude, latitude = origin.degrees(np.array([[*there[1], np.nan], [1e5, 0.0, -785.0]]))
    assert latitude[0] == pytest.approx(found[1, 0], abs=1e-6)
    assert [latitude[1], longitude[1]] == pytest.approx(origin.geodetic([1e5, 0.0, -785.0])[:2])
    assert origin.at_height(np.array([3.0, 4.0])).shape == (3,)
    assert np.isnan(origin.at_height(np.array([[1e7, 0.0]]))).all()


# -- a relative fix with the vessel's pose against draws of every error ---------------------------

NOTHING = np.zeros((3, 3))
VESSEL = Pose(np.array([1.0, 2.0, 3.0]), rotation(0.1, -0.05, 0.8))
MOUNT = Mounting(np.array([2.0, -1.0, -3.0]), rotation(0.0, 0.1, -0.4), 0.05)
POSITION = np.diag([1.0, 0.5, 0.2]) + 0.1
ATTITUDE = np.diag(np.radians([0.5, 0.4, 2.0])) ** 2 + 1e-5
OFFSET = np.array([150.0, 60.0, -40.0])
STD = {'range_std': 0.1, 'angle_std': np.radians(2.0)}


def truth(levelled=False):
    seen = OFFSET if levelled else VESSEL.R @ MOUNT.R @ OFFSET
    return VESSEL.position + VESSEL.R @ MOUNT.lever + seen


def claimed(levelled=False, covariance=None):
    """What is stated of the place of a target measured without an error."""
    known = VESSEL, Uncertainty(POSITION, ATTITUDE), MOUNT, OFFSET, covariance
    return place(*known, levelled=levelled, **STD).covariance


def test_what_is_certain_adds_nothing_and_place_and_lever_what_they_are_uncertain_by():
    std = {'range_std': 1.0, 'angle_std': 1.0}
    sure, loose = Mounting(MOUNT.lever, MOUNT.R), Mounting(MOUNT.lever, MOUNT.R, 0.3)
    placed = place(VESSEL, Uncertainty(NOTHING, NOTHING), sure, OFFSET, NOTHING, **std)
    assert placed.position == pytest.approx(truth())
    assert not placed.covariance.any()
    placed = place(VESSEL, Uncertainty(POSITION, NOTHING), loose, OFFSET, NOTHING, **std)
    assert placed.covariance == pytest.approx(POSITION + 0.09 * np.eye(3))


def draws(count, rng, *, levelled=False, angle_std=STD['angle_std'], covariance=None):
    """Places found from measurements with every error drawn, and their stated covariances."""
    along = OFFSET / np.linalg.norm(OFFSET)
    aside = np.cross(along, [0.0, 0.0, 1.0])
    aside /= np.linalg.norm(aside)
    across = np.array([aside, np.cross(along, aside)])
    found, stated = [], []
    for _ in range(count):
        turn = Rotation.from_rotvec(rng.multivariate_normal(np.zeros(3), ATTITUDE)).as_matrix()
        position = VESSEL.position + rng.multivariate_normal(np.zeros(3), POSITION)
        mount = Mounting(MOUNT.lever, MOUNT.R, MOUNT.lever_std)
        if covariance is None:
            bent = Rotation.from_rotvec(angle_std * rng.normal(size=2) @ across).apply(OFFSET)
            offset = bent * (1.0 + 0.1 * rng.normal() / np.linalg.norm(OFFSET))
        else:
            offset = OFFSET + rng.multivariate_normal(np.zeros(3), covariance)
        # The lever is off too: what is measured lies beside where it is said to be.
        slip = VESSEL.R @ (MOUNT.lever_std * rng.normal(size=3))
        placed = place(
            Pose(position + slip, turn @ VESSEL.R), Uncertainty(POSITION, ATTITUDE), mount, offset,
            covariance, range_std=0.1, angle_std=angle_std, levelled=levelled,
        )  # fmt: skip
        found.append(placed.position)
        stated.append(placed.covariance)
    return np.array(found), np.array(stated)


@pytest.mark.statistics
@pytest.mark.parametrize('levelled', [False, True])
@pytest.mark.parametrize('covariance', [None, np.diag([4.0, 9.0, 1.0]) + 0.5])
def test_mean_and_covariance_are_those_of_the_draws(levelled, covariance):
    rng = np.random.default_rng(1)
    count = 6000
    found, stated = draws(count, rng, levelled=levelled, covariance=covariance)
    error = found - truth(levelled)
    spread = np.cov(error.T)
    assert (np.abs(error.mean(axis=0)) < 4.0 * np.sqrt(np.diag(spread) / count)).all()
    C = claimed(levelled, covariance)
    scale = np.sqrt(np.outer(np.diag(C), np.diag(C)))
    assert np.abs((spread - C) / scale).max() < 0.08
    nees = np.einsum('ki,kij,kj->k', error, np.linalg.inv(stated), error)
    # What is stated turns with what was measured, which costs a tenth.
    assert 2.8 < nees.mean() < 3.4


@pytest.mark.statistics
def test_along_the_line_of_sight_the_bend_counts():
    """To first order alone a sonar good to .1 m in range would claim it of the place."""
    found, _ = draws(4000, np.random.default_rng(2))
    arm = truth() - VESSEL.position
    along = arm / np.linalg.norm(arm)
    std = np.sqrt(along @ (claimed() - POSITION) @ along)
    assert std > 0.3
    spread = np.cov((found - truth()).T) - POSITION
    assert np.sqrt(along @ spread @ along) == pytest.approx(std, rel=0.15)


def test_jacobian_of_the_attitude():
    """The covariance to first order against differences of the place."""
    tiny = np.diag([1e-12, 4e-12, 9e-12])
    exact = {'range_std': 1e-9, 'angle_std': 1e-9}
    C = place(VESSEL, Uncertainty(NOTHING, tiny), MOUNT, OFFSET, NOTHING, **exact).covariance
    C = C - MOUNT.lever_std**2 * np.eye(3)
    columns = []
    for axis in np.eye(3):
        step = 1e-6 * axis
        turned = [
            VESSEL.position
            + Rotation.from_rotvec(sign * step).as_matrix() @ (truth() - VESSEL.position)
            for sign in (1.0, -1.0)
        ]
        columns.append((turned[0] - turned[1]) / 2e-6)
    J = np.array(columns).T
    assert C == pytest.approx(J @ tiny @ J.T, rel=1e-4, abs=1e-13)


def test_a_target_at_the_transceiver_has_a_covariance():
    known = VESSEL, Uncertainty(NOTHING, NOTHING), MOUNT, np.zeros(3), None
    placed = place(*known, range_std=0.5, angle_std=0.1)
    assert placed.covariance == pytest.approx((0.25 + 0.0025) * np.eye(3))


# -- the polar conversion against quadrature and in use -------------------------------------------

SIGMA_RANGE, SIGMA_BEARING = 0.1, np.radians(2.0)


def measured(truth, runs, seed):
    """Noisy ranges and bearings (runs,) of one true position."""
    rng = np.random.default_rng(seed)
    return (
        np.hypot(*truth) + SIGMA_RANGE * rng.standard_normal(runs),
        np.arctan2(truth[1], truth[0]) + SIGMA_BEARING * rng.standard_normal(runs),
    )


def nees(truth, positions, covariances):
    gap = truth - positions
    return np.einsum('ni,ni->n', gap, np.linalg.solve(covariances, gap[..., None])[..., 0])


@pytest.mark.parametrize('variance', [1e-6, 0.01, 0.5])
def test_moments_equal_quadrature_over_the_truth_given_the_measurement(variance):
    r, angle, var_range = 30.0, 2.3, 4.0
    nodes, weights = np.polynomial.hermite_e.hermegauss(80)
    weights = weights / weights.sum()
    ranges = r - np.sqrt(var_range) * nodes[:, None]
    bearings = angle - np.sqrt(variance) * nodes[None, :]
    points = np.stack([ranges * np.cos(bearings), ranges * np.sin(bearings)], axis=-1)
    weight = weights[:, None] * weights[None, :]
    mean = (weight[..., None] * points).sum(axis=(0, 1))
    spread = points - mean
    covariance = np.einsum('ab,abi,abj->ij', weight, spread, spread)
    position, stated = unbiased_polar_to_cartesian(r, angle, var_range, variance)
    assert_allclose(position, mean, rtol=1e-10)
    assert_allclose(stated, covariance, rtol=1e-8, atol=1e-10)


@settings(max_examples=100, derandomize=True, deadline=None)
@given(
    r=st.floats(0.0, 1e5),
    b=st.floats(-10.0, 10.0),
    sr=st.floats(1e-3, 100.0),
    sb=st.floats(1e-5, 2.0),
)
def test_covariance_is_positive_definite_and_turns_with_the_scene(r, b, sr, sb):
    position, covariance = unbiased_polar_to_cartesian(r, 0.0, sr**2, sb**2)
    turn = rotation(0.0, 0.0, b)[:2, :2]
    turned_position, turned = unbiased_polar_to_cartesian(r, b, sr**2, sb**2)
    scale = np.abs(covariance).max()
    assert (np.diag(covariance) > 0.0).all() and covariance[0, 1] == 0.0
    assert_allclose(turned_position, turn @ position, atol=1e-9 * (1.0 + r))
    assert_allclose(turned, turn @ covariance @ turn.T, atol=1e-12 * scale)


def test_no_bearing_noise_and_broadcasting():
    position, covariance = unbiased_polar_to_cartesian([[10.0], [20.0]], [0.0, 1.0, 2.0], 4.0, 0.0)
    assert position.shape == (2, 3, 2) and covariance.shape == (2, 3, 2, 2)
    assert_allclose(position[1, 0], [20.0, 0.0])
    assert_allclose(covariance[1, 0], [[4.0, 0.0], [0.0, 0.0]])


def test_nees_at_long_range_is_right():
    truth, runs = np.array([120.0, -160.0]), 4000
    r, b = measured(truth, runs, seed=3)
    low, high = chi2.ppf([0.025, 0.975], 2 * runs) / runs
    variances = (SIGMA_RANGE**2, SIGMA_BEARING**2)
    right = nees(truth, *unbiased_polar_to_cartesian(r, b, *variances)).mean()
    # Along the line of sight the error is itself a square: heavier tails, wider bounds.
    assert 0.95 * low < right < 1.05 * high
