# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What ``info`` recommends works; recordings in either convention of axes."""

import json
import shlex

from attrs import evolve
from helpers import marine
from helpers.dive_bags import write_dive
from helpers.field_files import bag_of, FORMATS, line
from helpers.source import ROOT
import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
from scipy.spatial.transform import Rotation

from msg_adapters.fixes import write_geodetic
from msg_adapters.inputs import inputs_of
from sonar_imm.measurements import Detections, GeodeticFix, Navigation
from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.measurements import fitting_topics, measurements_of
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.sources import quoted
from sonar_imm_tools.recordings.writer import BagWriter, ros_message

SHIPPED = sorted(path.name for path in (ROOT / 'bags').iterdir() if path.is_dir())


def recommended(bag, capsys):
    """The commands that ``info`` prints, the best one first."""
    capsys.readouterr()
    assert main(['info', str(bag)]) == 0
    lines = capsys.readouterr().out.splitlines()
    return [
        line.partition(': ')[2]
        for line in lines
        if line.startswith(('to track it: ', 'or as something else: '))
    ]


def run(command, out, capsys, *more):
    """What a recommended command leaves."""
    program, *arguments = shlex.split(command)
    assert program == 'sonar-imm'
    arguments = [str(out) if word == 'OUT_DIR' else word for word in arguments]
    capsys.readouterr()
    assert main([*arguments, *more, '--json']) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize('name', SHIPPED)
def test_the_tracker_of_every_shipped_recording_is_recommended(name, capsys):
    """By this command test_processors.py tracks them all."""
    (command,) = recommended(ROOT / 'bags' / name, capsys)
    bag, system = quoted(str(ROOT / 'bags' / name)), name.split('_')[0]
    assert command == f'sonar-imm track {bag} OUT_DIR --system {system}'


def copied(name, out, rename=None, extra=()):
    """A shipped recording under other names, with further messages (topic, message, log time)."""
    with BagReader(ROOT / 'bags' / name) as reader, BagWriter(out) as writer:
        for item in reader.messages():
            if 'truth' not in item.topic:
                writer.write((rename or {}).get(item.topic, item.topic), item.message, item.log_ns)
        for topic, message, log_ns in extra:
            writer.write(topic, message, log_ns)
    return out


def test_topics_that_have_to_be_named_are_all_named(tmp_path, capsys):
    names = {'/nav': '/odom', '/detections': '/fls/points'}
    with BagReader(ROOT / 'bags' / 'obstacle_movers') as reader:
        # Of two odometries nobody knows which one is meant.
        other = [('/wheels', item.message, item.log_ns) for item in reader.messages(['/nav'])][:9]
    bag = copied('obstacle_movers', tmp_path / 'bag', names, other)
    command = recommended(bag, capsys)[0]
    assert '--topic nav=/odom' in command and '--topic detections=/fls/points' in command
    assert run(command, tmp_path / 'out', capsys)['rows'] > 0
    bag = copied('obstacle_movers', tmp_path / 'one', {'/nav': '/odom'})
    given = run(recommended(bag, capsys)[0], tmp_path / 'out1', capsys)
    assert given['rows'] > 0 and given['system'] == 'obstacle'


def test_the_ships_own_position_is_no_diver(tmp_path, capsys):
    """A recording of obstacles with a NavSatFix on a topic ``fix`` fits two trackers."""
    with BagReader(ROOT / 'bags' / 'obstacle_tethers') as reader:
        logs = [item.log_ns for item in reader.messages(['/nav'])][::10]
    fixes = [
        (
            '/gps/fix',
            write_geodetic(
                GeodeticFix(
                    stamp_ns=log_ns, latitude=54.0, longitude=10.0, height=0.0, frame_id='gps'
                ),
                ros_message,
            ),
            log_ns,
        )
        for log_ns in logs
    ]
    bag = copied('obstacle_tethers', tmp_path / 'bag', extra=fixes)
    commands = recommended(bag, capsys)
    assert [command.split()[-1] for command in commands] == ['obstacle', 'diver']
    assert main(['track', str(bag), str(tmp_path / 'out')]) == 0
    assert json.loads((tmp_path / 'out' / 'run.json').read_text())['system'] == 'obstacle'


def test_a_pose_is_the_diver_rather_than_a_receivers_position(tmp_path, capsys):
    """Neither is named: of both, the one that may be the ship's own is not tracked."""
    bag = write_dive(tmp_path / 'dive', topic='/usbl/pose', truth=False)
    with BagReader(bag) as reader, BagWriter(tmp_path / 'bag') as writer:
        for item in reader.messages():
            own = GeodeticFix(
                stamp_ns=item.log_ns, latitude=54.0, longitude=10.0, height=0.0, frame_id='gps'
            )
            writer.write(item.topic, item.message, item.log_ns)
            writer.write('/gps/fix', write_geodetic(own, ros_message), item.log_ns)
    bag = tmp_path / 'bag'
    assert main(['track', str(bag), str(tmp_path / 'out')]) == 0
    printed = capsys.readouterr().out
    assert 'diver <- /usbl/pose as fix (120 messages)' in printed
    own = "ignored: /gps/fix (120 messages): the ship's own position? --topic fix=/gps/fix"
    assert own in printed
    (command,) = recommended(bag, capsys)
    assert run(command, tmp_path / 'again', capsys)['topics'] == {'/usbl/pose': 'fix'}
    own = run(command, tmp_path / 'own', capsys, '--topic', 'fix=/gps/fix')
    assert own['topics'] == {'/gps/fix': 'fix'}


