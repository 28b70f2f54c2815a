# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Gating and assignment against brute force, track life against the definition."""

import itertools

from attrs import evolve
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from sonar_imm.estimation.association import (
    assign,
    assign_by_rank,
    association_cost,
    choose,
    gate_threshold,
    new_ids,
    TrackRules,
    Tracks,
    TrackStatus,
)

RULES = TrackRules(confirm_hits=3, confirm_window=5, delete_misses=2, max_coast_ns=100)


@pytest.mark.parametrize('dimension', [1, 2, 3])
def test_gate_threshold_is_the_quantile(dimension):
    assert chi2.cdf(gate_threshold(0.99, dimension), dimension) == pytest.approx(0.99, abs=1e-12)


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
    rng = np.random.default_rng(seed)
    table = np.where(
        rng.random((targets, detections)) < density,
        rng.integers(-4, 3, (targets, detections)),
        np.inf,
    )
    t, d = np.nonzero(np.isfinite(table))
    chosen = assign(t, d, table[t, d], targets, detections)
    used = chosen[chosen >= 0]
    assert len(set(used)) == len(used)
    assert sum(table[t, d] for t, d in enumerate(chosen) if d >= 0) == brute_force(table)


def test_clusters_give_the_cost_of_one_big_assignment():
    rng = np.random.default_rng(3)
    cost = rng.normal(size=500) - 0.5
    cells = rng.choice(200 * 150, 500, replace=False)
    t, d = cells // 150, cells % 150
    chosen = assign(t, d, cost, 200, 150)
    table = np.zeros((200, 150))
    table[t, d] = np.minimum(cost, 0.0)
    hits = np.flatnonzero(chosen >= 0)
    assert table[hits, chosen[hits]].sum() == pytest.approx(
        table[linear_sum_assignment(table)].sum(), abs=1e-9
    )
    assert (table[hits, chosen[hits]] < 0.0).all()


def test_the_order_of_the_pairs_does_not_matter():
    rng = np.random.default_rng(4)
    cells = rng.choice(400, 120, replace=False)
    t, d, cost = cells // 20, cells % 20, rng.integers(-3, 1, 120).astype(float)  # many ties
    expected = assign(*sorted_pairs(t, d, cost), 20, 20)
    shuffle = rng.permutation(120)
    np.testing.assert_array_equal(
        assign(*sorted_pairs(t[shuffle], d[shuffle], cost[shuffle]), 20, 20), expected
    )
    np.testing.assert_array_equal(assign(t[shuffle], d[shuffle], cost[shuffle], 20, 20), expected)


def sorted_pairs(t, d, cost):
    order = np.lexsort((d, t))
    return t[order], d[order], cost[order]


@given(st.integers(0, 2**32 - 1), st.integers(1, 8), st.integers(1, 8))
def test_ranks_choose_in_turn(seed, targets, detections):
    """Against one target set after the other, written with a table."""
    rng = np.random.default_rng(seed)
    table = rng.normal(size=(targets, detections))
    rank = rng.integers(-1, 3, targets)
    target, detection = np.divmod(np.arange(table.size), detections)
    chosen = assign_by_rank(target, detection, table.ravel(), rank, detections)
    left = list(range(detections))
    for turn in (0, 1, 2):
        own = np.flatnonzero(rank == turn)
        rows, columns = linear_sum_assignment(np.minimum(table[np.ix_(own, left)], 0.0))
        best = np.minimum(table[np.ix_(own, left)], 0.0)[rows, columns].sum()
        got = [(t, chosen[t]) for t in own if chosen[t] >= 0]
        assert {d for _, d in got} <= set(left)
        assert sum(table[t, d] for t, d in got) == pytest.approx(best)
        left = [d for d in left if d not in {d for _, d in got}]
    assert (chosen[rank < 0] == -1).all()


@given(st.integers(0, 2**32 - 1), st.integers(0, 5), st.integers(0, 5))
def test_uncontested_choices_are_those_of_the_weighing(seed, targets, detections):
    rng = np.random.default_rng(seed)
    fit = np.where(
        rng.uniform(size=(targets, detections)) < 0.3,
        rng.normal(size=(targets, detections)),
        -np.inf,
    )
    tentative = rng.uniform(size=targets) < 0.5
    pd, clutter = 0.9, 0.4
    chosen, clear = choose(fit, tentative, np.log1p(-pd) - np.log(pd), np.log(clutter))
    target, detection = np.nonzero(fit > -np.inf)
    cost = association_cost(fit[target, detection], pd, clutter)
    want = assign_by_rank(target, detection, cost, tentative.astype(np.int64), detections)
    if clear:
        np.testing.assert_array_equal(chosen, want)
    else:  # then two worthwhile pairs do share a target or a detection
        assert len(np.unique(target[cost < 0])) + len(np.unique(detection[cost < 0])) < 2 * np.sum(
            cost < 0
        )


