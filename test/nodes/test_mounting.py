# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Where a sonar is on its vehicle is kept by a node that is started again."""

from attrs import evolve
import numpy as np
import pytest

from msg_adapters.inputs import inputs_of
from msg_adapters.transforms import write_transforms
from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.measurements import Detections, Fix, Snapshot, StaticTransforms
from sonar_imm.nodes.bathymetry import BathymetryNode
from sonar_imm.nodes.diver import DiverNode
from sonar_imm.nodes.messages import make, message_class
from sonar_imm.nodes.obstacle import ObstacleNode
from sonar_imm.nodes.qos import transforms_qos
from sonar_imm.trackers.diver.known import track_positions
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.simulation.bathymetry import simulator as swath
from sonar_imm_tools.simulation.obstacle import simulator as ahead

LEVER, RPY = (1.5, -0.3, 0.4), (2.0, -5.0, 8.0)
ALONE = 'geometry_msgs/msg/TransformStamped'


def transform(child, parent, position, rpy):
    """A TransformStamped, which is installed everywhere; tf2_msgs is not."""
    pose = Pose(np.array(position), geometry.rotation(*np.radians(rpy)))
    given = write_transforms(StaticTransforms(poses={child: (parent, pose)}), ros_message)
    turn = given.transforms[0].transform.rotation
    where = {
        'translation': make('geometry_msgs/msg/Vector3', **dict(zip('xyz', position))),
        'rotation': make(
            'geometry_msgs/msg/Quaternion', **{name: getattr(turn, name) for name in 'xyzw'}
        ),
    }
    return make(
        ALONE, header=make('std_msgs/msg/Header', frame_id=parent), child_frame_id=child,
        transform=make('geometry_msgs/msg/Transform', **where),
    )  # fmt: skip


class Life:
    """One life of a node that keeps its state, and what is sent to it."""

    def __init__(self, make_bench, node_type, state, *more):
        words = [f'state_file:={state}', f"input_types:=['tf_static={ALONE}']", 'max_wait:=0.0']
        words += more
        self.bench = make_bench(*[word for item in words for word in ('-p', item)])
        self.node = self.bench.add(node_type(context=self.bench.context))

    def send(self, topic, message, type_name, qos=None):
        publisher = self.bench.publisher(type_name, topic, qos)
        self.bench.send(self.node, publisher, message)

    def tell(self, *where):
        self.send('/tf_static', transform(*where), ALONE, transforms_qos())

    def end(self):
        self.bench.nodes.remove(self.node)
        self.bench.executor.remove_node(self.node)
        self.node.destroy_node()


def a_ping(name):
    made = {'obstacle': (ahead, 'approach', Detections), 'bathymetry': (swath, 'paper', Snapshot)}
    scenes, scenario, kind = made[name]
    scene = scenes.simulate(scenes.scenario(scenario, {}), 1)
    ping = next(
        item.measurement for item in scene.measurements if isinstance(item.measurement, kind)
    )
    entry = next(item for item in inputs_of(name) if item.measurement is kind)
    return f'/{entry.name}', entry.write(ping, make), next(iter(entry.readers))


@pytest.mark.parametrize(
    'name, node', [('obstacle', ObstacleNode), ('bathymetry', BathymetryNode)]
)
def test_the_place_of_the_sonar_outlives_who_said_it(name, node, make_bench, tmp_path, capfd):
    frames = 'vehicle_frame:=base_link', 'sonar_frame:=sonar'
    ping = a_ping(name)
    first = Life(make_bench, node, tmp_path / 'state', *frames)
    first.send(*ping)
    assert first.node._meter.refused['no_mounting'] == 1  # nobody has said it
    first.tell('sonar', 'base_link', LEVER, RPY)
    first.send(*ping)
    assert first.node._meter.refused.total() == 1
    first.end()
    again = Life(make_bench, node, tmp_path / 'state', *frames)
    assert 'goes on from the state' in capfd.readouterr().err
    again.send(*ping)
    assert not again.node._meter.refused
    config = again.node.tracker.config
    assert config.sonar_lever == LEVER and config.sonar_mount_rpy_deg == pytest.approx(RPY)
    again.tell('sonar', 'base_link', (0.0, 0.0, 1.0), RPY)  # mounted elsewhere meanwhile
    assert again.node.tracker.config.sonar_lever == (0.0, 0.0, 1.0)


