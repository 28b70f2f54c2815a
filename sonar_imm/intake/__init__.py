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

"""What stands between the reader of a message and the tracker, live and offline the same.

A measurement passes, in this order,

    transforms -> frame -> repeats (`Intake`) -> type, frame and order of stamps (`stream`)

`Intake` refuses by a `Rejection`, which a user is shown. The streams belong to the trackers, which
place some measurements before they know their frame, and which alone know what they use; they
count what they refuse, and so a tracker without an `Intake` does not mix frames either.
"""

from __future__ import annotations

import hashlib
from typing import Any

from attrs import evolve
import numpy as np

from ..acoustics import geometry
from ..measurements import (
    Detections,
    Fix,
    Fixes,
    GeodeticFix,
    nanoseconds,
    NOBODY,
    Rejection,
    RelativeFix,
    Snapshot,
    StaticTransforms,
    VesselFix,
)
from ..parameters import Config
from .stream import KnownFrames
from .transforms import moved, TransformTree

__all__ = ['Intake', 'KnownFrames', 'RepeatFilter', 'TransformTree']

SEEN_FROM_THE_SONAR = (Detections, Snapshot)
"""What cannot be used before the place of the sonar is known."""
MOST_KEPT = 10_000
"""Positions remembered; the oldest are forgotten for more."""


class Intake:
    """What a measurement passes before `tracker`, a `trackers.Tracker`, processes it.

    mounting: the parameters of the place of the sonar, as /tf_static says them, None before.
    STATE: what it remembers, as of `trackers.Tracker`; the frames are remembered by the tracker.
    """

    STATE = ('repeats', 'transforms')

    def __init__(self, tracker: Any, frame_id: str = ''):
        """frame_id: the frame in which the measurements have to be, empty when the first one that
        is used decides."""
        self.tracker = tracker
        self.frame_id = frame_id
        self.repeats = RepeatFilter(getattr(tracker.config, 'repeat_time', 0.0))
        self.transforms = TransformTree()
        vehicle, sonar = (
            getattr(tracker.config, name, '') for name in ('vehicle_frame', 'sonar_frame')
        )
        self._sonar_frames = (vehicle, sonar) if vehicle and sonar else None
        self.mounting: dict[str, tuple[float, ...]] | None = None

    def admit(self, measurement: Any) -> Any:
        """The measurement as the tracker is to have it: in the frame of the tracks, and without
        rows that came before. None for transforms, which are kept here. Raises `Rejection` for
        one in a frame that has nothing to do with that of the tracks, and for a repeated one."""
        if isinstance(measurement, StaticTransforms):
            self.transforms.add(measurement)
            self._mount()
            return None
        if self._sonar_frames and not self.mounting:
            self._require_mounting(measurement)
        frames = self.tracker.frames
        target = frames.of(measurement, self.frame_id)
        if target and measurement.frame_id not in ('', target):
            measurement = self._in_frame(measurement, target)
        try:
            frames.check(measurement, self.frame_id)
        except Rejection as refusal:
            sentence = f'{refusal.sentence}, and no fixed transform joins the two'
            raise Rejection(refusal.reason, sentence) from None
        if not isinstance(measurement, frames.kinds):
            frames.settle(measurement)
        return self.repeats.fresh(measurement)

    def reconfigure(self, config: Config) -> None:
        """Give `config` to the tracker, with the place of the sonar where that is known."""
        self.tracker.reconfigure(evolve(config, **(self.mounting or {})))

    def reset(self) -> None:
        """Forget all measurements, here and in the tracker; what is known of frames that are fixed
        to each other stays."""
        self.tracker.reset()
        self.repeats.reset()

    def restored(self) -> None:
        """Tell the tracker where the sonar is, after a state was put in."""
        self._mount()

    def _in_frame(self, measurement: Any, target: str) -> Any:
        """The measurement in the frame `target`, where a transform says how."""
        pose = self.transforms.pose(target, measurement.frame_id)
        return measurement if pose is None else moved(measurement, target, pose)

    def _require_mounting(self, measurement: Any) -> None:
        if self._sonar_frames and isinstance(measurement, SEEN_FROM_THE_SONAR):
            vehicle, sonar = self._sonar_frames
            raise Rejection(
                'no_mounting', f"/tf_static has not said where '{sonar}' is on '{vehicle}'"
            )

    def _mount(self) -> None:
        """Give the place of the sonar to the tracker, where the transforms say it."""
        if not self._sonar_frames:
            return
        pose = self.transforms.pose(*self._sonar_frames)
        if pose is None:
            return
        self.mounting = {
            'sonar_lever': tuple(pose.position.tolist()),
            'sonar_mount_rpy_deg': tuple(np.degrees(geometry.euler_angles(pose.R)).tolist()),
        }
        self.tracker.remount(evolve(self.tracker.config, **self.mounting))


class RepeatFilter:
    """Leaves out repeated polls: the same numbers once more, when a driver asks more often than it
    is answered.

    Noise makes no two measurements alike to the last bit, so that a fix whose numbers came before,
    for the same diver and a moment ago, is the old one with a new stamp. It says nothing, and its
    stamp is wrong. After `limit` the same numbers count again: a diver that rests on a coarse grid
    is there.

    rows: how many rows of scans were left out so far.
    """

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
        """Whether that content came with another stamp, not long ago; remembers it, by a digest
        since a scan may have thousands of positions."""
        content = hashlib.blake2b(content, digest_size=16).digest()
        first = self._first.get(content)
        if first is not None and 0 < abs(stamp_ns - first) <= self._limit_ns:
            return True
        if first is None and len(self._first) >= MOST_KEPT:
            self._first.pop(next(iter(self._first)))
        self._first[content] = stamp_ns
        return False
