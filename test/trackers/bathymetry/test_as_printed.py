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

"""`variant: paper` takes what the paper takes where nothing else is stated."""

from attrs import evolve
from helpers.bathymetry_cases import floor
import numpy as np
import pytest

from sonar_imm.trackers.bathymetry.ping import look, Ping, run, run_particles
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker

RANGES = 17.0 + 0.05 * np.arange(200)
STATED = {
    'height_rw_ncs': {'sigmas': (1.0, 1.0)},
    'height_two_rw': {'sigmas': (0.01, 1.0)},
    'angle_two_rw': {'sigmas_deg': (0.1, 0.1, 2.0)},
}


def same(a, b):
    return all(np.array_equal(v, b.columns()[k], equal_nan=True) for k, v in a.columns().items())


@pytest.mark.parametrize('name', STATED)
def test_its_values_are_those_of_the_paper(name):
    ping = floor(0.0, ranges=RANGES, shadow=slice(60, 80))
    printed = BathymetryConfig(variant='paper', model_set=name)
    stated = BathymetryConfig(
        variant='paper',
        model_set=name,
        stay_probability=0.98,
        initial_probabilities=(0.5, 0.5),
        particles_per_model=100,
        shadow_gate=False,
        angle_drift=False,
        smoothing='none',
        redrawn_slope_std=0.0,
        **STATED[name],
    )
    found = BathymetryTracker(printed).process(ping)[0]
    assert same(found, BathymetryTracker(stated).process(ping)[0])
    assert found.extras['valid'].all()  # it tracks through shadows
    corrected = BathymetryTracker(evolve(printed, variant='corrected')).process(ping)[0]
    assert not same(found, corrected) and not corrected.extras['valid'].all()


def test_what_is_stated_counts():
    config = BathymetryConfig(variant='paper', sigmas=(0.02, 0.3), stay_probability=0.9)
    assert config.sigmas_used == (0.02, 0.3) and config.stay_used == 0.9
    assert BathymetryConfig(variant='paper').sigmas_used == (0.01, 1.0)
    assert BathymetryConfig(variant='paper').stay_used == 0.98
    bank = BathymetryConfig(variant='paper', model_set='height_bank')
    assert len(bank.sigmas_used) == 4  # not in the paper


def test_watching_the_particles_changes_nothing():
    ping = floor(0.0, ranges=RANGES)
    seen = look(Ping(BathymetryConfig(variant='paper'), ping, None))
    watched = []

    def watch(t, particles):
        watched.append((t, float((particles.mu[:, None] * particles.w * particles.x[:, 0]).sum())))

    track = run_particles(
        seen.models, seen.likelihood, 100, (0, ping.stamp_ns, 0), resample=True, watch=watch
    )
    assert np.array_equal(track.mean, run(seen).mean)
    assert [t for t, _ in watched] == list(range(len(RANGES)))
    assert [mean for _, mean in watched] == pytest.approx(track.mean[:, 0], abs=1e-12)
