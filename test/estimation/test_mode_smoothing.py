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

"""Kim's pass over model probabilities."""

import numpy as np
import pytest

from sonar_imm.estimation.smoothing import smooth_modes

P = np.array([[0.9, 0.07, 0.03], [0.3, 0.6, 0.1], [0.1, 0.2, 0.7]])


def filtered(likelihood, mu):
    out = []
    for row in likelihood:
        mu = (mu @ P) * row
        mu = mu / mu.sum()
        out.append(mu)
    return np.array(out)


def test_a_hidden_markov_chain_is_smoothed_exactly():
    rng = np.random.default_rng(1)
    likelihood, mu0 = rng.random((6, 3)), np.array([0.2, 0.5, 0.3])
    weights = np.zeros((6, 3))
    for path in np.ndindex(*(3,) * 7):
        weight = mu0[path[0]]
        for k in range(6):
            weight *= P[path[k], path[k + 1]] * likelihood[k, path[k + 1]]
        for k in range(6):
            weights[k, path[k + 1]] += weight
    exact = weights / weights.sum(axis=1, keepdims=True)
    assert smooth_modes(filtered(likelihood, mu0), P) == pytest.approx(exact)


def test_a_chain_at_rest_knows_what_it_will_know():
    mu = filtered(np.random.default_rng(2).random((5, 3)), np.full(3, 1 / 3))
    mu[2] = mu[1]
    smoothed = smooth_modes(mu, P, np.array([True, True, False, True, True]))
    assert smoothed[1] == pytest.approx(smoothed[2])
    assert smoothed == pytest.approx(smooth_modes(np.delete(mu, 2, 0), P)[[0, 1, 1, 2, 3]])


def test_impossible_models_and_short_rows_are_no_trouble():
    mu = np.array([[1.0, 0.0], [0.0, 1.0]])
    assert np.isfinite(smooth_modes(mu, np.eye(2))).all()
    assert smooth_modes(mu[:1], np.eye(2)) == pytest.approx(mu[:1])
    assert smooth_modes(mu[:0], np.eye(2)).shape == (0, 2)
