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

"""All inlier/outlier subsets: vectors, brute force, wild numbers."""

from itertools import product

from helpers.sea_vectors import vectors
import numpy as np
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


def test_any_order_gives_the_same():
    v, numbers, law = vector_case()
    there = subset_update(v['x'], v['P'], numbers, **law, prune=np.inf)
    back = subset_update(v['x'], v['P'], numbers[::-1], **law, prune=np.inf)
    np.testing.assert_allclose(there.x, back.x, atol=1e-12)
    np.testing.assert_allclose(there.P, back.P, atol=1e-12)
    np.testing.assert_allclose(there.good, back.good[::-1], atol=1e-12)


def test_wild_numbers_only_leave_the_prediction():
    v, numbers, law = vector_case()
    wild = [(measure, value + 500.0, variance) for measure, value, variance in numbers]
    got = subset_update(v['x'], v['P'], wild, **law)
    np.testing.assert_allclose(got.x, v['x'], atol=1e-12)
    np.testing.assert_allclose(got.P, v['P'], atol=1e-12)
    charge = 3 * np.log(law['outlier_probability'] * law['outlier_density'])
    assert got.log_evidence == pytest.approx(charge)


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
