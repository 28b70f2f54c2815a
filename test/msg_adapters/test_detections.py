# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Detections from every message that carries them; the sign of the bearing above all."""

from types import SimpleNamespace

from attrs import evolve
from helpers import marine
from helpers.refusals import reason
from hypothesis import given, HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
import numpy as np
from numpy.testing import assert_array_equal
import pytest

from msg_adapters.detections import (
    read_detections,
    read_detections_3d,
    read_laser_scan,
    read_point_cloud,
    read_pose_array,
    read_sonar_detections,
    read_sonar_ranges,
    write_detections,
)
from msg_adapters.table import encode_table
from sonar_imm.measurements import Detections, Rejection
from sonar_imm_tools.recordings.messages import ros_message

PORT, STARBOARD = 0.3, -0.2
NASTY = (0.0, -1.0, 1e-300, 1e9, 7.0, np.nan, np.inf, -np.inf, 0.25, 30.0)


def header(stamp=100):
    time = ros_message('builtin_interfaces/msg/Time', sec=stamp, nanosec=5)
    return ros_message('std_msgs/msg/Header', stamp=time, frame_id='sonar')


def table(**columns):
    return encode_table(columns, stamp_ns=7, frame_id='sonar', make=ros_message)


# -- our own table -----------------------------------------------------------------------------


def test_writing_and_reading_gives_the_same_detections():
    detections = Detections(
        stamp_ns=1_700_000_000_123_456_789, frame_id='sonar', range=[10.0, 1 / 3],
        bearing=[PORT, STARBOARD], var_range=[0.25, np.nan], intensity=[3.0, 4.0],
    )  # fmt: skip
    names = ['range', 'bearing', 'var_range', 'intensity']
    message = write_detections(detections, ros_message)
    assert [field.name for field in message.fields] == ['x', 'y', 'z', *names]
    of_heights = ['elevation', 'var_elevation']
    high = evolve(detections, elevation=[2.0**-4, np.nan], var_elevation=[2.0**-12, np.nan])
    for item, columns in ((detections, names), (high, names + of_heights)):
        again = read_detections(write_detections(item, ros_message))
        assert again.stamp_ns == item.stamp_ns and again.frame_id == 'sonar'
        for name in columns:
            assert np.array_equal(getattr(again, name), getattr(item, name), equal_nan=True), name
        assert np.isnan(again.var_bearing).all()


@pytest.mark.parametrize(
    'message',
    [write_detections(Detections(stamp_ns=7, range=[], bearing=[]), ros_message), table()],
)
def test_an_empty_cloud_is_a_ping_without_detections(message):
    message.header = header()
    ping = read_detections(message)
    assert len(ping) == 0 and ping.stamp_ns == 100_000_000_005


def test_a_cloud_of_points_is_read_by_x_y_z_and_drawn_with_port_on_the_left():
    ping = read_detections(table(x=[3.0, 0.0], y=[4.0, -2.0], z=[12.0, 0.0]))
    assert ping.range.tolist() == [13.0, 2.0]
    assert ping.bearing == pytest.approx([np.arctan2(4.0, 3.0), -np.pi / 2])
    message = write_detections(Detections(stamp_ns=1, range=[10.0], bearing=[PORT]), ros_message)
    x, y = np.frombuffer(bytes(message.data), '<f4')[:2]
    assert x > 9.0 and y == pytest.approx(10.0 * np.sin(PORT))


def test_rows_that_are_no_echo_are_dropped_and_variances_that_were_not_filled_in_unknown():
    ping = read_detections(
        table(
            range=[np.nan, np.inf, -np.inf, 0.0, -3.0, 1e30, 5.0, 6.0],
            bearing=[0.1] * 6 + [np.nan, PORT],
            var_range=np.arange(1.0, 9.0),
            var_bearing=[1.0] * 7 + [-1.0],
        )
    )
    assert ping.range.tolist() == [6.0] and ping.bearing.tolist() == [PORT]
    assert ping.var_range.tolist() == [8.0] and np.isnan(ping.var_bearing).all()
    variances = [1e-13, 0.25, 2e6, np.inf]
    ping = read_detections(
        table(range=[5.0] * 4, bearing=[0.1] * 4, var_range=variances, var_bearing=variances)
    )
    for variance in (ping.var_range, ping.var_bearing):
        assert np.isnan(variance).tolist() == [True, False, True, True]