def test_a_laser_scan_with_odometry_is_tracked_as_info_says(tmp_path, capsys):
    """Without its options the refusal speaks of the tracker that ``info`` recommends."""
    with BagReader(ROOT / 'bags' / 'obstacle_movers') as reader:
        navs = [(item.message, item.log_ns) for item in reader.messages(['/nav'])][:100]
    ranges = np.full(101, 30.0, np.float32)
    ranges[50] = 12.0
    with BagWriter(tmp_path / 'bag') as writer:
        for nav, log_ns in navs:
            scan = ros_message(
                'sensor_msgs/msg/LaserScan',
                header=nav.header,
                **{'angle_min': -0.5, 'angle_max': 0.5, 'angle_increment': 0.01},
                **{'time_increment': 0.0, 'scan_time': 0.1, 'range_min': 0.1, 'range_max': 25.0},
                **{'ranges': ranges, 'intensities': np.ones(101, np.float32)},
            )
            writer.write('/odom', nav, log_ns)
            writer.write('/scan', scan, log_ns)
    bag = tmp_path / 'bag'
    (command,) = recommended(bag, capsys)
    assert '--topic nav=/odom --topic detections=/scan' in command
    assert run(command, tmp_path / 'out', capsys)['rows'] > 0
    assert main(['track', str(bag), str(tmp_path / 'no')]) == 2
    refusal = capsys.readouterr().err
    assert 'no topic for the obstacle tracker' in refusal
    assert '/odom as nav' in refusal and '/scan as detections' in refusal


def test_what_only_the_user_knows_of_an_image_is_asked_in_the_command(tmp_path, capsys):
    """A picture of ranges by beams states neither; with both told, the command works."""
    shade = np.random.default_rng(1).rayleigh(12, (20, 100, 60))
    shade[:, 40:43, 30:32] += 200.0
    with BagReader(ROOT / 'bags' / 'obstacle_movers') as reader:
        navs = [(item.message, item.log_ns) for item in reader.messages(['/nav'])][:100]
    with BagWriter(tmp_path / 'bag') as writer:
        for nav, log_ns in navs:
            writer.write('/odom', nav, log_ns)
        for (nav, log_ns), pixels in zip(navs[::5], np.minimum(shade, 255).astype(np.uint8)):
            image = ros_message(
                'sensor_msgs/msg/Image',
                header=nav.header,
                **{'height': 100, 'width': 60, 'encoding': 'mono8', 'is_bigendian': 0},
                **{'step': 60, 'data': pixels.ravel()},
            )
            writer.write('/sonar/image', image, log_ns)
    (command,) = recommended(tmp_path / 'bag', capsys)
    told = command.replace('=METRES', '=40').replace('=DEGREES', '=90')
    assert told != command
    assert run(told, tmp_path / 'out', capsys)['rows'] > 0


