# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The real diver node as a process: exit codes, signals, what it is told at its start, its log.

All of that is of a process alone; kernels of the other nodes: test_cold_start.py.
"""

import os
import shutil
import signal
import subprocess
import sys

from helpers.faults.cases import BAGS, CASES
from helpers.faults.rig import own_words, Rig, wait_until_ready
import pytest

from sonar_imm_tools.replay.harness import NodeProcess, reserved_domain_id, run_lockstep
from sonar_imm_tools.replay.link import LinkError

pytestmark = pytest.mark.system


def test_a_node_that_cannot_start_ends_the_run_with_its_sentence(tmp_path):
    file = tmp_path / 'diver.yaml'
    file.write_text('/**:\n  ros__parameters:\n    sound_speed: 1500\n')
    sentence = "parameter 'sound_speed' is a double: write 1500.0 instead of 1500"
    with pytest.raises(LinkError, match=f'exit code 2: diver: {sentence}'):
        run_lockstep(BAGS / 'diver_table1', 'diver', params_file=file)


@pytest.mark.parametrize(
    'arguments, sentence',
    [
        (('--params-file', 'nowhere.yaml'), "Couldn't parse params file"),
        (('--no-such-flag',), '--no-such-flag'),
        (('--', '-p', 'sound_speed:=1500.0'), "'-p' has to follow --ros-args"),
    ],
)
def test_unusable_arguments_end_in_one_line_and_exit_code_2(arguments, sentence):
    with (
        reserved_domain_id() as domain,
        NodeProcess('diver', domain_id=domain, arguments=arguments) as node,
    ):
        assert node.process.wait(600.0) == 2
        said = own_words(node.log()).splitlines()
        (line,) = (line for line in said if '[rcl]' not in line and 'kernels' not in line)
    assert sentence in line


def test_a_node_under_nohup_outlives_its_terminal():
    with reserved_domain_id() as domain:
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


# -- a node that is to be secured, and cannot be, does not start without security --
# The Fast DDS of the wheels of PyPI has no security plugins, which the node then says.

RULES = '<?xml version="1.0" encoding="utf-8"?><dds><domain_access_rules/></dds>'


@pytest.fixture
def keystore(tmp_path):
    """Keys as `ros2 security create_keystore` and `create_enclave` lay them out."""
    if shutil.which('openssl') is None:
        pytest.skip('openssl is not installed')
    enclave, rules = tmp_path / 'keys' / 'enclaves' / 'sonar_imm' / 'diver', tmp_path / 'rules.xml'
    enclave.mkdir(parents=True)
    rules.write_text(RULES)
    authority, key = tmp_path / 'ca.cert.pem', tmp_path / 'ca.key.pem'
    curve = ['-newkey', 'ec', '-pkeyopt', 'ec_paramgen_curve:prime256v1', '-nodes', '-days', '9']
    signed_by = ['-signer', authority, '-inkey', key]
    made, own = ['req', '-x509', *curve, '-subj'], enclave / 'cert.pem'
    signed = ['smime', '-sign', '-text', '-in', rules, *signed_by, '-out']
    for words in (
        [*made, '/CN=sros2CA', '-keyout', key, '-out', authority],
        [*made, '/CN=diver', '-keyout', enclave / 'key.pem', '-out', own]
        + ['-CA', authority, '-CAkey', key],
        [*signed, enclave / 'governance.p7s'],
        [*signed, enclave / 'permissions.p7s'],
    ):
        subprocess.run(['openssl', *words], check=True, capture_output=True)
    for name in ('identity_ca.cert.pem', 'permissions_ca.cert.pem'):
        shutil.copy(authority, enclave / name)
    return tmp_path / 'keys'


@pytest.mark.parametrize('enclave', ['/sonar_imm/diver', '/sonar_imm/nobody'])
def test_what_cannot_be_secured_does_not_start(keystore, enclave):
    with reserved_domain_id() as domain:
        environment = {
            **os.environ, 'ROS_DOMAIN_ID': str(domain), 'ROS_SECURITY_KEYSTORE': str(keystore),
            'ROS_SECURITY_ENABLE': 'true', 'ROS_SECURITY_STRATEGY': 'Enforce',
        }  # fmt: skip
        command = [sys.executable, '-m', 'sonar_imm.nodes.diver', '--ros-args', '-e', enclave]
        try:
            done = subprocess.run(
                command, env=environment, capture_output=True, text=True, timeout=240.0
            )
        except subprocess.TimeoutExpired:
            pytest.skip('this Fast DDS has the security plugins, and the node runs')
    message = own_words(done.stderr)
    assert done.returncode == 2 and 'Traceback' not in message and 'ready' not in message
    if enclave.endswith('nobody'):
        assert "nobody' does not exist" in message
    else:
        assert "doesn't have the security libraries" in message
