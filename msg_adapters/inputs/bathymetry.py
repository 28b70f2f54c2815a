# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Input topics of the bathymetry tracker."""

from __future__ import annotations

from functools import partial

from sonar_imm.measurements import Altitude, Navigation, Snapshot

from ..navigation import (
    doubt_navigation,
    read_dvl,
    read_navigation,
    read_range,
    write_navigation,
    write_range,
)
from ..snapshots import read_snapshot, write_snapshot
from ..transforms import TF_STATIC
from .topic import InputTopic

TABLE = 'sensor_msgs/msg/PointCloud2'

SIDES = {'port': frozenset({'port'}), 'starboard': frozenset({'starboard', 'stbd'})}
"""The sides, with the words that name them."""

TOPICS = (
    InputTopic(
        'snapshot',
        'complex snapshots of a side-scan array, one row per range bin; parameter `side` says '
        'where it looks',
        measurement=Snapshot,
        readers={TABLE: read_snapshot},
        write=write_snapshot,
        one_topic=True,
    ),
    *(
        InputTopic(
            f'{side}/snapshot',
            f'the same from the {side} array of a sonar with two sides',
            measurement=Snapshot,
            readers={TABLE: partial(read_snapshot, side=side)},
            write=write_snapshot,
            one_topic=True,
            words=words,
        )
        for side, words in SIDES.items()
    ),
    InputTopic(
        'nav',
        'pose of the ship: only the pose is read',
        measurement=Navigation,
        readers={'nav_msgs/msg/Odometry': read_navigation},
        write=write_navigation,
        doubt=lambda message, navigation: doubt_navigation(message),
        companion=True,
        required=lambda settings: settings.get('navigation') == 'required',
    ),
    InputTopic(
        'altitude',
        'height of the navigation reference above the sea floor, for the start of each ping',
        measurement=Altitude,
        readers={
            'sensor_msgs/msg/Range': read_range,
            'marine_acoustic_msgs/msg/Dvl': read_dvl,
        },
        write=write_range,
        companion=True,
    ),
    TF_STATIC,
)
