# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""``echo`` beside a real node: discovery of publishers needs two processes."""

import json
import os
import re
import subprocess
import sys

from helpers.dive_bags import write_dive
from helpers.faults.rig import wait_until_ready
from helpers.source import ROOT
import pytest

pytest.importorskip('rclpy')

from sonar_imm_tools.replay.harness import NodeProcess, reserved_domain_id  # noqa: E402

pytestmark = pytest.mark.system


def command(domain, *arguments):
    """A started command in the ROS domain `domain`."""
    return subprocess.Popen(
        [sys.executable, '-m', 'sonar_imm_tools.cli', *map(str, arguments)], cwd=ROOT,
        env=dict(os.environ, ROS_DOMAIN_ID=str(domain), ROS_AUTOMATIC_DISCOVERY_RANGE='LOCALHOST'),
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


@pytest.fixture
def playing(tmp_path, monkeypatch):
    """The domain of a diver node that gets fixes again and again."""
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    bag = write_dive(tmp_path / 'dive')
    with reserved_domain_id() as domain, NodeProcess('diver', domain_id=domain) as node:
        wait_until_ready([node])
        player = command(domain, 'play', bag, '--rate', '20', '--loop')
        try:
            yield domain
        finally:
            player.terminate()
            player.communicate()
        assert node.process.poll() is None


def test_estimates_are_found_and_shown(playing):
    echoes = {
        'lines': command(playing, 'echo', '--once', '--timeout', '300'),
        'json': command(
            playing, 'echo', 'diver/estimate', '--json', '--count', '3', '--timeout', '300'
        ),
        'truth': command(playing, 'echo', '/truth/estimate', '--once', '--timeout', '300'),
    }
    values = {
        name: (*echo.communicate(timeout=600), echo.returncode) for name, echo in echoes.items()
    }
    lines = values['lines'][0].splitlines()
    assert 'listening to /diver/estimate' in values['lines'][1]
    assert values['lines'][2] == 0 and lines[0].startswith('/diver/estimate  20')
    assert 'frame map  1 row' in lines[0] and lines[1].split()[2:4] == ['px', 'py']
    assert '±' in lines[2] and re.search(r'(heading_\d{3}|hover|lively_\w+|quiet) +\d+%', lines[2])
    tables = [json.loads(line) for line in values['json'][0].splitlines()]
    assert values['json'][2] == 0 and len(tables) == 3
    assert {table['topic'] for table in tables} == {'/diver/estimate'}
    assert len({table['stamp_ns'] for table in tables}) == 3 and tables[0]['types']['px'] == 'f8'
    assert values['truth'][2] == 0 and values['truth'][0].startswith('/truth/estimate')
