# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""What stands between the reader of a message and the tracker, live and offline the same.

A measurement passes, in this order,

    transforms -> frame -> leaps -> repeats (`Intake`)
    -> type, frame and order of stamps (`stream`)

`Intake` refuses by a `Rejection`, which a user is shown. The streams belong to the trackers, which
place some measurements before they know their frame, and which alone know what they use; they
count what they refuse, and so a tracker without an `Intake` does not mix frames either.

Only transforms that do not change are used: a measurement is then turned by the same numbers
whenever it comes, live and from a recording. What moves against the frame of the tracks is a
vehicle, and has navigation.
"""

from __future__ import annotations

from functools import singledispatch
import hashlib
import math
from typing import Any, ClassVar, NamedTuple

from attrs import define, evolve, field
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
    GeodeticFix,
    Ground,
    nanoseconds,
    Navigation,
    NOBODY,
    Rejection,
    RelativeFix,
    Snapshot,
    Start,
    StaticTransforms,
    VesselFix,
)
from ..parameters import Config
from .leaps import DEGREE, LeapFilter, Place
from .stream import KnownFrames

__all__ = ['Intake', 'KnownFrames', 'RepeatFilter', 'TransformTree']

SEEN_FROM_THE_SONAR = (Detections, Snapshot)
"""What cannot be used before the place of the sonar is known."""
MOST_KEPT = 10_000
"""Positions remembered; the oldest are forgotten for more."""
MOST_SOURCES = 1000
"""Sources whose last value is remembered; the oldest are forgotten for more."""
LAST_VALUES = 5
"""Values of a source by which it is told whether it holds each for a while."""
USUAL_HOLD = 1.5
"""Part of the longest of the last times for which a value is expected to be held at most."""


class Intake:
    """What a measurement passes before `tracker`, a `trackers.Tracker`, processes it.

    mounting: the parameters of the place of the sonar, as /tf_static says them, None before.
    STATE: what it remembers, as of `trackers.Tracker`; the frames are remembered by the tracker.
    """

    STATE = ('leaps', 'repeats', 'transforms')

    leaps: LeapFilter
    repeats: RepeatFilter
    transforms: TransformTree

    def __init__(self, tracker: Any, frame_id: str = ''):
        """frame_id: the frame in which the measurements have to be, empty when the first one that
        is used decides."""
        self.tracker = tracker
        self.frame_id = frame_id
        self.leaps = LeapFilter()
        self.repeats = RepeatFilter(
            getattr(tracker.config, 'repeat_time', 0.0), getattr(tracker.config, 'fix_std', 1.0)
        )
        self.transforms = TransformTree()
        vehicle, sonar = (
            getattr(tracker.config, name, '') for name in ('vehicle_frame', 'sonar_frame')
        )
        self._sonar_frames = (vehicle, sonar) if vehicle and sonar else None
        self.mounting: dict[str, tuple[float, ...]] | None = None

    def admit(self, measurement: Any) -> Any:
        """The measurement as the tracker is to have it: in the frame of the tracks, and without
        rows that came before. None for transforms, which are kept here. Raises `Rejection` for
        one in a frame that has nothing to do with that of the tracks, for a vessel that cannot
        have come where it is, and for a repeated one."""
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
        self.leaps.check(measurement)
        return self.repeats.fresh(measurement)

    def reconfigure(self, config: Config) -> None:
        """Give `config` to the tracker, with the place of the sonar where that is known."""
        self.tracker.reconfigure(evolve(config, **(self.mounting or {})))

    def reset(self) -> None:
        """Forget all measurements, here and in the tracker; what is known of frames that are fixed
        to each other stays."""
        self.tracker.reset()
        self.leaps.reset()
        self.repeats.reset()

    def restored(self) -> None:
        """Tell the tracker where the sonar is, after a state was put in. Raises ValueError for
        transforms that are none."""
        self.transforms.require()
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


class Source(NamedTuple):
    """The last values of a source of positions: of a diver by a sensor."""

    digest: str = ''
    """Of the present value."""
    since_ns: int = 0
    """Stamp at which it came first."""
    times: int = 0
    """How often it came."""
    places: tuple[tuple[float, float], ...] = ()
    """Of the last values, m."""
    held: tuple[float, ...] = ()
    """For how long each of the values before was held, s; 0 for those that came once."""

    def after(self, digest: str, stamp_ns: int, place: tuple[float, float]) -> Source:
        """What is known after another position."""
        if digest == self.digest:
            return self._replace(times=self.times + 1)
        held = self.held
        if self.times:
            time = abs(stamp_ns - self.since_ns) * 1e-9 if self.times > 1 else 0.0
            held = (*held, time)[-LAST_VALUES:]
        return Source(digest, stamp_ns, 1, (*self.places, place)[-LAST_VALUES:], held)

    def hold(self, limit: float, std: float) -> float:
        """How long the present value may be held, s: `limit` unless values come in runs.

        Of a source with digits so fine that values differ by a third of the standard deviation,
        equal ones are no chance, however old. Otherwise a diver may rest on a coarse grid.
        """
        runs = [time for time in self.held if time]
        if not runs or 2 * len(runs) < len(self.held):
            return limit
        if len(runs) >= 3 and self._finest() < std / 3.0:
            return math.inf
        return max(limit, USUAL_HOLD * max(runs))

    def _finest(self) -> float:
        """The smallest difference of two of the last values, m."""
        return min(
            (
                max(abs(x - a), abs(y - b))
                for k, (x, y) in enumerate(self.places)
                for a, b in self.places[:k]
            ),
            default=math.inf,
        )


@define(eq=False)
class RepeatFilter:
    """Leaves out repeated polls: the same numbers once more, when a driver asks more often than it
    is answered.

    Noise makes no two measurements alike to the last bit, so that a fix whose numbers came before,
    for the same diver and a moment ago, is the old one with a new stamp. It says nothing, and its
    stamp is wrong. After `limit` the same numbers count again: a diver that rests on a coarse grid
    is there. Where a slow sensor is written at a fast rate, each value comes many times, for as
    long as the sensor takes: see `Source.hold`.

    limit: what is repeated within so many seconds is left out; 0: nothing. std: standard deviation
    of a position that states none, m. rows: how many rows of scans were left out so far. STATE:
    see `trackers.Tracker`.
    """

    STATE: ClassVar = ('rows', '_first', '_sources')

    _limit_ns: int = field(alias='limit', converter=nanoseconds)
    _std: float = field(alias='std', default=1.0)
    rows: int = field(init=False, default=0)
    _first: dict[str, int] = field(init=False, factory=dict)
    _sources: dict[str, Source] = field(init=False, factory=dict)

    def reset(self) -> None:
        """Forget what came."""
        self.rows, self._first, self._sources = 0, {}, {}

    def fresh(self, measurement: Any) -> Any:
        """The measurement, of a scan of named positions the rows that are new.

        Raises `Rejection` for one that holds nothing new.
        """
        if not self._limit_ns or isinstance(measurement, VesselFix):
            return measurement
        if isinstance(measurement, Fixes):
            return self._rows(measurement)
        if isinstance(measurement, (Fix, GeodeticFix, RelativeFix)):
            source = f'{measurement.frame_id}\0{measurement.sensor}\0'
            content = source.encode() + measurement.key()
            of_diver = f'{source}{measurement.target_id}'
            place, std = _place_of(measurement), _std_of(measurement.covariance, self._std)
            if self._came(content, measurement.stamp_ns, of_diver, place, std):
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
                    f'{scan.frame_id}\0{name}'.encode() + place.tobytes(),
                    scan.stamp_ns,
                    f'{scan.frame_id}\0{scan.sensor}\0{name}',
                    (float(place[0]), float(place[1])),
                    _std_of(None if scan.covariance is None else scan.covariance[k], self._std),
                )
                for k, (name, place) in enumerate(zip(scan.target_id.tolist(), scan.position))
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

    def _came(
        self,
        content: bytes,
        stamp_ns: int,
        name: str = '',
        place: tuple[float, float] = (math.nan, math.nan),
        std: float = 0.0,
    ) -> bool:
        """Whether that content came with another stamp, not long ago; remembers it, by a digest
        since a scan may have thousands of positions. name, place, std: of its source, the position
        in m, and its standard deviation; no name for a scan of several."""
        digest = hashlib.blake2b(content, digest_size=16).hexdigest()
        first = self._first.get(digest)
        held = bool(name) and self._is_held(name, digest, stamp_ns, place, std)
        if held or (first is not None and 0 < abs(stamp_ns - first) <= self._limit_ns):
            return True
        if first is None and len(self._first) >= MOST_KEPT:
            self._first.pop(next(iter(self._first)))
        self._first[digest] = stamp_ns
        return False

    def _is_held(
        self, name: str, digest: str, stamp_ns: int, place: tuple[float, float], std: float
    ) -> bool:
        """Whether a source gives the value that it gave last, which it holds."""
        before = self._sources.pop(name, Source())
        if len(self._sources) >= MOST_SOURCES:
            self._sources.pop(next(iter(self._sources)))
        self._sources[name] = before.after(digest, stamp_ns, place)
        age = abs(stamp_ns - before.since_ns) * 1e-9
        return digest == before.digest and 0.0 < age <= before.hold(self._limit_ns * 1e-9, std)


def _place_of(measurement: Fix | GeodeticFix | RelativeFix) -> tuple[float, float]:
    """A position in metres, of latitudes nearly."""
    if isinstance(measurement, GeodeticFix):
        east = DEGREE * math.cos(math.radians(measurement.latitude)) * measurement.longitude
        return east, DEGREE * measurement.latitude
    x, y = (measurement.offset if isinstance(measurement, RelativeFix) else measurement.position)[
        :2
    ]
    return float(x), float(y)


def _std_of(covariance: FloatArray | None, usual: float) -> float:
    """The standard deviation of the better axis, m; `usual` where it is not stated."""
    variance = math.nan if covariance is None else float(np.min(np.diagonal(covariance)[:2]))
    return math.sqrt(variance) if variance > 0.0 else usual


UPRIGHT = 1.0 - 1e-6
"""Least cosine between two verticals that are the same."""
SAME_PLACE = 0.01
"""Metres on each axis within which two sensors are at one place."""


MOST_FRAMES = 2000
"""Frames that are remembered, several times what a robot has. The oldest are forgotten."""


@define(eq=False)
class TransformTree:
    """All that was said of frames that are fixed to each other; what is said again replaces.
    STATE: see `trackers.Tracker`."""

    STATE: ClassVar = ('_poses',)

    _poses: dict[str, tuple[str, Pose]] = field(init=False, factory=dict)

    def add(self, transforms: StaticTransforms) -> None:
        """Take in what a message says."""
        for frame, step in transforms.poses.items():
            self._poses.pop(frame, None)
            self._poses[frame] = step
        while len(self._poses) > MOST_FRAMES:
            self._poses.pop(next(iter(self._poses)))

    def require(self) -> None:
        """Raise ValueError where it holds something else than frames."""
        for _, pose in self._poses.values():
            turned = pose.R @ pose.R.T - np.eye(3)
            if pose.position.shape != (3,) or not np.abs(turned).max() < 1e-6:
                raise ValueError('a frame is turned in no way')

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
    return evolve(
        navigation,
        position=_placed(navigation.position, pose),
        orientation=_after(geometry.euler_angles(pose.R)[2], navigation.orientation),
        pose_covariance=_turned_pose(navigation.pose_covariance, pose),
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


def _turned_pose(covariance: FloatArray | None, pose: Pose) -> FloatArray | None:
    """(6, 6) of a pose turned about the vertical, which mixes x with y, and roll with pitch: where
    one is unknown (NaN), both are."""
    if covariance is None:
        return None
    turn, unknown = np.kron(np.eye(2), pose.R), np.isnan(np.diag(covariance))
    unknown[[0, 1]], unknown[[3, 4]] = unknown[:2].any(), unknown[3:5].any()
    turned = turn @ np.where(unknown | unknown[:, None], 0.0, covariance) @ turn.T
    turned[unknown], turned[:, unknown] = np.nan, np.nan
    return np.asarray(turned)


def _after(yaw: float, q: FloatArray) -> FloatArray:
    """The orientation `q` (4,) x, y, z, w, turned by `yaw` around the vertical."""
    x, y, z, w = q
    s, c = np.sin(0.5 * yaw), np.cos(0.5 * yaw)
    return np.array([c * x - s * y, c * y + s * x, c * z + s * w, c * w - s * z])


STATE_TYPES = (Place, Pose, Source)
"""The classes that a saved state of the intake may hold, see `trackers.state_file`."""
