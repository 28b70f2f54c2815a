# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Heavy tails: the maximum, weights and Laplace covariance of the vectors."""

from helpers.sea_vectors import vectors
import numpy as np
from oracles.student_t import student_t_constant, student_t_maximum
import pytest

FLAT = 1e8


def case():
    """x, y and the emission, whose prior is flat."""
    v = vectors('robust')

    def measure(rx):
        def of(x):
            d = np.array([*(x[:2] - rx[:2]), float(v['z']) - rx[2]])
            r = np.sqrt(d @ d)
            return r + x[2], np.array([d[0] / r, d[1] / r, 1.0])

        return of

    variance = float(v['sigma']) ** 2
    numbers = [(measure(rx), float(y), variance) for rx, y in zip(v['rx'], v['path'])]
    P = np.zeros((3, 3))
    P[:2, :2], P[2, 2] = v['prior_cov'], FLAT
    return v, np.append(v['prior_mean'], 0.0), P, numbers


def test_the_maximum_of_the_vectors():
    v, mean, P, numbers = case()
    got = student_t_maximum(mean, P, numbers, [mean, np.append(v['out_least_squares'], 0.0)])
    np.testing.assert_allclose(got.x[:2], v['out_map'], atol=1e-5)
    assert got.x[2] == pytest.approx(float(v['out_te']), abs=1e-5)
    np.testing.assert_allclose(got.weights, v['out_weights'], atol=1e-5)
    np.testing.assert_allclose(got.P[:2, :2], v['out_cov_laplace'], atol=1e-5)
    # The evidence of the vectors has no constants of the prior nor of the t density.
    constants = 6 * student_t_constant(float(v['sigma']) ** 2, float(v['nu']))
    bare = got.log_evidence - constants + 0.5 * np.log(np.linalg.det(P)) + 1.5 * np.log(2 * np.pi)
    assert bare == pytest.approx(float(v['out_log_evidence_laplace']), abs=1e-4)


def test_a_start_elsewhere_is_not_believed_over_a_better_one():
    v, mean, P, numbers = case()
    far = mean + [300.0, 300.0, 0.0]
    got = student_t_maximum(mean, P, numbers, [far, mean])
    np.testing.assert_allclose(got.x[:2], v['out_map'], atol=1e-4)


def test_the_wild_number_weighs_next_to_nothing():
    v, mean, P, numbers = case()
    got = student_t_maximum(mean, P, numbers, [mean])
    assert got.weights[2] < 0.01 and (np.delete(got.weights, 2) > 1.0).all()
