# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Nodes and launch files under the real ``ros2`` command, where a machine has it.

Needs the ROS 2 command line and an install of this package on the ament path. PyPI has neither, so
elsewhere this is skipped; CONTRIBUTING.md has the procedure.
"""

from __future__ import annotations

import contextlib
import os
import queue
import re
import shutil
import signal
import subprocess
import threading
import time

from helpers.source import ROOT
import pytest
import yaml

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


@pytest.fixture
def domain():
    """The environment of a ROS domain that nobody else uses."""
    with reserved_domain_id() as number:
        yield os.environ | {
            'ROS_DOMAIN_ID': str(number),
            'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
            'RCUTILS_COLORIZED_OUTPUT': '0',
        }


@contextlib.contextmanager
def started(words, environment):
    """A program in a session of its own, as a terminal starts it, and what it says; ends by Ctrl-C
    to the whole session."""
    process = subprocess.Popen(
        [str(word) for word in words],
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    output = Output(process)
    try:
        yield output
        os.killpg(process.pid, signal.SIGINT)
        process.wait(STOP_LIMIT)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    assert process.returncode in (0, 1), output.rest()  # launch itself answers Ctrl-C with 1
    assert 'Traceback' not in output.rest()


NODES = [*SYSTEMS, 'fls_detector']


@pytest.mark.parametrize('name', NODES)
def test_a_session_with_a_node(ros2, domain, name, tmp_path):
    """node, lifecycle, param, topic and service; and what is dumped starts a node that dumps the
    same."""

    def say(*words, told=''):
        """What a command prints; asked again until `told` is part of it, as discovery needs."""
        end, done = time.monotonic() + 120.0, None
        while done is None or (told not in done.stdout and time.monotonic() < end):
            done = subprocess.run(
                [ros2, *words], env=domain, capture_output=True, text=True, timeout=120.0
            )
        assert told in done.stdout, (words, done.stdout, done.stderr)
        return done.stdout

    file = tmp_path / f'{name}.yaml'
    run = [ros2, 'run', 'sonar_imm', f'{name}_node', '--ros-args']
    more = []
    if name == 'fls_detector':  # the default needs a package
        more = ['-p', "input_types:=['image=sensor_msgs/msg/Image']"]
    managed = 'std_srvs/srv/Trigger' if name in SYSTEMS else ''
    with started([*run, '-p', 'autostart:=false', *more], domain) as output:
        say('node', 'list', told=f'/{name}\n')
        assert say('lifecycle', 'get', f'/{name}', told='[').strip() == 'unconfigured [1]'
        say('lifecycle', 'set', f'/{name}', 'configure', told='Transitioning successful')
        say('lifecycle', 'set', f'/{name}', 'activate', told='Transitioning successful')
        output.wait_for(lambda line, node: 'ready, hears' in line, [name])
        say('param', 'set', f'/{name}', 'stale_after', '7.5', told='Set parameter successful')
        say('param', 'get', f'/{name}', 'stale_after', told='7.5')
        say('param', 'describe', f'/{name}', 'stale_after', told='Description: ')
        say('topic', 'info', f'/{name}/processed', told='Publisher count: 1')
        say('topic', 'echo', '--once', f'/{name}/processed', told='point_step')
        if managed:
            reset = say('service', 'call', f'/{name}/reset', managed, told='success=True')
            assert 'forgotten' in reset
        file.write_text(say('param', 'dump', f'/{name}', told='ros__parameters'))
        say('lifecycle', 'set', f'/{name}', 'deactivate', told='Transitioning successful')
    assert yaml.safe_load(file.read_text())[f'/{name}']['ros__parameters']['stale_after'] == 7.5
    # The file comes first: what is told before it, for all nodes, gives way to all of the file.
    with started([*run, '--params-file', file, '-p', 'autostart:=true'], domain) as output:
        output.wait_for(lambda line, node: 'ready, hears' in line, [name])
        again = say('param', 'dump', f'/{name}', told='ros__parameters')
    assert again == file.read_text().replace('autostart: false', 'autostart: true')


@pytest.mark.parametrize(
    ('name', 'nodes'),
    [('diver', ['auv.diver']), ('all', [f'auv.{system}' for system in SYSTEMS])],
)
def test_launched_nodes_get_ready_in_their_namespace_and_end_on_ctrl_c(ros2, domain, name, nodes):
    words = [ros2, 'launch', 'sonar_imm', f'{name}.launch.xml', 'namespace:=/auv']
    with started(words, domain) as output:
        output.wait_for(lambda line, node: f'[{node}]' in line and 'ready' in line, nodes)
    rest = output.rest()
    assert 'process has died' not in rest
    assert rest.count('process has finished cleanly') == len(nodes)


def test_the_launch_file_of_the_tutorial_runs(ros2, domain, tmp_path):
    """Its obstacle node hears what the page renames, with the parameters of the page."""
    packages = pytest.importorskip('ament_index_python.packages')
    try:
        packages.get_package_prefix('tf2_ros')
    except LookupError as error:
        pytest.skip(f'not on the ament path: {error}')
    page = (ROOT / 'docs/tutorials/ros_avoidance.md').read_text(encoding='utf-8')
    (text,) = re.findall(r'^```xml\n(.*?)^```$', page, re.MULTILINE | re.DOTALL)
    (parameters,) = re.findall(r"<<'EOF'\n(/\*\*:\n.*?)^EOF$", page, re.MULTILINE | re.DOTALL)
    file, params_file = tmp_path / 'avoidance.launch.xml', tmp_path / 'my_obstacle.yaml'
    params_file.write_text(parameters)
    file.write_text(text.replace('/home/auv/my_obstacle.yaml', str(params_file)))
    with started([ros2, 'launch', file], domain) as output:
        output.wait_for(
            lambda line, topic: 'ready, hears' in line and topic in line,
            ['/sonar/targets', '/ekf/odometry'],
        )
        words = [ros2, 'param', 'get', '/obstacle', 'safety_radius']
        told = subprocess.run(words, env=domain, capture_output=True, text=True, timeout=60.0)
        assert '4.0' in told.stdout
    assert 'process has died' not in output.rest()


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
