# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Where a sonar is on its vehicle is kept by a node that is started again."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from msg_adapters.fixes import write_fix, write_start
from msg_adapters.inputs import inputs_of
from msg_adapters.transforms import write_transforms
from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.measurements import Detections, Fix, Start, StaticTransforms
from sonar_imm.nodes.bathymetry import BathymetryNode
from sonar_imm.nodes.diver import DiverNode
from sonar_imm.nodes.messages import make, message_class
from sonar_imm.nodes.obstacle import ObstacleNode
from sonar_imm.nodes.qos import transforms_qos
from sonar_imm.trackers.diver.known import track_positions
from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.writer import BagWriter
from sonar_imm_tools.simulation.obstacle import simulator as ahead

LEVER, RPY = (1.5, -0.3, 0.4), (2.0, -5.0, 8.0)
ALONE = 'geometry_msgs/msg/TransformStamped'
HEARD = f"input_types:=['tf_static={ALONE}']"


def transform(child, parent, position, rpy):
    """A TransformStamped, which is installed everywhere; tf2_msgs is not."""
    pose = Pose(np.array(position), geometry.rotation(*np.radians(rpy)))
    given = write_transforms(StaticTransforms(poses={child: (parent, pose)}), ros_message)
    turn = given.transforms[0].transform.rotation
    made = make(ALONE, header=make('std_msgs/msg/Header', frame_id=parent), child_frame_id=child)
    for part, values in ((made.transform.translation, position), (made.transform.rotation, None)):
        for k, name in enumerate('xyz' if values else 'xyzw'):
            setattr(part, name, float(values[k] if values else getattr(turn, name)))
    return made


@pytest.fixture
def live(make_bench, tmp_path):
    """Begin one life of a node that keeps its state; gives it, what sends to it, and what tells
    it a transform."""

    def begin(kind, *more):
        words = f'state_file:={tmp_path / "state"}', HEARD, 'max_wait:=0.0', *more
        bench = make_bench(p=words)
        node = bench.start(kind)

        def send(topic, message, type_name, qos=None):
            bench.send(node, bench.publisher(type_name, topic, qos), message)

        def tell(*where):
            send('/tf_static', transform(*where), ALONE, transforms_qos())

        return SimpleNamespace(node=node, send=send, tell=tell, end=lambda: bench.end(node))

    return begin


def written(system, measurement, name):
    """What `live` sends of a measurement for an input."""
    entry = next(item for item in inputs_of(system) if item.name == name)
    return entry.full_name(system), entry.write(measurement, make), next(iter(entry.readers))


def a_fix(second, frame_id, x, y):
    place = {'position': (x, y, 0.0), 'covariance': np.eye(2), 'frame_id': frame_id}
    return Fix(stamp_ns=round(second * 1e9), **place)


def test_the_place_of_the_sonar_outlives_who_said_it(live, capfd):
    frames = 'vehicle_frame:=base_link', 'sonar_frame:=sonar'
    seen = Detections(stamp_ns=10**9, range=[30.0], bearing=[0.1], frame_id='sonar')
    ping = written('obstacle', seen, 'detections')
    first = live(ObstacleNode, *frames)
    first.send(*ping)
    assert first.node._meter.refused['no_mounting'] == 1  # nobody has said it
    first.tell('sonar', 'base_link', LEVER, RPY)
    first.send(*ping)
    assert first.node._meter.refused.total() == 1
    first.end()
    again = live(ObstacleNode, *frames)
    assert 'goes on from the state' in capfd.readouterr().err
    again.send(*ping)
    assert not again.node._meter.refused
    config = again.node.tracker.config
    assert config.sonar_lever == LEVER and config.sonar_mount_rpy_deg == pytest.approx(RPY)
    again.tell('sonar', 'base_link', (0.0, 0.0, 1.0), RPY)  # mounted elsewhere meanwhile
    assert again.node.tracker.config.sonar_lever == (0.0, 0.0, 1.0)


def test_a_place_that_was_said_before_the_node_was_there_is_heard(make_bench):
    bench = make_bench(p=[HEARD, 'vehicle_frame:=base_link', 'sonar_frame:=sonar'])
    publisher = bench.peer.create_publisher(message_class(ALONE), '/tf_static', transforms_qos())
    publisher.publish(transform('sonar', 'base_link', LEVER, RPY))
    node = bench.start(BathymetryNode)
    bench.spin_until(lambda: node._meter.received.total())
    assert node.tracker.config.sonar_lever == LEVER


def test_a_track_that_was_told_and_frames_outlive_their_publishers(live, capfd):
    start = written('diver', a_fix(1.0, 'map', 105.0, 7.0), 'initial')
    first = live(DiverNode, 'frame_id:=map')
    first.send(*written('diver', a_fix(0.5, 'odom', 5.0, 7.0), 'fix'))
    assert first.node._meter.refused['frame'] == 1
    given = "'odom' is not the frame 'map' of the tracks, and no fixed"
    assert given in capfd.readouterr().err
    first.tell('odom', 'map', (100.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    first.send(*start)
    first.end()
    again = live(DiverNode, 'frame_id:=map')
    again.send(*written('diver', a_fix(2.0, 'odom', 5.5, 7.0), 'fix'))
    tracker = again.node.tracker
    known = tracker._stream.state
    assert not again.node._meter.refused
    assert track_positions(known, tracker.models)[0][:, 0] == pytest.approx([105.4], abs=0.3)
    assert known.life.track_id.tolist() == [1] and known.life.status.tolist() == [1]
    again.send(*start)  # it need not be told again
    assert len(tracker._stream.state) == 1


def test_places_that_were_recorded_count_offline(tmp_path):
    """Where the sonar is, on /tf_static, and where a diver is, on /initial."""

    def run_of(system, records, parameters):
        with BagWriter(tmp_path / system) as bag:
            for topic, message, stamp_ns in records:
                bag.write(topic, message, stamp_ns)
        params = tmp_path / f'{system}.yaml'
        params.write_text(f'{system}: {{ros__parameters: {{{parameters}}}}}')
        words = 'track', tmp_path / system, tmp_path / f'{system}_run', '--params', params
        assert main([str(word) for word in words]) == 0
        return json.loads((tmp_path / f'{system}_run' / 'run.json').read_text())

    pose = Pose(np.array(LEVER), geometry.rotation(*np.radians(RPY)))
    told = write_transforms(StaticTransforms(poses={'sonar': ('base_link', pose)}), ros_message)
    records, entries = [('/tf_static', told.transforms[0], 1)], inputs_of('obstacle')
    for each in ahead.simulate(ahead.scenario('approach', {}), 1).measurements[:300]:
        entry = next(e for e in entries if e.measurement is type(each.measurement))
        message = entry.write(each.measurement, ros_message)
        records.append((f'/{entry.name}', message, each.received_ns))
    run = run_of('obstacle', records, 'vehicle_frame: base_link, sonar_frame: sonar')
    assert run['mounting']['sonar_lever'] == list(LEVER) and not run['refused']
    place = {'position': [5.0, 7.0, 0.0], 'covariance': np.eye(2)}
    start = write_start(Start(stamp_ns=10**9, **place), ros_message)
    fixes = [
        ('/fix', write_fix(a_fix(k, '', 5.0 + k, 7.0), ros_message), k * 10**9) for k in (2, 3)
    ]
    run = run_of('diver', [('/initial', start, 10**9), *fixes], 'model_set: heading_speed')
    assert run['topics']['/initial'] == 'initial' and run['counts']['used'] == 3
