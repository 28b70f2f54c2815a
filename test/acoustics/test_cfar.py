# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""CFAR: the rate of false alarms it promises. Echoes in images: what is one, where it lies."""

from dataclasses import dataclass

from attrs import evolve
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


RANGE = 10.0 + 0.1 * np.arange(300)
BEARING = np.radians(np.linspace(-20.0, 20.0, 161))
RULES = EchoRules(beam_width=np.radians(1.0), range_resolution=0.3)


@dataclass
class Point:
    range: float
    bearing: float
    snr_db: float


def image(*points, seed=0, sidelobes=0.0):
    """Correlated speckle of power 1 and points of Gaussian patterns."""
    rng = np.random.default_rng(seed)
    step = BEARING[1] - BEARING[0]
    beam = np.exp(-2.0 * np.log(2.0) * np.square(step * np.arange(-12, 13) / RULES.beam_width))
    pulse = np.exp(-2.0 * np.log(2.0) * np.square(0.1 * np.arange(-9, 10) / 0.3))
    noise = rng.normal(size=(2, len(RANGE), len(BEARING)))
    noise = np.apply_along_axis(np.convolve, 2, noise, beam, 'same')
    noise = np.apply_along_axis(np.convolve, 1, noise, pulse, 'same')
    noise *= np.sqrt(0.5 / (np.square(beam).sum() * np.square(pulse).sum()))
    total = noise[0] + 1j * noise[1]
    for point in points:
        across = np.exp(
            -2.0 * np.log(2.0) * np.square((BEARING - point.bearing) / RULES.beam_width)
        )
        across = np.maximum(across, sidelobes)
        along = np.exp(-2.0 * np.log(2.0) * np.square((RANGE - point.range) / 0.3))
        phase = np.exp(2j * np.pi * rng.uniform())
        total += 10.0 ** (point.snr_db / 20.0) * phase * along[:, None] * across
    return np.abs(total)


def found(amplitude, **rules):
    return find_echoes(amplitude, RANGE, BEARING, evolve(RULES, **rules))


@pytest.mark.statistics
def test_a_point_lies_where_it_is_and_its_variance_is_believed():
    nees, places = [], []
    for seed in range(120):
        rng = np.random.default_rng([1, seed])
        point = Point(rng.uniform(15.0, 35.0), rng.uniform(-0.3, 0.3), 24.0)
        echoes = found(image(point, seed=seed))
        assert len(echoes.range) == 1
        error = echoes.range[0] - point.range, echoes.bearing[0] - point.bearing
        places.append(error)
        nees.append((error[0] ** 2 / echoes.var_range[0], error[1] ** 2 / echoes.var_bearing[0]))
    spread = np.std(places, axis=0)
    # half a width over sqrt(SNR): 0.0095 m and 0.032 degrees
    assert spread[0] < 0.016 and np.degrees(spread[1]) < 0.045
    assert np.abs(np.mean(places, axis=0)) == pytest.approx(0.0, abs=0.004)
    assert (0.15 < np.mean(nees, axis=0)).all() and (np.mean(nees, axis=0) < 1.3).all()


def test_sidelobes_of_a_strong_point_are_not_echoes_of_their_own():
    strong = image(Point(25.0, 0.05, 45.0), sidelobes=0.1)  # 20 dB down at every bearing
    assert len(found(strong).range) == 1
    assert len(found(strong, sidelobe=0.0, join_distance=0.0).range) == 1  # one ring of cells
    assert found(strong, sidelobe=0.0).extent_bearing[0] > 2.0 * found(strong).extent_bearing[0]


def test_glints_that_come_near_each_other_are_one_echo_and_others_are_not():
    glints = [Point(25.0, b, 28.0) for b in (-0.06, 0.0, 0.06)]  # 1.5 m apart, edges nearer
    whole = found(image(*glints))
    assert len(whole.range) == 1
    assert whole.extent_bearing[0] == pytest.approx(0.049, rel=0.4)
    assert whole.var_bearing[0] == pytest.approx(whole.extent_bearing[0] ** 2, rel=0.1)
    assert len(found(image(*glints), join_distance=0.2).range) == 3
    assert len(found(image(Point(25.0, 0.0, 28.0), Point(28.0, 0.0, 28.0))).range) == 2


def test_the_strongest_comes_first():
    echoes = found(image(Point(15.0, 0.1, 22.0), Point(30.0, -0.2, 35.0)))
    assert echoes.range == pytest.approx([30.0, 15.0], abs=0.1)
    assert echoes.snr[0] > echoes.snr[1] and echoes.amplitude[0] > echoes.amplitude[1]
    # Of a point: half a width over the amplitude ratio, and a tenth of a step.
    of_range, of_bearing = 0.15**2, np.radians(0.5) ** 2
    assert echoes.var_range[1] == pytest.approx(of_range / echoes.snr[1] + 0.01**2)
    of_step = np.radians(0.025) ** 2
    assert echoes.var_bearing[1] == pytest.approx(of_bearing / echoes.snr[1] + of_step)


def test_an_onset_of_the_sea_floor_is_no_echo():
    noise = image(seed=4)
    noise[RANGE > 25.0] *= 6.0  # 16 dB at once
    assert len(found(noise).range) == 0


def test_water_that_scatters_back_is_no_echo_where_the_sonar_begins_to_see():
    noise = image(seed=4) * (3.0 / np.linspace(0.3, 9.0, len(RANGE)))[:, None]
    assert len(found(noise, margin=1.0, false_alarm=1e-5).range) == 0
    assert len(found(image(Point(15.0, 0.1, 25.0)), nearest=16.0).range) == 0


def test_correlated_noise_gives_few_false_alarms():
    # 1e-4 of 48,300 cells, 1.5 x 1.3 widths of 4 x 3 cells each: some 2.5 groups per image
    count = sum(
        len(found(image(seed=seed), false_alarm=1e-4, margin=1.0, growth=1e-4).range)
        for seed in range(20)
    )
    assert 0 < count < 60


def test_few_independent_cells_ask_for_a_higher_threshold():
    """Nine beams and eight rows are four independent cells, not 72: taken for 72 they give 84."""
    small = {'beams': 9, 'training': 8, 'false_alarm': 1e-3, 'growth': 1e-3, 'margin': 1.0}
    assert 5 < sum(len(found(image(seed=seed), **small).range) for seed in range(10)) < 40


@pytest.mark.parametrize(
    'amplitude',
    [
        np.zeros((50, 5)),
        np.full((50, 5), 7.0),
        np.full((50, 5), np.nan),
        np.full((50, 5), np.inf),
        np.ones((1, 1)),
        np.empty((0, 5)),
        np.empty((5, 0)),
        np.empty((0, 0)),
    ],
)
def test_nothing_is_found_where_nothing_is(amplitude):
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
    n = 200
    distance, bearing = np.sort(rng.uniform(5.0, 40.0, n)), rng.uniform(-0.4, 0.4, n)
    part = rng.integers(0, 60, n)
    joined = joined_parts(part, distance, bearing, 1.5)
    place = distance * np.exp(1j * bearing)
    near = (np.abs(place[:, None] - place) <= 1.5) | (part[:, None] == part)
    for _ in range(8):  # paths of up to 256 steps
        near = (near.astype(int) @ near.astype(int)) > 0
    assert ((joined[:, None] == joined) == near).all()
    assert sorted(set(joined.tolist())) == list(range(joined.max() + 1))
