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

import subprocess
import sys
from typing import get_args

from helpers.marine import driver_message, OTHERS
import pytest

from msg_adapters.inputs import inputs_of
from sonar_imm.measurements import Measurement, Rejection
from sonar_imm.trackers import SYSTEMS
from sonar_imm_tools.recordings.messages import ros_message, typestore

FOREIGN = ('marine_acoustic_msgs/', 'stonefish_ros2/', 'dave_interfaces/')


def test_every_tracker_has_inputs_whose_readers_say_no_politely():
    for system in SYSTEMS:
        for topic in inputs_of(system):
            assert topic.description and not topic.name.startswith('/')
            for name, read in topic.readers.items():
                if name.startswith(FOREIGN):  # see test_detections.py, test_navigation.py
                    continue
                if name in OTHERS:
                    empty = driver_message(name)
                else:
                    assert name in typestore().types
                    empty = ros_message(name)
                with pytest.raises(Rejection):  # an empty message has no stamp
                    read(empty)
                assert topic.doubt(empty, ()) in (None, 'zero_covariance', 'no_frame')


def test_the_adapters_load_neither_rclpy_nor_rosbags():
    code = (
        'import sys, msg_adapters.estimates; from msg_adapters.inputs import inputs_of; '
        'names = ("bathymetry", "diver", "fathometer", "obstacle"); '
        'assert all(map(inputs_of, names)); '
        'sys.exit(any(name in sys.modules for name in ("rclpy", "rosbags")))'
    )
    assert subprocess.run([sys.executable, '-c', code], check=False).returncode == 0


def test_each_class_of_measurements_is_heard_under_one_name():
    """`write_scene` finds the topic of a measurement by its class."""
    entries = [entry for system in SYSTEMS for entry in inputs_of(system)]
    names: dict[type, str] = {}
    for entry in entries:
        # Several trackers take navigation; a sonar with two sides has a namespace for each.
        first = names.setdefault(entry.measurement, entry.name)
        assert '/' not in first and entry.name.split('/')[-1] == first
    received = {item for entry in entries for item in entry.measurements}
    assert received == set(get_args(Measurement))


def test_an_unknown_system_has_no_inputs():
    with pytest.raises(ModuleNotFoundError):
        inputs_of('whale')
