# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Detections from every message that carries them; the sign of the bearing above all."""

from attrs import asdict, evolve
from helpers import marine
from helpers.marine import driver_message, header
from helpers.refusals import reason
import numpy as np
from numpy.testing import assert_array_equal, assert_equal
import pytest

from msg_adapters import detections as adapters
from msg_adapters.detections import read_detections, read_laser_scan, read_sonar_ranges
from msg_adapters.table import encode_table
from sonar_imm.measurements import Detections, Rejection
from sonar_imm_tools.recordings.messages import ros_message

PORT, STARBOARD = 0.3, -0.2


def table(**columns):
    return encode_table(columns, stamp_ns=7, frame_id='sonar', make=ros_message)


def written(detections):
    return adapters.write_detections(detections, ros_message)


def scan(ranges, intensities=(), **fields):
    usual = {'angle_min': -0.2, 'angle_increment': 0.1, 'range_min': 1.0, 'range_max': 50.0}
    given = {'header': header(), 'ranges': ranges, 'intensities': intensities, **usual, **fields}
    return ros_message('sensor_msgs/msg/LaserScan', **given)


def point_cloud(points, **channels):
    kinds = {'points': 'geometry_msgs/msg/Point32', 'channels': 'sensor_msgs/msg/ChannelFloat32'}
    places = [ros_message(kinds['points'], **dict(zip('xyz', each))) for each in points]
    values = [ros_message(kinds['channels'], name=n, values=v) for n, v in channels.items()]
    given = {'header': header(), 'points': places, 'channels': values}
    return ros_message('sensor_msgs/msg/PointCloud', **given)


def pose_array(*places):
    points = [ros_message('geometry_msgs/msg/Point', **dict(zip('xyz', each))) for each in places]
    poses = [ros_message('geometry_msgs/msg/Pose', position=point) for point in points]
    return ros_message('geometry_msgs/msg/PoseArray', header=header(), poses=poses)


def boxes(*found):
    return driver_message('vision_msgs/msg/Detection3DArray', header=header(), detections=found)


def box(place, stated=0.0, at_hypothesis=False):
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = stated
    best = driver_message(
        'vision_msgs/msg/ObjectHypothesisWithPose', hypothesis__score=0.7,
        pose__covariance=covariance.ravel(),
    )  # fmt: skip
    made = driver_message('vision_msgs/msg/Detection3D', results=[best])
    where = best.pose.pose if at_hypothesis else made.bbox.center
    marine.put(where, **{f'position__{axis}': value for axis, value in zip('xyz', place)})
    return made


def beams(axes):
    """Unit vectors of a beam to port and one to starboard, both 5 degrees down."""
    az, down = np.array([PORT, STARBOARD]), np.radians(5.0)
    ahead, port = np.cos(down) * np.cos(az), np.cos(down) * np.sin(az)
    low = np.full(2, -np.sin(down))
    return np.column_stack([low, -port, ahead] if axes == 'marine' else [ahead, port, low])


def ranges_of(axes):
    return marine.sonar_ranges(beams(axes), [20.0, 30.0])


def test_writing_and_reading_gives_the_same_detections():
    detections = Detections(
        stamp_ns=1_700_000_000_123_456_789, frame_id='sonar', range=[10.0, 1 / 3],
        bearing=[PORT, STARBOARD], var_range=[0.25, np.nan], intensity=[3.0, 4.0],
    )  # fmt: skip
    names = ['range', 'bearing', 'var_range', 'intensity']
    assert [field.name for field in written(detections).fields] == ['x', 'y', 'z', *names]
    high = evolve(detections, elevation=[2.0**-4, np.nan], var_elevation=[2.0**-12, np.nan])
    for item in (detections, high):
        assert_equal(asdict(read_detections(written(item))), asdict(item))


