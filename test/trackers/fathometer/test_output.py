# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What is made of both beams: coherence, correlation, what the paper prints; real or envelope."""

import numpy as np
import pytest

from sonar_imm.acoustics.fathometer import printed_correlation, steering
from sonar_imm.acoustics.pulse import envelope_pulse
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.fathometer.config import FathometerConfig
from sonar_imm.trackers.fathometer.response import array_response, Lattice
from sonar_imm_tools.simulation.fathometer.scenario import Drift
from sonar_imm_tools.simulation.fathometer.simulator import cross_spectra, scenario

LAYER, ARRAY = 130.0, 73.5


@pytest.fixture(scope='module')
def spectra():
    config = scenario('small', {'ship_noise': 0.0, 'snapshots': 4000})
    layer = np.array([[LAYER]])
    floor = Drift(layer, 0.5 * np.ones((1, 1)), layer > 0.0, np.array([ARRAY]), np.array([ARRAY]))
    return cross_spectra(config, floor, 0, ARRAY, np.random.default_rng(0))


def received(spectra, low, high, **options):
    """Depth and response between `low` and `high`, and the noise at the layer."""
    stated = scenario('small').instruments()
    config = FathometerConfig(**stated, noise_depth_min=0.0, noise_depth_max=0.0, **options)
    lattice = Lattice(low, 0.03, int((high - low) / 0.03))
    found = array_response(spectra, lattice, config, ARRAY)
    return found.depth, found.amplitude, np.interp(LAYER, found.depth, found.sigma)


@pytest.mark.parametrize('output', ['coherence', 'correlation'])
def test_echoes_are_positive_and_where_they_should_be(spectra, output):
    depth, b, sigma = received(spectra, 100.0, 140.0, output=output)
    assert depth[np.argmax(b)] == pytest.approx(LAYER, abs=0.15)
    assert b.max() > 2.5 * sigma
    depth, e, _ = received(spectra, 100.0, 140.0, output=output, envelope=True)
    assert (e >= np.abs(b) - 1e-12).all()
    assert depth[np.argmax(e)] == pytest.approx(LAYER, abs=0.2)


def test_equation_4_as_printed_has_its_echo_above_the_array(spectra):
    w = steering(spectra.frequency, 0.36 * np.arange(8), 1500.0)
    C = printed_correlation(spectra.csdm, w, 'mvdr', loading=1e-3)
    z = np.arange(110.0, 140.0, 0.03)
    way = 4.0j * np.pi * spectra.frequency[:, None] * (z - ARRAY) / 1500.0
    at_depth, above = (np.abs((C[:, None] * np.exp(s * way)).mean(axis=0)) for s in (1.0, -1.0))
    assert z[np.argmax(above)] == pytest.approx(LAYER, abs=0.2)
    assert above.max() > 2.0 * at_depth.max()
    # The tracker, which looks below the array, is told so and finds less there.
    _, e, _ = received(spectra, 110.0, 140.0, output='printed', envelope=True, loading=1e-3)
    assert e.max() == pytest.approx(at_depth.max(), rel=0.1)


def test_the_conventional_one_is_printed_right(spectra):
    _, e, _ = received(
        spectra, 110.0, 140.0, output='printed', envelope=True, processor='conventional'
    )
    _, c, _ = received(
        spectra, 110.0, 140.0, output='correlation', envelope=True, processor='conventional'
    )
    assert e == pytest.approx(c, rel=1e-5)


def test_the_pulse_of_an_envelope():
    pulse = envelope_pulse(50.0, 4000.0, 1500.0)
    assert pulse(np.array([0.0]))[0] == 1.0
    first_zero = 1500.0 / (2.0 * 3950.0)
    assert pulse(np.array([first_zero]))[0] == pytest.approx(0.0, abs=1e-12)
    assert (pulse(np.linspace(-3.0, 3.0, 999)) >= 0.0).all()
    with pytest.raises(ValueError):
        envelope_pulse(10.0, 5.0, 1500.0)


def test_what_cannot_be_printed_is_refused():
    with pytest.raises(ConfigError, match='printed'):
        FathometerConfig(output='printed', processor='white_noise')
