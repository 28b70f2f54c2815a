# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Estimates, soundings and displays as messages; stamps, frames; both libraries of messages."""

from array import array
from importlib import import_module
import math
from types import SimpleNamespace

from attrs import asdict, evolve
from helpers.estimates import same
from helpers.marine import sent
from helpers.refusals import reason
import numpy as np
import pytest

from msg_adapters import estimates as adapters
from msg_adapters.arrivals import read_arrivals, write_arrivals
from msg_adapters.displays import displays_of
from msg_adapters.displays.diver import NAMES, write_markers, write_poses
from msg_adapters.estimates import read_estimate, write_estimate
from msg_adapters.fixes import read_fix, write_fix
from msg_adapters.headers import make_header, stamp_ns, to_enu
from msg_adapters.soundings import read_soundings, write_soundings
from msg_adapters.table import encode_table
from sonar_imm.estimates import Estimate, PLACES
from sonar_imm.measurements import Arrivals, Fix, Rejection
from sonar_imm.soundings import COLUMNS, LATER, Soundings
from sonar_imm_tools.recordings.messages import cdr_of, decode_cdr, ros_message, typestore

S = 10**9
STATES = ('px', 'py', 'vx', 'vy')


def estimate(rows=2, names=STATES, **extras):
    rng = np.random.default_rng(1)
    root = rng.standard_normal((rows, len(names), len(names)))
    probabilities = rng.random((rows, 3))
    state = rng.standard_normal((rows, len(names))) * 1e5
    usual = {'track_id': np.arange(7, 7 + rows, dtype=np.uint32)}
    usual |= {'track_state': np.ones(rows, np.uint8), 'nis': np.full(rows, np.nan)}
    return Estimate(
        stamp_ns=1700000000123456789, frame_id='map', state_names=names, state=state,
        xyz=np.column_stack([state[:, :2], np.full(rows, -4.0)]).astype(np.float32),
        covariance=root @ root.transpose(0, 2, 1),
        model_names=('heading_000', 'heading_022', 'hover'),
        probabilities=probabilities / probabilities.sum(axis=1, keepdims=True),
        extras=usual | extras,
    )  # fmt: skip


def table(columns, stamp_ns=1):
    return encode_table(columns, stamp_ns=stamp_ns, frame_id='map', make=ros_message)


@pytest.mark.parametrize('rows', [0, 1, 5])
def test_an_estimate_reads_back_bit_for_bit(rows):
    first = estimate(rows)
    again = read_estimate(sent(write_estimate(first, ros_message)))
    assert same(again, first)
    assert again.state_names == STATES and again.model_names == first.model_names


@pytest.mark.parametrize('rows, nan', [(0, True), (1, True), (3, False), (40, False), (40, True)])
def test_an_estimate_is_packed_as_the_table_of_its_columns(rows, nan):
    """Its numbers go in as one block; `encode_table` takes column by column."""
    outline = np.arange(3.0 * rows, dtype=np.float32).reshape(rows, 3)
    more = {'nis': np.full(rows, np.nan if nan else 1.0), 'valid': np.ones(rows, bool)}
    item = estimate(rows, **more, outline=outline)
    expected = table(item.columns(), item.stamp_ns)
    message = write_estimate(item, ros_message)
    assert bytes(message.data) == bytes(expected.data) and message.fields == expected.fields
    assert message.is_dense is expected.is_dense is (not nan or not rows)
    assert (message.width, message.point_step) == (expected.width, expected.point_step)


def test_the_columns_are_those_of_the_contract():
    message = write_estimate(estimate(), ros_message)
    assert [field.name for field in message.fields] == [
        'x', 'y', 'z', 'px', 'py', 'vx', 'vy', 'cov_px_px', 'cov_px_py', 'cov_px_vx', 'cov_px_vy',
        'cov_py_py', 'cov_py_vx', 'cov_py_vy', 'cov_vx_vx', 'cov_vx_vy', 'cov_vy_vy',
        'prob_heading_000', 'prob_heading_022', 'prob_hover', 'track_id', 'track_state', 'nis',
    ]  # fmt: skip
    assert [field.datatype for field in message.fields] == [7] * 3 + [8] * 17 + [6, 2, 8]
    for gone in ('x', 'cov_px_vy', 'px'):
        columns = estimate().columns()
        del columns[gone]
        with pytest.raises(Rejection, match=gone) as caught:
            read_estimate(table(columns))
        assert caught.value.reason == 'missing_column'


