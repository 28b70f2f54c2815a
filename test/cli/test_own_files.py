# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""No command writes over a file of a run, of a recording or of the user; and `view`."""

from itertools import product
import json
from pathlib import Path
import shutil
import sys
import webbrowser

from helpers.commands import contents, run
from helpers.dive_scenes import write_dive
import pytest

from sonar_imm_tools.offline.run_folder import RunFolder


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    """A recording and its run."""
    folder = tmp_path_factory.mktemp('made')
    write_dive(folder / 'dive.bag')
    assert run('track', folder / 'dive.bag', folder / 'out') == 0
    return folder


@pytest.fixture
def here(made, tmp_path):
    here = shutil.copytree(made, tmp_path / 'here')
    record = here / 'out' / 'run.json'
    content = {**json.loads(record.read_text()), 'bag': str(here / 'dive.bag')}
    record.write_text(json.dumps(content))
    return here


OWN = ('out/estimate.csv', 'out/soundings.csv', 'out/estimate/x.csv', 'dive.bag/tracks.csv')


@pytest.mark.parametrize('name', OWN)
def test_export_keeps_files_of_the_run_and_of_its_recording(here, capsys, name):
    before = contents(here)
    (here / 'link').symlink_to(here / 'out')
    (here / 'to_csv.csv').symlink_to(here / name)
    for run_folder in ('out', 'link'):
        for out in (name, name.replace('out/', 'link/'), 'to_csv.csv'):
            assert run('export', here / run_folder, here / out, '--overwrite') == 2
            assert 'choose another name' in capsys.readouterr().err
    assert contents(here) == before
    beside = 'export', here / 'out', here / 'out' / 'tracks.csv'
    assert [run(*beside), run(*beside), run(*beside, '--overwrite')] == [0, 2, 0]


@pytest.mark.parametrize(
    'name', ['out/run.json', 'out/estimate/estimate.mcap', 'dive.bag/metadata.yaml', 'mine.html']
)
def test_a_report_and_a_file_for_rerun_keep_them_too(here, capsys, name):
    (here / 'mine.html').write_text('<!doctype html><p>mine, of the obsonar_im')
    before = contents(here)
    assert run('evaluate', here / 'out', '--report', here / name) == 2
    assert 'choose another name' in capsys.readouterr().err
    assert contents(here, 'metrics.json') == before
    if name != 'mine.html':
        pytest.importorskip('rerun')
        assert run('view', here / 'out', '--rerun', here / name) == 2
        assert 'choose another name' in capsys.readouterr().err
        assert contents(here, 'metrics.json') == before


def test_a_report_replaces_a_report(here):
    for _ in range(2):
        assert run('evaluate', here / 'out') == 0
        assert run('evaluate', here / 'out', '--report', here / 'report.html') == 0
    assert (here / 'report.html').read_bytes() == (here / 'out' / 'report.html').read_bytes()


def test_a_summary_names_only_what_is_below_it_and_that_of_the_user_is_kept(here, capsys):
    summary = here / 'many' / 'summary.json'
    summary.parent.mkdir()
    for folder in ('..', '/tmp', 'a/../../b'):
        summary.write_text(json.dumps({'runs': [{'folder': folder}]}))
        assert run('evaluate', here / 'many') == 2
        assert 'is not below its folder' in capsys.readouterr().err
    summary.write_text('{"mine": 1}')
    shutil.copytree(here / 'dive.bag', here / 'other.bag')
    assert run('track', here / 'dive.bag', here / 'other.bag', here / 'many') == 2
    assert 'summary.json cannot be understood' in capsys.readouterr().err
    assert contents(here / 'many') == {'summary.json': b'{"mine": 1}'}


def test_a_recording_is_no_place_for_a_run(here, capsys):
    for name in ('dive', 'other'):
        shutil.copytree(here / 'dive.bag', here / name)
    before = contents(here)
    assert run('track', here / 'dive', here / 'dive', '--overwrite') == 2
    assert run('track', here / 'dive', here / 'other', '--overwrite') == 2
    assert 'is a recording; choose another folder' in capsys.readouterr().err
    assert run('track', here / 'dive', here / 'other', here) == 1  # each would go into itself
    assert contents(here, 'summary.json') == before


