# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""From measurements to pings: where the sonar was, and which echoes it heard.

Navigation, altitudes, soundings and detections arrive in any order. They lie in the `Inbox` until
the navigation says where the sonar was: a pose completes the pings that waited for it. A `Ping` is
what the stages of the tracker work on. Here, and only here, the axes change: poses come in as ENU
and FLU and bearings count to port; the filters work in NED and FRD (`acoustics.geometry`) with
azimuths to starboard; places go out as ENU.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

from attrs import define, field, frozen
import numpy as np

from ...acoustics import geometry
from ...acoustics.geometry import Pose
from ...estimation.arrays import BoolArray, FloatArray, IndexArray, take
from ...measurements import Altitude, Detections, Ground, Measurement, nanoseconds, Navigation
from ..navigation import MOST_WAITING, NavigationBuffer, Readiness
from .avoidance import course
from .beam import apply_elevations, Elevations
from .config import ObstacleConfig
from .filters import HeightPrior, Mixture, Sonar
from .ground import GroundMap
from .matches import Match

SMALLEST, WIDEST = 1e-12, 0.25
"""Variances m^2 and rad^2: below the one a sender means none; bearings above the other say
nothing."""
INSTANT = 0.01
"""Seconds within which a ping is one instant."""
ROUNDS = 3
"""In which the beam that turns and an obstacle meet."""
RATES_OVER_NS = 300_000_000
"""Over which velocities are differences of poses."""
SKEWED = 0.3
"""m, from which it matters that the vehicle moves during a ping."""
KEPT_AT_FIRST = 30.0
"""Seconds of navigation that are kept as long as nobody knows how long a scan takes."""


class Mount:
    """Where the sonar sits on the vehicle."""

    def __init__(self, config: ObstacleConfig):
        self.lever = np.array(config.sonar_lever)
        self.R = geometry.rotation(*np.radians(config.sonar_mount_rpy_deg))

    def sonar(self, vehicle: Pose) -> Pose:
        """Return the sonar in NED and FRD, from a vehicle in ENU and FLU."""
        there = geometry.mounted(vehicle, self.lever, self.R)
        return Pose(geometry.flip_world(there.position), geometry.flip_rotation(there.R))

    @staticmethod
    def to_enu(points: FloatArray, covariance: FloatArray) -> tuple[FloatArray, ...]:
        """Return points (T, 3) and covariances (T, 3, 3) in ENU, from NED."""
        return geometry.flip_world(points), geometry.flip_covariance(covariance)


@frozen(eq=False)
class Echoes:
    """The echoes of one ping: range and azimuth z (D, 2), m and rad positive to starboard, with
    covariance R (D, 2, 2); extended (D,): whether an extent is stated; stated (D, 2): which
    variances are; heights: their elevations, None where none is measured; late (D,): s after the
    stamp, None where all are of one instant."""

    z: FloatArray
    R: FloatArray
    extended: BoolArray
    stated: BoolArray
    heights: Elevations | None = None
    late: FloatArray | None = None

    @staticmethod
    def of(ping: Detections, config: ObstacleConfig, scale: FloatArray | float = 1.0) -> Echoes:
        """Return the rows that are echoes, with `scale` (2,) times their variances. One that is as
        uncertain as it is far says nothing and is left out."""
        z = np.column_stack([ping.range, -ping.bearing])  # REP-103 counts bearings to port
        variance = np.column_stack([ping.var_range, ping.var_bearing])
        stated = np.isfinite(variance) & (variance > SMALLEST)
        variance = np.where(stated, variance, default_variance(config))
        real = np.isfinite(z[:, 0]) & (np.abs(z[:, 1]) < 0.5 * np.pi)
        real &= (z[:, 0] > 2.0 * np.sqrt(variance[:, 0])) & (variance[:, 1] < WIDEST)
        R, extended = (scale * variance)[:, :, None] * np.eye(2), np.isfinite(ping.extent_range)
        heights = Elevations.of(ping.elevation[real], ping.var_elevation[real], config)
        late = times(z[:, 1], ping.time_offset)[real] if ping.takes > INSTANT else None
        return Echoes(z[real], R[real], extended[real], stated[real], heights, late)

    def __len__(self) -> int:
        return len(self.z)

    def rows(self, which: IndexArray | BoolArray) -> Echoes:
        """Return some of the echoes."""
        heights = self.heights and take(self.heights, which)
        late = None if self.late is None else self.late[which]
        return Echoes(
            self.z[which], self.R[which], self.extended[which], self.stated[which], heights, late
        )

    def height_prior(
        self, sonar: Sonar, ground: GroundMap, config: ObstacleConfig
    ) -> HeightPrior | None:
        """Return what is known of the height of obstacles that begin at these echoes."""
        if not (self.heights or ground):
            return None
        ends = self.heights.ends() if self.heights else np.full((len(self), 2), np.nan)
        return HeightPrior(ends, *ground.below(self.z, sonar, config))

    def update_height(
        self, mixture: Mixture, pose: Pose, config: ObstacleConfig
    ) -> tuple[Mixture, FloatArray]:
        """Return the obstacles after the elevation of one echo each, and the log (T,) of its
        density beside that of clutter."""
        if not self.heights:
            return mixture, np.zeros(len(self))
        return apply_elevations(mixture, self.heights, pose, config)


