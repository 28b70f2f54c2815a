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

"""Every function of the mathematics is used, or stands here as part of the library."""

import ast
from collections import defaultdict

from helpers.source import imports, module_name, MODULES, ROOT, tree_of

ROOMS = ('sonar_imm.estimation.', 'sonar_imm.acoustics.')

LIBRARY = {
    'sonar_imm.acoustics.arrivals_3d.arrival_angles': 'angles of many receivers at once',
    'sonar_imm.acoustics.geometry.vertical_offset': 'equation (7), which reconstruct turns round',
    'sonar_imm.estimation.imm.gate': 'the readable form of imm_kernels.gate',
    'sonar_imm.estimation.imm_filter.position': 'of the ready filter',
    'sonar_imm.estimation.imm_filter.range_bearing': 'of the ready filter',
    'sonar_imm.estimation.kalman.update': 'one Kalman filter, without models',
    'sonar_imm.estimation.motion.ca': 'of the ready filter',
    'sonar_imm.estimation.motion.ct': 'of the ready filter',
    'sonar_imm.estimation.motion.cv': 'of the ready filter',
    'sonar_imm.estimation.motion.hover': 'of the ready filter',
}
"""Public functions that this package does not call itself: what they are there for."""


def uses(path, tree):
    """(function that uses it or None, dotted name used) of every name and attribute."""
    names = {}
    for name in imports(path):
        names[name.rpartition('.')[2]] = name
    for node in ast.walk(tree):
        if isinstance(node, (ast.Import, ast.ImportFrom)):
            for alias in node.names:
                if alias.asname and alias.name.rpartition('.')[2] in names:
                    names[alias.asname] = names[alias.name.rpartition('.')[2]]
    own = module_name(path)
    for top in tree.body:
        owner = f'{own}.{top.name}' if isinstance(top, (ast.FunctionDef, ast.ClassDef)) else None
        for node in ast.walk(top):
            if isinstance(node, ast.Name):
                yield owner, names.get(node.id, f'{own}.{node.id}')
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                if node.value.id in names:
                    yield owner, f'{names[node.value.id]}.{node.attr}'


def unused():
    """Public functions of the mathematical rooms that nothing but themselves and other unused ones
    call."""
    users, public = defaultdict(set), set()
    for path in [*MODULES, *(ROOT / 'benchmarks').rglob('*.py')]:
        tree = tree_of(path)
        for owner, name in uses(path, tree):
            if owner != name:
                users[name].add(owner)
        if module_name(path).startswith(ROOMS):
            for node in tree.body:
                if isinstance(node, ast.FunctionDef) and not node.name.startswith('_'):
                    public.add(f'{module_name(path)}.{node.name}')
    found, more = set(), True
    while more:
        more = {name for name in public if name not in found and users[name] <= found}
        found |= more
    return found


def test_what_only_tests_use_is_part_of_the_library():
    assert unused() == set(LIBRARY)
