# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A node that is started again with a state file, and what it is told once: where its sonar is,
where a diver is, and frames."""

import json
import re
import time
from types import SimpleNamespace

from helpers.hostile.files import forge, parts_of
from helpers.node_bench import a_fix, Rig
import numpy as np
import pytest
from std_srvs.srv import Trigger

from msg_adapters.fixes import write_fix, write_start
from msg_adapters.inputs import inputs_of
from msg_adapters.transforms import write_transforms
from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.files import fcntl
from sonar_imm.measurements import Detections, Fix, Start, StaticTransforms
from sonar_imm.nodes.base import TrackerNode
from sonar_imm.nodes.bathymetry import BathymetryNode
from sonar_imm.nodes.diver import DiverNode
from sonar_imm.nodes.messages import make, message_class
from sonar_imm.nodes.obstacle import ObstacleNode
from sonar_imm.nodes.qos import transforms_qos
from sonar_imm.parameters import ConfigError
from sonar_imm.trackers.diver.known import track_positions
from sonar_imm.trackers.state_file import read_state
from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.writer import BagWriter
from sonar_imm_tools.simulation.obstacle import simulator as ahead

pytestmark = pytest.mark.usefixtures('walker')


@pytest.fixture
def start(make_bench, tmp_path):
    """Start a rig whose node keeps its state in `tmp_path`, with more parameters."""
    return lambda *given: Rig(make_bench(p=[f'state_file:={tmp_path / "state"}', *given]))


@pytest.mark.skipif(fcntl is None, reason='there are no locks')
def test_a_second_node_with_the_same_file_leaves_it_alone(start, tmp_path, capfd):
    """As two namespaces do that share one parameter file; then the first one ends."""
    first = start()
    first.send(a_fix(1.0, 0.0, 0.0), a_fix(2.0, 2.0, 8.0))
    first.node._saved_state.save(first.node._config, wait=True)
    assert not (tmp_path / 'state.refused').exists()
    written = (tmp_path / 'state').read_bytes()
    second = start()
    assert 'another node has the state_file' in capfd.readouterr().err
    assert 'another node has the state_file' in second.node.work_report()['warnings'][-1]
    second.send(a_fix(3.0, 4.0, 4.0))
    second.node._saved_state.save(second.node._config, wait=True)
    assert (tmp_path / 'state').read_bytes() == written
    first.end()
    second.send(a_fix(4.0, 4.0, 4.0))
    second.end()
    assert not capfd.readouterr().err.count('another node')
    assert read_state(tmp_path / 'state').newest_ns == 4 * 10**9
    assert read_state(tmp_path / 'state.refused').newest_ns == 2 * 10**9
    assert len(list(tmp_path.iterdir())) == 2


def test_a_node_that_is_started_again_goes_on_and_a_reset_is_kept(start, tmp_path):
    rig = start()
    rig.send(a_fix(0.5, 9.0, 9.0))
    rig.bench.call(Trigger, '/walker/reset', Trigger.Request())
    rig.send(a_fix(1.0, 0.0, 0.0), a_fix(2.0, 2.0, 8.0))
    rig.end()
    assert [path.name for path in tmp_path.iterdir()] == ['state']
    again = start()
    again.send(a_fix(2.0, 2.0, 8.0), a_fix(3.0, 4.0, 4.0), a_fix(4.0, 2.0, 0.0, 'odom'))
    assert again.means() == [(3.0, 2.0, 4.0)]
    assert again.answer == (3, 1, 1)  # the frame was not forgotten either
    assert again.node.tracker.counts['duplicate'] == 1


@pytest.mark.usefixtures('quick')
def test_states_are_saved_while_running_and_only_when_something_was_heard(start, tmp_path):
    rig = start()
    rig.bench.spin_until(lambda: rig.node._saved_state._taken == 0)
    rig.send(a_fix(1.0))
    rig.bench.spin_until((tmp_path / 'state').exists)
    rig.node._saved_state._thread.join()
    written = (tmp_path / 'state').stat().st_mtime_ns
    ticks = []
    rig.node.create_timer(0.3, lambda: ticks.append(1))
    rig.bench.spin_until(lambda: ticks)
    assert (tmp_path / 'state').stat().st_mtime_ns == written
    assert read_state(tmp_path / 'state').newest_ns == 10**9


def test_files_that_cannot_be_used_are_named_and_kept(start, tmp_path, capfd):
    (tmp_path / 'state').write_text('shopping list')
    rig = start()
    assert 'is not used: it is no state of a tracker' in capfd.readouterr().err
    assert (tmp_path / 'state').read_text() == 'shopping list'
    rig.send(a_fix(1.0))
    rig.end()
    assert (tmp_path / 'state.refused').read_text() == 'shopping list'
    assert read_state(tmp_path / 'state').system == 'walker'


def test_a_state_that_does_not_go_with_what_is_measured_is_given_up(start, tmp_path, capfd):
    """It loads, and the tracker raises at the first measurement: the node goes on without it."""
    rig = start()
    rig.send(a_fix(1.0))
    rig.end()
    header, arrays = parts_of(tmp_path / 'state')
    header['state']['tracker']['fixes'] = [[1, 'a fix']]
    forge(tmp_path / 'state', header, arrays)
    again = start()
    again.send(a_fix(2.0), a_fix(3.0, 3.0, 3.0), a_fix(4.0, 3.0, 3.0))
    said = capfd.readouterr().err
    assert said.count('does not go with what is measured (AttributeError)') == 1
    assert 'Traceback' not in said and 'internal error' not in said
    assert sorted(again.node.tracker.fixes) == [3 * 10**9, 4 * 10**9]
    again.end()
    assert read_state(tmp_path / 'state').newest_ns == 4 * 10**9
    assert (tmp_path / 'state.refused').exists()


def test_other_parameters_and_old_states_are_not_used(start, tmp_path, capfd, monkeypatch):
    rig = start()
    rig.send(a_fix(1.0))
    rig.end()
    start('steps:=4').end()
    assert 'other parameters: steps was 3, is 4' in capfd.readouterr().err
    start('frame_id:=map').end()
    assert 'another frame_id or world_frame_convention' in capfd.readouterr().err
    now = time.time_ns()
    with monkeypatch.context() as clock:
        clock.setattr('time.time_ns', lambda: now + 400 * 10**9)
        start().end()
        assert re.search('saved 4.. s ago, state_max_age is 300 s', capfd.readouterr().err)
        clock.setattr('time.time_ns', lambda: now - 500 * 10**9)
        start().end()
        assert 's ahead of the clock' in capfd.readouterr().err
    start('slow_share:=0.5', 'fast_share:=0.5')
    assert 'goes on from the state' in capfd.readouterr().err


def test_measurements_of_another_time_end_the_state_and_one_outlier_does_not(start, capfd):
    rig = start()
    rig.send(a_fix(1000.0, 9.0, 9.0))
    rig.end()
    again = start()
    again.send(a_fix(5000.0), a_fix(1001.0, 1.0, 1.0))
    assert again.node._saved_state._loaded_ns is None
    assert again.means()[-1][0] == 5000.0 and len(again.node.tracker.fixes) == 3
    again.node._saved_state.close()  # what the file sees of a process that is killed
    capfd.readouterr()
    other = start()
    other.send(*[a_fix(5000.0 + k, 1.0, 1.0) for k in range(4)])
    assert 'are +4002 s from the last one of the state' in capfd.readouterr().err
    assert sorted(other.node.tracker.fixes) == [5002 * 10**9, 5003 * 10**9]
    other.end()
    earlier = start()
    earlier.send(*[a_fix(100.0 + k, 1.0, 1.0) for k in range(3)])
    assert 'are -4901 s from the last one of the state' in capfd.readouterr().err
    assert sorted(earlier.node.tracker.fixes) == [102 * 10**9]


def test_a_disk_that_is_full_is_said(start, monkeypatch, capfd):
    def full(path, saved):
        raise OSError(28, 'No space left on device')

    rig = start()

    def save(seconds):
        rig.send(a_fix(seconds))
        rig.node._saved_state.save(rig.node.tracker.config, wait=True)

    with monkeypatch.context() as disk:
        disk.setattr('sonar_imm.nodes.saved_state.write_state', full)
        save(1.0)
        save(2.0)
        assert 'No space left on device' in rig.node._saved_state.trouble
        assert capfd.readouterr().err.count('the state cannot be saved') == 1
    save(3.0)  # somebody made room
    assert rig.node._saved_state.trouble == ''


@pytest.mark.parametrize(
    'file, sentence',
    [('/nowhere/state', 'there is no folder'), ('~nobody-here/state', 'stands for no folder')],
)
def test_a_folder_that_is_not_there_ends_the_node(make_bench, file, sentence):
    with pytest.raises(ConfigError, match=sentence):
        make_bench(p=[f'state_file:={file}']).start(TrackerNode, 'walker')


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


def told_fix(second, frame_id, x, y):
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
    start = written('diver', told_fix(1.0, 'map', 105.0, 7.0), 'initial')
    first = live(DiverNode, 'frame_id:=map')
    first.send(*written('diver', told_fix(0.5, 'odom', 5.0, 7.0), 'fix'))
    assert first.node._meter.refused['frame'] == 1
    given = "'odom' is not the frame 'map' of the tracks, and no fixed"
    assert given in capfd.readouterr().err
    first.tell('odom', 'map', (100.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    first.send(*start)
    first.end()
    again = live(DiverNode, 'frame_id:=map')
    again.send(*written('diver', told_fix(2.0, 'odom', 5.5, 7.0), 'fix'))
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
        ('/fix', write_fix(told_fix(k, '', 5.0 + k, 7.0), ros_message), k * 10**9) for k in (2, 3)
    ]
    run = run_of('diver', [('/initial', start, 10**9), *fixes], 'model_set: heading_speed')
    assert run['topics']['/initial'] == 'initial' and run['counts']['used'] == 3
