# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Targets over UDP: what arrives on a socket is decoded by another library."""

import socket
import sys

import numpy as np
import pytest
from rclpy.parameter import Parameter

from msg_adapters.fixes import write_geodetic
from sonar_imm.acoustics.geodesy import Origin
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import GeodeticFix
from sonar_imm.nodes import tracks
from sonar_imm.nodes.diver import DiverNode
from sonar_imm.nodes.messages import make, message_class
from sonar_imm.nodes.obstacle import ObstacleNode
from sonar_imm.nodes.qos import lockstep_qos
from sonar_imm.nodes.tracks import Targets
from sonar_imm.parameters import ConfigError

pyais = pytest.importorskip('pyais')
pynmea2 = pytest.importorskip('pynmea2')

SECOND = 10**9
START = 1_700_000_000 * SECOND
"""22:13:20 UTC."""


@pytest.fixture
def plotter():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listening:
        listening.bind(('127.0.0.1', 0))
        listening.settimeout(5.0)
        yield listening


def address(listening):
    return f'127.0.0.1:{listening.getsockname()[1]}'


def parsed(sentence):
    if sentence.startswith('!'):
        return pyais.decode(sentence, error_if_checksum_invalid=True)
    return pynmea2.parse(sentence, check=True)


def sentences(listening):
    """All sentences that have arrived, parsed, their sums checked."""
    found = []
    listening.setblocking(False)
    while True:
        try:
            datagram = listening.recv(2048)
        except BlockingIOError:
            return found
        assert datagram.endswith(b'\r\n') and len(datagram) <= 82
        found.append(parsed(datagram.decode('ascii').strip()))


def divers(ids=(3,), states=(1,), x=100.0, y=-50.0):
    rows = len(ids)
    return Estimate(
        stamp_ns=START,
        frame_id='map',
        xyz=np.tile([x, y, -8.0], (rows, 1)),
        state_names=('px', 'py', 'vx', 'vy'),
        state=np.tile([x, y, 0.5, 0.0], (rows, 1)),
        covariance=np.tile(np.eye(4), (rows, 1, 1)),
        model_names=('heading_000',),
        probabilities=np.ones((rows, 1)),
        extras={'track_id': np.array(ids), 'track_state': np.array(states)},
    )


def obstacles(bearing, velocity=(1.0, 0.0), offset=3.0):
    return Estimate(
        stamp_ns=START,
        frame_id='map',
        xyz=np.array([[30.0, 40.0, -8.0]]),
        state_names=('range', 'bearing', 'vertical_offset'),
        state=np.array([[5.0, bearing, offset]]),
        covariance=np.eye(3)[np.newaxis],
        model_names=('above', 'below'),
        probabilities=np.array([[0.25, 0.75]]),
        extras={
            'track_id': np.array([112]),
            'track_state': np.array([1]),
            'px': np.array([30.0]),
            'py': np.array([40.0]),
            'pz': np.array([-8.0]),
            'vx': np.array([velocity[0]]),
            'vy': np.array([velocity[1]]),
            'cpa_distance': np.array([185.2]),
            'cpa_time': np.array([90.0]),
        },
    )


def targets(listening, form='tll', period=0.1, warnings=None):
    warn = [].append if warnings is None else warnings.append
    return Targets(address(listening), form, period, 'DIVER', warn)


PLACES = [(54.25, 10.5), (-33.9999999, -151.25), (0.01, 179.9999999)]


@pytest.mark.parametrize(('latitude', 'longitude'), PLACES)
def test_latitude_and_longitude_arrive(plotter, latitude, longitude):
    origin = Origin(latitude, longitude)
    targets(plotter).send(divers(states=(2,)), origin)
    (sentence,) = sentences(plotter)
    expected = origin.geodetic(np.array([100.0, -50.0, -8.0]))
    assert sentence.sentence_type == 'TLL'
    assert sentence.latitude == pytest.approx(expected[0], abs=2e-7)
    assert sentence.longitude == pytest.approx(expected[1], abs=2e-7)
    assert (sentence.target_number, sentence.target_name) == (3, 'DIVER3')
    assert sentence.data[-3:] == ['221320.00', 'T', '']


