# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The bathymetry tracker as printed: the values of the paper, and its errata at work."""

from helpers.bathymetry_cases import floor
import numpy as np
import pytest

from benchmarks.bathymetry_paper import ANGLES, PrintedTracker, SETS
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker

RANGES = 17.0 + 0.05 * np.arange(200)
OF_PAPER = {'angle_two_rw': ANGLES, **{name: values(1.0) for name, values in SETS.items()}}


def config_of(name, **values):
    return BathymetryConfig(**{**OF_PAPER[name], **values})


def rmse(estimate, height):
    return float(np.sqrt(np.mean(np.square(estimate.columns()['height'] - height))))


@pytest.mark.parametrize('name', OF_PAPER)
def test_every_set_of_the_paper_finds_a_flat_floor_and_tracks_through_a_shadow(name):
    ping = floor(0.4, ranges=RANGES, shadow=slice(60, 80))
    estimate = PrintedTracker(config_of(name)).process(ping)[0]
    heard = np.delete(estimate.columns()['height'], slice(60, 90))
    assert np.sqrt(np.mean(np.square(heard - 0.4))) < 0.25
    assert estimate.extras['valid'].all() and 'surfaces' not in estimate.extras
    default = BathymetryTracker(BathymetryConfig(model_set=name)).process(ping)[0]
    assert not default.extras['valid'].all()


def test_the_slope_model_as_printed_is_a_random_walk_in_disguise():
    ranges = 17.0 + 0.05 * np.arange(800)
    height = 0.1 * (ranges - ranges[0])
    snapshot = floor(height, ranges=ranges)
    only = {'transition_matrix': (1.0, 0.0, 0.0, 1.0), 'initial_probabilities': (0.0, 1.0)}
    config = config_of('height_rw_ncs', **only)
    corrected = rmse(BathymetryTracker(config).process(snapshot)[0], height)
    assert corrected < 0.25
    assert rmse(PrintedTracker(config).process(snapshot)[0], height) > 3.0 * corrected
