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
from helpers.diver_runs import arrivals
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
from sonar_imm_tools.recordings import positions
from sonar_imm_tools.recordings.measurements import fitting_topics, measurements_of
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.positions import GAP_S
from sonar_imm_tools.recordings.reader import BagError, BagReader
from sonar_imm_tools.recordings.truth import records_of
from sonar_imm_tools.recordings.writer import BagWriter

START, SECOND = 1_700_000_000, 10**9
ORIGIN = Origin(59.0, 10.0)


@pytest.fixture
def recorded(tmp_path):
    """A bag of records, each with its log time and topic."""

    def write(*records, name='bag'):
        return marine.write_bag(tmp_path / name, [each for some in records for each in some])

    return write


def tracked(bag, topics=None, **parameters):
    """run.json and the estimates."""
    config, folder = DiverConfig.from_mapping(parameters), bag.parent / f'run_{bag.name}'
    with BagReader(bag) as reader:
        offline = OfflineRun(reader, SYSTEMS['diver'], config, InputOptions(topics=topics))
        run_folder = RunFolder(folder)
        with run_folder.fresh(overwrite=True) as unfinished:
            write_run(unfinished, offline)
    run = json.loads((folder / 'run.json').read_text())
    return run, run_folder.read_estimates()


def vessel(seconds):
    """The vessel drives east at 1 m/s, bow north."""
    stamp, half = round((START + seconds) * SECOND), np.sqrt(0.5)
    place = {'position': (seconds, 0.0, 0.0), 'orientation': (0.0, 0.0, half, half)}
    pose = VesselPose(stamp_ns=stamp, frame_id='odom', **place)
    return stamp, '/nav', write_navigation(pose, ros_message)


def sailing(last):
    return [vessel(k - 0.4) for k in range(1, last)]


def beacon(kind, seconds):
    """A diver at rest 20 m north and 10 m east of where the vessel began, 5 m deep."""
    ahead, starboard = 20.0, 10.0 - seconds
    distance = np.sqrt(ahead**2 + starboard**2 + 25.0)
    stamp = {'header__stamp__sec': START + seconds, 'header__frame_id': 'usbl'}
    if kind == BEACON:
        place = zip('xyz', (ahead, starboard, 5.0))
        at = {f'relative_position__{axis}': value for axis, value in place}
        return driver_message(kind, beacon_id=6, **stamp, **at)
    if kind == USBL:
        stamp['header__stamp__sec'] += 2
        enu = {f'enu__{axis}': value for axis, value in zip('xyz', (starboard, ahead, -5.0))}
        return driver_message(kind, remote_address=6, current_time=2.0, **stamp, **enu)
    return driver_message(
        kind, src_id=6, includes_range=True, includes_usbl=True, range_dist=round(10 * distance),
        usbl_azimuth=round(10 * np.degrees(np.arctan2(starboard, ahead))),
        usbl_elevation=round(-10 * np.degrees(np.arcsin(5.0 / distance))), **stamp,
    )  # fmt: skip


def beacons(kind, topic, last):
    return [((START + k) * SECOND, topic, beacon(kind, k)) for k in range(2, last)]


BEACON, MODEM = 'stonefish_ros2/msg/BeaconInfo', 'seatrac_interfaces/msg/ModemRec'
USBL = 'acomms_msgs/msg/UsblData'


@pytest.mark.parametrize('kind', [MODEM, USBL, BEACON])
def test_a_driver_without_its_package_is_tracked_from_the_vessel(recorded, kind):
    bag = recorded(sailing(22), beacons(kind, '/usbl/relative', 20))
    run, estimates = tracked(bag)
    assert run['topics'] == {'/nav': 'nav', '/usbl/relative': 'relative'}
    last = estimates[-1]
    assert last.frame_id == 'odom' and last.extras['target_id'].tolist() == [6]
    assert last.stamp_ns == (START + 19) * SECOND
    assert last.state[0, :2] == pytest.approx([10.0, 20.0], abs=0.3)
    with BagReader(bag) as reader:
        found = {item['name']: item['suits'] for item in inspect(reader)['topics']}
    assert found['/usbl/relative'] == ['diver relative'] and 'diver nav' in found['/nav']
    # On any topic it is suggested.
    with BagReader(recorded(beacons(kind, '/modem_rec', 5), name='alone')) as reader:
        found = inspect(reader)
    assert found['topics'][0]['suits'] == ['diver relative']
    assert found['systems']['diver'] == {'relative': ['/modem_rec']}


def geo(k, topic='/fix', status=0, x=None, frame_id='gps'):
    place = ORIGIN.geodetic(np.array([0.7 * k if x is None else x, 5.0, 0.0]))
    known = {'covariance': 0.04 * np.eye(3), 'frame_id': frame_id}
    stamp = (START + k) * SECOND
    fix = GeodeticFix(stamp_ns=stamp, latitude=place[0], longitude=place[1], **known)
    message = write_geodetic(fix, ros_message)
    message.status.status = status
    return stamp, topic, message


