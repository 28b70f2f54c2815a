# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A survey names damaged lines and leaves them out; it assumes no error budget in silence."""

import json
import os
import shutil

from helpers.commands import contents, run
import pytest
import rasterio

from sonar_imm.files import mark
from sonar_imm.trackers.bathymetry.config import BathymetryConfig
from sonar_imm_tools.survey.making import sources_of

pytest.importorskip('rasterio')
pytest.importorskip('pyarrow')

PARAMETERS = BathymetryConfig().as_dict()
RECORD = {'system': 'bathymetry', 'bag': 'a.bag', 'topics': {}, 'parameters': PARAMETERS}
SMALL = ('lines=2', 'cross_lines=1', 'spacing=25', 'length=60', 'ping_interval=0.7', 'ghost=false')


def other(**entries):
    return json.dumps({**RECORD, **entries})


def changed(**parameters):
    return other(parameters={**PARAMETERS, **parameters})


HOSTILE = {
    'empty': '', 'cut': json.dumps(RECORD)[:-20], 'list': '[]', 'number': '3', 'null': 'null',
    'deep': '[' * 100_000,
    'no_parameters': json.dumps({k: v for k, v in RECORD.items() if k != 'parameters'}),
    'empty_parameters': other(parameters={}), 'list_of_parameters': other(parameters=[1]),
    'other_system': other(system='diver'), 'text': changed(heave_std='0.05'),
    'bool': changed(heave_std=True), 'none': changed(heave_std=None),
    'nan': changed(heave_std=float('nan')), 'infinite': changed(heave_std=float('inf')),
    'negative': changed(heave_std=-1.0), 'huge': changed(heave_std=10**400),
    'longer_number': changed(heave_std=0).replace('"heave_std": 0', '"heave_std": ' + '9' * 5000),
    'nested': changed(heave_std={'a': [1]}), 'sound_speed': changed(sound_speed=1e300),
    'epsg_text': other(epsg='x'), 'epsg_list': other(epsg=[32632]), 'epsg_low': other(epsg=-3),
}  # fmt: skip


@pytest.fixture(scope='module')
def good(tmp_path_factory):
    """Lines with their run.json."""
    out = tmp_path_factory.mktemp('good') / 'runs'
    settings = [word for setting in SMALL for word in ('--set', setting)]
    assert run('simulate', 'survey', out, '--soundings', *settings) == 0
    for line in out.glob('line_*'):
        (line / 'run.json').write_text(json.dumps(RECORD))
    return out


