# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Compiled kernels are kept where they can be, what goes wrong with that is one sentence, and what
numba keeps of a kernel file is right for as long as the file is."""

import ast
import os
from pathlib import Path
import shutil
import subprocess
import sys

import llvmlite.binding as llvm
import numba
import pytest

import sonar_imm
from sonar_imm.estimation import jit
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers import SYSTEMS

PACKAGE = Path(sonar_imm.__file__).parent
WARM = 'from sonar_imm_tools.cli import main; raise SystemExit(main(["warm", "fathometer"]))'
DAMAGE = {
    'a flipped byte': lambda content: bytes([content[0] ^ 4]) + content[1:],
    'cut': lambda content: content[:-9],
}


def begin(code, cache, *, root=PACKAGE.parent, arguments=(), **environment):
    """A process of its own, with this folder for compiled kernels."""
    environment = {**os.environ, 'NUMBA_CACHE_DIR': str(cache), **environment}
    return subprocess.Popen(
        [sys.executable, '-c', code, *arguments], cwd=root,
        env={**environment, 'PYTHONPATH': str(root)}, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def alone(folder, text):
    """Code that runs this file of kernels."""
    (folder / 'alone.py').write_text(text)
    return f'import sys; sys.path.append({str(folder)!r}); import alone'


def run(code, cache, **options):
    """What it prints, its errors and its exit code."""
    process = begin(code, cache, **options)
    return *process.communicate(), process.returncode


@pytest.fixture
def warm(tmp_path, monkeypatch):
    """Gets a tracker with one kernel warm, which knows only what is in the folder."""
    monkeypatch.setattr(numba.config, 'CACHE_DIR', str(tmp_path))

    def doubled(x):
        return x + x

    class Tracker:
        def warm(self, inputs):
            assert jit.kernel(doubled)(2.0) == 4.0

    return lambda: SYSTEMS['diver'].warm(Tracker())


def test_what_was_done_is_a_sentence(warm):
    assert warm().startswith('1 kernels compiled, 0 loaded, ')
    assert warm().startswith('0 kernels compiled, 1 loaded, ')


@pytest.mark.parametrize('suffix', ['nbi', 'nbc'])
@pytest.mark.parametrize('damage', DAMAGE)
def test_a_damaged_file_is_one_sentence(warm, tmp_path, damage, suffix):
    warm()
    (path,) = tmp_path.rglob(f'*.{suffix}')
    path.write_bytes(DAMAGE[damage](path.read_bytes()))
    with pytest.raises(ConfigError) as raised:
        warm()
    sentence = str(raised.value)
    assert sentence.startswith(f'compiled kernels in {tmp_path} cannot be read or kept (')
    assert sentence.endswith('): free or delete that folder') and '\n' not in sentence
    for folder in tmp_path.iterdir():
        shutil.rmtree(folder)
    assert warm().startswith('1 kernels compiled')


def test_a_mistake_of_a_tracker_is_not_taken_for_a_damaged_file():
    class Tracker:
        def warm(self, inputs):
            raise ValueError('a bug')

    with pytest.raises(ValueError, match='a bug'):
        SYSTEMS['diver'].warm(Tracker())


def test_a_full_disk_ends_the_command_with_one_sentence(tmp_path):
    """A small file system where one may be mounted; else a limit on the size of files."""
    mount = ['mount', '-t', 'tmpfs', '-o', 'size=32k', 'tmpfs', str(tmp_path)]
    small = shutil.which('mount') and not subprocess.run(mount, capture_output=True).returncode
    limit = '' if small else 'import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (9, 9));'
    try:
        out, errors, code = run(limit + WARM, tmp_path)
    finally:
        if small:
            subprocess.run(['umount', str(tmp_path)], check=True)
    assert (out, code) == ('', 2)
    why = 'No space left on device' if small else 'File too large'
    assert errors == (
        f'sonar-imm: compiled kernels in {tmp_path} cannot be read or kept ({why}): free or '
        'delete that folder\n'
    )


def test_without_a_folder_that_can_be_written_each_process_compiles(tmp_path):
    """As in a container whose files cannot be written and that has no home."""
    (tmp_path / '__pycache__').touch()
    code = alone(
        tmp_path,
        'from sonar_imm.estimation.jit import counts, kernel\n'
        'doubled, halved = kernel(lambda x: 2.0 * x), kernel(lambda x: 0.5 * x)\n'
        'print(doubled(2.0), halved(2.0), *counts())\n',
    )
    nowhere = {'HOME': os.devnull, 'XDG_CACHE_HOME': os.devnull}
    for _ in range(2):
        out, errors, _ = run(code, os.devnull, **nowhere)
        assert out.split() == ['4.0', '1.0', '2', '0']
        assert errors.count('compiled kernels cannot be kept') == 1


TARGET = Path(__file__).parents[2] / 'docker' / 'numba_target.sh'


@pytest.mark.skipif(sys.platform != 'linux', reason='images are of Linux')
def test_kernels_of_an_image_load_on_another_processor(tmp_path):
    """LLVM is made to find another processor; without the target, that one compiles anew."""
    file = tmp_path / 'alone.py'
    file.write_text(
        'import sys\n'
        'import llvmlite.binding as llvm\n'
        'llvm.get_host_cpu_name = lambda: sys.argv[1]\n'
        'from sonar_imm.estimation.jit import counts, kernel\n'
        'def doubled(x): return 2.0 * x\n'
        'print(kernel(doubled)(2.0), *counts())\n'
    )
    environment = {k: v for k, v in os.environ.items() if not k.startswith('NUMBA_CPU')}
    environment |= {'NUMBA_CACHE_DIR': str(tmp_path / 'kept'), 'PYTHONPATH': str(PACKAGE.parent)}
    target, other = '. "$1"; ', 'x86-64'
    for source, processor, counted in (
        (target, llvm.get_host_cpu_name(), ['1', '0']), (target, other, ['0', '1']),
        ('', other, ['1', '0']),
    ):  # fmt: skip
        words = ['sh', '-ec', source + 'exec "$2" "$3" "$4"', 'sh', TARGET, sys.executable]
        words += [file, processor]
        done = subprocess.run(words, env=environment, capture_output=True, text=True)
        assert done.stdout.split() == ['4.0', *counted]


def test_a_processor_that_was_chosen_stays():
    told = '. "$1"; echo "$NUMBA_CPU_NAME ${NUMBA_CPU_FEATURES-none}"'
    words = ['sh', '-ec', told, 'sh', TARGET]
    environment = {**os.environ, 'NUMBA_CPU_NAME': 'skylake'}
    environment.pop('NUMBA_CPU_FEATURES', None)
    assert subprocess.check_output(words, env=environment, text=True) == 'skylake none\n'


def test_a_constant_that_changes_changes_the_result(tmp_path):
    """A numba that looks at the kernel alone forgets what it has from its file."""
    text = """
