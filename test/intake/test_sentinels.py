# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""One table of what a variance says besides its number, on every road into the diver tracker."""

import math
import sys

from helpers.refusals import reason
import numpy as np
import pytest

from msg_adapters import fixes
from msg_adapters.navigation import read_heading, read_vessel_pose, write_heading, write_navigation
from msg_adapters.scans import read_scan
from msg_adapters.table import encode_table
from sonar_imm import measurements
from sonar_imm.acoustics.geometry import Pose, rotation
from sonar_imm.intake import Intake, moved
from sonar_imm.measurements import Fix, GeodeticFix, Rejection, RelativeFix, VesselFix
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm_tools.recordings.messages import ros_message

S = 10**9
STOOD = (0.0, 0.0, 0.0, 1.0)
MOST = sys.float_info.max
UNKNOWN = [math.nan, -math.inf, -1e9, -1.0, 0.0]
TINY = [1e-30, 1e-13]
UNMEASURED = [1e6, 1e9, 1e10, 1e17, MOST, math.inf]
HUGE_ANGLES = [0.31, math.pi**2 / 3, math.pi**2, 99.0, 1e3, 1e6, 1e10, MOST, math.inf]


def variances(message, *diagonal):
    """The message with these variances, repeated, and nothing beside them."""
    of_earth = hasattr(message, 'position_covariance')
    stated = message.position_covariance if of_earth else message.pose.covariance
    stated[:] = np.diag(np.resize(diagonal, math.isqrt(len(stated)))).ravel()
    return message


FIXED = Fix(stamp_ns=S, position=(1.0, 2.0, 0.0), frame_id='map')
SEEN = RelativeFix(stamp_ns=S, offset=(30.0, 4.0, -5.0), frame_id='usbl')
EARTH = GeodeticFix(stamp_ns=S, latitude=59.0, longitude=10.0)
VESSEL = VesselFix(stamp_ns=S, latitude=59.0, longitude=10.0)
ROADS = {
    'PoseWithCovarianceStamped': (fixes.read_fix, fixes.write_fix(FIXED, ros_message), None),
    'relative': (fixes.read_relative, fixes.write_relative(SEEN, ros_message), None),
    'NavSatFix diagonal': (fixes.read_geodetic, fixes.write_geodetic(EARTH, ros_message), 2),
    'NavSatFix known': (fixes.read_geodetic, fixes.write_geodetic(EARTH, ros_message), 3),
    'of a vessel': (fixes.read_vessel_fix, fixes.write_geodetic(VESSEL, ros_message), 2),
}


def row_of_scan(variance):
    """A row of a table of fixes, beside a good one."""
    names, stated = ('x', 'y', 'cov_x_x', 'cov_x_y', 'cov_y_y'), np.array([variance, 1.0])
    columns = dict(zip(names, (np.ones(2), np.ones(2), stated, np.zeros(2), stated)))
    scan = read_scan(encode_table(columns, stamp_ns=S, frame_id='map', make=ros_message))
    if len(scan) == 1:
        raise Rejection('not_measured' if variance >= 1.0 else 'out_of_range', 'left out')
    known = not np.isnan(scan.covariance[0, 0, 0])
    return Fix(stamp_ns=S, position=scan.position[0], covariance=np.eye(2) if known else None)


def by_road(road, variance):
    if road == 'row of a table':
        return row_of_scan(variance)
    read, message, kind = ROADS[road]
    if kind is not None:
        message.position_covariance_type = kind
    return read(variances(message, variance))


@pytest.mark.parametrize('road', [*ROADS, 'row of a table'])
def test_variances_of_x_and_y(road):
    for variance in UNKNOWN:
        assert by_road(road, variance).covariance is None, variance
    for variance in (1e-10, 0.25, 99.0, 1e4):
        assert by_road(road, variance).covariance is not None, variance
    for code, refused in (('out_of_range', TINY), ('not_measured', UNMEASURED)):
        assert [reason(by_road, road, variance) for variance in refused] == [code] * len(refused)


def test_one_axis_that_is_far_from_known_is_used():
    """As a bearing and a range from far away say it."""
    message = variances(fixes.write_fix(FIXED, ros_message), 4.0, 3e6, 0.0, 0.0, 0.0, 0.0)
    assert fixes.read_fix(message).covariance[1, 1] == 3e6


def odometry(second, *diagonal):
    place = {'position': (0.0, 0.0, 0.0), 'orientation': STOOD, 'frame_id': 'odom'}
    pose = measurements.VesselPose(stamp_ns=round(second * S), **place)
    return read_vessel_pose(variances(write_navigation(pose, ros_message), *diagonal))


def by_heading(second, *diagonal):
    """A place on Earth that is exactly known, and the orientation of an IMU."""
    lies = {'orientation': STOOD, 'frame_id': 'vessel'}
    heading = measurements.VesselHeading(stamp_ns=round(second * S), **lies)
    message = write_heading(heading, ros_message)
    message.orientation_covariance[:] = np.diag(diagonal[3:]).ravel()
    return read_heading(message)


