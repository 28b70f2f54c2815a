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

import contextlib
import os
import re
import shutil
import signal
import subprocess
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
def ros2():
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
def started(words, environment, log):
    """A program in a session of its own, as a terminal starts it, which says into the file `log`;
    ends by Ctrl-C to the whole session. Gives what waits until `log` has a line with the words and
    each of the names."""

    def wait_for(words, names):
        end = time.monotonic() + START_LIMIT
        while True:
            over = process.poll() is not None or time.monotonic() > end
            lines = log.read_text().splitlines()
            if all(any(words in line and name in line for line in lines) for name in names):
                return
            assert not over, '\n'.join(lines)
            time.sleep(0.1)

    with log.open('w') as file:
        process = subprocess.Popen(
            list(map(str, words)), env=environment, stdout=file, stderr=subprocess.STDOUT,
            start_new_session=True,
        )  # fmt: skip
    try:
        yield wait_for
        os.killpg(process.pid, signal.SIGINT)
        process.wait(STOP_LIMIT)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
    said = log.read_text()
    assert process.returncode in (0, 1) and 'Traceback' not in said, said  # launch: Ctrl-C is 1


@pytest.fixture
def say(ros2, domain):
    """What a command prints; asked again until `told` is part of it, as discovery needs."""

    def say(*words, told=''):
        end, done = time.monotonic() + 120.0, None
        while done is None or (told not in done.stdout and time.monotonic() < end):
            done = subprocess.run([ros2, *words], env=domain, capture_output=True, text=True)
        assert told in done.stdout, (words, done.stdout, done.stderr)
        return done.stdout

    return say


NODES = [*SYSTEMS, 'fls_detector']


@pytest.mark.parametrize('name', NODES)
def test_a_session_with_a_node(ros2, domain, say, name, tmp_path):
    """node, lifecycle, param, topic and service; and what is dumped starts a node that dumps the
    same."""
    file = tmp_path / f'{name}.yaml'
    log, run = tmp_path / 'log', [ros2, 'run', 'sonar_imm', f'{name}_node', '--ros-args']
    more = ['-p', "input_types:=['image=sensor_msgs/msg/Image']"]
    more = [] if name in SYSTEMS else more  # of the detector the default needs a package
    with started([*run, '-p', 'autostart:=false', *more], domain, log) as wait_for:
        say('node', 'list', told=f'/{name}\n')
        assert say('lifecycle', 'get', f'/{name}', told='[').strip() == 'unconfigured [1]'
        say('lifecycle', 'set', f'/{name}', 'configure', told='Transitioning successful')
        say('lifecycle', 'set', f'/{name}', 'activate', told='Transitioning successful')
        wait_for('ready, hears', [''])
        say('param', 'set', f'/{name}', 'stale_after', '7.5', told='Set parameter successful')
        say('param', 'describe', f'/{name}', 'stale_after', told='Description: ')
        say('topic', 'echo', '--once', f'/{name}/processed', told='point_step')
        if name in SYSTEMS:
            reset = 'service', 'call', f'/{name}/reset', 'std_srvs/srv/Trigger'
            assert 'forgotten' in say(*reset, told='success=True')
        file.write_text(say('param', 'dump', f'/{name}', told='ros__parameters'))
        say('lifecycle', 'set', f'/{name}', 'deactivate', told='Transitioning successful')
    assert yaml.safe_load(file.read_text())[f'/{name}']['ros__parameters']['stale_after'] == 7.5
    # The file comes first: what is told before it, for all nodes, gives way to all of the file.
    words = [*run, '--params-file', file, '-p', 'autostart:=true']
    with started(words, domain, log) as wait_for:
        wait_for('ready, hears', [''])
        again = say('param', 'dump', f'/{name}', told='ros__parameters')
    assert again == file.read_text().replace('autostart: false', 'autostart: true')


@pytest.mark.parametrize(
    ('name', 'nodes'), [('diver', ['auv.diver']), ('all', [f'auv.{system}' for system in SYSTEMS])]
)
def test_launched_nodes_get_ready_and_end_on_ctrl_c(ros2, domain, name, nodes, tmp_path):
    """In their namespace."""
    words = [ros2, 'launch', 'sonar_imm', f'{name}.launch.xml', 'namespace:=/auv']
    with started(words, domain, tmp_path / 'log') as wait_for:
        wait_for('ready', [f'[{node}]' for node in nodes])
    said = (tmp_path / 'log').read_text()
    assert 'process has died' not in said
    assert said.count('process has finished cleanly') == len(nodes)


def test_the_launch_file_of_the_tutorial_runs(ros2, domain, say, tmp_path):
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
    with started([ros2, 'launch', file], domain, tmp_path / 'log') as wait_for:
        wait_for('ready, hears', ['/sonar/targets', '/ekf/odometry'])
        say('param', 'get', '/obstacle', 'safety_radius', told='4.0')
    assert 'process has died' not in (tmp_path / 'log').read_text()
