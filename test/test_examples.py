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

"""The examples run as they are, without ROS, and draw what they say."""

import ast
import os
from pathlib import Path
import subprocess
import sys

from helpers.source import ROOT
import pytest

from sonar_imm.trackers import SYSTEMS

EXAMPLES = sorted((ROOT / 'examples').glob('*.py'))
MOST_LINES = 30
WITHOUT_ROS = """
import runpy, sys
sys.modules.update(rclpy=None, sensor_msgs=None, rosbags=None)
runpy.run_path(sys.argv[1], run_name='__main__')
"""

if not EXAMPLES:
    pytest.skip('these tests read the source tree', allow_module_level=True)


def test_there_is_one_for_each_system():
    assert [path.stem for path in EXAMPLES] == sorted(SYSTEMS)


@pytest.mark.parametrize('path', EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs_without_ros_and_writes_a_plot(path: Path, tmp_path):
    done = subprocess.run(
        [sys.executable, '-c', WITHOUT_ROS.replace('sys.argv[1]', repr(str(path)))],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=dict(os.environ, PYTHONPATH=str(ROOT)),
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count('\n') == 1 and any(letter.isdigit() for letter in done.stdout)
    page = (tmp_path / f'{path.stem}.html').read_text(encoding='utf-8')
    assert page.count('"type":"scatter"') >= 2 and 'Plotly.newPlot' in page


@pytest.mark.parametrize('path', EXAMPLES, ids=lambda path: path.stem)
def test_an_example_is_short(path: Path):
    text = path.read_text(encoding='utf-8')
    (_, *code) = ast.parse(text).body
    lines = text.splitlines()[code[0].lineno - 1 :]
    assert sum(bool(line.strip()) for line in lines) <= MOST_LINES