def test_distance_and_bearing_are_over_ground_and_clockwise(plotter):
    """Ten degrees to port is 350 clockwise from the bow; 5 m away and 3 m below is 4 m over
    ground."""
    targets(plotter, 'ttm').send(obstacles(np.radians(10.0), (0.0, -2.0)), None)
    (sentence,) = sentences(plotter)
    assert sentence.sentence_type == 'TTM'
    assert float(sentence.distance) * 1852.0 == pytest.approx(4.0, abs=0.1)
    assert sentence.data[2:10] == ['350.0', 'R', '3.9', '180.0', 'T', '0.1000', '1.5', 'N']
    assert (sentence.target_number, sentence.name) == (12, 'DIVER112')
    assert sentence.data[11] == 'T'


def test_what_is_not_known_stays_empty(plotter):
    unknown = obstacles(0.0, (np.nan, np.nan), np.nan)
    targets(plotter, 'ttm').send(unknown, None)
    (sentence,) = sentences(plotter)
    assert sentence.data[4:6] == ['', '']
    assert float(sentence.distance) * 1852.0 == pytest.approx(5.0, abs=0.1)


@pytest.mark.parametrize(('latitude', 'longitude'), PLACES)
def test_a_diver_is_a_virtual_special_mark_of_ais(plotter, latitude, longitude):
    """Of which AIS knows a ten thousandth of a minute, and that it is better than 10 m."""
    origin = Origin(latitude, longitude)
    targets(plotter, 'ais').send(divers(), origin)
    (message,) = sentences(plotter)
    expected = origin.geodetic(np.array([100.0, -50.0, -8.0]))
    assert (message.msg_type, message.virtual_aid, message.accuracy) == (21, True, True)
    assert message.lat == pytest.approx(expected[0], abs=1.5e-6)
    assert message.lon == pytest.approx(expected[1], abs=1.5e-6)
    assert (message.name, message.second) == ('DIVER3', 20)
    assert message.aid_type == pyais.constants.NavAid.SPECIAL_MARK


def test_an_obstacle_is_an_isolated_danger_with_an_identity_of_its_own(plotter):
    """The same number of another node, and a place that is not better than 10 m."""
    uncertain = obstacles(0.0)
    for axis, variance in {'xx': 40.0, 'yy': 1.0, 'zz': 1.0, 'xy': 0.0}.items():
        uncertain.extras[f'place_cov_{axis}'] = np.array([variance])
    names = 'obstacle_node', 'port/obstacle_node'
    for name in names:
        Targets(address(plotter), 'ais', 1.0, 'OBSTACLE', print, name).send(
            uncertain, Origin(54.0, 10.0)
        )
    found = sentences(plotter)
    assert {m.aid_type for m in found} == {pyais.constants.NavAid.ISOLATED_DANGER}
    assert {(m.name, m.accuracy) for m in found} == {('OBSTACLE112', False)}
    identities = [f'{m.mmsi:09d}' for m in found]
    assert len({*identities}) == 2
    assert all(i[:2] == '99' and i[2:5] < '200' and i[5:] == '6112' for i in identities)


def test_ais_falls_silent_about_a_track_that_is_over(plotter):
    sender = targets(plotter, 'ais', period=0.0)
    for ids in ((3, 4), (4,), ()):
        sender.send(divers(ids, (1,) * len(ids)), Origin(54.0, 10.0))
    sender.close()
    assert [m.name for m in sentences(plotter)] == ['DIVER3', 'DIVER4', 'DIVER4']


def test_ais_without_its_library_is_a_sentence(make_bench, monkeypatch):
    monkeypatch.setitem(sys.modules, 'pyais', None)
    bench = make_bench('-p', 'targets_to:=127.0.0.1:10110', '-p', 'targets_as:=ais')
    with pytest.raises(ConfigError, match=r"'targets_as': ais needs pyais: pip install '.*nmea"):
        DiverNode(context=bench.context)


