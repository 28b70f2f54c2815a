# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Probabilities of association against all joint events, an independent prototype and brute force,
also where rows exclude other targets."""

from itertools import product

from helpers.vector_files import load_vectors
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from sonar_imm.estimation import jipda
from sonar_imm.estimation import marginals as module
from sonar_imm.estimation.linked_rows import linked_marginals, MOST_CLASSES
from sonar_imm.estimation.marginals import clusters, log_total, marginals


def events(possible):
    """All ways in which each track takes a detection or none (-1), none taken twice."""
    found = [()]
    for row in possible:
        choices = (-1, *np.flatnonzero(row).tolist())
        found = [(*event, d) for event in found for d in choices if d < 0 or d not in event]
    return found


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
    """Also where all pairs are equal, which propagation could take for ever."""
    pair, none = marginals(np.ones((40, 40)), np.full(40, 0.1), np.ones((40, 40), bool))
    np.testing.assert_allclose(pair.sum(axis=1) + none, 1.0)
    pair, none = marginals(*problem(T + D, T, D, share=0.9))
    np.testing.assert_allclose(pair.sum(axis=1) + none, 1.0, rtol=1e-12)
    exact = min(T, D) <= module.LARGEST
    assert (pair >= 0.0).all() and (pair.sum(axis=0) <= 1.0 + (1e-12 if exact else 1e-3)).all()


@pytest.mark.parametrize('reach, apart, off', [(0.6, 1e-6, 1e-6), (16.0, 0.02, 0.15)])
def test_a_cluster_that_is_too_large_is_solved_by_propagation(monkeypatch, reach, apart, off):
    """Fourteen tracks side by side, each near its own detection. It is exact in a tree."""
    at = np.arange(14.0)
    distance = np.square(at[:, None] - at[None] - 0.3)
    case = 90.0 * np.exp(-0.5 * distance / 0.2), np.linspace(0.1, 0.4, 14), distance < reach
    found = *marginals(*case), log_total(*case)
    monkeypatch.setattr(module, 'LARGEST', 14)
    exact = *marginals(*case), log_total(*case)
    assert np.abs(found[0] - exact[0]).max() < apart and (found[0] != exact[0]).any()
    assert np.abs(found[1] - exact[1]).max() < apart
    assert found[2] == pytest.approx(exact[2], abs=off)


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


def cluster(vectors, number):
    prefix = f'{number:02d}/'
    return {name[3:]: vectors[name] for name in vectors if name.startswith(prefix)}


@pytest.mark.parametrize('number', range(24))
def test_rows_and_fixes_are_those_of_the_enumeration(number):
    vectors = load_vectors('diver_in_the_field/linked_rows')
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


OUT = 'out_beta', 'out_missed_exists', 'out_existence'


# -- existence: joint integrated probabilistic data association -----------------------------------


def brute_force(ratio, existence, pd):
    """beta, existence by enumeration of everything: who exists, who takes which detection."""
    T, D = ratio.shape
    beta, exists, total = np.zeros((T, D)), np.zeros(T), 0.0
    for there in product((False, True), repeat=T):
        for taken in product(range(-1, D), repeat=T):
            used = [d for d in taken if d >= 0]
            if len(set(used)) < len(used) or any(
                d >= 0 and not alive for d, alive in zip(taken, there)
            ):
                continue
            weight = 1.0
            for t, (d, alive) in enumerate(zip(taken, there)):
                weight *= existence[t] if alive else 1.0 - existence[t]
                if alive:
                    weight *= 1.0 - pd[t] if d < 0 else pd[t] * ratio[t, d]
            total += weight
            for t, (d, alive) in enumerate(zip(taken, there)):
                exists[t] += weight * alive
                if d >= 0:
                    beta[t, d] += weight
    return beta / total, exists / total


@pytest.mark.parametrize('case', ['2x2', '3x3', '1x2', '2x0'])
def test_the_sums_over_events_are_those_of_the_prototype(case):
    known = load_vectors('diver_sea/association')
    v = {name: known[f'jipda_{case}/{name}'] for name in ('ratio', 'existence', 'pd', *OUT)}
    found = jipda.associate(v['ratio'], v['ratio'] > 0.0, v['existence'], v['pd'])
    for ours, name in zip(found, OUT):
        np.testing.assert_allclose(ours, v[name], rtol=1e-10, atol=1e-15)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_sums_agree_with_brute_force_over_existence_and_pairings(seed):
    rng = np.random.default_rng(seed)
    T, D = rng.integers(1, 4), rng.integers(0, 4)
    ratio = rng.gamma(1.0, 4.0, (T, D)) * (rng.uniform(size=(T, D)) < 0.7)
    existence, pd = rng.uniform(0.01, 0.999, T), rng.uniform(0.1, 0.99, T)
    beta, exists = brute_force(ratio, existence, pd)
    ours = jipda.associate(ratio, ratio > 0.0, existence, pd)
    np.testing.assert_allclose(ours[0], beta, rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(ours[2], exists, rtol=1e-9)


def test_the_nearest_older_track():
    rng = np.random.default_rng(4)
    T = 7
    mean = rng.normal(size=(T, 2))
    root = rng.normal(size=(T, 2, 2))
    covariance = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(2)
    ids, free, firm = rng.permutation(T), rng.uniform(size=T) < 0.8, rng.uniform(size=T) < 0.5
    partner, distance = jipda.nearest_older(mean, covariance, ids, free, firm)
    for t in range(T):
        best = (np.inf, -1)
        for u in range(T):
            if free[t] and free[u] and ids[u] < ids[t] and (firm[u] or not firm[t]):
                gap = mean[t] - mean[u]
                now = gap @ np.linalg.solve(covariance[t] + covariance[u], gap)
                best = min(best, (now, u))
        assert partner[t] == best[1]
        assert distance[t] == pytest.approx(best[0])


def test_log_odds():
    found = jipda.log_odds(np.array([0.0, 0.2, 0.9, 1.0]))
    assert found[0] == -np.inf and np.isfinite(found[3])
    np.testing.assert_allclose(found[1:3], np.log([0.25, 9.0]))


def test_existence_by_class_of_detectability_against_enumeration(monkeypatch):
    v = load_vectors('obstacle_in_clutter/joint_events')
    cases, probability = [cluster(v, k) for k in range(v['count'])], v['detection_probability']
    for largest, answer in ((module.LARGEST, 'beta'), (0, 'beta_bp')):
        monkeypatch.setattr(module, 'LARGEST', largest)
        for case in cases:
            T = len(case['q'])
            beta, none, after = jipda.associate_classes(
                case['ratio'], np.ones(case['ratio'].shape, bool), case['q'],
                np.tile(probability, (T, 1)), case['visible'][:, None],
            )  # fmt: skip
            np.testing.assert_allclose(beta, case[answer], atol=1e-9)
            if largest:
                np.testing.assert_allclose(none, case['missed'], atol=1e-9)
                np.testing.assert_allclose(after, case['q_after'], atol=1e-9)
