# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

from helpers.vector_files import load_vectors
import numpy as np
import pytest

from sonar_imm.acoustics import array, geometry, sounding
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.acoustics.sounding import ErrorBudget


def rows():
    table = load_vectors('bathymetry_sea/pose_table')
    s_att, s_head, *rest = table.pop('tpu')
    budget = ErrorBudget(
        attitude=np.radians(s_att), heading=np.radians(s_head), heave=rest[0], position=rest[1],
        sound_speed=rest[2],
    )  # fmt: skip
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


def test_rolling_to_starboard_lets_the_starboard_array_look_deeper():
    axes = sounding.array_axes('starboard', np.radians(30.0), np.eye(3))
    rolled = Pose(np.zeros(3), geometry.rotation(np.radians(5.0), 0.0, 0.0))
    assert sounding.looks(axes, np.zeros(3), rolled, rolled).psi == pytest.approx(np.radians(35.0))
    port = sounding.array_axes('port', np.radians(30.0), np.eye(3))
    assert sounding.looks(port, np.zeros(3), rolled, rolled).psi == pytest.approx(np.radians(25.0))


def test_attitude_is_that_of_reception_and_position_the_mean():
    axes = sounding.array_axes('port', 0.5, np.eye(3))
    sent = Pose(np.array([0.0, 0.0, 1.0]), np.eye(3))
    received = Pose(
        np.array([[2.0, 0.0, 1.0], [4.0, 0.0, 3.0]]),
        geometry.rotation(np.array([0.0, 0.1]), np.zeros(2), np.zeros(2)),
    )
    look = sounding.looks(axes, np.array([0.0, 0.0, -1.0]), sent, received)
    assert look.position[0] == pytest.approx([1.0, 0.0, 0.0])
    assert look.position[1] == pytest.approx([2.0, 0.5 * np.sin(0.1), 1.5 - 0.5 * np.cos(0.1)])
    assert look.psi == pytest.approx([0.5, 0.4])


def test_the_budget_is_finite_straight_below_and_infinite_where_the_depth_says_nothing():
    budget = ErrorBudget(attitude=1e-3, heading=1e-3, heave=0.05, position=0.1, sound_speed=0.5)
    vertical, horizontal = sounding.uncertainties(
        np.array([0.01, 0.01]), np.array([15.0, 0.0]), np.array([0.0, 50.0]), budget, 1500.0
    )
    assert np.isfinite(horizontal).all() and np.isfinite(vertical[0])
    assert vertical[1] == np.inf


def test_what_the_geometry_leaves_open_is_that_of_the_vectors():
    case = load_vectors('bathymetry_by_default/array')
    elevation = np.arcsin(15.0 / case['r'])
    parts = {
        'variance': (0.2, 0.01, 2.0),
        'tilt': (0.2, 0.0, 0.0),
        'spacing': (0.0, 0.01, 0.0),
        'speed': (0.0, 0.0, 2.0),
    }
    for name, (tilt, spacing, speed) in parts.items():
        doubt = sounding.GeometryDoubt(np.radians(tilt), spacing, speed / 1500.0)
        vertical, _ = sounding.geometry_variance(
            np.full(len(elevation), 15.0),
            case['r'] * np.cos(elevation),
            elevation - np.radians(30.0),
            doubt,
        )
        assert vertical == pytest.approx(case[f'common_{name}'], rel=1e-9), name


def test_what_the_geometry_leaves_open_is_what_an_error_does():
    """Seen by an array of another tilt and spacing through water of another speed."""
    r, tilt = np.array([20.0, 40.0, 70.0]), np.radians(30.0)
    elevation = np.arcsin(15.0 / r)
    wrong = {'tilt': 1e-6, 'spacing': 1e-6, 'sound_speed': 1e-6}
    for name, error in wrong.items():
        told = dict.fromkeys(wrong, 0.0) | {name: error}
        u = np.sin(elevation - tilt) * (1.0 + told['spacing'] + told['sound_speed'])
        seen = np.arcsin(u) + tilt + told['tilt']
        slant = r * (1.0 + told['sound_speed'])
        dz = slant * np.sin(seen) - 15.0
        dy = slant * np.cos(seen) - r * np.cos(elevation)
        vertical, horizontal = sounding.geometry_variance(
            np.full(3, 15.0),
            r * np.cos(elevation),
            elevation - tilt,
            sounding.GeometryDoubt(**told),
        )
        assert np.sqrt(vertical) == pytest.approx(np.abs(dz), rel=1e-3)
        assert np.sqrt(horizontal) == pytest.approx(np.abs(dy), rel=1e-3)