def test_association_cost_is_the_log_of_the_ratio_of_the_two_explanations():
    likelihood, pd, clutter = 0.02, 0.9, 1e-3
    joined, apart = pd * likelihood, (1 - pd) * clutter
    assert association_cost(np.log(likelihood), pd, clutter) == pytest.approx(
        -np.log(joined / apart), rel=1e-12
    )


# -- life of tracks -------------------------------------------------------------------------------


def live(pattern, rules=RULES, dt=1):
    """Statuses after each scan of a 1-and-0 pattern; None once ended."""
    tracks, statuses = Tracks.none(rules).born(1, 0, rules), []
    statuses.append(int(tracks.status[0]))
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
    rules = TrackRules(m, n, delete, 10**9)
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
    tracks = Tracks.none(RULES).born(2, 0, RULES)
    for k in range(1, 9):
        tracks, kept = tracks.scan(
            np.array([False, False]), k, RULES, looked=np.array([False, k > 6])
        )
        assert kept.all()
    assert list(tracks.misses) == [0, 2] and list(tracks.age) == [1, 3]
    tracks, _ = tracks.scan(np.array([True, True]), 9, RULES, looked=np.array([False, True]))
    assert list(tracks.seen.sum(axis=1)) == [2, 2] and list(tracks.age) == [2, 4]
    assert not tracks.scan(np.array([False, False]), 110, RULES, looked=np.zeros(2, bool))[1].any()


def test_identities_are_never_used_again():
    tracks = Tracks.none(RULES).born(3, 0, RULES)
    tracks, kept = tracks.scan(np.array([True, False, True]), 101, RULES)
    assert list(kept) == [True, False, True]
    assert list(tracks.born(2, 102, RULES).track_id) == [1, 3, 4, 5]
    assert list(tracks.only(np.array([False, True])).track_id) == [3]


def test_scan_is_pure():
    tracks = Tracks.none(RULES).born(2, 0, RULES)
    before = tracks.seen.copy()
    first, second = (tracks.scan(np.array([True, False]), 1, RULES)[0] for _ in range(2))
    np.testing.assert_array_equal(tracks.seen, before)
    np.testing.assert_array_equal(first.seen, second.seen)


@pytest.mark.parametrize('window', [3, 9])
def test_rules_may_change_while_tracks_live(window):
    tracks = Tracks.none(RULES).born(1, 0, RULES)
    rules = TrackRules(2, window, 2, 100)
    tracks, _ = tracks.scan(np.array([True]), 1, rules)
    assert list(tracks.status) == [TrackStatus.CONFIRMED]
    assert len(tracks.born(1, 2, RULES)) == 2


@pytest.mark.parametrize('arguments', [(0, 5, 2, 1), (6, 5, 2, 1), (1, 1, 0, 1), (1, 1, 1, -1)])
def test_rules_refuse_nonsense(arguments):
    with pytest.raises(ValueError, match='track rules need'):
        TrackRules(*arguments)


def test_identities_after_the_last_of_32_bits_are_those_that_no_track_has():
    """A track of number 0 would be none, and one more than a column can hold ended the tracker."""
    last = 2**32 - 1
    tracks = Tracks.none(RULES).born(3, 0, RULES)
    tracks = evolve(tracks, next_id=last - 1).born(3, 0, RULES)
    assert tracks.track_id.tolist() == [1, 2, 3, last - 1, last, 4]
    tracks = tracks.only(tracks.track_id != 2).born(2, 0, RULES)
    assert tracks.track_id.tolist() == [1, 3, last - 1, last, 4, 5, 6]
    assert (tracks.next_id, tracks.track_id.dtype) == (7, np.uint32)
    around = new_ids(last, 4, np.array([last, 2], np.uint32))
    assert (around[0].tolist(), around[1]) == ([1, 3, 4, 5], 6)
    assert new_ids(last, 1, tracks.track_id[:1])[1] == 1
    assert new_ids(last, 0, tracks.track_id)[1] == last