@pytest.mark.parametrize(
    'message, code',
    [
        (table(range=[1.0]), 'missing_column'),
        (table(bearing=[1.0]), 'missing_column'),
        (table(x=[1.0], y=[1.0]), 'missing_column'),
        (table(range=[1.0], bearing=[30.0]), 'out_of_range'),
        (table(range=np.ones((1, 2)), bearing=[0.0]), 'bad_field'),
        (table(range=np.ones(10_001), bearing=np.zeros(10_001)), 'too_large'),
        (ros_message('sensor_msgs/msg/PointCloud2'), 'bad_stamp'),
    ],
)
def test_a_table_that_cannot_be_used_is_refused_with_its_reason(message, code):
    assert reason(read_detections, message) == code


# -- common_interfaces -------------------------------------------------------------------------


def scan(ranges, intensities=(), **fields):
    return ros_message(
        'sensor_msgs/msg/LaserScan',
        **{
            'header': header(), 'angle_min': -0.2, 'angle_increment': 0.1, 'range_min': 1.0,
            'range_max': 50.0, 'ranges': ranges, 'intensities': intensities, **fields,
        },
    )  # fmt: skip


def test_a_laser_scan_counts_to_either_side_and_keeps_what_lies_inside_its_limits():
    ping = read_laser_scan(scan([0.5, 10.0, np.nan, np.inf, 60.0, 20.0], range(6)))
    assert ping.range.tolist() == [10.0, 20.0]
    assert ping.bearing == pytest.approx([-0.1, 0.3], abs=1e-7)
    assert ping.intensity.tolist() == [1.0, 5.0]
    assert len(read_laser_scan(scan([]))) == 0
    assert np.isnan(read_laser_scan(scan([2.0], [1.0, 2.0])).intensity).all()
    ping = read_laser_scan(scan([10.0, 20.0, 30.0], angle_min=0.2, angle_increment=-0.1))
    assert ping.bearing == pytest.approx([0.2, 0.1, 0.0], abs=1e-7)
    limits = {'range_min': -np.inf, 'range_max': np.inf}
    ping = read_laser_scan(scan([np.inf, -np.inf, np.nan, -3.0, 12.0], **limits))
    assert ping.range.tolist() == [12.0]


def test_the_rays_of_a_laser_scan_have_times_and_its_stamp_is_the_last_one():
    once = read_laser_scan(scan([10.0] * 4))
    timed = read_laser_scan(scan([10.0, 20.0, np.inf, np.nan], time_increment=0.5))
    assert timed.stamp_ns == once.stamp_ns + 1_500_000_000
    assert timed.time_offset.tolist() == [-1.5, -1.0]
    assert once.takes == 0.0 and timed.takes == 1.5
    assert read_laser_scan(scan([np.inf] * 3, time_increment=0.5)).stamp_ns > once.stamp_ns


@pytest.mark.parametrize('step', [0.0, -1.0, np.nan, np.inf])
def test_a_laser_scan_without_times_of_its_rays_says_how_long_it_takes(step):
    fields = {'time_increment': step, 'scan_time': 2.0}
    assert read_laser_scan(scan([10.0, 20.0], **fields)).untimed == 2.0
    assert np.isnan(read_laser_scan(scan([10.0, 20.0], **fields)).time_offset).all()
    assert read_laser_scan(scan([10.0], time_increment=step, scan_time=0.2)).untimed == 0.0


def test_times_of_a_table_move_its_stamp_to_the_last_row_and_those_of_no_scan_are_refused():
    ping = Detections(
        stamp_ns=10**9, range=[5.0] * 3, bearing=[0.0] * 3, time_offset=[0.5, np.nan, 0.25]
    )
    assert ping.stamp_ns == 1_500_000_000
    assert_array_equal(ping.time_offset, [0.0, np.nan, -0.25])
    again = read_detections(write_detections(ping, ros_message))
    assert again.stamp_ns == ping.stamp_ns
    assert_array_equal(again.time_offset, ping.time_offset)
    assert again.key() == ping.key()
    with pytest.raises(Rejection, match='time_offset of 1e\\+09 s'):
        Detections(stamp_ns=1, range=[5.0], bearing=[0.0], time_offset=[1e9])
    with pytest.raises(Rejection, match='scan of 3600 s'):
        read_laser_scan(scan([10.0] * 2, time_increment=3600.0))


