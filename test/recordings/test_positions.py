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

from helpers import marine
from helpers.marine import driver_message
import numpy as np
import pytest

from msg_adapters.arrivals import write_arrivals
from msg_adapters.fixes import write_fix, write_geodetic
from msg_adapters.navigation import write_navigation
from msg_adapters.scans import write_scan
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.measurements import Arrivals, Fix, Fixes, GeodeticFix, Rejection, VesselPose
from sonar_imm.trackers import SYSTEMS
from sonar_imm.trackers.diver.config import DiverConfig
from sonar_imm.truth import TrueTrack
from sonar_imm_tools.offline.inspection import inspect
from sonar_imm_tools.offline.run_folder import RunFolder
from sonar_imm_tools.offline.tracking import InputOptions, OfflineRun, write_run
from sonar_imm_tools.recordings.measurements import fitting_topics, measurements_of
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.positions import (
    GAP_S,
    Positions,
    read_navigated,
    read_positions,
    write_position,
)
from sonar_imm_tools.recordings.reader import BagError, BagReader
from sonar_imm_tools.recordings.truth import records_of
from sonar_imm_tools.recordings.writer import BagWriter

START, SECOND = 1_700_000_000, 10**9
ORIGIN = Origin(59.0, 10.0)


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
        place = zip('xyz', (ahead, starboard, 5.0))
        at = {f'relative_position__{axis}': value for axis, value in place}
        return driver_message(kind, beacon_id=6, **stamp, **at)
    if kind == 'acomms_msgs/msg/UsblData':
        stamp['header__stamp__sec'] += 2
        enu = {f'enu__{axis}': value for axis, value in zip('xyz', (starboard, ahead, -5.0))}
        return driver_message(kind, remote_address=6, current_time=2.0, **stamp, **enu)
    return driver_message(
        kind, src_id=6, includes_range=True, includes_usbl=True, range_dist=round(10 * distance),
        usbl_azimuth=round(10 * np.degrees(np.arctan2(starboard, ahead))),
        usbl_elevation=round(-10 * np.degrees(np.arcsin(5.0 / distance))), **stamp,
    )  # fmt: skip


BEACON, MODEM = 'stonefish_ros2/msg/BeaconInfo', 'seatrac_interfaces/msg/ModemRec'


@pytest.mark.parametrize('kind', [MODEM, 'acomms_msgs/msg/UsblData', BEACON])
def test_a_driver_without_its_package_is_tracked_from_the_vessel(tmp_path, kind):
    records = [vessel(k - 0.4) for k in range(1, 22)]
    records += [((START + k) * SECOND, '/usbl/relative', beacon(kind, k)) for k in range(2, 20)]
    bag = marine.write_bag(tmp_path / 'bag', records)
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
    records = [((START + k) * SECOND, '/modem_rec', beacon(MODEM, k)) for k in range(2, 5)]
    with BagReader(marine.write_bag(tmp_path / 'bag', records)) as reader:
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
    bag = marine.write_bag(tmp_path / 'bag', records)
    run, estimates = tracked(bag, tmp_path / 'run', origin=(59.0, 10.0, 0.0))
    refused = {reason: item['count'] for reason, item in run['refused'].items()}
    assert refused == {'no_fix': 5, 'repeated': 1} and run['counts']['refused'] == 6
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
    bag = marine.write_bag(tmp_path / 'bag', records)
    run, estimates = tracked(bag, tmp_path / 'run')
    assert run['topics'] == {'/usbl/fix': 'fix'} and len(estimates[-1]) == 1
    assert run['problems'] == [
        'topic /gps/fix (sensor_msgs/msg/NavSatFix) is left out, because /usbl/fix says where '
        'divers are; choose it with --topic fix=/gps/fix'
    ]


def test_navigation_without_relative_fixes_is_left_alone(tmp_path):
    records = [vessel(k) for k in range(1, 5)] + [geo(k) for k in range(1, 5)]
    with BagReader(marine.write_bag(tmp_path / 'bag', records)) as reader:
        assert list(fitting_topics(reader, 'diver')) == ['/fix']


