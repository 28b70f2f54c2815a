# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Estimates as flat arrays."""

from helpers.dive_scenes import (
    covariance,
    estimate_at,
    HEADINGS,
    SECOND,
    START_NS,
    truth_estimate,
)
import numpy as np
import pytest

from sonar_imm_tools.evaluation.diver.series import series_of, Truth, TruthPath

STATES = np.array([[1.0, 2.0, 0.5, -0.5], [3.0, 4.0, 0.0, 0.8]])


def test_rows_come_out_by_stamp_with_their_columns():
    late = estimate_at(START_NS + 5, STATES, [4, 9], nis=[1.5, np.nan])
    early = estimate_at(START_NS, STATES[:1], [4])
    series = series_of([late, early])
    assert series.stamp_ns.tolist() == [START_NS, START_NS + 5, START_NS + 5]
    assert series.track_id.tolist() == [4, 4, 9]
    np.testing.assert_array_equal(series.state[1:], STATES)
    np.testing.assert_array_equal(series.covariance[2], covariance())
    assert series.model_names == HEADINGS
    assert series.nis[1] == 1.5 and np.isnan(series.nis[0])


def test_scans_without_rows_are_remembered():
    series = series_of(
        [estimate_at(START_NS, np.empty((0, 4)), []), estimate_at(START_NS + 1, STATES[:1], [4])]
    )
    assert series.scan_ns.tolist() == [START_NS, START_NS + 1]
    assert len(series) == 1


def test_nothing_makes_an_empty_series():
    series = series_of([])
    assert len(series) == 0 and len(series.scan_ns) == 0
    assert series.longest_track() is None


def test_truth_states_no_covariance():
    series = series_of([truth_estimate(START_NS, STATES, [1, 2])])
    np.testing.assert_array_equal(series.state, STATES)
    assert np.isnan(series.covariance).all()


def test_tentative_rows_are_left_out_of_confirmed():
    series = series_of(
        [
            estimate_at(START_NS, STATES[:1], [4], tentative=True),
            estimate_at(START_NS + 1, STATES[:1], [4]),
        ]
    )
    assert series.confirmed().stamp_ns.tolist() == [START_NS + 1]


def test_a_table_of_something_else_is_refused():
    other = truth_estimate(START_NS, STATES, [1, 2])
    del other.extras['py']
    with pytest.raises(ValueError, match="no column 'py'"):
        series_of([other])


def test_two_runs_in_one_are_refused():
    import attrs

    first = estimate_at(START_NS, STATES[:1], [4])
    second = attrs.evolve(
        first, stamp_ns=START_NS + 1, model_names=('cv',), probabilities=np.ones((1, 1))
    )
    with pytest.raises(ValueError, match='more than one run'):
        series_of([first, second])


# -- truth ----------------------------------------------------------------------------------------

PATH = TruthPath(
    1,
    START_NS + np.array([0, 2, 100]) * SECOND,
    np.array([[0.0, 0.0, 1.0, 0.0], [4.0, -2.0, 3.0, 1.0], [9.0, 9.0, 0.0, 0.0]]),
)


def at(seconds, **options):
    stamps = START_NS + np.round(np.atleast_1d(seconds) * SECOND).astype(np.int64)
    return PATH.at(stamps, **{'max_gap': 10.0, **options})


def test_between_two_points_truth_is_a_straight_line():
    np.testing.assert_allclose(at(0.5)[0], [1.0, -0.5, 1.5, 0.25], atol=1e-12)


@pytest.mark.parametrize('seconds', [-0.001, 100.001])
def test_beyond_its_ends_truth_is_unknown(seconds):
    assert np.isnan(at(seconds)).all()


def test_across_a_long_gap_truth_is_unknown_but_its_ends_are_known():
    assert np.isnan(at(50.0)).all()
    np.testing.assert_array_equal(at([2.0, 100.0])[:, 0], [4.0, 9.0])
    assert np.isfinite(at(50.0, max_gap=98.0)).all()


def test_nanoseconds_are_not_lost_in_big_stamps():
    fast = TruthPath(1, START_NS + np.array([0, 1000]), np.array([[0.0] * 4, [1000.0] * 4]))
    assert fast.at(np.array([START_NS + 7]), max_gap=1.0)[0, 0] == pytest.approx(7.0, abs=1e-9)


def test_a_lag_compares_with_later_truth():
    shifted = Truth((PATH,)).shifted(0.5)
    np.testing.assert_allclose(shifted.at(np.array([START_NS]))[0, 0], at(0.5)[0])


def test_targets_are_told_apart_and_bad_rows_left_out():
    rows = [
        truth_estimate(START_NS + k, [[k, 0, 0, 0], [5, k if k else np.nan, 0, 0]], [1, 2])
        for k in range(3)
    ]
    truth = Truth.from_series(series_of(rows))
    assert [path.track_id for path in truth.paths] == [1, 2]
    assert [len(path.stamp_ns) for path in truth.paths] == [3, 2]


def test_of_repeated_stamps_the_last_counts():
    rows = [truth_estimate(START_NS, [[x, 0, 0, 0]], [1]) for x in (1.0, 2.0)]
    (path,) = Truth.from_series(series_of(rows)).paths
    assert path.state[:, 0].tolist() == [2.0]
