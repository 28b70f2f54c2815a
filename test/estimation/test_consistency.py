# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Consistency and distance measures against closed forms, brute force and Stone Soup."""

import datetime
import itertools

from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.stats import chi2

from sonar_imm.estimation.consistency import (
    average_bounds,
    gospa,
    identity_switches,
    interval_coverage,
    nees,
    nis,
    NIS_MEMORY,
    NisMemory,
    ospa,
    switches_by_scan,
    switching_gospa,
)


def test_nees_by_hand():
    error, P = np.array([[1.0, 2.0], [0.0, 3.0]]), np.array([[2.0, 0.5], [0.5, 1.0]])
    expected = [e @ np.linalg.inv(P) @ e for e in error]
    np.testing.assert_allclose(nees(error, P), expected, rtol=1e-13)
    np.testing.assert_allclose(nis(error, P), expected, rtol=1e-13)


def test_average_bounds_hold_as_often_as_they_say():
    rng = np.random.default_rng(1)
    average = rng.chisquare(4, (4000, 50)).mean(axis=1)
    low, high = average_bounds(50, 4)
    assert (low < 4.0 < high) and chi2.cdf(high * 50, 200) - chi2.cdf(
        low * 50, 200
    ) == pytest.approx(0.95, abs=1e-9)
    assert np.mean((low <= average) & (average <= high)) == pytest.approx(0.95, abs=0.015)


def test_coverage_of_honest_and_of_boastful_intervals():
    rng = np.random.default_rng(2)
    truth = rng.normal(size=2000)
    half = np.full(2000, 1.6449)  # 90 % of a standard normal
    spread = np.sqrt(0.9 * 0.1 / 2000)
    assert interval_coverage(truth, -half, half) == pytest.approx(0.9, abs=4.0 * spread)
    boastful = interval_coverage(truth, -0.5 * half, 0.5 * half)
    assert boastful == pytest.approx(0.5892, abs=4.0 * np.sqrt(0.59 * 0.41 / 2000))
    assert np.isnan(interval_coverage(np.empty(0), np.empty(0), np.empty(0)))


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
    result = gospa(truth, estimate, cutoff=4.0, order=2.0)
    assert (result.localisation, result.missed, result.false) == pytest.approx(expected, abs=1e-12)
    assert result.distance == pytest.approx(np.sqrt(sum(expected)), abs=1e-12)


def test_ospa_by_hand():
    assert ospa(POINTS, POINTS[:1], cutoff=4.0) == pytest.approx(np.sqrt(16.0 / 2), rel=1e-12)
    assert ospa(POINTS, POINTS + [0.0, 1.0], cutoff=4.0) == pytest.approx(1.0, rel=1e-12)
    assert ospa(NOTHING, NOTHING, cutoff=4.0) == 0.0
    assert ospa(NOTHING, POINTS, cutoff=4.0) == 4.0


def brute_gospa(truth, estimate, c, p):
    """Over all partial matchings, by definition."""
    best = np.inf
    for choice in itertools.product(range(-1, len(estimate)), repeat=len(truth)):
        used = [d for d in choice if d >= 0]
        if len(set(used)) == len(used):
            near = sum(
                np.linalg.norm(truth[t] - estimate[d]) ** p for t, d in enumerate(choice) if d >= 0
            )
            best = min(best, near + c**p / 2 * (len(truth) + len(estimate) - 2 * len(used)))
    return best ** (1 / p)


SETS = (
    st.integers(0, 2**32 - 1)
    .map(lambda seed: np.random.default_rng(seed))
    .map(lambda rng: tuple(rng.uniform(0, 6, (rng.integers(0, 5), 2)) for _ in range(3)))
)


@given(SETS, st.sampled_from([1.0, 2.0]))
def test_gospa_is_the_least_over_all_matchings(sets, p):
    assert gospa(sets[0], sets[1], 2.0, p).distance == pytest.approx(
        brute_gospa(sets[0], sets[1], 2.0, p), abs=1e-9
    )


@given(SETS, st.sampled_from([1.0, 2.0]))
def test_both_are_metrics(sets, p):
    a, b, c = sets
    for measure in (lambda x, y: ospa(x, y, 2.0, p), lambda x, y: gospa(x, y, 2.0, p).distance):
        assert measure(a, b) == pytest.approx(measure(b, a), abs=1e-12)
        assert measure(a, c) <= measure(a, b) + measure(b, c) + 1e-9
        assert measure(a, a) == 0.0


