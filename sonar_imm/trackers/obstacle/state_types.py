# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The classes of values that a saved state of this tracker may hold, see `state_file`."""

from __future__ import annotations

from ...acoustics import geometry
from ...estimation.association import Tracks
from ...estimation.consistency import NisMemory
from ...intake.stream import STREAM_TYPES
from ...measurements import Altitude, Detections, Ground, Navigation
from ..navigation import NavigationBuffer
from .beam import Elevations, MissEvidence
from .births import Seeds
from .bodies import Bodies
from .clutter import Clutter
from .existence import Existence
from .filters import Mixture, Sonar
from .ground import Cells, GroundMap
from .memory import Landmark
from .navigation_errors import NavigationErrors
from .pings import Echoes, Inbox
from .scales import Scales
from .state import Known, Obstacles, ObstacleState

STATE_TYPES = (
    *STREAM_TYPES,
    *(Altitude, Detections, Ground, Navigation, NavigationBuffer, geometry.Pose),
    *(ObstacleState, Inbox, Known, Obstacles, Tracks, NisMemory, Mixture, Sonar, Bodies),
    *(MissEvidence, Existence, Landmark, GroundMap, Cells, NavigationErrors),
    *(Clutter, Echoes, Elevations, Scales, Seeds),
)
