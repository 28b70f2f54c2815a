# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Wrapping of angles."""

from __future__ import annotations

import numpy as np

from sonar_imm.estimation.angles import wrap_angle


def test_angles_inside_keep_their_bits():
    angles = np.concatenate([np.linspace(-np.pi, np.pi, 1001), [0.1, -0.0, 1e-300]])
    assert (wrap_angle(angles) == angles).all()


def test_the_direction_stays_and_the_angle_lies_inside():
    angles = np.linspace(-20.0, 20.0, 1001)
    wrapped = wrap_angle(angles)
    assert (np.abs(wrapped) <= np.pi + 1e-15).all()
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-14)


def test_many_turns_cost_no_loop():
    np.testing.assert_allclose(wrap_angle(1e12), np.angle(np.exp(1e12j)), atol=1e-3)


def test_lists_scalars_and_unknown_angles():
    np.testing.assert_allclose(
        wrap_angle([3.5 * np.pi, -0.1, np.pi + 1e-3]), [-0.5 * np.pi, -0.1, -np.pi + 1e-3]
    )
    assert wrap_angle(4.0) == 4.0 - 2.0 * np.pi
    assert np.isnan(wrap_angle([np.nan])).all()
