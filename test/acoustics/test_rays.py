# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

from helpers.vector_files import load_vectors
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from sonar_imm.acoustics.rays import launch_table, look_up, profile_of, profile_problem, trace

SUMMER = (0.0, 1520.0, 5.0, 1518.0, 10.0, 1505.0, 15.0, 1495.0, 30.0, 1490.0)


def cases():
    case = load_vectors('bathymetry_sea/rays')
    for number, row in enumerate(case.pop('profile')):
        chosen = case['profile_id'] == number
        yield (
            row[np.isfinite(row)].tolist(),
            {name: values[chosen] for name, values in case.items()},
        )


def test_rays_are_those_of_an_independent_integration():
    for pairs, case in cases():
        found = trace(profile_of(pairs), case['depth0'], case['launch'], case['time'])
        assert found.depth == pytest.approx(case['depth'], abs=1e-5)
        assert found.distance == pytest.approx(case['distance'], abs=1e-5)
        assert found.elevation == pytest.approx(case['elevation'], abs=1e-5)


def test_rays_keep_snells_constant_and_can_be_walked_back():
    profile = profile_of(SUMMER)
    launch = np.radians(np.linspace(-80.0, 80.0, 65))
    there = trace(profile, 7.0, launch, 0.05)
    constant = np.cos(launch) / profile.at(7.0)
    assert np.cos(there.elevation) / profile.at(there.depth) == pytest.approx(constant, rel=1e-9)
    back = trace(profile, there.depth, -there.elevation, 0.05)
    assert back.depth == pytest.approx(np.full(65, 7.0), abs=1e-7)
    assert back.distance == pytest.approx(there.distance, abs=1e-7)


def test_a_ray_turns_where_the_speed_has_grown_by_its_cosine():
    # c = 1480 + z: a ray from z = 0 at 5 degrees turns at c = 1480 / cos 5 deg.
    profile = profile_of([0.0, 1480.0, 200.0, 1680.0])
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
    for pairs in (
        [0, 1480, 10, 1500, 20, 1480],
        [0, 1500, 10, 1480, 20, 1500],
        [0, 1500, 9, 1500],
    ):
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


def table_at(table, r, depth):
    k, i = r / table.range_step, (depth - table.first_depth) / table.depth_step
    k0, i0 = int(k), np.floor(i).astype(int)
    f, g = k - k0, i - i0
    rows = table.value[k0 : k0 + 2]
    return (1 - f) * ((1 - g) * rows[0, i0] + g * rows[0, i0 + 1]) + f * (
        (1 - g) * rows[1, i0] + g * rows[1, i0 + 1]
    )


def test_the_launch_table_undoes_the_rays():
    profile = profile_of(SUMMER)
    table = launch_table(profile, 5.0, 77.0, 1500.0)
    for r in (17.3, 40.0, 60.7, 76.9):
        steep = 80.0 if r < 40.0 else 50.0
        launch = np.radians(np.linspace(8.0, steep, 60))
        depth = trace(profile, 5.0, launch, r / 1500.0).depth - 5.0
        assert table_at(table, r, depth) == pytest.approx(r * np.sin(launch), abs=0.01)


def test_the_launch_table_of_straight_rays_is_the_depth():
    table = launch_table(profile_of([0.0, 1500.0]), 5.0, 77.0, 1500.0)
    depth = np.linspace(-11.0, 29.0, 50)  # also beyond straight down, where it says r sin > r
    for r in (0.3 * table.range_step, 12.5):
        assert table_at(table, r, depth) == pytest.approx(depth, abs=1e-9)


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
