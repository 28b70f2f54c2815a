# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The Kalman filter against information-form algebra, scipy densities, and itself in batches."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from sonar_imm.estimation.kalman import CovarianceError, factorise, predict, update


def random_covariance(rng, *shape):
    root = rng.normal(size=(*shape, shape[-1] + 1))
    return root @ np.swapaxes(root, -1, -2)


@pytest.fixture
def rng():
    return np.random.default_rng(7)


def test_predict_moves_mean_and_spreads_covariance(rng):
    x, F, b = rng.normal(size=3), rng.normal(size=(3, 3)), np.ones(3)
    P, Q = random_covariance(rng, 3), random_covariance(rng, 3)
    moved, spread, _ = predict(x, P, F, Q, b)
    expected = [sum(F[i, j] * x[j] for j in range(3)) + 1.0 for i in range(3)]
    np.testing.assert_allclose(moved, expected, rtol=1e-14)
    np.testing.assert_allclose(spread, np.linalg.multi_dot([F, P, F.T]) + Q, rtol=1e-13)
    np.testing.assert_array_equal(spread, spread.T)


def test_update_equals_information_form_and_the_density_of_its_innovation(rng):
    x, P, H = rng.normal(size=4), random_covariance(rng, 4), rng.normal(size=(2, 4))
    R, z = random_covariance(rng, 2), rng.normal(size=2)
    nu, S = z - H @ x, H @ P @ H.T + R
    updated = update(x, P, nu, H, R)
    information = np.linalg.inv(P) + H.T @ np.linalg.inv(R) @ H
    np.testing.assert_allclose(updated.P, np.linalg.inv(information), rtol=1e-9, atol=1e-12)
    due = np.linalg.inv(P) @ x + H.T @ np.linalg.inv(R) @ z
    np.testing.assert_allclose(information @ updated.x, due, rtol=1e-9)
    np.testing.assert_allclose(updated.innovation_covariance, S, rtol=1e-13)
    density = multivariate_normal(cov=S).logpdf(nu)
    np.testing.assert_allclose(updated.log_likelihood, density, rtol=1e-12)
    np.testing.assert_allclose(updated.nis, nu @ np.linalg.inv(S) @ nu, rtol=1e-11)


def test_a_batch_is_its_members(rng):
    x, P = rng.normal(size=(5, 3, 4)), random_covariance(rng, 5, 3, 4)
    F, Q, H = rng.normal(size=(3, 4, 4)), random_covariance(rng, 3, 4), rng.normal(size=(2, 4))
    R, nu = random_covariance(rng, 5, 1, 2), rng.normal(size=(5, 3, 2))
    px, pP, _ = predict(x, P, F, Q)
    updated = update(px, pP, nu, H, R)
    for t, m in np.ndindex(5, 3):
        alone = update(*predict(x[t, m], P[t, m], F[m], Q[m])[:2], nu[t, m], H, R[t, 0])
        for whole, single in zip(updated, alone):
            np.testing.assert_allclose(whole[t, m], single, rtol=1e-9, atol=1e-12)


def test_a_perfect_measurement_is_allowed():
    H = np.array([[1.0, 0.0]])
    updated = update(np.zeros(2), np.eye(2), np.array([3.0]), H, np.zeros((1, 1)))
    np.testing.assert_allclose(updated.x, [3.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(updated.P, [[0.0, 0.0], [0.0, 1.0]], atol=1e-12)
    assert updated.P[0, 0] > 0.0 and updated.repaired


def test_a_covariance_that_is_singular_or_nan_is_named():
    P, H = np.stack([np.eye(2), np.zeros((2, 2)), np.eye(2)]), np.array([[1.0, 0.0]])
    sentence = '1 of 3: innovation covariance is not positive definite'
    with pytest.raises(CovarianceError, match=sentence) as caught:
        update(np.zeros((3, 2)), P, np.zeros((3, 1)), H, np.zeros((1, 1)))
    np.testing.assert_array_equal(caught.value.where, [False, True, False])
    with pytest.raises(CovarianceError, match='innovation covariance is not finite'):
        update(np.zeros(2), np.full((2, 2), np.nan), np.zeros(1), H, np.eye(1))


@pytest.mark.parametrize('unit', [1e-20, 1.0, 1e20])
def test_covariances_without_a_factor_are_named_in_any_unit(unit):
    """The least eigenvalue is compared with the largest: what has none but for rounding counts."""
    fine, flat, negative = np.diag([1.0, 2.0]), np.ones((2, 2)), np.diag([1.0, -1.0])
    almost = np.array([[1.0, 1.0], [1.0, 1.0 + 4e-16]])
    with pytest.raises(CovarianceError, match='2 of 3: state is not positive') as caught:
        factorise(unit * np.array([fine, flat, negative]), 'state')
    assert caught.value.where.tolist() == [False, True, True]
    with pytest.raises(CovarianceError) as caught:
        factorise(unit * np.array([negative, almost, fine]))
    assert caught.value.where.tolist() == [True, True, False]
