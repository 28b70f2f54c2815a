# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The obstacle node: three inputs, and displays that say how unsure the height is."""

from attrs import evolve
from geometry_msgs.msg import PoseArray
import numpy as np
import pytest
from sensor_msgs.msg import JointState, LaserScan
from std_srvs.srv import Trigger
from visualization_msgs.msg import Marker, MarkerArray

from msg_adapters.detections import write_detections
from msg_adapters.displays.obstacle import band, write_markers, write_poses
from msg_adapters.displays.tracks import write_ended
from msg_adapters.navigation import write_navigation, write_range
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Altitude, Detections, Navigation
from sonar_imm.nodes.messages import make
from sonar_imm.nodes.obstacle import ObstacleNode
from sonar_imm.nodes.qos import latched_qos
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.obstacle.tracker import ObstacleConfig, ObstacleTracker
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate

WRITERS = {
    Detections: ('/detections', 'sensor_msgs/msg/PointCloud2', write_detections),
    Navigation: ('/nav', 'nav_msgs/msg/Odometry', write_navigation),
    Altitude: ('/altitude', 'sensor_msgs/msg/Range', write_range),
}


class Rig:
    def __init__(self, bench):
        self.bench = bench
        self.node = bench.add(ObstacleNode(context=bench.context))
        self.poses = bench.listen(PoseArray, '/obstacle/obstacles')
        self.markers = bench.listen(MarkerArray, '/obstacle/markers')
        self.probabilities = bench.listen(JointState, '/obstacle/model_probabilities')
        displays = ('obstacles', 'markers', 'model_probabilities')
        bench.spin_until(
            lambda: all(self.node.count_subscribers(f'/obstacle/{name}') for name in displays)
        )


@pytest.fixture
def rig(make_bench):
    return Rig(make_bench('-p', 'max_wait:=0.0'))


def an_estimate(ids, states, above=0.02):
    rows = len(ids)
    return Estimate(
        stamp_ns=5 * 10**9, frame_id='odom',
        xyz=np.tile(np.float32([40.0, 5.0, -23.0]), (rows, 1)),
        state_names=('range', 'bearing', 'vertical_offset'),
        state=np.tile([40.0, 0.1, 3.0], (rows, 1)), covariance=np.tile(np.eye(3), (rows, 1, 1)),
        model_names=('above', 'below'), probabilities=np.tile([above, 1.0 - above], (rows, 1)),
        extras={
            'track_id': np.array(ids, np.uint32),
            'track_state': np.array(states, np.uint8),
            'vertical_offset_lo': np.full(rows, 1.0),
            'vertical_offset_hi': np.full(rows, 4.5),
            'prob_fixed': 0.01 * np.array(ids),
            'prob_moving': 1.0 - 0.01 * np.array(ids),
        },
    )  # fmt: skip


def test_the_bar_reaches_as_far_as_the_band_and_the_right_way_up():
    estimate = an_estimate([7], [1])
    # 1.0 to 4.5 m below a sonar at z = -20.
    assert band(estimate, 0) == (-24.5, -21.0)
    bar, ball, label = write_markers(estimate, [0], make).markers
    assert (bar.ns, bar.type, bar.id, bar.action) == ('band', Marker.CUBE, 7, Marker.ADD)
    assert bar.scale.z == 3.5 and bar.pose.position.z == -22.75
    assert ball.type == Marker.SPHERE and ball.pose.position.z == -23.0
    assert label.type == Marker.TEXT_VIEW_FACING
    assert label.text == '7: 40 m ahead, +3.0 \N{PLUS-MINUS SIGN} 1.8 m down'
    assert all(
        marker.lifetime.sec > 0 and marker.header.frame_id == 'odom'
        for marker in (bar, ball, label)
    )


@pytest.mark.parametrize('half, text', [(1.9, '+3.0 \N{PLUS-MINUS SIGN} 1.9'), (2.0, '+3 ')])
def test_a_label_says_decimetres_where_the_band_is_within_two_metres(half, text):
    found = an_estimate([7], [1])
    ends = {'vertical_offset_lo': np.array([3.0 - half]), 'vertical_offset_hi': [3.0 + half]}
    *_, label = write_markers(evolve(found, extras={**found.extras, **ends}), [0], make).markers
    assert text in label.text


def test_the_marker_of_a_track_after_two_billion_others_has_a_number_that_ros_can_hold():
    bar, *_ = write_markers(an_estimate([2**31 + 5], [1]), [0], make).markers
    (ended,) = write_ended('odom', [2**31 + 5], ['band'], make).markers
    assert bar.id == ended.id == 5


def test_colours_tell_above_from_below_from_unknown():
    colours = [
        write_markers(an_estimate([1], [1], above), [0], make).markers[0].color
        for above in (0.02, 0.5, 0.98)
    ]
    assert colours[0].b > colours[0].r and colours[2].r > colours[2].b
    assert colours[1].r == colours[1].b


