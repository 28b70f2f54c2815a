# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The bank of models and the table of rows against an independent prototype, plain Kalman updates
and Monte Carlo."""

import math

from attrs import evolve
from helpers.vector_files import load_vectors
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from sonar_imm.estimation import bank as verbs
from sonar_imm.estimation.bank import Bank, Gaussians
from sonar_imm.estimation.rows import Borrowed, drop_weightless_rows, restore_rows, ROW_LOST, Rows

MIXING = load_vectors('regret_free/mixing')
ORDER = np.argsort(MIXING['kind'] == 1, kind='stable')
"""Velocities come last in a bank."""
A = int((MIXING['kind'] != 1).sum())
HOVER = MIXING['kind'][ORDER][:A] == 2
UNITS = np.where(HOVER, 0.0, MIXING['heading'][ORDER][:A].T)
BANK = Bank(
    UNITS, velocities=3, speed=float(MIXING['speed_mean']),
    speed_variance=float(MIXING['speed_variance']), sector=float(MIXING['sector_variance']),
)  # fmt: skip


def given_blocks():
    """Blocks of one row from the prototype's x (37, 4) and P (37, 4, 4)."""
    x, P = MIXING['x'][ORDER], MIXING['P'][ORDER]
    return [
        Gaussians(x[:A, :3].T[None], np.moveaxis(P[:A, :3, :3], 0, -1)[None]),
        Gaussians(x[A:].T[None], np.moveaxis(P[A:], 0, -1)[None]),
    ]


def transition():
    return MIXING['transition_1s'][np.ix_(ORDER, ORDER)][None]


