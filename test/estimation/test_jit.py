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

"""Compiling: the cache is used when it can be, and is no condition."""

import ast
import gc
import hashlib
import importlib
import math
import os
from pathlib import Path
import shutil

from helpers.kernel_process import ROOT, run
import numba
from numba.core import caching, types
import numpy as np
import pytest

from sonar_imm.estimation import jit, lowering


def test_without_any_place_for_a_cache_a_kernel_still_works(monkeypatch):
    """What numba does in a container with a read-only installation and no home."""
    monkeypatch.setattr(caching.CompileResultCacheImpl, '_locator_classes', [])
    jit._warn_of_no_cache.cache_clear()
    with pytest.warns(RuntimeWarning, match='no folder can be written') as warned:
        doubled, halved = jit.kernel(lambda x: 2.0 * x), jit.kernel(lambda x: 0.5 * x)
    assert len(warned) == 1
    assert doubled(2.0) == 4.0 and halved(2.0) == 1.0
    assert doubled.stats.cache_path is None


@pytest.fixture
def fresh(tmp_path, monkeypatch):
    """Makes the same kernel as a new process does: it knows only what is in the folder."""
    monkeypatch.setattr(numba.config, 'CACHE_DIR', str(tmp_path))
    jit._warn_of_no_cache.cache_clear()

    def doubled(x):
        return x + x

    def result_and_hits():
        compiled = jit.kernel(doubled)
        return compiled(2.0), sum(compiled.stats.cache_hits.values())

    return result_and_hits


def test_a_full_disk_costs_a_sentence_and_not_the_process(fresh, tmp_path):
    """The limit on the size of files fails a write as a full disk does: after the folder and the
    file were made."""
    resource = pytest.importorskip('resource')
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        with pytest.warns(RuntimeWarning, match='compiled in memory') as warned:
            assert [fresh(), fresh()] == [(4.0, 0), (4.0, 0)]
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert len(warned) == 1 and not list(tmp_path.rglob('*.nbc*'))
    assert [fresh(), fresh()] == [(4.0, 0), (4.0, 1)]


@jit.kernel
def caller(x, y):
    return callee(x) + callee(y)


@jit.kernel
def callee(x):
    """It has
    four lines."""
    return 0.5 * x


