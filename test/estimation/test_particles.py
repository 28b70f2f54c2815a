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

"""Weighted particles: log weights, effective sample size, moments."""

import numpy as np
import pytest
from scipy.special import logsumexp

from sonar_imm.estimation import particles


def test_normalise_survives_what_underflows():
    log_w = np.array([-1e5, -1e5 + np.log(3.0), -np.inf])
    w, log_sum = particles.normalise(log_w)
    assert w == pytest.approx([0.25, 0.75, 0.0])
    assert log_sum == pytest.approx(logsumexp(log_w))


def test_normalise_of_nothing_possible_is_uniform():
    w, log_sum = particles.normalise(np.full((2, 4), -np.inf))
    assert (w == 0.25).all() and np.isneginf(log_sum).all()


def test_effective_sample_size_lies_between_one_and_all():
    assert particles.effective_sample_size(np.full(50, 0.02)) == pytest.approx(50.0)
    assert particles.effective_sample_size(np.eye(1, 50)[0]) == pytest.approx(1.0)


def test_moments_are_those_of_numpy():
    rng = np.random.default_rng(1)
    x, w = rng.normal(size=(3, 2, 40)), rng.random((3, 40))
    w /= w.sum(axis=1, keepdims=True)
    mean, covariance = particles.mean(x, w), particles.covariance(x, w)
    for j in range(3):
        assert mean[j] == pytest.approx(np.average(x[j], axis=1, weights=w[j]))
        assert covariance[j] == pytest.approx(np.cov(x[j], aweights=w[j], ddof=0))
