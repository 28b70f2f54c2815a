# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What every tracker has."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection
from typing import Any, Protocol

from ..estimates import Estimate
from ..intake import KnownFrames


class Tracker(Protocol):
    """The only door to a tracker. `process` has no side effect outside the tracker: no log, no
    clock, no global state.

    counts: what happened to the input, by reason code (``used``, ``gated``, ``duplicate``,
    ``too_late``, ...). STATE: the names of the attributes that hold the state, each with an
    annotation in the class, see `state_file`; objects in them that change have a STATE, too. A
    method ``restored`` makes again what follows from these attributes, and raises ValueError where
    they do not fit each other. ``STATE_TYPES`` in `state_types` lists the classes of their values.
    """

    config: Any
    counts: Counter[str]

    @property
    def STATE(self) -> tuple[str, ...]: ...

    @property
    def frames(self) -> KnownFrames:
        """The frames of what was used so far."""
        ...

    def process(self, measurement: Any) -> list[Estimate]:
        """Take one measurement in. Gives the estimates it made or revised, oldest first; the last
        is the newest state.

        Never raises for bad data: what cannot be used is counted in `counts`."""
        ...

    def reset(self) -> None:
        """Forget everything: equals a fresh tracker."""
        ...

    def reconfigure(self, config: Any) -> None:
        """Take over the parameters that may change while running; keeps the tracks."""
        ...

    def warm(self, inputs: Collection[type] | None = None) -> None:
        """Compile or load every kernel that measurements of the classes `inputs` will need, by
        default of all classes. Changes nothing of the tracker. `System.warm` calls it."""
        ...

    def health(self) -> dict[str, float]:
        """Numbers for diagnostics: NIS, effective sample size, covariance repairs, tracks, ..."""
        ...


class SmoothingTracker(Tracker, Protocol):
    """A tracker that remembers a whole recording."""

    def smoothed(self) -> list[Estimate]:
        """The estimates of all stamps, oldest first, each given all measurements."""
        ...
