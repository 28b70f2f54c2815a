# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Schmidt's update: vectors, many filters at once, and a bias that is never averaged away."""

from helpers.sea_vectors import vectors
import numpy as np
import pytest

from sonar_imm.estimation import imm
from sonar_imm.estimation.consider import consider_scalar, consider_update


def test_the_update_of_the_vectors():
    v = vectors('consider_update')
    x, P = consider_update(
        v['x'], v['P'], v['H'], v['R'], v['innovation'], v['estimated'].astype(bool)
    )
    np.testing.assert_allclose(x, v['out_x'], atol=1e-9)
    np.testing.assert_allclose(P, v['out_P'], atol=1e-9)
    assert (P == P.T).all()


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
        np.testing.assert_allclose(x, plain_x, atol=1e-12)
        np.testing.assert_allclose(P, plain_P, atol=1e-12)
    if mask.all():
        joint = consider_update(v['x'], v['P'], v['H'], v['R'], v['innovation'], mask)
        np.testing.assert_allclose(x, joint[0], atol=1e-12)
        np.testing.assert_allclose(P, joint[1], atol=1e-12)
    if not mask.any():
        np.testing.assert_array_equal(x, v['x'])


def test_a_considered_bias_is_never_averaged_away():
    v = vectors('consider_static')
    P = np.diag([v['p0'], v['bias_var']])
    for expected in v['out_var']:
        _, P = consider_update(
            np.zeros(2), P, np.ones((1, 2)), v['r'][None, None], np.zeros(1),
            np.array([True, False]),
        )  # fmt: skip
        assert P[0, 0] == pytest.approx(expected, rel=1e-9)
        assert P[0, 0] > v['bias_var'] and P[1, 1] == v['bias_var']


def test_covariances_stay_symmetric_and_positive_over_many_updates():
    rng = np.random.default_rng(1)
    n, mask = 8, np.arange(8) < 5
    A = rng.normal(size=(n, n))
    x, P = np.zeros(n), A @ A.T
    for _ in range(2000):
        x, P = consider_update(
            x, P + 0.01 * np.diag(mask), rng.normal(size=(1, n)), np.eye(1), np.ones(1), mask
        )
    assert (P == P.T).all() and np.linalg.eigvalsh(P).min() > 0.0


def test_mixing_leaves_what_is_considered_as_it_is():
    v = vectors('consider_mix')
    x, P, c = imm.mix(v['X'][None], v['P'][None], v['mu'][None], v['Pi'][None])
    np.testing.assert_allclose(x[0], v['out_X0'], atol=1e-9)
    np.testing.assert_allclose(P[0], v['out_P0'], atol=1e-9)
    np.testing.assert_allclose(c[0], v['out_c'], atol=1e-9)
