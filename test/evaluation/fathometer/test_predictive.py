# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What of the fathometer is tuned."""

import numpy as np
import pytest

from sonar_imm.measurements import Trace
from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm_tools.evaluation.fathometer.predictive import for_tuning, Scored, tunables


def names(sigma=None, **values):
    trace = Trace(stamp_ns=1, depth=np.arange(3.0), amplitude=np.ones(3), sigma=sigma)
    return [found.name for found in tunables(FathometerConfig(**values), [trace])]


ALWAYS = ['depth_std', 'amplitude_std_sigmas']


@pytest.mark.parametrize('pulse, more', [('gaussian', ['pulse_width']), ('auto', [])])
def test_the_width_of_a_pulse_that_has_one_is_tuned(pulse, more):
    assert names(np.ones(3), pulse=pulse) == ALWAYS + more


def test_the_noise_of_traces_that_do_not_state_it_is_tuned():
    assert names(noise_sigma=0.5, pulse='auto') == ['noise_sigma', *ALWAYS]


def total(depth_std, stated=0.3):
    """Log evidence of five traces of noise alone, of 0.3."""
    rng, depth = np.random.default_rng(4), np.arange(100.0, 160.0, 0.1)
    traces = [
        Trace(
            stamp_ns=k * 10**9,
            depth=depth,
            amplitude=0.3 * rng.normal(size=len(depth)),
            sigma=np.full(len(depth), stated),
        )
        for k in range(1, 6)
    ]
    tracker = Scored(for_tuning(FathometerConfig(depth_std=depth_std, particles=500)), traces)
    for trace in traces:
        tracker.process(trace)
    return sum(score for score, _ in tracker.scores.values())


def test_depths_between_the_samples_of_a_trace_are_no_data():
    """A small `depth_std` needs a finer grid: noise alone stays as probable as it was."""
    assert total(0.01) == pytest.approx(total(0.2), abs=15.0)


def test_noise_is_most_probable_as_what_it_is():
    assert total(0.2) > max(total(0.2, 0.25), total(0.2, 0.36))