def test_places_are_read_by_x_y_z_and_drawn_with_port_on_the_left():
    ping = read_detections(table(x=[3.0, 0.0], y=[4.0, -2.0], z=[12.0, 0.0]))
    assert ping.range.tolist() == [13.0, 2.0]
    assert ping.bearing == pytest.approx([np.arctan2(4.0, 3.0), -np.pi / 2])
    message = written(Detections(stamp_ns=1, range=[10.0], bearing=[PORT]))
    x, y = np.frombuffer(bytes(message.data), '<f4')[:2]
    assert x > 9.0 and y == pytest.approx(10.0 * np.sin(PORT))
    ping = adapters.read_pose_array(pose_array((4.0, 3.0, 0.0), (np.nan, 0.0, 0.0), (0.0,) * 3))
    assert ping.range.tolist() == [5.0] and ping.bearing == pytest.approx([np.arctan2(3, 4)])
    # The older point cloud.
    places = [(4.0, 3.0, 0.0), (np.nan, 0.0, 0.0), (6.0, -8.0, 0.0)]
    message = point_cloud(places, other=[9.0, 9.0, 9.0], intensities=[1.0, 2.0, 3.0])
    ping = adapters.read_point_cloud(message)
    assert ping.range.tolist() == [5.0, 10.0] and ping.intensity.tolist() == [1.0, 3.0]
    assert ping.bearing == pytest.approx([np.arctan2(3, 4), np.arctan2(-8, 6)])
    ping = adapters.read_point_cloud(point_cloud(places[:1], intensity=[1.0, 2.0]))
    assert np.isnan(ping.intensity).all()


def test_rows_that_are_no_echo_are_dropped_and_variances_that_were_not_filled_in_unknown():
    distance = [np.nan, np.inf, -np.inf, 0.0, -3.0, 1e30, 5.0, 6.0]
    variances = {'var_range': np.arange(1.0, 9.0), 'var_bearing': [1.0] * 7 + [-1.0]}
    ping = read_detections(table(range=distance, bearing=[0.1] * 6 + [np.nan, PORT], **variances))
    assert ping.range.tolist() == [6.0] and ping.bearing.tolist() == [PORT]
    assert ping.var_range.tolist() == [8.0] and np.isnan(ping.var_bearing).all()
    variances = dict.fromkeys(('var_range', 'var_bearing'), [1e-13, 0.25, 2e6, np.inf])
    ping = read_detections(table(range=[5.0] * 4, bearing=[0.1] * 4, **variances))
    for variance in (ping.var_range, ping.var_bearing):
        assert np.isnan(variance).tolist() == [True, False, True, True]


LONG, AXIS = np.ones(10_001), np.repeat(beams('marine')[:1], 5, axis=0)
REFUSED = [
    (read_detections, table(range=[1.0]), 'missing_column'),
    (read_detections, table(bearing=[1.0]), 'missing_column'),
    (read_detections, table(x=[1.0], y=[1.0]), 'missing_column'),
    (read_detections, table(range=[1.0], bearing=[30.0]), 'out_of_range'),
    (read_detections, table(range=np.ones((1, 2)), bearing=[0.0]), 'bad_field'),
    (read_detections, table(range=LONG, bearing=LONG), 'too_large'),
    (read_detections, ros_message('sensor_msgs/msg/PointCloud2'), 'bad_stamp'),
    (read_laser_scan, scan(np.full(100_001, 10.0), angle_increment=1e-7), 'too_large'),
    (read_laser_scan, scan([10.0] * 3, angle_increment=1e30), 'out_of_range'),
    (read_laser_scan, scan([3e7, 4e7], range_max=1e30), 'out_of_range'),
    (read_laser_scan, scan([10.0], header=ros_message('std_msgs/msg/Header')), 'bad_stamp'),
    (adapters.read_point_cloud, point_cloud([(1.0, 1.0, 0.0)] * 10_001), 'too_large'),
    (read_sonar_ranges, marine.sonar_ranges(AXIS, [5.0]), 'bad_shape'),
    (read_sonar_ranges, marine.sonar_ranges(AXIS, [5.0] * 5, [0] * 3), 'bad_shape'),
]


