# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

import math

from helpers.refusals import reason
from hypothesis import given, HealthCheck, settings
from hypothesis import strategies as st
import numpy as np
import pytest

from msg_adapters.fixes import UNKNOWN_VARIANCE
from msg_adapters.scans import doubt_scan, read_poses, read_scan, write_poses, write_scan
from msg_adapters.table import encode_table
from sonar_imm.measurements import Fixes, Rejection
from sonar_imm_tools.recordings.messages import ros_message

STAMP = 1_700_000_000_123_456_789
FLAT = [[4.0, 0.5], [0.5, 9.0]]


def scan(**columns):
    """Two fixes at (1, 2) and (3, 4); `columns` replace."""
    full = {
        'x': np.array([1.0, 3.0]),
        'y': np.array([2.0, 4.0]),
        'cov_x_x': np.array([1.0, 4.0], np.float32),
        'cov_x_y': np.array([0.5, 0.0], np.float32),
        'cov_y_y': np.array([1.0, 9.0], np.float32),
    }
    full.update(columns)
    full = {name: np.asarray(values) for name, values in full.items() if values is not None}
    return encode_table(full, stamp_ns=STAMP, frame_id='map', make=ros_message)


def doubted(message):
    return doubt_scan(message, read_scan(message))


def test_a_table_is_read():
    got = read_scan(scan(z=[5.0, math.nan], id=np.array([7, -1], np.int32)))
    assert got.stamp_ns == STAMP and got.frame_id == 'map' and len(got) == 2
    assert got.position.tolist() == [[1.0, 2.0, 5.0], [3.0, 4.0, 0.0]]
    flat = got.covariance[:, :2, :2]
    assert flat.tolist() == [[[1.0, 0.5], [0.5, 1.0]], [[4.0, 0.0], [0.0, 9.0]]]
    assert np.isnan(got.covariance[:, 2]).all()
    assert got.target_id.tolist() == [7, -1]
    assert read_scan(scan()).target_id is None


def test_an_empty_scan_is_a_scan_and_an_empty_table_of_something_else_is_none():
    none = {name: [] for name in ('x', 'y', 'cov_x_x', 'cov_x_y', 'cov_y_y')}
    assert len(read_scan(scan(**none))) == 0
    assert reason(read_scan, scan(**dict.fromkeys(none))) == 'missing_column'
    assert reason(read_scan, scan(cov_x_y=None)) == 'missing_column'


def test_unknown_covariances_are_nan_in_their_rows():
    got = read_scan(scan(cov_x_x=[-1.0, 4.0]))
    assert np.isnan(got.covariance[0]).all()
    assert got.covariance[1, :2, :2].tolist() == [[4, 0], [0, 9]]
    zero = [0.0, 0.0]
    assert read_scan(scan(cov_x_x=zero, cov_x_y=zero, cov_y_y=zero)).covariance is None


@pytest.mark.parametrize(
    'columns',
    [
        {'x': [math.nan, 3.0]},
        {'y': [math.inf, 4.0]},
        {'x': [1e9, 3.0]},
        {'cov_x_y': [2.0, 0.0]},
        {'cov_x_x': [math.inf, 4.0]},
        {'cov_x_x': [1e-300, 4.0]},
    ],
)
def test_rows_that_cannot_be_used_are_left_out_and_doubted(columns):
    got = read_scan(scan(**columns))
    assert got.position.tolist() == [[3.0, 4.0, 0.0]]
    assert doubted(scan(**columns)) == 'unusable_rows' and doubted(scan()) is None


@pytest.mark.parametrize(
    'columns, code',
    [
        ({'x': [math.nan, math.nan]}, 'nan'),
        ({'id': [0.5, 1.0]}, 'out_of_range'),
        ({'id': [3e9, 1.0]}, 'out_of_range'),
        ({'x': np.ones((2, 2))}, 'bad_field'),
    ],
)
def test_what_cannot_be_used_is_refused_with_its_reason(columns, code):
    assert reason(read_scan, scan(**columns)) == code


def test_north_east_down_is_turned():
    message = scan(z=[5.0, 6.0])
    got = read_scan(message, world_frame='ned')
    assert got.position.tolist() == [[2.0, 1.0, -5.0], [4.0, 3.0, -6.0]]
    assert got.covariance[1, :2, :2].tolist() == [[9.0, 0.0], [0.0, 4.0]]


