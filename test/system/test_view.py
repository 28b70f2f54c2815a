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

"""``sonar-imm view`` as a process, seen by a real WebSocket client: a run, and running nodes."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys

import pytest

pytest.importorskip('rclpy')
pytest.importorskip('foxglove')
pytest.importorskip('websockets')

from helpers.foxglove_client import Viewer  # noqa: E402

from sonar_imm_tools.cli import main  # noqa: E402
from sonar_imm_tools.recordings.reader import BagReader  # noqa: E402
from sonar_imm_tools.replay.harness import NodeProcess, reserved_domain_id  # noqa: E402
from sonar_imm_tools.replay.player import play, PlayOptions  # noqa: E402
from sonar_imm_tools.resources import shared_file  # noqa: E402

pytestmark = pytest.mark.system

BAG = shared_file('bags/diver_multistatic')
LIMIT = 240.0


@contextlib.contextmanager
def viewing(*arguments, **environment):
    """The command as a process, and a viewer connected to the address that it says."""
    process = subprocess.Popen(
        [sys.executable, '-m', 'sonar_imm_tools.cli', 'view', *arguments, '--port', '0'],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **environment},
    )
    try:
        message = ''
        while not (url := re.search(r'ws://127\.0\.0\.1:\d+', message)):
            line = process.stdout.readline()
            assert line, process.communicate()[1]
            message += line
        with Viewer(url[0]) as viewer:
            yield viewer
        process.send_signal(signal.SIGINT)
        out, errors = process.communicate(timeout=LIMIT)
        ours = [line for line in errors.splitlines() if 'RTPS' not in line]
        assert (process.returncode, ours) == (0, []), out
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()


def test_a_run_is_played_with_its_estimates_and_its_recording(tmp_path):
    assert main(['track', str(BAG), str(tmp_path / 'run')]) == 0
    layout = tmp_path / 'layout.json'
    asked = [str(tmp_path / 'run'), '--rate', '1000', '--layout', str(layout)]
    with viewing(*asked) as viewer:
        viewer.wait(lambda: '/diver/estimate' in viewer.channels, LIMIT)
        viewer.subscribe('/diver/estimate', '/arrivals')
        with BagReader(tmp_path / 'run' / 'estimate') as bag:
            estimates = [item.raw for item in bag.messages(['/diver/estimate'], decode=False)]
        with BagReader(BAG) as bag:
            arrivals = [item.raw for item in bag.messages(['/arrivals'], decode=False)]
        count = len(estimates) + len(arrivals)
        viewer.wait(lambda: len(viewer.messages) == count, LIMIT)
        got = {name: [] for name in viewer.channels}
        for name, _, raw in viewer.messages:
            got[name].append(raw)
        assert got['/diver/estimate'] == estimates and got['/arrivals'] == arrivals
    assert '/diver/estimate' in json.loads(layout.read_text())['configById']['3D!divers']['topics']


def test_running_nodes_are_shown_live(monkeypatch):
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    with reserved_domain_id() as domain:
        monkeypatch.setenv('ROS_DOMAIN_ID', str(domain))
        with NodeProcess('diver', domain_id=domain) as node, viewing('--live') as viewer:
            wanted = {'/diver/estimate', '/diagnostics'}
            viewer.wait(lambda: wanted <= viewer.channels.keys(), LIMIT)
            assert (
                viewer.channels['/diver/estimate']['schemaName'] == 'sensor_msgs/msg/PointCloud2'
            )
            viewer.subscribe('/diver/estimate', '/diagnostics')
            viewer.wait(
                lambda: any(message[0] == '/diagnostics' for message in viewer.messages), LIMIT
            )
            # In lock-step, which waits for the node's inputs and loses nothing.
            played = play(
                BAG, PlayOptions(topics=('/arrivals',), lockstep='/diver'), domain_id=domain
            )
            assert played.problems == ()
            viewer.wait(
                lambda: any(message[0] == '/diver/estimate' for message in viewer.messages), LIMIT
            )
            assert node.process.poll() is None
