# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pictures of a sonar as a screen shows them."""

import numpy as np
import pytest

from msg_adapters.fans import unfolded
from sonar_imm.measurements import Rejection

ROWS = 120


def fan(sector_deg, far_first=True, target=(0.2, 80.0), seed=3):
    """The picture of an echo at (angle to the left, rows of range), and noise, apex at one end."""
    half = np.radians(0.5 * sector_deg)
    columns = round(2 * ROWS * np.sin(half))
    ahead, left = np.mgrid[:ROWS, :columns] + 0.5
    left = 0.5 * columns - left
    r, angle = np.hypot(ahead, left), np.arctan2(left, ahead)
    picture = np.random.default_rng(seed).rayleigh(10.0, r.shape)
    off = np.hypot(ahead - target[1] * np.cos(target[0]), left - target[1] * np.sin(target[0]))
    picture += 200.0 * np.exp(-np.square(off / 2.0))
    picture[(r > ROWS) | (np.abs(angle) > half)] = 0.0
    return picture[::-1] if far_first else picture


@pytest.mark.parametrize('sector', [60.0, 90.0, 130.0])
@pytest.mark.parametrize('far_first', [True, False])
def test_a_fan_gives_ranges_by_beams(sector, far_first):
    found = unfolded(fan(sector, far_first), sector)
    row, column = np.unravel_index(found.argmax(), found.shape)
    angle = np.radians(sector) * (0.5 - (column + 0.5) / found.shape[1])
    assert row + 0.5 == pytest.approx(80.0, abs=1.0)
    assert angle == pytest.approx(0.2, abs=0.02)
    assert np.median(found[10:]) == pytest.approx(np.median(found[10:, 10:-10]), rel=0.1)


def test_a_fan_of_another_sector_is_refused_with_its_own():
    with pytest.raises(Rejection, match='fan as a screen shows it, 90 deg wide'):
        unfolded(fan(90.0), 130.0)


@pytest.mark.parametrize('columns', [16, 170, 240, 400])
@pytest.mark.parametrize('empty', [False, True])
def test_ranges_by_beams_stay_as_they_are(columns, empty):
    picture = np.random.default_rng(1).rayleigh(10.0, (ROWS, columns)) * (not empty)
    assert unfolded(picture, 90.0) is picture


def test_ranges_by_beams_whose_far_ranges_are_dark_stay_as_they_are():
    picture = np.random.default_rng(1).rayleigh(10.0, (ROWS, 170))
    picture[80:] = 0.0
    assert unfolded(picture, 90.0) is picture
