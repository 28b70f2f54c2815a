# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Kalman's update, Schmidt's and robust ones against closed forms and vectors; covariances stay
positive definite: cases no double can hold, exact fractions, batches."""

from fractions import Fraction
from functools import partial

from helpers.vector_files import vectors
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from numpy.testing import assert_allclose
from oracles.robust import DEGREES, student_t_constant, student_t_maximum, subset_update
import pytest
from scipy.stats import multivariate_normal

from sonar_imm.estimation import covariance as cov
from sonar_imm.estimation import imm, kalman
from sonar_imm.estimation.angles import wrap_angle
from sonar_imm.estimation.consider import consider_scalar, consider_update
from sonar_imm.estimation.kalman import CovarianceError
from sonar_imm.trackers.obstacle import mixtures


def random_covariance(rng, *shape):
    root = rng.normal(size=(*shape, shape[-1] + 1))
    return root @ np.swapaxes(root, -1, -2)


def test_predict_moves_mean_and_spreads_covariance():
    rng = np.random.default_rng(7)
    x, F, b = rng.normal(size=3), rng.normal(size=(3, 3)), np.ones(3)
    P, Q = random_covariance(rng, 3), random_covariance(rng, 3)
    moved, spread, _ = kalman.predict(x, P, F, Q, b)
    expected = [sum(F[i, j] * x[j] for j in range(3)) + 1.0 for i in range(3)]
    assert_allclose(moved, expected, rtol=1e-14)
    assert_allclose(spread, np.linalg.multi_dot([F, P, F.T]) + Q, rtol=1e-13)
    np.testing.assert_array_equal(spread, spread.T)


def test_update_equals_information_form_and_the_density_of_its_innovation():
    rng = np.random.default_rng(7)
    x, P, H = rng.normal(size=4), random_covariance(rng, 4), rng.normal(size=(2, 4))
    R, z = random_covariance(rng, 2), rng.normal(size=2)
    nu, S = z - H @ x, H @ P @ H.T + R
    updated = kalman.update(x, P, nu, H, R)
    information = np.linalg.inv(P) + H.T @ np.linalg.inv(R) @ H
    assert_allclose(updated.P, np.linalg.inv(information), rtol=1e-9, atol=1e-12)
    due = np.linalg.inv(P) @ x + H.T @ np.linalg.inv(R) @ z
    assert_allclose(information @ updated.x, due, rtol=1e-9)
    assert_allclose(updated.innovation_covariance, S, rtol=1e-13)
    density = multivariate_normal(cov=S).logpdf(nu)
    assert_allclose(updated.log_likelihood, density, rtol=1e-12)
    assert_allclose(updated.nis, nu @ np.linalg.inv(S) @ nu, rtol=1e-11)


def test_a_batch_is_its_members():
    rng = np.random.default_rng(7)
    x, P = rng.normal(size=(5, 3, 4)), random_covariance(rng, 5, 3, 4)
    F, Q, H = rng.normal(size=(3, 4, 4)), random_covariance(rng, 3, 4), rng.normal(size=(2, 4))
    R, nu = random_covariance(rng, 5, 1, 2), rng.normal(size=(5, 3, 2))
    updated = kalman.update(*kalman.predict(x, P, F, Q)[:2], nu, H, R)
    for t, m in np.ndindex(5, 3):
        moved = kalman.predict(x[t, m], P[t, m], F[m], Q[m])[:2]
        for whole, single in zip(updated, kalman.update(*moved, nu[t, m], H, R[t, 0])):
            assert_allclose(whole[t, m], single, rtol=1e-9, atol=1e-12)


def test_a_covariance_that_is_singular_or_nan_is_named():
    P, H = np.stack([np.eye(2), np.zeros((2, 2)), np.eye(2)]), np.array([[1.0, 0.0]])
    sentence = '1 of 3: innovation covariance is not positive definite'
    with pytest.raises(CovarianceError, match=sentence) as caught:
        kalman.update(np.zeros((3, 2)), P, np.zeros((3, 1)), H, np.zeros((1, 1)))
    np.testing.assert_array_equal(caught.value.where, [False, True, False])
    with pytest.raises(CovarianceError, match='innovation covariance is not finite'):
        kalman.update(np.zeros(2), np.full((2, 2), np.nan), np.zeros(1), H, np.eye(1))
    # The least eigenvalue is compared with the largest: what has none but for rounding counts.
    fine, flat, negative = np.diag([1.0, 2.0]), np.ones((2, 2)), np.diag([1.0, -1.0])
    almost = np.array([[1.0, 1.0], [1.0, 1.0 + 4e-16]])
    for unit in (1e-20, 1e20):
        with pytest.raises(CovarianceError, match='2 of 3: state is not positive') as caught:
            kalman.factorise(unit * np.array([fine, flat, negative]), 'state')
        assert caught.value.where.tolist() == [False, True, True]
        with pytest.raises(CovarianceError) as caught:
            kalman.factorise(unit * np.array([negative, almost, fine]))
        assert caught.value.where.tolist() == [True, True, False]


ROUNDING = 1e-14


def least_eigenvalue(P):
    """Of the correlation matrix, where a component has a variance: a number without units."""
    own = np.diagonal(P, axis1=-2, axis2=-1)
    scale = np.sqrt(np.where(own > 0.0, own, 1.0))
    return np.linalg.eigvalsh(P / (scale[..., :, None] * scale[..., None, :]))[..., 0]


def is_covariance(P):
    """Finite, symmetric to the last bit, and with a Cholesky factor."""
    assert np.isfinite(P).all()
    np.testing.assert_array_equal(P, np.swapaxes(P, -1, -2))
    np.linalg.cholesky(P)  # LAPACK's, which raises
    assert (least_eigenvalue(P) > -ROUNDING).all()
    return True


def ill_conditioned(rng, count, n, m):
    """Batches of P, F, Q, H, R whose scales lie up to 1e24 apart, dependent, repeated, or zero."""

    def covariance(size, low, high):
        root = rng.normal(size=(count, size, size))
        root *= 10.0 ** rng.uniform(low / 2, high / 2, (count, 1, size))
        thin = rng.random(count) < 0.4
        root[thin, :, 0] *= 10.0 ** rng.uniform(-9, 0, (thin.sum(), 1))
        P = root @ np.swapaxes(root, -1, -2)
        scale = 10.0 ** rng.uniform(-3, 3, (count, size))
        P = 0.5 * (P + np.swapaxes(P, -1, -2)) * scale[:, :, None] * scale[:, None]
        return cov.add_jitter(P)[0]

    P, Q = covariance(n, -12, 12), covariance(n, -20, 2)
    Q[rng.random(count) < 0.3] = 0.0
    R = covariance(m, -14, 4)
    R[rng.random(count) < 0.2] = 0.0
    flat = rng.random(count) < 0.2
    R[flat, -1] = R[flat, :, -1] = 0.0  # a perfect component
    size, sign = rng.uniform(-6, 4, (count, n, n)), rng.choice([-1, 1], (count, n, n))
    F = np.eye(n) + np.triu(sign * 10.0**size, 1)
    H = rng.normal(size=(count, m, n))
    plain = rng.random(count) < 0.4
    H[plain] = np.eye(m, n)
    if m > 1:
        same = rng.random(count) < 0.2
        H[same, 1] = H[same, 0] * (1.0 + 10.0 ** rng.uniform(-16, -4, (same.sum(), 1)))
    return P, F, Q, H, R


@pytest.mark.parametrize(('n', 'm', 'seed'), [(2, 1, 0), (4, 2, 2)])
def test_ill_conditioned_cases_stay_positive_definite(n, m, seed):
    count, repairs = 400, 0
    P, F, Q, H, R = ill_conditioned(np.random.default_rng(seed), count, n, m)
    x, v, B = np.zeros((1, count, n)), np.zeros((1, count, m)), np.zeros((count, n))
    now = P[None].copy()
    for _ in range(10):  # some more perfect measurements would end at 1e-308
        _, now, repaired = imm.predict(x, now, F, Q, B)
        assert is_covariance(now)
        repairs += repaired.sum()
        # One R for all models of a target: each case is a target of its own.
        out = imm.update(
            x.reshape(count, 1, n), now.reshape(count, 1, n, n), np.ones((count, 1)),
            v.reshape(count, 1, m), H[:, None], R,
        )  # fmt: skip
        now = out[1].reshape(1, count, n, n)
        assert is_covariance(now)
        assert np.isfinite(out[0]).all() and np.isfinite(out[2]).all()
        repairs += out[6].sum()
    assert 0 < repairs < 20 * count
    for case in range(0, count, 50):
        assert is_covariance(cov.correct(P[case], H[case], R[case]).P)


def exact_posterior(P, H, R):
    """P - P H' S^-1 H P for one measured value, in fractions of the numbers given."""
    P = [[Fraction(float(value)) for value in row] for row in P]
    H = [Fraction(float(value)) for value in H]
    PH = [sum(a * b for a, b in zip(row, H)) for row in P]
    S = sum(a * b for a, b in zip(H, PH)) + Fraction(float(R))
    return [[P[i][j] - PH[i] * PH[j] / S for j in range(len(H))] for i in range(len(H))]