def tables(table):
    """Damaged forms of a table of soundings."""
    head, rest = table.split(b'\n', 1)
    first = rest.split(b'\n')[0].split(b',')
    first[head.split(b',').index(b'range')] = b'nan'
    return {
        'table_empty': b'', 'table_binary': bytes(range(256)) * 100, 'table_nul': b'stamp_ns\0',
        'table_header': b'stamp_ns,x\n1,2\n', 'table_cut': table[: len(table) * 2 // 3 - 5],
        'table_nan': b'\n'.join([head, b','.join(first), rest]),
        'table_big_stamp': head + b'\n' + b'9' * 30 + rest[19:], 'table_only_header': head + b'\n',
    }  # fmt: skip


def damage(runs):
    """Add a damaged line of each kind; gives their names."""
    line, before = runs / 'line_000', set(os.listdir(runs))
    files = {name: ('run.json', text.encode()) for name, text in HOSTILE.items()}
    broken = tables((line / 'soundings.csv').read_bytes())
    files |= {name: ('soundings.csv', content) for name, content in broken.items()}
    files['parquet'] = 'soundings.parquet', b'PAR1' + bytes(100) + b'PAR1'
    files['bytes'] = 'run.json', b'\xff\xfe{}'
    for name, (file, content) in files.items():
        shutil.copytree(line, runs / name)
        (runs / name / file).write_bytes(content)
    for name in ('directory', 'pipe', 'dangling', 'missing'):
        shutil.copytree(line, runs / name)
        (runs / name / 'run.json').unlink()
    (runs / 'directory' / 'run.json').mkdir()
    os.mkfifo(runs / 'pipe' / 'run.json')
    (runs / 'dangling' / 'run.json').symlink_to('nowhere')
    mark(runs / 'missing', 'results')
    return set(os.listdir(runs)) - before


@pytest.fixture
def runs(good, tmp_path):
    """A copy of the good lines."""
    return shutil.copytree(good, tmp_path / 'runs')


def warnings_of(out):
    return json.loads((out / 'survey.json').read_text())['warnings']


def test_each_damaged_line_is_named_and_left_out_and_the_chart_is_that_of_the_others(
    good, runs, tmp_path, capsys
):
    assert run('survey', good, tmp_path / 'wanted', '--resolution', 2) == 0
    wanted = capsys.readouterr()
    assert wanted.err == '' and '3 lines in' in wanted.out and 'left out' not in wanted.out
    names, out = damage(runs), tmp_path / 'out'
    assert run('export', runs / 'empty_parameters', tmp_path / 'out.tif') == 2
    assert 'its parameters lack' in capsys.readouterr().err
    assert not (tmp_path / 'out.tif').exists()
    assert run('survey', runs, out, '--resolution', 2, '--jobs', 2) == 0
    said = capsys.readouterr()
    left_out = [line for line in said.err.splitlines() if line.startswith('left out: ')]
    assert {line.split(': ')[1] for line in left_out} == names and len(left_out) == len(names)
    assert 'Traceback' not in said.err and 'Error:' not in said.err
    assert f'{len(names)} lines left out' in said.out and '3 lines in' in said.out
    lines = json.loads((out / 'survey.json').read_text())['lines']
    assert {line['name'] for line in lines if line['failure']} == names and not warnings_of(out)
    for name in ('survey.tif', 'provenance.parquet', 'crossings.csv'):
        assert (tmp_path / 'wanted' / name).read_bytes() == (out / name).read_bytes(), name


LACKING = 'attitude_std_deg, heading_std_deg, position_std, sound_speed_std'


@pytest.mark.parametrize(
    'record, sentence',
    [(None, '1 line without run.json (line_001): default error budget'),
     (other(parameters={'sound_speed': 1500.0, 'heave_std': 0.05}),
      f'1 line without {LACKING} (line_001): default values')],
)  # fmt: skip
def test_what_a_run_does_not_state_is_assumed_and_named(runs, tmp_path, capsys, record, sentence):
    """But a sound speed never is."""
    (runs / 'line_001' / 'run.json').unlink()
    if record:
        (runs / 'line_001' / 'run.json').write_text(record)
        assert run('export', runs / 'line_001', tmp_path / 'out.tif') == 0
        assert f'run.json does not state {LACKING}: default values' in capsys.readouterr().out
    assert run('survey', runs, tmp_path / 'out', '--resolution', 2) == 0
    assert sentence in capsys.readouterr().err and warnings_of(tmp_path / 'out') == [sentence]
    assert sentence in (tmp_path / 'out' / 'report.html').read_text()


@pytest.mark.parametrize('which', ['one', 'ping', 'end'])
def test_soundings_far_away_are_left_out_and_said(runs, tmp_path, capsys, which):
    """One of a ping, a ping, and the first pings: the navigation stood at 0, 0."""
    path = runs / 'line_001' / 'soundings.csv'
    head, *rows = (row.split(',') for row in path.read_text().splitlines())
    pings = sorted({row[0] for row in rows})
    far = {'one': (), 'ping': pings[len(pings) // 2 :][:1], 'end': pings[:3]}[which]
    chosen = [row for row in rows if row[0] in far] or [rows[len(rows) // 2]]
    for row in chosen:
        row[head.index('px')] = '3e6'
    path.write_text(''.join(','.join(row) + '\n' for row in [head, *rows]))
    assert run('survey', runs, tmp_path / 'out', '--resolution', 2) == 0
    said = f'{len(chosen)} soundings lie' if len(chosen) > 1 else '1 sounding lies'
    assert f'line_001: {said} far away and' in capsys.readouterr().err
    with rasterio.open(tmp_path / 'out' / 'survey.tif') as chart:
        assert max(chart.shape) < 2000
    assert run('export', runs / 'line_001', tmp_path / 'out.xyz') == 0
    assert f'{len(chosen)} far away left out' in capsys.readouterr().out
    assert len((tmp_path / 'out.xyz').read_text().splitlines()) == len(rows) - len(chosen)


def test_a_run_whose_table_is_gone_keeps_its_own_budget(tmp_path):
    """Its bag holds the soundings too; its run.json lies beside the bag."""
    table = tmp_path / 'line' / 'estimate' / 'estimate.mcap'
    table.parent.mkdir(parents=True)
    table.touch()
    for text, failure in ((changed(heave_std=0.5), ''), ('{', 'cannot be understood')):
        (tmp_path / 'line' / 'run.json').write_text(text)
        (source,) = sources_of(tmp_path)
        assert (source.name, source.table) == ('line', table)
        assert failure in source.failure and bool(failure) == bool(source.failure)
        assert failure or source.run['parameters']['heave_std'] == 0.5


def test_what_an_earlier_command_kept_may_be_damaged(good, tmp_path):
    out = tmp_path / 'out'
    assert run('survey', good, out, '--resolution', 2) == 0
    wanted = (out / 'survey.tif').read_bytes()
    for text in ('', '[]', '{}', '{"info": 3, "wanted": []}', '[' * 100_000):
        for kind in ('lines', 'soundings'):
            for path in (out / '.work' / kind).glob('*.json'):
                path.write_text(text)
        assert run('survey', good, out, '--resolution', 2, '--resume') == 0
        assert (out / 'survey.tif').read_bytes() == wanted


@pytest.mark.parametrize('marker', [True, False])
def test_an_earlier_survey_is_replaced_as_a_whole(good, tmp_path, monkeypatch, marker):
    out = tmp_path / 'out'
    assert run('survey', good, out, '--resolution', 2) == 0
    (out / 'mine.txt').write_text('mine')
    if not marker:  # of an older version
        (out / '.sonar_imm').unlink()
    before = contents(out)

    def broken(*_):
        raise OSError(28, 'No space left on device')

    with monkeypatch.context() as patches:
        patches.setattr('sonar_imm_tools.survey.products.write_report', broken)
        assert run('survey', good, out, '--resolution', 4, '--overwrite') == 2
    assert contents(out) == before and os.listdir(tmp_path) == ['out']
    assert run('survey', good, out, '--resolution', 4, '--overwrite') == 0
    assert run('survey', good, tmp_path / 'fresh', '--resolution', 4) == 0
    after, fresh = contents(out), contents(tmp_path / 'fresh')
    assert after.keys() == {*fresh, 'mine.txt'}
    assert after['survey.tif'] == fresh['survey.tif'] != before['survey.tif']


def test_a_folder_that_no_survey_made_is_not_replaced(good, tmp_path, capsys):
    out = tmp_path / 'out'
    for folder in ('tiles', '.work'):
        (out / folder).mkdir(parents=True)
    for name in ('tiles/L1_0_0.tif', '.work/thesis.tex', 'report.html', 'survey.json'):
        (out / name).write_text('mine')
    before = contents(out)
    for place, words, said in (
        (out, (), 'is there already'), (out, ('--resume',), 'no survey'),
        (out, ('--overwrite',), 'is no survey folder that sonar-imm made'),
        (good, ('--overwrite',), ''),
    ):  # fmt: skip
        assert run('survey', good, place, *words) == 2 and said in capsys.readouterr().err
    assert contents(out) == before


def test_tiles_that_lie_behind_a_link_stay(good, tmp_path, capsys):
    out, charts = tmp_path / 'out', tmp_path / 'charts'
    assert run('survey', good, out) == 0
    shutil.rmtree(out / 'tiles')
    charts.mkdir()
    (charts / 'L9_9_9.tif').write_text('mine')
    (out / 'tiles').symlink_to(charts)
    assert run('survey', good, out, '--resume') == 2
    assert 'tiles is a link' in capsys.readouterr().err
    assert run('survey', good, out, '--overwrite') == 0
    assert [path.name for path in charts.iterdir()] == ['L9_9_9.tif']
    assert (out / 'tiles').is_dir() and not (out / 'tiles').is_symlink()
