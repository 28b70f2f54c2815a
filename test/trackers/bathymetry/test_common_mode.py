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

"""A signal that all staves share is no floor, and is said."""

from attrs import evolve
from helpers.bathymetry_cases import floor
from helpers.tracked import BAGS
import numpy as np
import pytest

from sonar_imm.acoustics.coherence import common_mode
from sonar_imm.measurements import Snapshot
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.reader import BagReader


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


@pytest.mark.parametrize('values', [{}, {'shadow_gate': False}, {'tilt_deg': 0.0}])
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
    lines, _ = lines_and_health(evolve(clean, iq=np.hstack(cards)), shadow_gate=False)
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
