# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Gating, assignment, the life of tracks, measures of consistency and distance: against
definitions, brute force, closed forms and Stone Soup."""

import datetime
import itertools

from attrs import evolve
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment
from scipy.stats import chi2

from sonar_imm.estimation import association, consistency
from sonar_imm.estimation.consistency import nis

RULES = association.TrackRules(confirm_hits=3, confirm_window=5, delete_misses=2, max_coast_ns=100)


@pytest.mark.parametrize('dimension', [1, 2, 3])
def test_gate_threshold_is_the_quantile(dimension):
    assert chi2.cdf(association.gate_threshold(0.99, dimension), dimension) == pytest.approx(
        0.99, abs=1e-12
    )


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
    chosen = association.assign(t, d, table[t, d], targets, detections)
    used = chosen[chosen >= 0]
    assert len(set(used)) == len(used)
    assert sum(table[t, d] for t, d in enumerate(chosen) if d >= 0) == brute_force(table)


def test_clusters_give_the_cost_of_one_big_assignment():
    rng = np.random.default_rng(3)
    cost = rng.normal(size=500) - 0.5
    cells = rng.choice(200 * 150, 500, replace=False)
    t, d = cells // 150, cells % 150
    chosen = association.assign(t, d, cost, 200, 150)
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
    pairs = cells // 20, cells % 20, rng.integers(-3, 1, 120).astype(float)  # many ties
    expected = association.assign(*pairs, 20, 20)
    for order in (rng.permutation(120), np.argsort(cells)):
        np.testing.assert_array_equal(
            association.assign(*(each[order] for each in pairs), 20, 20), expected
        )


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
    rng = np.random.default_rng(seed)
    fit = np.where(
        rng.uniform(size=(targets, detections)) < 0.3,
        rng.normal(size=(targets, detections)),
        -np.inf,
    )
    tentative = rng.uniform(size=targets) < 0.5
    pd, clutter = 0.9, 0.4
    chosen, clear = association.choose(fit, tentative, np.log1p(-pd) - np.log(pd), np.log(clutter))
    target, detection = np.nonzero(fit > -np.inf)
    cost = association.association_cost(fit[target, detection], pd, clutter)
    want = association.assign_by_rank(
        target, detection, cost, tentative.astype(np.int64), detections
    )
    if clear:
        np.testing.assert_array_equal(chosen, want)
    else:  # then two worthwhile pairs do share a target or a detection
        assert len(np.unique(target[cost < 0])) + len(np.unique(detection[cost < 0])) < 2 * np.sum(
            cost < 0
        )


def test_association_cost_is_the_log_of_the_ratio_of_the_two_explanations():
    likelihood, pd, clutter = 0.02, 0.9, 1e-3
    joined, apart = pd * likelihood, (1 - pd) * clutter
    assert association.association_cost(np.log(likelihood), pd, clutter) == pytest.approx(
        -np.log(joined / apart), rel=1e-12
    )


# -- life of tracks -------------------------------------------------------------------------------


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
        tracks, kept = tracks.scan(
            np.array([False, False]), k, RULES, looked=np.array([False, k > 6])
        )
        assert kept.all()
    assert list(tracks.misses) == [0, 2] and list(tracks.age) == [1, 3]
    tracks, _ = tracks.scan(np.array([True, True]), 9, RULES, looked=np.array([False, True]))
    assert list(tracks.seen.sum(axis=1)) == [2, 2] and list(tracks.age) == [2, 4]
    assert not tracks.scan(np.array([False, False]), 110, RULES, looked=np.zeros(2, bool))[1].any()


def test_identities_are_never_used_again():
    tracks = association.Tracks.none(RULES).born(3, 0, RULES)
    tracks, kept = tracks.scan(np.array([True, False, True]), 101, RULES)
    assert list(kept) == [True, False, True]
    assert list(tracks.born(2, 102, RULES).track_id) == [1, 3, 4, 5]
    assert list(tracks.only(np.array([False, True])).track_id) == [3]


def test_scan_is_pure():
    tracks = association.Tracks.none(RULES).born(2, 0, RULES)
    before = tracks.seen.copy()
    first, second = (tracks.scan(np.array([True, False]), 1, RULES)[0] for _ in range(2))
    np.testing.assert_array_equal(tracks.seen, before)
    np.testing.assert_array_equal(first.seen, second.seen)


@pytest.mark.parametrize('window', [3, 9])
def test_rules_may_change_while_tracks_live(window):
    tracks = association.Tracks.none(RULES).born(1, 0, RULES)
    rules = association.TrackRules(2, window, 2, 100)
    tracks, _ = tracks.scan(np.array([True]), 1, rules)
    assert list(tracks.status) == [association.TrackStatus.CONFIRMED]
    assert len(tracks.born(1, 2, RULES)) == 2


@pytest.mark.parametrize('arguments', [(0, 5, 2, 1), (6, 5, 2, 1), (1, 1, 0, 1), (1, 1, 1, -1)])
def test_rules_refuse_nonsense(arguments):
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


def test_average_bounds_hold_as_often_as_they_say():
    assert chi2.cdf(np.array(consistency.average_bounds(50, 4)) * 50, 200) == pytest.approx(
        [0.025, 0.975]
    )


def test_coverage_by_hand():
    truth, low = np.arange(5.0), np.array([-1.0, 1.1, 2.0, 2.9, 3.0])
    high = low + [2.0, 1.0, 0.0, 0.2, 0.9]
    assert consistency.interval_coverage(truth, low, high) == pytest.approx(0.6)
    assert np.isnan(consistency.interval_coverage(np.empty(0), np.empty(0), np.empty(0)))


# -- sets of targets ------------------------------------------------------------------------------

POINTS = np.array([[0.0, 0.0], [10.0, 0.0]])
NOTHING = np.empty((0, 2))


@pytest.mark.parametrize(
    'truth, estimate, expected',
    [
        (POINTS, POINTS, (0.0, 0.0, 0.0)),
        (POINTS, POINTS[::-1] + [0.0, 1.0], (2.0, 0.0, 0.0)),
        (POINTS, POINTS[:1], (0.0, 8.0, 0.0)),
        (POINTS[:1], POINTS, (0.0, 0.0, 8.0)),
        (POINTS[:1], POINTS[1:], (0.0, 8.0, 8.0)),
        (NOTHING, POINTS, (0.0, 0.0, 16.0)),
        (POINTS, NOTHING, (0.0, 16.0, 0.0)),
        (NOTHING, NOTHING, (0.0, 0.0, 0.0)),
    ],
)
def test_gospa_parts_by_hand(truth, estimate, expected):
    result = consistency.gospa(truth, estimate, cutoff=4.0, order=2.0)
    assert (result.localisation, result.missed, result.false) == pytest.approx(expected, abs=1e-12)
    assert result.distance == pytest.approx(np.sqrt(sum(expected)), abs=1e-12)


def test_ospa_by_hand():
    assert consistency.ospa(POINTS, POINTS[:1], cutoff=4.0) == pytest.approx(
        np.sqrt(16.0 / 2), rel=1e-12
    )
    assert consistency.ospa(POINTS, POINTS + [0.0, 1.0], cutoff=4.0) == pytest.approx(
        1.0, rel=1e-12
    )
    assert consistency.ospa(NOTHING, NOTHING, cutoff=4.0) == 0.0
    assert consistency.ospa(NOTHING, POINTS, cutoff=4.0) == 4.0


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


SETS = (
    st.integers(0, 2**32 - 1)
    .map(lambda seed: np.random.default_rng(seed))
    .map(lambda rng: tuple(rng.uniform(0, 6, (rng.integers(0, 5), 2)) for _ in range(2)))
)


@given(SETS, st.sampled_from([1.0, 2.0]))
def test_both_are_the_least_over_all_matchings(sets, p):
    found = consistency.gospa(*sets, 2.0, p).distance, consistency.ospa(*sets, 2.0, p)
    assert found == pytest.approx(over_matchings(*sets, 2.0, p), abs=1e-9)


@given(SETS)
def test_stone_soup_agrees(sets):
    metrics = pytest.importorskip('stonesoup.metricgenerator.ospametric')
    states = pytest.importorskip('stonesoup.types.state')
    now = datetime.datetime(2024, 1, 1)
    truth, estimate = ([states.State(x, timestamp=now) for x in points] for points in sets)
    if not truth and not estimate:
        return  # Stone Soup cannot say what nothing is worth
    ours = consistency.gospa(*sets, 2.0, 2.0)
    theirs = metrics.GOSPAMetric(c=2.0, p=2.0).compute_gospa_metric(estimate, truth)[0].value
    assert ours.distance == pytest.approx(theirs['distance'], abs=1e-9)
    assert (ours.localisation, ours.missed, ours.false) == pytest.approx(
        (theirs['localisation'], theirs['missed'], theirs['false']), abs=1e-9
    )
    # Order 1 only: for others Stone Soup assigns by distance and scores by distance to the order.
    theirs = metrics.OSPAMetric(c=2.0, p=1.0).compute_OSPA_distance(estimate, truth)
    assert consistency.ospa(*sets, 2.0, 1.0) == pytest.approx(theirs.value, abs=1e-9)


def test_gospa_says_who_is_whom_and_refuses_nonsense():
    result = consistency.gospa(
        POINTS, np.array([[10.0, 1.0], [50.0, 0.0], [0.5, 0.0]]), cutoff=4.0
    )
    assert list(result.estimate_of) == [2, 0]
    for arguments in ((0.0, 2.0), (1.0, 0.5)):
        with pytest.raises(ValueError, match='cutoff > 0'):
            consistency.gospa(POINTS, POINTS, *arguments)


@pytest.mark.parametrize(
    'ids, switches',
    [
        ([[1, 2], [1, 2], [1, 2]], [0, 0, 0]),
        ([[1, 2], [2, 1]], [0, 2]),
        ([[1, 2], [-1, 2], [1, 2]], [0, 0, 0]),
        ([[1, 5], [-1, 5], [2, 5], [2, 6], [1, -1]], [0, 0, 1, 1, 1]),
        ([[-1, -1]], [0]),
        (np.empty((0, 2)), []),
    ],
)
def test_a_switch_counts_at_the_scan_where_the_other_track_appears(ids, switches):
    assert consistency.switches_by_scan(np.array(ids, int)).tolist() == switches
    assert consistency.identity_switches(np.array(ids, int)) == sum(switches)


def test_switching_gospa_is_the_root_mean_square_with_a_penalty_for_each_switch():
    distance, switches = np.array([3.0, 4.0]), np.array([0, 2])
    assert consistency.switching_gospa(distance, switches * 0, 5.0) == pytest.approx(np.sqrt(12.5))
    assert consistency.switching_gospa(distance, switches, 5.0) == pytest.approx(np.sqrt(37.5))
    assert np.isnan(consistency.switching_gospa(np.empty(0), np.empty(0, int), 5.0))


# -- mean NIS of a memory, against closed forms and random numbers --------------------------------


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
    low, high = memory.bounds
    assert low == pytest.approx(chi2.ppf(tail, equivalent) / equivalent, rel=2e-3)
    assert high == pytest.approx(chi2.isf(tail, equivalent) / equivalent, rel=2e-3)


@pytest.mark.parametrize('factor, verdict', [(1.0, 0), (4.0, 1), (0.25, -1)])
def test_true_words_are_believed_and_wrong_ones_are_not(factor, verdict):
    rng = np.random.default_rng(3)
    memory, verdicts = consistency.NisMemory(), []
    for _ in range(5000):
        memory = memory.after(factor * rng.chisquare(2, 1), 2)
        verdicts.append(memory.verdict)
    assert not any(verdicts[:68])  # too few
    assert set(verdicts[200:]) == {verdict}
    assert bool(memory.warnings('echoes', 'look')) == bool(verdict)
    if verdict:
        word = 'more' if verdict > 0 else 'less'
        assert f'echoes miss by {word} than stated' in memory.warnings('echoes', 'look')[0]
