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

"""``check fathometer``: the real node and the offline tracker, on the shipped recordings."""

import json

import pytest

from sonar_imm_tools.cli import main

pytestmark = pytest.mark.system


def test_the_shipped_recordings_pass(tmp_path, capsys):
    assert main(['check', 'fathometer', '--json', '--out', str(tmp_path)]) == 0
    outcomes = json.loads(capsys.readouterr().out)
    assert [outcome['bag'].rsplit('/', 1)[-1] for outcome in outcomes] == [
        'fathometer_array',
        'fathometer_drift',
        'fathometer_pressure',
    ]
    for outcome in outcomes:
        assert outcome['good'] and len(outcome['checks']) == 4
        assert outcome['checks'][1]['result'] == 'equal bytes'


def test_a_limit_that_cannot_be_met_fails(tmp_path, capsys):
    from sonar_imm_tools.resources import share_folder

    bag = share_folder() / 'bags' / 'fathometer_array'
    assert main(['check', 'fathometer', '--json', '--bag', str(bag), '--limit', '1e-6']) == 1
    (outcome,) = json.loads(capsys.readouterr().out)
    assert [check['good'] for check in outcome['checks']] == [True, True, True, False]


def test_told_otherwise_than_it_says_a_recording_of_another_array_is_counted_out(tmp_path, capsys):
    from sonar_imm_tools.resources import share_folder

    bag = share_folder() / 'bags' / 'fathometer_array'
    assert main(['track', str(bag), str(tmp_path / 'out'), '--set', 'phones=32', '--json']) == 2
    assert 'refused: 12 (wrong_hydrophones: ' in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()
