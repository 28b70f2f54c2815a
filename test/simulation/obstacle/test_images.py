# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Simulated images: speckle, reverberation, sea floor and targets are what they claim to be."""

import numpy as np
import pytest
from scipy.signal.windows import taylor

from sonar_imm.acoustics.geometry import Pose
from sonar_imm.measurements import SonarImage
from sonar_imm.parameters import ConfigError
from sonar_imm_tools.simulation.obstacle import scenario, simulate
from sonar_imm_tools.simulation.obstacle.images import ImageSonar, vertical_pattern

LEVEL = Pose(np.array([0.0, 0.0, 20.0]), np.eye(3))
NOWHERE = {'reverberation': 0.0, 'altitude': 5000.0, 'image_gain': 40.0}


# -- speckle, reverberation, sea floor and targets of images --------------------------------------


def sonar(seed=0, **values):
    config = scenario('approach', {'images': True, **values})
    return ImageSonar(config, np.random.default_rng(seed))


def powers(imager, count, places=(), pose=LEVEL):
    """Mean power over images, in units of the noise."""
    gain = imager.config.image_gain
    images = [imager.image(pose, list(places), 1.0) / gain for _ in range(count)]
    return np.mean(np.square(images), axis=0)


def correlation(power, axis, lag):
    """Of the power at places `lag` cells apart."""
    first = np.take(power, np.arange(power.shape[axis] - lag), axis)
    second = np.take(power, np.arange(lag, power.shape[axis]), axis)
    return np.corrcoef(first.ravel(), second.ravel())[0, 1]


def beams_correlate(lag):
    """Correlation of the power of beams `lag` times 45 / 256 degrees apart, 1 degree wide."""
    weight = taylor(400, nbar=6, sll=20.0)
    place = np.arange(400) - 199.5
    u = np.linspace(0.0, 0.01, 5001)
    pattern = np.abs(np.exp(2j * np.pi * np.multiply.outer(u, place)) @ weight) / weight.sum()
    half = u[np.argmax(pattern < np.sqrt(0.5))]
    off = lag * (45.0 / 256.0) * 2.0 * half
    together = np.exp(2j * np.pi * off * place) @ np.square(weight)
    return np.square(np.abs(together / np.square(weight).sum()))


def test_bins_and_beams_fill_range_and_sector():
    it = sonar()
    left = 0.5 * it.config.horizontal_fov_deg
    for cells, first, last in (
        (it.range, 0.0, it.config.max_range),
        (np.rad2deg(it.bearing), left, -left),
    ):
        half = 0.5 * (last - first) / len(cells)
        np.testing.assert_allclose(cells[[0, -1]], [first + half, last - half])


def test_noise_is_rayleigh_speckle_as_wide_as_a_beam_and_as_long_as_the_pulse():
    imager = sonar(**NOWHERE)
    images = [np.square(imager.image(LEVEL, [], 1.0) / 40.0) for _ in range(6)]
    power = np.concatenate(images, axis=0)
    assert power.mean() == pytest.approx(1.0, abs=0.01)
    assert power.std() == pytest.approx(1.0, abs=0.03)  # exponential
    # Speckle of an array correlates as the transform of its squared weights, to the second power.
    for lag in (2, 4):
        assert correlation(images[0], 1, lag) == pytest.approx(beams_correlate(lag), abs=0.06)
    assert correlation(images[0], 1, 12) == pytest.approx(0.0, abs=0.06)
    assert correlation(images[0], 0, 1) == pytest.approx(0.65, abs=0.06)
    assert correlation(images[0], 0, 4) == pytest.approx(0.0, abs=0.05)


def test_water_scatters_back_by_the_square_of_the_range():
    imager = sonar(**{**NOWHERE, 'reverberation': 30.0, 'image_gain': 20.0})
    mean = powers(imager, 30).mean(axis=1)
    wanted = 1.0 + 30.0 * np.square(10.0 / imager.range)
    far = imager.range > 15.0
    assert mean[far] / wanted[far] == pytest.approx(1.0, abs=0.12)


def test_a_point_is_as_strong_wide_and_long_as_told():
    imager = sonar(**{**NOWHERE, 'target_snr_db': 26.0, 'image_gain': 8.0})
    d, b = imager.range[300], -imager.bearing[100]
    place = np.array([d * np.cos(b), d * np.sin(b), 20.0])
    power = powers(imager, 20, [place])
    row, beam = np.unravel_index(np.argmax(power), power.shape)
    assert abs(imager.range[row] - d) < 0.1 and beam == 100
    peak = power[row, beam] - 1.0
    assert 10.0 * np.log10(peak) == pytest.approx(26.0, abs=0.6)
    step = np.degrees(imager.bearing[0] - imager.bearing[1])
    wide = step * np.count_nonzero(power[row] > 0.5 * peak)
    assert wide == pytest.approx(1.0, abs=0.2)
    beyond = np.abs(np.arange(256) - 100) * step > 1.6
    sidelobes = power[row, beyond].max() - 1.0
    assert -24.0 < 10.0 * np.log10(sidelobes / peak) < -17.0


