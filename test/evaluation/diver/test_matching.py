# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Who follows whom, against brute force and by hand."""

from itertools import permutations

from helpers.dive_scenes import estimate_at, SECOND, START_NS, truth_estimate
import numpy as np
import pytest

from sonar_imm_tools.evaluation.diver.series import assign, match, series_of, track_summary, Truth

FAR = 1000.0


def scene(rows_by_scan, ids_by_scan, *, targets=((0.0, 0.0), (30.0, 0.0)), cutoff=10.0):
    """Standing targets; estimates at the given places with the given track ids."""
    estimates, truths = [], []
    for k, (places, ids) in enumerate(zip(rows_by_scan, ids_by_scan)):
        stamp = START_NS + k * SECOND
        states = np.array([[*place, 0.0, 0.0] for place in places]).reshape(-1, 4)
        estimates.append(estimate_at(stamp, states, ids))
        truths.append(
            truth_estimate(stamp, [[*target, 0, 0] for target in targets], range(len(targets)))
        )
    return match(series_of(estimates), Truth.from_series(series_of(truths)), cutoff=cutoff)


@pytest.mark.parametrize('seed', range(20))
def test_assignment_has_the_least_total_of_all_assignments(seed):
    distance = np.random.default_rng(seed).uniform(0.0, 10.0, (3, 4))
    best = min(sum(distance[i, p[i]] for i in range(3)) for p in permutations(range(4), 3))
    pairs = assign(distance, np.inf)
    assert sum(distance[pair] for pair in pairs) == pytest.approx(best)


def test_pairs_beyond_the_cutoff_are_no_pairs():
    assert assign(np.array([[9.9, 50.0], [50.0, 10.0]]), 10.0) == [(0, 0)]


def test_what_is_left_over_on_both_sides_is_kept_apart():
    matching = scene([[(1.0, 0.0), (60.0, 0.0)], [(30.0, 0.0)]], [[1, 2], [2]])
    assert matching.distance.tolist() == [1.0, 0.0]
    assert matching.beyond_row.tolist() == [1]
    assert matching.beyond_truth[:, 0].tolist() == [30.0]


def test_one_target_with_one_track_is_matched_however_far():
    matching = scene([[(FAR, 0.0)]], [[7]], targets=[(0.0, 0.0)])
    assert matching.distance.tolist() == [FAR]


def test_errors_are_estimate_minus_truth():
    matching = scene([[(31.0, -2.0), (0.5, 0.0)]], [[2, 1]])
    order = np.argsort(matching.target)
    np.testing.assert_allclose(matching.error[order, :2], [[0.5, 0.0], [1.0, -2.0]])


def test_an_identity_switch_is_counted_once_and_a_gap_is_none():
    places = [[(0, 0), (30, 0)]] * 3 + [[(30, 0)]] + [[(0, 0), (30, 0)]] * 2
    ids = [[1, 2], [1, 2], [2, 1], [1], [2, 1], [2, 1]]
    summary = track_summary(scene(places, ids))
    assert summary['identity_switches'] == 2
    assert summary['fragmentations'] == 1
    assert summary['completeness'] == pytest.approx(11 / 12)
    assert summary['false_tracks'] == 0


def test_a_track_on_nothing_is_false():
    places = [[(0, 0), (30, 0), (15, 200)]] * 4
    summary = track_summary(scene(places, [[1, 2, 3]] * 4))
    assert summary['false_tracks'] == 1 and summary['tracks'] == 3
    assert summary['false_rows_per_scan'] == 1.0


def test_scans_without_truth_are_not_scored():
    estimates = [estimate_at(START_NS + k * SECOND, [[0.0, 0.0, 0.0, 0.0]], [1]) for k in range(5)]
    truths = [truth_estimate(START_NS + k * SECOND, [[0.0, 0.0, 0.0, 0.0]], [1]) for k in (1, 2)]
    matching = match(series_of(estimates), Truth.from_series(series_of(truths)), cutoff=10.0)
    assert len(matching.scan_ns) == 2 and matching.scored.sum() == 2


def test_no_estimates_find_nothing():
    matching = scene([[]], [[]])
    assert len(matching.row) == 0
    assert track_summary(matching)['completeness'] == 0.0


def test_a_target_counts_once_however_long_it_is_there():
    here = scene([[(0.0, 0.0)]] * 5, [[1]] * 5)
    assert track_summary(here)['true_targets'] == 2
    alone = scene([[(0.0, 0.0)]] * 5, [[1]] * 5, targets=((0.0, 0.0),))
    assert track_summary(alone)['true_targets'] == 1
