# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Directions of soundings, their uncertainty, and rays: vectors, closed forms, their inverse."""

from helpers.vector_files import load_vectors
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from sonar_imm.acoustics import array, geometry, sounding
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.acoustics.rays import launch_table, look_up, profile_of, profile_problem, trace
from sonar_imm.acoustics.sounding import ErrorBudget


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
        assert (look.psi, look.C) == (
            pytest.approx(row['psi'], abs=1e-6),
            pytest.approx(row['C'], abs=1e-6),
        )
        assert sounding.beam_angle(n, side) == pytest.approx(row['beam_angle'], abs=1e-6)
        depth, distance = -(point - look.position)[2], np.hypot(*(point - look.position)[:2])
        vertical, horizontal = sounding.uncertainties(
            row['var_filter'], depth, distance, budget, speed
        )
        assert vertical == pytest.approx(row['vertical_uncertainty'], abs=1e-6)
        assert horizontal == pytest.approx(row['horizontal_uncertainty'], abs=1e-6)


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
    vertical, horizontal = sounding.uncertainties(
        np.array([0.01, 0.01]), np.array([15.0, 0.0]), np.array([0.0, 50.0]), budget, 1500.0
    )
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


SUMMER = (0.0, 1520.0, 5.0, 1518.0, 10.0, 1505.0, 15.0, 1495.0, 30.0, 1490.0)


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


@pytest.mark.parametrize(
    'pairs, word',
    [
        ([], 'in turn'),
        ([0.0, 1500.0, 5.0], 'in turn'),
        ([5.0, 1500.0, 5.0, 1501.0], 'increasing'),
        ([0.0, 150.0], 'between'),
        ([float('nan'), 1500.0, 5.0, 1500.0], 'increasing'),
        ([0.0, float('nan')], 'between'),
    ],
)
def test_lists_that_are_no_profile_are_refused_by_one_sentence(pairs, word):
    assert word in profile_problem(pairs)
    with pytest.raises(ValueError, match=word):
        profile_of(pairs)