@pytest.mark.parametrize('stretch', [0.96, 1.04])
def test_an_error_of_the_sound_speed_stretches_all_ranges(stretch):
    imager = sonar(**{**NOWHERE, 'target_snr_db': 30.0, 'image_gain': 4.0})
    d = imager.range[300]
    image = imager.image(LEVEL, [LEVEL.position + np.array([d, 0.0, 0.0])], stretch)
    assert imager.range[image.max(axis=1).argmax()] == pytest.approx(stretch * d, abs=0.1)


def test_what_lies_above_or_below_the_axis_is_fainter():
    assert vertical_pattern(np.array([0.0]), 0.26) == 1.0
    assert vertical_pattern(np.array([0.13]), 0.26) == pytest.approx(0.25, rel=0.01)
    imager = sonar(**{**NOWHERE, 'target_snr_db': 30.0, 'image_gain': 4.0})
    edge = np.array([np.cos(0.1309), 0.0, np.sin(0.1309)])
    level, low = (
        powers(imager, 8, [LEVEL.position + imager.range[300] * way]).max()
        for way in (np.array([1.0, 0.0, 0.0]), edge)
    )
    assert 10.0 * np.log10(level / low) == pytest.approx(6.0, abs=1.0)


@pytest.mark.statistics
def test_a_fading_point_is_rayleigh_and_glints_wander():
    small = {**NOWHERE, 'image_bins': 240, 'image_beams': 128, 'horizontal_fov_deg': 22.5}
    imager = sonar(**{**small, 'target_fading': 'rayleigh', 'image_gain': 4.0})
    place = [np.array([50.0, 0.0, 20.0])]
    peaks = np.array([powers(imager, 1, place)[116:124, 56:72].max() for _ in range(60)])
    assert 0.6 < peaks.std() / peaks.mean() < 1.4
    chain = sonar(**{**small, 'target': 'chain', 'target_size': 10.0})
    images = [powers(chain, 1, place) for _ in range(30)]
    weights = [np.where(image > 8.0, image, 0.0).sum(axis=0) for image in images]
    centres = [np.average(chain.bearing, weights=weight) for weight in weights if weight.any()]
    assert np.std(centres) > 0.005


def test_a_wreck_is_the_outline_of_a_hull():
    small = {**NOWHERE, 'image_bins': 240, 'image_beams': 128, 'horizontal_fov_deg': 22.5}
    wreck = {'target': 'wreck', 'target_size': 12.0, 'target_snr_db': 30.0}
    imager = sonar(**{**small, **wreck, 'image_gain': 4.0})
    imager.heading = 0.0  # bow away from the sonar
    power = powers(imager, 12, [np.array([40.0, 0.0, 20.0])])
    row = np.searchsorted(imager.range, 40.0)
    beams = [np.argmin(np.abs(imager.bearing - side / 40.0)) for side in (-1.44, 0.0, 1.44)]
    port, inside, starboard = power[row - 2 : row + 3][:, beams].mean(axis=0)
    assert min(port, starboard) > 4.0 * inside
    # As long as asked for: 7 m from the middle, beyond bow and stern, there is nothing.
    along = power.max(axis=1)
    near, far = (np.abs(imager.range - 40.0) < limit for limit in (5.0, 7.0))
    assert along[near].min() > 3.0 * along[~far].max()


def test_the_sea_floor_is_patchy_and_its_patches_stay_in_the_world():
    values = {**NOWHERE, 'altitude': 6.0, 'seabed_shape': 0.5, 'image_gain': 8.0}
    imager = sonar(**values)
    here = powers(imager, 25)
    moved = Pose(np.array([3.0, 0.0, 20.0]), np.eye(3))
    there = powers(imager, 25, pose=moved)
    step = imager.range[1] - imager.range[0]
    shift = round(3.0 / step)
    ahead = slice(118, 138)  # straight ahead a patch comes nearer by 3 m
    first, second = here[350:500, ahead], there[350 - shift : 500 - shift, ahead]
    assert np.corrcoef(first.ravel(), second.ravel())[0, 1] > 0.5
    unmoved = there[350:500, ahead]
    assert np.corrcoef(first.ravel(), unmoved.ravel())[0, 1] < 0.3
    assert here[:30].mean() == pytest.approx(1.0, abs=0.05)  # nearer than the floor


def test_images_take_the_place_of_detections_and_the_rest_stays():
    values = {'last_range': 80.0, 'image_bins': 200, 'image_beams': 64}
    plain = simulate(scenario('approach', values), seed=3)
    scene = simulate(scenario('approach', {**values, 'images': True}), seed=3)
    again = simulate(scenario('approach', {**values, 'images': True}), seed=3)
    images, same = (
        [x.measurement for x in each.measurements if isinstance(x.measurement, SonarImage)]
        for each in (scene, again)
    )
    assert len(images) == 14 and images[0].amplitude.shape == (200, 64)
    assert all((a.amplitude == b.amplitude).all() for a, b in zip(images, same))
    np.testing.assert_array_equal(scene.truth[0].vertical_offset, plain.truth[0].vertical_offset)
    others = [len(item.measurements) - 14 for item in (scene, plain)]
    assert others[0] == others[1]
    with pytest.raises(ConfigError, match='instant'):
        scenario('approach', {'images': True, 'ping_timing': 'two_way'})
