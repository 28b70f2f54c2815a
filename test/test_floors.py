# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Imports go down the floors of docs/architecture.md only, and never in a circle; nothing that
came from a file or a process is run; and the examples in docstrings do what they say."""

from __future__ import annotations

import ast
import doctest
from importlib import import_module
import itertools
import subprocess
import sys

from helpers import source
from helpers.source import imports, module_name, MODULES, ROOT, ROS_MODULES
import pytest

if not (ROOT / 'setup.py').is_file():
    pytest.skip('these tests read the source tree', allow_module_level=True)

# A room may import from its own floor and from lower ones.
FLOORS = {
    'sonar_imm.files': 0, 'sonar_imm.gone': 0, 'sonar_imm.texts': 0, 'sonar_imm.threads': 0,
    'sonar_imm.estimation': 0, 'sonar_imm.acoustics': 1, 'sonar_imm.parameters': 2,
    'sonar_imm.measurements': 2, 'sonar_imm.truth': 2, 'sonar_imm.estimates': 2,
    'sonar_imm.soundings': 2, 'msg_adapters': 3, 'sonar_imm.intake': 3, 'sonar_imm.trackers': 4,
    'sonar_imm.node_config': 5, 'sonar_imm.nodes': 6, 'sonar_imm_tools.resources': 7,
    'sonar_imm_tools.recordings': 7, 'sonar_imm_tools.simulation': 8, 'sonar_imm_tools.replay': 8,
    'sonar_imm_tools.offline': 8, 'sonar_imm_tools.evaluation': 9, 'sonar_imm_tools.survey': 9,
    'sonar_imm_tools.cli': 10,
}  # fmt: skip
# Rooms of one floor, or of neighbouring ones, that must not know each other.
DESKS = 'sonar_imm_tools.simulation', 'sonar_imm_tools.replay', 'sonar_imm_tools.offline'
APART = {
    ('msg_adapters', 'sonar_imm.trackers'), ('msg_adapters', 'sonar_imm.intake'),
    ('sonar_imm_tools.recordings', 'sonar_imm.nodes'), *itertools.combinations(DESKS, 2),
}  # fmt: skip
ONLY_IN = {
    'rclpy': {'sonar_imm.nodes', 'sonar_imm_tools.replay'},
    'rosbags': {'sonar_imm_tools.recordings'},
}
DESK = {'click', 'plotly', 'rich', 'rosbags', 'sonar_imm_tools'}
"""What only the workbench may import: the live package runs without it."""


def test_imports_go_down_the_floors():
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
                assert not APART & {(here, there), (there, here)}, f'{here} must not import {name}'


def test_ros_and_the_workbench_stay_in_their_rooms():
    for path in MODULES:
        here = room_of(module_name(path))
        for name in imports(path):
            top = name.split('.')[0]
            rooms = ONLY_IN.get('rclpy' if top in ROS_MODULES else top)
            assert rooms is None or here in rooms, f'{here} must not import {name}'
            if not module_name(path).startswith('sonar_imm_tools'):
                assert top not in DESK, f'{here} must not import {name}'


def test_the_live_package_is_there_without_the_workbench():
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


def test_the_floor_check_sees_relative_and_inner_imports():
    file = ROOT / 'sonar_imm' / 'estimation' / 'imagined.py'
    text = 'from ..nodes import diver\nfrom .. import trackers\nfrom . import kalman\n'
    tree = ast.parse(text + 'def f():\n    import rclpy.node\n')
    due = {'sonar_imm.nodes.diver', 'sonar_imm.trackers', 'sonar_imm.estimation.kalman'}
    assert {*source.imported_names(tree, file)} >= due | {'rclpy.node'}


def test_no_module_imports_itself_by_way_of_others():
    """No circle, also none that an import inside a function or for type checking closes."""
    modules = {module_name(path): path for path in MODULES}
    graph = {
        name: {source.known_module(modules, used) for used in imports(path)} - {None, name}
        for name, path in modules.items()
    }
    assert source.circle_of(graph) is None
    assert source.circle_of({'a': {'b'}, 'b': {'c'}, 'c': set()}) is None
    found = source.circle_of({'a': {'b'}, 'b': {'c'}, 'c': {'d'}, 'd': {'b'}})
    assert found == ['b', 'c', 'd', 'b']


def room_of(name):
    """The room a dotted name lies in, None outside the house."""
    return next((room for room in FLOORS if name == room or name.startswith(room + '.')), None)


# -- examples in docstrings --

WITH_EXAMPLES = [
    module_name(path) for path in MODULES if '>>> ' in path.read_text(encoding='utf-8')
]


@pytest.mark.parametrize('name', WITH_EXAMPLES)
def test_examples_do_what_they_say(name):
    found = doctest.testmod(import_module(name))
    assert found.attempted > 0 and found.failed == 0
    rooms = {name.split('.')[1] for name in WITH_EXAMPLES}  # those for others have some
    assert {'estimation', 'acoustics', 'trackers'} <= rooms and len(WITH_EXAMPLES) >= 12


# -- nothing that came from a file or a process is run: the sources call nothing that could --

RUNS = {'eval', 'exec', 'compile', '__import__'}
UNPICKLE = {'pickle', '_pickle', 'cPickle', 'marshal', 'shelve', 'joblib', 'dill', 'cloudpickle'}
UNPICKLE |= {'xtf_read', 'xtf_read_gen'}
"""The readers of pyxtf unpickle an index beside the file."""
YAML = {'load', 'load_all', 'unsafe_load', 'full_load', 'UnsafeLoader', 'FullLoader', 'Loader'}


def faults(tree):
    """What of a module could run what it reads, as (line, what)."""
    for node in ast.walk(tree):
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or '', *(alias.name for alias in node.names)]
        if found := UNPICKLE.intersection(part for name in names for part in name.split('.')):
            yield node.lineno, found.pop()
        if isinstance(node, ast.Attribute) and ast.unparse(node.value) == 'yaml':
            if node.attr in YAML:
                yield node.lineno, f'yaml.{node.attr}'
        if isinstance(node, ast.Call):
            yield from _calls(node)


def _calls(node):
    called = ast.unparse(node.func)
    given = {word.arg: word.value for word in node.keywords}
    if called in RUNS or called in ('os.system', 'os.popen', 'builtins.eval', 'builtins.exec'):
        yield node.lineno, called
    if called.split('.')[-1] == 'load' and called.split('.')[0] in ('np', 'numpy'):
        if ast.unparse(given.get('allow_pickle', ast.Constant(True))) != 'False':
            yield node.lineno, 'np.load without allow_pickle=False'
    elif 'allow_pickle' in given and ast.unparse(given['allow_pickle']) != 'False':
        yield node.lineno, 'allow_pickle'
    if 'shell' in given and ast.unparse(given['shell']) != 'False':
        yield node.lineno, 'shell'


def test_no_module_runs_what_it_reads():
    wrong = {module_name(path): list(faults(source.tree_of(path))) for path in MODULES}
    assert not any(wrong.values()), wrong


BAD = (
    'import pickle', 'from pickle import loads', 'from concurrent import x; import numpy, joblib',
    'def f():\n    import marshal', 'eval("1")', 'exec(text)', 'os.system("ls")',
    'yaml.load(text)', 'yaml.load(text, yaml.SafeLoader)', 'yaml.unsafe_load(text)',
    'np.load(file)', 'np.load(file, allow_pickle=True)', 'np.load(file, allow_pickle=x)',
    'np.savez(file, allow_pickle=True)', 'subprocess.run(words, shell=True)',
)  # fmt: skip
GOOD = (
    'np.load(file, allow_pickle=False)', 'yaml.safe_load(text)', 're.compile(text)',
    'json.load(f)',
)  # fmt: skip


@pytest.mark.parametrize('text', [*BAD, *GOOD])
def test_the_check_sees_what_runs_and_leaves_the_rest(text):
    assert bool([*faults(ast.parse(text))]) == (text in BAD)
