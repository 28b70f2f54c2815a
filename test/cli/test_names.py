# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Names that are not UTF-8, or that steer a terminal, in every command and all it writes; and a
recording of a stranger, whose parameters are data and name no file but those beside it."""

import json
import os
from pathlib import Path
import shutil
import subprocess
import sys

from helpers.dive_scenes import write_dive
from helpers.source import ROOT
import pytest
import yaml

from sonar_imm.node_config import node_config_type
from sonar_imm.parameters import ConfigError, parameters_from_yaml
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.obstacle.detector import DetectorConfig
from sonar_imm_tools.cli import main
from sonar_imm_tools.cli.common import load_config, node_file
from sonar_imm_tools.recordings.own_files import MOST_BYTES, OF_FRAMES, own_parameters
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sources import BagError, quoted

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
            {'.json': json.loads, '.yaml': yaml.safe_load}.get(path.suffix, str)(text)


def test_every_command_that_reads_takes_any_name(name, run, tmp_path):
    path, made = tmp_path / name, tmp_path / 'runs' / 'run'
    run('info', path)
    run('info', '--json', '--', name)
    run('track', '--parquet', path, made)
    run('track', '--overwrite', '--json', path, made)
    assert json.loads((made / 'run.json').read_text())['bag'] == str(path)
    run('evaluate', made)
    run('convert', 'fixes', tmp_path / 'csv' / name, 'fixes.bag')
    run('convert', '--', tmp_path / 'csv' / name, 'sniffed.bag', codes=(0, 2))
    with BagReader(Path('fixes.bag')) as bag:
        bag.custom_data['source'].encode()
    run('tune', path, '--parameters', 'no_such', codes=(2,))
    run('play', '--topics', name, '--', path, codes=(0, 1, 2))
    run('track', path, 'x', '--params', path, codes=(2,))
    texts_are_utf8(tmp_path)


def test_every_command_that_writes_takes_any_name(name, run, tmp_path):
    outs = tmp_path / 'outs'
    write_dive(tmp_path / 'dive.bag', count=20)
    run('convert', 'fixes', tmp_path / 'csv' / name, outs / name / 'under.bag')
    run('convert', 'fixes', tmp_path / 'csv' / name, tmp_path / 'bags' / name)
    run('info', tmp_path / 'bags' / name)
    run('track', tmp_path / 'dive.bag', outs / name)
    run('track', tmp_path / 'dive.bag', outs / name, '--overwrite', '--parquet')
    run('evaluate', outs / name)
    run('evaluate', outs / name, '--report', outs / f'{name}.html', codes=(0, 2))
    for kind in ('csv', 'kml', 'gpx', 'geojson', 'parquet'):
        file = outs / f'{name[:200]}.{kind}'
        run('export', outs / name, file, '--crs', '32632', '--origin', '500000,6000000')
        assert file.is_file()
    texts_are_utf8(tmp_path)


def test_names_of_things_that_are_not_there_are_one_sentence(name, run):
    here = Path('missing') / name
    for command in (
        ('info', here), ('track', here, 'out'), ('track', name, 'out', '--set', f'{name}=3'),
        ('track', name, 'out', '--topic', f'fix={name}'), ('convert', 'fixes', here, 'out.bag'),
        ('evaluate', here), ('export', here, f'{name[:200]}.csv'), ('export', here, name),
        ('survey', here, 'chart'), ('simulate', name), ('tune', here), ('play', here),
        ('simulate', 'diver', 'out.bag', '--scenario', name), ('check', 'diver', '--bag', here),
        ('check', name), ('view', here), (name,),
    ):  # fmt: skip
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
    ['info', bag + ' missing'],
):
    assert main(command) == 2 * ('missing' in command[-1]), command
"""


