# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``sonar-imm view``: removed options, the report in the browser, the file for Rerun."""

from pathlib import Path
import shutil
import sys
import webbrowser

import pytest

from sonar_imm_tools.cli import main
from sonar_imm_tools.offline.run_folder import RunFolder
from sonar_imm_tools.resources import shared_file


@pytest.fixture(scope='module')
def run(tmp_path_factory):
    """A short dive, tracked."""
    folder = tmp_path_factory.mktemp('view')
    given = ['--set', 'duration=20', '--seed', '1']
    assert main(['simulate', 'diver', str(folder / 'bag'), *given]) == 0
    assert main(['track', str(folder / 'bag'), str(folder / 'run')]) == 0
    return folder / 'run'


@pytest.fixture
def opened(monkeypatch):
    """The addresses that a browser was asked to open, on a machine with a screen."""
    addresses = []
    monkeypatch.setattr(webbrowser, 'open', addresses.append)
    monkeypatch.setenv('DISPLAY', ':0')
    return addresses


@pytest.mark.parametrize(
    ('arguments', 'sentence'),
    [
        ([], "Missing argument 'RESULTS|BAG'"),
        (['nowhere.bag'], 'nowhere.bag'),
        (['--live'], "'--live' was removed: view opens the report"),
        (['out', '--host=0.0.0.0'], 'foxglove_bridge and config/foxglove_SYSTEM.json'),
        (['out', '--rate', '4', '--loop'], "'--rate' was removed"),
    ],
)
def test_mistakes_are_one_sentence(arguments, sentence, capsys):
    assert main(['view', *arguments]) == 2
    errors = capsys.readouterr().err
    assert sentence in errors and errors.count('\n') == 1


@pytest.mark.parametrize('kind', ['run', 'bag'])
def test_the_browser_gets_the_report(run, kind, capsys, opened):
    assert main(['view', str(run.parent / kind), *['--browser'] * (kind == 'run')]) == 0
    (address,) = opened
    assert address.startswith('file://') and address.endswith('/report.html')
    assert address.removeprefix('file://') in capsys.readouterr().out


def test_a_report_that_is_there_is_opened_as_it_is(run, tmp_path, opened):
    shutil.copytree(run, tmp_path / 'run')
    (tmp_path / 'run' / 'report.html').write_text('made with --truth')
    assert main(['view', str(tmp_path / 'run')]) == 0
    assert Path(opened[0].removeprefix('file://')).read_text() == 'made with --truth'


def test_without_a_screen_it_says_where_the_report_is(run, capsys, opened, monkeypatch):
    monkeypatch.setattr(sys, 'platform', 'linux')
    for name in ('DISPLAY', 'WAYLAND_DISPLAY', 'BROWSER'):
        monkeypatch.delenv(name, raising=False)
    assert main(['view', str(run)]) == 0
    assert opened == []
    assert capsys.readouterr().out == f'report: {run.resolve() / "report.html"}\n'


def test_a_browser_that_does_not_start_is_no_failure(run, monkeypatch):
    def fail(_address):
        raise webbrowser.Error('could not locate runnable browser')

    monkeypatch.setattr(webbrowser, 'open', fail)
    monkeypatch.setenv('DISPLAY', ':0')
    assert main(['view', str(run)]) == 0


def test_rerun_file(run, tmp_path, capsys):
    pytest.importorskip('rerun')
    assert main(['view', str(run), '--rerun', str(tmp_path / 'dive.rrd')]) == 0
    count = len(RunFolder(run).read_estimates())
    assert f'{count} estimates written' in capsys.readouterr().out
    assert (tmp_path / 'dive.rrd').read_bytes().startswith(b'RRF')


def test_rerun_needs_a_run(tmp_path, capsys):
    pytest.importorskip('rerun')
    bag = shared_file('bags/diver_table1')
    assert main(['view', str(bag), '--rerun', str(tmp_path / 'a.rrd')]) == 2
    assert 'holds no finished run' in capsys.readouterr().err
