# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What is said of a recording."""

from helpers.dive_bags import write_dive
from helpers.dive_scenes import SECOND, START_NS
import numpy as np
import pytest

from msg_adapters.arrivals import write_arrivals
from msg_adapters.detections import write_detections
from msg_adapters.fixes import write_fix
from msg_adapters.navigation import write_navigation
from sonar_imm.measurements import Arrivals, Detections, Fix, Navigation
from sonar_imm_tools.cli import main
from sonar_imm_tools.offline.inspection import inspect
from sonar_imm_tools.recordings.convert import convert_relative
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.writer import BagWriter, ros_message


def found(path):
    with BagReader(path) as bag:
        result = inspect(bag)
    return result, {topic['name']: topic for topic in result['topics']}


def write_fixes(path, seconds, frames=('map',)):
    with BagWriter(path) as bag:
        for k, second in enumerate(seconds):
            fix = Fix(stamp_ns=START_NS, position=[0, 0, 0], frame_id=frames[k % len(frames)])
            message = write_fix(fix, ros_message)
            stamp = 0 if second is None else START_NS + round(second * SECOND)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, SECOND)
            bag.write('/fix', message, START_NS + k * SECOND)
    return path


def test_a_good_recording_has_no_problems(tmp_path):
    result, topics = found(write_dive(tmp_path / 'dive'))
    assert result['systems'] == {'diver': {'fix': ['/fix']}}
    assert topics['/fix']['suits'] == ['diver fix']
    assert topics['/fix']['rate_hz'] == pytest.approx(1.0)
    assert topics['/fix']['problems'] == [] and topics['/truth/estimate']['problems'] == []
    assert topics['/truth/estimate']['suits'] == []
    assert result['duration_s'] == pytest.approx(119.5)


def test_a_topic_of_another_name_still_suits_and_refused_messages_are_told(tmp_path):
    dive = write_dive(tmp_path / 'dive', topic='/usbl/pose', truth=False, spoilt=(1, 2, 3))
    result, topics = found(dive)
    assert result['systems'] == {'diver': {'fix': ['/usbl/pose']}}
    (problem,) = topics['/usbl/pose']['problems']
    assert problem.startswith('3 messages refused as fix (nan): ')


@pytest.mark.parametrize(
    'seconds, words',
    [
        ([0, 1, 2, 1.5, 3], '1 stamps older than the one before, by up to 0.5 s'),
        ([0, 1, 2, 3, 40, 41], '1 gaps in the stamps, the longest 37 s against 1 s'),
        ([None, None, 1], '2 messages without a usable stamp'),
    ],
)
def test_odd_stamps_and_several_frames_are_told(tmp_path, seconds, words):
    _, topics = found(write_fixes(tmp_path / 'bag', seconds, frames=('map', 'odom')))
    assert any(words in problem for problem in topics['/fix']['problems'])
    assert "several frames: 'map', 'odom'" in topics['/fix']['problems']


def test_several_fixes_of_one_stamp_are_a_scan(tmp_path, capsys):
    _, topics = found(write_fixes(tmp_path / 'bag', [0, 1, 1, 1, 2, 2, 3]))
    assert topics['/fix']['problems'] == []
    assert topics['/fix']['scans'] == {'count': 4, 'most': 3}
    assert main(['info', str(tmp_path / 'bag')]) == 0
    assert '7 messages, 1 Hz, 4 scans, up to 3 per scan, frame map' in capsys.readouterr().out


def test_two_pings_of_one_stamp_are_a_problem(tmp_path):
    ping = Arrivals(
        stamp_ns=START_NS, frame_id='map', tx_id=[0, 0, 0], rx_id=[1, 2, 3], tx=np.zeros((3, 3)),
        rx=np.diag([40.0, 50.0, 60.0]), toa=[0.05, 0.06, 0.07], var_toa=np.full(3, np.nan),
        bearing=np.full(3, np.nan), var_bearing=np.full(3, np.nan),
    )  # fmt: skip
    with BagWriter(tmp_path / 'bag') as bag:
        for k in range(2):
            bag.write('/arrivals', write_arrivals(ping, ros_message), START_NS + k)
    _, topics = found(tmp_path / 'bag')
    assert topics['/arrivals']['problems'] == ['1 stamps equal to the one before']
    assert topics['/arrivals']['scans'] is None


