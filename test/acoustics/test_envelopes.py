# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Envelopes of profilers: noise, pulse and normal numbers, against vectors and closed forms."""

from helpers.vector_files import load_vectors
import numpy as np
import pytest
from scipy.stats import norm

from sonar_imm.acoustics.envelopes import (
    first_noise,
    from_normal,
    is_envelope,
    log_likelihoods,
    pulse_and_lead,
    quietest,
    rise,
    scatter_power,
    to_normal,
    transmit_samples,
    water_noise,
)


@pytest.fixture(scope='module')
def vectors():
    return load_vectors('fathometer_in_the_field/floor')


def test_tables_of_the_vectors(vectors):
    trace, step = vectors['trace'], float(vectors['step'])
    assert transmit_samples(trace) == vectors['ring_look']
    noise = first_noise(trace)
    assert noise == pytest.approx(vectors['noise_profile'], rel=1e-6)
    pulse, _, _ = pulse_and_lead(trace, vectors['first_onset'])
    assert step * pulse == pytest.approx(float(vectors['pulse']), rel=1e-6)
    # The transmit pulse of the first pass ends at 31 in most traces.
    found = water_noise(trace, noise, 31, vectors['first_onset'], pulse)
    assert found == pytest.approx(vectors['water_profile'], rel=1e-6)
    logs = log_likelihoods(trace[0], found, float(vectors['loudest']))
    for log, name in zip(logs, ('log_quiet', 'log_loud', 'log_onset')):
        assert log == pytest.approx(vectors[name], abs=1e-6)


def test_normal_numbers_of_the_vectors():
    scalars = load_vectors('fathometer_in_the_field/scalars')
    x, expected = scalars['x'], scalars['gaussian']
    b = to_normal(x)
    assert b == pytest.approx(expected, abs=1e-6) and b.min() >= -3.0903
    assert np.diff(b[x > 6.0]) == pytest.approx(np.sqrt(2.0) * np.diff(x[x > 6.0]))
    back, _ = from_normal(b)
    assert back[b > -3.09] == pytest.approx(x[b > -3.09], rel=1e-9)


def test_noise_becomes_normal_and_back():
    rng = np.random.default_rng(0)
    b = to_normal(rng.rayleigh(np.sqrt(0.5), 200_000))
    assert np.mean(b) == pytest.approx(0.0, abs=0.01) and np.std(b) == pytest.approx(1.0, abs=0.01)
    for level in (0.1, 0.5, 0.99):
        assert np.mean(b < norm.ppf(level)) == pytest.approx(level, abs=0.005)
    at = np.array([-2.0, 0.0, 3.0, 7.0, 9.0, 20.0])
    x, slope = from_normal(at)
    assert to_normal(x) == pytest.approx(at)
    near, _ = from_normal(at + 1e-5)
    assert slope == pytest.approx((near - x) / 1e-5, rel=1e-3)


def test_first_maximum_and_its_rise():
    cell = np.arange(60.0)
    trace = np.exp(-0.5 * np.square((cell - 30.0) / 3.0))
    width, top = rise(trace, 20)
    assert top == 30 and width == pytest.approx(3.0, rel=0.02)
    # A ripple on the way up is no maximum, and what is louder right below counts.
    ripple = trace + 0.05 * (cell == 24)
    assert rise(ripple, 20)[1] == 30
    assert rise(np.zeros(60), 20) is None or rise(np.zeros(60), 20)[0] == 0.0
    assert rise(trace, 59) is None
    few = np.repeat(trace[None], 9, axis=0)
    assert np.isnan(pulse_and_lead(few, np.full(9, 20))[0])
    many = np.repeat(trace[None], 12, axis=0)
    pulse, lead, spread = pulse_and_lead(many, np.array([-1] * 2 + [20] * 10))
    assert (pulse, lead) == pytest.approx((3.0, 10.0), rel=0.02) and spread < 0.5


def test_scatter_begins_below_the_floor():
    rng, cell = np.random.default_rng(1), np.arange(400)
    level = 5.0 * np.exp(-(cell - 100) / 60.0) * (cell > 100)
    trace = np.hypot(*(np.sqrt(0.5) * rng.standard_normal((2, 400)))) * np.hypot(1.0, level)
    power = scatter_power(trace, np.ones(400), 100, 2.5)
    assert (power >= 0.0).all() and (np.diff(power) <= 0.0).all()
    # Four pulses, 10 samples, below the onset; of a single trace a little less than it is.
    assert power[20] == pytest.approx(level[130] ** 2, rel=0.6)
    assert power[250] < 2.0 and power[290:].max() == 0.0
    assert not scatter_power(trace, np.ones(400), 395, 2.5).any()


def test_missing_samples_say_nothing():
    rng = np.random.default_rng(2)
    traces = rng.rayleigh(1.0, (60, 100))
    traces[:, :10] = np.nan
    traces[::2, 80:] = np.nan
    noise = first_noise(traces)
    assert np.isfinite(noise).all() and noise[50] == pytest.approx(np.sqrt(2.0), rel=0.5)
    logs = log_likelihoods(traces[0], noise, 5.0)
    assert all((log[:10] == 0.0).all() and log[20] != 0.0 for log in logs)
    assert transmit_samples(np.nan_to_num(traces, nan=9.0)) >= 10


def test_what_is_an_envelope():
    trace = np.array([0.0, 1.0, np.nan, 2.0])
    assert is_envelope(trace) and not is_envelope(-trace) and not is_envelope(0.0 * trace)
    assert quietest(trace) > 0.0