@pytest.mark.parametrize('risk, colour', [(0.01, 'g'), (0.5, 'r'), (np.nan, None)])
def test_the_ball_tells_how_probable_a_collision_is(risk, colour):
    estimate = an_estimate([1], [1])
    estimate = evolve(
        estimate, extras={**estimate.extras, 'collision_probability': np.array([risk])}
    )
    _, ball, label = write_markers(estimate, [0], make).markers
    strongest = max('rgb', key=lambda name: getattr(ball.color, name))
    if colour is None:
        assert ball.color.r == ball.color.g == ball.color.b and 'collision' not in label.text
    else:
        assert strongest == colour and label.text.endswith(f'collision {100 * risk:.0f} %')


def test_confirmed_obstacles_are_shown_and_the_oldest_gives_the_probabilities(rig):
    rig.node.show([an_estimate([9, 3, 5, 2], [1, 2, 1, 0])])
    rig.bench.spin_until(lambda: rig.poses and rig.markers and rig.probabilities)
    assert len(rig.poses[0].poses) == 3 and rig.poses[0].header.frame_id == 'odom'
    assert {marker.id for marker in rig.markers[0].markers} == {9, 3, 5}
    assert list(rig.probabilities[0].name) == ['above', 'below', 'fixed', 'moving']
    assert list(rig.probabilities[0].position) == [0.02, 0.98, 0.03, 0.97]
    rig.node.show([an_estimate([2], [0])])
    rig.bench.spin_until(lambda: len(rig.poses) == 2 and len(rig.markers) == 2)
    assert not rig.poses[1].poses
    drawn = {(marker.ns, marker.id) for marker in rig.markers[0].markers}
    assert {(marker.ns, marker.id) for marker in rig.markers[1].markers} == drawn
    assert {marker.action for marker in rig.markers[1].markers} == {Marker.DELETE}
    assert {marker.header.frame_id for marker in rig.markers[1].markers} == {'odom'}


def test_reset_deletes_all_markers(rig):
    rig.node.show([an_estimate([1], [1])])
    assert rig.bench.call(Trigger, '/obstacle/reset', Trigger.Request()).success
    rig.bench.spin_until(lambda: len(rig.markers) == 2)
    assert [marker.action for marker in rig.markers[1].markers] == [Marker.DELETEALL]


def test_a_type_that_is_not_installed_is_refused_in_one_sentence(make_bench):
    bench = make_bench('-p', "input_types:=['detections=marine_acoustic_msgs/msg/SonarRanges']")
    with pytest.raises(ConfigError, match='SonarRanges is not installed'):
        bench.add(ObstacleNode(context=bench.context))


def test_a_laser_scan_is_heard_when_it_is_asked_for(make_bench):
    bench = make_bench('-p', "input_types:=['detections=sensor_msgs/msg/LaserScan']")
    node = bench.add(ObstacleNode(context=bench.context))
    scan = make('sensor_msgs/msg/LaserScan', range_max=50.0, ranges=[10.0])
    scan.header.stamp.sec = 5
    bench.send(node, bench.publisher(LaserScan, '/detections', 10), scan)
    assert not node._meter.refused and node.tracker.health()['pings_waiting'] == 1


def test_places_far_from_the_origin_keep_their_centimetres():
    """float32 is half a metre coarse at a northing of 9e6."""
    estimate = an_estimate([1], [1])
    place = np.array([[500_000.37, 9_000_000.21, -30.0]])
    far = evolve(estimate, xyz=place)
    pose = write_poses(far, [0], make).poses[0].position
    ball = write_markers(far, [0], make).markers[1].pose.position
    for point in (pose, ball):
        assert (point.x, point.y) == (500_000.37, 9_000_000.21)


def test_places_of_the_tracker_are_not_rounded_either():
    config = scenario('late', {'last_range': 60.0})
    near = [item.measurement for item in simulate(config, 3).measurements]
    shift = np.array([500_000.0, 9_000_000.0, 0.0])
    far = [
        evolve(item, position=item.position + shift) if isinstance(item, Navigation) else item
        for item in near
    ]
    trackers = ObstacleTracker(ObstacleConfig()), ObstacleTracker(ObstacleConfig())
    runs = [
        [estimate for item in scene for estimate in tracker.process(item)]
        for tracker, scene in zip(trackers, (near, far))
    ]
    assert any(len(estimate) for estimate in runs[0])
    for run, other in zip(*runs, strict=True):
        np.testing.assert_allclose(other.xyz - shift, run.xyz, atol=1e-4)


def test_what_was_passed_is_on_the_map(rig):
    """Latched: who listens later gets it."""
    scene = simulate(scenario('approach', {'first_range': 30.0, 'last_range': -6.0}), 3)
    publishers = {
        kind: rig.bench.publisher(type_name, topic)
        for kind, (topic, type_name, _) in WRITERS.items()
    }
    for item in scene.measurements:
        kind = type(item.measurement)
        rig.bench.send(rig.node, publishers[kind], WRITERS[kind][2](item.measurement, make))
    assert rig.markers and any(message.poses for message in rig.poses)
    (mark,) = rig.node.tracker.landmarks
    maps = rig.bench.listen(PoseArray, '/obstacle/map', latched_qos())
    rig.bench.spin_until(lambda: maps)
    (pose,) = maps[-1].poses
    assert maps[-1].header.frame_id == 'odom'
    found = (pose.position.x, pose.position.y, pose.position.z)
    assert found == pytest.approx(tuple(mark.place))
    rig.node.start_afresh()
    rig.bench.spin_until(lambda: not maps[-1].poses)
