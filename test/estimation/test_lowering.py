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

"""What `estimation.lowering` writes for LLVM is compared with Python itself."""

import importlib

from numba.core.lowering import Lower
from numba.core.runtime import _nrt_python, rtsys
import numpy as np
import pytest

from sonar_imm.estimation import jit, lowering


def walk(P, at, k):
    """Ways to index an array and to count that `lowering` writes itself, and some it leaves."""
    total, last = 0.0, -1
    seen, flags = np.zeros((3, len(at)), dtype=np.int64), np.zeros(len(at), dtype=np.bool_)
    for i in range(len(at) - 1, -1, -1):
        row = P[at[i]]
        flags[-i] = row[-1] > 0.5
        for j in range(-2, 2):
            seen[j, i] += j
            total += row[j] * (i + 1)
            last = j
        if flags[i]:
            continue
        for j in range(i, len(at), 2):
            seen[0, j] -= i
    for i in range(3, k):
        total -= i
    a, b = P[0], P[1]
    for i in range(k):
        a, b = b, a
        x = P[i % len(P)] if i % 2 else b
        b[1], x[0] = x[0] + a[2], b[1]
        view = P[1:, i % 2]
        total += view[0] + P[:, 1][i % 2] + view.shape[0]
    n = 0
    while n < P.shape[0]:
        P[n, :] += n
        total += P[n].shape[0] + P[n, 1] + P[n][2]
        n += 1
    cube = np.arange(24.0).reshape(2, 3, 4)
    for i in range(-1, 2):
        inner = cube[i]
        inner[1, -1] = total
        total += inner[i, i] + cube[i, 1, 2]
    return total, last, seen, flags, P.T[1], cube


@pytest.fixture
def counted():
    """numba counts what is allocated and freed."""
    _nrt_python.memsys_enable_stats()
    yield
    _nrt_python.memsys_disable_stats()


@pytest.mark.parametrize('k', range(6))
def test_a_kernel_does_what_python_does_and_frees_its_memory(k, counted):
    at, before = np.array([0, -1, 2, 1, -2]), rtsys.get_allocation_stats()
    for mine, expected in zip(
        *(f(np.random.default_rng(k).normal(size=(4, 3)), at, k) for f in (walked, walk)),
        strict=True,
    ):
        assert np.asarray(mine).tobytes() == np.asarray(expected).tobytes()
    del mine, expected
    after = rtsys.get_allocation_stats()
    assert after.alloc - before.alloc == after.free - before.free > 0


walked = jit.kernel(walk)


@pytest.mark.parametrize(
    'part', ['compiler.DefaultPassBuilder', 'lowering.Lower', 'typed_passes.NativeLowering']
)
def test_without_a_part_of_numbas_compiler_kernels_take_all_of_its_passes(part, monkeypatch):
    module, _, name = part.partition('.')
    monkeypatch.delattr(importlib.import_module(f'numba.core.{module}'), name)
    assert lowering.fewer_passes() == {}


def test_where_numbas_lowering_has_another_form_it_is_left_as_it_is(monkeypatch):
    assert lowering.fewer_passes()
    monkeypatch.setattr(Lower, 'storevar', lambda self, value, name: None)
    assert lowering.fewer_passes() == {}


@pytest.mark.parametrize('version', ['0.57.1', '0.69.0', '0.580.0', '1.0.0'])
def test_a_version_of_numba_that_nobody_has_read_compiles_in_its_own_way(version, monkeypatch):
    monkeypatch.setattr(lowering.numba, '__version__', version)
    assert lowering.fewer_passes() == {}
