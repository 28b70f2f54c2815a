# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The command line as a user meets it: help, exit codes, one line and no traceback."""

from importlib.util import find_spec
import os
from pathlib import Path
import shutil
import subprocess
import sys

import pytest

from sonar_imm import __version__
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.cli import COMMANDS, main

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize('arguments', [[], ['--help'], ['-h']])
def test_help_lists_every_command(arguments, capsys):
    assert main(arguments) == 0
    printed = capsys.readouterr().out
    assert all(f'  {name} ' in printed for name in COMMANDS)


def test_help_fits_a_screen_of_24_lines_and_80_columns(monkeypatch, capsys):
    monkeypatch.setenv('COLUMNS', '80')
    assert main(['--help']) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) < 24 and max(map(len, lines)) <= 80  # the prompt takes one line
    assert '--version' in lines[0]


@pytest.mark.parametrize('name', list(COMMANDS))
def test_every_command_has_help(name, capsys):
    assert main([name, '--help']) == 0
    printed = capsys.readouterr().out
    assert f'Usage: sonar-imm {name}' in printed
    if name != 'convert':
        assert f'Example:\n    sonar-imm {name}' in printed


@pytest.mark.parametrize('kind', ['fixes', 'arrivals', 'truth', 'xtf'])
def test_every_kind_of_conversion_has_help(kind, capsys):
    assert main(['convert', kind, '--help']) == 0
    assert f'Example:\n    sonar-imm convert {kind}' in capsys.readouterr().out


def test_version(capsys):
    assert main(['--version']) == 0
    assert __version__ in capsys.readouterr().out


