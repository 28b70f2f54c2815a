# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Recordings of drivers whose packages are not installed, of vessels, tags and sensors."""

import json
import math

from helpers.marine import driver_message, typestore
import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from msg_adapters.fixes import write_fix, write_geodetic
from msg_adapters.navigation import write_navigation
from msg_adapters.scans import write_scan
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.measurements import Fix, Fixes, GeodeticFix, VesselPose
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm_tools.offline.inspection import inspect
from sonar_imm_tools.offline.run_folder import RunFolder
from sonar_imm_tools.offline.tracking import InputOptions, OfflineRun, write_run
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.positions import (
    GAP_S,
    Positions,
    read_navigated,
    read_positions,
    write_position,
)
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.topics import fitting_topics

START, SECOND = 1_700_000_000, 10**9
ORIGIN = Origin(59.0, 10.0)


def write_bag(path, records):
    """A bag as its recorder writes it: with the definitions of its types."""
    with Writer(path, version=8, storage_plugin=StoragePlugin.MCAP) as writer:
        links = {}
        for stamp_ns, topic, message in sorted(records, key=lambda item: item[0]):
            name = message.__msgtype__
            if topic not in links:
                links[topic] = writer.add_connection(topic, name, typestore=typestore())
            raw = typestore().serialize_cdr(message, name)
            writer.write(links[topic], stamp_ns, raw)
    return path


def tracked(bag, folder, topics=None, **parameters):
    """run.json and the last estimate."""
    config = DiverConfig.from_mapping(parameters)
    with BagReader(bag) as reader:
        offline = OfflineRun(reader, SYSTEMS['diver'], config, InputOptions(topics=topics))
        run_folder = RunFolder(folder)
        with run_folder.fresh(overwrite=True) as unfinished:
            write_run(unfinished, offline)
    run = json.loads((folder / 'run.json').read_text())
    return run, run_folder.read_estimates()


def vessel(seconds):
    """The vessel drives east at 1 m/s, bow north."""
    stamp = round((START + seconds) * SECOND)
    pose = VesselPose(
        stamp_ns=stamp,
        position=(seconds, 0.0, 0.0),
        orientation=(0.0, 0.0, np.sin(np.pi / 4), np.cos(np.pi / 4)),
        frame_id='odom',
    )
    return stamp, '/nav', write_navigation(pose, ros_message)


def beacon(kind, seconds):
    """A diver at rest 20 m north and 10 m east of where the vessel began, 5 m deep."""
    ahead, starboard = 20.0, 10.0 - seconds
    distance = np.sqrt(ahead**2 + starboard**2 + 25.0)
    stamp = {'header__stamp__sec': START + seconds, 'header__frame_id': 'usbl'}
    if kind == 'stonefish_ros2/msg/BeaconInfo':
        at = {
            f'relative_position__{axis}': value
            for axis, value in zip('xyz', (ahead, starboard, 5.0))
        }
        return driver_message(kind, beacon_id=6, **stamp, **at)
    if kind == 'acomms_msgs/msg/UsblData':
        stamp['header__stamp__sec'] += 2
        enu = {f'enu__{axis}': value for axis, value in zip('xyz', (starboard, ahead, -5.0))}
        return driver_message(kind, remote_address=6, current_time=2.0, **stamp, **enu)
    return driver_message(
        kind,
        src_id=6,
        includes_range=True,
        includes_usbl=True,
        range_dist=round(10 * distance),
        usbl_azimuth=round(10 * np.degrees(np.arctan2(starboard, ahead))),
        usbl_elevation=round(-10 * np.degrees(np.arcsin(5.0 / distance))),
        **stamp,
    )


@pytest.mark.parametrize(
    'kind',
    [
        'seatrac_interfaces/msg/ModemRec',
        'acomms_msgs/msg/UsblData',
        'stonefish_ros2/msg/BeaconInfo',
    ],
)
def test_a_driver_without_its_package_is_tracked_from_the_vessel(tmp_path, kind):
    records = [vessel(k - 0.4) for k in range(1, 22)]
    records += [((START + k) * SECOND, '/usbl/relative', beacon(kind, k)) for k in range(2, 20)]
    bag = write_bag(tmp_path / 'bag', records)
    run, estimates = tracked(bag, tmp_path / 'run')
    assert run['topics'] == {'/nav': 'nav', '/usbl/relative': 'relative'}
    last = estimates[-1]
    assert last.frame_id == 'odom' and last.extras['target_id'].tolist() == [6]
    assert last.stamp_ns == (START + 19) * SECOND
    assert last.state[0, :2] == pytest.approx([10.0, 20.0], abs=0.3)
    with BagReader(bag) as reader:
        found = {item['name']: item['suits'] for item in inspect(reader)['topics']}
    assert found['/usbl/relative'] == ['diver relative'] and 'diver nav' in found['/nav']


