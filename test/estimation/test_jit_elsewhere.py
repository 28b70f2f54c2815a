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

"""Kernels that another process compiles."""

import importlib
import signal
import sys
import threading

from helpers.kernel_process import ROOT, run
import numba
import pytest

from sonar_imm import files
from sonar_imm.estimation import jit
from sonar_imm.files import lock

STRANGER = """
import time

from sonar_imm.estimation import jit

@jit.kernel
def halved(x):
    return 0.5 * x

def work():
    assert halved(4.0) == 2.0

def steps():
    return [('work', work), ('sleep', lambda: time.sleep(600.0))]
"""


@pytest.fixture
def stranger(tmp_path, monkeypatch):
    """A module with a kernel that nobody has compiled, and a folder of its own for it."""
    (tmp_path / 'stranger.py').write_text(STRANGER)
    cache = tmp_path / 'kernels'
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(cache))
    monkeypatch.setattr(numba.config, 'CACHE_DIR', str(cache))
    monkeypatch.syspath_prepend(tmp_path)
    jit._warn_of_no_cache.cache_clear()
    yield importlib.import_module('stranger')
    del sys.modules['stranger']


@pytest.fixture
def elsewhere(stranger):
    process = jit.Elsewhere.begin(stranger.steps)
    yield process
    process.close()


def test_another_process_compiles_and_this_one_loads(stranger, elsewhere):
    before = jit.kernels.copy()
    assert not jit.kept(stranger.work) and jit.kernels == before
    elsewhere.compile('work')
    assert jit.kernels - before == {'compiled': 1} and jit.present['stranger.halved'] == 3
    assert jit.kept(stranger.work) and jit.kernels - before == {'compiled': 1, 'loaded': 1}
    elsewhere.compile('work')  # nothing is left
    assert jit.kernels - before == {'compiled': 1, 'loaded': 1}


@pytest.fixture
def at_it(stranger, tmp_path):
    """As if another process were compiling `stranger.halved`: the file that it has locked, and
    what it will write, with its name."""
    if files.fcntl is None:
        pytest.skip('there are no locks')
    code = f'import sys; sys.path.append({str(tmp_path)!r}); import stranger; stranger.work()'
    run(code, ROOT, tmp_path / 'kernels')
    (made,) = (tmp_path / 'kernels').rglob('*.nbc')
    content = made.read_bytes()
    made.unlink()
    with made.with_suffix('.lock').open('w') as locked:
        lock(locked.fileno())
        yield locked, made, content
    assert not list((tmp_path / 'kernels').rglob('*.lock'))


def test_what_another_process_compiles_is_waited_for_and_loaded(stranger, at_it, monkeypatch):
    """The command, a node and `warm` start side by side, and need the same kernels."""
    locked, made, content = at_it
    waited = []

    def ends(seconds):
        waited.append(seconds)
        if len(waited) == 3:
            made.write_bytes(content)
            locked.close()

    monkeypatch.setattr(jit.time, 'sleep', ends)
    before = jit.kernels.copy()
    stranger.work()
    assert len(waited) == 3 and jit.kernels - before == {'loaded': 1}


def test_nobody_waits_for_ever_nor_twice(stranger, at_it, monkeypatch):
    """For a process that was stopped while it compiled."""
    monkeypatch.setattr(jit._FilePerKey, 'patience', 0.1)
    before = jit.kernels.copy()
    stranger.work()
    assert jit.kernels - before == {'compiled': 1} and jit._FilePerKey.patience == 0.0


def test_without_locks_a_kernel_is_compiled_at_once(stranger, at_it, monkeypatch):
    """As on Windows, and on file systems without them."""
    monkeypatch.setattr(files, 'fcntl', None)
    monkeypatch.setattr(jit.time, 'sleep', None)
    before = jit.kernels.copy()
    stranger.work()
    assert jit.kernels - before == {'compiled': 1}


def test_what_cannot_be_kept_elsewhere_is_compiled_here(stranger):
    resource = pytest.importorskip('resource')
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100, before[1]))  # as a full disk
    process = jit.Elsewhere.begin(stranger.steps)
    try:
        process.compile('work')
        process.compile('work')  # it has ended
        assert not jit.kept(stranger.work)
        with pytest.warns(RuntimeWarning, match='compiled in memory'):
            stranger.work()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        process.close()
    assert jit.kept(stranger.work)


def test_what_compiles_elsewhere_can_be_stopped(elsewhere):
    threading.Timer(1.0, elsewhere.stop).start()
    elsewhere.compile('sleep')
    assert elsewhere._process.wait(120.0) == -signal.SIGTERM


def test_what_cannot_be_pickled_or_started_is_compiled_here(stranger, monkeypatch):
    assert jit.Elsewhere.begin(lambda: []) is None
    monkeypatch.setattr(sys, 'executable', '/nowhere/python')
    assert jit.Elsewhere.begin(stranger.steps) is None


def test_one_thread_does_without_compiling_and_others_compile(stranger):
    """A message may need a kernel while others are loaded."""
    thread = threading.Thread(target=stranger.work)

    def step():
        thread.start()
        thread.join()

    assert jit.kept(step) and stranger.halved.signatures