def test_a_measurement_much_better_than_the_state():
    """What is claimed is neither less than the truth, 1e-6 / k, nor more than the limit allows."""
    P = np.diag([1e12, 1e12])[None, None]
    h = np.array([1.0, 1.0 + 1e-7])
    H, R = h[None, None, None], np.array([[[1e-6]]])
    x, mu = np.zeros((1, 1, 2)), np.ones((1, 1))
    for k in range(1, 51):
        out = imm.update(x, P, mu, np.zeros((1, 1, 1)), H, R)
        x, P = out[:2]
        assert is_covariance(P)
        claimed = [Fraction(value) for value in P[0, 0].ravel()]
        h0, h1 = (Fraction(float(value)) for value in h)
        along = h0 * h0 * claimed[0] + 2 * h0 * h1 * claimed[1] + h1 * h1 * claimed[3]
        assert Fraction(1, 10**6) / k <= along <= Fraction(20 * cov.JITTER) * 10**12
        across = np.array([1.0, -1.0]) @ P[0, 0] @ np.array([1.0, -1.0])
        assert across == pytest.approx(2e12, rel=1e-6)


@settings(deadline=None, max_examples=300)
@given(st.integers(2, 4), st.integers(0, 2**32 - 1))
def test_an_update_is_as_good_as_the_limit_says(n, seed):
    """Against exact arithmetic: rounding the prior costs rounding over its least eigenvalue."""
    rng = np.random.default_rng(seed)
    P, _, _, H, R = (each[0] for each in ill_conditioned(rng, 1, n, 1))
    exact = np.array(exact_posterior(P, H[0], R[0, 0]), dtype=float)
    got = cov.correct(P, H, R)
    assert got.usable
    scale = np.sqrt(np.diagonal(P))
    error = np.abs(got.P - exact) / np.outer(scale, scale)
    assert error.max() <= 10.0 * cov.JITTER + 1e-14 / max(float(least_eigenvalue(P)), cov.LIMIT)


