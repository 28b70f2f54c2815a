# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A publisher in NED and FRD, and one in ENU and FLU, get the same answer: in ENU."""

from pathlib import Path

from attrs import evolve
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from msg_adapters.inputs import inputs_of
from sonar_imm.measurements import Detections, Navigation
from sonar_imm_tools.cli import main
from sonar_imm_tools.recordings.measurements import measurements_of
from sonar_imm_tools.recordings.messages import ros_message
from sonar_imm_tools.recordings.reader import BagReader
from sonar_imm_tools.recordings.topics import fitting_topics
from sonar_imm_tools.recordings.writer import BagWriter

BAG = Path(__file__).resolve().parents[2] / 'bags' / 'obstacle_tethers'
TO_NED, TO_FRD = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]]), np.diag([1, -1, -1])


def other_way(measurement):
    """As a vehicle in NED and FRD and a sonar that counts to starboard would state it."""
    if isinstance(measurement, Detections):
        return evolve(measurement, bearing=-measurement.bearing)
    if isinstance(measurement, Navigation):
        R = TO_NED @ Rotation.from_quat(measurement.orientation).as_matrix() @ TO_FRD
        return evolve(
            measurement,
            frame_id=measurement.frame_id + '_ned',
            position=TO_NED @ measurement.position,
            orientation=Rotation.from_matrix(R).as_quat(),
            pose_covariance=None,
            twist_covariance=None,
        )
    return measurement


@pytest.fixture
def ned_bag(tmp_path):
    write = {entry.measurement: (entry.name, entry.write) for entry in inputs_of('obstacle')}
    with BagReader(BAG) as bag, BagWriter(tmp_path / 'ned') as out:
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
    assert main(['track', str(BAG), str(tmp_path / 'enu_run'), '--order', 'stamp']) == 0
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


def test_the_only_odometry_beside_detections_is_found_by_its_type(tmp_path):
    with BagReader(BAG) as bag, BagWriter(tmp_path / 'odom') as out:
        for name, message, stamp_ns in records(bag):
            out.write('/odom' if name == '/nav' else name, message, stamp_ns)
    with BagReader(tmp_path / 'odom') as bag:
        names = {name: entry.name for name, entry in fitting_topics(bag, 'obstacle').items()}
    assert names['/odom'] == 'nav' and names['/detections'] == 'detections'


def test_one_of_two_odometries_is_not_guessed(tmp_path):
    with BagReader(BAG) as bag, BagWriter(tmp_path / 'odom') as out:
        for name, message, stamp_ns in records(bag):
            for topic in ('/odom', '/odom_raw') if name == '/nav' else (name,):
                out.write(topic, message, stamp_ns)
    with BagReader(tmp_path / 'odom') as bag:
        assert 'nav' not in {entry.name for entry in fitting_topics(bag, 'obstacle').values()}


def records(bag):
    """The first messages of the detections and the navigation of a bag, as they are."""
    write = {entry.measurement: entry.write for entry in inputs_of('obstacle')}
    topics = {name: entry.name for name, entry in fitting_topics(bag, 'obstacle').items()}
    for received, _ in zip(measurements_of(bag, 'obstacle', topics), range(40)):
        name = '/' + topics[received.topic]
        message = write[type(received.measurement)](received.measurement, ros_message)
        yield name, message, received.measurement.stamp_ns