def test_tags_by_topic_and_frame_have_their_own_tracks(tmp_path):
    records = [geo(k, '/amy/fix', x=0.3 * k) for k in range(1, 20)]
    records += [geo(k, '/divers/fix', x=5.0 - 0.3 * k, frame_id='bob') for k in range(1, 20)]
    _, estimates = tracked(
        marine.write_bag(tmp_path / 'bag', records), tmp_path / 'run', tags=('amy', 'bob')
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
        bag = marine.write_bag(tmp_path / sensor, [scan(k, sensor) for k in range(1, 15)])
        _, estimates = tracked(
            bag,
            tmp_path / f'run_{sensor}',
            **{'sensors': ['radar', 'lidar'], 'radar.fix_std': 5.0, 'lidar.fix_std': 0.5},
        )
        spread[sensor] = estimates[-1].covariance[0, 0, 0]
    assert spread['radar'] > 4.0 * spread['lidar']


def test_metres_and_latitudes_without_an_origin_are_said(tmp_path):
    records = [vessel(k - 0.4) for k in range(1, 8)]
    records += [((START + k) * SECOND, '/relative', beacon(BEACON, k)) for k in range(2, 6)]
    records += [geo(k, '/amy/fix') for k in range(1, 8)]
    chosen = {'/nav': 'nav', '/relative': 'relative', '/amy/fix': 'fix'}
    run, _ = tracked(marine.write_bag(tmp_path / 'bag', records), tmp_path / 'run', chosen)
    assert run['counts']['no_origin'] == 4
    assert 'parameter origin ' in run['warnings'][0]


def test_the_navigation_comes_along_with_a_chosen_topic(tmp_path):
    records = [vessel(k - 0.4) for k in range(1, 8)]
    records += [((START + k) * SECOND, '/usbl_info', beacon(BEACON, k)) for k in range(2, 6)]
    bag = marine.write_bag(tmp_path / 'bag', records)
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
    with BagReader(marine.write_bag(tmp_path / 'bag', records)) as reader:
        found = read_positions(reader)
    assert found.stamp_ns.tolist() == [START * SECOND, (START + 2) * SECOND]
    assert found.longitude.tolist() == [10.0, 12.0]


def test_a_place_of_the_navigation_with_one_coordinate_is_none(tmp_path):
    records = []
    for k, (x, y) in enumerate(((1.0, 2.0), (3.0, math.nan), (math.nan, 4.0), (5.0, 6.0))):
        place = {'pose__pose__position__x': x, 'pose__pose__position__y': y}
        message = marine.put(ros_message('nav_msgs/msg/Odometry'), **place)
        message.header.stamp.sec = START + k
        records.append(((START + k) * SECOND, '/nav', message))
    with BagReader(marine.write_bag(tmp_path / 'bag', records)) as reader:
        found = read_navigated(reader, lambda places: (places[:, 0], places[:, 1]))
    assert found.stamp_ns.tolist() == [START * SECOND, (START + 3) * SECOND]
    assert (found.longitude.tolist(), found.latitude.tolist()) == ([1.0, 5.0], [2.0, 6.0])


# -- what a tracker hears of a recording


POINT = 'geometry_msgs/msg/PointStamped'


def ping():
    return write_arrivals(
        Arrivals(
            stamp_ns=10**18, tx_id=[0], rx_id=[1], tx=[[0.0, 0.0, 0.0]], rx=[[1.0, 0.0, 0.0]],
            toa=[0.1], var_toa=[np.nan], bearing=[np.nan], var_bearing=[np.nan], frame_id='map',
        ),
        ros_message,
    )  # fmt: skip


@pytest.fixture
def mixed(tmp_path, fix_message):
    """A bag with inputs, a refused fix, truth, and things that are not for the tracker."""
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write('/usbl/fix', fix_message(0), 1)
        bag.write('/usbl/fix', fix_message(1, covariance=None), 2)
        bad = fix_message(2)
        bad.pose.covariance[1] = 0.7
        bag.write('/usbl/fix', bad, 3)
        zero = fix_message(3)
        zero.pose.covariance[:] = 0.0
        bag.write('/usbl/fix', zero, 4)
        bag.write('/arrivals', ping(), 5)
        bag.write('/truth/fix', fix_message(9), 6)
        bag.write('/pose', fix_message(5), 7)
        true = TrueTrack(1, np.array([5]), np.array([[1, 2]]), np.zeros((1, 2)))
        for _, topic, message in records_of(true, 'm'):
            bag.write(topic, message, 8)
        bag.write('/other/fix', ros_message('std_msgs/msg/String', data='no fix'), 9)
    return tmp_path / 'bag'


def test_measurements_and_rejections_come_in_recorded_order(mixed):
    with BagReader(mixed) as bag:
        fitting = {name: entry.name for name, entry in fitting_topics(bag, 'diver').items()}
        assert fitting == {'/usbl/fix': 'fix', '/arrivals': 'arrivals'}  # by type and last name
        received = list(measurements_of(bag, 'diver'))
        found = [(item.topic, item.log_ns) for item in received]
        assert found == [*(('/usbl/fix', k) for k in (1, 2, 3, 4)), ('/arrivals', 5)]
        kinds = [type(item.measurement) for item in received]
        assert kinds == [Fix, Fix, Rejection, Fix, Arrivals]
        assert received[2].measurement.reason == 'bad_covariance'
        for k in (1, 3):
            assert received[k].measurement.covariance is None
        assert bag.problems == [
            'topic /usbl/fix: 1 messages have a covariance of zeros, which is taken as unknown'
        ]


def test_a_topic_map_chooses(mixed):
    with BagReader(mixed) as bag:
        received = list(measurements_of(bag, 'diver', {'/pose': 'fix'}, world_frame='ned'))
        assert len(received) == 1 and received[0].measurement.position.tolist() == [2.0, 5.0, 0.0]


@pytest.mark.parametrize(
    'topics, words',
    [
        ({'/pose': 'fixx'}, ["no input 'fixx'", "'fix'"]),
        ({'/posee': 'fix'}, ["'/pose'"]),
        ({'/other/fix': 'fix'}, ['std_msgs/msg/String', POINT]),
    ],
)
def test_a_wrong_topic_map_is_explained(mixed, topics, words):
    with BagReader(mixed) as bag, pytest.raises(BagError) as caught:
        list(measurements_of(bag, 'diver', topics))
    assert all(word in caught.value.sentence for word in words)


def test_when_nothing_fits_it_lists_what_is_there(tmp_path, fix_message):
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write('/pose', fix_message(5), 7)
        bag.write('/text', ros_message('std_msgs/msg/String'), 7)
    with BagWriter(tmp_path / 'none'):
        pass
    with BagReader(tmp_path / 'none') as bag, pytest.raises(BagError, match='is empty'):
        fitting_topics(bag, 'diver')
    with BagReader(tmp_path / 'bag') as bag, pytest.raises(BagError) as caught:
        fitting_topics(bag, 'diver')
    for words in ("'fix'", "'fixes'", "'arrivals'", '/text (std_msgs/msg/String)', '/pose as fix'):
        assert words in caught.value.sentence


def test_one_topic_with_two_types_is_rejected_message_by_message(tmp_path, fix_message):
    with BagWriter(tmp_path / 'bag') as bag:
        bag.write('/fix', fix_message(0), 1)
        bag.write('/fix', ros_message('std_msgs/msg/String'), 2)
    with BagReader(tmp_path / 'bag') as bag:
        received = [item.measurement for item in measurements_of(bag, 'diver')]
    assert isinstance(received[0], Fix) and received[1].reason == 'bad_type'
