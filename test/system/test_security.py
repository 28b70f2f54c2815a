# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A node that is to be secured, and cannot be, does not start without security.

The Fast DDS of the wheels of PyPI is built without its security plugins, which the node then says.
"""

import os
import shutil
import subprocess
import sys

from helpers.live import own_words
import pytest

pytest.importorskip('rclpy')

from sonar_imm_tools.replay.harness import reserved_domain_id  # noqa: E402

pytestmark = pytest.mark.system
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
    for words in (
        ['req', '-x509', *curve, '-subj', '/CN=sros2CA', '-keyout', key, '-out', authority],
        [
            *('req', '-x509', *curve, '-subj', '/CN=diver', '-CA', authority, '-CAkey', key),
            *('-keyout', enclave / 'key.pem', '-out', enclave / 'cert.pem'),
        ],
        ['smime', '-sign', '-text', '-in', rules, '-out', enclave / 'governance.p7s', *signed_by],
        ['smime', '-sign', '-text', '-in', rules, '-out', enclave / 'permissions.p7s', *signed_by],
    ):
        subprocess.run(['openssl', *words], check=True, capture_output=True)
    for name in ('identity_ca.cert.pem', 'permissions_ca.cert.pem'):
        shutil.copy(authority, enclave / name)
    return tmp_path / 'keys'


@pytest.mark.parametrize('enclave', ['/sonar_imm/diver', '/sonar_imm/nobody'])
def test_what_cannot_be_secured_does_not_start(keystore, enclave):
    with reserved_domain_id() as domain:
        environment = {
            **os.environ,
            'ROS_DOMAIN_ID': str(domain),
            'ROS_SECURITY_KEYSTORE': str(keystore),
            'ROS_SECURITY_ENABLE': 'true',
            'ROS_SECURITY_STRATEGY': 'Enforce',
        }
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