def test_rows_do_not_influence_each_other_and_moments_are_about_the_row():
    """And not about the origin: row 4 is row 3, far away."""
    rng, blocks = np.random.default_rng(1), given_blocks()
    weights = rng.dirichlet(MIXING['mu'][ORDER] * 40.0 + 0.1, 5)
    weights[4] = weights[3]
    many = [Gaussians(np.repeat(b.x, 5, 0), np.repeat(b.P, 5, 0)) for b in blocks]
    for block in many:
        block.x[:] += rng.normal(size=(5, 1, 1))
        block.x[4] = block.x[3]
        block.x[4, :2] += 1e6
    together, c = verbs.mix(BANK, many, weights, transition())
    for row in range(4):
        one = [b.select([row]) for b in many]
        alone, c_alone = verbs.mix(BANK, one, weights[[row]], transition())
        np.testing.assert_allclose(c[row], c_alone[0], rtol=1e-12)
        for found, right in zip(together, alone):
            np.testing.assert_allclose(found.x[row], right.x[0], rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(found.P[row], right.P[0], rtol=1e-12, atol=1e-12)
    for found in together:
        np.testing.assert_allclose(found.x[4, :2] - 1e6, found.x[3, :2], atol=1e-8)
        np.testing.assert_allclose(found.P[4], found.P[3], atol=1e-8)


def test_states_behind_the_motion_are_mixed_by_identity():
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
    for found in verbs.mix(BANK, more, MIXING['mu'][ORDER][None], transition())[0]:
        np.testing.assert_allclose(found.x[:, -1], 0.7)
        np.testing.assert_allclose(found.P[:, -1, -1], 4.0)


def test_a_velocity_given_its_heading_is_what_samples_say():
    """Of velocities near a heading, those inside the sector: mean speed and position."""
    rng = np.random.default_rng(0)
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
    return rng.normal(size=(N, m, n)), P, rng.dirichlet(np.ones(m), N), rng


def model_last(x, P):
    return Gaussians(np.moveaxis(x, 1, -1), np.moveaxis(P, 1, -1))


def moment_matched(x, P, c, z, R, beta, missed, estimated):
    """x (M, n), P (M, n, n) and mu (M,) of one row by its measurements z (D, 2) with covariances R
    (D, 2, 2): a Kalman update for each and none, and their mixture by beta (D,), missed."""
    D, (M, n), H = len(z), x.shape, np.eye(2, x.shape[1])
    pairs = np.ndindex(D, M)
    law = [multivariate_normal(H @ x[j], H @ P[j] @ H.T + R[d]).pdf(z[d]) for d, j in pairs]
    density = np.reshape(law, (D, M))
    share = beta[:, None] * density / (density @ c)[:, None]
    weight = missed + share.sum(axis=0)
    x1, P1 = np.empty((M, n)), np.empty((M, n, n))
    for j in range(M):
        means, covariances = [x[j]], [P[j]]
        for d in range(D):
            gain = P[j] @ H.T @ np.linalg.inv(H @ P[j] @ H.T + R[d]) * estimated[:, None]
            left = np.eye(n) - gain @ H
            means.append(x[j] + gain @ (z[d] - H @ x[j]))
            covariances.append(left @ P[j] @ left.T + gain @ R[d] @ gain.T)
        b = np.append(missed, share[:, j]) / weight[j]
        x1[j] = b @ means
        P1[j] = np.tensordot(b, covariances, 1) + np.cov(np.transpose(means), aweights=b, ddof=0)
    return x1, P1, c * weight / (c @ weight), np.log(density)


def updated(x, P, c, z, R, beta, missed, estimated):
    """The same of many rows by the bank: x (T, M, n), ..., beta (T, D), missed (T,)."""
    block, (row, d) = model_last(x, P), (each.ravel() for each in np.indices(beta.shape))
    pairs = verbs.weigh(block, row, z[d], R[d])
    f = (c[row] * np.exp(pairs.log)).sum(axis=1, keepdims=True)
    ratio = beta.ravel()[:, None] * np.exp(pairs.log) / f
    after, weight = verbs.update(block, pairs, row, ratio, missed, estimated=estimated)
    logs = pairs.log.reshape(*beta.shape, -1)
    return np.moveaxis(after.x, -1, 1), np.moveaxis(after.P, -1, 1), c * weight, logs


@pytest.mark.parametrize('considered', [False, True])
def test_several_measurements_are_moment_matched(considered):
    x, P, mu, rng = one_block(7)
    z, noise = rng.normal(size=(3, 2)), rng.normal(size=(3, 2, 2))
    R = noise @ np.swapaxes(noise, -1, -2) + 0.1 * np.eye(2)
    share, estimated = rng.dirichlet(np.ones(4), 4), np.array([True, True, not considered])
    found = updated(x, P, mu, z, R, share[:, 1:], share[:, 0], estimated)
    for k in range(4):
        due = moment_matched(x[k], P[k], mu[k], z, R, share[k, 1:], share[k, 0], estimated)
        for ours, right in zip(found, due):
            np.testing.assert_allclose(ours[k], right, rtol=1e-9, atol=1e-12)


def test_the_update_is_that_of_the_prototype():
    names = ('X', 'P', 'mu', 'Z', 'R', 'beta', 'beta0')
    known = load_vectors('diver_sea/association')
    X, P, mu, Z, R, beta, beta0 = (known[f'imm_pda/{name}'] for name in names)
    many, every = np.tile(R, (len(Z), 1, 1)), np.ones(X.shape[1], bool)
    assert (known['imm_pda/H'] == np.eye(2, X.shape[1])).all()
    ours = updated(X[None], P[None], mu[None], Z, many, beta[None], np.reshape(beta0, 1), every)
    for found, name in zip(ours, ('out_X', 'out_P', 'out_mu')):
        np.testing.assert_allclose(found[0], known[f'imm_pda/{name}'], rtol=1e-10)


def test_a_measured_value_may_be_a_sum_of_components():
    x, P, _, rng = one_block(8, N=1, n=5)
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
    block, none = model_last(*one_block(9)[:2]), np.empty(0, int)
    pairs = verbs.weigh(block, none, np.empty((0, 2)), np.empty((0, 2, 2)))
    after, weight = verbs.update(block, pairs, none, np.empty((0, 5)), np.full(4, 0.3))
    assert after is block
    np.testing.assert_array_equal(weight, 0.3)


# -- the table of rows: what belongs together stays together, and no weight is lost ---------------

of_any = given(st.integers(0, 2**32 - 1))
SCALES = np.array([0.1, 1.0, 3.0, 10.0, 30.0])


def table(seed, tags=None):
    """Rows of some targets, one at least of each, and scales without one. The key `tag` says which
    target it was, and `name` which row; the first mean is the name too."""
    rng = np.random.default_rng(seed)
    tags = 7 + np.arange(rng.integers(1, 6)) if tags is None else tags
    T = len(tags)
    has = rng.uniform(size=(T, len(SCALES))) < 0.5
    has[np.arange(T), rng.integers(0, len(SCALES), T)] = True
    target, scale = np.nonzero(has)
    lent, its = np.nonzero(~has & (rng.uniform(size=has.shape) < 0.7))
    log = rng.normal(-5.0, 5.0, has.shape)
    N = len(target)
    name = 100 * seed % 10**6 + np.arange(N)
    root = rng.normal(size=(N, 4, 3, 3))
    x = rng.normal(size=(N, 3, 4))
    x[:, 0, 0] = name
    P = np.moveaxis(root @ np.swapaxes(root, -1, -2) + 0.1 * np.eye(3), 1, -1)
    key = {'scale': SCALES[scale], 'tag': np.asarray(tags)[target], 'name': name}
    mu, parent = rng.dirichlet(np.ones(4), N), rng.integers(-1, 50, N)
    rows = Rows((Gaussians(x, P),), mu, log[target, scale], target, parent, key)
    borrowed = Borrowed(lent, {'scale': SCALES[its]}, log[lent, its])
    total = weights(rows, borrowed)
    rows = rows.replace(logw=rows.logw - total[target])
    return rows, evolve(borrowed, logw=borrowed.logw - total[lent]), rng


def weights(rows, borrowed):
    """(T,) logarithm of the weight of each target, with what is borrowed."""
    total = np.full(rows.target.max() + 1, -np.inf)
    np.logaddexp.at(total, rows.target, rows.logw)
    np.logaddexp.at(total, borrowed.target, borrowed.logw)
    return total


def require_whole(rows, tags):
    """Rows stand by rising target, those of one target side by side, each with all that is its
    own; tags (T,): of the targets."""
    assert (np.diff(rows.target) >= 0).all()
    assert np.array_equal(np.unique(rows.target), np.arange(len(tags)))
    assert np.array_equal(rows.key['tag'], np.asarray(tags)[rows.target])
    assert np.array_equal(rows.blocks[0].x[:, 0, 0], rows.key['name'])
    assert len(rows.mu) == len(rows.logw) == len(rows.parent) == len(rows.blocks[0].P) == len(rows)


def by_name(rows, column):
    return dict(zip(rows.key['name'].tolist(), column.tolist()))


@of_any
def test_targets_that_go_are_numbered_anew_with_their_rows(seed):
    rows, borrowed, rng = table(seed)
    tags = np.unique(rows.key['tag'])
    kept = rng.uniform(size=len(tags)) < 0.6
    kept[0] |= not kept.any()
    left, lent = rows.select_targets(kept), borrowed.select_targets(kept)
    require_whole(left, tags[kept])
    assert set(left.key['tag']) == set(tags[kept])
    before = by_name(rows, rows.parent)
    assert all(parent == before[name] for name, parent in by_name(left, left.parent).items())
    for new, old in enumerate(np.flatnonzero(kept)):
        own = borrowed.target == old
        assert np.array_equal(lent.key['scale'][lent.target == new], borrowed.key['scale'][own])
        assert np.array_equal(lent.logw[lent.target == new], borrowed.logw[own])


@of_any
def test_new_rows_stand_beside_those_of_their_target(seed):
    rows, _, rng = table(seed)
    tags = np.unique(rows.key['tag'])
    T, more = len(tags), 90 + np.arange(2)
    new, *_ = table(seed + 1, np.append(tags[rng.integers(T)], more))
    target = np.searchsorted(np.append(tags, more), new.key['tag'])
    order = np.argsort(target, kind='stable')
    new = evolve(new.select(order), target=target[order], parent=np.full(len(new), -1))
    both = rows.append(new)
    require_whole(both, np.append(tags, more))
    due = by_name(rows, rows.parent) | by_name(new, new.parent)
    assert by_name(both, both.parent) == due
    with pytest.raises(ValueError, match='rows with .* do not fit'):
        rows.append(rows.select(np.array([0])).replace(key={}))


@of_any
def test_the_rows_of_one_target_are_replaced(seed):
    rows, borrowed, rng = table(seed)
    tags = np.unique(rows.key['tag'])
    target = int(rng.integers(len(tags)))
    new, *_ = table(seed + 1, tags[[target]])
    after = rows.replace_target(target, new)
    require_whole(after, tags)
    due = dict.fromkeys(new.key['name'].tolist(), -1)
    other = rows.target != target
    due |= {int(name): int(row) for name, row in zip(rows.key['name'][other], rows.parent[other])}
    assert by_name(after, after.parent) == due
    assert not (borrowed.without_target(target).target == target).any()
    assert len(borrowed.without_target(target)) == np.count_nonzero(borrowed.target != target)


@of_any
def test_a_row_that_is_lost_keeps_its_weight_and_gets_a_row_again(seed):
    rows, borrowed, rng = table(seed)
    tags, total = np.unique(rows.key['tag']), weights(rows, borrowed)
    stays = rows.logw == np.maximum.reduceat(rows.logw, rows.first)[rows.target]
    thin, lent, left = drop_weightless_rows(rows, borrowed, stays)
    require_whole(thin, tags)
    np.testing.assert_allclose(weights(thin, lent), total, atol=1e-12)
    assert np.array_equal(thin.key['name'], rows.key['name'][left])
    assert np.array_equal(thin.parent, rows.parent[left])
    assert (stays | (rows.logw >= math.log(ROW_LOST)))[left].all()
    assert len(thin) + len(lent) == len(rows) + len(borrowed)
    again = rng.uniform(size=len(lent)) < 0.5
    back, waiting = restore_rows(thin, lent, again)
    # A copy has the name of its lender, which is one of its own target.
    require_whole(back, tags)
    np.testing.assert_allclose(weights(back, waiting), total, atol=1e-12)
    for k in range(len(tags)):
        scales, own = (
            [s for each in pair for s in each.key['scale'][each.target == k]]
            for pair in ((back, waiting), (rows, borrowed))
        )
        assert sorted(scales) == sorted(own)
    parents = by_name(thin, thin.parent)
    assert all(parents[int(n)] == p for n, p in zip(back.key['name'], back.parent))
    assert len(Borrowed(lent.target[:0], {}, lent.logw[:0]).find_lenders(thin)) == 0
    lender = lent.find_lenders(thin)
    assert np.array_equal(thin.target[lender], lent.target)
    heaviest = np.maximum.reduceat(thin.logw, thin.first)
    assert np.array_equal(thin.logw[lender], heaviest[lent.target])


@of_any
def test_weights_of_the_rows_of_a_target_sum_to_one(seed):
    rows, _, rng = table(seed)
    np.testing.assert_allclose(np.add.reduceat(rows.weight, rows.first), 1.0)
    counted = rng.uniform(size=len(rows)) < 0.5
    some = rows.weights_among(counted)
    for k in range(rows.target.max() + 1):
        own = rows.target == k
        chosen = own & counted if (own & counted).any() else own
        np.testing.assert_allclose(some[chosen], rows.weight[chosen] / rows.weight[chosen].sum())
        assert (some[own & ~chosen] == 0.0).all()


@of_any
def test_models_and_rows_are_weighed_by_bayes(seed):
    rows, _, rng = table(seed)
    factor = rng.uniform(0.0, 2.0, rows.mu.shape)
    factor[0] = 0.0  # what no model explains keeps its models
    after, total = rows.multiply_models(factor)
    np.testing.assert_allclose(total, (rows.mu * factor).sum(axis=1))
    np.testing.assert_array_equal(after.mu[0], rows.mu[0])
    np.testing.assert_allclose(after.mu[1:] * total[1:, None], (rows.mu * factor)[1:])


@settings(max_examples=30)
@of_any
def test_the_mixture_of_rows_is_that_of_all_their_models(seed):
    rows, *_ = table(seed)
    outputs = [np.repeat(np.eye(2, 3)[..., None], 4, axis=2)]
    means = verbs.combine(rows.blocks, rows.mu, outputs)
    mean, covariance = rows.combine(*means, rows.weight)
    x, P = rows.blocks[0]
    for target in range(rows.target.max() + 1):
        own = np.flatnonzero(rows.target == target)
        weight = rows.weight[own, None] * rows.mu[own]
        due = np.einsum('km,kam->a', weight, x[own, :2])
        d = x[own, :2] - due[:, None]
        spread = P[own, :2, :2] + d[:, :, None] * d[:, None]
        np.testing.assert_allclose(mean[target], due, rtol=1e-9)
        due = np.einsum('km,kabm->ab', weight, spread)
        np.testing.assert_allclose(covariance[target], due, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(rows.model_probabilities().sum(axis=1), 1.0)
