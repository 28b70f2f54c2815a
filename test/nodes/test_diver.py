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

"""The diver node's displays: odometry of every confirmed diver, probabilities of one."""

from nav_msgs.msg import Odometry
import numpy as np
import pytest
from sensor_msgs.msg import JointState, PointCloud2

from msg_adapters.estimates import read_estimate
from msg_adapters.fixes import write_fix
from msg_adapters.scans import write_scan
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Fix, Fixes
from sonar_imm.nodes.diver import DiverNode
from sonar_imm.nodes.messages import make, message_class
from sonar_imm.nodes.qos import lockstep_qos


@pytest.fixture
def rig(make_bench):
    bench = make_bench()
    node = bench.add(DiverNode(context=bench.context))
    odometry = bench.listen(Odometry, '/diver/odometry')
    probabilities = bench.listen(JointState, '/diver/model_probabilities')
    bench.spin_until(
        lambda: (
            node.count_subscribers('/diver/odometry')
            and node.count_subscribers('/diver/model_probabilities')
        )
    )
    return bench, node, odometry, probabilities


def an_estimate(ids, states):
    rows = len(ids)
    return Estimate(
        stamp_ns=5 * 10**9,
        frame_id='map',
        xyz=np.zeros((rows, 3), np.float32),
        state_names=('px', 'py', 'vx', 'vy'),
        state=np.arange(4.0 * rows).reshape(rows, 4),
        covariance=np.tile(np.eye(4), (rows, 1, 1)),
        model_names=('heading_000', 'hover'),
        probabilities=np.array([[0.25 + 0.01 * i, 0.75 - 0.01 * i] for i in ids]).reshape(-1, 2),
        extras={
            'track_id': np.array(ids, np.uint32),
            'track_state': np.array(states, np.uint8),
            'nis': np.full(rows, np.nan),
        },
    )


def test_confirmed_divers_are_shown_and_the_oldest_gives_the_probabilities(rig):
    bench, node, odometry, probabilities = rig
    node.show([an_estimate([9, 3, 5, 2], [1, 2, 1, 0])])  # 2 is tentative, 3 coasts
    bench.spin_until(lambda: len(odometry) == 3 and probabilities)
    assert [m.child_frame_id for m in odometry] == ['diver_9', 'diver_3', 'diver_5']
    assert odometry[1].twist.twist.linear.x == 6.0
    assert odometry[1].header.stamp.sec == 5
    assert len(probabilities) == 1
    assert list(probabilities[0].name) == ['heading_000', 'hover']
    assert probabilities[0].position[0] == pytest.approx(0.28)


def test_nothing_is_shown_of_tentative_tracks_and_of_none(rig):
    bench, node, odometry, probabilities = rig
    node.show([an_estimate([1], [0])])
    node.show([an_estimate([], [])])
    node.show([an_estimate([1], [1])])
    bench.spin_until(lambda: odometry and probabilities)
    assert len(odometry) == len(probabilities) == 1


def test_a_diver_is_tracked_from_fixes(rig):
    bench, node, odometry, probabilities = rig
    publisher = bench.peer.create_publisher(
        message_class('geometry_msgs/msg/PoseWithCovarianceStamped'), '/fix', 10
    )
    bench.spin_until(publisher.get_subscription_count)
    for second in range(1, 31):
        publisher.publish(
            write_fix(
                Fix(
                    stamp_ns=second * 10**9,
                    position=(1.0 * second, 0.0, 0.0),
                    covariance=0.01 * np.eye(2),
                    frame_id='map',
                ),
                make,
            )
        )
        bench.spin_until(lambda want=second: node._meter.received['fix'] == want)
    bench.spin_until(lambda: odometry and odometry[-1].header.stamp.sec == 30)
    assert odometry[-1].pose.pose.position.x == pytest.approx(30.0, abs=0.5)
    assert odometry[-1].twist.twist.linear.x == pytest.approx(1.0, abs=0.2)
    best = int(np.argmax(probabilities[-1].position))
    assert probabilities[-1].name[best] == 'quiet'  # a straight line