@pytest.mark.parametrize('locale', LOCALES.values(), ids=LOCALES)
def test_any_locale_will_do(tmp_path, locale):
    """A locale is that of a process."""
    bag = os.fsencode(tmp_path) + b'/dive\xff ' + 'Zoë 中'.encode()
    os.rename(write_dive(tmp_path / 'plain', count=20), bag)
    with open(bag + b'.txt', 'w', encoding='utf-8') as file:
        file.write(ROWS)
    plain = {k: v for k, v in os.environ.items() if not k.startswith(('LC_', 'LANG'))}
    command = [sys.executable, '-c', SESSION, bag]
    done = subprocess.run(command, env={**plain, **locale}, cwd=ROOT, capture_output=True)
    assert done.returncode == 0, done.stderr.decode('utf-8', 'replace')
    encoding = 'ascii' if locale.get('PYTHONUTF8') == '0' else 'utf-8'
    (done.stdout + done.stderr).decode(encoding)
    texts_are_utf8(tmp_path)


def test_the_command_that_is_suggested_can_be_pasted():
    for name in (b'dive\xff', b"it's", b'a\nb', b'\x1b[31m\\', 'Zoë'.encode(), b'my dive.bag'):
        word = quoted(os.fsdecode(name), windows=False)
        word.encode()
        said = subprocess.run(['bash', '-c', f'printf %s {word}'], capture_output=True, check=True)
        assert said.stdout == name
    assert quoted('dive.bag', windows=False) == quoted('dive.bag', windows=True) == 'dive.bag'
    assert quoted('my dive.bag', windows=True) == '"my dive.bag"'
    assert quoted('C:\\dives\\a.bag', windows=True) == 'C:\\dives\\a.bag'


BAGS = Path(__file__).resolve().parents[2] / 'bags'
TABLE = 'range,probability\n0,0.9\n100,0.5\n'


@pytest.fixture
def bag(tmp_path):
    """A recording of divers, with a file of parameters by `state`."""
    shutil.copytree(BAGS / 'diver_table1', tmp_path / 'bag')
    return tmp_path / 'bag'


def state(bag, *lines, node='diver'):
    text = ''.join(f'    {line}\n' for line in lines)
    (bag / 'parameters.yaml').write_text(f'{node}:\n  ros__parameters:\n{text}')
    return own_parameters(bag)


def config_of(own):
    return load_config(SYSTEMS['diver'], own, {})


@pytest.mark.parametrize('node', ['diver', '/**', '/auv/diver'])
def test_a_recording_keeps_no_files_and_changes_no_node(bag, node, capsys):
    lines = 'state_file: /etc/passwd', 'stale_after: 1.0', 'fix_std: 2.5', 'frame_id: sea'
    tracker, settings = config_of(state(bag, *lines, node=node))
    assert (tracker.fix_std, settings.frame_id) == (2.5, 'sea')
    assert settings.state_file == '' and settings.stale_after != 1.0
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2 and "'state_file' is not used" in lines[0]
    # The command says it once.
    state(bag, 'state_file: /etc/passwd', node=node)
    assert main(['track', str(bag), str(bag.parent / 'run')]) == 0
    assert capsys.readouterr().err.count("'state_file' is not used") == 1


@pytest.mark.parametrize('system', SYSTEMS)
def test_only_parameters_of_the_tracker_and_of_frames_are_taken(bag, system):
    """Whatever parameters a node will get one day: a recording sets none of them."""
    config, node = SYSTEMS[system].config_type(), node_config_type(SYSTEMS[system])
    tracker = {spec.name for spec in config.specs()}
    for spec in node.specs():
        value = list(spec.default) if isinstance(spec.default, tuple) else spec.default
        own = state(bag, f'{spec.name}: {json.dumps(value)}', node=system)
        with node_file(SYSTEMS[system], own) as path:
            given = parameters_from_yaml(path.read_text(), node_name=system)
        assert set(given) <= tracker | {*OF_FRAMES}, spec.name
    files = {s.name for s in (*config.specs(), *node.specs()) if 'file' in s.name.split('_')}
    assert all(name.endswith('_file') for name in files)
    assert not any('_file' in spec.name for spec in DetectorConfig.specs())


HOSTILE = [
    '../secret.csv', '/dev/zero', '~/.bashrc', '.', 'nothing.csv', 'a\\0b', 'x' * 5000, 'link.csv',
    'there/secret.csv', 'large.csv', 'pipe.csv', 'zero.csv', '{}/secret.csv',
]  # fmt: skip


