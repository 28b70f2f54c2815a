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

"""A noise that is stated wrong is said; one that is true is not."""

import math

from attrs import evolve
import numpy as np
import pytest

from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.config import BathymetryConfig
from sonar_imm.trackers.bathymetry.ping import residual_ratio
from sonar_imm.trackers.bathymetry.tracker import BathymetryTracker, noise_warnings
from sonar_imm_tools.simulation.bathymetry import simulator as swath


@pytest.mark.parametrize('fading', [False, True])
@pytest.mark.parametrize('staves, spacing', [(4, 0.5), (8, -0.5)])
def test_what_is_left_beside_an_echo_is_the_noise(fading, staves, spacing):
    """Whatever the echo, and whether or not its power fades: to five standard deviations."""
    rng = np.random.default_rng(5)
    T, noise = 4000, 0.3
    sines = rng.uniform(-0.9, 0.9, T)
    white = rng.normal(size=(T, staves + 1)) + 1j * rng.normal(size=(T, staves + 1))
    white *= math.sqrt(0.5)
    steer = np.exp(2j * np.pi * spacing * sines[:, None] * np.arange(staves))
    y = 7.0 * white[:, :1] * steer + math.sqrt(noise) * white[:, 1:]
    if fading:
        y *= np.sqrt(rng.exponential(size=(T, 1)))
    stated, every = np.full(T, noise), np.ones(T, bool)
    of_fading = 2.0 * (1.0 + 1.0 / (staves - 1)) - 1.0
    std = math.sqrt((of_fading if fading else 1.0 / (staves - 1)) / T)
    ratio = residual_ratio(y, sines, spacing, stated, every)
    assert abs(ratio - 1.0) < 5.0 * std
    assert residual_ratio(y, sines, spacing, 4.0 * stated, every) == pytest.approx(ratio / 4.0)
    assert math.isnan(residual_ratio(y, sines, spacing, stated, np.arange(T) < 99))


def test_the_median_ping_decides_and_a_few_are_not_enough():
    assert not noise_warnings([4.0] * 4 + [math.nan] * 50)
    assert not noise_warnings([4.0, 9.0, 1.9, 1.0, 1.0])
    (high,) = noise_warnings([4.0] * 5)
    (low,) = noise_warnings([0.25] * 5)
    assert 'cannot be true' in high and 'element_spacing' in high
    assert '0.25 times' in low and 'element_spacing' not in low


@pytest.mark.parametrize('factor, warned', [(1.0, False), (4.0, True), (0.25, True)])
def test_a_noise_variance_that_is_wrong_by_four_is_said(factor, warned):
    scene = swath.scenario('paper', {'pings': 6})
    tracker = BathymetryTracker(BathymetryConfig(**scene.instruments()))
    for each in swath.simulate(scene, 4).measurements:
        found = each.measurement
        if isinstance(found, Snapshot):
            found = evolve(found, noise_variance=factor * found.noise_variance)
        tracker.process(found)
    assert any('cannot be true' in sentence for sentence in tracker.warnings()) == warned
    assert tracker.health()['residual_ratio'] == pytest.approx(1.0 / factor, rel=0.2)


def test_without_a_stated_noise_there_is_nothing_to_test():
    scene = swath.scenario('paper', {'pings': 6})
    tracker = BathymetryTracker(BathymetryConfig(**scene.instruments()))
    for each in swath.simulate(scene, 4).measurements:
        if isinstance(each.measurement, Snapshot):
            tracker.process(evolve(each.measurement, noise_variance=None))
    assert math.isnan(tracker.health()['residual_ratio'])
