# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Probabilities of association against all joint events, also where rows exclude other targets."""

from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
from oracles.jipda import events
import pytest

from sonar_imm.estimation import marginals as module
from sonar_imm.estimation.linked_rows import linked_marginals, MOST_CLASSES
from sonar_imm.estimation.marginals import clusters, log_total, marginals


def problem(seed, T, D, share=0.7):
    """Weights of all sizes, some pairs impossible."""
    rng = np.random.default_rng(seed)
    weight = rng.gamma(0.3, 4.0, (T, D)) * 10.0 ** rng.uniform(-6.0, 6.0, (T, 1))
    return weight, 10.0 ** rng.uniform(-6.0, 0.0, T), rng.uniform(size=(T, D)) < share


def enumerated(weight, missed, possible):
    pair, none, total = np.zeros(weight.shape), np.zeros(len(missed)), 0.0
    for event in events(possible):
        w = np.prod([missed[t] if d < 0 else weight[t, d] for t, d in enumerate(event)])
        total += w
        for t, d in enumerate(event):
            if d < 0:
                none[t] += w
            else:
                pair[t, d] += w
    return pair / total, none / total, np.log(total)


@settings(deadline=None, max_examples=200)
@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(0, 5))
def test_they_are_the_sums_over_all_joint_events(seed, T, D):
    case = problem(seed, T, D)
    for found, due in zip([*marginals(*case), log_total(*case)], enumerated(*case)):
        np.testing.assert_allclose(found, due, rtol=1e-12, atol=1e-300)


@pytest.mark.parametrize('T, D', [(5, 9), (9, 5), (8, 8)])
def test_tracks_and_detections_may_change_roles(T, D):
    """Where a false detection weighs 1, the problem turned round is the same one."""
    weight, missed, possible = problem(T * D, T, D)
    pair, none = marginals(weight, missed, possible)
    turned, nobodys = marginals((weight / missed[:, None]).T, np.ones(D), possible.T)
    np.testing.assert_allclose(pair, turned.T, rtol=1e-10)
    np.testing.assert_allclose(none, 1.0 - turned.sum(axis=0), atol=1e-10)
    np.testing.assert_allclose(nobodys, 1.0 - pair.sum(axis=0), atol=1e-10)


@pytest.mark.parametrize('T, D', [(12, 12), (12, 40), (13, 13), (30, 25)])
def test_rows_are_distributions_and_no_detection_is_given_away_twice(T, D):
    pair, none = marginals(*problem(T + D, T, D, share=0.9))
    np.testing.assert_allclose(pair.sum(axis=1) + none, 1.0, rtol=1e-12)
    exact = min(T, D) <= module.LARGEST
    assert (pair >= 0.0).all() and (pair.sum(axis=0) <= 1.0 + (1e-12 if exact else 1e-3)).all()


def test_a_cluster_that_is_too_large_is_solved_by_propagation(monkeypatch):
    """Fourteen tracks side by side, each near its own detection."""
    at = np.arange(14.0)
    distance = np.square(at[:, None] - at[None] - 0.2)
    weight, missed = 90.0 * np.exp(-0.5 * distance / 0.2), np.full(14, 0.1)
    possible = distance < 16.0
    pair, none = marginals(weight, missed, possible)
    monkeypatch.setattr(module, 'LARGEST', 14)
    exact, alone = marginals(weight, missed, possible)
    assert 0.0 < np.abs(pair - exact).max() < 0.02
    assert np.abs(none - alone).max() < 0.02


@pytest.mark.parametrize('spread', [0.05, 0.2])
def test_the_weight_of_all_events_of_a_large_cluster(monkeypatch, spread):
    """By propagation, which is exact where the cluster is a tree, against the exact sum."""
    at = np.arange(14.0)
    distance = np.square(at[:, None] - at[None] - 0.3)
    weight, missed = 90.0 * np.exp(-0.5 * distance / spread), np.linspace(0.1, 0.4, 14)
    for reach, tolerance in ((0.6, 1e-6), (16.0, 0.15)):
        possible = distance < reach
        total = log_total(weight, missed, possible)
        with monkeypatch.context() as patch:
            patch.setattr(module, 'LARGEST', 14)
            assert total == pytest.approx(log_total(weight, missed, possible), abs=tolerance)


def test_equal_pairs_in_a_large_cluster_end():
    pair, none = marginals(np.ones((40, 40)), np.full(40, 0.1), np.ones((40, 40), bool))
    np.testing.assert_allclose(pair.sum(axis=1) + none, 1.0)


