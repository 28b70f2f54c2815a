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

"""Estimates as flat arrays."""

from helpers.dive_scenes import covariance, estimate_at, HEADINGS, START_NS, truth_estimate
import numpy as np
import pytest

from sonar_imm_tools.evaluation.diver.series import series_of

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
