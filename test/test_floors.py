# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Imports go down the floors of docs/architecture.md only, and never in a circle."""

from __future__ import annotations

import ast
from functools import partial
from pathlib import Path
import subprocess
import sys

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
    'sonar_imm.gone': 0,
    'sonar_imm.texts': 0,
    'sonar_imm.threads': 0,
    'sonar_imm.estimation': 0,
    'sonar_imm.acoustics': 1,
    'sonar_imm.parameters': 2,
    'sonar_imm.measurements': 2,
    'sonar_imm.truth': 2,
    'sonar_imm.estimates': 2,
    'sonar_imm.soundings': 2,
    'msg_adapters': 3,
    'sonar_imm.intake': 3,
    'sonar_imm.trackers': 4,
    'sonar_imm.node_config': 5,
    'sonar_imm.nodes': 6,
    'sonar_imm_tools.resources': 7,
    'sonar_imm_tools.recordings': 7,
    'sonar_imm_tools.simulation': 8,
    'sonar_imm_tools.replay': 8,
    'sonar_imm_tools.offline': 8,
    'sonar_imm_tools.evaluation': 9,
    'sonar_imm_tools.survey': 9,
    'sonar_imm_tools.cli': 10,
}
# Rooms of one floor, or of neighbouring ones, that must not know each other.
APART = (
    ('msg_adapters', 'sonar_imm.trackers'),
    ('msg_adapters', 'sonar_imm.intake'),
    ('sonar_imm_tools.simulation', 'sonar_imm_tools.replay'),
    ('sonar_imm_tools.simulation', 'sonar_imm_tools.offline'),
    ('sonar_imm_tools.replay', 'sonar_imm_tools.offline'),
    ('sonar_imm_tools.recordings', 'sonar_imm.nodes'),
)
ONLY_IN = {
    'rclpy': {'sonar_imm.nodes', 'sonar_imm_tools.replay'},
    'rosbags': {'sonar_imm_tools.recordings'},
}
DESK = {'click', 'plotly', 'rich', 'rosbags', 'sonar_imm_tools'}
"""What only the workbench may import: the live package runs without it."""


def test_imports_go_down_the_floors() -> None:
    for path in MODULES:
        here = room_of(module_name(path))
        # sonar_imm/__init__.py looks whether msg_adapters is its own, and opens the filter.
        if here is None:
            assert module_name(path) in {'sonar_imm', 'sonar_imm_tools'}
            rooms = {room_of(name) for name in imports(path)}
            assert rooms <= {None, 'msg_adapters', 'sonar_imm.estimation'}
            continue
        for name in imports(path):
            there = room_of(name)
            if there is not None:
                assert FLOORS[there] <= FLOORS[here], f'{here} must not import {name}'
                assert (here, there) not in APART, f'{here} must not import {name}'
                assert (there, here) not in APART, f'{here} must not import {name}'


def test_ros_and_the_workbench_stay_in_their_rooms() -> None:
    for path in MODULES:
        here = room_of(module_name(path))
        for name in imports(path):
            top = name.split('.')[0]
            rooms = ONLY_IN.get('rclpy' if top in ROS_MODULES else top)
            assert rooms is None or here in rooms, f'{here} must not import {name}'
            if not module_name(path).startswith('sonar_imm_tools'):
                assert top not in DESK, f'{here} must not import {name}'


def test_the_live_package_is_there_without_the_workbench() -> None:
    """Trackers are imported and built by a process that can import nothing of the desk."""
    program = f"""
import sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in {DESK!r}:
            raise ImportError(name)
sys.meta_path.insert(0, Refuse())
from sonar_imm.trackers import SYSTEMS
import sonar_imm.node_config
for system in SYSTEMS.values():
    system.build(system.config_type()())
"""
    done = subprocess.run([sys.executable, '-c', program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_the_floor_check_sees_relative_and_inner_imports(tmp_path: Path) -> None:
    file = ROOT / 'sonar_imm' / 'estimation' / 'imagined.py'
    source = (
        'from ..nodes import diver\nfrom .. import trackers\nfrom . import kalman\n'
        'def f():\n    import rclpy.node\n'
    )
    assert set(imported_names(ast.parse(source), file)) >= {
        'sonar_imm.nodes.diver',
        'sonar_imm.trackers',
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