@pytest.mark.parametrize('name', HOSTILE)
def test_a_file_that_a_recording_names_lies_beside_it(bag, tmp_path, name, capsys):
    (tmp_path / 'secret.csv').write_text(TABLE)
    (bag / 'large.csv').write_bytes(b'0' * (MOST_BYTES + 1))
    os.mkfifo(bag / 'pipe.csv')
    for link, place in (('link.csv', '../secret.csv'), ('there', '..'), ('zero.csv', '/dev/zero')):
        (bag / link).symlink_to(place)
    name = name.format(tmp_path)
    tracker, _ = config_of(state(bag, f'coverage_file: "{name}"', 'fix_std: 2.5'))
    assert (tracker.coverage_file, tracker.fix_std) == ('', 2.5)
    assert capsys.readouterr().err.count("'coverage_file' is not used: ") == 1


def test_a_file_beside_the_recording_is_used(bag, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (bag / 'beam.csv').write_text(TABLE)
    (bag / 'other.csv').symlink_to('beam.csv')
    own = state(bag, 'coverage_file: beam.csv', 'sensors: [a, b]', 'b: {coverage_file: other.csv}')
    tracker, _ = config_of(own)
    assert tracker.coverage_file == str(bag.resolve() / 'beam.csv')
    assert tracker.own == (('b.coverage_file', str(bag.resolve() / 'beam.csv')),)
    SYSTEMS['diver'].build(tracker)


def test_what_the_user_names_is_trusted(tmp_path, capsys):
    beam, file = tmp_path / 'beam.csv', tmp_path / 'mine.yaml'
    beam.write_text(TABLE)
    file.write_text(f'coverage_file: {beam}\nstate_file: s\n')
    tracker, node = load_config(SYSTEMS['diver'], file, {'stale_after': '7.0'})
    assert tracker.coverage_file == str(beam)
    assert (node.state_file, node.stale_after) == ('s', 7.0)
    assert capsys.readouterr().err == ''


@pytest.mark.parametrize('kind', ['link', 'large', 'misspelt'])
def test_a_parameter_file_that_is_none_is_refused(bag, tmp_path, kind):
    own = state(bag, 'fix_stdd: 2.5')
    if kind == 'link':
        shutil.move(own.path, tmp_path / 'elsewhere.yaml')
        own.path.symlink_to(tmp_path / 'elsewhere.yaml')
    elif kind == 'large':
        own.path.write_text('#' * (MOST_BYTES + 1))
    with pytest.raises(ConfigError, match='outside of the folder|has more than|did you mean'):
        config_of(own)


@pytest.mark.parametrize('name', ['metadata.yaml', 'more.mcap', 'more.db3', 'more.mcap.zstd'])
def test_a_pipe_in_a_recording_is_not_opened(bag, name):
    """What is beside it is read."""
    (bag / name).unlink(missing_ok=True)
    os.mkfifo(bag / name)
    with BagReader(bag) as reader:
        assert sum(1 for _ in reader.messages()) > 100
        assert any('is no regular file' in sentence for sentence in reader.problems)
    with pytest.raises(BagError, match='is no regular file'), BagReader(bag, strict=True):
        pass


@pytest.mark.parametrize('name', ['pipe', '../elsewhere.mcap', '{}/elsewhere.mcap'])
def test_a_recording_that_is_a_pipe_or_lies_outside_of_its_folder_is_not_opened(
    bag, tmp_path, name
):
    (bag / 'diver_table1.mcap').rename(tmp_path / 'elsewhere.mcap')
    text = (bag / 'metadata.yaml').read_text()
    named = text.replace('diver_table1.mcap', name.format(tmp_path))
    (bag / 'metadata.yaml').write_text(named)
    os.mkfifo(tmp_path / 'pipe.mcap')
    place = tmp_path / 'pipe.mcap' if name == 'pipe' else bag
    with pytest.raises(BagError), BagReader(place):
        pass