def test_a_driver_on_any_topic_is_suggested(tmp_path):
    kind = 'seatrac_interfaces/msg/ModemRec'
    records = [((START + k) * SECOND, '/modem_rec', beacon(kind, k)) for k in range(2, 5)]
    with BagReader(write_bag(tmp_path / 'bag', records)) as reader:
        found = inspect(reader)
    assert found['topics'][0]['suits'] == ['diver relative']
    assert found['systems']['diver'] == {'relative': ['/modem_rec']}


def geo(k, topic='/fix', status=0, x=None, frame_id='gps'):
    place = ORIGIN.geodetic(np.array([0.7 * k if x is None else x, 5.0, 0.0]))
    fix = GeodeticFix(
        stamp_ns=(START + k) * SECOND, latitude=place[0], longitude=place[1],
        covariance=0.04 * np.eye(3), frame_id=frame_id,
    )  # fmt: skip
    message = write_geodetic(fix, ros_message)
    message.status.status = status
    return fix.stamp_ns, topic, message


def test_navsatfix_is_tracked_and_what_says_nothing_is_named_and_counted(tmp_path):
    records = [geo(k, status=-1 if k % 5 == 0 else 0) for k in range(1, 30)]
    polls = [geo(k, x=0.7 * 7) for k in (8,)]
    records = [record for record in records if record[0] != polls[0][0]] + polls
    run, estimates = tracked(
        write_bag(tmp_path / 'bag', records),
        tmp_path / 'run',
        origin=(59.0, 10.0, 0.0),
    )
    assert {reason: item['count'] for reason, item in run['refused'].items()} == {
        'no_fix': 5,
        'repeated': 1,
    }
    assert run['counts']['refused'] == 6
    assert run['origin'] == {'latitude': 59.0, 'longitude': 10.0, 'height': 0.0}
    last = estimates[-1]
    assert last.state[0, :2] == pytest.approx([0.7 * 29, 5.0], abs=0.1)
    assert last.extras['latitude'] == pytest.approx([ORIGIN.geodetic(last.state[0, [0, 1, 2]])[0]])


def test_the_gps_of_a_vessel_is_not_taken_for_a_diver(tmp_path):
    def fix(k):
        position = (0.5 * k, 0.1, 0.0)
        item = Fix(
            stamp_ns=(START + k) * SECOND, position=position, covariance=0.04 * np.eye(2),
            frame_id='map',
        )  # fmt: skip
        return item.stamp_ns, '/usbl/fix', write_fix(item, ros_message)

    records = [fix(k) for k in range(1, 10)] + [geo(k, '/gps/fix') for k in range(1, 10)]
    bag = write_bag(tmp_path / 'bag', records)
    run, estimates = tracked(bag, tmp_path / 'run')
    assert run['topics'] == {'/usbl/fix': 'fix'} and len(estimates[-1]) == 1
    assert run['problems'] == [
        'topic /gps/fix (sensor_msgs/msg/NavSatFix) is left out, because /usbl/fix says where '
        'divers are; choose it with --topic fix=/gps/fix'
    ]


def test_navigation_without_relative_fixes_is_left_alone(tmp_path):
    records = [vessel(k) for k in range(1, 5)] + [geo(k) for k in range(1, 5)]
    with BagReader(write_bag(tmp_path / 'bag', records)) as reader:
        assert list(fitting_topics(reader, 'diver')) == ['/fix']


def test_tags_by_topic_and_frame_have_their_own_tracks(tmp_path):
    records = [geo(k, '/amy/fix', x=0.3 * k) for k in range(1, 20)]
    records += [geo(k, '/divers/fix', x=5.0 - 0.3 * k, frame_id='bob') for k in range(1, 20)]
    _, estimates = tracked(
        write_bag(tmp_path / 'bag', records), tmp_path / 'run', tags=('amy', 'bob')
    )
    last = estimates[-1]
    by_name = dict(zip(last.extras['target_id'].tolist(), last.state[:, 0]))
    assert by_name[1] - by_name[2] == pytest.approx(0.6 * 19 - 5.0, abs=0.2)


def test_sensors_by_topic_have_their_own_numbers(tmp_path):
    def scan(k, sensor):
        fixes = Fixes(
            stamp_ns=(START + k) * SECOND, position=[[0.4 * k, 0.0, 0.0]], frame_id='map'
        )
        return fixes.stamp_ns, f'/{sensor}/fixes', write_scan(fixes, ros_message)

    spread = {}
    for sensor in ('radar', 'lidar'):
        bag = write_bag(tmp_path / sensor, [scan(k, sensor) for k in range(1, 15)])
        _, estimates = tracked(
            bag,
            tmp_path / f'run_{sensor}',
            **{'sensors': ['radar', 'lidar'], 'radar.fix_std': 5.0, 'lidar.fix_std': 0.5},
        )
        spread[sensor] = estimates[-1].covariance[0, 0, 0]
    assert spread['radar'] > 4.0 * spread['lidar']