def test_navsatfix_is_tracked_and_what_says_nothing_is_named_and_counted(recorded):
    """Of every fifth second nothing, and in the eighth the place of the seventh again."""
    records = [geo(k, status=-(k % 5 == 0), x=0.7 * 7 if k == 8 else None) for k in range(1, 30)]
    run, estimates = tracked(recorded(records), origin=(59.0, 10.0, 0.0))
    refused = {reason: item['count'] for reason, item in run['refused'].items()}
    assert refused == {'no_fix': 5, 'repeated': 1} and run['counts']['refused'] == 6
    assert run['origin'] == {'latitude': 59.0, 'longitude': 10.0, 'height': 0.0}
    last = estimates[-1]
    assert last.state[0, :2] == pytest.approx([0.7 * 29, 5.0], abs=0.1)
    assert last.extras['latitude'] == pytest.approx([ORIGIN.geodetic(last.state[0, [0, 1, 2]])[0]])


def test_the_gps_of_a_vessel_is_not_taken_for_a_diver(recorded):
    def fix(k):
        known = {'covariance': 0.04 * np.eye(2), 'frame_id': 'map'}
        item = Fix(stamp_ns=(START + k) * SECOND, position=(0.5 * k, 0.1, 0.0), **known)
        return item.stamp_ns, '/usbl/fix', write_fix(item, ros_message)

    bag = recorded(map(fix, range(1, 10)), [geo(k, '/gps/fix') for k in range(1, 10)])
    run, estimates = tracked(bag)
    assert run['topics'] == {'/usbl/fix': 'fix'} and len(estimates[-1]) == 1
    assert run['problems'] == [
        'topic /gps/fix (sensor_msgs/msg/NavSatFix) is left out, because /usbl/fix says where '
        'divers are; choose it with --topic fix=/gps/fix'
    ]
    # Navigation without relative fixes is left alone.
    with BagReader(recorded(sailing(5), map(geo, range(1, 5)), name='other')) as reader:
        assert list(fitting_topics(reader, 'diver')) == ['/fix']


def test_tags_by_topic_and_frame_have_their_own_tracks(recorded):
    amy = [geo(k, '/amy/fix', x=0.3 * k) for k in range(1, 20)]
    bob = [geo(k, '/divers/fix', x=5.0 - 0.3 * k, frame_id='bob') for k in range(1, 20)]
    _, estimates = tracked(recorded(amy, bob), tags=('amy', 'bob'))
    last = estimates[-1]
    by_name = dict(zip(last.extras['target_id'].tolist(), last.state[:, 0]))
    assert by_name[1] - by_name[2] == pytest.approx(0.6 * 19 - 5.0, abs=0.2)


def test_sensors_by_topic_have_their_own_numbers(recorded):
    def scan(k, sensor):
        known = {'position': [[0.4 * k, 0.0, 0.0]], 'frame_id': 'map'}
        fixes = Fixes(stamp_ns=(START + k) * SECOND, **known)
        return fixes.stamp_ns, f'/{sensor}/fixes', write_scan(fixes, ros_message)

    spread, std = {}, {'radar.fix_std': 5.0, 'lidar.fix_std': 0.5}
    for sensor in ('radar', 'lidar'):
        bag = recorded([scan(k, sensor) for k in range(1, 15)], name=sensor)
        _, estimates = tracked(bag, **{'sensors': ['radar', 'lidar'], **std})
        spread[sensor] = estimates[-1].covariance[0, 0, 0]
    assert spread['radar'] > 4.0 * spread['lidar']


def test_metres_and_latitudes_without_an_origin_are_said(recorded):
    amy = [geo(k, '/amy/fix') for k in range(1, 8)]
    chosen = {'/nav': 'nav', '/relative': 'relative', '/amy/fix': 'fix'}
    run, _ = tracked(recorded(sailing(8), beacons(BEACON, '/relative', 6), amy), chosen)
    assert run['counts']['no_origin'] == 4
    assert 'parameter origin ' in run['warnings'][0]
    # The navigation comes along with a chosen topic.
    bag = recorded(sailing(8), beacons(BEACON, '/usbl_info', 6), name='chosen')
    run, estimates = tracked(bag, {'/usbl_info': 'relative'})
    assert run['topics'] == {'/usbl_info': 'relative', '/nav': 'nav'}
    assert estimates[-1].state[0, :2] == pytest.approx([10.0, 20.0], abs=0.3)


def at(seconds, longitude, latitude, when):
    """Longitude and latitude `when`, s after the start, by fixes at `seconds`."""
    stamps = (START + np.array(seconds)) * SECOND
    found = positions.Positions(stamps, np.array(longitude), np.array(latitude))
    return found.at(np.array([round((START + item) * SECOND) for item in when]))


def test_a_place_between_two_fixes_goes_the_short_way_over_the_date_line():
    east, north = at([0, 10], [179.9, -179.7], [1.0, 2.0], [0.0, 2.5, 5.0, 7.5, 10.0])
    assert east == pytest.approx([179.9, -180.0, -179.9, -179.8, -179.7])
    assert north == pytest.approx([1.0, 1.25, 1.5, 1.75, 2.0])
    east, _ = at([0, 10], [-0.1, 0.1], [1.0, 2.0], [5.0])  # and over Greenwich
    assert east == pytest.approx([0.0])
    # Far from all fixes there is no place.
    near, far = GAP_S - 0.5, GAP_S + 0.5
    when = [-far, -near, 0.0, near, far, 100.0 - near, 100.0, 100.0 + near, 100.0 + far]
    for column in at([0, 100], [10.0, 11.0], [59.0, 60.0], when):
        wanted = [True, False, False, False, True, False, False, False, True]
        assert np.isnan(column).tolist() == wanted