def test_a_type_that_nobody_hears_names_what_would_do(tmp_path, capsys):
    types, kind = get_typestore(Stores.ROS2_JAZZY), 'usbl_msgs/msg/Target'
    types.register(get_types_from_msg('std_msgs/Header header\nfloat64 range', kind))

    def messages(each, stamp):
        header = marine.header(sec=stamp // 10**9)
        yield '/usbl/target', types.types[kind](header=header, range=40.0)

    bag_of(tmp_path / 'dive', line(5), messages, types)
    assert main(['track', str(tmp_path / 'dive'), str(tmp_path / 'run')]) == 2
    sentence = capsys.readouterr().err
    assert kind in sentence and 'PoseWithCovarianceStamped' in sentence
    assert 'diver' in sentence and 'bathymetry' not in sentence
    assert main(['info', str(tmp_path / 'dive')]) == 1
    assert 'fix takes geometry_msgs/msg/PoseWithCovarianceStamped' in capsys.readouterr().out


def test_both_sides_of_a_side_scan(tmp_path, capsys):
    scene = ('two_sides', '--set', 'pings=2', '--set', 'last_range=22')
    assert main(['simulate', 'bathymetry', str(tmp_path / 'bag'), '--scenario', *scene]) == 0
    few = ('--set', 'particles_per_model=10')
    (command,) = recommended(tmp_path / 'bag', capsys)
    assert run(command, tmp_path / 'out', capsys, *few)['estimates'] == 4
    names = {f'/{side}/snapshot': f'/{side}_sonar/x/snapshot' for side in ('port', 'starboard')}
    with BagReader(tmp_path / 'bag') as reader, BagWriter(tmp_path / 'other') as writer:
        for item in reader.messages(list(names)):
            writer.write(names[item.topic], item.message, item.log_ns)
    (command,) = recommended(tmp_path / 'other', capsys)
    assert run(command, tmp_path / 'named', capsys, *few)['estimates'] == 4


KINDS = ('usbl.csv', 'dive.gpx', 'gps.log', 'line.seg', 'frames')


@pytest.mark.parametrize(
    'command, name', [('track', 'usbl.csv'), *(('info', name) for name in KINDS)]
)
def test_a_file_of_another_kind_is_named_with_the_command_that_converts_it(
    command, name, tmp_path, capsys
):
    (each,) = (each for each in FORMATS if each.name == name)
    each.make(tmp_path / name, line(30))
    out = [str(tmp_path / 'out')] * (command == 'track')
    assert main([command, str(tmp_path / name), *out]) == 2
    suggested = capsys.readouterr().err.split('sonar-imm convert ')[1].split(' makes one')[0]
    words = suggested.replace('OUT_BAG', str(tmp_path / 'bag')).split()
    assert main(['convert', *words, *each.options]) == 0


def test_a_file_of_no_known_kind_says_what_it_lacks(tmp_path, capsys):
    (tmp_path / 'a.csv').write_text('Wann;Wo\n1;2\n')
    assert main(['info', str(tmp_path / 'a.csv')]) == 2
    assert '--column stamp=HEADER --column x=HEADER' in capsys.readouterr().err


@pytest.mark.parametrize(
    'path, here, on_windows',
    [
        ('dive.bag', 'dive.bag', 'dive.bag'),
        ('my dive.bag', "'my dive.bag'", '"my dive.bag"'),
        ('C:\\dives\\a.bag', "'C:\\dives\\a.bag'", 'C:\\dives\\a.bag'),
    ],
)
def test_a_suggested_command_is_one_that_the_shell_takes(path, here, on_windows):
    assert (quoted(path, windows=False), quoted(path, windows=True)) == (here, on_windows)


def test_images_of_an_interferometer_name_their_conversion(tmp_path, capsys):
    (each,) = (each for each in FORMATS if each.name == 'swath.bag')
    each.make(tmp_path / 'swath.bag', line(3))
    assert main(['info', str(tmp_path / 'swath.bag')]) == 1
    assert 'sonar-imm convert interferometer' in capsys.readouterr().out


# -- a publisher in NED and FRD, and one in ENU and FLU, get the same answer: in ENU --

TETHERS = ROOT / 'bags' / 'obstacle_tethers'
TO_NED, TO_FRD = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.diag([1, -1, -1])


def other_way(measurement):
    """As a vehicle in NED and FRD and a sonar that counts to starboard would state it."""
    if isinstance(measurement, Detections):
        return evolve(measurement, bearing=-measurement.bearing)
    if isinstance(measurement, Navigation):
        R = TO_NED @ Rotation.from_quat(measurement.orientation).as_matrix() @ TO_FRD
        return evolve(
            measurement, frame_id=measurement.frame_id + '_ned',
            position=TO_NED @ measurement.position, orientation=Rotation.from_matrix(R).as_quat(),
            pose_covariance=None, twist_covariance=None,
        )  # fmt: skip
    return measurement


@pytest.fixture
def ned_bag(tmp_path):
    write = {entry.measurement: (entry.name, entry.write) for entry in inputs_of('obstacle')}
    with BagReader(TETHERS) as bag, BagWriter(tmp_path / 'ned') as out:
        topics = {name: entry.name for name, entry in fitting_topics(bag, 'obstacle').items()}
        for received in measurements_of(bag, 'obstacle', topics):
            name, written = write[type(received.measurement)]
            message = written(other_way(received.measurement), ros_message)
            out.write(f'/{name}', message, received.measurement.stamp_ns)
    return tmp_path / 'ned'


def estimates(path):
    table = np.genfromtxt(path / 'estimate.csv', delimiter=',', names=True)
    return np.column_stack([table[name] for name in table.dtype.names])


def test_both_conventions_give_the_same_places(ned_bag, tmp_path):
    assert main(['track', str(TETHERS), str(tmp_path / 'enu_run'), '--order', 'stamp']) == 0
    given = ('--set', 'world_frame_convention=ned', '--set', 'bearing_positive=starboard')
    assert (
        main(['track', str(ned_bag), str(tmp_path / 'ned_run'), '--order', 'stamp', *given]) == 0
    )
    enu, ned = estimates(tmp_path / 'enu_run'), estimates(tmp_path / 'ned_run')
    assert len(enu) > 200
    np.testing.assert_allclose(ned, enu, rtol=1e-5, atol=1e-5)


def test_a_ned_frame_that_nobody_told_of_is_refused(ned_bag, tmp_path, capsys):
    assert main(['track', str(ned_bag), str(tmp_path / 'run')]) == 0
    assert 'north-east-down but east-north-up is expected' in capsys.readouterr().out