def test_a_perfect_component_and_one_repeated():
    """R singular, R slightly below zero, and two perfect measurements: S itself is singular."""
    P, e = np.tile(np.diag([4.0, 9.0, 1.0]), (3, 1, 1, 1)), np.eye(3)
    H = np.array([e[[0, 1]], e[[0, 1]], e[[0, 0]]])[:, None]
    R = np.array([np.diag(each) for each in ([0.25, 0.0], [0.25, -1e-19], [0.0, 0.0])])
    x, mu = np.zeros((3, 1, 3)), np.ones((3, 1))
    for v in (np.ones((3, 1, 2)), np.zeros((3, 1, 2)), np.zeros((3, 1, 2))):
        x, P, mu, log_likelihood, _, ok, _ = imm.update(x, P, mu, v, H, R)
        assert ok.all() and np.isfinite(log_likelihood).all() and is_covariance(P)
    assert_allclose(x[:2, 0, 1], 1.0, rtol=1e-9)
    assert_allclose(x[2, 0, 0], 1.0, rtol=1e-9)
    assert (P[:2, 0, 1, 1] < 1e-8).all() and P[2, 0, 0, 0] < 1e-8


def test_models_that_are_sharp_and_far_apart_mix():
    """Moments about the common mean would leave nothing of 1e-6 m^2 at 1e7 m from it. A drift that
    is shared leaves its correlation: coasting 1e9 s with a velocity known to 1 m/s makes position
    and velocity one number."""
    x = np.random.default_rng(5).uniform(-1e7, 1e7, (40, 6, 3))
    P, mu = np.tile(1e-6 * np.eye(3), (40, 6, 1, 1)), np.full((40, 6), 1.0 / 6.0)
    P0 = imm.mix(x, P, mu, np.eye(6)[None]).P
    assert is_covariance(P0)
    assert_allclose(P0, P, rtol=1e-6, atol=1e-12)
    P, F = np.diag([1e-6, 1.0]), np.array([[1.0, 1e9], [0.0, 1.0]])
    moved, repaired = cov.propagate(F, P, np.zeros((2, 2)))
    assert repaired and is_covariance(moved)
    assert_allclose(moved, F @ P @ F.T, rtol=1e-12)


