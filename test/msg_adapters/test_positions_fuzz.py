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

"""Whatever a driver fills in, a position is read or refused, and the tracker goes on."""

from helpers.marine import driver_message
import numpy as np
import pytest

from msg_adapters.geodetic import read_geodetic, read_vessel_fix
from msg_adapters.relative import read_beacon, read_modem, read_relative, read_usbl_data
from msg_adapters.vessel import read_heading, read_vessel_pose
from sonar_imm.measurements import Rejection
from sonar_imm.trackers.diver.tracker import DiverConfig, DiverTracker
from sonar_imm_tools.recordings.messages import ros_message

ODD = [
    np.nan,
    np.inf,
    -np.inf,
    0.0,
    -0.0,
    -1.0,
    5e-324,
    1e-30,
    90.0,
    1e5,
    1e30,
    1.7e308,
    3.0,
    20.0,
]


def fill(message, rng):
    """Put odd numbers into every field of a message, deep down."""
    for name in message.__dataclass_fields__:
        if name.startswith('_') or name.isupper():
            continue
        value = getattr(message, name)
        if name == 'stamp':
            value.sec, value.nanosec = int(rng.integers(0, 40)), int(rng.choice([0, 5, 10**9]))
        elif hasattr(value, 'w') and rng.random() < 0.8:
            value.x, value.y, value.z, value.w = 0.0, 0.0, 0.6, 0.8
        elif hasattr(value, '__dataclass_fields__'):
            fill(value, rng)
        elif rng.random() < 0.8:
            if isinstance(value, np.ndarray):
                value[:] = np.eye(round(len(value) ** 0.5)).ravel()
            elif isinstance(value, float):
                object.__setattr__(message, name, float(rng.normal(3.0, 0.01)))
        elif isinstance(value, np.ndarray):
            diagonal = np.diag(rng.choice(ODD, round(len(value) ** 0.5))).ravel()
            odd = rng.choice([diagonal, rng.choice(ODD, len(value))][rng.integers(2)], len(value))
            object.__setattr__(message, name, odd)
        elif isinstance(value, bool):
            object.__setattr__(message, name, bool(rng.integers(2)))
        elif isinstance(value, float):
            object.__setattr__(message, name, float(rng.choice(ODD)))
        elif isinstance(value, int):
            object.__setattr__(message, name, int(rng.choice([-1, 0, 1, 2, 3, 100, 255, 30_000])))
    return message


READERS = [
    (read_geodetic, 'sensor_msgs/msg/NavSatFix'),
    (read_vessel_fix, 'geographic_msgs/msg/GeoPoseWithCovarianceStamped'),
    (read_relative, 'geometry_msgs/msg/PoseWithCovarianceStamped'),
    (read_modem, 'seatrac_interfaces/msg/ModemRec'),
    (read_usbl_data, 'acomms_msgs/msg/UsblData'),
    (read_beacon, 'stonefish_ros2/msg/BeaconInfo'),
    (read_vessel_pose, 'nav_msgs/msg/Odometry'),
    (read_heading, 'sensor_msgs/msg/Imu'),
]


@pytest.mark.parametrize('stated', [True, False])
def test_odd_numbers_are_read_or_refused(stated):
    rng = np.random.default_rng(11)
    origin = {'origin_latitude': 3.0, 'origin_longitude': 20.0} if stated else {}
    tracker = DiverTracker(DiverConfig(vessel_max_extrapolation=60.0, **origin))
    read = 0
    for _ in range(1500):
        reader, name = READERS[rng.integers(len(READERS))]
        package = name.split('/')[0]
        make = (
            ros_message
            if package.split('_')[0] in ('sensor', 'geometry', 'nav')
            else driver_message
        )
        try:
            measurement = reader(fill(make(name), rng))
        except Rejection as rejection:
            assert rejection.reason and rejection.sentence
            continue
        read += 1
        for estimate in tracker.process(measurement):
            assert np.isfinite(estimate.state).all() and np.isfinite(estimate.covariance).all()
    assert read > 100 and tracker.counts['used'] > 10
