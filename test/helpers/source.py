# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The source tree as the tests of the house read it: modules, imports, circles of imports."""

import ast
import contextlib
from functools import cache
from pathlib import Path
import subprocess

ROOT = Path(__file__).resolve().parents[2]
ROOMS = 'sonar_imm', 'sonar_imm_tools', 'msg_adapters'
MODULES = sorted(path for room in ROOMS for path in (ROOT / room).rglob('*.py'))

COMMON_INTERFACES = {
    'actionlib_msgs', 'diagnostic_msgs', 'geometry_msgs', 'nav_msgs', 'sensor_msgs', 'shape_msgs',
    'std_msgs', 'std_srvs', 'stereo_msgs', 'trajectory_msgs', 'visualization_msgs',
}  # fmt: skip
COME_WITH_RCLPY = {'builtin_interfaces', 'lifecycle_msgs', 'rcl_interfaces', 'rosgraph_msgs'}
ROS_MODULES = COMMON_INTERFACES | COME_WITH_RCLPY | {'rclpy', 'ament_index_python'}


def module_name(path):
    parts = path.relative_to(ROOT).with_suffix('').parts
    return '.'.join(parts[:-1] if parts[-1] == '__init__' else parts)


def known_module(modules, name):
    """The module of ours that a dotted name is or is defined in."""
    while name and name not in modules:
        name = name.rpartition('.')[0]
    return name or None


def circle_of(graph):
    """A way from a module over its imports back to it, or None."""
    done, way = set(), []

    def visit(name):
        if name in way:
            return [*way[way.index(name) :], name]
        if name in done:
            return None
        way.append(name)
        found = next(filter(None, map(visit, sorted(graph[name]))), None)
        way.pop()
        done.add(name)
        return found

    return next(filter(None, map(visit, sorted(graph))), None)


@cache
def tree_of(path):
    """The module as it is parsed, once for all tests of a process."""
    return ast.parse(path.read_text(encoding='utf-8'))


@cache
def imports(path):
    """Every name the module imports, made absolute, at the top or inside a function."""
    return imported_names(tree_of(path), path)


def imported_names(tree, path):
    """Every name that the module at `path` imports, made absolute."""
    package = module_name(path) if path.name == '__init__.py' else module_name(path.parent)
    names = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            base = package.split('.')[: len(package.split('.')) - node.level + 1]
            stem = '.'.join([*(base if node.level else []), *filter(None, [node.module])])
            names += [f'{stem}.{alias.name}' for alias in node.names]
    return names


def commits():
    """How many commits there are, which chooses what is run in turn; 0 outside of a checkout."""
    command = ['git', '-C', str(ROOT), 'rev-list', '--count', 'HEAD']
    with contextlib.suppress(OSError):
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode == 0:
            return int(done.stdout)
    return 0
