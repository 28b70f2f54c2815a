# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The bank of models and the table of rows against an independent prototype, the readable IMM and
Monte Carlo."""

from pathlib import Path

import numpy as np
import pytest

from sonar_imm.estimation import bank as verbs
from sonar_imm.estimation.bank import Bank, Gaussians

FOLDER = Path(__file__).parents[1] / 'vectors' / 'regret_free'
MIXING = np.load(FOLDER / 'mixing.npz', allow_pickle=False)
ORDER = np.argsort(MIXING['kind'] == 1, kind='stable')
"""Velocities come last in a bank."""
A = int((MIXING['kind'] != 1).sum())
HOVER = MIXING['kind'][ORDER][:A] == 2
UNITS = np.where(HOVER, 0.0, MIXING['heading'][ORDER][:A].T)
BANK = Bank(
    UNITS, velocities=3, speed=float(MIXING['speed_mean']),
    speed_variance=float(MIXING['speed_variance']), sector=float(MIXING['sector_variance']),
)  # fmt: skip


def blocks_of(x, P):
    """Blocks of one row from the prototype's x (37, 4) and P (37, 4, 4)."""
    return [
        Gaussians(x[:A, :3].T[None], np.moveaxis(P[:A, :3, :3], 0, -1)[None]),
        Gaussians(x[A:].T[None], np.moveaxis(P[A:], 0, -1)[None]),
    ]


def given_blocks():
    return blocks_of(MIXING['x'][ORDER], MIXING['P'][ORDER])


def transition(name='transition_1s'):
    return MIXING[name][np.ix_(ORDER, ORDER)][None]


def test_rows_do_not_influence_each_other():
    rng = np.random.default_rng(1)
    blocks, mu = given_blocks(), MIXING['mu'][ORDER]
    many = [Gaussians(np.repeat(b.x, 5, 0), np.repeat(b.P, 5, 0)) for b in blocks]
    for block in many:
        block.x[:] += rng.normal(size=(5, 1, 1))
    weights = rng.dirichlet(mu * 40.0 + 0.1, 5)
    together, c = verbs.mix(BANK, many, weights, transition())
    for row in range(5):
        alone, c_alone = verbs.mix(
            BANK, [b.select([row]) for b in many], weights[[row]], transition()
        )
        np.testing.assert_allclose(c[row], c_alone[0], rtol=1e-12)
        for found, right in zip(together, alone):
            np.testing.assert_allclose(found.x[row], right.x[0], rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(found.P[row], right.P[0], rtol=1e-12, atol=1e-12)


def test_moments_are_about_the_row_and_not_about_the_origin():
    mu = MIXING['mu'][ORDER][None]
    here, _ = verbs.mix(BANK, given_blocks(), mu, transition())
    away = given_blocks()
    for block in away:
        block.x[:, :2] += 1e6
    there, _ = verbs.mix(BANK, away, mu, transition())
    for found, right in zip(there, here):
        np.testing.assert_allclose(found.x[:, :2] - 1e6, right.x[:, :2], atol=1e-8)
        np.testing.assert_allclose(found.P, right.P, atol=1e-8)


def test_states_behind_the_motion_are_mixed_by_identity():
    """A constant that is the same in all models stays as it is."""
    rng = np.random.default_rng(2)
    more = []
    for block in given_blocks():
        n = block.x.shape[1]
        x = np.insert(block.x, n, 0.7, axis=1)
        P = np.zeros((1, n + 1, n + 1, block.x.shape[2]))
        P[:, :n, :n] = block.P
        P[:, n, n] = 4.0
        P[:, :2, n] = P[:, n, :2] = rng.normal(size=(1, 2, 1))
        more.append(Gaussians(x, P))
    mixed, _ = verbs.mix(BANK, more, MIXING['mu'][ORDER][None], transition())
    plain, _ = verbs.mix(BANK, given_blocks(), MIXING['mu'][ORDER][None], transition())
    for found, right in zip(mixed, plain):
        n = right.x.shape[1]
        np.testing.assert_allclose(found.x[:, n], 0.7)
        np.testing.assert_allclose(found.P[:, n, n], 4.0)


@pytest.mark.parametrize('seed', range(3))
def test_a_velocity_given_its_heading_is_what_samples_say(seed):
    """Of velocities near a heading, those inside the sector: mean speed and position."""
    rng = np.random.default_rng(seed)
    x = np.array([3.0, -2.0, 0.8, 0.1])
    root = rng.normal(size=(4, 4)) * [0.5, 0.5, 0.2, 0.2]
    P = root.T @ root + 0.02 * np.eye(4)
    alone = Bank(np.array([[1.0], [0.0]]), velocities=1, sector=BANK.sector)
    block = Gaussians(x[None, :, None], P[None, :, :, None])
    moments, _ = verbs._to_headings(alone, block, np.zeros((1, 3)))
    samples = rng.multivariate_normal(x, P, 200_000)
    variance = BANK.sector * (x[2] ** 2 + P[2, 2]) + verbs.LEAST_ACROSS
    weight = np.exp(-0.5 * samples[:, 3] ** 2 / variance)
    mean = weight @ samples[:, :3] / weight.sum()
    np.testing.assert_allclose(moments[0, :3, 0, 0], mean, atol=0.02)


def one_block(seed, N=4, n=3, m=5):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(N, m, n, n))
    P = root @ np.swapaxes(root, -1, -2) + 0.1 * np.eye(n)
    x, mu = rng.normal(size=(N, m, n)), rng.dirichlet(np.ones(m), N)
    matrix = rng.dirichlet(np.ones(m), m)
    F = np.eye(n) + np.triu(rng.normal(size=(m, n, n)), 1)
    Q, B = np.tile(0.3 * np.eye(n), (m, 1, 1)), rng.normal(size=(m, n))
    return x, P, mu, matrix[None], F, Q, B, rng


