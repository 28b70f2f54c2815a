# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The examples run as they are, without ROS, and draw what they say."""

import ast
import json
import os
import re
import subprocess
import sys

from helpers.source import ROOT
import pytest

from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.own_models import BehaviourStep, checked

EXAMPLES = sorted((ROOT / 'examples').glob('*.py'))
NOTEBOOKS = sorted((ROOT / 'examples').glob('*.ipynb'))
MOST_LINES = 30
WITHOUT_ROS = """
import runpy, sys
sys.modules.update(rclpy=None, sensor_msgs=None, rosbags=None)
runpy.run_path(sys.argv[1], run_name='__main__')
"""

if not EXAMPLES:
    pytest.skip('these tests read the source tree', allow_module_level=True)


@pytest.mark.parametrize('path', EXAMPLES, ids=lambda path: path.stem)
def test_an_example_runs_without_ros_and_writes_a_plot(path, tmp_path):
    done = subprocess.run(
        [sys.executable, '-c', WITHOUT_ROS.replace('sys.argv[1]', repr(str(path)))],
        capture_output=True, text=True, cwd=tmp_path, env=dict(os.environ, PYTHONPATH=str(ROOT)),
        timeout=600,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.count('\n') == 1 and any(letter.isdigit() for letter in done.stdout)
    text = path.read_text(encoding='utf-8')
    begin = ast.parse(text).body[1].lineno  # after its docstring
    assert sum(bool(line.strip()) for line in text.splitlines()[begin - 1 :]) <= MOST_LINES
    page = (tmp_path / f'{path.stem}.html').read_text(encoding='utf-8')
    assert page.count('"type":"scatter"') >= 2 and 'Plotly.newPlot' in page


@pytest.mark.parametrize('path', NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_and_the_site_shows_what_it_gives(path, monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / 'docs'))
    import site_pages

    page = site_pages.notebook(path)  # runs every cell; they have assertions
    cells = json.loads(path.read_text(encoding='utf-8'))['cells']
    code = [''.join(cell['source']) for cell in cells if cell['cell_type'] == 'code']
    assert page.startswith('# ') and page.count('```python') == len(code) >= 3
    assert page.count('```text') >= 2
    assert ('Plotly.newPlot' in page) == ('plotly' in ''.join(code))
    assert not any(cell.get('outputs') for cell in cells)


def test_there_is_one_for_each_system_and_the_page_of_own_models_holds():
    assert [path.stem for path in EXAMPLES] == sorted(SYSTEMS)
    page = (ROOT / 'docs' / 'howto' / 'own_model.md').read_text(encoding='utf-8')
    space = {}
    for block in re.findall(r'```python\n(.*?)```', page, re.DOTALL):
        exec(compile(block, 'own_model.md', 'exec'), space)
    found = checked(space['Drifting'](config=None))
    assert found.joint.names == ('cv', 'drift') and found.motion(0.0).F[1, 0, 0] == 1.0
    step = BehaviourStep(*space['Bottle'](config=None).step(60.0))
    assert step.keep == pytest.approx(0.3679, abs=1e-4)
