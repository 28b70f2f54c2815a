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

"""Two robots in one process: real trackers, started as a user does, and ended by a signal."""

import os
import signal
import subprocess
import sys
import time

from helpers.live import own_words
import pytest

pytest.importorskip('rclpy')

from rcl_interfaces.srv import GetParameters  # noqa: E402

from sonar_imm_tools.replay.harness import reserved_domain_id  # noqa: E402
from sonar_imm_tools.replay.link import Link  # noqa: E402

pytestmark = pytest.mark.system
FLEET = """
/**:
  ros__parameters: {stale_after: 7.5}
/auv1/diver:
  ros__parameters: {frame_id: harbour}
/auv2/diver:
  ros__parameters: {frame_id: pier}
"""


def composed(*words, domain, log):
    command = [sys.executable, '-m', 'sonar_imm.nodes.composed', *words]
    environment = {
        **os.environ,
        'ROS_DOMAIN_ID': str(domain),
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    }
    return subprocess.Popen(command, env=environment, stdout=log, stderr=subprocess.STDOUT)


@pytest.mark.parametrize('how', [signal.SIGINT, signal.SIGTERM])
def test_two_robots_in_one_process_have_their_own_parameters_and_end_cleanly(
    how, tmp_path, monkeypatch
):
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    fleet, log = tmp_path / 'fleet.yaml', tmp_path / 'log'
    fleet.write_text(FLEET)
    nodes = ['/auv1/diver', '/auv2/diver', '/auv2/obstacle']
    with reserved_domain_id() as domain, log.open('wb') as out:
        arguments = [' '.join(nodes[:2]), nodes[2], '--ros-args', '--params-file', str(fleet)]
        process = composed(*arguments, domain=domain, log=out)
        try:
            end = time.monotonic() + 300.0
            while log.read_text().count('ready, hears') < len(nodes):
                assert process.poll() is None and time.monotonic() < end, log.read_text()
                time.sleep(0.05)
            with Link('asker', domain_id=domain) as link:
                given = [parameters(link, name) for name in nodes]
            process.send_signal(how)
            assert process.wait(240.0) == 0, log.read_text()
        finally:
            if process.poll() is None:
                process.kill()
    assert given == [('harbour', 7.5), ('pier', 7.5), ('', 7.5)]
    message = own_words(log.read_text())
    assert 'Traceback' not in message and 'has no effect' not in message


def parameters(link, name):
    """What the node of that name says."""
    client = link.node.create_client(GetParameters, f'{name}/get_parameters')
    assert link.wait_for(client.service_is_ready, 120.0)
    answer = client.call_async(GetParameters.Request(names=['frame_id', 'stale_after']))
    assert link.wait_for(answer.done, 120.0)
    frame, stale = answer.result().values
    return frame.string_value, stale.double_value


def test_what_cannot_be_started_is_said_in_a_sentence(tmp_path):
    for words, code, sentence in (
        (['/auv1/submarine'], 2, "there is no node 'submarine'"),
        (['/auv1/diver', '/auv1/diver'], 2, 'two nodes of one name'),
        ([], 0, 'usage: composed_node /NAMESPACE/NAME'),
    ):
        log = tmp_path / 'log'
        with reserved_domain_id() as domain, log.open('wb') as out:
            assert composed(*words, domain=domain, log=out).wait(120.0) == code
        assert sentence in log.read_text() and 'Traceback' not in log.read_text()
