# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Paths and angles in three dimensions: vectors, many states at once, numerical derivatives."""

from helpers.sea_vectors import vectors
import numpy as np
import pytest

from sonar_imm.acoustics.arrivals_3d import (
    arrival_angles,
    arrival_paths,
    BEARING,
    ELEVATION,
    HEIGHT,
    observe,
    ONE_WAY,
    PATH,
)


def test_the_paths_of_the_vectors():
    v = vectors('arrivals_3d')
    got, jacobian = arrival_paths(v['position'], v['tx'], v['rx']), v['out_jacobian']
    np.testing.assert_allclose(got.length, v['out_path'], atol=1e-9)
    np.testing.assert_allclose(got.by_position, jacobian[:, :3], atol=1e-9)
    for r in range(4):
        np.testing.assert_allclose(got.by_offset[r], jacobian[r, 3 + 2 * r : 5 + 2 * r], atol=1e-9)
        assert jacobian[r, 13 + r] == got.by_clock[r]
    np.testing.assert_allclose(got.by_sound_speed, jacobian[:, 17], atol=1e-9)


def test_the_angles_of_the_vectors():
    v = vectors('usbl')
    bearing, by_bearing, elevation, by_elevation = arrival_angles(
        v['position'], v['receiver'][None]
    )
    assert bearing[0] == pytest.approx(float(v['out_bearing']), abs=1e-9)
    assert elevation[0] == pytest.approx(float(v['out_elevation']), abs=1e-9)
    np.testing.assert_allclose(by_bearing[0], v['out_jacobian_bearing'], atol=1e-9)
    np.testing.assert_allclose(by_elevation[0], v['out_jacobian_elevation'], atol=1e-9)
    leg = arrival_paths(v['position'], None, v['receiver'][None])
    assert leg.length[0] == pytest.approx(float(v['out_range']), abs=1e-9)
    np.testing.assert_allclose(leg.by_position[0], v['out_jacobian_range'], atol=1e-9)


COLUMNS = np.array([0, 1, 3, 5, 7, 8, 9])
STATE = np.array([31.0, -12.0, 0.7, -9.0, 0.1, 0.6, -0.4, 0.8, 0.003, 4.0])


def seen(kind, states, tx, rx, columns=COLUMNS, height=0.0):
    """What one measurement of a kind expects at states (L, n): values (L,), gradients (L, n)."""
    one = np.array([kind]), columns[None], tx[None], rx[None]
    value, gradient = observe(np.atleast_2d(states).T, height, *one)
    return value[0], gradient[0].T


@pytest.mark.parametrize('kind', [PATH, ONE_WAY, BEARING, ELEVATION, HEIGHT])
def test_the_form_for_many_states_equals_the_plain_one_and_its_gradient_the_differences(kind):
    tx, rx = np.array([0.0, 0.0, -3.0]), np.array([70.0, 10.0, -5.0])
    (value,), (gradient,) = seen(kind, STATE, tx, rx)
    place = STATE[[0, 1, 3]]
    angles = arrival_angles(place, rx[None])
    errors = {'offset': STATE[5:7], 'clock': STATE[7], 'sound_speed_error': STATE[8]}
    expected = {
        PATH: arrival_paths(place, tx, rx[None], **errors).length[0],
        ONE_WAY: arrival_paths(place, None, rx[None], **errors).length[0] + STATE[9],
        BEARING: angles[0][0] + STATE[7],  # an error of all bearings has the place of a clock
        ELEVATION: angles[2][0],
        HEIGHT: STATE[3],
    }[kind]
    assert value == pytest.approx(expected, abs=1e-12)
    step = 1e-6 * np.eye(10)
    ahead, behind = seen(kind, STATE + step, tx, rx)[0], seen(kind, STATE - step, tx, rx)[0]
    # angles have no gradient by the offset of the receiver: it is metres among tens
    np.testing.assert_allclose(gradient, (ahead - behind) / 2e-6, atol=1e-7)


def test_measurements_of_all_kinds_at_once_are_those_of_each_kind():
    """Each with errors of its own receiver, or none."""
    kind = np.array([HEIGHT, PATH, BEARING, ONE_WAY, PATH, ELEVATION])
    rng = np.random.default_rng(5)
    tx, rx = rng.uniform(-80.0, 80.0, (2, 6, 3))
    columns = np.tile(COLUMNS, (6, 1))
    columns[4, 3:5] = columns[2, 4] = -1
    states = STATE + rng.normal(size=(4, 10))
    value, gradient = observe(states.T, 0.0, kind, columns, tx, rx)
    for c in range(6):
        each = seen(kind[c], states, tx[c], rx[c], columns[c])
        np.testing.assert_array_equal(value[c], each[0])
        np.testing.assert_array_equal(gradient[c].T, each[1])


def test_without_states_the_height_is_the_given_one_and_no_point_is_singular():
    columns = np.array([0, 1, -1, -1, -1, -1, -1])
    here = np.array([5.0, 5.0, -3.0])
    for kind in (PATH, ONE_WAY, BEARING, ELEVATION):
        value, gradient = seen(kind, here[:2], here, here, columns, -3.0)
        assert np.isfinite(value).all() and (gradient == 0.0).all()
    assert all(np.isfinite(part).all() for part in arrival_paths(here, here, here[None]))
    assert all(np.isfinite(part).all() for part in arrival_angles(here, here[None]))