@pytest.mark.parametrize(
    'fields',
    [
        {'ranges': [np.nan] * 4},
        {'ranges': [np.inf, -np.inf, -5.0, 0.0]},
        {'range_min': np.nan},
        {'range_max': np.nan},
        {'range_min': 50.0, 'range_max': 1.0},
        {'angle_min': np.nan},
        {'angle_min': np.inf, 'angle_increment': 1e30},
        {'angle_increment': np.nan},
        {'angle_increment': np.inf},
    ],
    ids=str,
)
def test_a_laser_scan_without_an_echo_is_an_empty_ping(fields):
    ping = read_laser_scan(scan(**{'ranges': [10.0, 20.0, 30.0, 40.0], **fields}))
    assert len(ping) == 0 and ping.stamp_ns > 0


@pytest.mark.parametrize(
    'message, code',
    [
        (scan(np.full(100_001, 10.0), angle_increment=1e-7), 'too_large'),
        (scan([10.0, 20.0], angle_min=90.0), 'out_of_range'),
        (scan([10.0] * 3, angle_increment=1e30), 'out_of_range'),
        (scan([3e7, 4e7], range_max=1e30), 'out_of_range'),
        (scan([10.0], header=ros_message('std_msgs/msg/Header')), 'bad_stamp'),
    ],
    ids=['huge', 'degrees', 'wild step', 'not metres', 'no stamp'],
)
def test_a_wild_laser_scan_is_refused_with_its_reason(message, code):
    assert reason(read_laser_scan, message) == code


def pose_array(*places):
    points = [ros_message('geometry_msgs/msg/Point', **dict(zip('xyz', each))) for each in places]
    poses = [ros_message('geometry_msgs/msg/Pose', position=point) for point in points]
    return ros_message('geometry_msgs/msg/PoseArray', header=header(), poses=poses)


def test_a_pose_array_is_read_by_its_places():
    ping = read_pose_array(pose_array((4.0, 3.0, 0.0), (np.nan, 0.0, 0.0), (0.0, 0.0, 0.0)))
    assert ping.range.tolist() == [5.0] and ping.bearing == pytest.approx([np.arctan2(3, 4)])
    assert len(read_pose_array(pose_array())) == 0


def point_cloud(points, **channels):
    places = [
        ros_message('geometry_msgs/msg/Point32', **dict(zip('xyz', each))) for each in points
    ]
    kind = 'sensor_msgs/msg/ChannelFloat32'
    values = [ros_message(kind, name=name, values=each) for name, each in channels.items()]
    return ros_message(
        'sensor_msgs/msg/PointCloud', header=header(), points=places, channels=values
    )


def test_the_older_point_cloud_is_read_by_its_places_and_intensities():
    places = [(4.0, 3.0, 0.0), (np.nan, 0.0, 0.0), (6.0, -8.0, 0.0)]
    message = point_cloud(places, other=[9.0, 9.0, 9.0], intensities=[1.0, 2.0, 3.0])
    ping = read_point_cloud(message)
    assert ping.range.tolist() == [5.0, 10.0] and ping.intensity.tolist() == [1.0, 3.0]
    assert ping.bearing == pytest.approx([np.arctan2(3, 4), np.arctan2(-8, 6)])
    ping = read_point_cloud(point_cloud(places[:1], intensity=[1.0, 2.0]))
    assert np.isnan(ping.intensity).all()
    assert len(read_point_cloud(point_cloud([]))) == 0
    assert reason(read_point_cloud, point_cloud([(1.0, 1.0, 0.0)] * 10_001)) == 'too_large'


# -- vision_msgs -------------------------------------------------------------------------------