def seen(read, *diagonal, config=None):
    """The tracker after a relative fix of a vessel with these variances, and its estimate."""
    tracker = DiverTracker(config or DiverConfig(covariance_scales=(1.0,)))
    intake, made = Intake(tracker), []
    for second in (4, 6):
        if read is by_heading:
            place = {'latitude': 59.0, 'longitude': 10.0, 'covariance': 0.25 * np.eye(3)}
            made.append(VesselFix(stamp_ns=second * S, **place))
        made.append(read(second, *diagonal))
    made.append(RelativeFix(stamp_ns=5 * S, offset=(100.0, 0.0, -20.0), frame_id='usbl'))
    rows = [row for item in made for row in tracker.process(intake.admit(item))]
    return tracker, rows[-1] if rows else None


PLACE, LEVEL, HEADING = [0.25] * 3, [1e-4, 1e-4], 1e-3
POSES = pytest.mark.parametrize('read', [odometry, by_heading])


@POSES
@pytest.mark.parametrize('variance', HUGE_ANGLES)
def test_what_is_not_measured_of_an_attitude_is_said(read, variance):
    """A heading gives no position; roll and pitch are the parameter."""
    tracker, made = seen(read, *PLACE, *LEVEL, variance)
    assert made is None and tracker.counts['heading_unmeasured'] == 1
    assert 'heading is not measured' in tracker.warnings()[0]
    std = np.radians(DiverConfig().vessel_attitude_std_deg)
    _, expected = seen(read, *PLACE, std**2, std**2, HEADING)
    tracker, made = seen(read, *PLACE, variance, variance, HEADING)
    assert made.covariance == pytest.approx(expected.covariance, rel=1e-6)
    assert 'roll or pitch is not measured' in tracker.warnings()[0]


@POSES
@pytest.mark.parametrize('variance', [math.nan, -math.inf, -1.0])
def test_an_axis_that_nobody_knows_is_the_parameter_and_the_others_stay(read, variance):
    """NaN means the same of a vessel as of a fix."""
    config = DiverConfig(covariance_scales=(1.0,), vessel_heading_std_deg=7.0)
    own, level = np.radians(7.0) ** 2, np.radians(config.vessel_attitude_std_deg) ** 2
    for given, whole in (
        ([*LEVEL, variance], [*LEVEL, own]),
        ([variance, 1e-4, HEADING], [level, 1e-4, HEADING]),
        ([0.0, 0.0, variance], [level, level, own]),
    ):
        if read is by_heading and given[0] == -1.0:
            continue  # the sign of an IMU without an orientation
        tracker, made = seen(read, *PLACE, *given, config=config)
        _, expected = seen(read, *PLACE, *whole, config=config)
        assert made.covariance == pytest.approx(expected.covariance, rel=1e-6)
        assert not tracker.counts['heading_unmeasured'] + tracker.counts['attitude_unmeasured']


def test_an_unknown_place_of_the_vessel_is_the_parameter_and_an_unmeasured_one_none():
    config = DiverConfig(covariance_scales=(1.0,), vessel_position_std=3.0)
    _, expected = seen(odometry, *[9.0] * 3, *LEVEL, HEADING, config=config)
    for variance in UNKNOWN:
        _, made = seen(odometry, *[variance] * 3, *LEVEL, HEADING, config=config)
        assert made.covariance == pytest.approx(expected.covariance, rel=1e-6)
    for variance in UNMEASURED:
        tracker, made = seen(odometry, *[variance] * 3, *LEVEL, HEADING, config=config)
        assert made is None and tracker.counts['position_unmeasured'] == 1
        assert 'place is not measured' in tracker.warnings()[0]


def test_what_is_unknown_stays_so_in_another_frame_and_on_the_way_out():
    whole = np.diag([0.25, 0.36, 0.49, 1e-4, 2e-4, 3e-4])
    whole[[2, 3]] = whole[:, [2, 3]] = np.nan
    place = {'position': (1.0, 2.0, 0.0), 'orientation': STOOD, 'frame_id': 'odom'}
    pose = measurements.VesselPose(stamp_ns=S, pose_covariance=whole, **place)
    again = read_vessel_pose(write_navigation(pose, ros_message))
    assert again.pose_covariance == pytest.approx(whole, nan_ok=True)
    turned = moved(pose, 'map', Pose(np.zeros(3), rotation(0.0, 0.0, np.pi / 2))).pose_covariance
    assert np.diag(turned) == pytest.approx([0.36, 0.25, *[np.nan] * 3, 3e-4], nan_ok=True)
    heading = measurements.VesselHeading(stamp_ns=S, orientation=STOOD, covariance=whole[3:, 3:])
    again = read_heading(write_heading(heading, ros_message))
    assert again.covariance == pytest.approx(whole[3:, 3:], nan_ok=True)
