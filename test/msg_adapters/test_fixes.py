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

import math

from hypothesis import given, HealthCheck, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from msg_adapters.fixes import doubt_fix, doubt_height, read_fix, write_fix
from sonar_imm.measurements import Fix, Rejection
from sonar_imm_tools.recordings.messages import ros_message

POSE = 'geometry_msgs/msg/PoseWithCovarianceStamped'


WHOLE = [[4.0, 0.1, 0.2], [0.1, 9.0, 0.3], [0.2, 0.3, 0.25]]
ONLY_Z = np.full((3, 3), np.nan)
ONLY_Z[2, 2] = 0.25


def header(sec=100, nanosec=5, frame_id='map'):
    stamp = ros_message('builtin_interfaces/msg/Time', sec=sec, nanosec=nanosec)
    return ros_message('std_msgs/msg/Header', stamp=stamp, frame_id=frame_id)


def pose(covariance=None, x=1.0, y=2.0, z=3.0, **head):
    message = ros_message(POSE, header=header(**head))
    message.pose.pose.position.x, message.pose.pose.position.y = x, y
    message.pose.pose.position.z = z
    if covariance is not None:
        message.pose.covariance[:] = np.ravel(covariance)
    return message


def block(a, b, c, d):
    covariance = np.zeros((6, 6))
    covariance[:2, :2] = [[a, b], [c, d]]
    return covariance


def reason(message):
    with pytest.raises(Rejection) as caught:
        read_fix(message)
    return caught.value.reason


def test_a_pose_and_a_point_are_read():
    fix = read_fix(pose(block(4.0, 0.5, 0.5, 9.0)))
    assert fix.stamp_ns == 100_000_000_005 and fix.frame_id == 'map'
    assert fix.position.tolist() == [1.0, 2.0, 3.0]
    assert fix.covariance[:2, :2].tolist() == [[4.0, 0.5], [0.5, 9.0]]
    assert np.isnan(fix.covariance[2]).all()
    point = ros_message(
        'geometry_msgs/msg/PointStamped',
        header=header(),
        point=ros_message('geometry_msgs/msg/Point', x=7.0, y=8.0),
    )
    assert read_fix(point).position.tolist() == [7.0, 8.0, 0.0]
    assert read_fix(point).covariance is None and doubt_fix(point) is None


@pytest.mark.parametrize(
    'covariance, doubt',
    [
        (block(0.0, 0.0, 0.0, 0.0), 'zero_covariance'),
        (block(-1.0, 0.0, 0.0, 4.0), None),
        (block(4.0, 0.0, 0.0, -1.0), None),
        (-np.eye(6), None),
    ],
)
def test_zero_and_negative_covariances_are_unknown_and_only_zero_is_doubted(covariance, doubt):
    assert read_fix(pose(covariance)).covariance is None
    assert doubt_fix(pose(covariance)) == doubt


def test_what_is_not_used_may_be_nonsense():
    covariance = block(4.0, 0.0, 0.0, 9.0)
    covariance[2:, 2:] = np.nan
    fix = read_fix(pose(covariance, z=math.nan))
    assert fix.covariance[:2, :2].tolist() == [[4.0, 0.0], [0.0, 9.0]]
    assert np.isnan(fix.covariance[2]).all() and fix.position[2] == 0.0


def spatial(variance, *across, z=3.0, flat=((4.0, 0.0), (0.0, 9.0))):
    covariance = np.zeros((6, 6))
    covariance[:2, :2], covariance[2, 2] = flat, variance
    for axis, value in enumerate(across):
        covariance[2, axis] = covariance[axis, 2] = value
    return pose(covariance, z=z)


def test_the_height_is_read_where_its_variance_is_stated():
    fix = read_fix(spatial(0.25, 0.5, -0.2))
    assert fix.covariance.tolist() == [[4.0, 0.0, 0.5], [0.0, 9.0, -0.2], [0.5, -0.2, 0.25]]
    turned = read_fix(spatial(0.25, 0.5, -0.2), world_frame='ned')
    assert turned.covariance.tolist() == [[9.0, 0.0, 0.2], [0.0, 4.0, -0.5], [0.2, -0.5, 0.25]]
    assert doubt_height(spatial(0.25, 0.5, -0.2), fix) is None
    alone = read_fix(spatial(0.25, flat=-np.eye(2)))
    assert np.isnan(alone.covariance[:2]).all() and alone.covariance[2, 2] == 0.25


