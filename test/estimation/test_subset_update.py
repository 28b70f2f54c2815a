# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The oracles of robust updates: all inlier/outlier subsets, and heavy tails."""

from itertools import product

from helpers.sea_vectors import vectors
import numpy as np
from oracles.student_t import student_t_constant, student_t_maximum
from oracles.subset_update import subset_update
import pytest


def linear(h, value, variance):
    return (lambda x: (float(h @ x), h)), float(value), float(variance)


def vector_case():
    v = vectors('subsets')
    numbers = [linear(h, y, v['sigma'] ** 2) for h, y in zip(v['H'], v['y'])]
    law = {
        'outlier_probability': float(v['outlier_probability']),
        'outlier_density': float(v['outlier_density']),
    }
    return v, numbers, law


def test_the_subsets_of_the_vectors():
    v, numbers, law = vector_case()
    got = subset_update(v['x'], v['P'], numbers, **law, prune=np.inf)
    assert [each.good for each in got.explanations] == [tuple(s) for s in v['out_subsets'] == 1]
    np.testing.assert_allclose(got.probability, v['out_subset_prob'], atol=1e-9)
    assert got.log_evidence == pytest.approx(float(v['out_log_evidence']), abs=1e-9)
    np.testing.assert_allclose(got.x, v['out_x'], atol=1e-9)
    np.testing.assert_allclose(got.P, v['out_P'], atol=1e-9)


def test_pruning_changes_nothing_that_shows():
    v, numbers, law = vector_case()
    got = subset_update(v['x'], v['P'], numbers, **law)
    assert len(got.explanations) < 8
    np.testing.assert_allclose(got.x, v['out_x'], atol=1e-5)


def test_evidence_is_the_sum_over_all_subsets():
    """Against multivariate normals of each subset, integrated in closed form."""
    from scipy.stats import multivariate_normal

    v, numbers, law = vector_case()
    eps, u = law['outlier_probability'], law['outlier_density']
    total = 0.0
    for good in product((False, True), repeat=3):
        rows = np.flatnonzero(good)
        weight = np.prod([1 - eps if g else eps * u for g in good])
        if len(rows):
            H = v['H'][rows]
            S = H @ v['P'] @ H.T + np.eye(len(rows)) * v['sigma'] ** 2
            weight *= multivariate_normal(H @ v['x'], S).pdf(v['y'][rows])
        total += weight
    got = subset_update(v['x'], v['P'], numbers, **law, prune=np.inf)
    assert got.log_evidence == pytest.approx(np.log(total))


# -- heavy tails: the maximum, weights and Laplace covariance of the vectors ----------------------

FLAT = 1e8


def student_t_case():
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
    v, mean, P, numbers = student_t_case()
    got = student_t_maximum(mean, P, numbers, [mean, np.append(v['out_least_squares'], 0.0)])
    np.testing.assert_allclose(got.x[:2], v['out_map'], atol=1e-5)
    assert got.x[2] == pytest.approx(float(v['out_te']), abs=1e-5)
    np.testing.assert_allclose(got.weights, v['out_weights'], atol=1e-5)
    np.testing.assert_allclose(got.P[:2, :2], v['out_cov_laplace'], atol=1e-5)
    # The evidence of the vectors has no constants of the prior nor of the t density.
    constants = 6 * student_t_constant(float(v['sigma']) ** 2, float(v['nu']))
    bare = got.log_evidence - constants + 0.5 * np.log(np.linalg.det(P)) + 1.5 * np.log(2 * np.pi)
    assert bare == pytest.approx(float(v['out_log_evidence_laplace']), abs=1e-4)