def box(place, covariance=(), score=0.7, at_hypothesis=False):
    """A Detection3D; vision_msgs is not installed here, and fields are read by name."""
    here, nowhere = (
        SimpleNamespace(position=SimpleNamespace(**dict(zip('xyz', each))))
        for each in (place, (0.0, 0.0, 0.0))
    )
    stated = np.zeros((6, 6))
    if len(covariance):
        stated[:3, :3] = covariance
    pose = SimpleNamespace(pose=here if at_hypothesis else nowhere, covariance=stated.ravel())
    hypothesis = SimpleNamespace(class_id='rock', score=score)
    return SimpleNamespace(
        results=[SimpleNamespace(hypothesis=hypothesis, pose=pose)],
        bbox=SimpleNamespace(center=nowhere if at_hypothesis else here),
    )


def test_boxes_in_three_dimensions_have_an_elevation():
    up, port = np.radians(5.0), np.radians(20.0)
    axis = [np.cos(up) * np.cos(port), np.cos(up) * np.sin(port), np.sin(up)]
    aside = [-np.sin(port), np.cos(port), 0.0]
    axes = np.column_stack([axis, aside, np.cross(axis, aside)])
    # .1 m along, 1 degree across, 2 degrees in height at 40 m.
    std = np.array([0.1, 40.0 * np.cos(up) * np.radians(1.0), 40.0 * np.radians(2.0)])
    place = 40.0 * np.array(axis)
    stated = axes @ np.diag(std**2) @ axes.T
    boxes = [box(place, stated), box(place, at_hypothesis=True), box([np.nan, 0.0, 0.0])]
    ping = read_detections_3d(SimpleNamespace(header=header(), detections=boxes))
    assert ping.range == pytest.approx([40.0, 40.0]) and ping.bearing == pytest.approx([port] * 2)
    assert ping.elevation == pytest.approx([up, up]) and ping.intensity.tolist() == [0.7, 0.7]
    assert ping.var_range[0] == pytest.approx(0.01) and np.isnan(ping.var_range[1])
    assert np.sqrt(ping.var_bearing[0]) == pytest.approx(np.radians(1.0))
    assert np.sqrt(ping.var_elevation[0]) == pytest.approx(np.radians(2.0))
    assert len(read_detections_3d(SimpleNamespace(header=header(), detections=[]))) == 0


# -- marine_acoustic_msgs ----------------------------------------------------------------------


def beams(axes):
    """Unit vectors of a beam to port and one to starboard, both 5 degrees down."""
    az, down = np.array([PORT, STARBOARD]), np.radians(5.0)
    ahead, port = np.cos(down) * np.cos(az), np.cos(down) * np.sin(az)
    low = np.full(2, -np.sin(down))
    return np.column_stack([low, -port, ahead] if axes == 'marine' else [ahead, port, low])


@pytest.mark.parametrize('axes', ['marine', 'rep103'])
@pytest.mark.parametrize('given', ['right', 'auto'])
def test_both_beam_axes_give_port_as_positive(axes, given):
    message = marine.sent(marine.sonar_ranges(beams(axes), [20.0, 30.0]))
    beam_axes = axes if given == 'right' else 'auto'
    ping = read_sonar_ranges(message, beam_axes=beam_axes, world_frame='enu', sound_speed=1400.0)
    assert ping.bearing == pytest.approx([PORT, STARBOARD], abs=1e-6)
    assert ping.range.tolist() == [20.0, 30.0]


def test_the_wrong_axes_are_not_mended_in_silence():
    message = marine.sonar_ranges(beams('marine'), [20.0, 30.0])
    ping = read_sonar_ranges(message, beam_axes='rep103')
    assert np.abs(ping.bearing).min() > 1.5
    with pytest.raises(ValueError, match='beam_axes'):
        read_sonar_ranges(message, beam_axes='sideways')


@pytest.mark.parametrize(
    'read, message',
    [
        (read_detections, lambda: table(range=np.array([5.0]), bearing=np.array([PORT]))),
        (read_laser_scan, lambda: scan([5.0, 6.0])),
        (read_point_cloud, lambda: point_cloud([(4.0, 3.0, 0.0)])),
        (read_pose_array, lambda: pose_array((4.0, 3.0, 0.0))),
        (read_sonar_ranges, lambda: marine.sonar_ranges(beams('marine'), [20.0, 30.0])),
        (read_sonar_detections, lambda: marine.sonar_detections([0.02], [PORT])),
    ],
)
def test_a_sender_that_counts_to_the_other_side_is_turned_round(read, message):
    plain, turned = read(message()), read(message(), bearing_positive='starboard')
    assert len(plain) and np.abs(plain.bearing).min() > 0.05
    assert np.array_equal(turned.bearing, -plain.bearing)
    assert np.array_equal(turned.range, plain.range)
    with pytest.raises(ValueError, match='port, starboard'):
        read(message(), bearing_positive='left')


