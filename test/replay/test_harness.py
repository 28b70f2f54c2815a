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

"""The harness around real nodes; what needs a process is tested in test/system."""

import os

import numpy as np
import pytest

from msg_adapters.fixes import write_fix
from sonar_imm.measurements import Fix
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.reader import BagError
from sonar_imm_tools.recordings.writer import BagWriter
from sonar_imm_tools.replay import harness
from sonar_imm_tools.replay.harness import LockstepResult, reserved_domain_id, run_lockstep
from sonar_imm_tools.replay.link import Link, LinkError
from sonar_imm_tools.replay.lockstep import Counts


def result(delays):
    return LockstepResult([], Counts(0, 0, 0), tuple(delays), 0, '', ())


def test_latency_percentiles_are_milliseconds():
    latency = result(np.arange(1, 102) / 1000.0).latency_ms()
    assert latency == pytest.approx({'p50': 51.0, 'p99': 100.0})
    assert np.isnan(result([]).latency_ms()['p99'])


def test_reserved_domains_differ_and_come_free_again():
    with reserved_domain_id() as first, reserved_domain_id() as second:
        assert first != second
        assert 1 <= first <= 100
    with reserved_domain_id():
        pass


def test_a_domain_of_a_killed_process_is_reserved_last(tmp_path, monkeypatch):
    monkeypatch.setattr(harness, '_SHARED_MEMORY', tmp_path)
    for domain in {*range(1, 101)} - {37}:
        (tmp_path / f'fastrtps_port{7400 + 250 * domain + 11}').touch()
    with reserved_domain_id() as first, reserved_domain_id() as second:
        assert first == 37 != second


def test_an_input_recorded_with_two_types_cannot_be_played_to_one_node(tmp_path):
    fix = write_fix(Fix(stamp_ns=10**9, position=(1.0, 2.0, 0.0), frame_id='map'), ros_message)
    point = ros_message(
        'geometry_msgs/msg/PointStamped', header=fix.header, point=fix.pose.pose.position
    )
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write('/usbl/fix', fix, 10**9)
        writer.write('/gps/fix', point, 10**9)
    with pytest.raises(LinkError, match="the input 'fix' would come as"):
        run_lockstep(tmp_path / 'bag', 'diver')


def test_a_bag_without_input_is_a_bag_error_and_the_environment_is_as_before(tmp_path):
    with BagWriter(tmp_path / 'bag') as writer:
        writer.write('/note', ros_message('std_msgs/msg/String', data='x'), 10**9)
    before = dict(os.environ)
    with pytest.raises(BagError, match='no topic for the diver tracker'):
        run_lockstep(tmp_path / 'bag', 'diver')
    assert dict(os.environ) == before


def test_waiting_ends_by_the_limit_or_by_trouble():
    with Link('waiter') as link:
        assert not link.wait_for(lambda: False, 0.05)
        assert link.wait_for(lambda: True, 0.0)
        with pytest.raises(LinkError, match='the peer has sunk'):
            link.wait_for(lambda: False, 10.0, lambda: 'the peer has sunk')
