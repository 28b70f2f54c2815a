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

"""The kernels of fixes against the plain forms."""

import numpy as np

from sonar_imm.estimation import imm
from sonar_imm.trackers.diver import fix_kernels

T, M, N, D = 6, 3, 3, 8


def problem(seed=0):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(T, M, N, N))
    P = root @ np.swapaxes(root, -1, -2) + 0.1 * np.eye(N)
    E = np.zeros((1, M, 2, N))
    E[:, :, 0, 0] = E[:, :, 1, 1] = 1.0
    R = rng.normal(size=(D, 2, 2))
    R = R @ np.swapaxes(R, -1, -2) + 0.2 * np.eye(2)
    mu = rng.dirichlet(np.ones(M), T)
    return rng.normal(size=(T, M, N)), P, mu, E, rng.normal(size=(D, 2)), R


def test_taking_fixes_is_the_plain_update_of_those_tracks():
    x, P, mu, H, z, R = problem()
    h = fix_kernels.expected(x, H)
    np.testing.assert_allclose(h, x[..., :2])
    tracks, detection = np.array([4, 1]), np.array([0, 7])
    v = z[detection][:, None] - h[tracks]
    want = imm.update(x[tracks], P[tracks], mu[tracks], v, H, R[detection])
    kept = x.copy(), P.copy(), mu.copy()
    x1, P1, mu1, nis, dof, repairs = fix_kernels.update(
        x, P, mu, h, H, z, R, tracks, detection, np.ones(T), np.ones(T, np.uint16)
    )
    for argument, before in zip((x, P, mu), kept):
        np.testing.assert_array_equal(argument, before)
    assert repairs == 0 and dof.tolist() == [1, 3, 1, 1, 3, 1]
    np.testing.assert_allclose(nis[tracks], 1.0 + want.nis)
    for got, plain, before in ((x1, want.x, x), (P1, want.P, P), (mu1, want.mu, mu)):
        np.testing.assert_allclose(got[tracks], plain, rtol=1e-9, atol=1e-12)
        np.testing.assert_array_equal(np.delete(got, tracks, 0), np.delete(before, tracks, 0))


def test_the_account_of_innovations():
    x, P, mu, H, z, R = problem(1)
    rng = np.random.default_rng(2)
    tracks, detection = np.array([0, 2, 3, 5]), np.array([3, 1, 6, 0])
    tentative = np.array([False, False, False, True, False, False])
    white = rng.normal(size=(T, 2))
    white[2] = np.nan  # never seen before
    white[5], z[detection[-1]] = [9.0, -12.0], z[detection[-1]] + 40.0  # sharp turns
    before, memory = white.copy(), 50.0
    old = (49.0, 30.0, 40.0, 5.0, 35.0)
    mean, covariance = imm.combine(x, P, mu, H[0])
    white, new = fix_kernels.watch(
        mean, covariance, z, R, tracks, detection, tentative, white, old, memory
    )
    mean, covariance = mean[tracks], covariance[tracks]
    root = np.linalg.cholesky(covariance + R[detection])
    now = np.linalg.solve(root, (z[detection] - mean)[..., None])[..., 0]
    np.testing.assert_allclose(white[tracks], now)
    np.testing.assert_array_equal(np.delete(white, tracks, 0), np.delete(before, tracks, 0))

    def short(v):
        return v * np.minimum(1.0, np.sqrt(18.0) / np.linalg.norm(v, axis=1))[:, None]

    firm, paired = short(now[[0, 1, 3]]), (short(now[[0, 3]]), short(before[[0, 5]]))
    assert np.sum(now[3] ** 2) > 18.0 and np.sum(now[0] ** 2) < 18.0
    want = np.array(old) + [
        3.0,
        0.5 * np.sum(firm**2),
        2.0,
        np.sum(paired[0] * paired[1]),
        0.5 * np.sum(paired[0] ** 2 + paired[1] ** 2),
    ]
    np.testing.assert_allclose(new, want * memory / want[0])


def test_scores_and_numbers_that_are_not_finite():
    score, chosen = np.zeros(3), np.array([1, -1, -1])
    named = np.array([False, False, True])
    fit = np.array([[0.0, -1.5], [0.0, 0.0], [0.0, 0.0]])
    after = fix_kernels.scores(score, fit, chosen, named, -2.3, 2.2, -7.0)
    assert not score.any()
    np.testing.assert_allclose(after, [-2.3 - 1.5 + 2.2 + 7.0, -2.3, 0.0])
    x, P = np.zeros((3, 2, 2)), np.zeros((3, 2, 2, 2))
    x[1, 1, 0], P[2, 0, 1, 1] = np.nan, np.inf
    assert fix_kernels.finite(x, P).tolist() == [True, False, False]