def test_a_lift_adds_no_more_than_it_must():
    P = random_covariance(np.random.default_rng(6), 50, 4)
    P = 0.5 * (P + np.swapaxes(P, -1, -2))
    P[0] = np.diag([1.0, 0.0, 2.0, 3.0])  # nothing to lift where there is no variance
    P[1] = 0.0
    lifted, repaired = cov.add_jitter(P)
    np.testing.assert_array_equal(lifted, P)
    assert not repaired.any()
    hurt = np.array([[1.0, 1.0 + 1e-9], [1.0 + 1e-9, 1.0]])
    lifted, repaired = cov.add_jitter(np.stack([np.eye(2), hurt, 1e9 * hurt]))
    np.testing.assert_array_equal(repaired, [False, True, True])
    np.testing.assert_array_equal(lifted[0], np.eye(2))
    assert (np.diagonal(lifted[1]) <= 1.0 + 1e-7).all() and is_covariance(lifted)
    # What is no covariance is left for the caller to see.
    for bad in (np.diag([-0.1, 1.0]), np.full((2, 2), np.inf), -np.eye(2)):
        lifted, repaired = cov.add_jitter(bad)
        assert repaired and not cov.is_psd(lifted)
        np.testing.assert_array_equal(lifted, bad)


@pytest.mark.parametrize('broken', range(3))
def test_numbers_that_are_not_finite_change_nothing_and_are_told(broken):
    parts = np.tile(np.eye(2), (3, 1, 1))
    parts[broken, 0, 0] = np.nan
    got, (P, H, R) = cov.correct(*parts), parts
    assert not got.usable and not got.repaired
    known = np.zeros((1, 1, 2)), P[None, None], np.ones((1, 1)), np.ones((1, 1, 2))
    out = imm.update(*known, H[None, None], R[None])
    assert not out[5].any() and not out[6].any()
    np.testing.assert_array_equal(out[1], known[1])


def test_the_obstacle_update_stays_positive_definite():
    rng = np.random.default_rng(8)
    P = ill_conditioned(rng, 2000, 4, 2)[0].reshape(500, 4, 4, 4)
    R = ill_conditioned(rng, 500, 4, 2)[4]
    mu, x = rng.dirichlet(np.ones(4), 500), np.zeros((500, 4, 4))
    h, z = np.zeros((500, 4, 2)), np.zeros((500, 2))
    repairs = 0
    for _ in range(5):
        x, P, mu, _, repaired = mixtures.update(x, P, mu, h, z, R)
        assert is_covariance(P)
        assert np.isfinite(x).all() and (mu >= 0.0).all()
        assert_allclose(mu.sum(axis=1), 1.0, rtol=1e-12)
        repairs += repaired.sum()
    assert repairs > 0
    # Weights add up to one but for rounding; the probability of `below` is their sum at most.
    mu = rng.dirichlet(np.full(16, 0.3), 4000)
    mean, std = -10.0 * np.ones((4000, 16)), 0.1 * np.ones((4000, 16))
    *_, negative = mixtures.bands(mean, std, mu, 0.05)
    assert (mu.sum(axis=1) > 1.0).any()
    assert (negative <= 1.0).all() and (negative > 1.0 - 1e-9).all()


def test_kalman_reports_what_it_repaired():
    P = np.stack([np.eye(2), np.diag([1e12, 1e12])])
    H = np.array([[1.0, 1.0 + 1e-7]])
    updated = kalman.update(np.zeros((2, 2)), P, np.ones((2, 1)), H, np.array([[1e-6]]))
    np.testing.assert_array_equal(updated.repaired, [False, True])
    assert not kalman.predict(np.zeros(2), np.eye(2), np.eye(2), np.eye(2)).repaired
    # A perfect measurement is allowed.
    known = np.zeros(2), np.eye(2), np.array([3.0]), np.eye(1, 2), np.zeros((1, 1))
    updated = kalman.update(*known)
    assert_allclose(updated.x, [3.0, 0.0], atol=1e-12)
    assert_allclose(updated.P, [[0.0, 0.0], [0.0, 1.0]], atol=1e-12)
    assert updated.P[0, 0] > 0.0 and updated.repaired