def default_variance(config: ObstacleConfig) -> FloatArray:
    """Return the variances (2,), m^2 and rad^2, of a detection that comes without."""
    return np.square([config.range_std, np.radians(config.bearing_std_deg)])


def times(azimuth: FloatArray, offset: FloatArray) -> FloatArray:
    """Return the times (D,), s, of detections at these azimuths, of which some are NaN: as of
    those beside them."""
    known = np.flatnonzero(np.isfinite(offset) & np.isfinite(azimuth))
    order = known[np.argsort(azimuth[known], kind='stable')]
    return np.where(np.isfinite(offset), offset, np.interp(azimuth, azimuth[order], offset[order]))


class Met(NamedTuple):
    """Where the sonar was, and how long ago, s, when its beam met each of T obstacles; poses: the
    same as arrays, position (T, 3) and R (T, 3, 3)."""

    sonars: tuple[Sonar, ...]
    ago: FloatArray
    poses: Pose

    @classmethod
    def of(cls, sonars: Iterable[Sonar], ago: FloatArray) -> Met:
        sonars = tuple(sonars)
        position = np.array([sonar.pose.position for sonar in sonars]).reshape(-1, 3)
        R = np.array([sonar.pose.R for sonar in sonars]).reshape(-1, 3, 3)
        return cls(sonars, ago, Pose(position, R))

    def rows(self, which: IndexArray | BoolArray) -> Met:
        """Return those of some obstacles."""
        ago = self.ago[which]
        index = np.arange(len(self.ago))[which]
        return Met.of((self.sonars[i] for i in index), ago)


def joined(met: Met | None, others: Met | None) -> Met | None:
    """Return both, where there are any."""
    if met is None or others is None:
        return met
    return Met.of((*met.sonars, *others.sonars), np.concatenate([met.ago, others.ago]))


@frozen(eq=False)
class Sweep:
    """A ping that takes time: echoes in order of their azimuth (D,), each so much `late` (D,), s
    (all before the stamp); at: the sonar at any instant, s after the stamp."""

    azimuth: FloatArray
    late: FloatArray
    at: Callable[[float], Sonar]

    @classmethod
    def of(cls, echoes: Echoes, at: Callable[[float], Sonar]) -> Sweep | None:
        """Return that of a ping, None where all is of one instant."""
        if echoes.late is None or not len(echoes):
            return None
        order = np.argsort(echoes.z[:, 1], kind='stable')
        return cls(echoes.z[order, 1], echoes.late[order], at)

    def met(self, place: FloatArray, velocity: FloatArray, since: float) -> Met:
        """Return when the beam met obstacles at the places (T, 3) that move with velocity (T, 3),
        NED, the stamp being `since` s later than that; not earlier than then."""
        ago = np.zeros(len(place))
        for i in range(len(place)):
            late = 0.0
            for _ in range(ROUNDS):
                m = geometry.to_body(self.at(late).pose, place[i] + velocity[i] * (since + late))
                late = float(np.interp(np.arctan2(m[1], m[0]), self.azimuth, self.late))
                late = max(late, -since)
            ago[i] = -late
        return Met.of((self.at(-each) for each in ago), ago)


