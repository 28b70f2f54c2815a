"""The sonar's pose at the instant of a ping, from navigation that comes at its own rate.

Poses are interpolated: position linearly, attitude at constant rate. Across a gap nothing is
known of the attitude in between, and attitude is what the vertical offset is read from, so a ping
in a gap is skipped rather than guessed. A ping newer than the newest pose waits for the next one,
or is extrapolated from the last two where the user allows it, up to a limit.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from typing import Literal

from attrs import field, frozen
import numpy as np

from ...acoustics import geometry
from ...acoustics.geometry import Pose
from ...estimation.arrays import FloatArray
from ...measurements import Navigation
from .config import ObstacleConfig

Readiness = Literal['ready', 'wait', 'gap']


class Mount:
    """Where the sonar sits on the vehicle.

    Here, and only here, the tracker changes between the axes of ROS and those of the papers: poses
    come in as ENU and FLU, the filters work in NED and FRD (`acoustics.geometry`), places go out
    as ENU.
    """

    def __init__(self, config: ObstacleConfig):
        self.lever = np.array(config.sonar_lever)
        self.R = geometry.rotation(*np.radians(config.sonar_mount_rpy_deg))

    def sonar(self, vehicle: Pose) -> Pose:
        """The sonar in NED and FRD, from a vehicle in ENU and FLU."""
        return geometry.flip_pose(geometry.mounted(vehicle, self.lever, self.R))

    @staticmethod
    def to_enu(points: FloatArray, covariance: FloatArray) -> tuple[FloatArray, ...]:
        """Points (T, 3) and covariances (T, 3, 3) in ENU, from NED."""
        halfway = np.swapaxes(geometry.flip_world(covariance), -1, -2)
        return geometry.flip_world(points), geometry.flip_world(halfway)


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

    def since(self, stamp_ns: int) -> NavigationBuffer:
        """What is needed for poses from `stamp_ns` on, and at least two."""
        first = max(0, min(bisect_right(self.stamps, stamp_ns) - 1, len(self.stamps) - 2))
        return NavigationBuffer(self.stamps[first:], self.samples[first:]) if first else self

    def readiness(
        self, first_ns: int, last_ns: int, max_gap_ns: int, max_extrapolation_ns: int
    ) -> Readiness:
        """Whether poses from `first_ns` to `last_ns` are known, will be, or never will be."""
        if not self.stamps:
            return 'wait'
        if first_ns < self.stamps[0]:
            return 'gap'
        begin = bisect_right(self.stamps, first_ns) - 1
        end = min(bisect_left(self.stamps, last_ns), len(self.stamps) - 1)
        steps = np.diff(self.stamps[begin : end + 1])
        if len(steps) and steps.max() > max_gap_ns:
            return 'gap'
        beyond = last_ns - self.stamps[-1]
        if beyond <= 0:
            return 'ready'
        known_rate = len(self.stamps) > 1 and self.stamps[-1] - self.stamps[-2] <= max_gap_ns
        return 'ready' if known_rate and beyond <= max_extrapolation_ns else 'wait'

    def pose(self, stamp_ns: int) -> Pose:
        """The vehicle at `stamp_ns`, in ENU and FLU."""
        if len(self.stamps) == 1:
            one = self.samples[0]
            return Pose(one.position, geometry.rotation_of_quaternion(one.orientation))
        after = min(max(bisect_left(self.stamps, stamp_ns), 1), len(self.stamps) - 1)
        older, newer = self.samples[after - 1], self.samples[after]
        fraction = (stamp_ns - older.stamp_ns) / (newer.stamp_ns - older.stamp_ns)
        position = older.position + fraction * (newer.position - older.position)
        q = geometry.slerp(older.orientation, newer.orientation, fraction)
        return Pose(position, geometry.rotation_of_quaternion(q))
