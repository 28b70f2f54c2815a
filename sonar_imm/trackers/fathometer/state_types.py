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
from ...acoustics.pulse import SampledPulse
from ...estimation.onset import OnsetState
from ...estimation.set_filter import SetStep, Weighted
from ...estimation.set_model import Sets
from ...estimation.set_shifts import ShiftPath
from ...intake.stream import STREAM_TYPES
from ...measurements import CrossSpectra, Pressure, Trace
from .multiples import Multiples, Seen
from .pressure import Beginning, Pace
from .reflectors import Identified, Identities, Taken
from .response import Lattice, Response
from .slopes import Slope
from .water import SeenFloor

STATE_TYPES = (
    *STREAM_TYPES,
    *(CrossSpectra, Pressure, Trace, Origin),
    *(Beginning, Pace, Response, SampledPulse, Lattice, Taken),
    *(SetStep, Weighted, Sets, ShiftPath),
    *(SeenFloor, OnsetState),
    *(Identities, Identified, Slope, Multiples, Seen),
)
