# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Messages of other packages to real nodes, with types that colcon builds for this test: only a
process of its own finds them."""

import json
import os
import subprocess
import sys

from helpers import interfaces
from helpers.marine import definitions
import pytest

from sonar_imm_tools.replay.harness import reserved_domain_id

pytestmark = [
    pytest.mark.system,
    pytest.mark.skipif(
        not interfaces.can_build(),
        reason='the generators of rosidl are not here: see test/helpers/interfaces.py',
    ),
]


WITHOUT_ESTIMATES = {
    'vision_msgs/msg/Detection3DArray', 'marine_acoustic_msgs/msg/SonarDetections',
    'marine_acoustic_msgs/msg/SonarRanges', 'marine_acoustic_msgs/msg/Dvl',
    'stonefish_ros2/msg/DVL', 'dave_interfaces/msg/DVL', 'marine_interfaces/msg/SonarInfo',
}  # fmt: skip
"""The first ones wait for navigation."""


def test_nodes_receive_the_types_of_others(tmp_path, request):
    interfaces.write_sources(tmp_path, definitions())
    environment, root = interfaces.build(tmp_path), request.config.rootpath
    environment['PYTHONPATH'] += f'{os.pathsep}{root / "test"}'
    with reserved_domain_id() as domain:
        environment |= {'ROS_DOMAIN_ID': str(domain), 'ROS_PYTHON_CHECK_FIELDS': '1'}
        command = [sys.executable, '-m', 'helpers.neighbours_live']
        done = subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]
    found = json.loads(done.stdout.splitlines()[-1])
    for type_name, result in found.items():
        assert (result['messages'], result['refused']) == (20, 0), type_name
        if type_name not in WITHOUT_ESTIMATES:
            assert result['estimates'] > (0 if 'ping360' in type_name else 10), type_name
