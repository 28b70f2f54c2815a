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

"""Members from the intensity of many sets."""

import numpy as np
import pytest

from sonar_imm.estimation.set_filter import find_members


def hills(*places):
    sums = np.zeros((5, 100))
    for place, mass, amplitude in places:
        shape = mass * np.exp(-0.5 * (np.arange(100) - place) ** 2)
        shape *= mass / shape.sum()
        sums += shape * np.array([[1.0], [amplitude], [amplitude**2 + 0.25], [place], [0.5]])
    return sums


def test_each_hill_is_a_member():
    found = find_members(hills((20, 0.9, 5.0), (70, 0.6, 2.0)), 10, 5, 0.01)
    assert found.place[:2] == pytest.approx([20.0, 70.0], abs=0.01)
    assert found.amplitude[:2] == pytest.approx([5.0, 2.0])
    assert found.existence[:2] == pytest.approx([0.9, 0.6], abs=1e-3)
    assert found.prior_variance[:2] == pytest.approx([20.0, 70.0])
    assert found.foremost[:2] == pytest.approx([0.45, 0.3], abs=1e-3)
    assert found.covariance[0] == pytest.approx(np.array([[1.0, 0.0], [0.0, 0.25]]), abs=0.01)


def test_no_more_than_asked_and_none_that_is_not_believed():
    sums = hills((20, 0.9, 5.0), (50, 0.3, 1.0), (70, 0.6, 2.0))
    assert len(find_members(sums, 10, 2, 0.0).place) == 2
    assert find_members(sums, 10, 9, 0.5).place == pytest.approx([20.0, 70.0], abs=0.01)
    assert len(find_members(np.zeros((5, 100)), 10, 9, 0.0).place) == 0


def test_a_member_at_the_edge_and_a_separation_of_one():
    sums = np.zeros((5, 4))
    sums[:, 0] = 0.8, 0.8, 0.9, 1.6, 0.4
    found = find_members(sums, 1, 3, 0.1)
    assert found.place == pytest.approx([0.0])
    assert found.existence == pytest.approx([0.8])
    assert found.prior_variance == pytest.approx([2.0])


def test_of_two_humps_the_greater_is_reported_with_its_own_spread():
    sums = hills((40, 0.55, 5.0), (52, 0.4, 3.0))
    mean = find_members(sums, 16, 1, 0.5)
    assert mean.place == pytest.approx([45.05], abs=0.1) and mean.covariance[0, 0, 0] > 30.0
    mode = find_members(sums, 16, 1, 0.5, modes=True)
    assert mode.place == pytest.approx([40.0], abs=0.1)
    assert mode.amplitude == pytest.approx([5.0], abs=0.01)
    assert mode.covariance[0] == pytest.approx(np.array([[1.0, 0.0], [0.0, 0.25]]), abs=0.15)
    # That there is a member is as sure as before, wherever it is.
    assert mode.existence == pytest.approx(mean.existence) and mode.existence > 0.9
    assert mode.foremost == pytest.approx(mean.foremost)


def test_one_hump_and_what_is_rare_beside_it_stay_whole():
    sums = hills((40, 0.9, 5.0), (52, 0.05, 3.0))
    with_modes = find_members(sums, 16, 1, 0.5, modes=True)
    for found, expected in zip(with_modes, find_members(sums, 16, 1, 0.5)):
        assert np.array_equal(found, expected)