def test_the_order_of_tracks_and_detections_does_not_matter():
    weight, missed, possible = problem(3, 9, 11)
    rng = np.random.default_rng(4)
    rows, columns = rng.permutation(9), rng.permutation(11)
    pair, none = marginals(weight, missed, possible)
    cell = np.ix_(rows, columns)
    other, alone = marginals(weight[cell], missed[rows], possible[cell])
    np.testing.assert_allclose(other, pair[cell], rtol=1e-10)
    np.testing.assert_allclose(alone, none[rows], rtol=1e-10)


@given(st.integers(0, 2**32 - 1))
def test_clusters_are_connected_components(seed):
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    rng = np.random.default_rng(seed)
    T, D = rng.integers(1, 12), rng.integers(0, 12)
    possible = rng.uniform(size=(T, D)) < 0.15
    t, d = np.nonzero(possible)
    graph = coo_array((np.ones(len(t)), (t, T + d)), shape=(T + D, T + D))
    due = connected_components(graph, directed=False)[1][:T]
    label = clusters(possible)
    assert np.array_equal(label[:, None] == label[None], due[:, None] == due[None])
    assert all(label[label == first].size and label[first] == first for first in set(label))


VECTORS = Path(__file__).parents[1] / 'vectors/diver_in_the_field/linked_rows.npz'


def cluster(vectors, number):
    return {
        name.partition('/')[2]: vectors[name]
        for name in vectors
        if name.startswith(f'{number:02d}/')
    }


@pytest.mark.parametrize('number', range(24))
def test_rows_and_fixes_are_those_of_the_enumeration(number):
    with np.load(VECTORS) as vectors:
        own, p = cluster(vectors, number), float(vectors['detection_probability'])
        clutter = float(vectors['clutter'])
    track, weight, link = own['track'], own['weight'], own['link']
    T = int(track.max()) + 1
    linked = np.flatnonzero(link >= 0)
    of = track.copy()
    of[linked] = T + np.arange(len(linked))
    target = np.concatenate([np.arange(T), track[linked]])
    links = np.concatenate([np.full(T, -1), link[linked]])
    ways = ('dir', 'stay', 'leave', 'open')
    density = weight[:, None] * sum(own[way] for way in ways) / clutter
    assigned = np.zeros((len(target), density.shape[1]))
    np.add.at(assigned, of, density)
    alive = (1.0 - p) * np.bincount(of, weight, minlength=len(target))
    missed = alive.copy()
    missed[:T] += 1.0 - np.bincount(track, weight, minlength=T)
    found = linked_marginals(assigned, missed, assigned > 0.0, target, links, T)
    none = found.none[of] * weight * (1.0 - p) / missed[of]
    np.testing.assert_allclose(none, own['after_miss'], atol=1e-12)
    share = found.pair[of] / np.where(assigned[of] > 0.0, assigned[of], 1.0)
    for way in ways:
        after = share * weight[:, None] * own[way] / clutter
        np.testing.assert_allclose(after, own[f'after_{way}'], atol=1e-12)


def test_without_links_they_are_the_marginals():
    rng = np.random.default_rng(0)
    assigned, missed = rng.uniform(size=(5, 4)), rng.uniform(size=5) + 0.1
    possible = rng.uniform(size=(5, 4)) < 0.7
    pair, none = marginals(assigned, missed, possible)
    found = linked_marginals(assigned, missed, possible, np.arange(5), np.full(5, -1), 5)
    np.testing.assert_allclose(found.pair, pair, atol=1e-14)
    np.testing.assert_allclose(found.none, none, atol=1e-14)
    np.testing.assert_array_equal(found.held, 1.0)


def test_more_links_than_classes_leave_out_the_lightest():
    rng = np.random.default_rng(1)
    T, rows = 4, 3
    target = np.concatenate([np.arange(2 * T), np.repeat(np.arange(T), rows)])
    link = np.concatenate([np.full(2 * T, -1), T + np.tile(np.arange(T), rows)])
    G = len(target)
    assigned, missed = rng.uniform(size=(G, 3)), rng.uniform(size=G) + 0.1
    found = linked_marginals(assigned, missed, np.ones((G, 3), bool), target, link, 2 * T)
    assert (1 + rows) ** T > MOST_CLASSES
    used = found.pair.sum(axis=1) + found.none
    assert np.isfinite(used).all() and (used[2 * T :] == 0.0).any() and (used[2 * T :] > 0.0).any()
    assert (found.pair.sum(axis=0) <= 1.0 + 1e-12).all()