def test_odometry_shows_one_diver_with_velocity_in_the_world():
    first = estimate()
    message = sent(adapters.write_odometry(first, 1, ros_message))
    assert message.child_frame_id == 'diver_8' and message.header.frame_id == 'map'
    place, speed = message.pose.pose.position, message.twist.twist.linear
    assert [place.x, place.y, speed.x, speed.y] == first.state[1].tolist() and place.z == -4.0
    quaternion = message.pose.pose.orientation
    assert (quaternion.x, quaternion.y, quaternion.z, quaternion.w) == (0.0, 0.0, 0.0, 1.0)
    for got, of in ((message.pose, slice(2)), (message.twist, slice(2, 4))):
        wanted = np.diag([0.0, 0.0, 1.0, 1e-9, 1e-9, 1e-9])
        wanted[:2, :2] = first.covariance[1, of, of]
        assert (got.covariance.reshape(6, 6) == wanted).all()
    # Where the depth is a state, it is shown too.
    deep = estimate(1, ('px', 'py', 'pz', 'vx', 'vy', 'vz'))
    message = sent(adapters.write_odometry(deep, 0, ros_message))
    place, speed = message.pose.pose.position, message.twist.twist.linear
    assert [place.x, place.y, place.z, speed.x, speed.y, speed.z] == deep.state[0].tolist()
    for got, of in ((message.pose, slice(3)), (message.twist, slice(3, 6))):
        assert (got.covariance.reshape(6, 6)[:3, :3] == deep.covariance[0, of, of]).all()
    # Probabilities of models are named scalars.
    message = sent(adapters.write_model_probabilities(first, 0, ros_message))
    assert message.name == list(first.model_names)
    assert message.position.tolist() == first.probabilities[0].tolist()
    assert len(message.velocity) == len(message.effort) == 0


# -- soundings --


def soundings(n=4):
    rng = np.random.default_rng(1)
    columns = {name: (10 * rng.random(n)).astype(kind) for name, kind in COLUMNS.items()}
    return Soundings(1_700_000_000_000_000_001, 'map', columns)


@pytest.mark.parametrize('n', [0, 4])
def test_what_is_written_reads_back_bit_for_bit(n):
    points = soundings(n)
    again = read_soundings(write_soundings(points, ros_message))
    assert (again.stamp_ns, again.frame_id) == (points.stamp_ns, points.frame_id)
    for name, column in points.columns.items():
        assert (again.columns[name] == column).all() and again.columns[name].dtype == column.dtype


def test_the_layout_is_what_cube_expects():
    """The CUBE node walks through the fields as four-byte floats, x y z first, nothing NaN."""
    message = write_soundings(soundings(), ros_message)
    of_cube = ['vertical_uncertainty', 'horizontal_uncertainty', 'intensity', 'beam_angle']
    assert [field.name for field in message.fields[:7]] == ['x', 'y', 'z', *of_cube]
    assert all(field.datatype == 7 and field.count == 1 for field in message.fields[:7])
    assert [field.offset for field in message.fields[:7]] == [0, 4, 8, 12, 16, 20, 24]
    assert message.is_dense and message.height == 1


def test_the_topic_reads_back_with_the_reader_of_ros():
    point_cloud2 = pytest.importorskip('sensor_msgs_py.point_cloud2')
    messages = pytest.importorskip('sonar_imm.nodes.messages')
    points = soundings()
    found = point_cloud2.read_points(write_soundings(points, messages.make), skip_nans=True)
    for name, column in points.columns.items():
        assert (found[name] == column).all()


def test_older_soundings_without_exact_places_and_surfaces_are_read_and_no_other_tables():
    columns = soundings().columns
    older = {name: column for name, column in columns.items() if name not in (*PLACES, *LATER)}
    again = read_soundings(table(older)).columns
    assert list(again) == list(COLUMNS) and again['py'].dtype == np.float64
    assert (again['py'] == columns['y']).all()
    assert (again['surface'] == 1).all() and (again['existence'] == 0.0).all()
    assert reason(read_soundings, table({**columns, 'z': np.zeros(4)}))
    del older['vertical_uncertainty']
    assert reason(read_soundings, table(older))


# -- Displays of several divers at once: poses, and markers that end when their track does --


ADD, DELETE, DELETE_ALL = 0, 2, 3


