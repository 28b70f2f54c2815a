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

"""The launch files under the real ``ros2 launch``, where a machine has it.

Needs the ROS 2 command line and an install of this package on the ament path. PyPI has neither, so
elsewhere this is skipped; CONTRIBUTING.md has the procedure.
"""

from __future__ import annotations

import os
import queue
import shutil
import signal
import subprocess
import threading
import time

import pytest

from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.replay.harness import reserved_domain_id

pytestmark = pytest.mark.system
START_LIMIT = 240.0  # seconds; four nodes compile their kernels at once when the cache is empty
STOP_LIMIT = 120.0


@pytest.fixture
def ros2() -> str:
    """The program, when launch and this package can be found by it."""
    pytest.importorskip('launch_xml', reason='ROS 2 launch is not installed')
    packages = pytest.importorskip('ament_index_python.packages')
    program = shutil.which('ros2')
    if program is None:
        pytest.skip('ros2 is not on the PATH')
    for package in ('launch', 'sonar_imm'):
        try:
            packages.get_package_prefix(package)
        except (LookupError, OSError) as error:
            pytest.skip(f'not on the ament path: {error}')
    return program


@pytest.mark.parametrize(
    ('name', 'nodes'),
    [('diver', ['auv.diver']), ('all', [f'auv.{system}' for system in SYSTEMS])],
)
def test_launched_nodes_get_ready_in_their_namespace_and_end_on_ctrl_c(ros2, name, nodes):
    with reserved_domain_id() as domain:
        launch = subprocess.Popen(
            [ros2, 'launch', 'sonar_imm', f'{name}.launch.xml', 'namespace:=/auv'],
            env=os.environ
            | {'ROS_DOMAIN_ID': str(domain), 'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'},
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        )
        output = Output(launch)
        try:
            output.wait_for(lambda line, node: f'[{node}]' in line and 'ready' in line, nodes)
            # The terminal sends Ctrl-C to launch and to its nodes alike.
            os.killpg(launch.pid, signal.SIGINT)
            launch.wait(STOP_LIMIT)
        finally:
            if launch.poll() is None:
                os.killpg(launch.pid, signal.SIGKILL)
                launch.wait()
        rest = output.rest()
    assert launch.returncode in (0, 1), rest  # launch itself answers Ctrl-C with 1
    assert 'process has died' not in rest
    assert 'Traceback' not in rest
    assert rest.count('process has finished cleanly') == len(nodes)


class Output:
    """What a process prints, read in a thread so that waiting for a line has a limit."""

    def __init__(self, process: subprocess.Popen[str]):
        self._process = process
        self._lines: queue.Queue[str] = queue.Queue()
        self._printed = ''
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        for line in self._process.stdout:
            self._lines.put(line)

    def wait_for(self, matches, names: list[str]) -> None:
        """Read on until a line has come for which `matches(line, name)` holds, for every name."""
        waiting, end = set(names), time.monotonic() + START_LIMIT
        while waiting and time.monotonic() < end and self._process.poll() is None:
            try:
                line = self._lines.get(timeout=0.5)
            except queue.Empty:
                continue
            self._printed += line
            waiting = {name for name in waiting if not matches(line, name)}
        assert not waiting, self._printed

    def rest(self) -> str:
        """Everything that was printed, once the process has ended."""
        self._reader.join(STOP_LIMIT)
        while not self._lines.empty():
            self._printed += self._lines.get()
        return self._printed
