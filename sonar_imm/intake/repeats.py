# Copyright 2026 The sonar_imm developers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Repeated polls: the same numbers once more, when a driver asks more often than it is answered.

Noise makes no two measurements alike to the last bit, so that a fix whose numbers came before, for
the same diver and a moment ago, is the old one with a new stamp. It says nothing, and its stamp is
wrong. After `limit_ns` the same numbers count again: a diver that rests on a coarse grid is there.
"""

from __future__ import annotations

from typing import Any

from attrs import evolve
import numpy as np

from ..measurements import (
    Fix,
    Fixes,
    GeodeticFix,
    nanoseconds,
    NOBODY,
    Rejection,
    RelativeFix,
    VesselFix,
)

MOST_KEPT = 10_000
"""Positions remembered; the oldest are forgotten for more."""


class RepeatFilter:
    """Lets new positions pass. rows: how many rows of scans were left out so far."""

    def __init__(self, limit: float):
        """Leave out what is repeated within `limit` seconds; 0: nothing."""
        self._limit_ns = nanoseconds(limit)
        self.reset()

    def reset(self) -> None:
        """Forget what came."""
        self.rows = 0
        self._first: dict[bytes, int] = {}

    def fresh(self, measurement: Any) -> Any:
        """The measurement, of a scan of named positions the rows that are new.

        Raises `Rejection` for one that holds nothing new.
        """
        if not self._limit_ns or isinstance(measurement, VesselFix):
            return measurement
        if isinstance(measurement, Fixes):
            return self._rows(measurement)
        if isinstance(measurement, (Fix, GeodeticFix, RelativeFix)):
            source = f'{measurement.frame_id}\0{measurement.sensor}\0'.encode()
            if self._came(source + measurement.key(), measurement.stamp_ns):
                raise Rejection('repeated', 'the same position came before with another stamp')
        return measurement

    def _rows(self, scan: Fixes) -> Fixes:
        if not len(scan):
            return scan
        if scan.target_id is None or (scan.target_id == NOBODY).any():
            if self._came(scan.frame_id.encode() + scan.key(), scan.stamp_ns):
                raise Rejection('repeated', 'the same scan came before with another stamp')
            return scan
        new = np.array(
            [
                not self._came(
                    f'{scan.frame_id}\0{name}'.encode() + place.tobytes(), scan.stamp_ns
                )
                for name, place in zip(scan.target_id.tolist(), scan.position)
            ]
        )
        if new.all():
            return scan
        if not new.any():
            raise Rejection('repeated', 'the same positions came before with another stamp')
        self.rows += int((~new).sum())
        return evolve(
            scan,
            position=scan.position[new],
            covariance=None if scan.covariance is None else scan.covariance[new],
            target_id=scan.target_id[new],
        )

    def _came(self, content: bytes, stamp_ns: int) -> bool:
        """Whether that content came with another stamp, not long ago; remembers it."""
        first = self._first.get(content)
        if first is not None and 0 < abs(stamp_ns - first) <= self._limit_ns:
            return True
        if first is None and len(self._first) >= MOST_KEPT:
            self._first.pop(next(iter(self._first)))
        self._first[content] = stamp_ns
        return False