def test_what_cannot_be_used_is_refused_with_its_reason():
    for read, message, code in REFUSED:
        assert reason(read, message) == code
    with pytest.raises(Rejection, match='time_offset of 1e\\+09 s'):
        Detections(stamp_ns=1, range=[5.0], bearing=[0.0], time_offset=[1e9])
    with pytest.raises(Rejection, match='scan of 3600 s'):
        read_laser_scan(scan([10.0] * 2, time_increment=3600.0))
    ranges, bearing = np.array([56_780.0, 23_000.0]), np.array([0.1, -0.2])
    with pytest.raises(Rejection, match='all ranges are beyond 10000, from 23000 on; .* metres'):
        read_detections(table(range=ranges, bearing=bearing))
    ranges[0] = 50.0  # one wild echo among others is only left out
    assert read_detections(table(range=ranges, bearing=bearing)).range.tolist() == [50.0]


FOUR = [10.0, 20.0, 30.0, 40.0]
EMPTY = [
    (read_detections, written(Detections(stamp_ns=7, range=[], bearing=[]))),
    (read_detections, table()),
    (read_laser_scan, scan([])),
    (read_laser_scan, scan([np.nan] * 4)),
    (read_laser_scan, scan([np.inf, -np.inf, -5.0, 0.0])),
    (read_laser_scan, scan(FOUR, range_min=np.nan)),
    (read_laser_scan, scan(FOUR, range_max=np.nan)),
    (read_laser_scan, scan(FOUR, range_min=50.0, range_max=1.0)),
    (read_laser_scan, scan(FOUR, angle_min=np.nan)),
    (read_laser_scan, scan(FOUR, angle_min=np.inf, angle_increment=1e30)),
    (read_laser_scan, scan(FOUR, angle_increment=np.inf)),
    (adapters.read_pose_array, pose_array()),
    (adapters.read_point_cloud, point_cloud([])),
    (adapters.read_detections_3d, boxes()),
    (read_sonar_ranges, marine.sonar_ranges([], [])),
    (adapters.read_sonar_detections, marine.sonar_detections([0.02, 0.03], [])),  # no angles
]


def test_a_message_without_an_echo_is_a_ping_without_detections():
    for read, message in EMPTY:
        message.header = header()
        ping = read(message)
        assert len(ping) == 0 and ping.stamp_ns == 100_000_000_005


def test_a_laser_scan_counts_to_either_side_and_keeps_what_lies_inside_its_limits():
    ping = read_laser_scan(scan([0.5, 10.0, np.nan, np.inf, 60.0, 20.0], range(6)))
    assert ping.range.tolist() == [10.0, 20.0]
    assert ping.bearing == pytest.approx([-0.1, 0.3], abs=1e-7)
    assert ping.intensity.tolist() == [1.0, 5.0]
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
    # Without the times of its rays it says how long it takes.
    for step in (0.0, -1.0, np.nan, np.inf):
        untimed = read_laser_scan(scan([10.0, 20.0], time_increment=step, scan_time=2.0))
        assert untimed.untimed == 2.0 and np.isnan(untimed.time_offset).all()
    assert read_laser_scan(scan([10.0], scan_time=0.2)).untimed == 0.0
    # Times of a table move its stamp to the last row.
    times = {'bearing': [0.0] * 3, 'time_offset': [0.5, np.nan, 0.25]}
    ping = Detections(stamp_ns=10**9, range=[5.0] * 3, **times)
    assert ping.stamp_ns == 1_500_000_000
    assert_array_equal(ping.time_offset, [0.0, np.nan, -0.25])
    assert_equal(asdict(read_detections(written(ping))), asdict(ping))


