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

"""What is measured in a frame that is fixed to that of the tracks, turned into that.

Only transforms that do not change are used: a measurement is then turned by the same numbers
whenever it comes, live and from a recording. What moves against the frame of the tracks is a
vehicle, and has navigation.
"""

from __future__ import annotations

from functools import singledispatch
from typing import Any

from attrs import evolve
import numpy as np

from ..acoustics import geometry
from ..acoustics.geometry import Pose
from ..estimation.angles import wrap_angle
from ..estimation.arrays import FloatArray
from ..measurements import (
    Altitude,
    Arrivals,
    Detections,
    Fix,
    Fixes,
    Ground,
    Navigation,
    Rejection,
    RelativeFix,
    Start,
    StaticTransforms,
)

UPRIGHT = 1.0 - 1e-6
"""Least cosine between two verticals that are the same."""
SAME_PLACE = 0.01
"""Metres on each axis within which two sensors are at one place."""


MOST_FRAMES = 2000
"""Frames that are remembered, several times what a robot has. The oldest are forgotten."""


class TransformTree:
    """All that was said of frames that are fixed to each other; what is said again replaces."""

    def __init__(self) -> None:
        self._poses: dict[str, tuple[str, Pose]] = {}

    def add(self, transforms: StaticTransforms) -> None:
        """Take in what a message says."""
        for frame, step in transforms.poses.items():
            self._poses.pop(frame, None)
            self._poses[frame] = step
        while len(self._poses) > MOST_FRAMES:
            self._poses.pop(next(iter(self._poses)))

    def pose(self, target: str, source: str) -> Pose | None:
        """Where the frame `source` is in the frame `target`; None when it is not known."""
        there, here = self._to_root(source), self._to_root(target)
        common = next((name for name in there if name in here), None)
        if common is None:
            return None
        (a, b) = (there[common], here[common])
        back = b.R.T
        return Pose(back @ (a.position - b.position), back @ a.R)

    def _to_root(self, frame: str) -> dict[str, Pose]:
        """Where `frame` is in itself, in its parent, and so on; a loop ends where it closes."""
        pose, seen = Pose(np.zeros(3), np.eye(3)), {}
        while frame not in seen:
            seen[frame] = pose
            if frame not in self._poses:
                break
            frame, step = self._poses[frame]
            pose = Pose(step.position + step.R @ pose.position, step.R @ pose.R)
        return seen


def moved(measurement: Any, frame_id: str, pose: Pose) -> Any:
    """`measurement`, whose own frame has `pose` in `frame_id`, in that.

    What a sensor on board measures from itself is then what the sensor at the place of `frame_id`
    would have measured. Raises `Rejection` for what cannot be turned: a frame that is tilted,
    because the variance of z need not be known; echoes of a sonar at another place, whose range
    and bearing depend on a height that is not known; and the signals of an array.
    """
    if isinstance(measurement, RelativeFix):
        return evolve(_relative(measurement, pose), frame_id=frame_id)
    if pose.R[2, 2] < UPRIGHT:
        raise Rejection(
            'frame',
            f"the frame '{measurement.frame_id}' is tilted against '{frame_id}': only frames with "
            'the same vertical are turned',
        )
    return evolve(_moved(measurement, pose), frame_id=frame_id)


@singledispatch
def _moved(measurement: Any, pose: Pose) -> Any:
    raise Rejection(
        'frame',
        f"the frame '{measurement.frame_id}' is another one, and this kind of measurement cannot "
        'be turned',
    )


@_moved.register
def _(fix: Fix, pose: Pose) -> Fix:
    covariance = None if fix.covariance is None else _turned(fix.covariance, pose)
    return evolve(fix, position=_placed(fix.position, pose), covariance=covariance)


@_moved.register
def _(scan: Fixes, pose: Pose) -> Fixes:
    covariance = None if scan.covariance is None else _turned(scan.covariance, pose)
    return evolve(scan, position=_placed(scan.position, pose), covariance=covariance)


@_moved.register
def _(start: Start, pose: Pose) -> Start:
    covariance = _turned(start.covariance, pose)
    return evolve(start, position=_placed(start.position, pose), covariance=covariance)


@_moved.register
def _(ping: Arrivals, pose: Pose) -> Arrivals:
    bearing = wrap_angle(ping.bearing + geometry.euler_angles(pose.R)[2])
    return evolve(ping, tx=_placed(ping.tx, pose), rx=_placed(ping.rx, pose), bearing=bearing)


@_moved.register
def _(navigation: Navigation, pose: Pose) -> Navigation:
    covariance, turn = navigation.pose_covariance, np.kron(np.eye(2), pose.R)
    return evolve(
        navigation,
        position=_placed(navigation.position, pose),
        orientation=_after(geometry.euler_angles(pose.R)[2], navigation.orientation),
        pose_covariance=None if covariance is None else turn @ covariance @ turn.T,
    )


@_moved.register
def _(height: Altitude, pose: Pose) -> Altitude:
    return evolve(height, altitude=max(0.0, height.altitude - float(pose.position[2])))


@_moved.register
def _(ping: Detections, pose: Pose) -> Detections:
    if np.abs(pose.position).max() > SAME_PLACE:
        raise Rejection(
            'frame',
            f"the frame '{ping.frame_id}' is another one, at another place: echoes are turned, "
            'but not shifted. A second sonar has a node of its own',
        )
    return evolve(ping, bearing=wrap_angle(ping.bearing + geometry.euler_angles(pose.R)[2]))


def _relative(fix: RelativeFix, pose: Pose) -> RelativeFix:
    """In the axes of another transceiver, tilted or not. One that is levelled has turned what it
    says already, and where it is itself depends on how the vessel lies."""
    if fix.levelled and np.abs(pose.position).max() > SAME_PLACE:
        raise Rejection(
            'frame',
            f"the frame '{fix.frame_id}' is another one, at another place, and levelled positions "
            'do not say how the vessel lies',
        )
    if fix.levelled:
        return fix
    covariance = None if fix.covariance is None else pose.R @ fix.covariance @ pose.R.T
    return evolve(fix, offset=_placed(fix.offset, pose), covariance=covariance)


@_moved.register
def _(ground: Ground, pose: Pose) -> Ground:
    return evolve(ground, position=_placed(ground.position, pose))


def _placed(points: FloatArray, pose: Pose) -> FloatArray:
    """Points (..., 3) of a frame that has `pose`."""
    return np.asarray(points @ pose.R.T + pose.position)


def _turned(covariance: FloatArray, pose: Pose) -> FloatArray:
    """Covariances (..., 3, 3); NaN of what is not stated stays where it is, as z stays z."""
    R, turned = pose.R[:2, :2], covariance.copy()
    turned[..., :2, :2] = R @ covariance[..., :2, :2] @ R.T
    turned[..., :2, 2] = covariance[..., :2, 2] @ R.T
    turned[..., 2, :2] = turned[..., :2, 2]
    return np.asarray(turned)


def _after(yaw: float, q: FloatArray) -> FloatArray:
    """The orientation `q` (4,) x, y, z, w, turned by `yaw` around the vertical."""
    x, y, z, w = q
    s, c = np.sin(0.5 * yaw), np.cos(0.5 * yaw)
    return np.array([c * x - s * y, c * y + s * x, c * z + s * w, c * w - s * z])
