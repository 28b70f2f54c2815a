# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

import numpy as np
from oracles.array_likelihood import interfered_log_likelihood, log_likelihood
from oracles.bin_likelihood import log_likelihoods
import pytest

from sonar_imm.acoustics import array, interference, laplace

STAVES, SPACING = 8, 0.5
STEP = array.phase_step(SPACING)
SINES = np.array([[0.3, -0.2], [0.1, np.nan], [0.5, 0.55]])
VARIANCES = np.array([[5.0, 2.0], [3.0, 3.0], [0.0, 4.0]])
NOISE = np.array([1.0, 0.5, 2.0])


@pytest.fixture
def scene():
    rng = np.random.default_rng(0)
    y = rng.normal(size=(3, STAVES)) + 1j * rng.normal(size=(3, STAVES))
    return y, interference.noise_covariance(SINES, VARIANCES, NOISE, STAVES, STEP)


def test_the_covariance_is_the_sum_of_its_parts(scene):
    _, covariance = scene
    a, b = (array.steering(u, STAVES, SPACING) for u in (0.3, -0.2))
    first = 5.0 * np.outer(a, a.conj()) + 2.0 * np.outer(b, b.conj()) + np.eye(STAVES)
    assert np.allclose(covariance[0], first)
    a, b = (array.steering(u, STAVES, SPACING) for u in (0.1, 0.55))
    assert np.allclose(covariance[1], 3.0 * np.outer(a, a.conj()) + 0.5 * np.eye(STAVES))
    assert np.allclose(covariance[2], 4.0 * np.outer(b, b.conj()) + 2.0 * np.eye(STAVES))


@pytest.mark.parametrize('likelihood', laplace.LIKELIHOODS)
def test_the_likelihood_by_its_parts_is_that_of_linear_algebra(scene, likelihood):
    y, covariance = scene
    form = interference.interference_form(y, covariance)
    u, signal = np.append(np.linspace(-1.0, 1.0, 41), np.nan), 7.0
    for n in range(3):
        out = log_likelihoods(
            u, SPACING, -signal * form.beam[n], form.base[n], form.spread[n], signal,
            laplace.likelihood_table(STAVES, likelihood),
        )  # fmt: skip
        expected = interfered_log_likelihood(u, y[n], signal, covariance[n], STEP, likelihood)
        assert out[-1] == expected[-1] == -np.inf
        assert np.allclose(out[:-1], expected[:-1], rtol=3e-7, atol=1e-6)


def test_without_interferers_it_is_the_plain_law(scene):
    y, _ = scene
    covariance = interference.noise_covariance(np.full((3, 1), np.nan), 1.0, NOISE, STAVES, STEP)
    form = interference.interference_form(y, covariance)
    assert np.allclose(form.log_determinant, STAVES * np.log(NOISE))
    u = np.linspace(-0.9, 0.9, 31)
    plain = log_likelihood(u, y[0], 7.0, NOISE[0], STEP)
    other = interfered_log_likelihood(u, y[0], 7.0, covariance[0], STEP)
    assert np.ptp(plain - other) < 1e-9