def test_a_track_that_is_over_is_sent_once_as_lost(plotter, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(tracks.time, 'monotonic', lambda: now[0])
    sender = targets(plotter, period=1.0)
    origin = Origin(54.0, 10.0)
    for ids in ((3, 4), (4,), (4,), ()):
        sender.send(divers(ids, (1,) * len(ids)), origin)
        now[0] += 1.0
    found = [(s.target_name, s.data[-2]) for s in sentences(plotter)]
    assert found == [
        *[('DIVER3', 'T'), ('DIVER4', 'T')],
        *[('DIVER4', 'T'), ('DIVER3', 'L')],
        ('DIVER4', 'T'),
        ('DIVER4', 'L'),
    ]


def test_rounds_keep_their_distance_and_tentative_tracks_stay_at_home(plotter, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(tracks.time, 'monotonic', lambda: now[0])
    sender = targets(plotter, period=1.0)
    for _ in range(40):  # 4 s at 10 Hz
        sender.send(divers((1, 2), (0, 1)), Origin(54.0, 10.0))
        now[0] += 0.1
    assert [s.target_name for s in sentences(plotter)] == ['DIVER2'] * 4


def test_all_are_lost_when_the_tracker_starts_afresh(plotter):
    sender = targets(plotter)
    sender.send(divers(), Origin(54.0, 10.0))
    sender.forget()
    sender.close()
    assert [s.data[-2] for s in sentences(plotter)] == ['T', 'L']


@pytest.mark.parametrize('form', ['tll', 'ais'])
def test_without_an_origin_nothing_is_sent(plotter, form):
    targets(plotter, form).send(divers(), None)
    assert sentences(plotter) == []


def test_who_does_not_listen_is_said_once_and_found_when_he_comes():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listening:
        listening.bind(('127.0.0.1', 0))
        where = listening.getsockname()
    warnings = []
    sender = Targets(f'127.0.0.1:{where[1]}', 'tll', 0.0, 'DIVER', warnings.append)
    origin = Origin(54.0, 10.0)
    for _ in range(5):
        sender.send(divers((1, 2), (1, 1)), origin)
    assert len(warnings) == 1 and 'refused' in warnings[0] and '\n' not in warnings[0]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as listening:
        listening.bind(where)
        sender.send(divers(), origin)
        sender.send(divers(), origin)
        assert 'DIVER3' in {s.target_name for s in sentences(listening)}
    assert not sender.trouble
    sender.close()


@pytest.mark.parametrize('wrong', ['plotter:10110', '10.0.0.1', '10.0.0.1:0', '1.2.3.4:99999'])
def test_an_address_that_is_none_is_a_sentence(make_bench, wrong):
    bench = make_bench('-p', f'targets_to:={wrong}')
    with pytest.raises(ConfigError, match=r"'targets_to' must be the address .* in numbers"):
        DiverNode(context=bench.context)


@pytest.mark.parametrize('form', ['tll', 'ais'])
def test_latitudes_of_obstacles_need_an_origin(make_bench, form):
    bench = make_bench('-p', 'targets_to:=127.0.0.1:10110', '-p', f'targets_as:={form}')
    with pytest.raises(ConfigError, match=f"'targets_as' {form} needs origin_latitude"):
        ObstacleNode(context=bench.context)


def test_a_node_sends_its_divers_to_a_plotter(make_bench, plotter):
    """Fixes in latitude and longitude go in as messages, positions come out of the socket; with
    the end of the node they are lost."""
    type_name = 'sensor_msgs/msg/NavSatFix'
    settings = {
        'targets_to': address(plotter),
        'targets_period': 0.1,
        'fix_type': type_name,
        'origin_latitude': 54.3,
        'origin_longitude': 10.2,
    }
    bench = make_bench()
    overrides = [Parameter(name, value=value) for name, value in settings.items()]
    node = bench.add(DiverNode(context=bench.context, parameter_overrides=overrides))
    publisher = bench.peer.create_publisher(message_class(type_name), '/fix', lockstep_qos())
    bench.spin_until(lambda: publisher.get_subscription_count())
    origin, found = Origin(54.3, 10.2), []
    for step in range(1000):
        place = origin.geodetic(np.array([20.0 + 0.5 * step, 10.0, -5.0]))
        fix = GeodeticFix(
            stamp_ns=START + step * SECOND,
            latitude=place[0],
            longitude=place[1],
            height=place[2],
            covariance=np.eye(3),
            frame_id='gps',
        )
        publisher.publish(write_geodetic(fix, make))
        bench.spin_until(lambda step=step: node.answer()['messages'] > step)
        found += sentences(plotter)
        # Many fixes come in a period: what is there was sent when the diver was further back.
        if step >= 29 and found:
            east, north, _ = origin.local(found[-1].latitude, found[-1].longitude)
            if abs(east - (20.0 + 0.5 * step)) < 6.0 and abs(north - 10.0) < 6.0:
                break
    else:
        pytest.fail(f'{len(found)} targets, none of them where the diver was')
    assert not node.work_report()['warnings']
    node.release()
    assert [s.data[-2] for s in sentences(plotter)][-1:] == ['L']


def test_a_type_that_is_not_installed_is_a_sentence(make_bench):
    name = 'marine_interfaces/msg/Contact'
    try:
        message_class(name)
    except ImportError:
        bench = make_bench('-p', f'also_publish:=[{name}]')
        with pytest.raises(ConfigError, match=f"^parameter 'also_publish': .*{name} is not"):
            DiverNode(context=bench.context)
