# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A recording of a stranger, played to a real node."""

from pathlib import Path
import shutil

import pytest

from sonar_imm_tools.cli.checking import play_recording

pytestmark = pytest.mark.system
BAGS = Path(__file__).resolve().parents[2] / 'bags'


def test_check_replaces_no_file_of_the_user(tmp_path):
    """A real node has `state_file`, and saves its state there when it ends."""
    victim = tmp_path / 'precious'
    victim.write_text('shopping list')
    shutil.copytree(BAGS / 'diver_table1', tmp_path / 'bag')
    (tmp_path / 'bag' / 'parameters.yaml').write_text(
        f'/**:\n  ros__parameters:\n    state_file: {victim}\n    model_set: heading_speed\n'
    )
    played = play_recording(tmp_path / 'bag', 'diver', tmp_path / 'runs', quiet=True)
    assert all(check.good for check in played.checks)
    assert victim.read_text() == 'shopping list'
    assert [path.name for path in tmp_path.glob('precious*')] == ['precious']