def covariances(rng, n, lanes):
    """Covariances (lanes, n, n): sound ones, singular ones, and some that are none."""
    A = rng.normal(size=(lanes, n, n)) * 10.0 ** rng.uniform(-3.0, 2.0, (lanes, n, 1))
    P = A @ np.swapaxes(A, -1, -2)
    P[1, 2, :] = P[1, :, 2] = 0.0
    P[2, n - 1, :] = P[2, :, n - 1] = P[2, 0, 0] = 0.0
    P[3] = np.outer(np.arange(1.0, n + 1), np.arange(1.0, n + 1))
    P[4, 1, 1] *= -1.0
    P[5, 0, 0] = np.nan
    P[6, n - 1, n - 1] = np.inf
    P[7] = 0.0
    return P


@pytest.mark.parametrize('n', [3, 6])
def test_roots_and_soundness_are_those_of_the_eigenvalues(n):
    P = covariances(np.random.default_rng(n), n, 40)
    S = np.moveaxis(P, 0, -1)
    L, sound = cov.semidefinite_roots(S), cov.are_sound(S)
    for k, each in enumerate(P):
        own = np.diag(each)
        lonely = (each[own == 0.0] != 0.0).any()  # a covariance without a variance
        least = -1.0 if lonely or not np.isfinite(each).all() else least_eigenvalue(each)
        if (own < 0.0).any() or least < -ROUNDING:
            assert not sound[k], k
        elif not own.any() or least > cov.LIMIT + ROUNDING:
            assert sound[k], k
        if sound[k]:
            mine, size = np.tril(L[:, :, k]), np.sqrt(own)
            assert (np.abs(mine @ mine.T - each) <= 1e-13 * np.outer(size, size)).all(), k
    assert {False, True} == set(sound.tolist())


@pytest.mark.parametrize('n', [3, 6])
def test_jitter_is_the_least_power_of_ten_that_cures(n):
    P = covariances(np.random.default_rng(n), n, 40)
    S = np.moveaxis(P, 0, -1)
    mended, repaired = cov.with_jitter(S)
    np.testing.assert_array_equal(repaired, ~cov.are_sound(S))
    cured = repaired & cov.are_sound(mended)
    assert cured.any() and (repaired & ~cured).any()
    for k in range(len(P)):
        if not cured[k]:
            assert_allclose(mended[..., k], P[k])
            continue
        own = np.diag(P[k])
        share = (np.diag(mended[..., k]) - own)[own > 0.0] / own[own > 0.0]
        assert share.min() == pytest.approx(share.max(), rel=1e-2) and share.min() < 2.0 * n
        assert share.min() >= 0.9 * cov.JITTER
        if share.min() > 5.0 * cov.JITTER:
            less = P[k] + np.diag(0.1 * share.min() * own)
            assert not cov.is_psd(less)


@pytest.mark.parametrize('mask', [[True] * 5, [True, True, True, False, False], [False] * 5])
def test_numbers_one_by_one_equal_the_joint_update(mask):
    """In turn they are the joint update but for Schmidt's gain: that is compared with numpy."""
    v, mask = vectors('consider_update'), np.array(mask)
    x, P = v['x'].copy(), v['P'].copy()
    y = v['innovation'] + v['H'] @ x
    plain_x, plain_P = x.copy(), P.copy()
    for h, R, value in zip(v['H'], np.diag(v['R']), y):
        nu = value - h @ x
        expected = -0.5 * (nu**2 / (h @ P @ h + R) + np.log(2 * np.pi * (h @ P @ h + R)))
        # two filters at once, the same
        xs, Ps = np.stack([x, x], 1), np.stack([P, P], 2)
        fit = consider_scalar(xs, Ps, np.stack([h, h], 1), R, np.array([nu, nu]), mask)
        assert fit == pytest.approx([expected, expected])
        x, P = xs[:, 1], Ps[..., 1]
        plain_x, plain_P = consider_update(
            plain_x, plain_P, h[None], np.array([[R]]), np.array([value - h @ plain_x]), mask
        )
        assert_allclose(x, plain_x, atol=1e-12)
        assert_allclose(P, plain_P, atol=1e-12)
    known = v['x'], v['P'], v['H'], v['R'], v['innovation']
    if mask.all():
        joint = consider_update(*known, mask)
        assert_allclose(x, joint[0], atol=1e-12)
        assert_allclose(P, joint[1], atol=1e-12)
    if not mask.any():
        np.testing.assert_array_equal(x, v['x'])
    due = consider_update(*known, v['estimated'].astype(bool))
    assert_allclose(due[0], v['out_x'], atol=1e-9)
    assert_allclose(due[1], v['out_P'], atol=1e-9)
    assert (due[1] == due[1].T).all()


