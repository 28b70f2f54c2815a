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

import os
from pathlib import Path
import subprocess
import sys

import pytest

import msg_adapters
import sonar_imm

ROOT = str(Path(sonar_imm.__file__).parent.parent)


def import_with(*path):
    return subprocess.run(
        [sys.executable, '-c', 'import sonar_imm'],
        capture_output=True,
        text=True,
        cwd='/',
        check=False,
        env={**os.environ, 'PYTHONPATH': os.pathsep.join(path)},
    )


def test_our_own_adapters_are_ours():
    assert msg_adapters.__owner__ == 'sonar_imm'
    assert msg_adapters.__version__ == sonar_imm.__version__
    assert import_with(ROOT).returncode == 0


@pytest.mark.parametrize(
    'content',
    [
        '',
        "__owner__ = 'someone'\n__version__ = '9'\n",
        "__owner__ = 'sonar_imm'\n__version__ = '0.0.0'\n",
        None,
    ],
)
def test_foreign_adapters_are_refused_and_both_places_named(tmp_path, content):
    foreign = tmp_path / 'msg_adapters'
    foreign.mkdir()
    if content is not None:
        (foreign / '__init__.py').write_text(content)
        path = [str(tmp_path), ROOT]
    else:  # a folder without __init__.py is a module too when nothing better is found
        if 'site-packages' in ROOT:
            pytest.skip('ours is installed here, and a bare folder never comes before it')
        house = tmp_path / 'house'
        house.mkdir()
        (house / 'sonar_imm').symlink_to(Path(ROOT) / 'sonar_imm')
        path = [str(tmp_path), str(house)]
    result = import_with(*path)
    assert result.returncode == 1
    last = result.stderr.strip().splitlines()[-1]
    assert last.startswith('ImportError') and str(foreign) in last
    assert os.path.join('sonar_imm', '__init__.py') in last