def test_a_bag_that_starts_over_is_tracked_again_without_a_clock(rig):
    bench, node, odometry, _ = rig
    publisher = bench.peer.create_publisher(
        message_class('geometry_msgs/msg/PoseWithCovarianceStamped'), '/fix', 10
    )
    bench.spin_until(publisher.get_subscription_count)
    for count, second in enumerate((*range(1, 41), *range(1, 21)), start=1):
        publisher.publish(
            write_fix(
                Fix(
                    stamp_ns=second * 10**9,
                    position=(0.0, 2.0 * second, 0.0),
                    covariance=0.01 * np.eye(2),
                    frame_id='map',
                ),
                make,
            )
        )
        bench.spin_until(lambda want=count: node._meter.received['fix'] == want)
    bench.spin_until(lambda: odometry and odometry[-1].header.stamp.sec == 20)
    assert odometry[-1].pose.pose.position.y == pytest.approx(40.0, abs=0.5)


def test_a_storm_of_garbage_is_answered_and_leaves_no_garbage_behind(rig):
    bench, node, _, _ = rig
    tables = bench.listen(PointCloud2, '/diver/estimate', lockstep_qos())
    publisher = bench.peer.create_publisher(
        message_class('geometry_msgs/msg/PoseWithCovarianceStamped'), '/fix', lockstep_qos()
    )
    bench.spin_until(publisher.get_subscription_count)
    rng = np.random.default_rng(7)
    odd = np.array([np.nan, np.inf, -np.inf, 0.0, -0.0, -1.0, 5e-324, 1e-30, 1e30, 1.7e308])

    def some(size):
        values = rng.normal(scale=10.0, size=size)
        hit = rng.random(size) < 0.15
        values[hit] = rng.choice(odd, size=hit.sum())
        return values

    count = 500
    for k in range(1, count + 1):
        x, y, z = some(3)
        message = make('geometry_msgs/msg/PoseWithCovarianceStamped')
        message.pose.pose.position = make('geometry_msgs/msg/Point', x=x, y=y, z=z)
        message.pose.covariance = some(36) if k % 3 == 0 else np.diag(np.abs(some(6))).ravel()
        message.header.stamp.sec = int(rng.choice([k, k, k, k - 3, 0, -k, 2**31 - 1]))
        message.header.stamp.nanosec = int(rng.choice([0, 5, 10**9 - 1, 10**9, 2**32 - 1]))
        message.header.frame_id = str(rng.choice(['map'] * 8 + ['', 'map_ned', 'a' * 300]))
        publisher.publish(message)
        bench.spin_until(lambda want=k: node._meter.received['fix'] == want)
    bench.spin_until(lambda: len(tables) == node._published)
    refused = node._meter.refused
    assert {'nan', 'bad_stamp', 'bad_covariance'} <= set(refused)
    assert 0 < refused.total() < count
    assert not node._errors
    for table in tables:
        estimate = read_estimate(table)
        assert np.isfinite(estimate.state).all()
        assert np.isfinite(estimate.covariance).all()
        assert np.isfinite(estimate.probabilities).all()
    assert len(tables) > 10


def test_scans_are_heard_and_an_empty_one_is_a_missed_detection(make_bench):
    bench = make_bench()
    node = bench.add(DiverNode(context=bench.context))
    estimates = bench.listen(PointCloud2, '/diver/estimate')
    publisher = bench.peer.create_publisher(PointCloud2, '/fixes', lockstep_qos())
    bench.spin_until(
        lambda: publisher.get_subscription_count() and node._estimates.get_subscription_count()
    )
    for second in range(1, 8):
        places = [[0.5 * second, 0.0, 0.0]] if second < 7 else np.empty((0, 3))
        scan = Fixes(
            stamp_ns=second * 10**9,
            position=places,
            covariance=np.tile(np.eye(2), (len(places), 1, 1)),
            target_id=np.full(len(places), -1),
            frame_id='map',
        )
        publisher.publish(write_scan(scan, make))
    bench.spin_until(lambda: len(estimates) == 7)
    states = [read_estimate(message).extras['track_state'].tolist() for message in estimates]
    assert states[2:] == [[1]] * 4 + [[2]]