def test_a_considered_bias_is_never_averaged_away():
    v = vectors('consider_static')
    P = np.diag([v['p0'], v['bias_var']])
    known = np.ones((1, 2)), v['r'][None, None], np.zeros(1), np.array([True, False])
    for expected in v['out_var']:
        _, P = consider_update(np.zeros(2), P, *known)
        assert P[0, 0] == pytest.approx(expected, rel=1e-9)
        assert P[0, 0] > v['bias_var'] and P[1, 1] == v['bias_var']


def test_covariances_stay_symmetric_and_positive_over_many_updates():
    rng = np.random.default_rng(1)
    n, mask = 8, np.arange(8) < 5
    A = rng.normal(size=(n, n))
    x, P = np.zeros(n), A @ A.T
    for _ in range(2000):
        P += 0.01 * np.diag(mask)
        x, P = consider_update(x, P, rng.normal(size=(1, n)), np.eye(1), np.ones(1), mask)
    assert (P == P.T).all() and np.linalg.eigvalsh(P).min() > 0.0


def test_the_subsets_of_the_vectors():
    v = vectors('subsets')
    numbers = [
        (lambda x, h=h: (float(h @ x), h), float(y), float(v['sigma'] ** 2))
        for h, y in zip(v['H'], v['y'])
    ]
    law = float(v['outlier_probability']), float(v['outlier_density'])
    got = subset_update(v['x'], v['P'], numbers, *law, prune=np.inf)
    np.testing.assert_array_equal(got.subsets, v['out_subsets'] == 1)
    assert_allclose(got.probability, v['out_subset_prob'], atol=1e-9)
    assert got.log_evidence == pytest.approx(float(v['out_log_evidence']), abs=1e-9)
    assert_allclose(got.x, v['out_x'], atol=1e-9)
    assert_allclose(got.P, v['out_P'], atol=1e-9)


def test_the_maximum_of_the_vectors():
    """x, y and the emission, whose prior is flat; weights, Laplace covariance and evidence."""
    v = vectors('robust')

    def measure(x, rx):
        d = np.array([*(x[:2] - rx[:2]), float(v['z']) - rx[2]])
        r = np.sqrt(d @ d)
        return r + x[2], np.array([d[0] / r, d[1] / r, 1.0])

    variance, rows = float(v['sigma']) ** 2, zip(v['rx'], v['path'])
    numbers = [(partial(measure, rx=rx), float(y), variance) for rx, y in rows]
    P = np.zeros((3, 3))
    P[:2, :2], P[2, 2] = v['prior_cov'], 1e8
    mean = np.append(v['prior_mean'], 0.0)
    got = student_t_maximum(mean, P, numbers, [mean, np.append(v['out_least_squares'], 0.0)])
    assert_allclose(got.x[:2], v['out_map'], atol=1e-5)
    assert got.x[2] == pytest.approx(float(v['out_te']), abs=1e-5)
    assert_allclose(got.weights, v['out_weights'], atol=1e-5)
    assert_allclose(got.P[:2, :2], v['out_cov_laplace'], atol=1e-5)
    # The evidence of the vectors has no constants of the prior nor of the t density.
    assert v['nu'] == DEGREES
    constants = 6 * student_t_constant(float(v['sigma']) ** 2)
    bare = got.log_evidence - constants + 0.5 * np.log(np.linalg.det(P)) + 1.5 * np.log(2 * np.pi)
    assert bare == pytest.approx(float(v['out_log_evidence_laplace']), abs=1e-4)


def test_angles_keep_their_direction_and_those_inside_their_bits():
    inside = np.concatenate([np.linspace(-np.pi, np.pi, 1001), [0.1, -0.0, 1e-300]])
    assert (wrap_angle(inside) == inside).all()
    angles = np.linspace(-20.0, 20.0, 1001)
    wrapped = wrap_angle(angles)
    assert (np.abs(wrapped) <= np.pi + 1e-15).all()
    assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-14)
    assert_allclose(wrap_angle(1e12), np.angle(np.exp(1e12j)), atol=1e-3)

    assert wrap_angle(4.0) == 4.0 - 2.0 * np.pi
    assert np.isnan(wrap_angle([np.nan])).all()
