# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The diver node's displays: odometry of every confirmed diver, probabilities of one."""

import math
import time

from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped as POSE
from helpers.node_bench import values_of
from nav_msgs.msg import Odometry
import numpy as np
import pytest
from sensor_msgs.msg import JointState, NavSatFix, PointCloud2
from std_srvs.srv import Trigger

from msg_adapters.estimates import read_estimate
from msg_adapters.fixes import read_geodetic, write_fix, write_geodetic, write_start
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Fix, GeodeticFix, Start
from sonar_imm.nodes.diagnostics import clock_offset
from sonar_imm.nodes.diver import DiverNode
from sonar_imm.nodes.messages import make
from sonar_imm.nodes.qos import lockstep_qos, output_qos

SECOND = 10**9


@pytest.fixture
def rig(make_bench):
    bench = make_bench()
    node = bench.start(DiverNode)
    return bench, node, *bench.hear(node, odometry=Odometry, model_probabilities=JointState)


def a_fix(stamp_ns, x, y):
    fix = Fix(stamp_ns=stamp_ns, position=(x, y, 0), covariance=np.eye(2), frame_id='map')
    return write_fix(fix, make)


def an_estimate(ids, states):
    rows = len(ids)
    return Estimate(
        stamp_ns=5 * 10**9, frame_id='map', xyz=np.zeros((rows, 3), np.float32),
        state_names=('px', 'py', 'vx', 'vy'), state=np.arange(4.0 * rows).reshape(rows, 4),
        covariance=np.tile(np.eye(4), (rows, 1, 1)), model_names=('heading_000', 'hover'),
        probabilities=np.array([[0.25 + 0.01 * i, 0.75 - 0.01 * i] for i in ids]).reshape(-1, 2),
        extras={
            'track_id': np.array(ids, np.uint32),
            'track_state': np.array(states, np.uint8),
            'nis': np.full(rows, np.nan),
        },
    )  # fmt: skip


def test_confirmed_divers_are_shown_and_the_oldest_gives_the_probabilities(rig):
    bench, node, odometry, probabilities = rig
    node.show([an_estimate([1], [0])])
    node.show([an_estimate([], [])])
    node.show([an_estimate([9, 3, 5, 2], [1, 2, 1, 0])])  # 2 is tentative, 3 coasts
    bench.spin_until(lambda: len(odometry) >= 3 and probabilities)
    assert [m.child_frame_id for m in odometry] == ['diver_9', 'diver_3', 'diver_5']
    assert odometry[1].twist.twist.linear.x == 6.0
    assert odometry[1].header.stamp.sec == 5
    assert len(probabilities) == 1
    assert list(probabilities[0].name) == ['heading_000', 'hover']
    assert probabilities[0].position[0] == pytest.approx(0.28)


def test_a_message_that_the_tracker_cannot_use_is_known_as_such(rig):
    """Of two publishers, the one with a clock half a minute behind is of no use."""
    node = rig[1]
    for second in range(100, 110):
        for behind in (0, 30):
            node.receive('fix', a_fix((second - behind) * SECOND, 1.0, second + behind))
    assert [stamp.used for stamp in node._meter.stamps['fix']] == [True, False] * 10
    assert {stamp.frame_id for stamp in node._meter.stamps['fix']} == {'map'}


def test_two_clocks_are_told_apart_behind_a_full_queue(rig):
    """What waits longer and longer in the node is as old as it was at its reception."""
    node, now_ns = rig[1], time.time_ns()
    for k in range(40):
        received_ns = now_ns - k * 45_000_000  # the last one waited for 1.8 s
        fix = a_fix(received_ns - k % 2 * 3 * SECOND, 1.0, 2.0)
        node.receive('fix', fix, {'received_timestamp': received_ns})
    ages = [stamp.age for stamp in node._meter.stamps['fix']]
    assert clock_offset(ages) == pytest.approx(3.0, abs=0.3)


@pytest.mark.usefixtures('quick')
@pytest.mark.parametrize(
    'waited, behind, used',
    [(3.0, 0, False), (1.0, 0, True), (0.0, 20, True), (0.0, 3600, True), (0.0, -3600, True)],
)
def test_what_waited_in_the_node_is_dropped_and_what_is_late_is_not(rig, waited, behind, used):
    """Behind a busy tracker, from a slow sensor, and from a clock that is off."""
    bench, node, *_ = rig
    received = bench.listen(DiagnosticArray, '/diagnostics', output_qos())
    bench.spin_until(lambda: received)
    received.clear()
    for k in range(12):
        now_ns = time.time_ns()
        info = {'received_timestamp': now_ns - round(waited * 1e9)}
        node.receive('fix', a_fix(now_ns - round((waited + behind) * 1e9) + k, k, 0.0), info)
    assert node._meter.dropped == ({} if used else {'fix': 12})
    assert node.tracker.counts['used'] == (12 if used else 0)
    bench.spin_until(lambda: len(received) > 3)
    said = '; '.join(status.message for each in received for status in each.status)
    assert ('12 messages dropped' in said) == (not used)
    assert ('arrive that late' in said) == (behind == 20)
    assert ('the clock of this computer' in said) == (abs(behind) == 3600)


