# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Pulses and what follows from them."""

import json
from pathlib import Path

import numpy as np
import pytest

from sonar_imm.acoustics.pulse import (
    band_pulse,
    gaussian_pulse,
    gram,
    independent_samples,
    measured_pulse,
)

GOLDEN = Path(__file__).parents[1] / 'vectors' / 'fathometer' / 'golden.json'


def test_band_pulse_is_the_golden_one():
    wanted = json.loads(GOLDEN.read_text())['pulse lattice lag 4,20,100 (50-4000) vs closed form']
    pulse = band_pulse(50.0, 4000.0, 1500.0)
    assert pulse(np.array([4, 20, 100]) / 64.0) == pytest.approx(wanted[1], abs=1e-12)
    assert pulse(0.0) == 1.0
    fine = np.linspace(0.0, 0.2, 20_001)
    assert fine[np.argmax(pulse(fine) < 0.0)] == pytest.approx(0.1, abs=0.01)


def test_a_gram_matrix_is_one_of_inner_products():
    for pulse in (band_pulse(200.0, 4000.0, 1500.0), gaussian_pulse(0.3)):
        G = gram(pulse, [1.0, 1.4, 2.2, 9.0])
        assert np.array_equal(G, G.T)
        assert np.linalg.eigvalsh(G)[0] > 0.0
        assert np.diag(G) == pytest.approx(1.0)


def test_a_band_has_two_b_t_independent_samples():
    pulse = band_pulse(50.0, 4000.0, 1500.0)
    assert independent_samples(pulse, 50.0, 0.005) == pytest.approx(527.0, rel=0.01)


def test_a_measured_pulse_is_even_and_scaled():
    pulse = measured_pulse([-0.2, -0.1, 0.0, 0.1, 0.2], [0.0, 2.2, 4.0, 1.8, 0.0])
    assert pulse(np.array([0.0, 0.1, -0.1, 0.15, 3.0])) == pytest.approx(
        [1.0, 0.5, 0.5, 0.25, 0.0]
    )
    assert measured_pulse([0.0, 1.0], [1.0, 0.0])(0.25) == pytest.approx(0.75)


@pytest.mark.parametrize(
    'distance, value',
    [
        ([0.0], [1.0]),
        ([0.0, 1.0], [1.0]),
        ([0.5, 1.0], [1.0, 0.0]),
        ([0.0, 1.0], [-1.0, 0.0]),
        ([0.0, 1.0], [0.0, 1.0]),
        ([0.0, np.nan], [1.0, 0.0]),
    ],
)
def test_what_is_no_pulse_is_refused(distance, value):
    with pytest.raises(ValueError):
        measured_pulse(distance, value)


def test_bands_and_widths_that_cannot_be():
    with pytest.raises(ValueError):
        band_pulse(4000.0, 50.0, 1500.0)
    with pytest.raises(ValueError):
        gaussian_pulse(0.0)
