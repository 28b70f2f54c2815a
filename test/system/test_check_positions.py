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

"""``check`` with positions from a vessel, a topic for each tag, and on Earth."""

import json

import pytest

pytest.importorskip('rclpy')

from sonar_imm.cli import main  # noqa: E402

pytestmark = pytest.mark.system


@pytest.mark.parametrize('scene', ['usbl', 'geodetic'])
def test_live_equals_offline(scene, tmp_path, capsys):
    bag = tmp_path / scene
    told = ['--scenario', scene, '--seed', '3', '--set', 'duration=20']
    assert main(['simulate', 'diver', str(bag), *told]) == 0
    capsys.readouterr()
    out = tmp_path / 'out'
    wanted = ['--bag', str(bag), '--limit', '3', '--out', str(out), '--json']
    assert main(['check', 'diver', *wanted]) == 0
    (outcome,) = json.loads(capsys.readouterr().out)
    assert outcome['good'] and len(outcome['checks']) == 4
    header = (out / scene / 'offline' / 'estimate.csv').read_text().splitlines()[0]
    assert ('latitude' in header) == (scene == 'geodetic')
