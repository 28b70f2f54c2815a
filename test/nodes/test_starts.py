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

"""``~/initial`` of the diver node: a track begins where somebody says that a diver is."""

import math

from geometry_msgs.msg import PoseWithCovarianceStamped
import numpy as np
from sensor_msgs.msg import PointCloud2

from msg_adapters.estimates import read_estimate
from msg_adapters.fixes import write_fix, write_start
from sonar_imm.measurements import Fix, Start
from sonar_imm.nodes.diver import DiverNode
from sonar_imm.nodes.messages import make

POSE = PoseWithCovarianceStamped
SECOND = 10**9


def start(second, x, frame_id='map'):
    return write_start(
        Start(
            stamp_ns=second * SECOND,
            position=[x, 2.0, 0.0],
            covariance=np.eye(2),
            frame_id=frame_id,
        ),
        make,
    )


def test_a_start_begins_a_track_and_a_useless_one_is_refused_by_name(make_bench, capfd):
    bench = make_bench()
    node = bench.add(DiverNode(context=bench.context))
    estimates = bench.listen(PointCloud2, '/diver/estimate')
    initial = bench.peer.create_publisher(POSE, '/diver/initial', 10)
    fixes = bench.peer.create_publisher(POSE, '/fix', 10)
    bench.spin_until(
        lambda: (
            initial.get_subscription_count()
            and fixes.get_subscription_count()
            and node.count_subscribers('/diver/estimate')
        )
    )

    def send(publisher, message):
        before = node._meter.received.total()
        publisher.publish(message)
        bench.spin_until(lambda: node._meter.received.total() > before)

    send(initial, start(1, 5.0))
    bench.spin_until(lambda: estimates)
    first = read_estimate(estimates[0])
    assert first.extras['track_state'].tolist() == [1] and first.xyz[0].tolist() == [5.0, 2.0, 0.0]
    fix = Fix(stamp_ns=2 * SECOND, position=[5.5, 2.0, 0.0], frame_id='map')
    send(fixes, write_fix(fix, make))
    bench.spin_until(lambda: len(estimates) == 2)
    assert read_estimate(estimates[1]).extras['track_id'].tolist() == [1]

    nan, unknown = start(3, math.pi), start(3, 4.0)
    nan.pose.pose.position.x = math.nan
    unknown.pose.covariance = np.zeros(36)
    for bad in (nan, unknown, start(3, 4.0, frame_id='odom')):
        send(initial, bad)
    assert node._meter.refused == {'nan': 1, 'no_covariance': 1, 'frame': 1}
    assert node._meter.received == {'initial': 4, 'fix': 1} and len(estimates) == 2
    errors = capfd.readouterr().err
    assert "the frame 'odom' is not the frame 'map' of the tracks" in errors
    assert 'the start has no covariance of x and y' in errors
    assert 'the start has a position that is not finite' in errors
