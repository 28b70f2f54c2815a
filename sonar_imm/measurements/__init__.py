"""What a tracker takes in: frozen values in SI units and radians, stamps in integer nanoseconds.

A measurement that cannot be used is never built: its class raises `Rejection`, which carries a
reason code to count and one sentence to show. The classes know nothing of ROS; `msg_adapters`
makes them from messages.
"""

from __future__ import annotations

from .bathymetry import MAX_BINS, Snapshot
from .checks import check_covariance, check_stamp, nanoseconds, Rejection
from .diver import Arrivals, Fix, Fixes, NOBODY, scan_of, usable_fixes
from .fathometer import ArrayDepth, CrossSpectra, Pressure, Trace
from .frames import frame_role, FrameGuard
from .obstacle import (
    Altitude,
    BEAM_AXES,
    Detections,
    IMAGE_ORDERS,
    MAX_IMAGE_CELLS,
    Navigation,
    OPTIONAL_COLUMNS,
    SonarImage,
)
from .positions import GeodeticFix, RelativeFix, VesselFix, VesselHeading, VesselPose
from .repeats import RepeatGuard

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
    'frame_role',
    'FrameGuard',
    'GeodeticFix',
    'IMAGE_ORDERS',
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
    'RepeatGuard',
    'scan_of',
    'Snapshot',
    'SonarImage',
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
    | Snapshot
    | Trace
    | CrossSpectra
    | Pressure
    | ArrayDepth
    | Detections
    | Navigation
    | Altitude
)
