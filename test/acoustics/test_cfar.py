# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""CFAR: the rate of false alarms it promises. Echoes in images: what is one, where it lies."""

from attrs import evolve
import numpy as np
from numpy.testing import assert_allclose
import pytest

from sonar_imm.acoustics import cfar
from sonar_imm.acoustics.image_echoes import EchoRules, find_echoes, joined_parts


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


@pytest.mark.parametrize('shape', [(60, 9), (7, 3), (40, 1)])
@pytest.mark.parametrize('training, guard, beams', [(8, 2, 5), (5, 0, 1), (16, 4, 25)])
def test_the_level_is_that_of_a_loop(shape, training, guard, beams):
    power = np.random.default_rng(1).exponential(size=shape)
    level, sides = cfar.noise_level(power, beams=beams, training=training, guard=guard)
    wanted, counted = level_of_loops(power, beams, training, guard)
    assert sides.tolist() == counted.tolist()
    np.testing.assert_allclose(level, wanted, rtol=1e-12)


@pytest.mark.parametrize('cells, sides', [(2, 1), (30, 1), (6, 2)])
def test_the_factor_gives_the_rate_that_sampling_finds(cells, sides):
    rng = np.random.default_rng(2)
    factor = cfar.threshold_factor(0.01, cells, sides)
    means = rng.gamma(cells, 1.0 / cells, (sides, 400_000)).max(axis=0)
    rate = (rng.exponential(size=400_000) > factor * means).mean()
    assert rate == pytest.approx(0.01, rel=0.06)  # 4,000 events: 1.6 % each
    assert cfar.false_alarm_probability(factor, cells, sides) == pytest.approx(0.01, rel=1e-6)


def test_with_many_cells_the_level_is_known_and_the_law_that_of_the_noise():
    assert cfar.threshold_factor(1e-6, 100_000) == pytest.approx(-np.log(1e-6), rel=0.01)
    assert (np.diff([cfar.threshold_factor(1e-6, cells) for cells in (3, 20, 300)]) < 0.0).all()
    with pytest.raises(ValueError, match='between 0 and 1'):
        cfar.threshold_factor(0.0, 20)
    with pytest.raises(ValueError, match=r'\(R, B\)'):
        cfar.noise_level(np.ones(5), beams=3, training=4, guard=1)


@pytest.mark.parametrize('width', [1.0, 6.0])
def test_effective_cells_are_those_whose_mean_varies_as_much(width):
    rng, lag = np.random.default_rng(3), np.arange(-30, 31)
    pattern = np.exp(-2.0 * np.log(2.0) * np.square(lag / width))
    noise = rng.normal(size=(2, 4000, 25 + 60))
    speckle = np.array([[np.convolve(row, pattern, 'valid') for row in part] for part in noise])
    power = np.square(speckle).sum(axis=0) / (2.0 * np.square(pattern).sum())
    assert power.mean() == pytest.approx(1.0, abs=0.05)
    due = 1.0 / power.mean(axis=1).var()
    assert cfar.effective_cells(25, width) == pytest.approx(due, rel=0.12)
    assert cfar.effective_cells(25, 1e-9) == 25.0 and cfar.effective_cells(1, 5.0) == 1.0


def test_a_factor_for_k_noise_gives_the_probability_that_was_asked_for():
    rng = np.random.default_rng(3)
    for shape in (1.5, 4.0, 40.0):
        power = rng.gamma(shape, 1.0 / shape, (400, 5000)) * rng.exponential(size=(400, 5000))
        rough = np.var(np.log(np.maximum(power, 0.02)))
        threshold = -np.log(1e-4) * cfar.tail_factor(np.array([rough]), 1e-4)[0]
        assert np.mean(power > threshold) == pytest.approx(1e-4, rel=0.25)


CELLS = {'beams': 25, 'training': 16, 'guard': 4}


def test_the_rougher_the_sea_floor_the_higher_and_rayleigh_noise_asks_for_no_more():
    rng, factor = np.random.default_rng(5), []
    power = np.random.default_rng(4).exponential(size=(200, 256))
    rough = cfar.quiet_level(power, **CELLS)[2]
    assert np.max(cfar.tail_factor(rough[60:140], 1e-6)) < 10.0**0.1
    for shape in (1000.0, 4.0, 1.5, 0.7):
        patches = rng.gamma(shape, 1.0 / shape, (50, 64)).repeat(4, 0).repeat(4, 1)
        rough = cfar.quiet_level(patches * rng.exponential(size=(200, 256)), **CELLS)[2]
        factor.append(np.median(cfar.tail_factor(rough[40:160], 1e-6)))
    assert np.all(np.diff(factor) > 0.2)