def an_estimate(ids, states=None, covariance=((4.0, 0.0), (0.0, 1.0))):
    rows, whole = len(ids), np.diag([4.0, 1.0, 0.1, 0.1])
    state = np.array([[10.0 * i, -5.0, 0.6, 0.8] for i in ids]).reshape(rows, 4)
    whole[:2, :2] = covariance
    extras = {'track_id': np.array(ids, np.uint32)}
    extras['track_state'] = np.array(states or [1] * rows, np.uint8)
    return evolve(
        estimate(rows), stamp_ns=5 * 10**9, state=state, covariance=np.tile(whole, (rows, 1, 1)),
        xyz=np.column_stack([state[:, :2], np.full(rows, -4.0)]).astype(np.float32), extras=extras,
    )  # fmt: skip


def test_all_divers_are_in_one_message_each_turned_to_where_he_swims():
    message = write_poses(an_estimate([3, 7]), [0, 1], ros_message)
    assert message.header.frame_id == 'map' and message.header.stamp.sec == 5
    assert [pose.position.x for pose in message.poses] == [30.0, 70.0]
    q = message.poses[0].orientation
    assert 2.0 * math.atan2(q.z, q.w) == pytest.approx(math.atan2(0.8, 0.6))


def test_the_ellipse_holds_nine_of_ten_samples_and_lies_along_the_covariance():
    turn = np.array([[math.cos(0.5), -math.sin(0.5)], [math.sin(0.5), math.cos(0.5)]])
    covariance = turn @ np.diag([9.0, 0.25]) @ turn.T
    seen = an_estimate([3], covariance=covariance)
    place, course, label = write_markers(seen, [0], ros_message).markers
    half = 2.0 * math.atan2(place.pose.orientation.z, place.pose.orientation.w)
    assert math.cos(half - 0.5) ** 2 == pytest.approx(1.0)
    samples = np.random.default_rng(1).multivariate_normal([0.0, 0.0], covariance, 20000)
    long, wide = (samples @ turn).T
    inside = (2.0 * long / place.scale.x) ** 2 + (2.0 * wide / place.scale.y) ** 2 <= 1.0
    assert inside.mean() == pytest.approx(0.9, abs=0.01)
    assert [(end.x, end.y) for end in course.points] == [(30.0, -5.0), (33.0, -1.0)]
    assert label.text == '3: 1.0 m/s' and label.pose.position.z == -3.0
    assert {item.id for item in (place, course, label)} == {3}
    # One that coasts is grey and says so.
    lost = write_markers(an_estimate([3], [2]), [0], ros_message).markers
    assert place.color != lost[0].color and lost[2].text.endswith('not seen')


def drawn(displays, estimate):
    return [
        [(marker.ns, marker.id, marker.action) for marker in message.markers]
        for name, message in displays.of(estimate, ros_message, lambda name: name == 'markers')
    ]


def test_markers_of_a_track_that_is_over_are_deleted_at_once():
    displays = displays_of('diver')
    assert drawn(displays, an_estimate([1, 2], [0, 1])) == [[(n, 2, ADD) for n in NAMES]]
    both = drawn(displays, an_estimate([1, 2]))
    assert both == [[(n, i, ADD) for i in (1, 2) for n in NAMES]]
    ended, left = drawn(displays, an_estimate([1]))
    assert ended == [(n, 2, DELETE) for n in NAMES] and left == [(n, 1, ADD) for n in NAMES]
    assert drawn(displays, an_estimate([])) == [[(n, 1, DELETE) for n in NAMES]]
    assert drawn(displays, an_estimate([])) == []
    ((name, message),) = displays.forget(ros_message)
    assert name == 'markers' and [marker.action for marker in message.markers] == [DELETE_ALL]


# -- stamps and frames


def fix(frame_id='map'):
    covariance = [[4.0, 0.5], [0.5, 9.0]]
    known = {'position': (1.0, 2.0, 3.0), 'frame_id': frame_id, 'covariance': covariance}
    return Fix(stamp_ns=1700000000123456789, **known)


def arrivals(**changes):
    usual = {
        'stamp_ns': 10**18, 'tx_id': [1, 1], 'rx_id': [2, 3], 'tx': [[1.0, 2.0, 3.0]] * 2,
        'rx': [[4.0, 5.0, 6.0]] * 2, 'toa': [0.1, 1 / 3], 'var_toa': np.float32([1e-6, np.nan]),
        'bearing': [0.25, -0.4], 'var_bearing': np.float32([0.01, 0.02]), 'frame_id': 'map',
    }  # fmt: skip
    return Arrivals(**{**usual, **changes})


