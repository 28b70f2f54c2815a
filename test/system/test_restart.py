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

"""A real node that is killed goes on where it was saved last."""

import os
import signal

import numpy as np
import pytest

from msg_adapters.estimates import read_estimate
from msg_adapters.fixes import write_fix
from msg_adapters.table import decode_table
from sonar_imm.evaluation.tracking import final_estimates
from sonar_imm.measurements import Fix
from sonar_imm.nodes.harness import NodeProcess, reserved_domain_id
from sonar_imm.nodes.link import Link
from sonar_imm.nodes.messages import make, message_class
from sonar_imm.nodes.qos import latched_qos, lockstep_qos
from sonar_imm.trackers import SYSTEMS

pytestmark = pytest.mark.system

TABLE = 'sensor_msgs/msg/PointCloud2'
FIXES, KILLED_AFTER, SENT_AGAIN = 60, 40, 15


def fixes():
    """Of two divers, who swim past each other."""
    rng = np.random.default_rng(4)
    for k in range(FIXES):
        side = 1.0 if k % 2 else -1.0
        position = (0.4 * k * side + rng.normal(), 20.0 * side + rng.normal(), 0.0)
        yield Fix(
            stamp_ns=(1000 + k) * 10**9, position=position, covariance=np.eye(2), frame_id='map'
        )


def play(link, messages, wait_for_state=None):
    """Send messages one by one to a node that just started; gives what it estimated."""
    answers, estimates = [], []
    subscriptions = [
        link.node.create_subscription(message_class(TABLE), f'/diver/{name}', heard.append, qos)
        for name, heard, qos in (
            ('processed', answers, latched_qos()),
            ('estimate', estimates, lockstep_qos()),
        )
    ]
    kind = message_class('geometry_msgs/msg/PoseWithCovarianceStamped')
    fix = link.node.create_publisher(kind, '/fix', lockstep_qos())
    there = lambda: answers and fix.get_subscription_count()  # noqa: E731
    assert link.wait_for(there, 90.0)

    def count(name):
        return int(decode_table(answers[-1])[name][0])

    for k, message in enumerate(messages, start=1):
        fix.publish(message)
        assert link.wait_for(lambda k=k: count('messages') == k, 30.0)
    assert link.wait_for(lambda: len(estimates) == count('estimates'), 30.0)
    if wait_for_state:
        assert link.wait_for(wait_for_state, 30.0)
    for one in subscriptions:
        link.node.destroy_subscription(one)
    link.node.destroy_publisher(fix)
    return [read_estimate(one) for one in estimates]


def test_a_diver_node_that_is_killed_goes_on_with_ids_and_covariances(tmp_path, monkeypatch):
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    state = tmp_path / 'state'
    told = ['-p', f'state_file:={state}', '-p', 'state_interval:=0.2']
    system = SYSTEMS['diver']
    config = system.config_type()()
    tracker = system.build(config)
    whole = final_estimates([e for one in fixes() for e in tracker.process(one)], config)
    messages = [write_fix(one, make) for one in fixes()]
    # A link of its own for each life: the first one takes the dead node for alive for a while.
    with reserved_domain_id() as domain:
        with (
            Link('before', domain_id=domain) as link,
            NodeProcess('diver', domain_id=domain, arguments=told) as node,
        ):
            play(link, messages[:KILLED_AFTER], state.exists)
            os.kill(node.process.pid, signal.SIGKILL)
            node.process.wait(10.0)
        with (
            Link('after', domain_id=domain) as link,
            NodeProcess('diver', domain_id=domain, arguments=told) as node,
        ):
            live = play(link, messages[KILLED_AFTER - SENT_AGAIN :])
            assert node.stop() == 0
            assert 'goes on from the state' in node.log()
            assert 'Traceback' not in node.log()
    live = final_estimates(live, config)
    expected = [one for one in whole if one.stamp_ns >= live[0].stamp_ns]
    assert len(live) == len(expected) >= FIXES - KILLED_AFTER
    for one, other in zip(live, expected, strict=True):
        assert one.stamp_ns == other.stamp_ns
        assert one.state.tobytes() == other.state.tobytes()
        assert one.covariance.tobytes() == other.covariance.tobytes()
        assert np.array_equal(one.extras['track_id'], other.extras['track_id'])