def test_help_loads_no_heavy_module():
    code = (
        "import sys; from sonar_imm_tools.cli import main; main(['--help']); "
        "print([name for name in ('numpy', 'scipy', 'rosbags', 'numba', 'plotly', 'rclpy', "
        "'rich') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, '-c', code], text=True, capture_output=True, cwd=ROOT)
    assert done.stdout.splitlines()[-1] == '[]'


@pytest.mark.parametrize(
    'arguments, words',
    [
        (['trakc'], "there is no command 'trakc' (did you mean 'track'?)"),
        (['--bad'], '--bad'),
        (['track'], "Missing argument 'BAG...'"),
        (['track', 'dive.bag'], "Missing argument 'OUT_DIR': where the estimates of dive.bag go"),
        (['track', 'nowhere.bag', 'out'], 'nowhere.bag does not exist'),
        (['info', 'nowhere.bag'], 'nowhere.bag does not exist'),
        (['evaluate', 'nowhere'], 'holds no finished run'),
        (['track', 'b', 'o', '--set', 'speed_mean'], "'speed_mean' is not of the form NAME=VALUE"),
        (['track', 'b', 'o', '--topic', 'fix'], "'fix' is not of the form INPUT=TOPIC"),
        (['track', 'b', 'o', '--system', 'divers'], "'divers'"),
        (['simulate', 'diver'], "Missing argument 'OUT_BAG'"),
        (['simulate', 'diver', 'b', '--scenario', 'tabel1'], "did you mean 'table1'?"),
        (
            ['simulate', 'diver', 'b', '--set', 'speed=fast'],
            "'speed' must be a number, got 'fast'",
        ),
        (['convert', 'fixes', 'nowhere.csv', 'b'], 'nowhere.csv'),
        (['convert', 'fixes', 'a', 'b', '--origin', '5'], "'5' is not of the form LAT,LON"),
        (['convert', 'fixes', 'a', 'b', '--time-offset', 'x'], 'not a number of seconds'),
        (['convert', 'arrivals', 'a', 'b'], "Missing option '--receivers'"),
        (['check', 'dvier'], "'dvier'"),
    ],
)
def test_mistakes_end_in_one_line_and_exit_code_2(arguments, words, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == ''
    assert len(printed.err.splitlines()) == 1 and printed.err.startswith('sonar-imm: ')
    assert words in printed.err


@pytest.mark.parametrize(
    'arguments',
    [
        ['track', 'BAG', 'out', '--params', '/dev/zero'],
        ['tune', 'BAG', '--params', '/dev/zero'],
        pytest.param(
            ['play', 'BAG', '--qos-profile-overrides-path', '/dev/zero'],
            marks=pytest.mark.skipif(find_spec('rclpy') is None, reason='needs rclpy'),
        ),
        ['info', 'folder'],
    ],
)
def test_parameters_and_metadata_without_an_end_are_not_read_to_it(arguments, tmp_path, capsys):
    shutil.copytree(ROOT / 'bags' / 'diver_table1', tmp_path / 'folder')
    (tmp_path / 'folder' / 'metadata.yaml').unlink()
    (tmp_path / 'folder' / 'metadata.yaml').symlink_to('/dev/zero')
    places = {'BAG': ROOT / 'bags' / 'diver_table1', 'folder': tmp_path / 'folder'}
    places['out'] = tmp_path / 'out'
    code = main([str(places.get(word, word)) for word in arguments])
    printed = capsys.readouterr()
    assert code == (0 if 'folder' in arguments else 2) and 'YAML' in printed.out + printed.err


def test_convert_alone_lists_what_it_reads(capsys):
    assert main(['convert']) == 0
    printed = capsys.readouterr()
    assert not printed.err and all(f'\n  {kind} ' in printed.out for kind in ('fixes', 'segy'))


def test_a_bug_is_not_hidden(monkeypatch):
    from sonar_imm_tools.cli import info

    def broken(*arguments, **options):
        raise RuntimeError('a bug')

    monkeypatch.setattr(info, 'progress', broken)
    monkeypatch.setattr(
        'sonar_imm_tools.recordings.reader.BagReader.__enter__',
        lambda self: (_ for _ in ()).throw(RuntimeError('a bug')),
    )
    with pytest.raises(RuntimeError, match='a bug'):
        main(['info', 'x.bag'])


def test_a_package_that_is_not_there_is_named(monkeypatch, capsys):
    def absent(self):
        raise ModuleNotFoundError("No module named 'rclpy'", name='rclpy')

    monkeypatch.setattr('sonar_imm_tools.recordings.reader.BagReader.__enter__', absent)
    assert main(['info', 'x.bag']) == 2
    assert 'sonar_imm[ros]' in capsys.readouterr().err


def test_a_name_that_a_library_cannot_take_is_told(monkeypatch, capsys):
    def encoded(self):
        'dive\udcff'.encode()

    monkeypatch.setattr('sonar_imm_tools.recordings.reader.BagReader.__enter__', encoded)
    assert main(['info', 'x.bag']) == 2
    assert r'dive\udcff is not UTF-8' in capsys.readouterr().err


def test_ctrl_c_is_clean(monkeypatch, capsys):
    def interrupted(self):
        raise KeyboardInterrupt

    monkeypatch.setattr('sonar_imm_tools.recordings.reader.BagReader.__enter__', interrupted)
    assert main(['info', 'x.bag']) == 130
    assert 'Traceback' not in capsys.readouterr().err


@pytest.mark.skipif(sys.platform == 'win32', reason='pipes end otherwise there')
def test_a_reader_that_goes_away_is_no_trouble():
    process = subprocess.Popen(
        [sys.executable, '-m', 'sonar_imm_tools.cli', 'simulate', 'diver', '--list'],
        env=dict(os.environ, PYTHONPATH=str(ROOT)),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    process.stdout.close()
    assert process.wait(600) == 141
    assert b'Traceback' not in process.stderr.read()
    process.stderr.close()


def test_help_is_fast():
    """In seconds of work, however busy the machine is."""
    resource = pytest.importorskip('resource')
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    command = [sys.executable, '-m', 'sonar_imm_tools.cli', '--help']
    assert subprocess.run(command, capture_output=True, cwd=ROOT).returncode == 0
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 2.0


ENDED = """
import signal
from sonar_imm_tools import cli

class Half:
    def __init__(self):
        cli._leave(signal.SIGTERM, None)
        self.name = 'made'

    def __del__(self):
        print(self.name)

class Wrong:
    def __del__(self):
        raise ValueError('this one is told')

try:
    Half()
finally:
    Wrong()
"""


def test_what_a_signal_leaves_half_made_is_no_traceback():
    done = subprocess.run([sys.executable, '-c', ENDED], capture_output=True, text=True)
    assert done.returncode == 143 and 'this one is told' in done.stderr
    assert 'AttributeError' not in done.stderr and 'Half' not in done.stderr


def test_parameters_of_the_detector_come_from_a_file_the_command_or_both(tmp_path):
    from sonar_imm_tools.cli.common import load_detector

    path = tmp_path / 'parameters.yaml'
    path.write_text('fls_detector:\n  ros__parameters:\n    min_range: 15.0\n')
    obstacle, diver = SYSTEMS['obstacle'], SYSTEMS['diver']
    asked = {'max_detections': '7', 'history': '1.0'}  # the second is no parameter of it
    assert load_detector(obstacle, None, {}) == {}
    assert load_detector(obstacle, path, {}) == {'min_range': 15.0}
    assert load_detector(obstacle, None, asked) == {'max_detections': 7}
    both = load_detector(obstacle, path, {**asked, 'min_range': '16'})
    assert both == {'max_detections': 7, 'min_range': 16.0}
    assert load_detector(diver, path, asked) == {}
