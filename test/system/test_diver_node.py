# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Real nodes as processes: exit codes, signals, what they are told at their start, their log; and
their kernels, with the defaults, from an empty folder or a damaged one.

All of that is of a process alone; what is compiled or loaded stays so in a process of tests.
"""

import contextlib
import os
from pathlib import Path
import re
import shutil
import signal
import subprocess
import sys
import time

from diagnostic_msgs.msg import DiagnosticArray
from helpers.faults.cases import BAGS, CASES
from helpers.faults.rig import own_words, Rig, wait_until_ready
import pytest
from rcl_interfaces.srv import GetParameters

from sonar_imm.nodes.qos import output_qos
from sonar_imm_tools.replay import harness
from sonar_imm_tools.replay.harness import NodeProcess
from sonar_imm_tools.replay.link import Link, LinkError

pytestmark = pytest.mark.system


def test_a_node_that_cannot_start_ends_the_run_with_its_sentence(tmp_path):
    file = tmp_path / 'diver.yaml'
    file.write_text('/**:\n  ros__parameters:\n    sound_speed: 1500\n')
    sentence = "parameter 'sound_speed' is a double: write 1500.0 instead of 1500"
    with pytest.raises(LinkError, match=f'exit code 2: diver: {sentence}'):
        harness.run_lockstep(BAGS / 'diver_table1', 'diver', params_file=file)


def test_unusable_arguments_end_in_one_line_and_exit_code_2():
    arguments = '--params-file', 'nowhere.yaml'
    with (
        harness.reserved_domain_id() as domain,
        NodeProcess('diver', domain_id=domain, arguments=arguments) as node,
    ):
        assert node.process.wait(600.0) == 2
        said = own_words(node.log()).splitlines()
        (line,) = (line for line in said if '[rcl]' not in line and 'kernels' not in line)
    assert "Couldn't parse params file" in line


def test_a_node_under_nohup_outlives_its_terminal():
    with harness.reserved_domain_id() as domain:
        before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
        try:
            node = NodeProcess('diver', domain_id=domain)
        finally:
            signal.signal(signal.SIGHUP, before)
        with node:
            wait_until_ready([node])
            node.process.send_signal(signal.SIGHUP)
            with pytest.raises(subprocess.TimeoutExpired):
                node.process.wait(0.5)
            node.process.send_signal(signal.SIGTERM)
            assert node.process.wait(600.0) == 0, node.log()


def test_help_is_said_and_the_module_loaded_without_what_takes_long():
    code = (
        'import atexit, sys, sonar_imm.nodes.diver as node\n'
        'words = ("numba", "scipy", "rosbags", "plotly")\n'
        'print([m for m in words if m in sys.modules], flush=True)\n'
        'sys.argv = ["diver", "--help"]\nsys.exit(node.main())'
    )
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    assert done.returncode == 0 and done.stdout.startswith('[]\nusage: diver [--ros-args')


# -- its log: a memory card is taken out, a disk is full --


def still_answers(rig, times=1):
    """Whether the node logs, answers and makes estimates as before."""
    messages = rig.case.messages()[:5]
    for _ in range(times):
        rig.reset()  # it logs that
    return len(rig.play(messages)) >= len(messages) and rig.node.trouble() is None


def test_a_node_outlives_the_folder_of_its_log(tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))
    with Rig(CASES['diver']) as rig:
        assert still_answers(rig)
        assert list((tmp_path / 'log').iterdir())
        shutil.rmtree(tmp_path / 'log')
        assert still_answers(rig, times=3)


def test_a_node_outlives_a_full_disk_below_its_log(tmp_path, monkeypatch):
    mount = ['mount', '-t', 'tmpfs', '-o', 'size=16k', 'tmpfs', str(tmp_path)]
    if not shutil.which('mount') or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip('no file system may be mounted here')
    try:
        monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path))
        with Rig(CASES['diver']) as rig:
            (tmp_path / 'filler').write_bytes(bytes(os.statvfs(tmp_path).f_bavail * 4096))
            assert not os.statvfs(tmp_path).f_bavail
            assert still_answers(rig, times=100)
    finally:
        subprocess.run(['umount', str(tmp_path)], check=True)


@pytest.mark.parametrize(
    'name, words',
    [('diver', "doesn't have the security libraries"), ('nobody', "nobody' does not exist")],
)
def test_what_cannot_be_secured_does_not_start(name, words, tmp_path):
    """The Fast DDS of the wheels of PyPI has no security plugins, and others refuse empty keys."""
    enclave = tmp_path / 'enclaves' / 'sonar_imm' / 'diver'
    enclave.mkdir(parents=True)
    keys = 'identity_ca.cert.pem', 'cert.pem', 'key.pem', 'permissions_ca.cert.pem'
    for file in (*keys, 'governance.p7s', 'permissions.p7s'):
        (enclave / file).touch()
    command = [sys.executable, '-m', 'sonar_imm.nodes.diver', '--ros-args', '-e']
    with harness.reserved_domain_id() as domain:
        environment = {
            **os.environ, 'ROS_DOMAIN_ID': str(domain), 'ROS_SECURITY_KEYSTORE': str(tmp_path),
            'ROS_SECURITY_ENABLE': 'true', 'ROS_SECURITY_STRATEGY': 'Enforce',
        }  # fmt: skip
        command.append(f'/sonar_imm/{name}')
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
    message = own_words(done.stderr)
    assert done.returncode == 2 and 'Traceback' not in message and 'ready' not in message
    assert words in message or (name == 'diver' and 'libraries' not in message)


LIMIT = 240.0


@pytest.fixture
def start(tmp_path, monkeypatch):
    """Starts a node that keeps its kernels in a folder of its own; gives it and a link."""
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path / 'kernels'))
    with contextlib.ExitStack() as stack:
        domain = stack.enter_context(harness.reserved_domain_id())
        stack.enter_context(harness.local_discovery())
        link = stack.enter_context(Link('asks', domain_id=domain))
        yield lambda system: (
            stack.enter_context(NodeProcess(system, domain_id=domain)),
            link,
        )


def wait_for(node, link, predicate):
    assert link.wait_for(predicate, LIMIT, node.trouble), node.log()


def test_a_node_answers_and_reports_while_it_compiles(start):
    node, link = start('bathymetry')
    reports, answers, longest, begun = [], [], 0.0, time.monotonic()
    link.node.create_subscription(DiagnosticArray, '/diagnostics', reports.append, output_qos())
    client = link.node.create_client(GetParameters, '/bathymetry/get_parameters')

    def compiles():
        sentences = [status.message for report in reports for status in report.status]
        return 'loading kernels, no input is heard until then' in sentences

    wait_for(node, link, client.service_is_ready)
    for _ in range(3):
        del reports[:]
        wait_for(node, link, compiles)
        asked = time.monotonic()
        request = GetParameters.Request(names=['frame_id'])
        client.call_async(request).add_done_callback(answers.append)
        wait_for(node, link, lambda: answers and answers.pop())
        longest = max(longest, time.monotonic() - asked)
    assert 'ready, hears' not in node.log()
    wait_for(node, link, lambda: 'ready, hears' in node.log())
    assert longest < 0.25 * (time.monotonic() - begun)  # however slow the machine is
    assert re.search(r'loading kernels.*\n.*[1-9] kernels compiled, 0 loaded', node.log())


def test_a_node_without_kernels_loads_no_numba(start):
    node, link = start('obstacle')
    wait_for(node, link, lambda: 'ready, hears' in node.log())
    maps = Path(f'/proc/{node.process.pid}/maps').read_text()
    assert 'numpy' in maps and 'llvmlite' not in maps
    assert 'kernels' not in node.log()
