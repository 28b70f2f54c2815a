# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Input topics of the diver tracker."""

from __future__ import annotations

from typing import Any, cast

from sonar_imm.measurements import (
    Arrivals,
    Fix,
    Fixes,
    GeodeticFix,
    RelativeFix,
    Start,
    VesselFix,
    VesselHeading,
    VesselPose,
)

from ..arrivals import read_arrivals, write_arrivals
from ..fixes import (
    doubt_fix,
    doubt_geodetic,
    doubt_height,
    is_geodetic,
    read_fix,
    read_geodetic,
    read_relative,
    read_start,
    read_vessel_fix,
    RELATIVE_DRIVERS,
    write_fix,
    write_geodetic,
    write_relative,
    write_start,
)
from ..headers import Make
from ..navigation import read_heading, read_vessel_pose, write_heading, write_navigation
from ..scans import doubt_scan, read_poses, read_scan, write_scan
from ..transforms import TF_STATIC
from .topic import InputTopic

POSE = 'geometry_msgs/msg/PoseWithCovarianceStamped'
GEODETIC = (
    'sensor_msgs/msg/NavSatFix',
    'geographic_msgs/msg/GeoPointStamped',
    'geographic_msgs/msg/GeoPoseStamped',
    'geographic_msgs/msg/GeoPoseWithCovarianceStamped',
)
RELATIVE = (
    POSE,
    'geometry_msgs/msg/PointStamped',
    'geometry_msgs/msg/Vector3Stamped',
)


def _doubt(message: Any, fix: Fix | GeodeticFix) -> str | None:
    if is_geodetic(message):
        return doubt_geodetic(message)
    return doubt_fix(message) or doubt_height(message, cast(Fix, fix))


def _write(fix: Fix | GeodeticFix, make: Make) -> Any:
    return write_geodetic(fix, make) if isinstance(fix, GeodeticFix) else write_fix(fix, make)


TOPICS = (
    InputTopic(
        'fix',
        'position fixes in a local metric frame, or in latitude and longitude',
        measurement=Fix,
        also=(GeodeticFix,),
        readers={
            POSE: read_fix,
            'geometry_msgs/msg/PointStamped': read_fix,
            **dict.fromkeys(GEODETIC, read_geodetic),
        },
        write=_write,
        doubt=_doubt,
        scans=True,
        second=frozenset(GEODETIC),
        named_by=('tags', 'sensors'),
    ),
    InputTopic(
        'fixes',
        'all position fixes of one scan, also when there are none',
        measurement=Fixes,
        readers={
            'sensor_msgs/msg/PointCloud2': read_scan,
            'geometry_msgs/msg/PoseArray': read_poses,
        },
        write=write_scan,
        doubt=doubt_scan,
        named_by=('sensors',),
    ),
    InputTopic(
        'relative',
        'position fixes relative to a transceiver on a vessel',
        measurement=RelativeFix,
        readers={
            **dict.fromkeys(RELATIVE, read_relative),
            **RELATIVE_DRIVERS,
        },
        write=write_relative,
        scans=True,
        settings=('relative_axes',),
        by_name=frozenset(RELATIVE),
        named_by=('tags', 'sensors'),
    ),
    InputTopic(
        'arrivals',
        'arrival times of one ping, one row per transmitter-receiver pair',
        measurement=Arrivals,
        readers={'sensor_msgs/msg/PointCloud2': read_arrivals},
        write=write_arrivals,
    ),
    InputTopic(
        'nav',
        'pose of the vessel that carries the transceiver of relative fixes',
        measurement=VesselPose,
        readers={'nav_msgs/msg/Odometry': read_vessel_pose},
        write=write_navigation,
        companion=True,
        beside=('relative',),
    ),
    InputTopic(
        'nav_fix',
        'where the vessel is, in latitude and longitude, where there is no nav',
        measurement=VesselFix,
        readers=dict.fromkeys(GEODETIC, read_vessel_fix),
        write=write_geodetic,
        doubt=lambda message, fix: doubt_geodetic(message),
        companion=True,
        beside=('relative',),
    ),
    InputTopic(
        'heading',
        'how the vessel lies, beside nav_fix',
        measurement=VesselHeading,
        readers={
            'sensor_msgs/msg/Imu': read_heading,
            'geometry_msgs/msg/QuaternionStamped': read_heading,
        },
        write=write_heading,
        companion=True,
        beside=('relative',),
    ),
    InputTopic(
        'initial',
        'where a diver is, told and not measured: a confirmed track begins there',
        measurement=Start,
        readers={POSE: read_start},
        write=write_start,
        companion=True,
        prefix='~/',
        by_name=frozenset({POSE}),
    ),
    TF_STATIC,
)
