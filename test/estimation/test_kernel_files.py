# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A kernel file stands alone, so that what numba keeps of it is right for as long as the file is.

Compiled code contains the kernels it calls and the constants it names. numba compiles anew when a
kernel's own file changes, and looks at no other.
"""

import ast
from pathlib import Path
import subprocess
import sys

import pytest

import sonar_imm

PACKAGE = Path(sonar_imm.__file__).parent
TYPES = {'BoolArray', 'ComplexArray', 'FloatArray', 'IndexArray', 'IntArray'}
ALLOWED = {
    'numpy': {'np'}, 'numpy.typing': {'NDArray'}, 'math': {'math'}, 'numba': {'numba'},
    'typing': {'Any'},
    **dict.fromkeys(('.jit', '..estimation.jit', '...estimation.jit'), {'kernel'}),
    '__future__': {'annotations'}, **dict.fromkeys(('.arrays', '...estimation.arrays'), TYPES),
}  # fmt: skip
"""What may be imported, and by which names; of `arrays` the names of types, which no code uses."""


def imported(tree):
    """(module, name) of all that is imported anywhere in a file."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from ((alias.name, alias.asname or alias.name) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            module = '.' * node.level + (node.module or '')
            yield from ((module, alias.asname or alias.name) for alias in node.names)


def kernels_of(tree):
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
    decorated = (f for f in functions if [ast.unparse(d) for d in f.decorator_list] == ['kernel'])
    return {function.name for function in decorated}


ALONE = sorted(
    path.relative_to(PACKAGE).as_posix()
    for path in PACKAGE.rglob('*.py')
    if kernels_of(ast.parse(path.read_text()))
)


@pytest.mark.parametrize('name', ALONE)
def test_a_kernel_file_imports_no_code_of_another(name):
    tree = ast.parse((PACKAGE / name).read_text())
    wrong = [(module, own) for module, own in imported(tree) if own not in ALLOWED.get(module, ())]
    assert wrong == []


@pytest.mark.parametrize('name', ALONE)
def test_a_kernel_has_its_helpers_in_it(name):
    """Called from two kernels a helper would be compiled three times."""
    tree = ast.parse((PACKAGE / name).read_text())
    functions = [node for node in tree.body if isinstance(node, ast.FunctionDef)]
    kernels = kernels_of(tree)
    assert kernels and len(kernels) == len(functions)
    called = {
        node.func.id
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    assert not called & kernels


def test_a_shift_is_compiled_where_it_is_configured_only():
    program = """
import sys
import numpy as np
from sonar_imm.estimation.set_filter import SetFilter
from sonar_imm.estimation.set_model import SetModel, gaussian_walk
from sonar_imm.estimation.set_shifts import Shift
for shift in (None, Shift(std=1.0)):
    model = SetModel(cells=20, separation=3, order_min=1, transition=[[1.0]], shift=shift,
                     walk=gaussian_walk(1.0), gram=np.eye(1, 20)[0])
    tracker = SetFilter(model, 5)
    record = tracker.record(np.ones(model.record_cells), (1, 2))
    tracker.propagate(tracker.start(record), record)
    print('sonar_imm.estimation.set_shift_kernels' in sys.modules)
"""
    done = subprocess.run(
        [sys.executable, '-c', program], capture_output=True, text=True, cwd=PACKAGE.parent
    )
    assert done.stdout.split() == ['False', 'True'], done.stderr
