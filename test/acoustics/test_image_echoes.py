# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Echoes in images: what is one echo, where it lies, how sure that is."""

from dataclasses import dataclass

from attrs import evolve
import numpy as np
import pytest

from sonar_imm.acoustics.image_echoes import EchoRules, find_echoes, joined_parts

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