def test_boxes_in_three_dimensions_have_an_elevation():
    up, port = np.radians(5.0), np.radians(20.0)
    axis = [np.cos(up) * np.cos(port), np.cos(up) * np.sin(port), np.sin(up)]
    aside = [-np.sin(port), np.cos(port), 0.0]
    axes = np.column_stack([axis, aside, np.cross(axis, aside)])
    # .1 m along, 1 degree across, 2 degrees in height at 40 m.
    std = np.array([0.1, 40.0 * np.cos(up) * np.radians(1.0), 40.0 * np.radians(2.0)])
    place = 40.0 * np.array(axis)
    found = box(place, axes @ np.diag(std**2) @ axes.T), box(place, at_hypothesis=True)
    ping = adapters.read_detections_3d(boxes(*found, box([np.nan, 0.0, 0.0])))
    assert ping.range == pytest.approx([40.0, 40.0]) and ping.bearing == pytest.approx([port] * 2)
    assert ping.elevation == pytest.approx([up, up]) and ping.intensity.tolist() == [0.7, 0.7]
    assert ping.var_range[0] == pytest.approx(0.01) and np.isnan(ping.var_range[1])
    assert np.sqrt(ping.var_bearing[0]) == pytest.approx(np.radians(1.0))
    assert np.sqrt(ping.var_elevation[0]) == pytest.approx(np.radians(2.0))


@pytest.mark.parametrize('axes', ['marine', 'rep103'])
def test_both_beam_axes_give_port_as_positive(axes):
    for beam_axes in (axes, 'auto'):
        options = {'beam_axes': beam_axes, 'world_frame': 'enu', 'sound_speed': 1400.0}
        ping = read_sonar_ranges(marine.sent(ranges_of(axes)), **options)
        assert ping.bearing == pytest.approx([PORT, STARBOARD], abs=1e-6)
        assert ping.range.tolist() == [20.0, 30.0]
    # The wrong axes are not mended in silence.
    ping = read_sonar_ranges(ranges_of('marine'), beam_axes='rep103')
    assert np.abs(ping.bearing).min() > 1.5
    with pytest.raises(ValueError, match='beam_axes'):
        read_sonar_ranges(ranges_of('marine'), beam_axes='sideways')


def test_a_sender_that_counts_to_the_other_side_is_turned_round():
    for read, message in (
        (read_detections, table(range=np.array([5.0]), bearing=np.array([PORT]))),
        (read_laser_scan, scan([5.0, 6.0])),
        (adapters.read_point_cloud, point_cloud([(4.0, 3.0, 0.0)])),
        (adapters.read_pose_array, pose_array((4.0, 3.0, 0.0))),
        (read_sonar_ranges, ranges_of('marine')),
        (adapters.read_sonar_detections, marine.sonar_detections([0.02], [PORT])),
    ):
        plain, turned = read(message), read(message, bearing_positive='starboard')
        assert len(plain) and np.abs(plain.bearing).min() > 0.05
        assert np.array_equal(turned.bearing, -plain.bearing)
        assert np.array_equal(turned.range, plain.range)
        with pytest.raises(ValueError, match='port, starboard'):
            read(message, bearing_positive='left')


def test_two_way_times_become_ranges_and_starboard_angles_negative_bearings():
    message = marine.sonar_detections([0.04, 0.02], [-PORT, -STARBOARD], sound_speed=1480.0)
    ping = adapters.read_sonar_detections(marine.sent(message), sound_speed=1500.0)
    assert ping.range == pytest.approx([29.6, 14.8], rel=1e-6)
    assert ping.bearing == pytest.approx([PORT, STARBOARD])
    # A speed of sound that is none gives way to the parameter; one angle is that of all.
    for stated in (0.0, np.nan, 1.5):
        message = marine.sonar_detections([0.02, 0.02], [0.1], sound_speed=stated)
        ping = adapters.read_sonar_detections(message, sound_speed=1450.0)
        assert ping.range == pytest.approx([14.5] * 2)
        assert ping.bearing == pytest.approx([-0.1] * 2)
    # Bad flags and ranges are dropped.
    ranges = [5.0, np.inf, 7.0, np.nan, 9.0]
    ping = read_sonar_ranges(marine.sonar_ranges(AXIS, ranges, [0, 0, 2, 0, 0], [3.0]))
    assert ping.range.tolist() == [5.0, 9.0] and ping.intensity.tolist() == [3.0, 3.0]
