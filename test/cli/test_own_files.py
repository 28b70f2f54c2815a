# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""No command writes over a file of a run, of a recording or of the user."""

import json
import shutil

from helpers.commands import contents, run
from helpers.dive_bags import write_dive
import pytest


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    """A recording and its run."""
    folder = tmp_path_factory.mktemp('made')
    write_dive(folder / 'dive.bag')
    assert run('track', folder / 'dive.bag', folder / 'out') == 0
    return folder


@pytest.fixture
def here(made, tmp_path):
    shutil.copytree(made, tmp_path / 'here')
    record = tmp_path / 'here' / 'out' / 'run.json'
    content = json.loads(record.read_text())
    content['bag'] = str(tmp_path / 'here' / 'dive.bag')
    record.write_text(json.dumps(content))
    return tmp_path / 'here'


OWN = ('out/estimate.csv', 'out/soundings.csv', 'out/estimate/x.csv', 'dive.bag/tracks.csv')


@pytest.mark.parametrize('name', OWN)
def test_export_keeps_files_of_the_run_and_of_its_recording(here, capsys, name):
    before = contents(here)
    (here / 'link').symlink_to(here / 'out')
    (here / 'to_csv.csv').symlink_to(here / name)
    outs = [here / name, here / name.replace('out/', 'link/'), here / 'to_csv.csv']
    for run_folder in ('out', 'link'):
        for out in outs:
            assert run('export', here / run_folder, out, '--overwrite') == 2
            assert 'choose another name' in capsys.readouterr().err
    assert contents(here) == before


def test_export_may_write_beside_them(here):
    assert run('export', here / 'out', here / 'out' / 'tracks.csv') == 0
    assert run('export', here / 'out', here / 'out' / 'tracks.csv') == 2
    assert run('export', here / 'out', here / 'out' / 'tracks.csv', '--overwrite') == 0


@pytest.mark.parametrize(
    'name', ['out/run.json', 'out/estimate/estimate.mcap', 'dive.bag/metadata.yaml', 'mine.html']
)
def test_a_report_keeps_them_too(here, capsys, name):
    (here / 'mine.html').write_text('<!doctype html><p>mine, of the obsonar_im')
    before = contents(here)
    assert run('evaluate', here / 'out', '--report', here / name) == 2
    assert 'choose another name' in capsys.readouterr().err
    after = contents(here)
    after.pop('out/metrics.json', None)
    assert after == before


def test_a_report_replaces_a_report(here):
    for _ in range(2):
        assert run('evaluate', here / 'out') == 0
        assert run('evaluate', here / 'out', '--report', here / 'report.html') == 0
    assert (here / 'report.html').read_bytes() == (here / 'out' / 'report.html').read_bytes()


@pytest.mark.parametrize('folder', ['..', '/tmp', 'a/../../b'])
def test_a_summary_names_only_what_is_below_it(here, capsys, folder):
    (here / 'many').mkdir()
    (here / 'many' / 'summary.json').write_text(json.dumps({'runs': [{'folder': folder}]}))
    assert run('evaluate', here / 'many') == 2
    assert 'is not below its folder' in capsys.readouterr().err


def test_a_summary_of_the_user_is_kept(here, capsys):
    (here / 'many').mkdir()
    (here / 'many' / 'summary.json').write_text('{"mine": 1}')
    shutil.copytree(here / 'dive.bag', here / 'other.bag')
    assert run('track', here / 'dive.bag', here / 'other.bag', here / 'many') == 2
    assert 'summary.json cannot be understood' in capsys.readouterr().err
    assert contents(here / 'many') == {'summary.json': b'{"mine": 1}'}


def test_a_recording_is_no_place_for_a_run(here, capsys):
    shutil.copytree(here / 'dive.bag', here / 'dive')
    shutil.copytree(here / 'dive.bag', here / 'other')
    before = contents(here)
    assert run('track', here / 'dive', here / 'dive', '--overwrite') == 2
    assert run('track', here / 'dive', here / 'other', '--overwrite') == 2
    assert 'is a recording; choose another folder' in capsys.readouterr().err
    assert run('track', here / 'dive', here / 'other', here) == 1  # each would go into itself
    after = contents(here)
    after.pop('summary.json')
    assert after == before


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


def test_tune_keeps_the_recording(here, capsys):
    before = contents(here)
    place = here / 'dive.bag' / 'metadata.yaml'
    assert run('tune', here / 'dive.bag', '--out', place) == 2
    assert 'which stays as it is' in capsys.readouterr().err and contents(here) == before


def test_check_replaces_only_runs(here, capsys):
    """`demo` and `check` overwrite what they left before, in folders that they name."""
    pytest.importorskip('rclpy')
    mine = here / 'checks' / 'dive' / 'offline'
    mine.mkdir(parents=True)
    (mine / 'estimate.csv').write_text('mine')
    assert run('check', 'diver', '--bag', here / 'dive.bag', '--out', here / 'checks') == 2
    assert 'is no results folder that sonar-imm made' in capsys.readouterr().err
    assert (mine / 'estimate.csv').read_text() == 'mine'


@pytest.mark.parametrize('origin', [3, 'x', [1], {'a': 1}, {'latitude': 'x', 'longitude': 1}])
def test_an_export_of_a_hostile_run_json_is_one_sentence(here, capsys, origin):
    record = json.loads((here / 'out' / 'run.json').read_text())
    (here / 'out' / 'run.json').write_text(json.dumps({**record, 'origin': origin}))
    assert run('export', here / 'out', here / 'tracks.gpx') == 2
    assert "'origin' in the run.json" in capsys.readouterr().err
    (here / 'out' / 'run.json').write_text(json.dumps({**record, 'landmarks': origin}))
    place = ('--crs', 32632, '--origin', '500000,6000000')
    assert run('export', here / 'out', here / 'map.geojson', '--map', *place) == 2
    assert "'landmarks' in the run.json" in capsys.readouterr().err
    assert not (here / 'map.geojson').exists()


def test_a_file_for_rerun_keeps_them_too(here, capsys):
    pytest.importorskip('rerun')
    before = contents(here)
    assert run('view', here / 'out', '--rerun', here / 'out' / 'estimate.csv') == 2
    assert 'choose another name' in capsys.readouterr().err and contents(here) == before