@pytest.mark.parametrize(
    'message',
    [
        spatial(0.0),
        spatial(-1.0),
        spatial(math.nan),
        spatial(math.inf),
        spatial(1e-300),
        spatial(1e6),
        spatial(0.25, math.nan),
        spatial(0.25, 1.0, 0.0),  # as good as singular with x: the correlation is 1
        spatial(0.25, 0.9, 0.9),
        spatial(0.25, 1e300, -1e300),
        spatial(0.25, z=math.nan),
        spatial(0.25, z=1e9),
    ],
)
def test_a_height_that_is_not_stated_or_cannot_be_true_is_left_out_alone(message):
    fix = read_fix(message)
    assert fix.covariance[:2, :2].tolist() == [[4.0, 0.0], [0.0, 9.0]]
    assert np.isnan(fix.covariance[2]).all() and np.isnan(fix.covariance[:, 2]).all()
    variance, z = message.pose.covariance[14], message.pose.pose.position.z
    doubted = 1e-12 <= variance < 1e6 and math.isfinite(z)
    assert doubt_height(message, fix) == ('bad_height' if doubted else None)


@pytest.mark.parametrize(
    'message, code',
    [
        (pose(block(4.0, 1.0, 2.0, 9.0)), 'bad_covariance'),
        (pose(block(1.0, 2.0, 2.0, 1.0)), 'bad_covariance'),
        (pose(block(math.nan, 0.0, 0.0, 1.0)), 'nan'),
        (pose(block(1.0, math.inf, math.inf, 1.0)), 'nan'),
        (pose(block(1e-300, 0.0, 0.0, 1e-300)), 'out_of_range'),
        (pose(block(1e300, 0.0, 0.0, 1e308)), 'out_of_range'),
        (pose(x=math.nan), 'nan'),
        (pose(y=math.inf), 'nan'),
        (pose(x=1e9), 'out_of_range'),
        (pose(sec=0, nanosec=0), 'bad_stamp'),
        (pose(sec=-5), 'bad_stamp'),
        (pose(nanosec=2**32 - 1), 'bad_stamp'),
        (pose(frame_id='odom_ned'), 'frame_ned'),
    ],
)
def test_what_cannot_be_used_is_refused_with_its_reason(message, code):
    assert reason(message) == code


def test_a_covariance_of_another_size_is_refused():
    message = pose()
    message.pose.covariance = np.zeros(35)
    assert reason(message) == 'bad_shape'


@pytest.mark.parametrize('covariance', [None, [[4.0, 0.1], [0.1, 9.0]], WHOLE, ONLY_Z])
def test_writing_and_reading_gives_the_same_fix(covariance):
    fix = Fix(
        stamp_ns=1700000000123456789,
        position=(1 / 3, -2e5, 0.5),
        covariance=covariance,
        frame_id='map',
    )
    message = write_fix(fix, ros_message)
    again = read_fix(message)
    assert again.stamp_ns == fix.stamp_ns and again.frame_id == 'map'
    assert (again.position == fix.position).all() and doubt_fix(message) is None
    assert (
        (again.covariance is None)
        if covariance is None
        else again.covariance.tobytes() == fix.covariance.tobytes()
    )


NASTY = (
    1.0, 2.0, 4.0, 0.5, 0.0, -0.0, -1.0, 1e-300, 1e-12, 1e9, 1e300, 1e-160, math.nan, math.inf,
    -math.inf, 1 / 3, 100.0,
)  # fmt: skip


@given(
    values=st.binary(min_size=10, max_size=10),
    symmetric=st.booleans(),
    sec=st.sampled_from((1, 0, -1, 1700000000, 2**31 - 1, -(2**31))),
    nanosec=st.sampled_from((0, 5, 999999999, 10**9, 2**32 - 1)),
    frame_id=st.sampled_from(['map', '', 'x_ned']),
    world=st.sampled_from(['enu', 'ned']),
)
@settings(max_examples=1_000, deadline=None, suppress_health_check=list(HealthCheck))
def test_hostile_fixes_are_refused_or_finite(values, symmetric, sec, nanosec, frame_id, world):
    x, y, z, a, b, c, d, *of_z = (NASTY[value % len(NASTY)] for value in values)
    covariance = block(a, b, b if symmetric else c, d)
    covariance[2, :3] = of_z
    if symmetric:
        covariance[:2, 2] = covariance[2, :2]
    message = pose(covariance, x, y, z, sec=sec, nanosec=nanosec, frame_id=frame_id)
    try:
        fix = read_fix(message, world_frame=world)
    except Rejection as rejection:
        assert rejection.reason and rejection.sentence
        return
    assert np.isfinite(fix.position).all() and fix.stamp_ns > 0
    if fix.covariance is not None:
        flat, z = fix.covariance[:2, :2], fix.covariance[2, 2]
        assert np.isnan(z) or 1e-12 <= z < 1e6
        if np.isfinite(z) and np.isnan(flat).all():
            return
        assert np.isfinite(flat).all()
        assert (np.linalg.eigvalsh(flat) >= 0.99e-12).all()
        assert flat.max() <= 1e16
