# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What is said of a recording: a noise that is stated wrong, a signal that all staves share."""

import math

from attrs import evolve
from helpers.bathymetry_cases import floor
from helpers.tracked import BAGS
import numpy as np
import pytest

from sonar_imm.acoustics.coherence import common_mode
from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.findings import noise_warnings, residual_ratio
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.reader import BagReader
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


def shared(snapshot, level_db, seed=5):
    """The snapshot with a signal that is the same at all staves, in decibels over the noise."""
    rng = np.random.default_rng(seed)
    T = len(snapshot)
    both = rng.normal(size=(T, 2)).view(complex) * np.sqrt(0.5) * 10.0 ** (level_db / 20.0)
    return evolve(snapshot, iq=(snapshot.iq + both).astype(np.complex64))


def lines_and_health(snapshot, **values):
    tracker = BathymetryTracker(BathymetryConfig.from_mapping(values))
    tracker.process(snapshot)
    return [line for line in tracker.warnings() if 'same phase' in line], tracker.health()


@pytest.mark.parametrize('values', [{}, {'gate_false_alarm': 1.0}, {'tilt_deg': 0.0}])
@pytest.mark.parametrize('P', [2, 4, 8])
def test_a_signal_common_to_the_staves_is_said(P, values):
    clean = floor(0.0, snr_db=10.0, P=P, ranges=15.5 + 0.05 * np.arange(600))
    loud, health = lines_and_health(shared(clean, 30.0), **values)
    assert len(loud) == 1 and health['common_mode'] > 0.5
    quiet, health = lines_and_health(clean, **values)
    assert not quiet and health['common_mode'] < 0.1


def test_so_is_what_the_staves_of_one_card_share():
    clean = floor(0.0, snr_db=10.0, ranges=15.5 + 0.05 * np.arange(600))
    cards = [
        shared(clean, 30.0, seed).iq[:, part] for seed, part in ((5, np.s_[:4]), (6, np.s_[4:]))
    ]
    lines, _ = lines_and_health(evolve(clean, iq=np.hstack(cards)), gate_false_alarm=1.0)
    assert len(lines) == 1


def test_a_weak_one_under_a_floor_is_not():
    clean = floor(0.0, snr_db=25.0)
    lines, health = lines_and_health(shared(clean, 0.0))
    assert not lines and health['common_mode'] < 0.1


@pytest.mark.parametrize('tilt_deg', [0.0, 3.0, 30.0, 60.0, 90.0])
def test_a_flat_floor_is_a_floor_wherever_the_array_looks(tilt_deg):
    ranges = 15.1 + 0.05 * np.arange(1200)
    lines, _ = lines_and_health(floor(0.0, tilt_deg=tilt_deg, ranges=ranges), tilt_deg=tilt_deg)
    assert not lines


def test_noise_has_no_common_mode():
    rng = np.random.default_rng(1)
    iq = rng.normal(size=(800, 8, 2)).view(complex)[..., 0]
    assert common_mode(iq, np.ones(800, bool)) < 0.1
    assert common_mode(np.ones((800, 8)), np.ones(800, bool)) == 1.0
    # In a quarter of the swath alone it may be a floor.
    assert common_mode(np.ones((800, 8)), np.arange(800) < 200) == 0.0


@pytest.mark.parametrize('name', ['bathymetry_paper', 'bathymetry_shadow', 'bathymetry_ship'])
def test_shipped_recordings_have_none(name):
    with BagReader(BAGS / name) as bag:
        found = [item.measurement for item in measurements_of(bag, 'bathymetry')]
    shares = [common_mode(each.iq, each.usable) for each in found if isinstance(each, Snapshot)]
    assert len(shares) > 5 and max(shares) < 0.2
