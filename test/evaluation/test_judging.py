# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Every system has what the commands need of it, and judges its own runs."""

from importlib import import_module
import re

from attrs import evolve
from helpers.dive_bags import write_dive
from helpers.dive_scenes import single_run
import numpy as np
import pytest

from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Fix
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.evaluation import numbers
from sonar_imm_tools.evaluation.judging import judge, JudgeOptions, Limit
from sonar_imm_tools.evaluation.numbers import (
    bounds_remark,
    cards,
    chi2_summary,
    coverage_sentence,
    coverage_verdict,
    error_summary,
    lines,
    Metric,
    nis_summary,
    verdict,
)
from sonar_imm_tools.offline.run_folder import read_measurements, read_truth, RunFolder
from sonar_imm_tools.recordings.reader import BagError


def folder_of(tmp_path, estimates=(), **run):
    folder = RunFolder(tmp_path / 'run')
    folder.path.mkdir()
    folder.write_estimates(estimates, 'diver')
    record = {'system': 'diver', 'bag': str(tmp_path / 'dive'), 'topics': {'/fix': 'fix'}}
    folder.write_json('run.json', {**record, 'counts': {}, 'parameters': {}, **run})
    return folder


@pytest.mark.parametrize('system', SYSTEMS)
def test_every_system_has_a_judge_with_a_limit(system):
    module = import_module(SYSTEMS[system].judge)
    assert callable(module.scored) and isinstance(module.LIMIT, Limit)


def test_a_limit_is_met_or_missed():
    limit = Limit(0.5, 'm', 'height RMSE', 'height.all.rmse_m')
    check = limit.check(0.5, remark=' (flat floor 1.20 m)')
    assert check.good and check.wanted == 'at most 0.5 m'
    assert check.name == 'height RMSE against truth'
    assert check.result == '0.50 m (flat floor 1.20 m)'
    assert not limit.check(0.4, at_most=0.3).good


def test_without_truth_there_is_no_accuracy_but_a_page(tmp_path):
    judgement = judge(folder_of(tmp_path, single_run(count=30)[0]))
    assert judgement.accuracy(None) is None
    assert 'no truth' in judgement.summary and judgement.metrics['truth_lag_s'] == 0.0
    assert judgement.part([]).title == 'dive'


def test_truth_of_another_bag_is_scored(tmp_path):
    truth = write_dive(tmp_path / 'truth')
    options = JudgeOptions(truth_bag=truth, lag=0.5, gap=5.0, cutoff=3.0)
    judgement = judge(folder_of(tmp_path, single_run(count=100)[0]), options)
    assert judgement.metrics['cutoff_m'] == 3.0 and judgement.metrics['truth_lag_s'] == 0.5
    check = judgement.accuracy(None)
    assert check.wanted == 'at most 1.25 m' and check.name == 'position RMSE against truth'
    assert not judgement.accuracy(1e-3).good
    assert judgement.lines[0][0] == 'position error, RMSE / median / 95 %'


def test_estimates_of_something_else_are_one_sentence(tmp_path):
    divers = single_run(count=3)[0]
    whales = [evolve(item, state_names=('a', 'b', 'c', 'd')) for item in divers]
    with pytest.raises(BagError, match="no column 'px'"):
        judge(folder_of(tmp_path, whales))


def test_what_went_into_a_run_is_read_again(tmp_path):
    run = {'system': 'diver', 'topics': {'/fix': 'fix'}, 'bag': str(tmp_path / 'dive')}
    assert read_truth(run) is None and list(read_measurements(run)) == []
    write_dive(tmp_path / 'dive', count=10, spoilt=(3,))
    assert len(read_truth(run)) == 20
    measured = list(read_measurements(run))
    assert len(measured) == 9 and all(isinstance(item, Fix) for item in measured)


def test_a_truth_bag_without_truth_is_told(tmp_path):
    blind = write_dive(tmp_path / 'blind', truth=False, count=5)
    assert read_truth({'bag': str(blind)}) is None
    with pytest.raises(BagError, match='has no topic /truth/estimate'):
        read_truth({'bag': str(blind)}, blind)


@pytest.mark.parametrize('system', ['diver', 'obstacle'])
def test_truth_that_is_none_is_refused_by_the_name_of_its_recording(system, tmp_path, monkeypatch):
    place = {name: np.zeros(1, np.float32) for name in 'xyz'}
    nothing = Estimate.from_columns(place, stamp_ns=1, frame_id='map')
    read_truth = 'sonar_imm_tools.evaluation.judging.read_truth'
    monkeypatch.setattr(read_truth, lambda *_: [nothing])
    with pytest.raises(BagError, match=re.escape(f'{tmp_path / "dive"}: ')):
        judge(folder_of(tmp_path, system=system))


# -- numbers that every system is judged by -------------------------------------------------------


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
    shown = [numbers.error('angle', 'angle error', 'rad'), numbers.chi2('nees', 'NEES')]
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


def test_nees_leaves_out_what_says_nothing():
    none = chi2_summary(np.empty(0), 2)
    assert (none['n'], none['dof'], none['believable']) == (0, 2, None)
    error = np.array([[3.0, 4.0], [1.0, 1.0], [np.nan, 0.0]])
    covariance = np.array([np.diag([1.0, 4.0]), np.diag([1.0, 0.0]), np.eye(2)])
    assert numbers.usable_nees(error, covariance).tolist() == [13.0]


def test_mixed_degrees_of_freedom_share_bounds_around_one():
    summary = nis_summary(np.array([2.0, 4.0]), np.array([2.0, 3.0]))
    assert summary['mean'] == pytest.approx(6.0 / 5.0) and summary['low'] < 1.0 < summary['high']
    assert bounds_remark(summary).startswith('per degree of freedom: 1 expected')
    assert bounds_remark(nis_summary(np.array([2.0]), np.array([2.0]))).endswith('believable')
    far = bounds_remark(nis_summary(np.full(9, 20.0), np.full(9, 2.0)))
    assert far.startswith('2 expected; outside of ') and 'believable' not in far


def test_the_lines_of_each_number_are_labelled_in_words():
    shown = numbers.each('height', ['mean_error', 'rmse'])
    found = lines(shown, {'height': {'mean_error': 0.25, 'rmse': 2}})
    assert found == (('mean error', '0.25'), ('rmse', '2'))
