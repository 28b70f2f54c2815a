# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The classes of values that a saved state of this tracker may hold, see `state_file`."""

from __future__ import annotations

from ...acoustics.calibration import Calibration
from ...acoustics.geometry import Pose
from ...intake.stream import STREAM_TYPES
from ...measurements import Altitude, Navigation, Snapshot
from ..navigation import NavigationBuffer
from .findings import LoudBins, Sign
from .ping import Ping, PosedPing
from .tracker import Alone

STATE_TYPES = (
    *STREAM_TYPES,
    *(Altitude, Navigation, Snapshot, NavigationBuffer, Pose),
    *(Alone, Ping, PosedPing, LoudBins, Calibration, Sign),
)