# -- positions as users have them: on Earth, with names --

ORIGIN = Origin(59.0, 10.0)
ON_EARTH = "input_types:=['fix=sensor_msgs/msg/NavSatFix']"


def on_earth(k, x, status=0):
    latitude, longitude, _ = ORIGIN.geodetic(np.array([x, 5.0, 0.0]))
    place = {'latitude': latitude, 'longitude': longitude, 'covariance': 0.04 * np.eye(3)}
    message = write_geodetic(GeodeticFix(stamp_ns=k * SECOND, frame_id='gps', **place), make)
    message.status.status = status
    return message


def test_navsatfix_in_and_out(make_bench):
    bench = make_bench(p=[ON_EARTH])
    node = bench.start(DiverNode)
    (geo,) = bench.hear(node, geo=NavSatFix)
    fixes = bench.publisher(NavSatFix, '/fix')
    bench.send(node, fixes, *(on_earth(k, 0.5 * k) for k in range(1, 21)))
    bench.spin_until(lambda: geo and geo[-1].header.stamp.sec == 20)
    assert geo[-1].header.frame_id == 'diver_1'
    back = read_geodetic(geo[-1])
    assert ORIGIN.local(back.latitude, back.longitude)[:2] == pytest.approx([10.0, 5.0], abs=0.2)
    assert back.covariance[0, 0] < 0.04 < 1e5 < back.covariance[2, 2]


@pytest.mark.usefixtures('quick')
def test_what_has_no_fix_and_what_is_repeated_is_counted_and_said(make_bench):
    bench = make_bench(p=[ON_EARTH])
    node = bench.start(DiverNode)
    arrived = bench.listen(DiagnosticArray, '/diagnostics')
    fixes = bench.publisher(NavSatFix, '/fix')
    given = ((1, 0.0, 0), (2, 0.0, 0), (3, 0.5, -1), (4, 0.6, 0))
    bench.send(node, fixes, *(on_earth(*each) for each in given))
    assert node._meter.refused == {'repeated': 1, 'no_fix': 1} and node._published == 2
    count = len(arrived)
    bench.spin_until(lambda: len(arrived) > count + 1)
    values = values_of(arrived[-1])
    assert values['refused: repeated'] == '1' and values['refused: no_fix'] == '1'
    bench.call(Trigger, '/diver/reset', Trigger.Request())
    bench.send(node, fixes, on_earth(5, 0.6))  # after a reset nothing is a repetition
    assert node._meter.refused['repeated'] == 1 and node._published == 3


def test_a_tag_has_a_topic_of_its_own(make_bench):
    bench = make_bench(p=[ON_EARTH, "tags:=['amy','bob']"])
    node = bench.start(DiverNode)
    tables = bench.listen(PointCloud2, '/diver/estimate', lockstep_qos())
    amy, bob = (bench.publisher(NavSatFix, f'/{name}/fix') for name in ('amy', 'bob'))
    for k in range(1, 8):
        bench.send(node, amy, on_earth(k, 0.3 * k))
        bench.send(node, bob, on_earth(k, 1.0 + 0.2 * k))
    bench.spin_until(lambda: len(tables) == node._published)
    assert sorted(read_estimate(tables[-1]).extras['target_id'].tolist()) == [1, 2]


def test_a_start_begins_a_track_and_a_useless_one_is_refused_by_name(make_bench, capfd):
    """``~/initial``: where somebody says that a diver is."""

    def told(second, x, frame_id='map'):
        place = {'position': [x, 2.0, 0.0], 'covariance': np.eye(2), 'frame_id': frame_id}
        return write_start(Start(stamp_ns=second * SECOND, **place), make)

    bench = make_bench()
    node = bench.start(DiverNode)
    (estimates,) = bench.hear(node, estimate=PointCloud2)
    initial = bench.publisher(POSE, '/diver/initial', 10)
    fixes = bench.publisher(POSE, '/fix', 10)
    bench.send(node, initial, told(1, 5.0))
    bench.spin_until(lambda: estimates)
    first = read_estimate(estimates[0])
    assert first.extras['track_state'].tolist() == [1] and first.xyz[0].tolist() == [5.0, 2.0, 0.0]
    bench.send(node, fixes, a_fix(2 * SECOND, 5.5, 2.0))
    bench.spin_until(lambda: len(estimates) == 2)
    assert read_estimate(estimates[1]).extras['track_id'].tolist() == [1]

    nan, unknown = told(3, math.pi), told(3, 4.0)
    nan.pose.pose.position.x = math.nan
    unknown.pose.covariance = np.zeros(36)
    bench.send(node, initial, nan, unknown, told(3, 4.0, frame_id='odom'))
    assert node._meter.refused == {'nan': 1, 'no_covariance': 1, 'frame': 1}
    assert node._meter.received == {'initial': 4, 'fix': 1} and len(estimates) == 2
    errors = capfd.readouterr().err
    assert "the frame 'odom' is not the frame 'map' of the tracks" in errors
    assert 'the start has no covariance of x and y' in errors
    assert 'the start has a position that is not finite' in errors