@given(SETS)
def test_stone_soup_agrees(sets):
    metrics = pytest.importorskip('stonesoup.metricgenerator.ospametric')
    states = pytest.importorskip('stonesoup.types.state')
    now = datetime.datetime(2024, 1, 1)
    truth, estimate = (
        [states.State(point, timestamp=now) for point in points] for points in sets[:2]
    )
    if not truth and not estimate:
        return  # Stone Soup cannot say what nothing is worth
    ours = gospa(sets[0], sets[1], 2.0, 2.0)
    theirs = metrics.GOSPAMetric(c=2.0, p=2.0).compute_gospa_metric(estimate, truth)[0].value
    assert ours.distance == pytest.approx(theirs['distance'], abs=1e-9)
    assert (ours.localisation, ours.missed, ours.false) == pytest.approx(
        (theirs['localisation'], theirs['missed'], theirs['false']), abs=1e-9
    )
    # Order 1 only: for others Stone Soup assigns by distance and scores by distance to the order.
    assert ospa(sets[0], sets[1], 2.0, 1.0) == pytest.approx(
        metrics.OSPAMetric(c=2.0, p=1.0).compute_OSPA_distance(estimate, truth).value, abs=1e-9
    )


def test_gospa_says_who_is_whom():
    result = gospa(POINTS, np.array([[10.0, 1.0], [50.0, 0.0], [0.5, 0.0]]), cutoff=4.0)
    assert list(result.estimate_of) == [2, 0]


@pytest.mark.parametrize('arguments', [(0.0, 2.0), (1.0, 0.5)])
def test_nonsense_is_refused(arguments):
    with pytest.raises(ValueError, match='cutoff > 0'):
        gospa(POINTS, POINTS, *arguments)


@pytest.mark.parametrize(
    'ids, switches',
    [
        ([[1, 2], [1, 2], [1, 2]], 0),
        ([[1, 2], [2, 1]], 2),
        ([[1, 2], [-1, 2], [1, 2]], 0),
        ([[1, 2], [-1, 2], [3, 2], [1, -1]], 2),
        ([[-1, -1]], 0),
    ],
)
def test_identity_switches(ids, switches):
    assert identity_switches(np.array(ids)) == switches


def test_a_switch_counts_at_the_scan_where_the_other_track_appears():
    ids = np.array([[1, 5], [-1, 5], [2, 5], [2, 6], [1, -1]])
    assert switches_by_scan(ids).tolist() == [0, 0, 1, 1, 1]
    assert switches_by_scan(np.empty((0, 2), int)).tolist() == []


def test_switching_gospa_is_the_root_mean_square_with_a_penalty_for_each_switch():
    distance, switches = np.array([3.0, 4.0]), np.array([0, 2])
    assert switching_gospa(distance, switches * 0, 5.0) == pytest.approx(np.sqrt(12.5))
    assert switching_gospa(distance, switches, 5.0) == pytest.approx(np.sqrt(37.5))
    assert np.isnan(switching_gospa(np.empty(0), np.empty(0, int), 5.0))


# -- mean NIS of a memory, against closed forms and random numbers --------------------------------


def test_the_memory_is_a_weighted_mean():
    rng = np.random.default_rng(2)
    nis, dof = rng.chisquare(3, 300), rng.integers(1, 4, 300)
    memory = NisMemory()
    for k in range(0, 300, 3):
        memory = memory.after(nis[k : k + 3], dof[k : k + 3])
    weight = (1.0 - 1.0 / NIS_MEMORY) ** np.arange(299, -1, -1)
    assert (nis > 9.0 * dof).any()  # some are so far out that they count as nine
    expected = weight @ np.minimum(nis, 9.0 * dof) / (weight @ dof)
    assert memory.mean == pytest.approx(expected, rel=1e-12)
    assert memory.square == pytest.approx(weight**2 @ dof, rel=1e-12)
    assert memory.after(np.empty(0), 2) == memory


def test_its_bounds_are_those_of_the_chi_square_of_the_same_variance():
    memory = NisMemory()
    for _ in range(2000):
        memory = memory.after(np.array([2.0]), 2)
    equivalent = memory.dof**2 / memory.square
    assert equivalent == pytest.approx(2.0 * (2.0 * NIS_MEMORY - 1.0), rel=1e-9)
    tail = 2.866516e-7  # of a Gaussian beyond five sigmas
    low, high = memory.bounds
    assert low == pytest.approx(chi2.ppf(tail, equivalent) / equivalent, rel=2e-3)
    assert high == pytest.approx(chi2.isf(tail, equivalent) / equivalent, rel=2e-3)


@pytest.mark.parametrize('factor, verdict', [(1.0, 0), (4.0, 1), (0.25, -1)])
def test_true_words_are_believed_and_wrong_ones_are_not(factor, verdict):
    rng = np.random.default_rng(3)
    memory, verdicts = NisMemory(), []
    for _ in range(5000):
        memory = memory.after(factor * rng.chisquare(2, 1), 2)
        verdicts.append(memory.verdict)
    assert not any(verdicts[:68])  # too few
    assert set(verdicts[200:]) == {verdict}
    assert bool(memory.warnings('echoes', 'look')) == bool(verdict)
    if verdict:
        word = 'more' if verdict > 0 else 'less'
        assert f'echoes miss by {word} than stated' in memory.warnings('echoes', 'look')[0]
