# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Gating, assignment, the life of tracks, measures of consistency and distance, and probabilities
of association: against definitions, enumeration, an independent prototype and closed forms."""

import itertools

from attrs import evolve
from helpers.vector_files import load_vectors
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.sparse.csgraph import connected_components
from scipy.stats import chi2

from sonar_imm.estimation import association, consistency, jipda
from sonar_imm.estimation import marginals as module
from sonar_imm.estimation.consistency import nis
from sonar_imm.estimation.linked_rows import linked_marginals, MOST_CLASSES
from sonar_imm.estimation.marginals import clusters, log_total, marginals

RULES = association.TrackRules(confirm_hits=3, confirm_window=5, delete_misses=2, max_coast_ns=100)
POINTS = np.array([[0.0, 0.0], [10.0, 0.0]])
NOTHING = np.empty((0, 2))


def test_gates_and_bounds_are_quantiles():
    for dimension in (1, 3):
        gate = association.gate_threshold(0.99, dimension)
        assert chi2.cdf(gate, dimension) == pytest.approx(0.99, abs=1e-12)
    bounds = np.array(consistency.average_bounds(50, 4))
    assert chi2.cdf(bounds * 50, 200) == pytest.approx([0.025, 0.975])


def brute_force(table):
    """Least cost over all partial assignments of a (T, D) table."""
    targets, detections = table.shape
    choices = itertools.product(range(-1, detections), repeat=targets)
    return min(
        sum(table[t, d] for t, d in enumerate(choice) if d >= 0)
        for choice in choices
        if len({d for d in choice if d >= 0}) == sum(d >= 0 for d in choice)
    )


@given(st.integers(0, 2**32 - 1), st.integers(1, 5), st.integers(1, 4), st.floats(0.1, 1.0))
def test_assign_reaches_the_least_cost_of_all(seed, targets, detections, density):
    rng, shape = np.random.default_rng(seed), (targets, detections)
    table = np.where(rng.random(shape) < density, rng.integers(-4, 3, shape), np.inf)
    t, d = np.nonzero(np.isfinite(table))
    chosen = association.assign(t, d, table[t, d], targets, detections)
    used = chosen[chosen >= 0]
    assert len(set(used)) == len(used)
    assert sum(table[t, d] for t, d in enumerate(chosen) if d >= 0) == brute_force(table)


def test_clusters_give_the_cost_of_one_big_assignment():
    rng = np.random.default_rng(3)
    cost, cells = rng.normal(size=500) - 0.5, rng.choice(200 * 150, 500, replace=False)
    t, d = cells // 150, cells % 150
    chosen = association.assign(t, d, cost, 200, 150)
    table = np.zeros((200, 150))
    table[t, d] = np.minimum(cost, 0.0)
    hits = np.flatnonzero(chosen >= 0)
    best = table[linear_sum_assignment(table)].sum()
    assert table[hits, chosen[hits]].sum() == pytest.approx(best, abs=1e-9)
    assert (table[hits, chosen[hits]] < 0.0).all()


def test_the_order_of_the_pairs_does_not_matter():
    rng = np.random.default_rng(4)
    cells = rng.choice(400, 120, replace=False)
    pairs = cells // 20, cells % 20, rng.integers(-3, 1, 120).astype(float)  # many ties
    expected = association.assign(*pairs, 20, 20)
    for order in (rng.permutation(120), np.argsort(cells)):
        again = association.assign(*(each[order] for each in pairs), 20, 20)
        np.testing.assert_array_equal(again, expected)


@given(st.integers(0, 2**32 - 1), st.integers(1, 8), st.integers(1, 8))
def test_ranks_choose_in_turn(seed, targets, detections):
    """Against one target set after the other, written with a table."""
    rng = np.random.default_rng(seed)
    table = rng.normal(size=(targets, detections))
    rank = rng.integers(-1, 3, targets)
    target, detection = np.divmod(np.arange(table.size), detections)
    chosen = association.assign_by_rank(target, detection, table.ravel(), rank, detections)
    left = list(range(detections))
    for turn in (0, 1, 2):
        own = np.flatnonzero(rank == turn)
        worth = np.minimum(table[np.ix_(own, left)], 0.0)
        best = worth[linear_sum_assignment(worth)].sum()
        got = [(t, chosen[t]) for t in own if chosen[t] >= 0]
        assert {d for _, d in got} <= set(left)
        assert sum(table[t, d] for t, d in got) == pytest.approx(best)
        left = [d for d in left if d not in {d for _, d in got}]
    assert (chosen[rank < 0] == -1).all()


@given(st.integers(0, 2**32 - 1), st.integers(0, 5), st.integers(0, 5))
def test_uncontested_choices_are_those_of_the_weighing(seed, targets, detections):
    rng, shape = np.random.default_rng(seed), (targets, detections)
    fit = np.where(rng.uniform(size=shape) < 0.3, rng.normal(size=shape), -np.inf)
    tentative = rng.uniform(size=targets) < 0.5
    pd, clutter = 0.9, 0.4
    chosen, clear = association.choose(fit, tentative, np.log1p(-pd) - np.log(pd), np.log(clutter))
    target, detection = np.nonzero(fit > -np.inf)
    cost = association.association_cost(fit[target, detection], pd, clutter)
    pairs, rank = (target, detection, cost), tentative.astype(np.int64)
    want = association.assign_by_rank(*pairs, rank, detections)
    if clear:
        np.testing.assert_array_equal(chosen, want)
    else:  # then two worthwhile pairs do share a target or a detection
        worthwhile = target[cost < 0], detection[cost < 0]
        assert sum(len(np.unique(each)) for each in worthwhile) < 2 * np.sum(cost < 0)


def test_association_cost_is_the_log_of_the_ratio_of_the_two_explanations():
    likelihood, pd, clutter = 0.02, 0.9, 1e-3
    due = -np.log(pd * likelihood / ((1 - pd) * clutter))
    found = association.association_cost(np.log(likelihood), pd, clutter)
    assert found == pytest.approx(due, rel=1e-12)


def live(pattern, rules=RULES, dt=1):
    """Statuses after each scan of a 1-and-0 pattern; None once ended."""
    tracks = association.Tracks.none(rules).born(1, 0, rules)
    statuses = [int(tracks.status[0])]
    for k, symbol in enumerate(pattern[1:], start=1):
        tracks, kept = tracks.scan(np.array([symbol == '1']), k * dt, rules)
        if not kept[0]:
            return [*statuses, None]
        statuses.append(int(tracks.status[0]))
    return statuses


@given(
    st.lists(st.booleans(), max_size=40), st.integers(1, 6), st.integers(1, 6), st.integers(1, 4)
)
def test_life_equals_the_definition(hits, m, n, delete):
    if m > n:
        return
    rules = association.TrackRules(m, n, delete, 10**9)
    pattern = '1' + ''.join('01'[hit] for hit in hits)
    confirmed, expected = False, []
    for k in range(1, len(pattern) + 1):
        window = pattern[:k][-n:]
        confirmed = confirmed or window.count('1') >= m
        ended = pattern[:k].endswith('0' * delete) if confirmed else window.count('0') > n - m
        if ended:
            expected.append(None)
            break
        expected.append((1 if pattern[k - 1] == '1' else 2) if confirmed else 0)
    assert live(pattern, rules) == expected


def test_time_ends_a_track_too():
    assert live('1110', RULES, dt=50) == [0, 0, 1, 2]
    assert live('1110', RULES, dt=101) == [0, 0, 1, None]


def test_a_track_nobody_looked_for_is_neither_hit_nor_missed():
    tracks = association.Tracks.none(RULES).born(2, 0, RULES)
    for k in range(1, 9):
        looked = np.array([False, k > 6])
        tracks, kept = tracks.scan(np.zeros(2, bool), k, RULES, looked=looked)
        assert kept.all()
    assert list(tracks.misses) == [0, 2] and list(tracks.age) == [1, 3]
    tracks, _ = tracks.scan(np.array([True, True]), 9, RULES, looked=np.array([False, True]))
    assert list(tracks.seen.sum(axis=1)) == [2, 2] and list(tracks.age) == [2, 4]
    assert not tracks.scan(np.array([False, False]), 110, RULES, looked=np.zeros(2, bool))[1].any()


def test_identities_are_never_used_again():
    tracks = association.Tracks.none(RULES).born(3, 0, RULES)
    hit, before = np.array([True, False, True]), tracks.seen.copy()
    first, second = (tracks.scan(hit, 101, RULES) for _ in range(2))
    assert list(first[1]) == [True, False, True]
    assert list(first[0].born(2, 102, RULES).track_id) == [1, 3, 4, 5]
    assert list(first[0].only(np.array([False, True])).track_id) == [3]
    # A scan is pure.
    np.testing.assert_array_equal(tracks.seen, before)
    np.testing.assert_array_equal(first[0].seen, second[0].seen)


def test_rules_may_change_while_tracks_live():
    tracks = association.Tracks.none(RULES).born(1, 0, RULES)
    for window in (3, 9):
        after, _ = tracks.scan(np.array([True]), 1, association.TrackRules(2, window, 2, 100))
        assert list(after.status) == [association.TrackStatus.CONFIRMED]
        assert len(after.born(1, 2, RULES)) == 2
    for arguments in ((0, 5, 2, 1), (6, 5, 2, 1), (1, 1, 0, 1), (1, 1, 1, -1)):
        with pytest.raises(ValueError, match='track rules need'):
            association.TrackRules(*arguments)


def test_identities_after_the_last_of_32_bits_are_those_that_no_track_has():
    """A track of number 0 would be none, and one more than a column can hold ended the tracker."""
    last = 2**32 - 1
    tracks = association.Tracks.none(RULES).born(3, 0, RULES)
    tracks = evolve(tracks, next_id=last - 1).born(3, 0, RULES)
    assert tracks.track_id.tolist() == [1, 2, 3, last - 1, last, 4]
    tracks = tracks.only(tracks.track_id != 2).born(2, 0, RULES)
    assert tracks.track_id.tolist() == [1, 3, last - 1, last, 4, 5, 6]
    assert (tracks.next_id, tracks.track_id.dtype) == (7, np.uint32)
    around = association.new_ids(last, 4, np.array([last, 2], np.uint32))
    assert (around[0].tolist(), around[1]) == ([1, 3, 4, 5], 6)
    assert association.new_ids(last, 1, tracks.track_id[:1])[1] == 1
    assert association.new_ids(last, 0, tracks.track_id)[1] == last


def test_nees_by_hand():
    error, P = np.array([[1.0, 2.0], [0.0, 3.0]]), np.array([[2.0, 0.5], [0.5, 1.0]])
    expected = [e @ np.linalg.inv(P) @ e for e in error]
    np.testing.assert_allclose(consistency.nees(error, P), expected, rtol=1e-13)
    np.testing.assert_allclose(nis(error, P), expected, rtol=1e-13)


def test_coverage_by_hand():
    truth, low = np.arange(5.0), np.array([-1.0, 1.1, 2.0, 2.9, 3.0])
    high = low + [2.0, 1.0, 0.0, 0.2, 0.9]
    assert consistency.interval_coverage(truth, low, high) == pytest.approx(0.6)
    assert np.isnan(consistency.interval_coverage(np.empty(0), np.empty(0), np.empty(0)))


@pytest.mark.parametrize('truth, estimate, expected', [
    (POINTS, POINTS, (0.0, 0.0, 0.0)),
    (POINTS, POINTS[::-1] + [0.0, 1.0], (2.0, 0.0, 0.0)), (POINTS, POINTS[:1], (0.0, 8.0, 0.0)),
    (POINTS[:1], POINTS, (0.0, 0.0, 8.0)), (POINTS[:1], POINTS[1:], (0.0, 8.0, 8.0)),
    (NOTHING, POINTS, (0.0, 0.0, 16.0)), (POINTS, NOTHING, (0.0, 16.0, 0.0)),
    (NOTHING, NOTHING, (0.0, 0.0, 0.0)),
])  # fmt: skip
def test_gospa_parts_by_hand(truth, estimate, expected):
    result = consistency.gospa(truth, estimate, cutoff=4.0, order=2.0)
    assert (result.localisation, result.missed, result.false) == pytest.approx(expected, abs=1e-12)
    assert result.distance == pytest.approx(np.sqrt(sum(expected)), abs=1e-12)


def over_matchings(truth, estimate, c, p):
    """GOSPA and OSPA over all partial matchings, by definition."""
    both, most = len(truth) + len(estimate), max(len(truth), len(estimate))
    sums = []
    for choice in itertools.product(range(-1, len(estimate)), repeat=len(truth)):
        pairs = [(t, d) for t, d in enumerate(choice) if d >= 0]
        if len({d for _, d in pairs}) == len(pairs):
            near = sum(np.linalg.norm(truth[t] - estimate[d]) ** p for t, d in pairs)
            left = both - 2 * len(pairs), most - len(pairs)
            sums.append((near + c**p / 2 * left[0], (near + c**p * left[1]) / max(most, 1)))
    return np.min(sums, axis=0) ** (1 / p)


@given(st.integers(0, 2**32 - 1), st.sampled_from([1.0, 2.0]))
def test_both_are_the_least_over_all_matchings(seed, p):
    rng = np.random.default_rng(seed)
    sets = [rng.uniform(0, 6, (rng.integers(0, 5), 2)) for _ in range(2)]
    found = consistency.gospa(*sets, 2.0, p).distance, consistency.ospa(*sets, 2.0, p)
    assert found == pytest.approx(over_matchings(*sets, 2.0, p), abs=1e-9)


def test_gospa_says_who_is_whom_and_refuses_nonsense():
    estimate = np.array([[10.0, 1.0], [50.0, 0.0], [0.5, 0.0]])
    assert list(consistency.gospa(POINTS, estimate, cutoff=4.0).estimate_of) == [2, 0]
    for arguments in ((0.0, 2.0), (1.0, 0.5)):
        with pytest.raises(ValueError, match='cutoff > 0'):
            consistency.gospa(POINTS, POINTS, *arguments)


@pytest.mark.parametrize('ids, switches', [
    ([[1, 2], [1, 2], [1, 2]], [0, 0, 0]), ([[1, 2], [2, 1]], [0, 2]),
    ([[1, 2], [-1, 2], [1, 2]], [0, 0, 0]),
    ([[1, 5], [-1, 5], [2, 5], [2, 6], [1, -1]], [0, 0, 1, 1, 1]), ([[-1, -1]], [0]),
    (np.empty((0, 2)), []),
])  # fmt: skip
def test_a_switch_counts_at_the_scan_where_the_other_track_appears(ids, switches):
    assert consistency.switches_by_scan(np.array(ids, int)).tolist() == switches
    assert consistency.identity_switches(np.array(ids, int)) == sum(switches)


def test_switching_gospa_is_the_root_mean_square_with_a_penalty_for_each_switch():
    distance, switches = np.array([3.0, 4.0]), np.array([0, 2])
    assert consistency.switching_gospa(distance, switches * 0, 5.0) == pytest.approx(np.sqrt(12.5))
    assert consistency.switching_gospa(distance, switches, 5.0) == pytest.approx(np.sqrt(37.5))
    assert np.isnan(consistency.switching_gospa(np.empty(0), np.empty(0, int), 5.0))


def test_the_memory_is_a_weighted_mean():
    rng = np.random.default_rng(2)
    nis, dof = rng.chisquare(3, 300), rng.integers(1, 4, 300)
    memory = consistency.NisMemory()
    for k in range(0, 300, 3):
        memory = memory.after(nis[k : k + 3], dof[k : k + 3])
    weight = (1.0 - 1.0 / consistency.NIS_MEMORY) ** np.arange(299, -1, -1)
    assert (nis > 9.0 * dof).any()  # some are so far out that they count as nine
    expected = weight @ np.minimum(nis, 9.0 * dof) / (weight @ dof)
    assert memory.mean == pytest.approx(expected, rel=1e-12)
    assert memory.square == pytest.approx(weight**2 @ dof, rel=1e-12)
    assert memory.after(np.empty(0), 2) == memory


def test_its_bounds_are_those_of_the_chi_square_of_the_same_variance():
    memory = consistency.NisMemory()
    for _ in range(2000):
        memory = memory.after(np.array([2.0]), 2)
    equivalent = memory.dof**2 / memory.square
    assert equivalent == pytest.approx(2.0 * (2.0 * consistency.NIS_MEMORY - 1.0), rel=1e-9)
    tail = 2.866516e-7  # of a Gaussian beyond five sigmas
    due = chi2.ppf([tail, 1.0 - tail], equivalent) / equivalent
    assert memory.bounds == pytest.approx(due, rel=2e-3)


@pytest.mark.parametrize('factor, verdict', [(1.0, 0), (4.0, 1), (0.25, -1)])
def test_true_words_are_believed_and_wrong_ones_are_not(factor, verdict):
    rng, memory, verdicts = np.random.default_rng(3), consistency.NisMemory(), []
    for _ in range(2000):
        memory = memory.after(factor * rng.chisquare(2, 1), 2)
        verdicts.append(memory.verdict)
    assert not any(verdicts[:68])  # too few
    assert set(verdicts[200:]) == {verdict}
    said = memory.warnings('echoes', 'look')
    assert bool(said) == bool(verdict)
    if verdict:
        assert f'echoes miss by {"more" if verdict > 0 else "less"} than stated' in said[0]


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


@settings(deadline=None, max_examples=100)
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


@pytest.mark.parametrize('T, D', [(12, 40), (13, 13), (30, 25)])
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


@given(st.integers(0, 2**32 - 1))
def test_clusters_are_connected_components(seed):
    rng = np.random.default_rng(seed)
    T, D = rng.integers(1, 12), rng.integers(0, 12)
    possible = rng.uniform(size=(T, D)) < 0.15
    graph = np.block([[np.zeros((T, T)), possible], [possible.T, np.zeros((D, D))]])
    due = connected_components(graph, directed=False)[1][:T]
    label = clusters(possible)
    assert np.array_equal(label[:, None] == label[None], due[:, None] == due[None])
    assert all(label[label == first].size and label[first] == first for first in set(label))


def cluster(vectors, number):
    prefix = f'{number:02d}/'
    return {name[3:]: vectors[name] for name in vectors if name.startswith(prefix)}


def test_rows_and_fixes_are_those_of_the_enumeration():
    vectors = load_vectors('diver_in_the_field/linked_rows')
    p, clutter = float(vectors['detection_probability']), float(vectors['clutter'])
    ways = ('dir', 'stay', 'leave', 'open')
    for own in (cluster(vectors, number) for number in range(24)):
        track, weight, link = own['track'], own['weight'], own['link']
        T, of = int(track.max()) + 1, track.copy()
        linked = np.flatnonzero(link >= 0)
        of[linked] = T + np.arange(len(linked))
        target = np.concatenate([np.arange(T), track[linked]])
        links = np.concatenate([np.full(T, -1), link[linked]])
        density = weight[:, None] * sum(own[way] for way in ways) / clutter
        assigned = np.zeros((len(target), density.shape[1]))
        np.add.at(assigned, of, density)
        missed = (1.0 - p) * np.bincount(of, weight, minlength=len(target))
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


def existence_enumerated(ratio, existence, pd):
    """beta, Pr(missed and exists) and existence from everything: who exists, who takes which
    detection."""
    T, D = ratio.shape
    beta, missed, exists, total = np.zeros((T, D)), np.zeros(T), np.zeros(T), 0.0
    for there in itertools.product((False, True), repeat=T):
        for event in events(np.tile(np.array(there)[:, None], D)):
            weight = 1.0
            for t, (d, alive) in enumerate(zip(event, there)):
                weight *= existence[t] if alive else 1.0 - existence[t]
                if alive:
                    weight *= 1.0 - pd[t] if d < 0 else pd[t] * ratio[t, d]
            total += weight
            exists += weight * np.array(there)
            missed += weight * (np.array(there) & (np.array(event) < 0))
            for t, d in enumerate(event):
                if d >= 0:
                    beta[t, d] += weight
    return beta / total, missed / total, exists / total


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2**32 - 1))
def test_sums_agree_with_brute_force_over_existence_and_pairings(seed):
    rng = np.random.default_rng(seed)
    T, D = rng.integers(1, 4), rng.integers(0, 4)
    ratio = rng.gamma(1.0, 4.0, (T, D)) * (rng.uniform(size=(T, D)) < 0.7)
    existence, pd = rng.uniform(0.01, 0.999, T), rng.uniform(0.1, 0.99, T)
    due = existence_enumerated(ratio, existence, pd)
    for ours, right in zip(jipda.associate(ratio, ratio > 0.0, existence, pd), due):
        np.testing.assert_allclose(ours, right, rtol=1e-9, atol=1e-14)


def test_the_nearest_older_track():
    rng = np.random.default_rng(4)
    T = 7
    mean = rng.normal(size=(T, 2))
    root = rng.normal(size=(T, 2, 2))
    covariance = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(2)
    ids, free, firm = rng.permutation(T), rng.uniform(size=T) < 0.8, rng.uniform(size=T) < 0.5
    partner, distance = jipda.nearest_older(mean, covariance, ids, free, firm)
    for t in range(T):
        best = [(np.inf, -1)]
        for u in range(T):
            if free[t] and free[u] and ids[u] < ids[t] and (firm[u] or not firm[t]):
                gap = mean[t] - mean[u]
                best.append((gap @ np.linalg.solve(covariance[t] + covariance[u], gap), u))
        assert (distance[t], partner[t]) == pytest.approx(min(best))


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
            ratio, q = case['ratio'], case['q']
            known = np.tile(probability, (len(q), 1)), case['visible'][:, None]
            beta, none, after = jipda.associate_classes(ratio, ratio > -1.0, q, *known)
            np.testing.assert_allclose(beta, case[answer], atol=1e-9)
            if largest:
                np.testing.assert_allclose(none, case['missed'], atol=1e-9)
                np.testing.assert_allclose(after, case['q_after'], atol=1e-9)