@define(eq=False)
class Ping:
    """One ping on its way through the stages. What a stage tells later ones stands in a slot that
    no other stage writes: `before` and `dt` (s) the sonar in the ping before and how long ago that
    was, and in a ping that takes time where the obstacles were `met`, by `predict`; `match` by
    `associate`; `navigation_before`, marginals of its errors before the update, by
    `note_navigation`; `stays` (T,) the tracks that do not end, and `over` (T,) those that are
    remembered if so, by `judge`. sweep: of a ping that takes time; untimed: s that it took where
    nobody says when it met what."""

    stamp_ns: int
    sonar: Sonar
    echoes: Echoes
    ground: GroundMap
    sweep: Sweep | None = None
    untimed: float = 0.0
    met: Met | None = field(init=False, default=None)
    before: Sonar = field(init=False)
    dt: float = field(init=False)
    match: Match = field(init=False)
    navigation_before: tuple[FloatArray, FloatArray] = field(init=False)
    stays: BoolArray = field(init=False)
    over: BoolArray = field(init=False)

    def places(self) -> list[Sonar]:
        """Return where the sonar was when it heard each echo."""
        if self.sweep is None or self.echoes.late is None:
            return [self.sonar] * len(self.echoes)
        return [self.sweep.at(late) for late in self.echoes.late.tolist()]

    def skew(self) -> tuple[float, float]:
        """Return how long a ping took whose echoes have no times, s, and how far the vehicle went
        meanwhile, m; zeros where that does not matter."""
        wrong = float(np.hypot(*self.sonar.course[:2])) * self.untimed
        return (self.untimed, wrong) if wrong >= SKEWED else (0.0, 0.0)


