# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""rclpy's messages and rosbags' messages are the same to the adapters and on the wire."""

from array import array
from importlib import import_module

import numpy as np
import pytest

from msg_adapters.arrivals import read_arrivals, write_arrivals
from msg_adapters.estimates import (
    read_estimate,
    write_estimate,
    write_model_probabilities,
    write_odometry,
)
from msg_adapters.fixes import read_fix, write_fix
from sonar_imm.estimates import Estimate
from sonar_imm.measurements import Arrivals, Fix
from sonar_imm_tools.recordings.messages import decode_cdr, ros_message, typestore

pytest.importorskip('rclpy')
rclpy_serialization = pytest.importorskip('rclpy.serialization')


def get_message(name):
    package, _, kind = name.split('/')
    return getattr(import_module(f'{package}.msg'), kind)


def from_rosbags(message):
    """Carry a rosbags message to rclpy through CDR."""
    name = message.__msgtype__
    raw = bytes(typestore().serialize_cdr(message, name))
    return rclpy_serialization.deserialize_message(raw, get_message(name)), name


def make_rclpy(type_name, /, **fields):
    """The smallest factory for rclpy: bulk data as array.array."""
    for key, value in fields.items():
        if isinstance(value, np.ndarray) and key != 'covariance':
            fields[key] = array('B' if value.dtype == np.uint8 else 'd', value.tobytes())
    return get_message(type_name)(**fields)


def fix():
    return Fix(
        stamp_ns=1700000000123456789, position=(1 / 3, 2.0, 3.0),
        covariance=[[4.0, 0.5], [0.5, 9.0]], frame_id='map',
    )  # fmt: skip


def arrivals():
    return Arrivals(
        stamp_ns=10**18, tx_id=[1, 1], rx_id=[2, 3], tx=np.ones((2, 3)), rx=np.zeros((2, 3)),
        toa=[0.1, 1 / 3], var_toa=np.float32([1e-6, np.nan]), bearing=[0.3, -0.4],
        var_bearing=np.float32([0.01, 0.02]), frame_id='map',
    )  # fmt: skip


def estimate():
    return Estimate(
        stamp_ns=10**18, frame_id='map', xyz=np.zeros((1, 3), np.float32),
        state_names=('px', 'py', 'vx', 'vy'), state=np.array([[1 / 3, 2.0, 0.3, 0.4]]),
        covariance=np.eye(4)[None] * 0.1, model_names=('a', 'b'),
        probabilities=np.array([[0.25, 0.75]]), extras={'track_id': np.array([4], np.uint32)},
    )  # fmt: skip


def messages(make):
    return [
        write_fix(fix(), make),
        write_arrivals(arrivals(), make),
        write_estimate(estimate(), make),
        write_odometry(estimate(), 0, make),
        write_model_probabilities(estimate(), 0, make),
    ]


def test_rclpy_reads_what_rosbags_writes_and_the_other_way():
    for ours, theirs in zip(messages(ros_message), messages(make_rclpy)):
        carried, name = from_rosbags(ours)
        assert carried == theirs
        back = decode_cdr(typestore(), name, rclpy_serialization.serialize_message(theirs))
        # bytes may differ in alignment padding, so both are written by the same serializer
        assert bytes(typestore().serialize_cdr(back, name)) == bytes(
            typestore().serialize_cdr(ours, name)
        )


def test_live_and_recorded_messages_give_the_same_measurement():
    live, _ = from_rosbags(write_arrivals(arrivals(), ros_message))
    assert isinstance(live.data, array)
    first, second = read_arrivals(live), read_arrivals(write_arrivals(arrivals(), ros_message))
    for name in ('tx', 'rx', 'toa', 'var_toa', 'bearing', 'var_bearing', 'tx_id', 'rx_id'):
        assert getattr(first, name).tobytes() == getattr(second, name).tobytes()
    live, _ = from_rosbags(write_fix(fix(), ros_message))
    assert read_fix(live).covariance.tobytes() == fix().covariance.tobytes()
    live, _ = from_rosbags(write_estimate(estimate(), ros_message))
    assert read_estimate(live).state.tobytes() == estimate().state.tobytes()


def test_fields_are_checked_in_these_tests():
    with pytest.raises(AssertionError):
        get_message('std_msgs/msg/Float64')(data='text')
