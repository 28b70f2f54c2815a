# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""One thread of algebra, in real processes: counted by the operating system."""

import os
from pathlib import Path
import subprocess
import sys

import pytest

from sonar_imm.trackers import SYSTEMS

ROOT = Path(__file__).resolve().parents[1]
SETTINGS = ('OPENBLAS', 'GOTO', 'OMP', 'MKL', 'BLIS')
CORES = len(os.sched_getaffinity(0)) if hasattr(os, 'sched_getaffinity') else 0

# A module that Python imports at start; it tells at the end how many threads there were.
WITNESS = """
import atexit, sys
def tell():
    import numpy
    status = open('/proc/self/status').read()
    print('threads', status.split('Threads:')[1].split()[0], file=sys.stderr)
atexit.register(tell)
"""

pytestmark = pytest.mark.skipif(
    CORES < 2 or not Path('/proc/self/status').exists(),
    reason='one core: nobody would start a second thread',
)


@pytest.fixture(scope='module')
def threads_of(tmp_path_factory):
    """How many threads Python with `arguments` has at its end, with nothing said of threads in its
    environment but `said`."""
    tmp_path = tmp_path_factory.mktemp('witness')
    (tmp_path / 'sitecustomize.py').write_text(WITNESS)

    def run(*arguments, **said):
        told = tuple(f'{each}_NUM_THREADS' for each in SETTINGS)
        kept = {name: value for name, value in os.environ.items() if not name.startswith(told)}
        paths = os.pathsep.join([str(tmp_path), str(ROOT), str(ROOT / 'test')])
        done = subprocess.run(
            [sys.executable, *arguments], env={**kept, 'PYTHONPATH': paths, **said},
            capture_output=True, text=True, cwd=tmp_path,
        )  # fmt: skip
        assert 'threads ' in done.stderr, done.stderr
        return int(done.stderr.rsplit('threads ', 1)[1].split()[0])

    return run


@pytest.fixture(scope='module')
def loaded_alone(threads_of):
    """Threads of a process that only loads numpy."""
    count = threads_of('-c', 'import numpy')
    if count == 1:
        pytest.skip('the BLAS of this numpy starts no thread when it is loaded')
    return count


INSTALLED = """
import sys
sys.argv[0] = '/opt/lib/sonar_imm/obstacle_node'
from sonar_imm.nodes.commands import main
main()
"""
INFO = ('-m', 'sonar_imm_tools.cli', 'info', str(ROOT / 'bags' / 'diver_table1'))


def test_the_command_has_one_thread_or_what_the_user_says(threads_of, loaded_alone):
    assert threads_of(*INFO) == 1
    for name in ('OPENBLAS_NUM_THREADS', 'OMP_NUM_THREADS'):
        assert threads_of(*INFO, **{name: '2'}) == 2


def test_the_library_leaves_the_process_alone(threads_of, loaded_alone):
    imports = (
        'import sonar_imm, sonar_imm_tools.cli, sonar_imm.estimation.imm, sonar_imm.trackers; '
        'from sonar_imm.trackers.diver.tracker import DiverTracker'
    )
    assert threads_of('-c', imports) >= loaded_alone > 1  # scipy brings a BLAS of its own
    late = (
        'import os, numpy; from sonar_imm.threads import one_blas_thread; '
        'assert not one_blas_thread() and "OPENBLAS_NUM_THREADS" not in os.environ'
    )
    assert threads_of('-c', late) == loaded_alone


def test_a_node_has_one_thread_of_algebra(threads_of, loaded_alone):
    """Its parameters are refused, so it ends by itself; the middleware has threads of its own, and
    so has the BLAS of scipy."""
    pytest.importorskip('rclpy')
    words = ('-c', INSTALLED, '--ros-args', '-p', 'history:=-1.0')
    alone = threads_of(*words, OPENBLAS_NUM_THREADS='1')
    assert threads_of(*words) == alone
    assert threads_of(*words, OPENBLAS_NUM_THREADS='2') > alone


def test_every_node_has_its_command():
    text = (ROOT / 'setup.py').read_text(encoding='utf-8')
    for name in ("f'{system}", "'fls_detector"):
        assert f"{name}_node = sonar_imm.nodes.commands:main'" in text
    for name in (*SYSTEMS, 'fls_detector'):
        module = (ROOT / 'sonar_imm' / 'nodes' / f'{name}.py').read_text(encoding='utf-8')
        assert '\ndef main(' in module
        start = module.index("if __name__ == '__main__':")
        assert 'one_blas_thread()' in module[start : module.index('import sys')]
