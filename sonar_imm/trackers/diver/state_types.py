# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The classes of values that a saved state of this tracker may hold, see `state_file`."""

from __future__ import annotations

from ...acoustics.geodesy import Origin
from ...estimation.association import Tracks
from ...estimation.bank import Gaussians
from ...estimation.consistency import NisMemory
from ...estimation.rows import Borrowed, Rows
from ...intake.stream import STREAM_TYPES
from ...measurements import (
    Arrivals,
    Fix,
    Fixes,
    GeodeticFix,
    Navigation,
    RelativeFix,
    Start,
    VesselFix,
    VesselHeading,
    VesselPose,
)
from ..navigation import NavigationBuffer
from .arrival_stamps import ArrivalStamps, Resolution
from .burst_reports import BurstCounts
from .clutter import Clutter, Clutters
from .depth import HeightCounts
from .innovations import FixConsistency, SensorConsistency
from .instruments import Instruments
from .known import Known
from .names import LastNamed
from .offsets import BiasTest, RecentPairs
from .polling import SingleFixes
from .ranges import Ranges
from .sensors import Sensors

STATE_TYPES = (
    *STREAM_TYPES,
    *(Arrivals, Fix, Fixes, Start),
    *(GeodeticFix, RelativeFix, Navigation, VesselFix, VesselHeading, VesselPose),
    *(NavigationBuffer, Origin),
    *(Known, Rows, Borrowed, Gaussians, Tracks),
    *(
        NisMemory,
        FixConsistency,
        SensorConsistency,
        BurstCounts,
        HeightCounts,
        Instruments,
        BiasTest,
        RecentPairs,
    ),
    *(Clutter, Clutters, LastNamed, Ranges, Sensors, SingleFixes),
    *(ArrivalStamps, Resolution),
)
