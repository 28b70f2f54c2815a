# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Names that are not UTF-8, or that steer a terminal, in every command and all it writes."""

import json
import os
from pathlib import Path
import subprocess
import sys

from helpers.dive_bags import write_dive
from helpers.source import ROOT
import pytest
import yaml

from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sources import quoted

NAMES = {
    'not UTF-8, lines, quotes': 'dive\udcff\udcfe a\nb\r"\'`$(x) & <b>.bag',
    'dash, escapes': '-\x1b[31mred\x07\x9b2J\u202e [bold]',
    'longest': 'x' * 255,
}
ROWS = 'time,x,y,z\n' + ''.join(f'{1700000000 + k},{0.5 * k},{0.3 * k},0\n' for k in range(20))
TEXTS = ('.json', '.csv', '.html', '.kml', '.gpx', '.geojson', '.yaml')


@pytest.fixture(params=NAMES.values(), ids=NAMES)
def name(request, tmp_path, monkeypatch):
    """A name; the current folder has a recording of that name, and a CSV file."""
    monkeypatch.chdir(tmp_path)
    write_dive(Path('plain'), count=20)
    os.rename('plain', request.param)
    Path('csv').mkdir()
    (Path('csv') / request.param).write_text(ROWS)
    return request.param


@pytest.fixture
def run(capsys):
    """Runs a command; gives its output once that is checked."""

    def call(*arguments, codes=(0,)):
        code = main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        assert code in codes, (arguments, code, err)
        (out + err).encode()
        assert not set(out + err) & set('\x1b\x07\x9b\u202e\r'), ascii(out + err)
        assert 'Traceback' not in err
        if code == 2:
            assert err.startswith('sonar-imm: ') and err.count('\n') == 1, err
        if '--json' in arguments and code != 2:
            json.loads(out)
        return out + err

    return call


def texts_are_utf8(folder):
    for path in folder.rglob('*'):
        if path.is_file() and path.suffix in TEXTS:
            text = path.read_bytes().decode('utf-8')
            if path.suffix == '.json':
                json.loads(text)
            elif path.suffix == '.yaml':
                yaml.safe_load(text)


def test_every_command_that_reads_takes_any_name(name, run, tmp_path):
    path = tmp_path / name
    run('info', path)
    run('info', '--json', '--', name)
    run('track', '--parquet', path, tmp_path / 'runs' / 'run')
    run('track', '--overwrite', '--json', path, tmp_path / 'runs' / 'run')
    assert json.loads((tmp_path / 'runs' / 'run' / 'run.json').read_text())['bag'] == str(path)
    run('evaluate', tmp_path / 'runs' / 'run')
    run('convert', 'fixes', tmp_path / 'csv' / name, 'fixes.bag')
    run('convert', '--', tmp_path / 'csv' / name, 'sniffed.bag', codes=(0, 2))
    with BagReader(Path('fixes.bag')) as bag:
        bag.custom_data['source'].encode()
    run('tune', path, '--parameters', 'no_such', codes=(2,))
    run('play', '--topics', name, '--', path, codes=(0, 1, 2))
    run('track', path, 'x', '--params', path, codes=(2,))
    texts_are_utf8(tmp_path)


def test_every_command_that_writes_takes_any_name(name, run, tmp_path):
    out = tmp_path / 'outs' / name
    write_dive(tmp_path / 'dive.bag', count=20)
    codes = (2,) if len(name) == 255 else (0,)
    run('convert', 'fixes', tmp_path / 'csv' / name, out / 'under.bag')
    run('convert', 'fixes', tmp_path / 'csv' / name, tmp_path / 'bags' / name)
    run('info', tmp_path / 'bags' / name)
    run('track', tmp_path / 'dive.bag', out)
    run('track', tmp_path / 'dive.bag', out, '--overwrite', '--parquet')
    run('evaluate', out)
    run('evaluate', out, '--report', tmp_path / 'outs' / f'{name}.html', codes=(*codes, 0, 2))
    for kind in ('csv', 'kml', 'gpx', 'geojson', 'parquet'):
        place = ('--crs', '32632', '--origin', '500000,6000000')
        run('export', out, f'outs/{name[:200]}.{kind}', *place)
        assert (tmp_path / 'outs' / f'{name[:200]}.{kind}').is_file()
    texts_are_utf8(tmp_path)


def test_names_of_things_that_are_not_there_are_one_sentence(name, run):
    here = Path('missing') / name
    for command in (
        ('info', here),
        ('track', here, 'out'),
        ('track', name, 'out', '--set', f'{name}=3'),
        ('track', name, 'out', '--topic', f'fix={name}'),
        ('convert', 'fixes', here, 'out.bag'),
        ('evaluate', here),
        ('export', here, f'{name[:200]}.csv'),
        ('export', here, name),
        ('survey', here, 'chart'),
        ('simulate', name),
        ('simulate', 'diver', 'out.bag', '--scenario', name),
        ('tune', here),
        ('play', here),
        ('check', 'diver', '--bag', here),
        ('check', name),
        ('view', here),
        (name,),
    ):
        run(*command, codes=(2,))


LOCALES = {
    'C without UTF-8 mode': {'LC_ALL': 'C', 'PYTHONUTF8': '0', 'PYTHONCOERCECLOCALE': '0'},
    'ASCII': {'LC_ALL': 'C', 'PYTHONUTF8': '0', 'PYTHONIOENCODING': 'ascii'},
    'strict': {'PYTHONIOENCODING': 'utf-8:strict'},
}
SESSION = """
import sys
from sonar_imm_tools.cli import main
bag = sys.argv[1]
for command in (
    ['info', bag], ['info', '--json', bag], ['track', bag, bag + ' run'],
    ['evaluate', bag + ' run'], ['evaluate', '--json', bag + ' run'],
    ['export', bag + ' run', bag + '.csv'],
    ['convert', 'fixes', bag + '.txt', bag + ' made'], ['info', bag + ' made'],
    ['simulate', 'diver', '--list'], ['track', '--help'], ['play', '--help'], ['echo', '--help'],
):
    code = main(command)
    assert code == 0, (command, code)
assert main(['info', bag + ' missing']) == 2
"""


@pytest.mark.parametrize('locale', LOCALES.values(), ids=LOCALES)
def test_any_locale_will_do(tmp_path, locale):
    """A locale is that of a process."""
    bag = os.fsencode(tmp_path) + b'/dive\xff ' + 'Zoë 中'.encode()
    write_dive(tmp_path / 'plain', count=20)
    os.rename(os.fsencode(tmp_path / 'plain'), bag)
    with open(bag + b'.txt', 'w', encoding='utf-8') as file:
        file.write(ROWS)
    environment = {k: v for k, v in os.environ.items() if not k.startswith(('LC_', 'LANG'))}
    done = subprocess.run(
        [sys.executable, '-c', SESSION, bag], env={**environment, **locale}, cwd=ROOT,
        capture_output=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr.decode('utf-8', 'replace')
    encoding = 'ascii' if locale.get('PYTHONUTF8') == '0' else 'utf-8'
    (done.stdout + done.stderr).decode(encoding)
    texts_are_utf8(tmp_path)


def test_the_command_that_is_suggested_can_be_pasted(tmp_path):
    for name in (b'dive\xff', b"it's", b'a\nb', b'\x1b[31m\\', 'Zoë'.encode()):
        word = quoted(os.fsdecode(name), windows=False)
        word.encode()
        said = subprocess.run(['bash', '-c', f'printf %s {word}'], capture_output=True, check=True)
        assert said.stdout == name
