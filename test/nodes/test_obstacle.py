# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The obstacle node: three inputs, and displays that say how unsure the height is."""

from types import SimpleNamespace

from attrs import evolve
from geometry_msgs.msg import PoseArray
import numpy as np
import pytest
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from visualization_msgs.msg import Marker, MarkerArray

from msg_adapters.displays.obstacle import band, write_markers, write_poses
from msg_adapters.displays.tracks import write_ended
from msg_adapters.inputs import inputs_of
from sonar_imm.estimates import Estimate
from sonar_imm.nodes.messages import make
from sonar_imm.nodes.obstacle import ObstacleNode
from sonar_imm.nodes.qos import latched_qos
from sonar_imm_tools.simulation.obstacle.simulator import scenario, simulate


@pytest.fixture
def rig(make_bench):
    bench = make_bench(p=['max_wait:=0.0'])
    kinds = {'obstacles': PoseArray, 'markers': MarkerArray, 'model_probabilities': JointState}
    node = bench.start(ObstacleNode)
    poses, markers, probabilities = bench.hear(node, **kinds)
    return SimpleNamespace(
        bench=bench, node=node, poses=poses, markers=markers, probabilities=probabilities
    )


def an_estimate(ids, states=(1,), above=0.02, half=1.75, **more):
    """`half` as wide as the band is; more: other extras."""
    rows = len(ids)
    place, state = np.float32([40.0, 5.0, -23.0]), [40.0, 0.1, 3.0]
    return Estimate(
        stamp_ns=5 * 10**9, frame_id='odom', xyz=np.tile(place, (rows, 1)),
        state_names=('range', 'bearing', 'vertical_offset'), state=np.tile(state, (rows, 1)),
        covariance=np.tile(np.eye(3), (rows, 1, 1)), model_names=('above', 'below'),
        probabilities=np.tile([above, 1.0 - above], (rows, 1)),
        extras={
            'track_id': np.array(ids, np.uint32), 'track_state': np.array(states, np.uint8),
            'vertical_offset_lo': np.full(rows, 2.75 - half),
            'vertical_offset_hi': np.full(rows, 2.75 + half),
            'prob_fixed': 0.01 * np.array(ids), 'prob_moving': 1.0 - 0.01 * np.array(ids), **more,
        },
    )  # fmt: skip


def drawn(*arguments, **more):
    """The bar, the ball and the label of one obstacle."""
    return write_markers(an_estimate([7], [1], *arguments, **more), [0], make).markers


def test_the_bar_reaches_as_far_as_the_band_and_the_right_way_up():
    # 1.0 to 4.5 m below a sonar at z = -20.
    assert band(an_estimate([7]), 0) == (-24.5, -21.0)
    bar, ball, label = drawn()
    assert (bar.ns, bar.type, bar.id, bar.action) == ('band', Marker.CUBE, 7, Marker.ADD)
    assert bar.scale.z == 3.5 and bar.pose.position.z == -22.75
    assert ball.type == Marker.SPHERE and ball.pose.position.z == -23.0
    assert label.type == Marker.TEXT_VIEW_FACING
    assert label.text == '7: 40 m ahead, +3.0 \N{PLUS-MINUS SIGN} 1.8 m down'
    for marker in (bar, ball, label):
        assert marker.lifetime.sec > 0 and marker.header.frame_id == 'odom'
    # A label says decimetres where the band is within two metres.
    assert '+3.0 \N{PLUS-MINUS SIGN} 1.9' in drawn(half=1.9)[2].text
    assert '+3 \N{PLUS-MINUS SIGN} 2' in drawn(half=2.0)[2].text
    # After two billion other tracks a number is still one that ROS can hold.
    late, *_ = write_markers(an_estimate([2**31 + 5]), [0], make).markers
    (ended,) = write_ended('odom', [2**31 + 5], ['band'], make).markers
    assert late.id == ended.id == 5


@pytest.mark.parametrize('risk, colour', [(0.01, 'g'), (0.5, 'r'), (np.nan, None)])
def test_the_ball_tells_how_probable_a_collision_is_the_bar_above_from_below(risk, colour):
    _, ball, label = drawn(collision_probability=np.array([risk]))
    strongest = max('rgb', key=lambda name: getattr(ball.color, name))
    if colour is None:
        assert ball.color.r == ball.color.g == ball.color.b and 'collision' not in label.text
    else:
        assert strongest == colour and label.text.endswith(f'collision {100 * risk:.0f} %')
    below, unknown, above = (drawn(share)[0].color for share in (0.02, 0.5, 0.98))
    assert below.b > below.r and unknown.r == unknown.b and above.r > above.b


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
    before, after = (
        {(marker.ns, marker.id, marker.header.frame_id) for marker in each.markers}
        for each in rig.markers
    )
    assert before == after and {each.action for each in rig.markers[1].markers} == {Marker.DELETE}


def test_reset_deletes_all_markers(rig):
    rig.node.show([an_estimate([1], [1])])
    assert rig.bench.call(Trigger, '/obstacle/reset', Trigger.Request()).success
    rig.bench.spin_until(lambda: len(rig.markers) == 2)
    assert [marker.action for marker in rig.markers[1].markers] == [Marker.DELETEALL]


def test_places_far_from_the_origin_keep_their_centimetres():
    """float32 is half a metre coarse at a northing of 9e6."""
    far = evolve(an_estimate([1]), xyz=np.array([[500_000.37, 9_000_000.21, -30.0]]))
    pose = write_poses(far, [0], make).poses[0].position
    ball = write_markers(far, [0], make).markers[1].pose.position
    for point in (pose, ball):
        assert (point.x, point.y) == (500_000.37, 9_000_000.21)


def test_what_was_passed_is_on_the_map(rig):
    """Latched: who listens later gets it."""
    scene = simulate(scenario('approach', {'first_range': 30.0, 'last_range': -6.0}), 3)
    inputs, publishers = {entry.measurement: entry for entry in inputs_of('obstacle')}, {}
    for item in scene.measurements:
        entry = inputs[type(item.measurement)]
        message = entry.write(item.measurement, make)
        if entry.name not in publishers:
            publishers[entry.name] = rig.bench.publisher(type(message), f'/{entry.name}')
        rig.bench.send(rig.node, publishers[entry.name], message)
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
