# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Frames, projection, prediction, places, soundings and rays: tables made elsewhere, vectors,
closed forms, their inverse."""

import math
from pathlib import Path

from helpers.vector_files import load_vectors
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.spatial.transform import Rotation, Slerp

from sonar_imm.acoustics import array, geometry, sounding
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.acoustics.geometry import Pose, rotation
from sonar_imm.acoustics.polar import unbiased_polar_to_cartesian
from sonar_imm.acoustics.rays import launch_table, look_up, profile_of, profile_problem, trace
from sonar_imm.acoustics.relative_position import Mounting, place, Uncertainty
from sonar_imm.acoustics.sounding import ErrorBudget

VECTORS = Path(__file__).parents[1] / 'vectors' / 'obstacle'
EXACT = {'rtol': 0.0, 'atol': 1e-9}
A, F = 6378137.0, 1.0 / 298.257223563
E2 = F * (2.0 - F)
PLACES = [(59.1, 10.2, 0.0), (-33.9, 151.2, 20.0), (0.001, -179.9999, -5.0), (78.2, 15.6, 3.0)]
SUMMER = (0.0, 1520.0, 5.0, 1518.0, 10.0, 1505.0, 15.0, 1495.0, 30.0, 1490.0)


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


def sonar_pose(rows):
    """The sonar in NED, from vehicle pose, lever and mount."""
    turn = geometry.rotation(rows['roll'], rows['pitch'], rows['yaw'])
    vehicle = Pose(columns(rows, 'nav_n', 'nav_e', 'nav_d'), turn)
    mount = geometry.rotation(rows['mount_roll'], rows['mount_pitch'], rows['mount_yaw'])
    return geometry.mounted(vehicle, columns(rows, 'lever_x', 'lever_y', 'lever_z'), mount)


def test_rotations_of_both_worlds():
    rows = table('rotation_table')
    angles = np.radians(columns(rows, 'roll_deg', 'pitch_deg', 'yaw_deg'))
    R, due, q = geometry.rotation(*angles.T), {}, {}
    for world in ('ned', 'enu'):
        names = [f'R{world}{i}{j}' for i in range(3) for j in range(3)]
        due[world] = columns(rows, *names).reshape(-1, 3, 3)
        q[world] = columns(rows, *(f'q{world}_{part}' for part in 'xyzw'))
        assert_allclose(geometry.rotation_of_quaternion(3.0 * q[world]), due[world], **EXACT)
    assert_allclose(R, due['ned'], **EXACT)
    assert_allclose(geometry.flip_rotation(R), due['enu'], **EXACT)
    for first, other in ((q['ned'], q['enu']), (q['enu'], q['ned'])):
        same = geometry.flip_quaternion(first)  # q and -q are the same rotation
        same *= np.sign(np.sum(same * other, axis=1, keepdims=True))
        assert_allclose(same, other, **EXACT)
    enu_angles = geometry.euler_angles(due['enu'])
    stated = columns(rows, 'rpy_enu_r', 'rpy_enu_p', 'rpy_enu_y')
    assert_allclose(np.exp(1j * enu_angles), np.exp(1j * stated), **EXACT)
    ros = np.column_stack([angles[:, 0], -angles[:, 1], 0.5 * np.pi - angles[:, 2]])
    assert_allclose(np.exp(1j * enu_angles), np.exp(1j * ros), **EXACT)


def test_sonar_pose_from_vehicle_lever_and_mount(seen):
    """Odometry in ENU and FLU, with lever and mount in FLU, is the same sonar."""
    due = sonar_pose(seen)
    assert_allclose(due.position, columns(seen, 'sonar_n', 'sonar_e', 'sonar_d'), **EXACT)
    assert_allclose(due.R[:, 2], columns(seen, 'n_x', 'n_y', 'n_z'), **EXACT)
    turn = geometry.rotation_of_quaternion(columns(seen, 'qx', 'qy', 'qz', 'qw'))
    vehicle = Pose(columns(seen, 'odom_x', 'odom_y', 'odom_z'), turn)
    lever = geometry.flip_body(columns(seen, 'lever_x', 'lever_y', 'lever_z'))
    # In FLU the same mount is turned by roll, -pitch, -yaw.
    mount = geometry.rotation(seen['mount_roll'], -seen['mount_pitch'], -seen['mount_yaw'])
    ours = geometry.mounted(vehicle, lever, mount)
    assert_allclose(geometry.flip_world(ours.position), due.position, **EXACT)
    assert_allclose(geometry.flip_rotation(ours.R), due.R, **EXACT)
    enu = geometry.flip_world(columns(seen, 'obst_enu_x', 'obst_enu_y', 'obst_enu_z'))
    assert_allclose(enu, columns(seen, 'obst_n', 'obst_e', 'obst_d'), **EXACT)


@pytest.mark.parametrize('model', geometry.AZIMUTH_MODELS)
def test_projection_and_its_inverse(seen, model):
    pose, obstacle = sonar_pose(seen), columns(seen, 'obst_n', 'obst_e', 'obst_d')
    m = geometry.to_body(pose, obstacle)
    assert_allclose(m, columns(seen, 'm_x', 'm_y', 'm_z'), **EXACT)
    d, delta = geometry.project(m, model)
    assert_allclose(d, seen['d'], **EXACT)
    assert_allclose(delta, seen[f'delta_{model}'], **EXACT)
    assert_allclose(geometry.vertical_offset(m, pose.R), seen['d_st'], **EXACT)
    back = geometry.reconstruct(seen['d'], seen[f'delta_{model}'], seen['d_st'], pose.R, model)
    assert_allclose(back, m, **EXACT)
    assert_allclose(geometry.to_world(pose, back), obstacle, **EXACT)
    # An obstacle further off than its range is infeasible.
    level = geometry.rotation(0.0, 0.0, 0.3)
    assert np.isnan(geometry.reconstruct(10.0, 0.1, 10.01, level, model)).any()
    assert np.isfinite(geometry.reconstruct(10.0, 0.1, 9.9, level, model)).all()


def two_poses(rows):
    lever = columns(rows, 'lever_x', 'lever_y', 'lever_z')
    for i in (0, 1):
        turn = geometry.rotation(rows[f'roll{i}'], rows[f'pitch{i}'], rows[f'yaw{i}'])
        vehicle = Pose(columns(rows, f'n{i}', f'e{i}', f'd{i}'), turn)
        yield geometry.mounted(vehicle, lever, np.eye(3))


@pytest.mark.parametrize('model', geometry.AZIMUTH_MODELS)
def test_exact_prediction(model):
    moved = table('prediction')
    before, after = two_poses(moved)
    known = moved['range0'], moved[f'delta_{model}0'], moved['dst0']
    m1 = geometry.predict(geometry.reconstruct(*known, before.R, model), before, after)
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


@pytest.mark.parametrize('place', PLACES)
def test_metres_are_those_of_the_ellipsoid_and_come_back(place):
    origin = Origin(*place)
    rng = np.random.default_rng(3)
    many = rng.normal(scale=1e4, size=(3, 3)) * [1.0, 1.0, 0.001]
    for enu, found in zip(many, origin.geodetic(many)):
        there = earth(*place) + numeric_axes(*place) @ enu
        assert earth(*found) == pytest.approx(there, abs=2e-3)
        assert origin.local(*found) == pytest.approx(enu, abs=1e-6)
        assert origin.geodetic(enu) == pytest.approx(found)
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
    for north, east in ((0.0, 0.0), (0.9, 0.2), (6.0, -4.0)):
        expected.append(earth(place[0] + north, place[1] + east, place[2] - 3.0))
        there.append((numeric_axes(*place).T @ (expected[-1] - earth(*place)))[:2])
    found = origin.at_height(np.array(there), -3.0)
    assert [earth(*each) for each in found] == [pytest.approx(e, abs=0.01) for e in expected]
    assert found[:, 2] == pytest.approx(place[2] - 3.0, abs=1e-3)
    longitude, latitude = origin.degrees(np.array([[*there[1], np.nan], [1e5, 0.0, -785.0]]))
    assert latitude[0] == pytest.approx(found[1, 0], abs=1e-6)
    assert [latitude[1], longitude[1]] == pytest.approx(origin.geodetic([1e5, 0.0, -785.0])[:2])
    assert origin.at_height(np.array([3.0, 4.0])).shape == (3,)
    assert np.isnan(origin.at_height(np.array([[1e7, 0.0]]))).all()


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


def draws(count, rng, *, levelled=False, covariance=None):
    """Errors (count, 3) of places found from measurements with every error drawn, and their stated
    covariances."""
    along = OFFSET / np.linalg.norm(OFFSET)
    aside = np.cross(along, [0.0, 0.0, 1.0])
    aside /= np.linalg.norm(aside)
    across, nothing = np.array([aside, np.cross(along, aside)]), np.zeros(3)
    found, stated = [], []
    for _ in range(count):
        turn = Rotation.from_rotvec(rng.multivariate_normal(nothing, ATTITUDE)).as_matrix()
        position = VESSEL.position + rng.multivariate_normal(nothing, POSITION)
        if covariance is None:
            bent = Rotation.from_rotvec(STD['angle_std'] * rng.normal(size=2) @ across)
            offset = bent.apply(OFFSET) * (1.0 + 0.1 * rng.normal() / np.linalg.norm(OFFSET))
        else:
            offset = OFFSET + rng.multivariate_normal(nothing, covariance)
        # The lever is off too: what is measured lies beside where it is said to be.
        slip = VESSEL.R @ (MOUNT.lever_std * rng.normal(size=3))
        vessel = Pose(position + slip, turn @ VESSEL.R), Uncertainty(POSITION, ATTITUDE)
        placed = place(*vessel, MOUNT, offset, covariance, levelled=levelled, **STD)
        found.append(placed.position - truth(levelled))
        stated.append(placed.covariance)
    return np.array(found), np.array(stated)


@pytest.mark.statistics
@pytest.mark.parametrize('levelled', [False, True])
@pytest.mark.parametrize('covariance', [None, np.diag([4.0, 9.0, 1.0]) + 0.5])
def test_mean_and_covariance_are_those_of_the_draws(levelled, covariance):
    count, rng = 6000, np.random.default_rng(1)
    error, stated = draws(count, rng, levelled=levelled, covariance=covariance)
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
    spread = np.cov(draws(4000, np.random.default_rng(2))[0].T)
    along = (truth() - VESSEL.position) / np.linalg.norm(truth() - VESSEL.position)
    std, seen = (np.sqrt(along @ (each - POSITION) @ along) for each in (claimed(), spread))
    assert std > 0.3 and seen == pytest.approx(std, rel=0.15)


def test_jacobian_of_the_attitude():
    """The covariance to first order against differences of the place."""
    tiny, step = np.diag([1e-12, 4e-12, 9e-12]), 1e-6
    exact = {'range_std': 1e-9, 'angle_std': 1e-9}
    C = place(VESSEL, Uncertainty(NOTHING, tiny), MOUNT, OFFSET, NOTHING, **exact).covariance
    arm = truth() - VESSEL.position
    ahead, behind = (Rotation.from_rotvec(k * step * np.eye(3)).apply(arm) for k in (1, -1))
    J = (ahead - behind).T / (2.0 * step)
    due = J @ tiny @ J.T
    assert C - MOUNT.lever_std**2 * np.eye(3) == pytest.approx(due, rel=1e-4, abs=1e-13)
    # A target at the transceiver has a covariance.
    known = VESSEL, Uncertainty(NOTHING, NOTHING), MOUNT, np.zeros(3), None
    placed = place(*known, range_std=0.5, angle_std=0.1)
    assert placed.covariance == pytest.approx((0.25 + 0.0025) * np.eye(3))


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
@given(st.floats(0.0, 1e5), st.floats(-10.0, 10.0), st.floats(1e-3, 100.0), st.floats(1e-5, 2.0))
def test_covariance_is_positive_definite_and_turns_with_the_scene(r, b, sr, sb):
    position, covariance = unbiased_polar_to_cartesian(r, 0.0, sr**2, sb**2)
    turned_position, turned = unbiased_polar_to_cartesian(r, b, sr**2, sb**2)
    turn, scale = rotation(0.0, 0.0, b)[:2, :2], np.abs(covariance).max()
    assert (np.diag(covariance) > 0.0).all() and covariance[0, 1] == 0.0
    assert_allclose(turned_position, turn @ position, atol=1e-9 * (1.0 + r))
    assert_allclose(turned, turn @ covariance @ turn.T, atol=1e-12 * scale)


def test_no_bearing_noise_and_broadcasting():
    position, covariance = unbiased_polar_to_cartesian([[10.0], [20.0]], [0.0, 1.0, 2.0], 4.0, 0.0)
    assert position.shape == (2, 3, 2) and covariance.shape == (2, 3, 2, 2)
    assert_allclose(position[1, 0], [20.0, 0.0])
    assert_allclose(covariance[1, 0], [[4.0, 0.0], [0.0, 0.0]])


def rows():
    table = load_vectors('bathymetry_sea/pose_table')
    s_att, s_head, *rest = table.pop('tpu')
    names = ('attitude', 'heading', 'heave', 'position', 'sound_speed')
    budget = ErrorBudget(**dict(zip(names, (np.radians(s_att), np.radians(s_head), *rest))))
    speed = float(table.pop('sound_speed'))
    for k in range(len(table['p'])):
        yield {name: values[k] for name, values in table.items()}, budget, speed


def look_of(row):
    side = 'port' if row['side'] == 0 else 'starboard'
    axes = sounding.array_axes(side, row['tilt'], geometry.rotation(*row['mount']))
    pose = Pose(row['p'], geometry.rotation_of_quaternion(row['quaternion_xyzw']))
    return sounding.looks(axes, row['lever'], pose, pose), side


def test_the_pose_table():
    for row, budget, speed in rows():
        look, side = look_of(row)
        n = sounding.direction(look, row['u'])
        point = look.position + row['range'] * n
        assert look.position == pytest.approx(row['sonar'], abs=1e-9)
        assert point == pytest.approx(row['point'], abs=1e-6)
        assert (look.psi, look.C) == pytest.approx((row['psi'], row['C']), abs=1e-6)
        assert sounding.beam_angle(n, side) == pytest.approx(row['beam_angle'], abs=1e-6)
        depth, distance = -(point - look.position)[2], np.hypot(*(point - look.position)[:2])
        found = sounding.uncertainties(row['var_filter'], depth, distance, budget, speed)
        due = row['vertical_uncertainty'], row['horizontal_uncertainty']
        assert found == pytest.approx(due, abs=1e-6)


def test_height_gives_back_the_direction_sine_also_with_pitch():
    """C belongs into the formula: without it a pitched array is wrong."""
    without = []
    for row, _, _ in rows():
        look, _ = look_of(row)
        s = (look.position[2] - row['point'][2]) / (row['range'] * look.C)
        u = array.direction_sine(s * row['range'], row['range'], look.psi)
        # Two directions of the fan have one height: the formula gives the one nearer to broadside.
        if abs(np.arcsin(row['u']) + look.psi) <= 0.5 * np.pi:
            assert u == pytest.approx(row['u'], abs=1e-9)
            wrong = array.direction_sine(s * look.C * row['range'], row['range'], look.psi)
            without.append(abs(wrong - row['u']))
    assert len(without) > 40 and max(without) > 1e-3


def test_attitude_is_that_of_reception_and_position_the_mean():
    axes, ahead = sounding.array_axes('port', 0.5, np.eye(3)), np.zeros(3)
    sent = Pose(np.array([0.0, 0.0, 1.0]), np.eye(3))
    turn = geometry.rotation(np.array([0.0, 0.1]), np.zeros(2), np.zeros(2))
    received = Pose(np.array([[2.0, 0.0, 1.0], [4.0, 0.0, 3.0]]), turn)
    look = sounding.looks(axes, np.array([0.0, 0.0, -1.0]), sent, received)
    assert look.position[0] == pytest.approx([1.0, 0.0, 0.0])
    assert look.position[1] == pytest.approx([2.0, 0.5 * np.sin(0.1), 1.5 - 0.5 * np.cos(0.1)])
    # Rolling to starboard lets the starboard array look deeper, and the port one less deep.
    assert look.psi == pytest.approx([0.5, 0.4])
    axes = sounding.array_axes('starboard', 0.5, np.eye(3))
    assert sounding.looks(axes, ahead, sent, received).psi == pytest.approx([0.5, 0.6])


def test_the_budget_is_finite_straight_below_and_infinite_where_the_depth_says_nothing():
    budget = ErrorBudget(attitude=1e-3, heading=1e-3, heave=0.05, position=0.1, sound_speed=0.5)
    known = np.array([[0.01, 0.01], [15.0, 0.0], [0.0, 50.0]])
    vertical, horizontal = sounding.uncertainties(*known, budget, 1500.0)
    assert np.isfinite(horizontal).all() and np.isfinite(vertical[0])
    assert vertical[1] == np.inf


def test_what_the_geometry_leaves_open_is_that_of_the_vectors():
    case = load_vectors('bathymetry_by_default/array')
    elevation, depth = np.arcsin(15.0 / case['r']), np.full(len(case['r']), 15.0)
    known = depth, case['r'] * np.cos(elevation), elevation - np.radians(30.0)
    tilt, spacing, speed = (np.radians(0.2), 0, 0), (0, 0.01, 0), (0, 0, 2.0 / 1500.0)
    every = np.add(np.add(tilt, spacing), speed)
    parts = {'variance': every, 'tilt': tilt, 'spacing': spacing, 'speed': speed}
    for name, doubt in parts.items():
        vertical, _ = sounding.geometry_variance(*known, sounding.GeometryDoubt(*doubt))
        assert vertical == pytest.approx(case[f'common_{name}'], rel=1e-9), name


def test_what_the_geometry_leaves_open_is_what_an_error_does():
    """Seen by an array of another tilt and spacing through water of another speed."""
    r, down = np.array([20.0, 40.0, 70.0]), np.radians(30.0)
    elevation = np.arcsin(15.0 / r)
    known = np.full(3, 15.0), r * np.cos(elevation), elevation - down
    for tilt, spacing, speed in 1e-6 * np.eye(3):
        u = np.sin(elevation - down) * (1.0 + spacing + speed)
        seen, slant = np.arcsin(u) + down + tilt, r * (1.0 + speed)
        dz, dy = slant * np.sin(seen) - 15.0, slant * np.cos(seen) - r * np.cos(elevation)
        doubt = sounding.GeometryDoubt(tilt=tilt, spacing=spacing, sound_speed=speed)
        vertical, horizontal = sounding.geometry_variance(*known, doubt)
        assert np.sqrt(vertical) == pytest.approx(np.abs(dz), rel=1e-3)
        assert np.sqrt(horizontal) == pytest.approx(np.abs(dy), rel=1e-3)


def cases():
    case = load_vectors('bathymetry_sea/rays')
    for number, row in enumerate(case.pop('profile')):
        chosen = case['profile_id'] == number
        values = {name: values[chosen] for name, values in case.items()}
        yield row[np.isfinite(row)].tolist(), values


def test_rays_are_those_of_an_independent_integration():
    for pairs, case in cases():
        found = trace(profile_of(pairs), case['depth0'], case['launch'], case['time'])
        assert found.depth == pytest.approx(case['depth'], abs=1e-5)
        assert found.distance == pytest.approx(case['distance'], abs=1e-5)
        assert found.elevation == pytest.approx(case['elevation'], abs=1e-5)


def test_a_ray_turns_where_the_speed_has_grown_by_its_cosine():
    # c = 1480 + z: a ray from z = 0 at 5 degrees turns at c = 1480 / cos 5 deg.
    profile = profile_of([0.0, 1480.0, 200.0, 1680.0])
    assert profile.at(20.0) == 1500.0
    times = np.linspace(0.0, 0.2, 2001)
    depth = trace(profile, 0.0, np.radians(5.0), times).depth
    assert depth.max() == pytest.approx(1480.0 / np.cos(np.radians(5.0)) - 1480.0, abs=1e-4)
    circle = trace(profile, 0.0, np.radians(5.0), 0.05)
    radius = 1480.0 / np.cos(np.radians(5.0))
    x0 = radius * np.sin(np.radians(5.0))
    assert np.hypot(circle.distance - x0, circle.depth + 1480.0) == pytest.approx(radius)


def test_a_vertical_ray_takes_the_harmonic_mean_speed():
    time = np.log(1505.0 / 1518.0) / ((1505.0 - 1518.0) / 5.0)
    down = trace(profile_of(SUMMER), 5.0, 0.5 * np.pi, time)
    assert (down.depth, down.distance) == (pytest.approx(10.0), pytest.approx(0.0, abs=1e-9))
    up = trace(profile_of(SUMMER), 10.0, -0.5 * np.pi, time)
    assert up.depth == pytest.approx(5.0)


def test_grazing_rays_end():
    # Along a speed maximum, a speed minimum and in a layer of constant speed, exactly level.
    for speeds in ([1480, 1500, 1480], [1500, 1480, 1500], [1500, 1500]):
        pairs = [value for k, c in enumerate(speeds) for value in (10 * k, c)]
        found = trace(profile_of(pairs), [0.0, 9.0, 10.0, 20.0], 0.0, 0.5)
        assert np.isfinite(found.depth).all() and (found.distance > 600.0).all()


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.floats(1400.0, 1600.0), min_size=1, max_size=6),
    st.floats(-20.0, 80.0),
    st.floats(-1.57, 1.57),
    st.floats(0.0, 0.3),
)
def test_no_profile_makes_a_ray_faster_than_its_fastest_layer(speeds, depth, launch, time):
    pairs = [value for k, c in enumerate(speeds) for value in (10.0 * k, c)]
    found = trace(profile_of(pairs), depth, launch, time)
    far = np.hypot(found.depth - depth, found.distance)
    assert np.isfinite(far) and far <= max(speeds) * time * (1.0 + 1e-9) + 1e-9


def test_the_launch_table_undoes_the_rays():
    profile = profile_of(SUMMER)
    table = launch_table(profile, 5.0, 77.0, 1500.0)
    straight = launch_table(profile_of([0.0, 1500.0]), 5.0, 77.0, 1500.0)
    level = np.linspace(-11.0, 29.0, 50)  # also beyond straight down, where it says r sin > r
    for r, steep in ((17.3, 80.0), (40.0, 50.0), (76.9, 50.0)):
        launch = np.radians(np.linspace(8.0, steep, 60))
        depth = trace(profile, 5.0, launch, r / 1500.0).depth - 5.0
        assert table_at(table, r, depth) == pytest.approx(r * np.sin(launch), abs=0.01)
        # Of straight rays it is the depth.
        assert table_at(straight, r, level) == pytest.approx(level, abs=1e-9)


def table_at(table, r, depth):
    row = np.full(len(depth), r / table.range_step)
    return look_up(table.value, row, table.first_depth, table.depth_step, depth)


def test_between_cells_of_the_launch_table_there_is_a_bilinear_function():
    """In a table that is one there is no error anywhere, also in the second of two rows."""
    row, column = np.arange(4.0)[:, None], np.arange(6.0)
    table = 1.0 + 2.0 * row + 0.5 * column - 0.3 * row * column
    rng = np.random.default_rng(0)
    rows, columns = rng.uniform(0.0, 3.0, 50), rng.uniform(0.0, 5.0, 50)
    found = look_up(table, rows, 10.0, 0.25, 10.0 + 0.25 * columns)
    assert found == pytest.approx(1.0 + 2.0 * rows + 0.5 * columns - 0.3 * rows * columns)
    outside = look_up(table, np.ones(2), 10.0, 0.25, np.array([9.99, 11.26]))
    assert np.isnan(outside).all()


def test_where_rays_fold_back_nothing_is_heard():
    # Below a fast layer lies a shadow zone: no direct ray gets there.
    table = launch_table(profile_of([0.0, 1500.0, 10.0, 1500.0, 12.0, 1600.0]), 5.0, 150.0, 1500.0)
    row = table.value[140]
    assert np.isnan(row).any() and np.isfinite(row[-40:]).all()


@pytest.mark.parametrize('pairs, word', [
    ([], 'in turn'), ([0.0, 1500.0, 5.0], 'in turn'),
    ([5.0, 1500.0, 5.0, 1501.0], 'increasing'), ([0.0, 150.0], 'between'),
    ([float('nan'), 1500.0, 5.0, 1500.0], 'increasing'), ([0.0, float('nan')], 'between'),
])  # fmt: skip
def test_lists_that_are_no_profile_are_refused_by_one_sentence(pairs, word):
    assert word in profile_problem(pairs)
    with pytest.raises(ValueError, match=word):
        profile_of(pairs)
