# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The table of rows: what belongs together stays together, and no weight is lost."""

import math

from attrs import evolve
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from sonar_imm.estimation import bank
from sonar_imm.estimation.bank import Gaussians
from sonar_imm.estimation.rows import Borrowed, drop_weightless_rows, restore_rows, ROW_LOST, Rows

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
    return (
        rows.replace(logw=rows.logw - total[target]),
        Borrowed(lent, {'scale': SCALES[its]}, borrowed.logw - total[lent]),
        rng,
    )


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
    if not kept.any():
        kept[0] = True
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
        scales = np.append(
            back.key['scale'][back.target == k], waiting.key['scale'][waiting.target == k]
        )
        own = np.append(
            rows.key['scale'][rows.target == k], borrowed.key['scale'][borrowed.target == k]
        )
        assert sorted(scales) == sorted(own)
    parents = by_name(thin, thin.parent)
    assert all(parents[int(n)] == p for n, p in zip(back.key['name'], back.parent))
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
    means = bank.combine(rows.blocks, rows.mu, outputs)
    mean, covariance = rows.combine(*means, rows.weight)
    x, P = rows.blocks[0]
    for target in range(rows.target.max() + 1):
        own = np.flatnonzero(rows.target == target)
        weight = (rows.weight[own, None] * rows.mu[own]).ravel()
        points = np.moveaxis(x[own, :2], 1, -1).reshape(-1, 2)
        spread = np.moveaxis(P[own, :2, :2], -1, 1).reshape(-1, 2, 2)
        due = weight @ points
        d = points - due
        due_P = np.einsum('k,kab->ab', weight, spread + d[:, :, None] * d[:, None])
        np.testing.assert_allclose(mean[target], due, rtol=1e-9)
        np.testing.assert_allclose(covariance[target], due_P, rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(rows.model_probabilities().sum(axis=1), 1.0)
