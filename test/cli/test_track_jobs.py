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

"""Several processes, and several bags: the same bytes as one by one."""

import json

from helpers.dive_bags import write_dive
import pytest

from sonar_imm_tools.cli import main

FEW = ('--set', 'particles_per_model=10')
COUPLED = ('--set', 'engine=grid', '--set', 'grid_extent=3', '--set', 'smoothing=states')
COUPLED += ('--set', 'ping_coupling=0.35')


@pytest.fixture(scope='module')
def swaths(tmp_path_factory):
    """A short recording of a sonar with two sides."""
    bag = tmp_path_factory.mktemp('swaths') / 'swaths.bag'
    scene = ('two_sides', '--set', 'pings=4', '--set', 'last_range=22')
    assert main(['simulate', 'bathymetry', str(bag), '--scenario', *scene]) == 0
    return bag


def contents(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob('*')
        if path.is_file() and path.name not in ('run.json', 'summary.json')
    }


@pytest.mark.parametrize('options', [FEW, COUPLED], ids=['independent', 'coupled'])
def test_pings_are_shared_out(swaths, tmp_path, capsys, options):
    counts = []
    for jobs in ('1', '2'):
        capsys.readouterr()
        out = str(tmp_path / jobs)
        assert main(['track', str(swaths), out, *options, '--jobs', jobs, '--json']) == 0
        run = json.loads(capsys.readouterr().out)
        counts.append((run['counts'], run['estimates'], run['messages']))
    assert counts[0] == counts[1] and counts[0][1] == 8
    assert contents(tmp_path / '1') == contents(tmp_path / '2')


def test_bags_are_shared_out_and_one_that_fails_stops_no_other(swaths, tmp_path, capsys):
    dive, broken = write_dive(tmp_path / 'dive.bag'), tmp_path / 'broken.bag'
    broken.mkdir()
    bags = [str(swaths), str(broken), str(dive)]
    found = []
    for jobs in ('1', '2'):
        capsys.readouterr()
        assert main(['track', *bags, str(tmp_path / jobs), '--jobs', jobs]) == 1
        output = capsys.readouterr()
        assert output.err.startswith(f'{broken}: ')
        assert 'Traceback' not in output.err and output.err.count('broken') == 2
        found.append((contents(tmp_path / jobs), output.out.replace(str(tmp_path / jobs), '')))
    assert found[0] == found[1]
    assert {name.split('/')[0] for name in found[0][0]} == {'swaths', 'dive'}
    capsys.readouterr()
    assert main(['track', str(swaths), str(dive), str(tmp_path / 'j'), '--json']) == 0
    runs = json.loads(capsys.readouterr().out)['runs']
    assert {run['bag']: run['system'] for run in runs} == {
        str(swaths): 'bathymetry',
        str(dive): 'diver',
    }


def test_two_bags_of_one_name_are_refused(swaths, tmp_path, capsys):
    assert main(['track', str(swaths), str(swaths), str(tmp_path / 'out')]) == 2
    assert 'two bags would be tracked into' in capsys.readouterr().err
    assert not (tmp_path / 'out').exists()


def test_a_worker_that_dies_is_one_sentence(swaths, tmp_path, capsys, monkeypatch):
    from concurrent.futures.process import BrokenProcessPool

    from sonar_imm_tools.offline.tracking import OfflineRun

    def dies(self, done):
        raise BrokenProcessPool('gone')

    monkeypatch.setattr(OfflineRun, '_taken', dies)
    assert main(['track', str(swaths), str(tmp_path / 'out'), *FEW, '--jobs', '2']) == 2
    assert 'Traceback' not in (errors := capsys.readouterr().err) and 'lack of memory' in errors