class Inbox(NamedTuple):
    """What came and is not used up. waiting: pings without a pose yet, each with the altitude
    then; ground: soundings so far; skipped: pings so far for which navigation had a gap; missing:
    pings so far that were given up because too many waited; scan_ns: longest ping so far, -1
    before the first one."""

    navigation: NavigationBuffer = NavigationBuffer()
    altitude: Altitude | None = None
    ground: GroundMap = GroundMap()
    waiting: tuple[tuple[Detections, Altitude | None], ...] = ()
    skipped: int = 0
    missing: int = 0
    scan_ns: int = -1

    def received(self, items: Iterable[Measurement]) -> Inbox:
        """Return the inbox with all measurements of one stamp."""
        navigation, altitude, ground = self.navigation, self.altitude, self.ground
        pings = []
        for item in items:
            if isinstance(item, Navigation):
                navigation = navigation.added(item)
            elif isinstance(item, Altitude):
                altitude = item
            elif isinstance(item, Ground):
                ground = ground.added(item)
            elif isinstance(item, Detections):
                pings.append(item)
        waiting = [*self.waiting, *((ping, altitude) for ping in pings)]
        given_up = max(0, len(waiting) - MOST_WAITING)
        return self._replace(
            navigation=navigation,
            altitude=altitude,
            ground=ground,
            waiting=tuple(waiting[given_up:]),
            missing=self.missing + given_up,
            scan_ns=max([self.scan_ns, *(nanoseconds(ping.takes) for ping in pings)]),
        )

    def released(
        self, config: ObstacleConfig
    ) -> tuple[Inbox, list[tuple[Detections, Altitude | None]]]:
        """Return the inbox without the pings that wait no longer, and those that can be used."""
        waiting, ready, skipped = list(self.waiting), [], self.skipped
        while waiting and (state := self._readiness(waiting[0][0], config)) != 'wait':
            first = waiting.pop(0)
            if state == 'ready':
                ready.append(first)
            else:
                skipped += 1
        return self._replace(waiting=tuple(waiting), skipped=skipped), ready

    def _readiness(self, ping: Detections, config: ObstacleConfig) -> Readiness:
        return self.navigation.readiness(
            ping.stamp_ns - nanoseconds(ping.takes),
            ping.stamp_ns + _late_ns(config),
            nanoseconds(config.max_navigation_gap),
            nanoseconds(config.max_extrapolation),
        )

    def ping(
        self,
        detections: Detections,
        altitude: Altitude | None,
        mount: Mount,
        config: ObstacleConfig,
        scale: FloatArray,
    ) -> Ping:
        """Return the ping that one of the `released` ones is; scale (2,): of its variances."""
        stamp_ns, echoes = detections.stamp_ns, Echoes.of(detections, config, scale)

        def at(late: float) -> Sonar:
            return self._sonar(stamp_ns + nanoseconds(late), altitude, mount, config)

        sweep = Sweep.of(echoes, at)
        return Ping(stamp_ns, at(0.0), echoes, self.ground, sweep, detections.untimed)

    def _sonar(
        self, stamp_ns: int, altitude: Altitude | None, mount: Mount, config: ObstacleConfig
    ) -> Sonar:
        vehicle = self.navigation.pose(stamp_ns)
        pose = mount.sonar(vehicle)
        reference = float(pose.position[2] + vehicle.position[2])  # depth plus height
        straight = geometry.flip_world(course(self.navigation, stamp_ns, config.course_window))
        height = np.nan
        if altitude and altitude.stamp_ns >= stamp_ns - nanoseconds(config.max_altitude_age):
            height = altitude.altitude
        rates = self._rates(stamp_ns, pose, mount)
        late_ns = _late_ns(config)
        if not late_ns:
            return Sonar(pose, height, None, 0.0, reference, straight, *rates)
        late = mount.sonar(self.navigation.pose(stamp_ns + late_ns))
        return Sonar(pose, height, late, late_ns * 1e-9, reference, straight, *rates)

    def _rates(self, stamp_ns: int, pose: Pose, mount: Mount) -> tuple[FloatArray, FloatArray]:
        """Return velocity (3,) m/s, NED, and turn rate (3,) rad/s, in its own axes, of the sonar,
        by the difference of poses."""
        before_ns = max(stamp_ns - RATES_OVER_NS, self.navigation.stamps[0])
        dt = (stamp_ns - before_ns) * 1e-9
        if dt <= 0.0:
            return np.zeros(3), np.zeros(3)
        before = mount.sonar(self.navigation.pose(before_ns))
        turned = before.R.T @ pose.R
        turn = 0.5 * (turned - turned.T)[[2, 0, 1], [1, 2, 0]]
        sine = float(np.linalg.norm(turn))
        angle = np.arctan2(sine, 0.5 * (np.trace(turned) - 1.0))
        scale = angle / sine if sine > 1e-9 else 1.0
        return (pose.position - before.position) / dt, turn * scale / dt

    def forgetting(self, stamp_ns: int, config: ObstacleConfig) -> Inbox:
        """Return the inbox without the poses that no ping needs any more."""
        oldest = self.waiting[0][0].stamp_ns if self.waiting else stamp_ns
        longest = nanoseconds(KEPT_AT_FIRST) if self.scan_ns < 0 else self.scan_ns
        kept = self.navigation.since(oldest - longest - nanoseconds(config.course_window))
        return self._replace(navigation=kept)


def _late_ns(config: ObstacleConfig) -> int:
    """How long after the transmission a pose is needed."""
    if config.ping_timing == 'instant':
        return 0
    return nanoseconds(2.0 * config.max_range / config.sound_speed)