def test_what_reaches_into_its_own_training_cells_is_left_out_of_the_noise():
    power = np.random.default_rng(6).exponential(size=(200, 100))
    power[80:120, 48:53] += 60.0  # along the line of sight, longer than the training cells
    plain, _ = cfar.noise_level(power, **CELLS)
    quiet, _, _ = cfar.quiet_level(power, **CELLS)
    assert plain[100, 50] > 8.0 and quiet[100, 50] < 1.5
    # Noise alone keeps its level.
    assert_allclose(quiet[20:60].mean(), plain[20:60].mean(), rtol=0.06)
    # A chain of glints, ten of 25 beams wide, lifts the mean by which they are told from noise.
    power = np.random.default_rng(8).exponential(size=(200, 100))
    power[80:120, 45:55] *= 20.0
    quiet, _, _ = cfar.quiet_level(power, **CELLS)
    assert np.median(quiet[90:110, 50]) < 2.0  # 2.6 after one look, 8.9 with all cells


def test_the_unit_of_power_does_not_matter_where_nothing_is_quiet():
    power = np.random.default_rng(9).exponential(size=(120, 60))
    power[60:] *= 300.0
    power[90] *= 1e4
    level, _, rough = cfar.quiet_level(power, **CELLS)
    for unit in (1e-8, 1e8):
        again, _, same = cfar.quiet_level(unit * power, **CELLS)
        assert_allclose(again, unit * level, rtol=1e-9)
        assert_allclose(same, rough, rtol=1e-9)


def test_rows_without_a_quiet_beam_count_as_the_others_do():
    """Two rings, loud in every beam, nearer and farther: they are neither noise nor silence."""
    power = np.random.default_rng(10).exponential(size=(200, 100))
    power[80:84] = power[100:104] = 60.0
    quiet, _, _ = cfar.quiet_level(power, **CELLS)
    between, noise = np.median(quiet[91:93]), np.median(quiet[140:160])
    # A level that is too low lets noise through.
    assert between == pytest.approx(noise, rel=0.15) and between > 0.97 * noise


def test_silence_and_one_huge_cell_are_survived():
    for power in (np.zeros((60, 40)), np.full((60, 40), 1e76), np.zeros((0, 40)), np.ones((3, 2))):
        level, sides, rough = cfar.quiet_level(power, **CELLS)
        assert level.shape == power.shape and len(sides) == len(rough) == len(power)
        assert not np.isnan(level).any() and not np.isnan(cfar.tail_factor(rough, 1e-6)).any()
    power = np.random.default_rng(7).exponential(size=(60, 40))
    power[30, 20] = 1e76
    assert cfar.quiet_level(power, **CELLS)[0][50, 20] < 3.0


def test_roughness_is_the_variance_of_what_is_known():
    rng = np.random.default_rng(8)
    logarithm = rng.normal(2.0, 0.7, size=(300, 40))
    unknown = logarithm.copy()
    unknown[:, ::3] = np.nan
    alone = np.delete(logarithm, np.s_[::3], axis=1)
    assert_allclose(cfar.roughness(unknown), cfar.roughness(alone), rtol=1e-9)
    assert_allclose(cfar.roughness(alone), 0.49, atol=0.1)


RANGE = 10.0 + 0.1 * np.arange(300)
BEARING = np.radians(np.linspace(-20.0, 20.0, 161))
RULES = EchoRules(beam_width=np.radians(1.0), range_resolution=0.3)


def image(*points, seed=0, sidelobes=0.0):
    """Correlated speckle of power 1 and points (range, bearing, snr_db) of Gaussian patterns."""
    rng, step = np.random.default_rng(seed), BEARING[1] - BEARING[0]

    def pattern(off, width):
        return np.exp(-2.0 * np.log(2.0) * np.square(off / width))

    beam = pattern(step * np.arange(-12, 13), RULES.beam_width)
    pulse = pattern(0.1 * np.arange(-9, 10), 0.3)
    noise = rng.normal(size=(2, len(RANGE), len(BEARING)))
    noise = np.apply_along_axis(np.convolve, 2, noise, beam, 'same')
    noise = np.apply_along_axis(np.convolve, 1, noise, pulse, 'same')
    noise *= np.sqrt(0.5 / (np.square(beam).sum() * np.square(pulse).sum()))
    total = noise[0] + 1j * noise[1]
    for distance, bearing, snr_db in points:
        across = np.maximum(pattern(BEARING - bearing, RULES.beam_width), sidelobes)
        phase = np.exp(2j * np.pi * rng.uniform())
        along = pattern(RANGE - distance, 0.3)[:, None]
        total += 10.0 ** (snr_db / 20.0) * phase * along * across
    return np.abs(total)


def found(amplitude, **rules):
    return find_echoes(amplitude, RANGE, BEARING, evolve(RULES, **rules))


def count(amplitude, **rules):
    return len(found(amplitude, **rules).range)


@pytest.mark.statistics
def test_a_point_lies_where_it_is_and_its_variance_is_believed():
    nees, places = [], []
    for seed in range(120):
        rng = np.random.default_rng([1, seed])
        place = np.array([rng.uniform(15.0, 35.0), rng.uniform(-0.3, 0.3)])
        echoes = found(image((*place, 24.0), seed=seed))
        assert len(echoes.range) == 1
        error = np.array([echoes.range[0], echoes.bearing[0]]) - place
        places.append(error)
        nees.append(error**2 / [echoes.var_range[0], echoes.var_bearing[0]])
    spread = np.std(places, axis=0)
    # half a width over sqrt(SNR): 0.0095 m and 0.032 degrees
    assert spread[0] < 0.016 and np.degrees(spread[1]) < 0.045
    assert np.abs(np.mean(places, axis=0)) == pytest.approx(0.0, abs=0.004)
    assert (0.15 < np.mean(nees, axis=0)).all() and (np.mean(nees, axis=0) < 1.3).all()


