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

from attrs import evolve
import numpy as np
import pytest

from msg_adapters.estimates import (
    read_estimate,
    write_estimate,
    write_model_probabilities,
    write_odometry,
)
from msg_adapters.table import encode_table
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Rejection
from sonar_imm_tools.recordings.messages import ros_message, typestore

STATES = ('px', 'py', 'vx', 'vy')


def estimate(rows=2, seed=1):
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((rows, 4, 4))
    probabilities = rng.random((rows, 3))
    state = rng.standard_normal((rows, 4)) * 1e5
    xyz = np.column_stack([state[:, :2], np.full(rows, -4.0)]).astype(np.float32)
    return Estimate(
        stamp_ns=1700000000123456789,
        frame_id='map',
        xyz=xyz,
        state_names=STATES,
        state=state,
        covariance=root @ root.transpose(0, 2, 1),
        model_names=('heading_000', 'heading_022', 'hover'),
        probabilities=probabilities / probabilities.sum(axis=1, keepdims=True),
        extras={
            'track_id': np.arange(7, 7 + rows, dtype=np.uint32),
            'track_state': np.ones(rows, np.uint8),
            'nis': np.full(rows, np.nan),
        },
    )


def through_cdr(message):
    name = message.__msgtype__
    return typestore().deserialize_cdr(typestore().serialize_cdr(message, name), name)


@pytest.mark.parametrize('rows', [0, 1, 5])
def test_an_estimate_reads_back_bit_for_bit(rows):
    first = estimate(rows)
    again = read_estimate(through_cdr(write_estimate(first, ros_message)))
    assert (again.stamp_ns, again.frame_id) == (first.stamp_ns, first.frame_id)
    assert again.state_names == STATES and again.model_names == first.model_names
    for name, column in first.columns().items():
        assert again.columns()[name].tobytes() == np.ascontiguousarray(column).tobytes(), name
        assert again.columns()[name].dtype == column.dtype


@pytest.mark.parametrize('rows', [0, 1, 3, 40])
@pytest.mark.parametrize('nan', [False, True])
def test_an_estimate_is_packed_as_the_table_of_its_columns(rows, nan):
    """Its numbers go in as one block; `encode_table` takes column by column."""
    item = estimate(rows)
    more = {
        'nis': np.full(rows, np.nan if nan else 1.0),
        'valid': np.ones(rows, bool),
        'outline': np.arange(3.0 * rows, dtype=np.float32).reshape(rows, 3),
    }
    item = evolve(item, extras=item.extras | more)
    expected = encode_table(
        item.columns(), stamp_ns=item.stamp_ns, frame_id=item.frame_id, make=ros_message
    )
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


@pytest.mark.parametrize('gone', ['x', 'cov_px_vy', 'px'])
def test_a_table_without_a_column_is_refused(gone):
    columns = estimate().columns()
    del columns[gone]
    message = encode_table(columns, stamp_ns=1, frame_id='map', make=ros_message)
    with pytest.raises(Rejection, match=gone) as caught:
        read_estimate(message)
    assert caught.value.reason == 'missing_column'


def test_odometry_shows_one_diver_with_velocity_in_the_world():
    first = estimate()
    message = through_cdr(write_odometry(first, 1, ros_message))
    assert message.child_frame_id == 'diver_8' and message.header.frame_id == 'map'
    pose, twist = message.pose, message.twist
    assert [pose.pose.position.x, pose.pose.position.y] == first.state[1, :2].tolist()
    assert pose.pose.position.z == -4.0
    assert [twist.twist.linear.x, twist.twist.linear.y] == first.state[1, 2:].tolist()
    quaternion = pose.pose.orientation
    assert (quaternion.x, quaternion.y, quaternion.z, quaternion.w) == (0.0, 0.0, 0.0, 1.0)
    for got, block in (
        (pose.covariance, first.covariance[1, :2, :2]),
        (twist.covariance, first.covariance[1, 2:, 2:]),
    ):
        matrix = got.reshape(6, 6)
        assert (matrix[:2, :2] == block).all()
        assert (matrix[2:, 2:] == np.diag([1.0, 1e-9, 1e-9, 1e-9])).all()
        assert not matrix[:2, 2:].any() and not matrix[2:, :2].any()


def test_odometry_shows_the_depth_where_it_is_a_state():
    rng = np.random.default_rng(3)
    root = rng.standard_normal((1, 6, 6))
    deep = evolve(
        estimate(rows=1),
        state_names=('px', 'py', 'pz', 'vx', 'vy', 'vz'),
        state=rng.standard_normal((1, 6)),
        covariance=root @ root.transpose(0, 2, 1),
    )
    message = through_cdr(write_odometry(deep, 0, ros_message))
    place, speed = message.pose.pose.position, message.twist.twist.linear
    assert [place.x, place.y, place.z, speed.x, speed.y, speed.z] == deep.state[0].tolist()
    for got, block in (
        (message.pose.covariance, deep.covariance[0, :3, :3]),
        (message.twist.covariance, deep.covariance[0, 3:, 3:]),
    ):
        assert (got.reshape(6, 6)[:3, :3] == block).all()


def test_model_probabilities_are_named_scalars():
    first = estimate()
    message = through_cdr(write_model_probabilities(first, 0, ros_message))
    assert message.name == list(first.model_names)
    assert message.position.tolist() == first.probabilities[0].tolist()
    assert len(message.velocity) == len(message.effort) == 0