def test_only_fixes_of_a_receiver_that_has_one_are_places(recorded):
    records = []
    for k, status in enumerate((0, -1, 2, 0)):
        message = positions.write_position((START + k) * SECOND, 10.0 + k, 59.0)
        message.status.status = status
        records.append(((START + k) * SECOND, '/position', message))
    records[3][2].latitude = 91.0
    for k, (x, y) in enumerate(((1.0, 2.0), (3.0, math.nan), (math.nan, 4.0), (5.0, 6.0))):
        place = {'pose__pose__position__x': x, 'pose__pose__position__y': y}
        message = marine.put(ros_message('nav_msgs/msg/Odometry'), **place)
        message.header.stamp.sec = START + k
        records.append(((START + k) * SECOND, '/nav', message))
    with BagReader(recorded(records)) as reader:
        found = positions.read_positions(reader)
        by_nav = positions.read_navigated(reader, lambda places: (places[:, 0], places[:, 1]))
    assert found.stamp_ns.tolist() == [START * SECOND, (START + 2) * SECOND]
    assert found.longitude.tolist() == [10.0, 12.0]
    # A place of the navigation with one coordinate is none either.
    assert by_nav.stamp_ns.tolist() == [START * SECOND, (START + 3) * SECOND]
    assert (by_nav.longitude.tolist(), by_nav.latitude.tolist()) == ([1.0, 5.0], [2.0, 6.0])


# -- what a tracker hears of a recording


def ping():
    heard = arrivals(10**18, [[1.0, 0.0, 0.0]], [0.1], tx=[0.0, 0.0, 0.0], rx_id=[1])
    return write_arrivals(heard, ros_message)


@pytest.fixture
def mixed(tmp_path, fix_message):
    """A bag with inputs, a refused fix, truth, and things that are not for the tracker."""
    bad, zero = fix_message(2), fix_message(3)
    bad.pose.covariance[1], zero.pose.covariance[:] = 0.7, 0.0
    true = TrueTrack(1, np.array([5]), np.array([[1, 2]]), np.zeros((1, 2)))
    inputs = fix_message(0), fix_message(1, covariance=None), bad, zero
    records = [(k, '/usbl/fix', message) for k, message in enumerate(inputs, start=1)]
    records += [(5, '/arrivals', ping()), (6, '/truth/fix', fix_message(9))]
    records += [(7, '/pose', fix_message(5))]
    records += [(8, topic, message) for _, topic, message in records_of(true, 'm')]
    records += [(9, '/other/fix', ros_message('std_msgs/msg/String', data='no fix'))]
    with BagWriter(tmp_path / 'bag') as bag:
        for log_ns, topic, message in records:
            bag.write(topic, message, log_ns)
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


def test_a_topic_map_chooses_and_a_wrong_one_is_explained(mixed):
    with BagReader(mixed) as bag:
        received = list(measurements_of(bag, 'diver', {'/pose': 'fix'}, world_frame='ned'))
        assert len(received) == 1 and received[0].measurement.position.tolist() == [2.0, 5.0, 0.0]
        for topics, words in (
            ({'/pose': 'fixx'}, "no input 'fixx'.*'fix'"), ({'/posee': 'fix'}, "'/pose'"),
            ({'/other/fix': 'fix'}, 'std_msgs/msg/String.*geometry_msgs/msg/PointStamped'),
        ):  # fmt: skip
            with pytest.raises(BagError, match=words):
                list(measurements_of(bag, 'diver', topics))


def test_when_nothing_fits_it_lists_what_is_there(tmp_path, fix_message):
    text = ros_message('std_msgs/msg/String')
    with BagWriter(tmp_path / 'bag') as bag, BagWriter(tmp_path / 'none'):
        bag.write('/pose', fix_message(5), 7)
        bag.write('/text', text, 7)
    with BagReader(tmp_path / 'none') as bag, pytest.raises(BagError, match='is empty'):
        fitting_topics(bag, 'diver')
    with BagReader(tmp_path / 'bag') as bag, pytest.raises(BagError) as caught:
        fitting_topics(bag, 'diver')
    for words in ("'fix'", "'fixes'", "'arrivals'", '/text (std_msgs/msg/String)', '/pose as fix'):
        assert words in caught.value.sentence
    # One topic with two types is rejected message by message.
    with BagWriter(tmp_path / 'two') as bag:
        bag.write('/fix', fix_message(0), 1)
        bag.write('/fix', text, 2)
    with BagReader(tmp_path / 'two') as bag:
        received = [item.measurement for item in measurements_of(bag, 'diver')]
    assert isinstance(received[0], Fix) and received[1].reason == 'bad_type'