def test_stamps_round_trip_exactly_and_one_that_a_header_cannot_hold_is_none():
    for stamp in (0, 7, 1_000_000_007, 2**31 * S - 1, 1700000000123456789, -1, -(2**31) * S):
        header = make_header(stamp, 'map', ros_message)
        assert stamp_ns(SimpleNamespace(header=header)) == stamp
    for beyond in (2**31 * S, -(2**31) * S - 1):
        with pytest.raises(ValueError, match='cannot hold'):
            make_header(beyond, 'map', ros_message)
    message = SimpleNamespace(header=SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=S)))
    assert reason(stamp_ns, message) == 'bad_stamp'


def as_read(measurement, world_frame):
    """The measurement sent as a message and read again by a reader that is told `world_frame`."""
    of_fix = isinstance(measurement, Fix)
    write, read = (write_fix, read_fix) if of_fix else (write_arrivals, read_arrivals)
    return read(write(measurement, ros_message), world_frame=world_frame)


def test_a_measurement_turns_from_ned_to_enu():
    turned = as_read(fix('map_ned'), 'ned')
    assert turned.position.tolist() == [2.0, 1.0, -3.0] and turned.frame_id == 'map'
    assert turned.covariance[:2, :2].tolist() == [[9.0, 0.5], [0.5, 4.0]]
    for bearing in (-3.0, 0.25, 1.0, 3.1):
        north, east = np.cos(bearing), np.sin(bearing)
        turned = as_read(arrivals(bearing=[bearing] * 2, frame_id='map_ned'), 'ned')
        assert np.cos(turned.bearing[0]) == pytest.approx(east)
        assert np.sin(turned.bearing[0]) == pytest.approx(north)
    assert turned.tx[0].tolist() == [2.0, 1.0, -3.0] and turned.rx[0].tolist() == [5.0, 4.0, -6.0]
    twice = as_read(as_read(arrivals(frame_id='map_ned'), 'ned'), 'ned')
    assert np.allclose(twice.bearing, [0.25, -0.4]) and (twice.tx == arrivals().tx).all()
    assert twice.frame_id == 'map'


def test_a_ned_frame_is_refused_under_enu_and_read_under_ned():
    for measurement in (fix('map_ned'), arrivals(frame_id='map_ned')):
        with pytest.raises(Rejection, match='north-east-down') as caught:
            as_read(measurement, 'enu')
        assert caught.value.reason == 'frame_ned'
    assert as_read(fix(), 'enu').position.tolist() == [1.0, 2.0, 3.0]
    with pytest.raises(ValueError, match='enu, ned'):
        to_enu(fix(), 'nwu', lambda same: same)


# -- rclpy's messages and rosbags' messages are the same to the adapters and on the wire


@pytest.fixture
def wire():
    """Serialization of rclpy."""
    pytest.importorskip('rclpy')
    return pytest.importorskip('rclpy.serialization')


def get_message(name):
    package, _, kind = name.split('/')
    return getattr(import_module(f'{package}.msg'), kind)


def live(wire, message):
    """Carry a rosbags message to rclpy through CDR."""
    return wire.deserialize_message(cdr_of(message), get_message(message.__msgtype__))


def make_rclpy(type_name, /, **fields):
    """The smallest factory for rclpy: bulk data as array.array."""
    for key, value in fields.items():
        if isinstance(value, np.ndarray) and key != 'covariance':
            fields[key] = array('B' if value.dtype == np.uint8 else 'd', value.tobytes())
    return get_message(type_name)(**fields)


def messages(make):
    yield write_fix(fix(), make)
    yield write_arrivals(arrivals(), make)
    yield write_estimate(estimate(), make)
    yield adapters.write_odometry(estimate(), 0, make)
    yield adapters.write_model_probabilities(estimate(), 0, make)


def test_rclpy_reads_what_rosbags_writes_and_the_other_way(wire):
    for ours, theirs in zip(messages(ros_message), messages(make_rclpy)):
        assert live(wire, ours) == theirs
        back = decode_cdr(typestore(), ours.__msgtype__, wire.serialize_message(theirs))
        # bytes may differ in alignment padding, so both are written by the same serializer
        assert cdr_of(back) == cdr_of(ours)


def test_live_and_recorded_messages_give_the_same_measurement(wire):
    of_fix, of_arrivals, of_estimate, *_ = (live(wire, each) for each in messages(ros_message))
    assert isinstance(of_arrivals.data, array)
    for found, wanted in ((read_arrivals(of_arrivals), arrivals()), (read_fix(of_fix), fix())):
        np.testing.assert_equal(asdict(found), asdict(wanted))
    assert read_estimate(of_estimate).state.tobytes() == estimate().state.tobytes()

    with pytest.raises(AssertionError):  # fields are checked in these tests
        get_message('std_msgs/msg/Float64')(data='text')
