# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The k best joint events, and the hypotheses that live over several scans."""

from itertools import product

import numpy as np
import pytest

from sonar_imm.estimation import hypotheses as h
from sonar_imm.estimation.hypotheses import Hypotheses, k_best, paired, settled, with_births

WORK = 10**9


def every_event(prior, gain):
    """All joint events of all hypotheses, best first: (value, parent, choice)."""
    found = []
    G, n, D = gain.shape
    for g in range(G):
        for choice in product(range(-1, D), repeat=n):
            taken = [d for d in choice if d >= 0]
            if len(set(taken)) < len(taken):
                continue
            value = prior[g] + sum(gain[g, i, d] for i, d in enumerate(choice) if d >= 0)
            if np.isfinite(value):
                found.append((value, g, choice))
    return sorted(found, reverse=True)


@pytest.mark.parametrize(
    'seed', [*range(8), *(pytest.param(k, marks=pytest.mark.statistics) for k in range(8, 40))]
)
def test_k_best_is_the_head_of_a_list_of_all_events(seed):
    rng = np.random.default_rng(seed)
    G, n, D = rng.integers(1, 4), rng.integers(0, 5), rng.integers(0, 5)
    prior, gain = rng.normal(size=G), rng.normal(scale=3.0, size=(G, n, D))
    gain[rng.uniform(size=gain.shape) < 0.3] = -np.inf
    whole = every_event(prior, gain)
    for most in (1, 7, 10_000):
        parent, choice, value = k_best(prior, gain, most, np.inf, WORK)
        expected = whole[:most]
        assert len(value) == len(expected)
        assert value == pytest.approx([each[0] for each in expected], abs=1e-12)
        events = list(zip(parent.tolist(), map(tuple, choice.tolist())))
        assert events == [each[1:] for each in expected]


def test_k_best_of_ties_names_each_event_once():
    parent, choice, value = k_best(np.zeros(1), np.zeros((1, 3, 3)), 1000, np.inf, WORK)
    events = set(map(tuple, choice.tolist()))
    # Matchings of three and three: 1 + 9 + 18 + 6.
    assert len(value) == len(events) == 34
    assert not value.any() and not parent.any()


def test_k_best_leaves_out_what_is_below_the_span():
    gain = np.array([[[2.0, -3.0]]])
    assert k_best(np.zeros(1), gain, 10, 4.0, WORK)[2].tolist() == [2.0, 0.0]
    assert k_best(np.zeros(1), gain, 10, 5.5, WORK)[2].tolist() == [2.0, 0.0, -3.0]


def test_k_best_with_no_work_left_still_has_the_best_of_each_hypothesis():
    rng = np.random.default_rng(5)
    prior, gain = rng.normal(size=3), rng.normal(size=(3, 4, 4))
    _, _, value = k_best(prior, gain, 50, np.inf, -1)
    best = [max(each[0] for each in every_event(prior[[g]], gain[[g]])) for g in range(3)]
    assert value == pytest.approx(sorted(best, reverse=True))


def test_many_tracks_in_a_knot_cost_a_bounded_time():
    """The work is bounded, not only the number of events."""
    rng = np.random.default_rng(1)
    gain = rng.normal(size=(2, 60, 60))
    _, choice, value = k_best(np.zeros(2), gain, 200, np.inf, h.MOST_WORK)
    assert len(value) > 10
    assert all(len(set(row)) == 60 or -1 in row for row in choice.tolist())


def two_tracks():
    return Hypotheses.none().with_alone(2), np.array([1, 2])


def pair(before, ids, ratio, existence=None, *, hit=0.8, missed=0.8, reserved=None, most=1000):
    T, D = np.shape(ratio)
    ratio = np.asarray(ratio, float).reshape(T, D)
    return paired(
        before,
        ids,
        ratio,
        np.ones(T) if existence is None else np.asarray(existence),
        np.full(T, hit),
        np.full(T, missed),
        np.zeros((T, D), bool) if reserved is None else reserved,
        most,
    )


def rows_of(found):
    """Each hypothesis as a set of (source row, detection), with its probability."""
    names = list(zip(found.source.tolist(), found.detection.tolist()))
    now = found.hypotheses
    return {
        (int(c), frozenset(names[t] for t in np.flatnonzero(row))): w
        for c, w, row in zip(now.cluster, now.weight, now.member)
    }


def test_two_tracks_and_two_detections_by_hand():
    before, ids = two_tracks()
    f = np.array([[6.0, 2.0], [1.0, 3.0]])
    found = rows_of(pair(before, ids, np.log(f), hit=0.8, missed=0.8))
    q = 0.2
    by_hand = {
        frozenset({(0, -1), (1, -1)}): q * q,
        frozenset({(0, 0), (1, -1)}): 0.8 * 6 * q,
        frozenset({(0, 1), (1, -1)}): 0.8 * 2 * q,
        frozenset({(0, -1), (1, 0)}): 0.8 * 1 * q,
        frozenset({(0, -1), (1, 1)}): 0.8 * 3 * q,
        frozenset({(0, 0), (1, 1)}): 0.64 * 18,
        frozenset({(0, 1), (1, 0)}): 0.64 * 2,
    }
    total = sum(by_hand.values())
    assert {key[1] for key in found} == set(by_hand)
    assert len({key[0] for key in found}) == 1
    for (_, event), weight in found.items():
        assert weight == pytest.approx(by_hand[event] / total, abs=1e-12)


