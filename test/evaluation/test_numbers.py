# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Numbers that every system is judged by."""

import numpy as np
import pytest

from sonar_imm_tools.evaluation.numbers import (
    bounds_remark,
    cards,
    chi2,
    chi2_summary,
    coverage_sentence,
    coverage_verdict,
    each,
    error,
    error_summary,
    lines,
    Metric,
    nis_summary,
    usable_nees,
    verdict,
)


@pytest.mark.parametrize(
    'coverage, words', [(0.6, 'overconfident'), (0.95, 'is consistent'), (1.0, 'more cautious')]
)
def test_coverage_is_put_in_words(coverage, words):
    assert words in coverage_sentence(coverage)


def test_a_tracker_with_few_errors_far_too_large_is_overconfident():
    assert coverage_verdict(0.96, nees=1.9) == 'consistent'
    assert coverage_verdict(0.96, nees=2.1) == coverage_verdict(1.0, nees=2.1) == 'overconfident'
    sentence = coverage_sentence(0.96, 31_500.0)
    assert 'overconfident' in sentence and 'mean NEES 3.15e+04 times' in sentence
    assert 'NEES' not in coverage_sentence(0.5, 31_500.0)
    far = chi2_summary(np.array([1.0, 1.0, 126_000.0]), 2)
    shown = [Metric(covers=('share', 0.95), nees='nees')]
    assert verdict(shown, {'share': 0.96, 'nees': far}) == 'overconfident'
    assert verdict(shown, {'share': 0.96}) == 'consistent'


def test_lines_name_the_unit_and_are_left_out_without_errors():
    shown = [error('angle', 'angle error', 'rad'), chi2('nees', 'NEES')]
    angle = error_summary(np.radians([3.0, 4.0]), unit='rad')
    ((title, value),) = lines(shown, {'angle': angle, 'nees': chi2_summary(np.empty(0), 2)})
    assert title == 'angle error, RMSE / median / 95 %'
    assert value == '0.062 / 0.061 / 0.069 rad'
    assert lines(shown, {'angle': error_summary(np.empty(0), unit='rad')}) == ()


def test_a_metric_is_shown_where_its_first_number_is_known():
    shown = [
        Metric(label='kept / lost', line='{a.kept:.0%} / {a.lost:.0%}'),
        Metric(card='Kept', value='{a.kept:.1%}', remark='of {n}', when=lambda m: m['n'] > 1),
    ]
    assert lines(shown, {'a': {'kept': 0.5, 'lost': float('nan')}}) == (
        ('kept / lost', '50 % / -'),
    )
    assert lines(shown, {'a': {'lost': 0.5}}) == lines(shown, {}) == ()
    (card,) = cards(shown, {'n': 2, 'a': {'kept': 0.25}})
    assert (card.title, card.value, card.remark) == ('Kept', '25.0 %', 'of 2')
    assert cards(shown, {'n': 1, 'a': {'kept': 0.25}}) == ()


def test_without_values_there_is_no_verdict():
    none = chi2_summary(np.empty(0), 2)
    assert (none['n'], none['dof'], none['believable']) == (0, 2, None)


def test_nees_leaves_out_what_says_nothing():
    error = np.array([[3.0, 4.0], [1.0, 1.0], [np.nan, 0.0]])
    covariance = np.array([np.diag([1.0, 4.0]), np.diag([1.0, 0.0]), np.eye(2)])
    assert usable_nees(error, covariance).tolist() == [13.0]


def test_mixed_degrees_of_freedom_share_bounds_around_one():
    summary = nis_summary(np.array([2.0, 4.0]), np.array([2.0, 3.0]))
    assert summary['mean'] == pytest.approx(6.0 / 5.0) and summary['low'] < 1.0 < summary['high']
    assert bounds_remark(summary).startswith('per degree of freedom: 1 expected')
    assert bounds_remark(nis_summary(np.array([2.0]), np.array([2.0]))).endswith('believable')
    far = bounds_remark(nis_summary(np.full(9, 20.0), np.full(9, 2.0)))
    assert far.startswith('2 expected; outside of ') and 'believable' not in far


def test_the_lines_of_each_number_are_labelled_in_words():
    found = lines(
        each('height', ['mean_error', 'rmse']), {'height': {'mean_error': 0.25, 'rmse': 2}}
    )
    assert found == (('mean error', '0.25'), ('rmse', '2'))
