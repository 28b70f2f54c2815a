# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

import math

import numpy as np
import pytest

from sonar_imm.acoustics import array

TILT = math.radians(30.0)


@pytest.mark.parametrize('tilt', [-0.4, 0.0, 0.3, TILT, 1.2])
def test_the_direction_sine_is_the_sine_of_the_angle(tilt):
    rng = np.random.default_rng(0)
    r = rng.uniform(5.0, 80.0, 1000)
    D = r * rng.uniform(-1.0, 1.0, 1000)
    angle = np.arcsin(D / r) - tilt
    assert np.allclose(array.direction_sine(D, r, tilt), np.sin(angle), atol=1e-14)
    assert np.allclose(array.angle_of_depth(D, r, tilt), angle, atol=1e-14)
    assert np.allclose(array.depth_of_angle(angle, r, tilt), D, atol=1e-12)
    assert np.allclose(np.hypot(array.across_track(D, r), D), r)


def test_the_phase_is_that_of_the_path_to_each_stave():
    D, r, wavelength = 15.0, 4e4, 0.01  # so far away that the wave is plane
    echo = np.array([math.sqrt(r**2 - D**2), D])  # outward, down
    staves = np.arange(8)[:, None] * 0.5 * wavelength * [-math.sin(TILT), math.cos(TILT)]
    path = np.linalg.norm(echo - staves, axis=1)
    a = array.steering(array.direction_sine(D, r, TILT), 8, 0.5)
    assert np.allclose(a, np.exp(2j * np.pi * (r - path) / wavelength), atol=1e-6)
    # The axis is orthogonal to where the array looks.
    assert staves[1] @ [math.cos(TILT), math.sin(TILT)] == pytest.approx(0.0, abs=1e-18)


def test_nadir_and_horizon():
    assert array.direction_sine(15.0, 15.0, TILT) == pytest.approx(math.sin(math.radians(60.0)))
    assert array.direction_sine(0.0, 15.0, TILT) == pytest.approx(-0.5)
    assert array.direction_sine(7.5, 15.0, TILT) == pytest.approx(0.0, abs=1e-15)


def test_a_floor_beyond_the_range_is_impossible():
    D = np.array([15.0 + 1e-9, -15.1, 15.0, np.nan, np.inf])
    for values in (
        array.direction_sine(D, 15.0, TILT),
        array.angle_of_depth(D, 15.0, TILT),
        array.across_track(D, 15.0),
    ):
        assert np.isnan(values).tolist() == [True, True, False, True, True]
    assert np.isnan(array.direction_sine(1.0, 0.0, TILT))


def test_conjugation_turns_the_phase_round():
    u = np.linspace(-0.9, 0.9, 7)
    straight, turned = (array.steering(u, 5, 0.4, conjugate=c) for c in (False, True))
    assert straight.shape == (7, 5)
    assert np.allclose(turned, straight.conj()) and np.allclose(turned, straight[::-1])
    assert array.phase_step(0.4) == -array.phase_step(0.4, conjugate=True) == 0.8 * math.pi


def test_the_mirror_of_the_surface():
    D, r, surface = np.array([15.0, 15.0]), np.array([40.0, 20.0]), 3.0
    sines = array.multipath_sines(D, r, TILT, surface)
    assert sines.shape == (2, 2)
    assert np.allclose(sines[:, 0], np.sin(np.arcsin(-surface / r) - TILT))
    # The floor appears in the mirror as far above the surface as it lies below.
    assert sines[0, 1] == pytest.approx(math.sin(math.asin(-(3.0 + 18.0) / 40.0) - TILT))
    assert np.isnan(sines[1, 1])


def test_the_grid_covers_all_that_can_be_told_apart():
    assert array.largest_sine(0.25) == 1.0 and array.largest_sine(2.0) == 0.25
    for staves, spacing in ((2, 0.5), (8, 0.5), (64, 0.5), (8, 0.2), (2, 3.66)):
        grid = array.direction_grid(staves, spacing)
        assert grid[-1] == -grid[0] == array.largest_sine(spacing)
        assert np.diff(grid).max() <= 1.0 / (8 * staves * spacing) + 1e-12
