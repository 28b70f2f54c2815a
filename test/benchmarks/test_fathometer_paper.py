# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The fathometer tracker as printed: its model of sets, and what a bootstrap filter costs."""

from helpers.vector_files import load_vectors
import numpy as np
import pytest

from benchmarks.fathometer_paper import BOOTSTRAP, ChangedTracker, ENVELOPE, PENALTY, score
from sonar_imm.measurements import Trace
from sonar_imm.trackers.fathometer.tracker import FathometerConfig


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