def test_progress_counts_kernels_with_their_callees_and_time_goes_with_lines(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(jit.time, 'monotonic', lambda: clock[0])
    monkeypatch.setattr(jit, 'present', {})
    caller._cache.flush()
    callee._cache.flush()
    progress = jit.Progress((5, 32))
    assert progress.sentence() == ''
    assert caller(1.0, 2.0) == 1.5
    assert jit.present == {f'{__name__}.caller': 3, f'{__name__}.callee': 5}
    clock[0] += 2.0
    once = 'kernels, once for this machine'
    assert progress.sentence() == f'compiling 3 of 5 {once}, some 6 s more'
    progress.needed = 2, 8
    assert progress.sentence() == f'compiling {once}: 2 so far'
    assert jit.Progress((5, 32)).sentence() == ''


def test_a_loaded_kernel_counts_with_its_callees(monkeypatch):
    caller(1.0, 2.0)
    monkeypatch.setattr(jit, 'present', {})
    loaded = jit.kernel(caller.py_func)
    assert loaded(1.0, 2.0) == 1.5 and sum(loaded.stats.cache_hits.values()) == 1
    assert set(jit.present) == {f'{__name__}.caller', f'{__name__}.callee'}


def test_what_is_left_out_of_compiling_changes_no_bit(monkeypatch):
    def spread(P, count):
        out, total = np.zeros((count, P.shape[1])), 0.0
        for k in range(count):
            row = P[k % len(P)]
            for a in range(len(row)):
                out[k, a] = math.exp(-row[a]) / (1.0 + abs(total)) + 0.1 * k
                total += out[k, a] if row[a] > 0.0 else -(row[a] ** 2)
        if not total > -1e6:
            raise ValueError('too far')
        return out[1:], total, np.sum(P[:, 0]), max(k, 2)

    resolved, resolve = [], types.Function.get_call_type
    monkeypatch.setattr(types.Function, 'get_call_type', resolve)  # and back, at the end
    monkeypatch.setattr(
        lowering, '_resolve', lambda *args: resolved.append(args) or resolve(*args)
    )
    monkeypatch.setattr(lowering, '_resolved', {})
    P = np.random.default_rng(3).normal(size=(5, 4))
    options = {name: jit._OPTIONS[name] for name in ('nogil', 'error_model')}
    own, numbas = jit.kernel(spread), numba.njit(**options)(spread)
    (out, *rest), (expected, *others) = own(P, 7), numbas(P, 7)
    assert out.tobytes() == expected.tobytes() and rest == others
    with pytest.raises(ValueError, match='too far'):
        own(np.full((5, 4), -1e6), 7)
    asked = [(id(function), args) for function, _, args, _ in resolved]
    scalars = [each for each in asked if set(each[1]) == {types.float64}]
    assert scalars and len(scalars) == len(set(scalars))


def test_a_number_that_a_caller_writes_out_is_no_type_of_its_own():
    inner = jit.kernel(lambda values, k: values[k])
    outer = jit.kernel(lambda values, k: inner(values, 0) + inner(values, 1) + inner(values, k))
    assert outer(np.arange(5.0), 2) == 3.0 and len(inner.signatures) == 1


def test_no_kernel_gives_an_array_to_a_slice():
    """numba then compiles thirty functions more, which say what does not fit."""
    found = []
    for file in (ROOT / 'sonar_imm').rglob('*.py'):
        for function in ast.walk(ast.parse(file.read_text())):
            decorators = getattr(function, 'decorator_list', [])
            if 'kernel' not in [getattr(each, 'id', '') for each in decorators]:
                continue
            for node in ast.walk(function):
                slices = [
                    part
                    for target in getattr(node, 'targets', [getattr(node, 'target', node)])
                    for part in ast.walk(target)
                    if isinstance(node, ast.Assign | ast.AugAssign) and isinstance(part, ast.Slice)
                ]
                if slices and not isinstance(node.value, ast.Constant):
                    found.append(f'{file.name}:{node.lineno}')
    assert not found


@pytest.mark.parametrize('before', [(700, 10, 10), (0, 10, 10)])
def test_garbage_is_looked_for_rarely_while_numba_compiles_and_then_as_before(before, monkeypatch):
    seen = []
    monkeypatch.setattr(jit, 'listeners', [lambda: seen.append(gc.get_threshold())])
    other = gc.get_threshold()
    gc.set_threshold(*before)
    try:
        caller._cache.flush()
        callee._cache.flush()
        monkeypatch.setitem(globals(), 'callee', jit.kernel(callee.py_func))
        assert jit.kernel(caller.py_func)(1.0, 2.0) == 1.5
        after = gc.get_threshold()
    finally:
        gc.set_threshold(*other)
    # The callee is compiled inside of the caller, which is kept when it is compiled.
    assert seen == [(100_000, 50, 100) if before[0] else before, before] and after == before


DAMAGE = {
    'bit': lambda content: content[:3000] + bytes([content[3000] ^ 4]) + content[3001:],
    'cut': lambda content: content[:-9],
    'empty': lambda content: b'',
    'zeros': lambda content: bytes(len(content)),
}


@pytest.mark.filterwarnings('error')
@pytest.mark.parametrize('damage', DAMAGE)
def test_a_damaged_file_is_compiled_anew(fresh, tmp_path, damage):
    """LLVM ends a process that gives it a damaged file, so it must not see any."""
    fresh()
    (path,) = tmp_path.rglob('*.nbc')
    path.write_bytes(DAMAGE[damage](path.read_bytes()))
    assert [fresh(), fresh()] == [(4.0, 0), (4.0, 1)]


def test_a_file_that_cannot_be_unpacked_is_compiled_anew(fresh, tmp_path):
    """A checksum that holds says nothing of what another program packed."""
    fresh()
    (path,) = tmp_path.rglob('*.nbc')
    packed = b'cnowhere\nNothing\n.'
    path.write_bytes(hashlib.sha256(packed).digest() + packed)
    with pytest.warns(RuntimeWarning, match='ModuleNotFoundError'):
        assert fresh() == (4.0, 0)
    assert fresh() == (4.0, 1)


@pytest.mark.filterwarnings('error')
def test_a_folder_that_is_deleted_while_a_process_runs_is_made_again(fresh, tmp_path):
    fresh()
    for folder in tmp_path.iterdir():
        shutil.rmtree(folder)
    assert [fresh(), fresh()] == [(4.0, 0), (4.0, 1)]


@pytest.mark.parametrize('place', ['the folder', 'a folder in it'])
def test_a_file_where_the_cache_should_be_costs_a_sentence(fresh, tmp_path, monkeypatch, place):
    implementation = caching.CompileResultCacheImpl
    only = [
        locator
        for locator in implementation._locator_classes
        if 'UserProvided' in locator.__name__
    ]
    monkeypatch.setattr(implementation, '_locator_classes', only)
    if place == 'a folder in it':
        fresh()
        for folder in tmp_path.iterdir():
            shutil.rmtree(folder)
            folder.write_text('')
    else:
        (tmp_path / 'file').write_text('')
        monkeypatch.setattr(numba.config, 'CACHE_DIR', str(tmp_path / 'file'))
    with pytest.warns(RuntimeWarning, match='no folder can be written') as warned:
        for _ in range(2):
            assert jit.kernel(lambda x: x + x)(2.0) == 4.0
    assert len(warned) == 1


def test_a_folder_of_another_user_costs_a_sentence(fresh, monkeypatch):
    def denied(path, content):
        raise PermissionError(13, 'Permission denied')

    with monkeypatch.context() as patch, pytest.warns(RuntimeWarning, match='denied') as warned:
        patch.setattr(Path, 'write_bytes', denied)
        assert [fresh(), fresh()] == [(4.0, 0), (4.0, 0)]
    assert len(warned) == 1
    assert [fresh(), fresh()] == [(4.0, 0), (4.0, 1)]


@pytest.mark.filterwarnings('error')
def test_two_versions_of_numba_leave_each_other_alone(fresh, tmp_path, monkeypatch):
    """Code of one is neither loaded nor removed by the other."""
    fresh()
    with monkeypatch.context() as patch:
        patch.setattr(numba, '__version__', '0.0.1')
        assert [fresh(), fresh()] == [(4.0, 0), (4.0, 1)]
    assert fresh() == (4.0, 1)
    assert len(list(tmp_path.rglob('*.nbc'))) == 2


SMALL = {
    'estimation/constants.py': 'SHIFT = 0.25\n',
    'acoustics/callee.py': """
from ..estimation.constants import SHIFT
from ..estimation.jit import kernel

@kernel
def shifted(x):
    return x + SHIFT
""",
    'acoustics/caller.py': """
from ..estimation.jit import kernel
from .callee import shifted

@kernel
def double(x, out):
    out[0] = 2.0 * shifted(x)
""",
}
CALL = """
import numpy as np
from sonar_imm.acoustics.caller import double
out = np.empty(1)
double(1.0, out)
print(out[0], sum(double.stats.cache_hits.values()))
"""


@pytest.fixture
def root(tmp_path):
    """Of a package with a kernel, a callee and a constant in files of their own, and our `jit`."""
    package = tmp_path / 'root' / 'sonar_imm'
    for room in ('estimation', 'acoustics'):
        (package / room).mkdir(parents=True)
        (package / room / '__init__.py').touch()
    (package / '__init__.py').touch()  # else one that is installed is found first
    for name, text in SMALL.items():
        (package / name).write_text(text)
    for module in (jit, lowering):
        shutil.copy(module.__file__, package / 'estimation')
    return package.parent


def test_what_was_compiled_beside_the_source_serves_others(root, tmp_path):
    """Who installed the package compiled it; another user can only read that folder."""
    elsewhere = (
        'from numba.core.caching import CacheImpl as impl;'
        'impl._locator_classes = [c for c in impl._locator_classes if "InTree" not in c.__name__];'
    )
    assert run(CALL, root, '') == ['2.5', '0']
    assert list((root / 'sonar_imm' / 'acoustics' / '__pycache__').glob('*.nbc'))
    assert run(elsewhere + CALL, root, '', XDG_CACHE_HOME=str(tmp_path / 'home')) == ['2.5', '1']
    # NUMBA_CACHE_DIR is the only folder.
    assert run(CALL, root, tmp_path / 'other') == ['2.5', '0']
    for path in root.rglob('*.nbc'):
        path.unlink()
    nowhere = {'HOME': os.devnull, 'XDG_CACHE_HOME': ''}
    assert run(elsewhere + CALL, root, '', **nowhere) == ['2.5', '0']


def test_a_named_folder_serves_other_processes_until_a_source_changes(root, tmp_path):
    """`NUMBA_CACHE_DIR` takes what a read-only installation cannot. A callee or a constant of
    another file is a source too."""
    cache, package = tmp_path / 'cache', root / 'sonar_imm'
    assert [run(CALL, root, cache) for _ in range(2)] == [['2.5', '0'], ['2.5', '1']]
    assert list(cache.rglob('*.nbc')) and not list(root.rglob('*.nbc'))
    edit(package / 'acoustics/callee.py', 'x + SHIFT', 'x - SHIFT')
    assert run(CALL, root, cache) == ['1.5', '0']
    edit(package / 'estimation/constants.py', '0.25', '0.5')
    assert run(CALL, root, cache) == ['1.0', '0']


def test_code_that_is_not_the_same_is_never_in_the_same_file(monkeypatch):
    """Of numba's own cache the second of two signatures, compiled in two processes at once, or
    code of another state of the sources, could be read as the first."""

    def doubled(x):
        return x + x

    def compiled(digest='first'):
        monkeypatch.setattr(jit, 'digest_of', lambda path: digest)
        return jit.kernel(doubled)

    def files(function):
        folder, line = Path(function.stats.cache_path), doubled.__code__.co_firstlineno
        return {path: path.read_bytes() for path in folder.glob(f'*doubled-{line}.*.nbc')}

    mine, other = compiled(), compiled()
    mine._cache.flush()
    assert mine(2.0) == 4.0
    first = files(mine)
    assert other(2) == 4 and compiled('second')(2.0) == 4.0
    both = files(mine)
    assert len(first) == 1 and len(both) == 3 and first.items() <= both.items()
    loaded = compiled()
    assert loaded(3.0) == 6.0 and type(loaded(3)) is int
    assert sum(loaded.stats.cache_hits.values()) == 2


def test_a_file_that_holds_something_else_is_not_used():
    @jit.kernel
    def halved(x):
        return 0.5 * x

    @jit.kernel
    def thirded(x):
        return x / 3.0

    for function in (halved, thirded):
        function._cache.flush()
        function(1.0)
    folder = Path(halved.stats.cache_path)
    (mine,), (foreign,) = folder.glob('*halved*.nbc'), folder.glob('*thirded*.nbc')
    shutil.copy(foreign, mine)
    cache_file = halved._cache._cache_file
    key = halved._cache._index_key(halved.signatures[0], halved.targetctx.codegen())
    assert cache_file.load(key) is None
    thirded._cache.flush()
    halved._cache.flush()
    assert not list(folder.glob('*halved*.nbc'))


def test_code_of_old_sources_is_removed_after_a_while(monkeypatch):
    def tripled(x):
        return 3.0 * x

    kernels = []
    for digest in ('first', 'second', 'third'):
        monkeypatch.setattr(jit, 'digest_of', lambda path, digest=digest: digest)
        kernels.append(jit.kernel(tripled))
        kernels[-1](1.0)
        folder = Path(kernels[-1].stats.cache_path)
        for path in folder.glob('*tripled*.nbc'):
            if digest == 'first':
                os.utime(path, (0, 0))
    assert len(list(folder.glob('*tripled*.nbc'))) == 2
    kernels[-1]._cache.flush()


def edit(path, old, new):
    text = path.read_text(encoding='utf-8')
    assert text.count(old) == 1
    path.write_text(text.replace(old, new), encoding='utf-8')


def test_code_with_and_without_bounds_checks_is_not_confused(root, tmp_path, monkeypatch):
    monkeypatch.delenv('NUMBA_BOUNDSCHECK', raising=False)
    assert run(CALL, root, tmp_path) == ['2.5', '0']
    monkeypatch.setenv('NUMBA_BOUNDSCHECK', '1')
    beyond = f"""
try:{CALL.replace('np.empty(1)', 'np.empty(0)').replace(chr(10), chr(10) + '    ')}
except IndexError:
    print('checked')
"""
    assert run(beyond, root, tmp_path) == ['checked']


def test_a_digest_follows_every_form_of_import(tmp_path):
    package = tmp_path / 'package'
    files = {
        'caller.py': 'from .first import (\n    a,  # why\n    b as c,\n)\nfrom . import two\n',
        'first.py': 'from .deep import four\nfrom os import path\n',
        'two.py': 'from .caller import loop\n',
        'deep/__init__.py': '',
        'deep/four.py': 'from ..five import e\n',
        'five.py': 'e = 1\n',
        'apart.py': '',
    }
    for name, text in files.items():
        (package / name).parent.mkdir(parents=True, exist_ok=True)
        (package / name).write_text(text)

    def digest():
        return jit.digest_of(str(package / 'caller.py'))

    seen = {digest()}
    for name in files:
        (package / name).write_text((package / name).read_text() + '# changed\n')
        assert (digest() in seen) == (name in {'apart.py'}), name
        seen.add(digest())


MODULE = """
from sonar_imm.estimation.jit import kernel

@kernel
def scaled(x):
    return 2.0 * x
"""


def test_compiled_code_is_valid_for_the_contents_of_files_whatever_their_dates(tmp_path):
    """A copy with other dates, as a checkout or a wheel makes it, loads what was compiled."""
    folder = tmp_path / 'first'
    folder.mkdir()
    (folder / 'module.py').write_text(MODULE)
    os.utime(folder / 'module.py', (1e9, 1e9))
    code = f"""
import sys
sys.path.append({str(ROOT)!r})
import module
print(module.scaled(1.0), sum(module.scaled.stats.cache_hits.values()))
"""
    assert run(code, folder, '') == ['2.0', '0']
    copied = shutil.copytree(folder, tmp_path / 'copied', copy_function=shutil.copy)
    assert (copied / 'module.py').stat().st_mtime > 1.1e9
    assert run(code, copied, '') == ['2.0', '1']
    edit(copied / 'module.py', '2.0', '3.0')
    os.utime(copied / 'module.py', (1e9, 1e9))
    assert run(code, copied, '') == ['3.0', '0']


def test_a_module_that_is_edited_and_loaded_again_is_compiled_anew(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    path = tmp_path / 'edited_module.py'
    path.write_text(MODULE)
    import edited_module

    assert edited_module.scaled(1.0) == 2.0
    path.write_text(MODULE.replace('2.0', '-2.5'))
    assert importlib.reload(edited_module).scaled(1.0) == -2.5


def gone(monkeypatch):
    monkeypatch.delattr(caching, 'FunctionCache')


def without_files(monkeypatch):
    class Other(caching.FunctionCache):
        def __init__(self, function):
            super().__init__(function)
            del self._cache_file

    monkeypatch.setattr(caching, 'FunctionCache', Other)


def called_otherwise(monkeypatch):
    class Files(caching.IndexDataCacheFile):
        def save(self, key, data, compress):
            super().save(key, data)

    class Other(caching.FunctionCache):
        def __init__(self, function):
            super().__init__(function)
            self._cache_file = Files('', '', '')

    monkeypatch.setattr(caching, 'FunctionCache', Other)


@pytest.mark.parametrize('change', [gone, without_files, called_otherwise])
def test_with_another_numba_its_own_cache_is_used_and_a_warning_says_so(change, monkeypatch):
    def quadrupled(x):
        return 4.0 * x

    with monkeypatch.context() as patch:
        change(patch)
        jit._warn_of_other_numba.cache_clear()
        jit._check_verbs.cache_clear()
        with pytest.warns(RuntimeWarning, match="numba's own cache is used") as warned:
            compiled = [jit.kernel(quadrupled) for _ in range(2)]
    assert len(warned) == 1 and warned[0].filename == __file__
    assert compiled[0](2.0) == 8.0
    folder = Path(compiled[0].stats.cache_path)
    assert list(folder.glob('*quadrupled*.nbi'))
    for path in folder.glob('*quadrupled*.nb?'):
        path.unlink()


def test_with_another_numba_and_no_place_for_a_cache_a_kernel_still_works(monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(caching.CompileResultCacheImpl, '_locator_classes', [])
        patch.delattr(caching, 'FunctionCache')
        jit._warn_of_other_numba.cache_clear()
        with pytest.warns(RuntimeWarning):
            tripled = jit.kernel(lambda x: 3.0 * x)
    assert tripled(2.0) == 6.0 and tripled.stats.cache_path is None