@pytest.mark.parametrize('n', [0, 1, 5])
@pytest.mark.parametrize('named', [False, True])
@pytest.mark.parametrize('deep', [False, True])
def test_writing_and_reading_gives_the_same_scan(n, named, deep):
    rng = np.random.default_rng(n)
    fixes = Fixes(
        stamp_ns=STAMP,
        position=rng.normal(size=(n, 3)) * 1e5,
        covariance=np.tile(
            [[4.0, 0.5, 0.25], [0.5, 9.0, 0.5], [0.25, 0.5, 1.0]] if deep else FLAT, (n, 1, 1)
        ),
        target_id=np.arange(n) if named else None,
        frame_id='map',
    )
    message = write_scan(fixes, ros_message)
    assert ('cov_z_z' in [each.name for each in message.fields]) == (deep and n > 0)
    again = read_scan(message)
    assert again.stamp_ns == fixes.stamp_ns and (again.position == fixes.position).all()
    assert n == 0 or again.covariance.tobytes() == fixes.covariance.tobytes()
    assert (again.target_id is None) == (not named or n == 0)


def test_poses_are_fixes_without_covariance():
    fixes = Fixes(stamp_ns=STAMP, position=[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]], frame_id='map')
    message = write_poses(fixes, ros_message)
    got = read_poses(message)
    assert (got.position == fixes.position).all() and got.covariance is None
    message.poses[0].position.x = math.nan
    left = read_poses(message)
    assert len(left) == 1 and doubt_scan(message, left) == 'unusable_rows'
    assert (
        len(read_poses(write_poses(Fixes(stamp_ns=1, position=np.empty((0, 3))), ros_message)))
        == 0
    )


def test_heights_are_read_where_they_are_stated():
    z = {'z': [5.0, math.nan], 'cov_z_z': [0.25, 0.25]}
    got = read_scan(scan(**z)).covariance
    assert got[0].tolist() == [[1.0, 0.5, 0.0], [0.5, 1.0, 0.0], [0.0, 0.0, 0.25]]
    assert np.isnan(got[1, 2]).all()
    turned = read_scan(scan(**z, cov_x_z=[0.1, 0.0], cov_y_z=[0.2, 0.0]), world_frame='ned')
    assert turned.covariance[0, 2] == pytest.approx([-0.2, -0.1, 0.25])
    only = read_scan(scan(**z, cov_x_x=[-1.0, 4.0])).covariance[0]
    assert np.isnan(only[:2]).all() and only[2, 2] == 0.25
    assert np.isnan(read_scan(scan(cov_z_z=[1.0, 1.0])).covariance[:, 2]).all()


NASTY = (1.0, 4.0, 0.5, 0.0, -1.0, 1e-300, 1e9, 1e300, math.nan, math.inf, -math.inf, 1 / 3)


@given(
    values=st.lists(st.sampled_from(NASTY), min_size=20, max_size=20),
    world=st.sampled_from(['enu', 'ned']),
)
@settings(max_examples=200, deadline=None, suppress_health_check=list(HealthCheck))
def test_hostile_scans_are_refused_or_finite(values, world):
    deep = ('cov_x_z', 'cov_y_z', 'cov_z_z')
    names = ('x', 'y', 'z', 'cov_x_x', 'cov_x_y', 'cov_y_y', 'id', *deep)
    columns = {name: values[2 * k : 2 * k + 2] for k, name in enumerate(names)}
    try:
        got = read_scan(scan(**columns), world_frame=world)
    except Rejection as rejection:
        assert rejection.reason and rejection.sentence
        return
    assert np.isfinite(got.position).all()
    if got.covariance is not None:
        flat = got.covariance[:, :2, :2]
        known = flat[~np.isnan(flat).any(axis=(1, 2))]
        assert len(known) + np.isnan(flat).all(axis=(1, 2)).sum() == len(flat)
        whole = got.covariance[~np.isnan(got.covariance).any(axis=(1, 2))]
        assert (np.linalg.det(whole / np.abs(whole).max(axis=(1, 2))[:, None, None]) > 0.0).all()
        assert (np.linalg.eigvalsh(known) > 0.0).all() and (known <= 1e10 * UNKNOWN_VARIANCE).all()