def model_last(x, P):
    return Gaussians(np.moveaxis(x, 1, -1), np.moveaxis(P, 1, -1))


@pytest.mark.parametrize('considered', [False, True])
def test_several_measurements_are_moment_matched(considered):
    """Against one Kalman update for each measurement, and their mixture with none of them."""
    from oracles import jipda as oracle

    x, P, mu, _, _, _, _, rng = one_block(7, N=2)
    z, R = rng.normal(size=(3, 2)), np.tile(0.5 * np.eye(2) + 0.1, (3, 1, 1))
    beta, missed = np.array([0.2, 0.5, 0.1]), 0.2
    H = np.broadcast_to(np.eye(2, 3), (5, 2, 3))
    estimated = np.array([True, True, not considered])
    block, row = model_last(x, P), np.repeat([0, 1], 3)
    pairs = verbs.weigh(block, row, np.tile(z, (2, 1)), np.tile(R, (2, 1, 1)))
    f = (mu[row] * np.exp(pairs.log)).sum(axis=1)
    ratio = np.tile(beta, 2)[:, None] * np.exp(pairs.log) / f[:, None]
    after, weight = verbs.update(block, pairs, row, ratio, np.full(2, missed), estimated=estimated)
    for k in range(2):
        innovation = z[:, None] - x[k, :, :2]
        due = oracle.update(x[k], P[k], mu[k], innovation, H, R, beta, missed, ~estimated)
        np.testing.assert_allclose(after.x[k].T, due[0], rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(np.moveaxis(after.P[k], -1, 0), due[1], rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(mu[k] * weight[k], due[2], rtol=1e-10)


def test_a_measured_value_may_be_a_sum_of_components():
    """Position and a lasting error of the fix, against H as a matrix."""
    x, P, *_, rng = one_block(8, N=1, n=5)
    z, R = rng.normal(size=(1, 2)), np.tile(np.eye(2), (1, 1, 1))
    H = np.array([[1.0, 0, 0, 1.0, 0], [0, 1.0, 0, 0, 1.0]])
    block, row = model_last(x, P), np.zeros(1, int)
    measured = ((0, 3), (1, 4))
    pairs = verbs.weigh(block, row, z, R, measured)
    after, _ = verbs.update(block, pairs, row, np.ones((1, 5)), np.zeros(1), measured)
    for j in range(5):
        S = H @ P[0, j] @ H.T + R[0]
        K = P[0, j] @ H.T @ np.linalg.inv(S)
        np.testing.assert_allclose(after.x[0, :, j], x[0, j] + K @ (z[0] - H @ x[0, j]))
        np.testing.assert_allclose(after.P[0, ..., j], P[0, j] - K @ S @ K.T, rtol=1e-9)


def test_without_a_measurement_nothing_changes():
    x, P, *_ = one_block(9)
    block, none = model_last(x, P), np.empty(0, int)
    pairs = verbs.weigh(block, none, np.empty((0, 2)), np.empty((0, 2, 2)))
    after, weight = verbs.update(block, pairs, none, np.empty((0, 5)), np.full(4, 0.3))
    assert after is block
    np.testing.assert_array_equal(weight, 0.3)


# -- the table of rows ---------------------------------------------------------------------------
