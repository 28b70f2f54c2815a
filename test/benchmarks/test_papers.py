# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Trackers as printed: of a swath the values of the paper, and its errata at work; of a fathometer
the model of sets, and what a bootstrap filter costs."""

from helpers.bathymetry_cases import floor
from helpers.vector_files import load_vectors
import numpy as np
import pytest

from benchmarks.bathymetry_paper import ANGLES, PrintedTracker, SETS
from benchmarks.fathometer_paper import BOOTSTRAP, ChangedTracker, ENVELOPE, PENALTY, score
from sonar_imm.measurements import Trace
from sonar_imm.trackers.bathymetry.tracker import BathymetryConfig, BathymetryTracker
from sonar_imm.trackers.fathometer.tracker import FathometerConfig

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


@pytest.fixture(scope='module')
def drift():
    """(trace, true depths) of the first 60 records of the vectors."""
    kept = load_vectors('fathometer/mvdr_traces')
    strength, depth = kept['reflector_amplitude'], kept['depth']
    there = strength > 0.4 * strength.max(axis=0)
    sigma = np.broadcast_to(np.ravel(kept['sigma']), len(strength))
    found = []
    for k in range(60):
        heard = {'amplitude': kept['amplitude'][k], 'sigma': np.full(len(depth), sigma[k])}
        trace = Trace(stamp_ns=(k + 1) * 90 * 10**9, depth=depth, **heard)
        found.append((trace, kept['reflector_depth'][k][there[k]].astype(float)))
    return found


def distance(drift, changes, **values):
    """Mean OSPA, m."""
    tracker = ChangedTracker(FathometerConfig(particles=3000, **values), **changes)
    scores = [score(tracker.process(trace)[-1], depth) for trace, depth in drift]
    return np.mean([apart for _, apart in scores])


def test_the_model_of_the_sets_is_that_of_the_paper_after_a_reset_too(drift):
    tracker = ChangedTracker(FathometerConfig(particles=50, **ENVELOPE), **PENALTY, **BOOTSTRAP)
    for _ in range(2):
        tracker.process(drift[0][0])
        model = tracker._filter.model
        assert model.amplitude_prior == 'paper' and model.walk_share == model.birth_share == 0.0
        assert model.order_min == 7 and model.independent_samples > 100.0
        tracker.reset()


@pytest.mark.statistics
def test_a_bootstrap_filter_does_not_find_the_reflectors(drift):
    assert distance(drift, BOOTSTRAP) > 5.0 * distance(drift, {})
    assert distance(drift, BOOTSTRAP, order_min=7, order_max=7) > 0.5