def test_bad_flags_and_ranges_are_dropped():
    axes = np.repeat(beams('marine')[:1], 5, axis=0)
    message = marine.sonar_ranges(
        axes, [5.0, np.inf, 7.0, np.nan, 9.0], flags=[0, 0, 2, 0, 0], intensities=[3.0]
    )
    ping = read_sonar_ranges(message)
    assert ping.range.tolist() == [5.0, 9.0] and ping.intensity.tolist() == [3.0, 3.0]
    assert reason(read_sonar_ranges, marine.sonar_ranges(axes, [5.0])) == 'bad_shape'
    assert reason(read_sonar_ranges, marine.sonar_ranges(axes, [5.0] * 5, [0] * 3)) == 'bad_shape'
    assert len(read_sonar_ranges(marine.sonar_ranges([], []))) == 0


def test_two_way_times_become_ranges_and_starboard_angles_negative_bearings():
    message = marine.sent(
        marine.sonar_detections([0.04, 0.02], [-PORT, -STARBOARD], sound_speed=1480.0)
    )
    ping = read_sonar_detections(message, sound_speed=1500.0)
    assert ping.range == pytest.approx([29.6, 14.8], rel=1e-6)
    assert ping.bearing == pytest.approx([PORT, STARBOARD])


@pytest.mark.parametrize('stated', [0.0, np.nan, 1.5])
def test_a_speed_of_sound_that_is_none_gives_way_to_the_parameter(stated):
    ping = read_sonar_detections(
        marine.sonar_detections([0.02], [0.0], sound_speed=stated), sound_speed=1450.0
    )
    assert ping.range == pytest.approx([14.5])


def test_times_without_angles_are_no_detections():
    assert len(read_sonar_detections(marine.sonar_detections([0.02, 0.03], []))) == 0
    item = read_sonar_detections(marine.sonar_detections([0.02, 0.03], [0.1]))
    assert item.bearing == pytest.approx([-0.1, -0.1])


# -- hostile -----------------------------------------------------------------------------------

numbers = arrays(np.float32, st.integers(0, 6), elements=st.sampled_from(NASTY).map(np.float32))


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(numbers, numbers, numbers, st.lists(st.integers(0, 255), max_size=6))
def test_anything_gives_sound_detections_or_a_rejection(a, b, c, flags):
    rows = np.column_stack(
        [np.resize(item, 4) if len(item) else np.zeros(4) for item in (a, b, c)]
    )
    for read, message in [
        (read_detections, table(x=rows[:, 0], range=rows[:, 1], bearing=rows[:, 2])),
        (read_detections, table(x=rows[:, 0], y=rows[:, 1], z=rows[:, 2])),
        (read_laser_scan, scan(a, b)),
        (read_sonar_ranges, marine.sonar_ranges(rows, a, flags, b)),
        (read_sonar_detections, marine.sonar_detections(a, b, flags, c)),
    ]:
        message.header = header()
        try:
            ping = read(message)
        except Rejection as rejection:
            assert rejection.sentence and rejection.reason
            continue
        assert np.isfinite(ping.range).all() and np.isfinite(ping.bearing).all()
        assert (ping.range > 0.0).all()


def test_ranges_in_millimetres_are_refused_by_name():
    ranges, bearing = np.array([56_780.0, 23_000.0]), np.array([0.1, -0.2])
    with pytest.raises(Rejection, match='all ranges are beyond 10000, from 23000 on; .* metres'):
        read_detections(table(range=ranges, bearing=bearing))
    ranges[0] = 50.0  # one wild echo among others is only left out
    assert read_detections(table(range=ranges, bearing=bearing)).range.tolist() == [50.0]