def test_sidelobes_of_a_strong_point_are_not_echoes_of_their_own():
    strong = image((25.0, 0.05, 45.0), sidelobes=0.1)  # 20 dB down at every bearing
    assert count(strong) == count(strong, sidelobe=0.0, join_distance=0.0) == 1  # a ring of cells
    assert found(strong, sidelobe=0.0).extent_bearing[0] > 2.0 * found(strong).extent_bearing[0]


def test_glints_that_come_near_each_other_are_one_echo_and_others_are_not():
    glints = image(*((25.0, b, 28.0) for b in (-0.06, 0.0, 0.06)))  # 1.5 m apart, edges nearer
    whole = found(glints)
    assert len(whole.range) == 1
    assert whole.extent_bearing[0] == pytest.approx(0.049, rel=0.4)
    assert whole.var_bearing[0] == pytest.approx(whole.extent_bearing[0] ** 2, rel=0.1)
    assert count(glints, join_distance=0.2) == 3
    assert count(image((25.0, 0.0, 28.0), (28.0, 0.0, 28.0))) == 2


def test_the_strongest_comes_first():
    echoes = found(image((15.0, 0.1, 22.0), (30.0, -0.2, 35.0)))
    assert echoes.range == pytest.approx([30.0, 15.0], abs=0.1)
    assert echoes.snr[0] > echoes.snr[1] and echoes.amplitude[0] > echoes.amplitude[1]
    # Of a point: half a width over the amplitude ratio, and a tenth of a step.
    of_range, of_bearing = 0.15**2, np.radians(0.5) ** 2
    assert echoes.var_range[1] == pytest.approx(of_range / echoes.snr[1] + 0.01**2)
    of_step = np.radians(0.025) ** 2
    assert echoes.var_bearing[1] == pytest.approx(of_bearing / echoes.snr[1] + of_step)


def test_the_sea_floor_and_water_where_the_sonar_begins_to_see_are_no_echoes():
    noise = image(seed=4)
    scattered = noise * (3.0 / np.linspace(0.3, 9.0, len(RANGE)))[:, None]
    assert count(scattered, margin=1.0, false_alarm=1e-5) == 0
    noise[RANGE > 25.0] *= 6.0  # an onset of 16 dB at once
    assert count(noise) == 0
    assert count(image((15.0, 0.1, 25.0)), nearest=16.0) == 0


def test_correlated_noise_gives_few_false_alarms():
    images, low = [image(seed=seed) for seed in range(20)], {'margin': 1.0}
    # 1e-4 of 48,300 cells, 1.5 x 1.3 widths of 4 x 3 cells each: some 2.5 groups per image
    assert 0 < sum(count(each, false_alarm=1e-4, growth=1e-4, **low) for each in images) < 60
    # Nine beams and eight rows are four independent cells, not 72: taken for 72 they give 84.
    small = {'beams': 9, 'training': 8, 'false_alarm': 1e-3, 'growth': 1e-3, **low}
    assert 5 < sum(count(each, **small) for each in images[:10]) < 40


def test_nothing_is_found_where_nothing_is():
    flat = [np.full((50, 5), value) for value in (0.0, 7.0, np.nan, np.inf)]
    for amplitude in (*flat, np.ones((1, 1)), *map(np.empty, ((0, 5), (5, 0), (0, 0)))):
        rows, beams = amplitude.shape
        axes = 1.0 + np.arange(float(rows)), 0.01 * np.arange(float(beams))
        assert len(find_echoes(amplitude, *axes, RULES).range) == 0


def test_an_image_full_of_spikes_takes_bounded_work_and_gives_numbers():
    spikes = np.ones((600, 256))
    spikes[::3, ::3] = 1e38
    axes = 1.0 + np.arange(600.0), 0.003 * np.arange(256.0)
    echoes = find_echoes(spikes, *axes, evolve(RULES, beams=1, training=2, guard=0))
    assert np.isfinite(echoes.range).all() and np.isfinite(echoes.var_bearing).all()


def test_parts_are_joined_as_by_comparing_all_cells():
    rng = np.random.default_rng(7)
    distance, bearing = np.sort(rng.uniform(5.0, 40.0, 200)), rng.uniform(-0.4, 0.4, 200)
    part = rng.integers(0, 60, 200)
    joined = joined_parts(part, distance, bearing, 1.5)
    place = distance * np.exp(1j * bearing)
    near = (np.abs(place[:, None] - place) <= 1.5) | (part[:, None] == part)
    for _ in range(8):  # paths of up to 256 steps
        near = (near.astype(int) @ near.astype(int)) > 0
    assert ((joined[:, None] == joined) == near).all()
    assert sorted(set(joined.tolist())) == list(range(joined.max() + 1))
