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

"""Pings that wait until the navigation says how the ship lay at each of their bins.

A ping needs the poses from its transmission to the reception of its last bin. It waits until a
pose at or after that is known, or is skipped, and counted, when the navigation has a gap there. A
ping may be late by `KEPT_NS`: poses are kept that long.
"""

from __future__ import annotations

from collections import Counter
from typing import NamedTuple

import numpy as np

from ...acoustics.geometry import Pose
from ...estimation.arrays import FloatArray
from ...intake import KnownFrames
from ...intake.stream import Stream, StreamRules
from ...measurements import Altitude, nanoseconds, Navigation, Snapshot
from ..navigation import MOST_WAITING, NavigationBuffer
from .config import BathymetryConfig

KEPT_NS = 60_000_000_000
_LONGEST_PAUSE_NS = 3_600_000_000_000
_RESTART_AFTER = 5
ALTITUDE_AGE_NS = 5_000_000_000
"""An altitude older than this, seen from the ping, says nothing."""


class PosedPing(NamedTuple):
    """A ping, the poses of the ship (T + 1,), ENU from FLU, when it was sent and when each bin was
    received, the frame of the navigation, and the newest altitude, m, None when there is none."""

    snapshot: Snapshot
    poses: Pose
    frame_id: str
    altitude: float | None


class PoseQueue:
    """Poses and the pings that wait for them. counts: where to count what is not used."""

    def __init__(self, counts: Counter[str]):
        self.counts = counts
        self.heard = False
        rules = StreamRules(KEPT_NS, _LONGEST_PAUSE_NS, _RESTART_AFTER)
        self._stream = Stream((Navigation,), rules, counts)
        self._buffer = NavigationBuffer()
        self._altitudes: list[Altitude] = []
        self._waiting: list[Snapshot] = []

    def __len__(self) -> int:
        """How many pings wait."""
        return len(self._waiting)

    @property
    def frames(self) -> KnownFrames:
        return self._stream.frames

    def add_pose(self, sample: Navigation) -> None:
        """Take one pose in. A clock that was set back forgets all poses."""
        admitted = self._stream.admit(sample)
        if admitted.restarted:
            self.counts['navigation_gap'] += len(self._waiting)
            self._buffer, self._altitudes, self._waiting = NavigationBuffer(), [], []
        for pose in admitted.items:
            self.heard = True
            self.counts['poses'] += 1
            self._buffer = self._buffer.inserted(pose)
        if self._buffer.stamps:
            self._buffer = self._buffer.since(self._buffer.stamps[-1] - KEPT_NS)

    def add_altitude(self, altitude: Altitude) -> None:
        self._altitudes = [*self._altitudes[-999:], altitude]

    def add_ping(self, snapshot: Snapshot) -> None:
        if len(self._waiting) == MOST_WAITING:
            self._waiting.pop(0)
            self.counts['navigation_missing'] += 1
        self._waiting.append(snapshot)

    def ready(self, config: BathymetryConfig) -> list[PosedPing]:
        """The pings whose poses are known now, in the order in which they came."""
        done, waiting = [], []
        for snapshot in self._waiting:
            stamps = bin_stamps(snapshot, config)
            known = self._buffer.readiness(
                int(stamps[0]),
                int(stamps[-1]),
                nanoseconds(config.max_gap),
                nanoseconds(config.max_extrapolation),
            )
            if known == 'wait':
                waiting.append(snapshot)
            elif known == 'gap':
                self.counts['navigation_gap'] += 1
            else:
                poses = self._buffer.poses(stamps)
                altitude = self._altitude(int(stamps[-1]))
                done.append(PosedPing(snapshot, poses, self._stream.frame_id, altitude))
        self._waiting = waiting
        return done

    def _altitude(self, stamp_ns: int) -> float | None:
        usable = [
            one for one in self._altitudes if 0 <= stamp_ns - one.stamp_ns <= ALTITUDE_AGE_NS
        ]
        return max(usable, key=lambda one: one.stamp_ns).altitude if usable else None


def sound_speed_of(snapshot: Snapshot, config: BathymetryConfig) -> float:
    """The sound speed, m/s, that made the ranges of a snapshot."""
    return snapshot.sound_speed or config.sound_speed


def bin_stamps(snapshot: Snapshot, config: BathymetryConfig) -> np.ndarray:
    """Stamps (T + 1,) ns: of the transmission, and of the reception of each bin."""
    ranges: FloatArray = snapshot.ranges(config.sound_speed)
    late = np.rint(2e9 * ranges / sound_speed_of(snapshot, config)).astype(np.int64)
    return snapshot.stamp_ns + np.concatenate([[0], late])
