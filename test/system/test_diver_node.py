# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The real diver node as a process: lock-step against offline, signals, bad parameters.

Exit codes, signals and what comes over the middleware are those of a process alone.
"""

import signal
import subprocess
import sys

from helpers.live import own_words, wait_until_ready
import numpy as np
import pytest

from msg_adapters.fixes import write_fix
from sonar_imm.intake import KnownFrames
from sonar_imm.measurements import Fix, Rejection
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.writer import BagWriter
from sonar_imm_tools.replay.harness import NodeProcess, reserved_domain_id, run_lockstep
from sonar_imm_tools.replay.link import LinkError

pytestmark = pytest.mark.system

START = 1_700_000_000 * 10**9
SECOND = 10**9


@pytest.fixture(scope='module')
def bag(tmp_path_factory):
    """Two divers and what a sea trial adds: late, repeated, unusable and far-off fixes."""
    path = tmp_path_factory.mktemp('bags') / 'rough'
    rng = np.random.default_rng(20240)
    with BagWriter(path) as writer:
        log_ns = START
        for k in range(120):
            for diver in (0, 1):
                late = 3 if k % 11 == 10 else 0
                stamp = START + (k - late) * SECOND + (late > 0) * SECOND // 3
                place = np.array([-40.0 + 0.7 * k + 30.0 * diver, 40.0 - 0.5 * k, 0.0])
                place[:2] += rng.normal(scale=0.3, size=2) + (k % 23 == 22) * 500.0
                message = write_fix(
                    Fix(
                        stamp_ns=stamp, position=place, frame_id='map', covariance=0.09 * np.eye(2)
                    ),
                    ros_message,
                )
                if k % 17 == 16:
                    message.pose.pose.position.y = float('inf')
                if k == 60:
                    message.header.frame_id = 'odom'
                log_ns += SECOND // 10
                writer.write('/usbl/fix', message, log_ns)
                if k % 19 == 18:
                    writer.write('/usbl/fix', message, log_ns + 1)
    return path


def offline(path, **parameters):
    """What the tracker makes of the bag without ROS."""
    system = SYSTEMS['diver']
    tracker = system.build(system.config_type()(**parameters))
    guard, estimates = KnownFrames(), []
    with BagReader(path) as reader:
        for received in measurements_of(reader, 'diver'):
            try:
                if not isinstance(received.measurement, Rejection):
                    guard.admit(received.measurement)
                    estimates += tracker.process(received.measurement)
            except Rejection:
                pass
    return estimates


def assert_same_tables(live, recorded):
    assert [e.stamp_ns for e in live] == [e.stamp_ns for e in recorded]
    for a, b in zip(live, recorded):
        assert a.frame_id == b.frame_id
        left, right = a.columns(), b.columns()
        assert list(left) == list(right)
        for name in left:
            assert left[name].dtype == right[name].dtype, name
            assert left[name].tobytes() == right[name].tobytes(), name


def test_live_lockstep_equals_offline_byte_for_byte(bag):
    result = run_lockstep(bag, 'diver')
    expected = offline(bag)
    assert len(expected) > 100
    assert_same_tables(result.estimates, expected)
    assert result.counts.messages == 252
    assert result.counts.refused > 10
    assert result.exit_code == 0
    assert 'Traceback' not in result.log
    assert 'ready, hears /fix' in result.log
    assert 0.0 < result.latency_ms()['p50'] <= result.latency_ms()['p99']


def test_a_node_that_cannot_start_ends_the_run_with_its_sentence(bag, tmp_path):
    file = tmp_path / 'diver.yaml'
    file.write_text('/**:\n  ros__parameters:\n    sound_speed: 1500\n')
    with pytest.raises(
        LinkError,
        match=r"exit code 2: diver: parameter 'sound_speed' is a "
        r'double: write 1500\.0 instead of 1500',
    ):
        run_lockstep(bag, 'diver', params_file=file)


@pytest.mark.parametrize(
    'arguments, sentence',
    [
        (('-p', 'sound_speed:=1500'), 'write 1500.0 instead of 1500'),
        (('-p', 'depth_min:=90.0'), 'depth_min (90) cannot exceed depth_max (20)'),
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
        assert node.process.wait(120.0) == 2
        own = ('[rcl]', 'kernels')
        message = own_words(node.log()).splitlines()
        lines = [line for line in message if not any(word in line for word in own)]
    assert len(lines) == 1
    assert sentence in lines[0]


def assert_clean_end(nodes, how):
    for node in nodes:
        node.process.send_signal(how)
    for node in nodes:
        assert node.process.wait(120.0) == 0, node.log()
        message = own_words(node.log())
        assert 'Traceback' not in message and 'Error' not in message


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
            assert_clean_end([node], signal.SIGTERM)


def test_modules_of_the_nodes_load_neither_scipy_nor_numba():
    code = (
        'import sys, sonar_imm.nodes.diver; '
        'print([m for m in ("numba", "scipy", "rosbags", "plotly") if m in sys.modules])'
    )
    printed = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=True
    )
    assert printed.stdout.strip() == '[]'


def test_help_is_said_without_starting():
    with (
        reserved_domain_id() as domain,
        NodeProcess('diver', domain_id=domain, arguments=('--', '--help')) as node,
    ):
        assert node.process.wait(120.0) == 0
        assert node.log().startswith('usage: diver [--ros-args')
