# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""CFAR: the rate of false alarms it promises, and the level it compares with."""

import numpy as np
from numpy.testing import assert_allclose
import pytest

from sonar_imm.acoustics.cfar import (
    effective_cells,
    false_alarm_probability,
    noise_level,
    quiet_level,
    roughness,
    tail_factor,
    threshold_factor,
)


def level_of_loops(power, beams, training, guard):
    """The same cell by cell, and how many sides count."""
    R, B = power.shape
    level, sides = np.full((R, B), np.inf), np.zeros(R)
    for r in range(R):
        before = [k for k in range(r - guard - training, r - guard) if k >= 0]
        behind = [k for k in range(r + guard + 1, r + guard + 1 + training) if k < R]
        used = [rows for rows in (before, behind) if 2 * len(rows) >= training]
        used = used if 2 * len(before) >= training else []
        sides[r] = len(used)
        for b in range(B):
            around = slice(max(0, b - beams // 2), b + beams // 2 + 1)
            means = [power[rows, around].mean() for rows in used]
            level[r, b] = max(means, default=np.inf)
    return level, sides


@pytest.mark.parametrize('shape', [(60, 9), (20, 40), (7, 3), (40, 1)])
@pytest.mark.parametrize('training, guard, beams', [(8, 2, 5), (5, 0, 1), (16, 4, 25)])
def test_the_level_is_that_of_a_loop(shape, training, guard, beams):
    power = np.random.default_rng(1).exponential(size=shape)
    level, sides = noise_level(power, beams=beams, training=training, guard=guard)
    wanted, counted = level_of_loops(power, beams, training, guard)
    assert sides.tolist() == counted.tolist()
    np.testing.assert_allclose(level, wanted, rtol=1e-12)


@pytest.mark.parametrize('sides', [1, 2])
@pytest.mark.parametrize('cells', [2, 6, 30])
def test_the_factor_gives_the_rate_that_sampling_finds(cells, sides):
    rng = np.random.default_rng(2)
    factor = threshold_factor(0.01, cells, sides)
    means = rng.gamma(cells, 1.0 / cells, (sides, 400_000)).max(axis=0)
    rate = (rng.exponential(size=400_000) > factor * means).mean()
    assert rate == pytest.approx(0.01, rel=0.06)  # 4,000 events: 1.6 % each
    assert false_alarm_probability(factor, cells, sides) == pytest.approx(0.01, rel=1e-6)


def test_with_many_cells_the_level_is_known_and_the_law_that_of_the_noise():
    assert threshold_factor(1e-6, 100_000) == pytest.approx(-np.log(1e-6), rel=0.01)
    assert threshold_factor(1e-6, 3) > threshold_factor(1e-6, 20) > threshold_factor(1e-6, 300)
    with pytest.raises(ValueError, match='between 0 and 1'):
        threshold_factor(0.0, 20)


@pytest.mark.parametrize('width', [1.0, 3.0, 6.0])
def test_effective_cells_are_those_whose_mean_varies_as_much(width):
    rng = np.random.default_rng(3)
    lag = np.arange(-30, 31)
    pattern = np.exp(-2.0 * np.log(2.0) * np.square(lag / width))
    noise = rng.normal(size=(2, 4000, 25 + 60))
    speckle = np.array([[np.convolve(row, pattern, 'valid') for row in part] for part in noise])
    power = np.square(speckle).sum(axis=0) / (2.0 * np.square(pattern).sum())
    assert power.mean() == pytest.approx(1.0, abs=0.05)
    assert effective_cells(25, width) == pytest.approx(1.0 / power.mean(axis=1).var(), rel=0.12)


def test_independent_cells_are_all_effective():
    assert effective_cells(25, 1e-9) == 25.0 and effective_cells(1, 5.0) == 1.0


def test_only_images_are_taken():
    with pytest.raises(ValueError, match=r'\(R, B\)'):
        noise_level(np.ones(5), beams=3, training=4, guard=1)


def test_a_factor_for_k_noise_gives_the_probability_that_was_asked_for():
    """Drawn: power of patches of gamma distributed power."""
    rng = np.random.default_rng(3)
    for shape in (1.5, 4.0, 40.0):
        power = rng.gamma(shape, 1.0 / shape, (400, 5000)) * rng.exponential(size=(400, 5000))
        rough = np.var(np.log(np.maximum(power, 0.02)))
        threshold = -np.log(1e-4) * tail_factor(np.array([rough]), 1e-4)[0]
        assert np.mean(power > threshold) == pytest.approx(1e-4, rel=0.25)


def test_rayleigh_noise_asks_for_no_more():
    power = np.random.default_rng(4).exponential(size=(200, 256))
    _, _, rough = quiet_level(power, beams=25, training=16, guard=4)
    assert np.max(tail_factor(rough[60:140], 1e-6)) < 10.0**0.1


def test_the_rougher_the_sea_floor_the_higher():
    rng = np.random.default_rng(5)
    factor = []
    for shape in (1000.0, 4.0, 1.5, 0.7):
        patches = np.repeat(np.repeat(rng.gamma(shape, 1.0 / shape, (50, 64)), 4, 0), 4, 1)
        power = patches * rng.exponential(size=(200, 256))
        _, _, rough = quiet_level(power, beams=25, training=16, guard=4)
        factor.append(np.median(tail_factor(rough[40:160], 1e-6)))
    assert np.all(np.diff(factor) > 0.2)


def test_what_reaches_into_its_own_training_cells_is_left_out_of_the_noise():
    rng = np.random.default_rng(6)
    power = rng.exponential(size=(200, 100))
    power[80:120, 48:53] += 60.0  # along the line of sight, longer than the training cells
    plain, _ = noise_level(power, beams=25, training=16, guard=4)
    quiet, _, _ = quiet_level(power, beams=25, training=16, guard=4)
    assert plain[100, 50] > 8.0 and quiet[100, 50] < 1.5
    # Noise alone keeps its level.
    assert_allclose(quiet[20:60].mean(), plain[20:60].mean(), rtol=0.06)


def test_a_wide_chain_does_not_lift_the_level_by_which_it_is_left_out():
    """Ten of 25 beams wide: its glints lift the mean by which they are told from noise."""
    rng = np.random.default_rng(8)
    power = rng.exponential(size=(200, 100))
    power[80:120, 45:55] *= 20.0
    quiet, _, _ = quiet_level(power, beams=25, training=16, guard=4)
    assert np.median(quiet[90:110, 50]) < 2.0  # 2.6 after one look, 8.9 with all cells


def test_the_unit_of_power_does_not_matter_where_nothing_is_quiet():
    power = np.random.default_rng(9).exponential(size=(120, 60))
    power[60:] *= 300.0
    power[90] *= 1e4
    level, _, rough = quiet_level(power, beams=25, training=16, guard=4)
    for unit in (1e-8, 1e8):
        again, _, same = quiet_level(unit * power, beams=25, training=16, guard=4)
        assert_allclose(again, unit * level, rtol=1e-9)
        assert_allclose(same, rough, rtol=1e-9)


def test_rows_without_a_quiet_beam_count_as_the_others_do():
    """Two rings, loud in every beam, nearer and farther: they are neither noise nor silence."""
    rng = np.random.default_rng(10)
    power = rng.exponential(size=(200, 100))
    power[80:84] = power[100:104] = 60.0
    quiet, _, _ = quiet_level(power, beams=25, training=16, guard=4)
    between, noise = np.median(quiet[91:93]), np.median(quiet[140:160])
    assert between == pytest.approx(noise, rel=0.15)
    assert between > 0.97 * noise  # a level that is too low lets noise through


def test_silence_and_one_huge_cell_are_survived():
    for power in (np.zeros((60, 40)), np.full((60, 40), 1e76), np.zeros((0, 40)), np.ones((3, 2))):
        level, sides, rough = quiet_level(power, beams=25, training=16, guard=4)
        assert level.shape == power.shape and len(sides) == len(rough) == len(power)
        assert not np.isnan(level).any() and not np.isnan(tail_factor(rough, 1e-6)).any()
    power = np.random.default_rng(7).exponential(size=(60, 40))
    power[30, 20] = 1e76
    assert quiet_level(power, beams=25, training=16, guard=4)[0][50, 20] < 3.0


def test_roughness_is_the_variance_of_what_is_known():
    rng = np.random.default_rng(8)
    logarithm = rng.normal(2.0, 0.7, size=(300, 40))
    unknown = logarithm.copy()
    unknown[:, ::3] = np.nan
    alone = np.delete(logarithm, np.s_[::3], axis=1)
    assert_allclose(roughness(unknown), roughness(alone), rtol=1e-9)
    assert_allclose(roughness(alone), 0.49, atol=0.1)
