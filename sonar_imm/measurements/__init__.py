# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What a tracker takes in: frozen values in SI units and radians, stamps in integer nanoseconds.

A measurement that cannot be used is never built: its class raises `Rejection`, which carries a
reason code to count and one sentence to show. The classes know nothing of ROS; `msg_adapters`
makes them from messages.
"""

from __future__ import annotations

from .bathymetry import MAX_BINS, Snapshot
from .checks import check_covariance, check_stamp, nanoseconds, Rejection
from .diver import Arrivals, Fix, Fixes, in_space, NOBODY, scan_of, Start, usable_fixes
from .fathometer import ArrayDepth, CrossSpectra, Pressure, Trace
from .obstacle import (
    Altitude,
    BEAM_AXES,
    Detections,
    Ground,
    IMAGE_ORDERS,
    LONGEST_SCAN,
    MAX_IMAGE_CELLS,
    Navigation,
    OPTIONAL_COLUMNS,
    SonarImage,
    SonarInfo,
)
from .positions import (
    GeodeticFix,
    RelativeFix,
    StaticTransforms,
    VesselFix,
    VesselHeading,
    VesselPose,
)

__all__ = [
    'Altitude',
    'ArrayDepth',
    'Arrivals',
    'BEAM_AXES',
    'check_covariance',
    'check_stamp',
    'CrossSpectra',
    'Detections',
    'Fix',
    'Fixes',
    'GeodeticFix',
    'Ground',
    'IMAGE_ORDERS',
    'in_space',
    'LONGEST_SCAN',
    'MAX_BINS',
    'MAX_IMAGE_CELLS',
    'Measurement',
    'nanoseconds',
    'Navigation',
    'NOBODY',
    'OPTIONAL_COLUMNS',
    'Pressure',
    'Rejection',
    'RelativeFix',
    'scan_of',
    'Snapshot',
    'SonarImage',
    'SonarInfo',
    'Start',
    'StaticTransforms',
    'Trace',
    'usable_fixes',
    'VesselFix',
    'VesselHeading',
    'VesselPose',
]

Measurement = (
    Fix
    | Fixes
    | Arrivals
    | GeodeticFix
    | RelativeFix
    | VesselPose
    | VesselFix
    | VesselHeading
    | Start
    | Snapshot
    | Trace
    | CrossSpectra
    | Pressure
    | ArrayDepth
    | Detections
    | Navigation
    | Altitude
    | Ground
    | StaticTransforms
)