def test_a_place_that_was_said_before_the_node_was_there_is_heard(make_bench):
    words = f"input_types:=['tf_static={ALONE}']", 'vehicle_frame:=base_link', 'sonar_frame:=sonar'
    bench = make_bench(*[word for item in words for word in ('-p', item)])
    publisher = bench.peer.create_publisher(message_class(ALONE), '/tf_static', transforms_qos())
    publisher.publish(transform('sonar', 'base_link', LEVER, RPY))
    node = bench.add(BathymetryNode(context=bench.context))
    bench.spin_until(lambda: node._meter.received.total())
    assert node.tracker.config.sonar_lever == LEVER


def test_a_track_that_was_told_and_frames_outlive_their_publishers(make_bench, tmp_path, capfd):
    def fix_at(topic, seconds, frame_id, x, y):
        fix = Fix(
            stamp_ns=round(seconds * 1e9), position=(x, y, 0.0), covariance=np.eye(2),
            frame_id=frame_id,
        )  # fmt: skip
        entry = next(item for item in inputs_of('diver') if item.name == topic.rpartition('/')[2])
        return topic, entry.write(fix, make), next(iter(entry.readers))

    first = Life(make_bench, DiverNode, tmp_path / 'state', 'frame_id:=map')
    first.tell('odom', 'map', (100.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    first.send(*fix_at('/diver/initial', 1.0, 'map', 105.0, 7.0))
    first.end()
    again = Life(make_bench, DiverNode, tmp_path / 'state', 'frame_id:=map')
    again.send(*fix_at('/fix', 2.0, 'odom', 5.5, 7.0))
    tracker = again.node.tracker
    known = tracker._stream.state
    assert not again.node._meter.refused
    assert track_positions(known, tracker.models)[0][:, 0] == pytest.approx([105.4], abs=0.3)
    assert known.life.track_id.tolist() == [1] and known.life.status.tolist() == [1]
    again.send(*fix_at('/diver/initial', 1.0, 'map', 105.0, 7.0))  # it need not be told again
    assert len(tracker._stream.state) == 1


def test_a_fix_in_a_frame_that_the_tree_knows_is_turned_and_another_is_refused(make_bench, capfd):
    bench = make_bench('-p', 'frame_id:=map')
    node = bench.add(DiverNode(context=bench.context))
    kind = next(entry for entry in inputs_of('diver') if entry.name == 'fix')
    type_name = next(iter(kind.readers))
    fixes = bench.publisher(type_name, '/fix')
    publisher = bench.publisher(ALONE, '/tf_static', transforms_qos())

    def fix(second, frame_id):
        place = Fix(stamp_ns=second * 10**9, position=(1.0, 2.0, 0.0), frame_id=frame_id)
        return kind.write(evolve(place, covariance=np.eye(2)), make)

    bench.send(node, fixes, fix(1, 'buoy'))
    assert node._meter.refused['frame'] == 1
    assert "'buoy' is not the frame 'map' of the tracks, and no fixed" in capfd.readouterr().err
    bench.send(node, publisher, transform('buoy', 'map', (100.0, 0.0, 0.0), (0.0, 0.0, 90.0)))
    bench.send(node, fixes, fix(2, 'buoy'))
    assert node._meter.refused['frame'] == 1
    bench.send(node, fixes, fix(4, 'odom'))
    assert node._meter.refused['frame'] == 2
    assert node.tracker.counts['used'] == 1
