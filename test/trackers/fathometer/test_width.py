# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Traces whose echoes are not as wide as those of the band, where nobody has told it."""

from helpers.fathometer_runs import run
from helpers.vector_files import load_vectors
import numpy as np
import pytest

from sonar_imm.acoustics.pulse import band_pulse
from sonar_imm.measurements import Trace
from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm.trackers.fathometer.tracker import FathometerTracker
from sonar_imm.trackers.fathometer.width import EchoWidth, half_width

LAYERS, STRENGTH = np.array([14.0, 19.5, 27.0]), np.array([1.0, 0.5, 0.3])


def made(width, records=12, noise=0.05, seed=5):
    """Traces (T,) of three Gaussian echoes that wander."""
    rng, depth, layers = np.random.default_rng(seed), 0.1 * np.arange(400), LAYERS
    for k in range(records):
        layers = layers + 0.05 * rng.standard_normal(3)
        echoes = np.exp(-0.5 * np.square((depth[:, None] - layers) / width)) @ STRENGTH
        yield Trace(
            stamp_ns=(k + 1) * 10**9,
            depth=depth,
            amplitude=echoes + noise * rng.standard_normal(400),
            sigma=np.full(400, noise),
        )


def test_half_width_is_that_of_the_narrowest_loud_echo():
    z = np.arange(400, dtype=np.float64)
    b = 40.0 * np.exp(-0.5 * np.square((z - 100.3) / 4.0))
    b += 60.0 * np.exp(-0.5 * np.square((z - 200.0) / 9.0))
    b += 9.0 * np.exp(-0.5 * np.square((z - 300.0) / 2.0))  # not loud
    assert half_width(b) == pytest.approx(4.0 * np.sqrt(2.0 * np.log(2.0)), rel=0.02)
    assert np.isnan(half_width(0.1 * b)) and np.isnan(half_width(np.zeros(5)))
    # It has to end within the trace on both sides.
    assert np.isnan(half_width(40.0 * np.exp(-z / 50.0)))


@pytest.mark.parametrize('width', [0.15, 0.25, 0.5, 1.0])
def test_width_of_the_echoes_is_found_and_used_from_the_first_trace_on(width):
    tracker, found = run(made(width), particles=1000)
    assert tracker.health()['pulse_width'] == pytest.approx(width, rel=0.15)
    orders = [int(np.argmax(each.probabilities[0])) + 1 for each in found.values()]
    assert orders == [3] * 12 and tracker.warnings() == []
    assert len(set(np.concatenate([e.extras['track_id'] for e in found.values()]))) == 3


def test_pulse_of_the_band_is_left_alone():
    config, band = FathometerConfig(), band_pulse(50.0, 4000.0, 1500.0)
    traces = load_vectors('fathometer/mvdr_traces')
    found = EchoWidth()
    for amplitude, sigma in zip(traces['amplitude'][:60], traces['sigma']):
        trace = Trace(
            stamp_ns=1,
            depth=traces['depth'],
            amplitude=amplitude,
            sigma=np.full(len(amplitude), sigma),
        )
        assert not found.take(trace, config, band)
    assert found.effective(config) == config
    # What is told is used, and echoes narrower than the samples say nothing.
    wide = next(made(0.5))
    assert not EchoWidth().take(wide, FathometerConfig(pulse='band'), band)
    assert not EchoWidth().take(next(made(0.03)), config, band)


def test_pulse_is_judged_anew_until_many_traces_have_shown_it():
    found, config, band = EchoWidth(), FathometerConfig(), band_pulse(50.0, 4000.0, 1500.0)
    widths = np.repeat([0.3, 0.5, 0.8, 1.3, 2.0], [1, 4, 10, 45, 20])
    taken = [found.take(next(made(width)), config, band) for width in widths]
    assert (np.flatnonzero(taken) + 1).tolist() == [1, 5, 15, 60]


def test_room_for_all_reflectors_is_left():
    found, config = EchoWidth(), FathometerConfig(order_max=12)
    assert found.take(next(made(2.0)), config, band_pulse(50.0, 4000.0, 1500.0))
    own = found.effective(config)
    assert own.pulse == 'gaussian' and own.pulse_width == pytest.approx(2.0, rel=0.2)
    assert 12.0 * own.min_separation < 40.0
    FathometerTracker(config).process(next(made(2.0)))
    found._seen = np.array([np.nan])
    with pytest.raises(ValueError, match='no echo is as wide'):
        found.require()
