# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A node whose log cannot be kept any more goes on: a memory card is taken out, a disk is full."""

import os
import shutil
import subprocess

from helpers.faults.cases import CASES
from helpers.faults.rig import Rig
import pytest

pytestmark = pytest.mark.system


def still_answers(rig, messages, times=1):
    """Whether the node logs, answers and makes estimates as before."""
    for _ in range(times):
        rig.reset()  # it logs that
    return len(rig.play(messages)) >= len(messages) and rig.node.trouble() is None


def test_a_node_outlives_the_folder_of_its_log(tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path / 'log'))
    messages = CASES['diver'].messages()[:5]
    with Rig(CASES['diver']) as rig:
        assert still_answers(rig, messages)
        assert list((tmp_path / 'log').iterdir())
        shutil.rmtree(tmp_path / 'log')
        assert still_answers(rig, messages, times=3)


def test_a_node_outlives_a_full_disk_below_its_log(tmp_path, monkeypatch):
    mount = ['mount', '-t', 'tmpfs', '-o', 'size=16k', 'tmpfs', str(tmp_path)]
    if not shutil.which('mount') or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip('no file system may be mounted here')
    try:
        monkeypatch.setenv('ROS_LOG_DIR', str(tmp_path))
        messages = CASES['diver'].messages()[:5]
        with Rig(CASES['diver']) as rig:
            (tmp_path / 'filler').write_bytes(bytes(os.statvfs(tmp_path).f_bavail * 4096))
            assert not os.statvfs(tmp_path).f_bavail
            assert still_answers(rig, messages, times=100)
    finally:
        subprocess.run(['umount', str(tmp_path)], check=True)