def test_metres_and_latitudes_without_an_origin_are_said(tmp_path):
    records = [vessel(k - 0.4) for k in range(1, 8)]
    records += [
        ((START + k) * SECOND, '/relative', beacon('stonefish_ros2/msg/BeaconInfo', k))
        for k in range(2, 6)
    ]
    records += [geo(k, '/amy/fix') for k in range(1, 8)]
    chosen = {'/nav': 'nav', '/relative': 'relative', '/amy/fix': 'fix'}
    run, _ = tracked(write_bag(tmp_path / 'bag', records), tmp_path / 'run', chosen)
    assert run['counts']['no_origin'] == 4
    assert 'parameter origin ' in run['warnings'][0]


def test_the_navigation_comes_along_with_a_chosen_topic(tmp_path):
    kind = 'stonefish_ros2/msg/BeaconInfo'
    records = [vessel(k - 0.4) for k in range(1, 8)]
    records += [((START + k) * SECOND, '/usbl_info', beacon(kind, k)) for k in range(2, 6)]
    bag = write_bag(tmp_path / 'bag', records)
    run, estimates = tracked(bag, tmp_path / 'run', {'/usbl_info': 'relative'})
    assert run['topics'] == {'/usbl_info': 'relative', '/nav': 'nav'}
    assert estimates[-1].state[0, :2] == pytest.approx([10.0, 20.0], abs=0.3)


def at(seconds, longitude, latitude, when):
    """Longitude and latitude `when`, s after the start, by fixes at `seconds`."""
    stamps = (START + np.array(seconds)) * SECOND
    positions = Positions(stamps, np.array(longitude), np.array(latitude))
    return positions.at(np.array([round((START + item) * SECOND) for item in when]))


def test_a_place_between_two_fixes_goes_the_short_way_over_the_date_line():
    east, north = at([0, 10], [179.9, -179.7], [1.0, 2.0], [0.0, 2.5, 5.0, 7.5, 10.0])
    assert east == pytest.approx([179.9, -180.0, -179.9, -179.8, -179.7])
    assert north == pytest.approx([1.0, 1.25, 1.5, 1.75, 2.0])
    east, _ = at([0, 10], [-0.1, 0.1], [1.0, 2.0], [5.0])  # and over Greenwich
    assert east == pytest.approx([0.0])


def test_far_from_all_fixes_there_is_no_place():
    near, far = GAP_S - 0.5, GAP_S + 0.5
    when = [-far, -near, 0.0, near, far, 100.0 - near, 100.0, 100.0 + near, 100.0 + far]
    for column in at([0, 100], [10.0, 11.0], [59.0, 60.0], when):
        wanted = [True, False, False, False, True, False, False, False, True]
        assert np.isnan(column).tolist() == wanted


def test_only_fixes_of_a_receiver_that_has_one_are_places(tmp_path):
    records = []
    for k, status in enumerate((0, -1, 2, 0)):
        message = write_position((START + k) * SECOND, 10.0 + k, 59.0)
        message.status.status = status
        records.append(((START + k) * SECOND, '/position', message))
    records[3][2].latitude = 91.0
    with BagReader(write_bag(tmp_path / 'bag', records)) as reader:
        found = read_positions(reader)
    assert found.stamp_ns.tolist() == [START * SECOND, (START + 2) * SECOND]
    assert found.longitude.tolist() == [10.0, 12.0]


def test_a_place_of_the_navigation_with_one_coordinate_is_none(tmp_path):
    records = []
    for k, (x, y) in enumerate(((1.0, 2.0), (3.0, math.nan), (math.nan, 4.0), (5.0, 6.0))):
        header = ros_message(
            'std_msgs/msg/Header',
            stamp=ros_message('builtin_interfaces/msg/Time', sec=START + k, nanosec=0),
            frame_id='map',
        )
        message = ros_message('nav_msgs/msg/Odometry', header=header)
        message.pose.pose.position.x, message.pose.pose.position.y = x, y
        records.append(((START + k) * SECOND, '/nav', message))
    with BagReader(write_bag(tmp_path / 'bag', records)) as reader:
        found = read_navigated(reader, lambda places: (places[:, 0], places[:, 1]))
    assert found.stamp_ns.tolist() == [START * SECOND, (START + 3) * SECOND]
    assert (found.longitude.tolist(), found.latitude.tolist()) == ([1.0, 5.0], [2.0, 6.0])
