# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The polar conversion against quadrature, against its printed equations and in use."""

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose
import pytest
from scipy.stats import chi2

from sonar_imm.acoustics.polar import unbiased_polar_to_cartesian


def test_nees_at_long_range_is_right():
    truth, runs = np.array([120.0, -160.0]), 4000
    r, b = measured(truth, runs, seed=3)
    low, high = chi2.ppf([0.025, 0.975], 2 * runs) / runs
    variances = (SIGMA_RANGE**2, SIGMA_BEARING**2)
    right = nees(truth, *unbiased_polar_to_cartesian(r, b, *variances)).mean()
    # Along the line of sight the error is itself a square: heavier tails, wider bounds.
    assert 0.95 * low < right < 1.05 * high


SIGMA_RANGE, SIGMA_BEARING = 0.1, np.radians(2.0)


def rotation(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def measured(truth, runs, seed):
    """Noisy ranges and bearings (runs,) of one true position."""
    rng = np.random.default_rng(seed)
    return (
        np.hypot(*truth) + SIGMA_RANGE * rng.standard_normal(runs),
        np.arctan2(truth[1], truth[0]) + SIGMA_BEARING * rng.standard_normal(runs),
    )


def nees(truth, positions, covariances):
    gap = truth - positions
    return np.einsum('ni,ni->n', gap, np.linalg.solve(covariances, gap[..., None])[..., 0])


@pytest.mark.parametrize('variance', [1e-6, 0.01, 0.5])
def test_moments_equal_quadrature_over_the_truth_given_the_measurement(variance):
    r, angle, var_range = 30.0, 2.3, 4.0
    nodes, weights = np.polynomial.hermite_e.hermegauss(80)
    weights = weights / weights.sum()
    ranges = r - np.sqrt(var_range) * nodes[:, None]
    bearings = angle - np.sqrt(variance) * nodes[None, :]
    points = np.stack([ranges * np.cos(bearings), ranges * np.sin(bearings)], axis=-1)
    weight = weights[:, None] * weights[None, :]
    mean = (weight[..., None] * points).sum(axis=(0, 1))
    spread = points - mean
    covariance = np.einsum('ab,abi,abj->ij', weight, spread, spread)
    position, stated = unbiased_polar_to_cartesian(r, angle, var_range, variance)
    assert_allclose(position, mean, rtol=1e-10)
    assert_allclose(stated, covariance, rtol=1e-8, atol=1e-10)


def test_covariance_equals_the_printed_equations():
    r, b, vr, vb = 200.0, -0.7, 0.01, 0.09
    lam = np.exp(-vb / 2)
    position, covariance = unbiased_polar_to_cartesian(r, b, vr, vb)
    xx = (r**2 + vr) / 2 * (1 + lam**4 * np.cos(2 * b)) - lam**2 * r**2 * np.cos(b) ** 2
    yy = (r**2 + vr) / 2 * (1 - lam**4 * np.cos(2 * b)) - lam**2 * r**2 * np.sin(b) ** 2
    xy = (r**2 + vr) / 2 * lam**4 * np.sin(2 * b) - lam**2 * r**2 * np.sin(b) * np.cos(b)
    assert_allclose(covariance, [[xx, xy], [xy, yy]], rtol=1e-10)
    assert_allclose(position, lam * r * np.array([np.cos(b), np.sin(b)]), rtol=1e-14)


@settings(max_examples=100, derandomize=True, deadline=None)
@given(
    r=st.floats(0.0, 1e5),
    b=st.floats(-10.0, 10.0),
    sr=st.floats(1e-3, 100.0),
    sb=st.floats(1e-5, 2.0),
)
def test_covariance_is_positive_definite_and_turns_with_the_scene(r, b, sr, sb):
    position, covariance = unbiased_polar_to_cartesian(r, 0.0, sr**2, sb**2)
    turn = rotation(b)
    turned_position, turned = unbiased_polar_to_cartesian(r, b, sr**2, sb**2)
    scale = np.abs(covariance).max()
    assert (np.diag(covariance) > 0.0).all() and covariance[0, 1] == 0.0
    assert_allclose(turned_position, turn @ position, atol=1e-9 * (1.0 + r))
    assert_allclose(turned, turn @ covariance @ turn.T, atol=1e-12 * scale)


def test_no_bearing_noise_and_broadcasting():
    position, covariance = unbiased_polar_to_cartesian([[10.0], [20.0]], [0.0, 1.0, 2.0], 4.0, 0.0)
    assert position.shape == (2, 3, 2) and covariance.shape == (2, 3, 2, 2)
    assert_allclose(position[1, 0], [20.0, 0.0])
    assert_allclose(covariance[1, 0], [[4.0, 0.0], [0.0, 0.0]])
