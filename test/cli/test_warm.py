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

"""``sonar-imm warm``, and what ``track`` says while it compiles."""

from pathlib import Path

import pytest

from sonar_imm.estimation import jit
from sonar_imm_tools.cli import common, main
from sonar_imm_tools.cli.check import _small_ones_first


def test_a_system_is_compiled_and_the_next_time_it_is_there(capsys):
    assert main(['warm', 'bathymetry']) == 0
    capsys.readouterr()
    assert main(['warm', 'bathymetry']) == 0
    output = capsys.readouterr().out
    assert output.startswith('bathymetry: 0 kernels compiled, ')
    assert int(output.split(', ')[1].split()[0]) > 0


def test_parameters_belong_to_one_system(capsys):
    assert main(['warm', '--set', 'sound_speed=1480']) == 2
    assert 'need exactly one system' in capsys.readouterr().err


@pytest.mark.parametrize('compiles', [False, True])
def test_a_kernel_that_is_compiled_is_said_beside_the_progress(compiles, capsys, monkeypatch):
    monkeypatch.setattr(common, 'SECONDS_BETWEEN_LINES', -1.0)

    @jit.kernel
    def tripled(x):
        return 3.0 * x

    tripled._cache.flush()
    monkeypatch.setattr(jit, 'present', {})
    jit.expect((4, 3))
    with common.progress('tracking', 10, compiles=compiles) as advance:
        assert tripled(2.0) == 6.0
        advance(4)
    first, *rest = capsys.readouterr().err.splitlines()
    progress = ['compiling 2 of 4 kernels, once for this machine, some 0 s more']
    assert [first, *rest] == [*(progress if compiles else []), 'tracking: 4 of 10']
    assert jit.listeners == []


def test_the_smallest_recording_of_each_system_is_first(tmp_path):
    sizes = {'a1': 30, 'a2': 10, 'b1': 20, 'a3': 50}
    for name, size in sizes.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / 'data').write_bytes(bytes(size))
    todo = [(Path(tmp_path / name), name[0]) for name in sizes]
    order, first = _small_ones_first(todo)
    assert [todo[i][0].name for i in order] == ['a2', 'b1', 'a3', 'a1'] and first == 2