def test_frames_of_relative_fixes_are_names_of_targets(tmp_path):
    table = tmp_path / 'usbl.csv'
    rows = ''.join(f'{k},1,2,90,10,2,{name}\n' for k in range(3) for name in ('amy', 'rov'))
    table.write_text('stamp,vessel_x,vessel_y,heading,forward,starboard,id\n' + rows)
    convert_relative(table, tmp_path / 'bag')
    _, topics = found(tmp_path / 'bag')
    assert topics['/relative']['frames'] == ['amy', 'rov']
    assert topics['/relative']['problems'] == []


def test_navigation_in_ned_is_an_input_that_needs_a_parameter(tmp_path, capsys):
    with BagWriter(tmp_path / 'bag') as bag:
        for k in range(3):
            stamp_ns = START_NS + k * 10**9
            ping = Detections(stamp_ns=stamp_ns, frame_id='sonar', range=[20.0], bearing=[0.1])
            pose = Navigation(
                stamp_ns=stamp_ns, position=[k, 0, 5], orientation=[0, 0, 0, 1],
                frame_id='odom_ned',
            )  # fmt: skip
            bag.write('/detections', write_detections(ping, ros_message), stamp_ns)
            bag.write('/odometry', write_navigation(pose, ros_message), stamp_ns)
    assert main(['info', str(tmp_path / 'bag')]) == 0
    assert '--system obstacle --set world_frame_convention=ned' in capsys.readouterr().out


def test_what_no_tracker_knows_suits_nothing_and_an_empty_recording_is_no_trouble(tmp_path):
    with BagWriter(tmp_path / 'bag') as bag, BagWriter(tmp_path / 'none'):
        bag.write('/note', ros_message('std_msgs/msg/String', data='hello'), START_NS)
    result, topics = found(tmp_path / 'bag')
    assert result['systems'] == {} and topics['/note']['problems'] == []
    result, _ = found(tmp_path / 'none')
    assert result['messages'] == 0 and result['duration_s'] == 0.0


def test_a_companion_counts_by_its_name_and_not_alone(tmp_path):
    alone, topics = found(write_dive(tmp_path / 'alone', topic='/array_depth', truth=False))
    assert 'fathometer array_depth' in topics['/array_depth']['suits']
    assert 'fathometer' not in alone['systems']


def fixes_by_hint(tmp_path, seed, divers, *, speed=0.5, together=False, clutter=0.0):
    """What is said of fixes of divers 20 m apart, polled within 2 s, or of all at one stamp."""
    rng = np.random.default_rng(seed)
    with BagWriter(tmp_path / 'bag') as bag:
        for turn in range(60):
            phases = np.zeros(divers) if together else (np.arange(divers) + 0.5) / divers
            for diver, phase in enumerate(phases):
                if rng.uniform() > 0.9:
                    continue
                when = 2.0 * (turn + phase) + (0.0 if together else 0.02 * rng.normal())
                place = [speed * when, 20.0 * diver, 0.0] + 0.3 * rng.normal(size=3)
                if rng.uniform() < clutter:
                    place = rng.uniform(-100.0, 100.0, 3)
                stamp = START_NS + round(when * SECOND)
                fix = Fix(stamp_ns=stamp, position=place, frame_id='map')
                bag.write('/fix', write_fix(fix, ros_message), stamp)
    _, topics = found(tmp_path / 'bag')
    return [text for text in topics['/fix']['problems'] if 'scan_period' in text]


@pytest.mark.parametrize('divers, clutter', [(2, 0.15), (3, 0.0), (7, 0.15)])
def test_fixes_that_are_stamped_one_by_one_are_hinted_at(tmp_path, divers, clutter):
    (hint,) = fixes_by_hint(tmp_path, divers, divers, clutter=clutter)
    assert 1.9 < float(hint.partition('scan_period=')[2].split()[0]) < 2.1


@pytest.mark.parametrize('seed, speed', [(0, 0.0), (1, 0.5)])
@pytest.mark.parametrize('divers, together', [(1, False), (3, True)])
def test_one_diver_and_whole_scans_need_no_hint(tmp_path, seed, speed, divers, together):
    assert fixes_by_hint(tmp_path, seed, divers, speed=speed, together=together) == []
