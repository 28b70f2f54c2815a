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

"""`sonar-imm sweep` as a user meets it. What a sweep does is tested in evaluation."""

import csv
import json
import sys

import pytest

from sonar_imm_tools.cli import main
from sonar_imm_tools.evaluation.sweep import finite_numbers

TINY = ('--set', 'duration=15', '--workers', '1')


def test_a_seed_scores_as_simulate_track_and_evaluate_say(tmp_path, capsys):
    params = tmp_path / 'mine.yaml'
    params.write_text('model_set: heading_speed\ndirections: 4\n')
    out = tmp_path / 'out'
    circle = ['--scenario', 'circle']
    asked = ['--runs', '2', '--seed', '6', '--params', str(params), '--out', str(out)]
    assert main(['sweep', 'diver', *circle, *TINY, *asked]) == 0
    with (out / 'sweep.csv').open(newline='') as file:
        rows = list(csv.DictReader(file))
    assert [row['seed'] for row in rows] == ['6', '7']
    bag, run = str(tmp_path / 'bag'), str(tmp_path / 'run')
    assert main(['simulate', 'diver', bag, '--seed', '7', *circle, *TINY[:2]]) == 0
    assert main(['track', bag, run, '--params', str(params)]) == 0
    capsys.readouterr()
    assert main(['evaluate', run, '--no-report', '--json']) == 0
    wanted = finite_numbers(json.loads(capsys.readouterr().out))
    found = {
        name: float(text)
        for name, text in rows[1].items()
        if text and name not in ('seed', 'failure')
    }
    assert found == wanted and 'position.rmse_m' in found


def test_the_table_says_mean_and_error(capsys):
    assert main(['sweep', 'diver', '--runs', '3', *TINY]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == 'diver table1: 3 runs, seeds 0 to 2'
    assert lines[1].split() == ['metric', 'mean', 'std', 'std', 'error', 'runs']
    row = next(line.split() for line in lines if line.startswith('  position.rmse_m '))
    assert float(row[3]) == pytest.approx(float(row[2]) / 3**0.5, rel=1e-2) and row[4] == '3'


def test_json_is_what_the_folder_holds(tmp_path, capsys):
    assert main(['sweep', 'diver', '--runs', '2', *TINY, '--out', str(tmp_path), '--json']) == 0
    printed = capsys.readouterr()
    content = json.loads(printed.out)
    assert content == json.loads((tmp_path / 'sweep.json').read_text()) and not printed.err
    assert content['seeds'] == [0, 1] and content['failures'] == {}
    assert content['scene']['duration'] == 15.0
    assert content['parameters']['model_set'] == 'families'
    assert {'sonar_imm', 'numpy', 'numba'} <= content['versions'].keys()


def test_when_most_runs_fail_the_exit_code_is_1(capsys):
    assert main(['sweep', 'diver', '--runs', '2', *TINY, '--topic', 'fix=/nowhere']) == 1
    printed = capsys.readouterr()
    assert printed.out == 'diver table1: 2 runs, seeds 0 to 1, 2 failed\n'
    assert len(printed.err.splitlines()) == 1
    assert printed.err.startswith("failed: seed 0, 1: scene has no topic '/nowhere'")


@pytest.mark.parametrize('failing, status', [(1, 0), (2, 1)])
def test_few_failures_leave_a_result(failing, status, monkeypatch, capsys):
    from sonar_imm_tools.simulation import diver

    simulate = diver.simulate

    def moody(config, seed):
        if seed < failing:
            raise ZeroDivisionError('division\nby zero')
        return simulate(config, seed)

    monkeypatch.setattr(diver, 'simulate', moody)
    assert main(['sweep', 'diver', '--runs', '3', *TINY, '--json']) == status
    content = json.loads(capsys.readouterr().out)
    sentence = 'ZeroDivisionError: division by zero'
    assert content['failures'] == {str(seed): sentence for seed in range(failing)}
    assert content['seeds'] == [0, 1, 2]
    assert content['summary']['position.rmse_m']['runs'] == 3 - failing


@pytest.mark.parametrize(
    'arguments, words',
    [
        (['diver'], "Missing option '--runs'"),
        (['diver', '--runs', '0'], '0 is not in the range'),
        (['dvier', '--runs', '1'], "'dvier'"),
        (['diver', '--runs', '1', '--scenario', 'tabel1'], "did you mean 'table1'?"),
        (['diver', '--runs', '1', '--set', 'speed=fast'], "'speed' must be a number, got 'fast'"),
        (['diver', '--runs', '1', '--params', 'nowhere.yaml'], 'nowhere.yaml'),
        (['diver', '--runs', '1', '--workers', '2', '--scheduler', 'a:1'], 'exclude each other'),
        (['diver', '--runs', '1', '--scheduler', 'nonsense'], 'no dask scheduler at nonsense'),
    ],
)
def test_mistakes_end_in_one_line_and_exit_code_2(arguments, words, capsys):
    if 'nonsense' in arguments:
        pytest.importorskip('distributed')
    assert main(['sweep', *arguments]) == 2
    printed = capsys.readouterr()
    assert printed.out == '' and len(printed.err.splitlines()) == 1 and words in printed.err


@pytest.mark.parametrize('where', [('--workers', '2'), ('--scheduler', '127.0.0.1:1')])
def test_without_dask_the_command_says_how_to_get_it(where, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, 'distributed', None)
    assert main(['sweep', 'diver', '--runs', '2', *where]) == 2
    printed = capsys.readouterr().err
    assert "pip install 'sonar_imm[sweep]'" in printed and '--workers 1' in printed
