# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The pose of a vehicle at the instants of a ping, from navigation that comes at its own rate.

Poses are interpolated: position linearly, attitude at constant rate. Across a gap nothing is
known of the attitude in between, and attitude is what heights are read from, so a ping in a gap is
skipped rather than guessed. A ping newer than the newest pose waits for the next one, or is
extrapolated from the last two where the user allows it, up to a limit.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from itertools import pairwise
from typing import Literal

from attrs import field, frozen
import numpy as np

from ..acoustics import geometry
from ..acoustics.geometry import Pose
from ..estimation.arrays import IntArray
from ..measurements import Navigation

MOST_WAITING = 200
"""Measurements that wait for a pose; the oldest is given up for one more."""

Readiness = Literal['ready', 'wait', 'gap']


@frozen(eq=False)
class NavigationBuffer:
    """The newest poses, as a value: `stamps` rising, `samples` beside them."""

    stamps: tuple[int, ...] = ()
    samples: tuple[Navigation, ...] = field(default=())

    def added(self, sample: Navigation) -> NavigationBuffer:
        """The buffer with one more pose, which is the newest; of one stamp the last one counts."""
        keep = bisect_left(self.stamps, sample.stamp_ns)
        return NavigationBuffer(
            (*self.stamps[:keep], sample.stamp_ns), (*self.samples[:keep], sample)
        )

    def inserted(self, sample: Navigation) -> NavigationBuffer:
        """The buffer with one more pose in its place; of one stamp the last one counts."""
        place = bisect_left(self.stamps, sample.stamp_ns)
        after = place + (place < len(self.stamps) and self.stamps[place] == sample.stamp_ns)
        return NavigationBuffer(
            (*self.stamps[:place], sample.stamp_ns, *self.stamps[after:]),
            (*self.samples[:place], sample, *self.samples[after:]),
        )

    def since(self, stamp_ns: int) -> NavigationBuffer:
        """What is needed for poses from `stamp_ns` on, and at least two."""
        first = max(0, min(bisect_right(self.stamps, stamp_ns) - 1, len(self.stamps) - 2))
        return NavigationBuffer(self.stamps[first:], self.samples[first:]) if first else self

    def readiness(
        self, first_ns: int, last_ns: int, max_gap_ns: int, max_extrapolation_ns: int = 0
    ) -> Readiness:
        """Whether poses from `first_ns` to `last_ns` are known, will be, or never will be."""
        if not self.stamps:
            return 'wait'
        if first_ns < self.stamps[0]:
            return 'gap'
        begin = bisect_right(self.stamps, first_ns) - 1
        end = min(bisect_left(self.stamps, last_ns), len(self.stamps) - 1)
        steps = pairwise(self.stamps[begin : end + 1])
        if any(newer - older > max_gap_ns for older, newer in steps):
            return 'gap'
        beyond = last_ns - self.stamps[-1]
        if beyond <= 0:
            return 'ready'
        known_rate = len(self.stamps) > 1 and self.stamps[-1] - self.stamps[-2] <= max_gap_ns
        return 'ready' if known_rate and beyond <= max_extrapolation_ns else 'wait'

    def pose(self, stamp_ns: int) -> Pose:
        """The vehicle at `stamp_ns`, in the navigation's own axes."""
        if len(self.stamps) == 1:
            sample = self.samples[0]
            return Pose(sample.position, geometry.rotation_of_quaternion(sample.orientation))
        after = min(max(bisect_left(self.stamps, stamp_ns), 1), len(self.stamps) - 1)
        older, newer = self.samples[after - 1], self.samples[after]
        fraction = (stamp_ns - older.stamp_ns) / (newer.stamp_ns - older.stamp_ns)
        position = older.position + fraction * (newer.position - older.position)
        q = geometry.slerp(older.orientation, newer.orientation, fraction)
        return Pose(position, geometry.rotation_of_quaternion(q))

    def poses(self, stamps_ns: IntArray) -> Pose:
        """The vehicle at stamps (T,), rising, in the navigation's own axes: (T, 3), (T, 3, 3)."""
        begin = max(0, min(bisect_right(self.stamps, stamps_ns[0]) - 1, len(self.stamps) - 2))
        end = max(begin + 2, bisect_left(self.stamps, stamps_ns[-1]) + 1)
        stamps, samples = np.array(self.stamps[begin:end]), self.samples[begin:end]
        position = np.array([sample.position for sample in samples])
        q = np.array([sample.orientation for sample in samples])
        if len(stamps) == 1:
            stamps = np.append(stamps, stamps + 1)
            position, q = np.repeat(position, 2, axis=0), np.repeat(q, 2, axis=0)
        after = np.clip(np.searchsorted(stamps, stamps_ns), 1, len(stamps) - 1)
        steps = stamps[after] - stamps[after - 1]
        fraction = (stamps_ns - stamps[after - 1]) / steps
        older, newer = position[after - 1], position[after]
        turned = geometry.slerp(q[after - 1], q[after], fraction)
        return Pose(
            older + fraction[:, None] * (newer - older), geometry.rotation_of_quaternion(turned)
        )
