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
from sonar_imm_tools.cli.common import load_detector

ROOT = Path(__file__).resolve().parents[2]


def test_help_lists_every_command_on_a_screen_of_24_lines_and_80_columns(monkeypatch, capsys):
    monkeypatch.setenv('COLUMNS', '80')
    for arguments in ([], ['--help'], ['-h']):
        assert main(arguments) == 0
        printed = capsys.readouterr().out
        assert all(f'  {name} ' in printed for name in COMMANDS)
        lines = printed.splitlines()
        assert len(lines) < 24 and max(map(len, lines)) <= 80  # the prompt takes one line
        assert '--version' in lines[0]
    assert main(['--version']) == 0
    assert __version__ in capsys.readouterr().out


KINDS = ('fixes', 'arrivals', 'truth', 'xtf')


@pytest.mark.parametrize('name', [*COMMANDS, *(f'convert {kind}' for kind in KINDS)])
def test_every_command_and_kind_of_conversion_has_help(name, capsys):
    assert main([*name.split(), '--help']) == 0
    printed = capsys.readouterr().out
    assert f'Usage: sonar-imm {name}' in printed
    if name != 'convert':
        assert f'Example:\n    sonar-imm {name}' in printed
        return
    assert main(['convert']) == 0  # lists what it reads
    printed = capsys.readouterr()
    assert not printed.err and all(f'\n  {kind} ' in printed.out for kind in ('fixes', 'segy'))


def test_help_is_fast_and_loads_no_heavy_module():
    """In seconds of work, however busy the machine is."""
    resource = pytest.importorskip('resource')
    code = (
        "import sys; from sonar_imm_tools.cli import main; main(['--help']); "
        "print([name for name in ('numpy', 'scipy', 'rosbags', 'numba', 'plotly', 'rclpy', "
        "'rich') if name in sys.modules])"
    )
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    done = subprocess.run([sys.executable, '-c', code], text=True, capture_output=True, cwd=ROOT)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    assert done.returncode == 0 and done.stdout.splitlines()[-1] == '[]'
    assert after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime < 2.0


def test_mistakes_end_in_one_line_and_exit_code_2(capsys, tmp_path, monkeypatch):
    for arguments, words in (
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
        (['simulate', 'diver', 'b', '--set', 'speed=fast'], "'speed' must be a number, got 'f"),
        (['convert', 'fixes', 'nowhere.csv', 'b'], 'nowhere.csv'),
        (['convert', 'fixes', 'a', 'b', '--origin', '5'], "'5' is not of the form LAT,LON"),
        (['convert', 'fixes', 'a', 'b', '--time-offset', 'x'], 'not a number of seconds'),
        (['convert', 'arrivals', 'a', 'b'], "Missing option '--receivers'"),
        (['convert', 'nothing.csv', 'out'], 'nothing.csv does not exist'),
        (['convert', 'fixess', 'out'], "Did you mean 'fixes'"),
        (['convert', str(ROOT / 'bags' / 'diver_table1'), 'out'], 'is a recording already'),
        (['check', 'dvier'], "'dvier'"),
        (['view'], "Missing argument 'RESULTS|BAG'"),
        (['view', 'nowhere.bag'], 'nowhere.bag'),
    ):
        monkeypatch.chdir(tmp_path)
        assert main(arguments) == 2
        printed = capsys.readouterr()
        assert printed.out == ''
        assert len(printed.err.splitlines()) == 1 and printed.err.startswith('sonar-imm: ')
        assert words in printed.err


ENDLESS = ['track BAG out --params /dev/zero', 'tune BAG --params /dev/zero', 'info folder']
if find_spec('rclpy'):
    ENDLESS.append('play BAG --qos-profile-overrides-path /dev/zero')


@pytest.mark.parametrize('words', ENDLESS)
def test_parameters_and_metadata_without_an_end_are_not_read_to_it(
    words, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(ROOT / 'bags' / 'diver_table1', 'folder')
    Path('folder', 'metadata.yaml').unlink()
    Path('folder', 'metadata.yaml').symlink_to('/dev/zero')
    code = main(words.replace('BAG', str(ROOT / 'bags' / 'diver_table1')).split())
    printed = ''.join(capsys.readouterr())
    assert code == (0 if 'folder' in words else 2) and 'YAML' in printed


@pytest.fixture
def reading(monkeypatch):
    """The code of a command whose recording raises an error."""

    def fail(error):
        def enter(self):
            raise error

        monkeypatch.setattr('sonar_imm_tools.recordings.reader.BagReader.__enter__', enter)
        return main(['info', 'x.bag'])

    return fail


def test_what_is_missing_what_a_library_cannot_take_ctrl_c_and_a_bug(reading, capsys):
    for error, code, said in (
        (ModuleNotFoundError("No module named 'rclpy'", name='rclpy'), 2, 'sonar_imm[ros]'),
        (UnicodeEncodeError('utf-8', 'dive\udcff', 4, 5, 'x'), 2, r'dive\udcff is not UTF-8'),
        (KeyboardInterrupt(), 130, ''),
    ):
        assert reading(error) == code
        errors = capsys.readouterr().err
        assert said in errors and 'Traceback' not in errors
    with pytest.raises(RuntimeError, match='a bug'):
        reading(RuntimeError('a bug'))


@pytest.mark.skipif(sys.platform == 'win32', reason='pipes end otherwise there')
def test_a_reader_that_goes_away_is_no_trouble():
    with subprocess.Popen(
        [sys.executable, '-m', 'sonar_imm_tools.cli', 'simulate', 'diver', '--list'],
        env=dict(os.environ, PYTHONPATH=str(ROOT)), stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    ) as process:  # fmt: skip
        process.stdout.close()
        assert process.wait(600) == 141 and b'Traceback' not in process.stderr.read()


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
    path = tmp_path / 'parameters.yaml'
    path.write_text('fls_detector:\n  ros__parameters:\n    min_range: 15.0\n')
    asked = {'max_detections': '7', 'history': '1.0'}  # the second is no parameter of it
    both = {'max_detections': 7, 'min_range': 16.0}
    for system, file, given, found in (
        ('obstacle', None, {}, {}), ('obstacle', path, {}, {'min_range': 15.0}),
        ('obstacle', None, asked, {'max_detections': 7}),
        ('obstacle', path, {**asked, 'min_range': '16'}, both), ('diver', path, asked, {}),
    ):  # fmt: skip
        assert load_detector(SYSTEMS[system], file, given) == found