@pytest.mark.parametrize('command', [('simulate', 'diver'), ('convert', 'fixes', 'fixes.csv')])
def test_commands_that_make_a_recording_replace_nothing(here, capsys, monkeypatch, command):
    monkeypatch.chdir(here)
    (here / 'fixes.csv').write_text('time,x,y\n1700000000,1,2\n')
    (here / 'file').write_text('mine')
    (here / 'empty').mkdir()
    before = contents(here)
    for out in ('dive.bag', 'out', 'file', 'empty', '.', '/'):
        assert run(*command, out) == 2, out
    assert contents(here) == before and 'Traceback' not in capsys.readouterr().err


def test_tune_keeps_the_recording_and_check_replaces_only_runs(here, capsys):
    """`demo` and `check` overwrite what they left before, in folders that they name."""
    before = contents(here)
    place = here / 'dive.bag' / 'metadata.yaml'
    assert run('tune', here / 'dive.bag', '--out', place) == 2
    assert 'which stays as it is' in capsys.readouterr().err and contents(here) == before
    pytest.importorskip('rclpy')
    mine = here / 'checks' / 'dive' / 'offline' / 'estimate.csv'
    mine.parent.mkdir(parents=True)
    mine.write_text('mine')
    assert run('check', 'diver', '--bag', here / 'dive.bag', '--out', here / 'checks') == 2
    assert 'is no results folder that sonar-imm made' in capsys.readouterr().err
    assert mine.read_text() == 'mine'


def test_an_export_of_a_hostile_run_json_is_one_sentence(here, capsys):
    record = here / 'out' / 'run.json'
    good, place = json.loads(record.read_text()), ('--crs', 32632, '--origin', '500000,6000000')
    ways = ('origin', 'tracks.gpx'), ('landmarks', 'map.geojson', '--map', *place)
    hostile = 3, 'x', [1], {'a': 1}, {'latitude': 'x', 'longitude': 1}
    for value, (key, name, *words) in product(hostile, ways):
        record.write_text(json.dumps({**good, key: value}))
        assert run('export', here / 'out', here / name, *words) == 2
        assert f'{key!r} in the run.json' in capsys.readouterr().err
        assert not (here / name).exists()


# -- `view`: the report in the browser, the file for Rerun --


@pytest.fixture
def opened(monkeypatch):
    """The addresses that a browser was asked to open, on a machine with a screen."""
    addresses = []
    monkeypatch.setattr(webbrowser, 'open', addresses.append)
    monkeypatch.setenv('DISPLAY', ':0')
    return addresses


@pytest.mark.parametrize('kind', ['out', 'dive.bag'])
def test_the_browser_gets_the_report(here, kind, capsys, opened):
    assert run('view', here / kind, *['--browser'] * (kind == 'out')) == 0
    (address,) = opened
    assert address.startswith('file://') and address.endswith('/report.html')
    path = Path(address.removeprefix('file://'))
    assert str(path) in capsys.readouterr().out
    if kind == 'out':  # one that is there is opened as it is
        path.write_text('made with --truth')
        assert run('view', here / 'out') == 0 and opened == [address] * 2
        assert path.read_text() == 'made with --truth'


def test_without_a_screen_it_says_where_the_report_is(here, capsys, opened, monkeypatch):
    def fail(_address):
        raise webbrowser.Error('could not locate runnable browser')

    monkeypatch.setattr(webbrowser, 'open', fail)
    assert run('view', here / 'out') == 0  # a browser that does not start is no failure
    capsys.readouterr()
    monkeypatch.setattr(webbrowser, 'open', opened.append)
    monkeypatch.setattr(sys, 'platform', 'linux')
    for name in ('DISPLAY', 'WAYLAND_DISPLAY', 'BROWSER'):
        monkeypatch.delenv(name, raising=False)
    assert run('view', here / 'out') == 0 and opened == []
    assert capsys.readouterr().out == f'report: {here.resolve() / "out" / "report.html"}\n'


def test_rerun_file(made, tmp_path, capsys):
    pytest.importorskip('rerun')
    assert run('view', made / 'out', '--rerun', tmp_path / 'dive.rrd') == 0
    count = len(RunFolder(made / 'out').read_estimates())
    assert f'{count} estimates written' in capsys.readouterr().out
    assert (tmp_path / 'dive.rrd').read_bytes().startswith(b'RRF')
    assert run('view', made / 'dive.bag', '--rerun', tmp_path / 'a.rrd') == 2
    assert 'holds no finished run' in capsys.readouterr().err