def test_tracks_that_share_no_detection_stay_apart():
    before, ids = two_tracks()
    found = pair(before, ids, [[1.0, -np.inf], [-np.inf, 2.0]])
    clusters = sorted(set(found.hypotheses.cluster.tolist()))
    assert len(clusters) == 2 and found.place.tolist() == clusters
    sums = np.bincount(found.hypotheses.cluster, found.hypotheses.weight)
    assert sums[clusters] == pytest.approx([1, 1])


def test_a_reserved_detection_goes_to_its_row_or_to_none():
    before, ids = two_tracks()
    reserved = np.array([[True], [False]])
    found = pair(before, ids, [[-1.0], [5.0]], reserved=reserved, missed=0.0)
    assert {key[1] for key in rows_of(found)} == {
        frozenset({(0, 0), (1, -1)}),
        frozenset({(0, -1), (1, -1)}),
    }


def test_a_new_track_is_where_no_other_took_its_detection():
    before = Hypotheses.none().with_alone(1)
    found = pair(before, np.array([1]), [[1.0, -np.inf]])
    now = with_births(found, np.array([0, 1]))
    taken = np.flatnonzero(found.detection == 0)[0]
    there = now.cluster == found.place[0]
    assert (now.member[there, taken] != now.member[there, -2]).all()
    alone = now.member[:, -1]
    assert alone.sum() == 1 and now.weight[alone] == pytest.approx([1.0])
    assert not now.member[alone][:, :-1].any()


def test_rows_with_the_same_last_detections_become_the_likelier_one():
    member = np.array([[1, 0, 1, 0], [0, 1, 1, 0], [0, 1, 0, 1]], bool)
    now = Hypotheses(
        np.zeros(3, np.int64), np.log([0.2, 0.5, 0.3]), np.array([True, False, False]), member
    )
    ids = np.array([1, 1, 2, 2])
    key = np.array([[7, 8], [7, 8], [5, 6], [5, 9]])
    after, kept = settled(now, ids, key, np.ones(4, bool), 10)
    assert kept.tolist() == [False, True, True, True]
    # Track 1 is certain now and stands apart.
    assert sorted(np.bincount(after.cluster).tolist()) == [1, 2]
    two = after.cluster == np.bincount(after.cluster).argmax()
    assert after.weight[two] == pytest.approx([0.7, 0.3])
    assert after.shown[two].tolist() == [True, False]


def test_no_more_hypotheses_than_wanted_and_their_weights_sum_to_one():
    rng = np.random.default_rng(3)
    before, ids = two_tracks()
    found = pair(before, ids, rng.normal(size=(2, 6)))
    T = len(found.source)
    after, kept = settled(
        found.hypotheses,
        ids[found.source],
        np.column_stack([np.arange(T) + 1, np.full(T, 99)]),
        np.ones(T, bool),
        5,
    )
    assert len(after.weight) == 5
    assert after.weight.sum() == pytest.approx(1.0)
    assert after.shown.sum() == 1
    assert after.member.shape[1] == kept.sum()


def test_what_is_shown_stays_until_another_is_much_likelier():
    member = np.eye(2, dtype=bool)

    def shown(first):
        now = Hypotheses(
            np.zeros(2, np.int64), np.log([first, 1 - first]), np.array([False, True]), member
        )
        after, _ = settled(now, np.array([1, 1]), np.eye(2, dtype=int), np.ones(2, bool), 9)
        return after.member[after.shown][0].tolist()

    assert shown(0.7) == [False, True]
    assert shown(0.8) == [True, False]


def test_hypotheses_of_joined_clusters_are_the_products():
    first = Hypotheses(
        np.array([0, 0, 1, 1]),
        np.log([0.9, 0.1, 0.6, 0.4]),
        np.array([True, False, True, False]),
        np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], bool),
    )
    ids = np.array([1, 1, 2, 2])
    # A detection that is nobody's joins nothing else than the clusters.
    found = pair(first, ids, np.full((4, 1), -50.0))
    weights = [w for (_, rows), w in sorted(rows_of(found).items(), key=lambda item: -item[1])]
    assert weights == pytest.approx([0.54, 0.36, 0.06, 0.04], abs=1e-12)
    assert found.hypotheses.weight[found.hypotheses.shown] == pytest.approx([0.54])


def test_a_number_that_no_cluster_has_is_no_cluster():
    before, ids = two_tracks()
    gap = before._replace(cluster=2 * before.cluster)  # 0 and 2
    ratio = [[3.0, 1.0], [1.0, 2.0]]  # each detection is near to both
    found, expected = pair(gap, ids, ratio), pair(before, ids, ratio)
    weights = [sorted(rows_of(item).values()) for item in (found, expected)]
    assert weights[0] == pytest.approx(weights[1], abs=1e-15)


def test_nothing_at_all():
    found = pair(Hypotheses.none(), np.empty(0, np.int64), np.empty((0, 3)))
    assert len(found.source) == 0 and found.claimed.tolist() == [0.0, 0.0, 0.0]
    now = with_births(found, np.arange(3))
    assert now.member.shape == (3, 3) and sorted(now.cluster.tolist()) == [0, 1, 2]
    empty, kept = settled(
        Hypotheses.none(), np.empty(0, np.int64), np.empty((0, 2), np.int64), np.empty(0, bool), 3
    )
    assert len(empty.cluster) == 0 and len(kept) == 0
