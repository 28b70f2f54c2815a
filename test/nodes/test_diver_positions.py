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

"""The diver node with positions as users have them: on Earth, from a vessel, with names."""

from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import pytest
from sensor_msgs.msg import NavSatFix, PointCloud2
from std_srvs.srv import Trigger

from msg_adapters.estimates import read_estimate
from msg_adapters.fixes import read_geodetic, write_geodetic, write_relative
from msg_adapters.navigation import write_navigation
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.measurements import GeodeticFix, RelativeFix, VesselPose
from sonar_imm.nodes.diver import DiverNode
from sonar_imm.nodes.messages import make, message_class
from sonar_imm.nodes.qos import lockstep_qos
from sonar_imm.parameters import ConfigError

ORIGIN = Origin(59.0, 10.0)
SECOND = 10**9


def start(make_bench, *parameters):
    bench = make_bench(*(item for value in parameters for item in ('-p', value)))
    node = bench.add(DiverNode(context=bench.context))
    return bench, node


def publisher(bench, type_name, topic):
    made = bench.peer.create_publisher(message_class(type_name), topic, lockstep_qos())
    bench.spin_until(made.get_subscription_count)
    return made


def on_earth(k, x, status=0, topic_frame='gps'):
    latitude, longitude, _ = ORIGIN.geodetic(np.array([x, 5.0, 0.0]))
    message = write_geodetic(
        GeodeticFix(
            stamp_ns=k * SECOND,
            latitude=latitude,
            longitude=longitude,
            covariance=0.04 * np.eye(3),
            frame_id=topic_frame,
        ),
        make,
    )
    message.status.status = status
    return message


def received(node):
    return node._meter.received.total()


def test_navsatfix_in_and_out(make_bench):
    bench, node = start(make_bench, 'fix_type:=sensor_msgs/msg/NavSatFix')
    geo = bench.listen(NavSatFix, '/diver/geo')
    bench.spin_until(lambda: node.count_subscribers('/diver/geo'))
    fixes = publisher(bench, 'sensor_msgs/msg/NavSatFix', '/fix')
    for k in range(1, 21):
        fixes.publish(on_earth(k, 0.5 * k))
        bench.spin_until(lambda want=k: received(node) == want)
    bench.spin_until(lambda: geo and geo[-1].header.stamp.sec == 20)
    assert geo[-1].header.frame_id == 'diver_1'
    back = read_geodetic(geo[-1])
    assert ORIGIN.local(back.latitude, back.longitude)[:2] == pytest.approx([10.0, 5.0], abs=0.2)
    assert back.covariance[0, 0] < 0.04 < 1e5 < back.covariance[2, 2]


def test_what_has_no_fix_and_what_is_repeated_is_in_diagnostics(make_bench):
    bench, node = start(
        make_bench, 'fix_type:=sensor_msgs/msg/NavSatFix', 'diagnostics_period:=0.1'
    )
    arrived = bench.listen(DiagnosticArray, '/diagnostics')
    fixes = publisher(bench, 'sensor_msgs/msg/NavSatFix', '/fix')
    for k, x, status in ((1, 0.0, 0), (2, 0.0, 0), (3, 0.5, -1), (4, 0.6, 0)):
        fixes.publish(on_earth(k, x, status))
    bench.spin_until(lambda: received(node) == 4)
    assert dict(node._meter.refused) == {'repeated': 1, 'no_fix': 1}
    count = len(arrived)
    bench.spin_until(lambda: len(arrived) > count + 1)
    values = {item.key: item.value for status in arrived[-1].status for item in status.values}
    assert values['refused: repeated'] == '1' and values['refused: no_fix'] == '1'


def test_after_a_reset_nothing_is_a_repetition(make_bench):
    bench, node = start(make_bench, 'fix_type:=sensor_msgs/msg/NavSatFix')
    fixes = publisher(bench, 'sensor_msgs/msg/NavSatFix', '/fix')
    for k in (1, 2):
        fixes.publish(on_earth(k, 0.0))
        bench.spin_until(lambda want=k: received(node) == want)
    assert node._meter.refused == {'repeated': 1}
    bench.call(Trigger, '/diver/reset', Trigger.Request())
    fixes.publish(on_earth(3, 0.0))
    bench.spin_until(lambda: received(node) == 3)
    assert node._meter.refused == {'repeated': 1} and node._published == 2


def test_relative_fixes_are_composed_with_nav(make_bench):
    bench, node = start(make_bench)
    tables = bench.listen(PointCloud2, '/diver/estimate', lockstep_qos())
    relative = publisher(bench, 'geometry_msgs/msg/PoseWithCovarianceStamped', '/relative')
    nav = publisher(bench, 'nav_msgs/msg/Odometry', '/nav')
    for k in range(1, 12):
        pose = VesselPose(
            stamp_ns=round((k - 0.5) * SECOND),
            position=(float(k), 0.0, 0.0),
            orientation=(0.0, 0.0, np.sin(np.pi / 4), np.cos(np.pi / 4)),
            frame_id='odom',
        )
        nav.publish(write_navigation(pose, make))
        bench.spin_until(lambda want=2 * k - 1: received(node) == want)
        fix = RelativeFix(stamp_ns=k * SECOND, offset=(20.0, k + 0.5, -5.0), frame_id='usbl')
        relative.publish(write_relative(fix, make))
        bench.spin_until(lambda want=2 * k: received(node) == want)
    bench.spin_until(lambda: len(tables) == node._published)
    last = read_estimate(tables[-1])
    assert last.frame_id == 'odom' and last.stamp_ns == 10 * SECOND
    assert last.state[0, :2] == pytest.approx([0.0, 20.0], abs=0.3)
    assert node.tracker.health()['waiting_for_vessel'] == 1


def test_a_tag_has_a_topic_of_its_own(make_bench):
    bench, node = start(make_bench, 'fix_type:=sensor_msgs/msg/NavSatFix', "tags:=['amy','bob']")
    tables = bench.listen(PointCloud2, '/diver/estimate', lockstep_qos())
    amy = publisher(bench, 'sensor_msgs/msg/NavSatFix', '/amy/fix')
    bob = publisher(bench, 'sensor_msgs/msg/NavSatFix', '/bob/fix')
    for k in range(1, 8):
        amy.publish(on_earth(k, 0.3 * k))
        bench.spin_until(lambda want=2 * k - 1: received(node) == want)
        bob.publish(on_earth(k, 1.0 + 0.2 * k))
        bench.spin_until(lambda want=2 * k: received(node) == want)
    bench.spin_until(lambda: len(tables) == node._published)
    assert sorted(read_estimate(tables[-1]).extras['target_id'].tolist()) == [1, 2]


def test_a_type_that_is_not_installed_is_one_sentence(make_bench):
    with pytest.raises(ConfigError, match='BeaconInfo is not installed here'):
        start(make_bench, 'relative_type:=stonefish_ros2/msg/BeaconInfo')
