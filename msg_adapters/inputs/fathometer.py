# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Input topics of the fathometer tracker."""

from __future__ import annotations

from sonar_imm.measurements import ArrayDepth, CrossSpectra, GeodeticFix, Pressure, Trace

from ..array_records import (
    read_array_depth,
    read_csdm,
    read_pressure,
    read_trace,
    write_array_depth,
    write_csdm,
    write_pressure,
    write_trace,
)
from ..fixes import read_geodetic, write_geodetic
from .topic import InputTopic

TOPICS = (
    InputTopic(
        'csdm',
        'cross-spectra of a vertical array, one row per frequency',
        measurement=CrossSpectra,
        readers={'sensor_msgs/msg/PointCloud2': read_csdm},
        write=write_csdm,
        one_topic=True,
    ),
    InputTopic(
        'pressure',
        'pressure at the hydrophones of a vertical array, one row per sample',
        measurement=Pressure,
        readers={'sensor_msgs/msg/PointCloud2': read_pressure},
        write=write_pressure,
        one_topic=True,
    ),
    InputTopic(
        'trace',
        'ready-made traces, one row per depth',
        measurement=Trace,
        readers={'sensor_msgs/msg/PointCloud2': read_trace},
        write=write_trace,
        one_topic=True,
    ),
    InputTopic(
        'array_depth',
        'depth of the deepest hydrophone, from a companion instrument',
        measurement=ArrayDepth,
        readers={
            'geometry_msgs/msg/PointStamped': read_array_depth,
            'geometry_msgs/msg/PoseWithCovarianceStamped': read_array_depth,
        },
        write=write_array_depth,
        companion=True,
    ),
    InputTopic(
        'position',
        'where the array is, for what changes by distance (record_distance)',
        measurement=GeodeticFix,
        readers={'sensor_msgs/msg/NavSatFix': read_geodetic},
        write=write_geodetic,
        companion=True,
        wanted=lambda settings: settings['record_distance'] > 0.0,
    ),
)
