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

"""Imports go down the floors of docs/architecture.md only, and never in a circle."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from helpers.source import (
    circle_of,
    imported_names,
    imports,
    known_module,
    module_name,
    MODULES,
    ROOT,
    ROS_MODULES,
)
import pytest

if not (ROOT / 'setup.py').is_file():
    pytest.skip('these tests read the source tree', allow_module_level=True)

# A room may import from its own floor and from lower ones.
FLOORS = {
    'sonar_imm.files': 0,
    'sonar_imm.resources': 0,
    'sonar_imm.texts': 0,
    'sonar_imm.threads': 0,
    'sonar_imm.estimation': 0,
    'sonar_imm.acoustics': 1,
    'sonar_imm.parameters': 2,
    'sonar_imm.measurements': 2,
    'sonar_imm.estimates': 2,
    'sonar_imm.soundings': 2,
    'msg_adapters': 3,
    'sonar_imm.trackers': 3,
    'sonar_imm.simulation': 4,
    'sonar_imm.node_config': 4,
    'sonar_imm.recordings': 5,
    'sonar_imm.evaluation': 6,
    'sonar_imm.viewing': 7,
    'sonar_imm.nodes': 7,
    'sonar_imm.cli': 8,
}
SIDE_BY_SIDE = {
    ('sonar_imm.viewing', 'sonar_imm.nodes'),
    ('sonar_imm.nodes', 'sonar_imm.viewing'),
    ('msg_adapters', 'sonar_imm.trackers'),
    ('sonar_imm.trackers', 'msg_adapters'),
}
ONLY_IN = {'rclpy': {'sonar_imm.nodes'}, 'rosbags': {'sonar_imm.recordings'}}


@pytest.mark.parametrize('path', MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_go_down_the_floors(path: Path) -> None:
    here = room_of(module_name(path))
    if here is None:  # sonar_imm/__init__.py only looks whether msg_adapters is its own
        assert module_name(path) == 'sonar_imm'
        assert {room_of(name) for name in imports(path)} <= {None, 'msg_adapters'}
        return
    for name in imports(path):
        there = room_of(name)
        if there is not None:
            assert FLOORS[there] <= FLOORS[here], f'{here} must not import {name}'
            assert (here, there) not in SIDE_BY_SIDE, f'{here} must not import {name}'


@pytest.mark.parametrize('path', MODULES, ids=lambda path: str(path.relative_to(ROOT)))
def test_ros_and_rosbags_stay_in_their_rooms(path: Path) -> None:
    here = room_of(module_name(path))
    for name in imports(path):
        top = name.split('.')[0]
        rooms = ONLY_IN.get('rclpy' if top in ROS_MODULES else top)
        assert rooms is None or here in rooms, f'{here} must not import {name}'


def test_the_floor_check_sees_relative_and_inner_imports(tmp_path: Path) -> None:
    file = ROOT / 'sonar_imm' / 'estimation' / 'imagined.py'
    source = (
        'from ..nodes import diver\nfrom .. import cli\nfrom . import kalman\n'
        'def f():\n    import rclpy.node\n'
    )
    assert set(imported_names(source, file)) >= {
        'sonar_imm.nodes.diver',
        'sonar_imm.cli',
        'sonar_imm.estimation.kalman',
        'rclpy.node',
    }


def test_no_module_imports_itself_by_way_of_others() -> None:
    """No circle, also none that an import inside a function or for type checking closes."""
    modules = {module_name(path): path for path in MODULES}
    graph = {
        name: {found for found in map(partial(known_module, modules), imports(path)) if found}
        - {name}
        for name, path in modules.items()
    }
    assert circle_of(graph) is None


def test_the_circle_check_sees_circles() -> None:
    assert circle_of({'a': {'b'}, 'b': {'c'}, 'c': set()}) is None
    found = circle_of({'a': {'b'}, 'b': {'c'}, 'c': {'d'}, 'd': {'b'}})
    assert found == ['b', 'c', 'd', 'b']


def room_of(name: str) -> str | None:
    """The room a dotted name lies in, None outside the house."""
    return next((room for room in FLOORS if name == room or name.startswith(room + '.')), None)