import math
from sonar_imm.estimation.jit import counts, kernel
LN_2 = math.log(2.0)
@kernel
def scaled(x):
    return x / LN_2
print(round(scaled(1.0), 4), *counts())
"""
    code, cache = alone(tmp_path, text), tmp_path / 'cache'
    assert run(code, cache)[0].split() == ['1.4427', '1', '0']
    assert run(code, cache)[0].split() == ['1.4427', '0', '1']
    alone(tmp_path, text.replace('LN_2 =', 'LN_2 = 2.0 *'))
    assert run(code, cache)[0].split() == ['0.7213', '1', '0']


def test_of_processes_that_begin_at_once_one_compiles(tmp_path):
    """Two begin with an empty folder, a third loads what they left: all give the same bits."""
    text = """
import math, sys, time
from pathlib import Path
from sonar_imm.estimation.jit import counts, kernel
from sonar_imm.trackers import SYSTEMS
@kernel
def series(x):
    total = 0.0
    for k in range(1, 50):
        total += math.sin(x / k)
    return total
class Tracker:
    def warm(self, inputs):
        series(1.0), series(1)
start, me = Path(sys.argv[1]), sys.argv[2]
(start / me).touch()
while len(list(start.iterdir())) < 2:
    time.sleep(0.001)
SYSTEMS['diver'].warm(Tracker())
print(series(3.0).hex(), *counts())
"""
    start, cache = tmp_path / 'start', tmp_path / 'cache'
    start.mkdir()
    code = alone(tmp_path, text)
    both = [begin(code, cache, arguments=(str(start), name)) for name in 'ab']
    made = [process.communicate() for process in both]
    words = [out.split() for out, _ in made]
    assert sorted(each[1:] for each in words) == [['0', '2'], ['2', '0']], made
    loaded = run(code, cache, arguments=(str(start), 'c'))[0].split()
    assert loaded[1:] == ['0', '2']
    assert {loaded[0], *(each[0] for each in words)} == {loaded[0]}


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


# -- a kernel file stands alone: compiled code contains the kernels it calls and the constants it
# names, and numba compiles anew when a kernel's own file changes, but looks at no other ----------

ALONE = sorted(
    path.relative_to(PACKAGE).as_posix()
    for path in PACKAGE.rglob('*.py')
    if kernels_of(ast.parse(path.read_text()))
)


@pytest.mark.parametrize('name', ALONE)
def test_a_kernel_file_imports_no_code_of_another_and_a_kernel_has_its_helpers_in_it(name):
    """Called from two kernels a helper would be compiled three times."""
    tree = ast.parse((PACKAGE / name).read_text())
    wrong = [(module, own) for module, own in imported(tree) if own not in ALLOWED.get(module, ())]
    assert wrong == []
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
    command = [sys.executable, '-c', program]
    done = subprocess.run(command, capture_output=True, text=True, cwd=PACKAGE.parent)
    assert done.stdout.split() == ['False', 'True'], done.stderr
