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

"""The launch files start what is installed, and pass arguments that exist.

They are read as XML here; `test/system/test_launch.py` runs them where ROS 2 launch is installed.
"""

from __future__ import annotations

from pathlib import Path
import re
import xml.etree.ElementTree as ElementTree

import pytest

from sonar_imm.trackers import SYSTEMS

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / 'launch'
FILES = sorted(FOLDER.glob('*.launch.xml'))
SHARE = '$(find-pkg-share sonar_imm)/'


def tree(name: str) -> ElementTree.Element:
    return ElementTree.parse(FOLDER / f'{name}.launch.xml').getroot()


def declared(root: ElementTree.Element) -> set[str]:
    return {arg.get('name') for arg in root.findall('arg')}


@pytest.mark.parametrize('system', [*SYSTEMS, 'fls_detector'])
def test_each_node_has_a_launch_file_that_starts_its_executable(system):
    (include,) = tree(system).findall('include')
    given = {arg.get('name'): arg.get('value') for arg in include.findall('arg')}
    assert include.get('file') == f'{SHARE}launch/node.launch.xml'
    assert given == {'system': system}
    (node,) = tree('node').findall('node')
    assert node.get('exec').replace('$(var system)', system) in executables()
    # The name is what the parameter files and the remaps of the documentation use.
    assert node.get('name') == '$(var system)'


def executables() -> set[str]:
    """What setup.py installs for `ros2 run`."""
    names = {f'{system}_node' for system in SYSTEMS}
    return names | set(re.findall(r"'(\w+_node) = ", (ROOT / 'setup.py').read_text()))


def test_the_file_for_all_starts_every_system_once_in_a_namespace_of_its_own():
    root = tree('all')
    started = []
    for group in root.findall('group'):
        (include,) = group.findall('include')
        given = {arg.get('name'): arg.get('value') for arg in include.findall('arg')}
        system = given['system']
        started.append(system)
        assert group.get('if') == f'$(var {system})'
        spaces = [push.get('namespace') for push in group.findall('push-ros-namespace')]
        assert spaces == ['$(var namespace)', f'$(var {system}_namespace)']
        assert given['params_file'] == f'$(var {system}_params_file)'
        # An absolute namespace given for all would otherwise win inside as well.
        assert given['namespace'] == ''
    assert sorted(started) == sorted(SYSTEMS)


@pytest.mark.parametrize('path', FILES, ids=lambda path: path.name)
def test_every_argument_and_file_that_is_used_is_there(path):
    text = path.read_text(encoding='utf-8')
    root = ElementTree.fromstring(text)
    from_outside = {'system'} if path.name == 'node.launch.xml' else set()
    used = set(re.findall(r'\$\(var (\w+)\)', text))
    assert used <= declared(root) | from_outside
    assert all(arg.get('description') for arg in root.findall('arg'))
    known = declared(tree('node'))
    for include in root.iter('include'):
        assert {arg.get('name') for arg in include.findall('arg')} <= known
    for name in re.findall(re.escape(SHARE) + r'([\w./]+)(?=["\'])', text):
        assert (ROOT / name).is_file(), name
