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

from helpers.dive_bags import write_dive
import numpy as np
import pytest

from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Fix
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.evaluation.judging import judge, JudgeOptions, Limit
from sonar_imm_tools.offline.run_folder import read_measurements, read_truth, RunFolder
from sonar_imm_tools.recordings.reader import BagError


def folder_of(tmp_path, estimates=(), **run):
    folder = RunFolder(tmp_path / 'run')
    folder.path.mkdir()
    folder.write_estimates(estimates, 'diver')
    folder.write_json(
        'run.json',
        {
            'system': 'diver', 'bag': str(tmp_path / 'dive'), 'counts': {},
            'topics': {'/fix': 'fix'}, 'parameters': {}, **run,
        },
    )  # fmt: skip
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
    from helpers.dive_scenes import single_run

    judgement = judge(folder_of(tmp_path, single_run(count=30)[0]))
    assert judgement.accuracy(None) is None
    assert 'no truth' in judgement.summary and judgement.metrics['truth_lag_s'] == 0.0
    assert judgement.part([]).title == 'dive'


def test_truth_of_another_bag_is_scored(tmp_path):
    from helpers.dive_scenes import single_run

    truth = write_dive(tmp_path / 'truth')
    options = JudgeOptions(truth_bag=truth, lag=0.5, gap=5.0, cutoff=3.0)
    judgement = judge(folder_of(tmp_path, single_run(count=100)[0]), options)
    assert judgement.metrics['cutoff_m'] == 3.0 and judgement.metrics['truth_lag_s'] == 0.5
    check = judgement.accuracy(None)
    assert check.wanted == 'at most 1.25 m' and check.name == 'position RMSE against truth'
    assert not judgement.accuracy(1e-3).good
    assert judgement.lines[0][0] == 'position error, RMSE / median / 95 %'


def test_estimates_of_something_else_are_one_sentence(tmp_path):
    import attrs
    from helpers.dive_scenes import single_run

    whales = [
        attrs.evolve(item, state_names=('a', 'b', 'c', 'd')) for item in single_run(count=3)[0]
    ]
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
    module = import_module(f'sonar_imm_tools.evaluation.{system}')
    place = {name: np.zeros(1, np.float32) for name in 'xyz'}
    nothing = Estimate.from_columns(place, stamp_ns=1, frame_id='map')
    monkeypatch.setattr(module, 'read_truth', lambda *_: [nothing])
    with pytest.raises(BagError, match=re.escape(f'{tmp_path / "dive"}: ')):
        judge(folder_of(tmp_path, system=system))
