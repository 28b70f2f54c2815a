# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``sonar-imm warm``."""

from pathlib import Path
import re

from sonar_imm_tools.cli import main
from sonar_imm_tools.cli.check import _small_ones_first


def test_a_system_is_compiled_once(capsys):
    assert main(['warm', 'fathometer']) == 0
    first = capsys.readouterr().out
    assert main(['warm', 'fathometer']) == 0
    again = 'fathometer: nothing to compile\n'
    assert first == again or re.match(r'fathometer: \d kernels compiled, \d loaded, ', first)
    assert capsys.readouterr().out == again


def test_parameters_belong_to_one_system(capsys):
    assert main(['warm', '--set', 'sound_speed=1480']) == 2
    assert 'need exactly one system' in capsys.readouterr().err


def test_a_tracker_of_numpy_has_no_kernels(capsys):
    assert main(['warm', 'obstacle']) == 0
    assert capsys.readouterr().out == 'obstacle: nothing to compile\n'


def test_the_smallest_recording_of_each_system_is_first(tmp_path):
    sizes = {'a1': 30, 'a2': 10, 'b1': 20, 'a3': 50}
    for name, size in sizes.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / 'data').write_bytes(bytes(size))
    todo = [(Path(tmp_path / name), name[0]) for name in sizes]
    order, first = _small_ones_first(todo)
    assert [todo[i][0].name for i in order] == ['a2', 'b1', 'a3', 'a1'] and first == 2
