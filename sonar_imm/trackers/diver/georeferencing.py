# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Positions of all kinds, brought into the frame of the tracks before the tracker sees them.

Latitude and longitude become metres east and north of the origin. A relative fix waits until the
vessel's pose is known around its stamp, from ``nav`` or from ``nav_fix`` and ``heading``, and is
composed with it. Everything else goes through as it is.

East, north and up of a vessel that is known by latitude and longitude are not those of the origin:
what it measures against them (its heading, a position by the transceiver's own compass) is turned
by the convergence of the meridians and the tilt of the vertical. What is by compass is turned from
magnetic to true north before.

A sensor that rotates or polls stamps each fix by itself. With ``scan_period`` they get the stamp
of their scan here, so that those who are not looked at just now are not missed.

Without a stated origin the first position in latitude and longitude is it, once such a position is
used. Then metres that others have measured are from somewhere else, and cannot be used beside it:
what came first stays. Positions far from it are refused, unless it is the first ones that are
wrong: a receiver that has just been switched on may be anywhere.
"""

from __future__ import annotations

from collections import Counter
from operator import attrgetter
from typing import ClassVar, NamedTuple

from attrs import define, evolve, field
import numpy as np

from ...acoustics import geometry
from ...acoustics.geodesy import Origin
from ...acoustics.geometry import Pose
from ...acoustics.relative_position import Mounting, place, Uncertainty
from ...estimation.arrays import FloatArray
from ...estimation.history import StampGate
from ...measurements import (
    Arrivals,
    Fix,
    Fixes,
    GeodeticFix,
    Measurement,
    nanoseconds,
    Navigation,
    NOBODY,
    Rejection,
    RelativeFix,
    VesselFix,
    VesselHeading,
    VesselPose,
)
from ...measurements.variances import filled, UNKNOWN_VARIANCE, UNMEASURED_ANGLE
from ..navigation import MOST_WAITING, NavigationBuffer, Readiness
from .config import DiverConfig

KEPT_NS = 60_000_000_000
"""Poses are kept that long, and for the history of the tracker."""
_LONGEST_PAUSE_NS = 3_600_000_000_000
_RESTART_AFTER = 5
FARTHEST = 1e6
"""Metres from the origin. Further away a plane that touches the Earth there is no chart: lengths
are wrong by more than a hundredth."""
_AGREE = 3
"""Positions in succession, as far from an origin that fewer have confirmed, that are believed."""
_LEVEL = (0.0, 0.0, 0.0, 1.0)


class _Vessel(NamedTuple):
    """The vessel at an instant, and the frame it is placed in; axes (3, 3): of that frame from
    east, north, up where the vessel is."""

    pose: Pose
    uncertainty: Uncertainty
    frame_id: str
    axes: FloatArray


@define(eq=False)
class Samples:
    """What one instrument says of the vessel: poses, of which only a part may be meant. STATE: see
    `trackers.Tracker`."""

    STATE: ClassVar = ('_gate', 'buffer')

    _kept_ns: int
    _gate: StampGate[Navigation] = field(init=False)
    buffer: NavigationBuffer = field(init=False, factory=NavigationBuffer)

    def __attrs_post_init__(self) -> None:
        self._gate = StampGate(self._kept_ns, _LONGEST_PAUSE_NS, _RESTART_AFTER)

    def add(self, sample: Navigation, counts: Counter[str]) -> bool:
        """Take a sample in; True when the clock was restarted, so that all before is forgotten."""
        decision = self._gate.decide(sample.stamp_ns, sample)
        decision.count_in(counts)
        restarted = decision.verdict == 'restart'
        if restarted:
            self.buffer = NavigationBuffer()
        for released in decision.released:
            counts['poses'] += 1
            self.buffer = self.buffer.inserted(released)
        if self.buffer.stamps:
            self.buffer = self.buffer.since(self.buffer.stamps[-1] - self._kept_ns)
        return restarted

    def nearest(self, stamp_ns: int) -> Navigation:
        """The sample nearest to a stamp."""
        stamps = np.array(self.buffer.stamps)
        return self.buffer.samples[int(np.abs(stamps - stamp_ns).argmin())]


@define(eq=False)
class Georeferencer:
    """Gives what the tracker can use of each measurement; counts what it cannot in `counts`.
    STATE: see `trackers.Tracker`."""

    STATE: ClassVar = (
        'origin',
        '_first',
        '_near',
        '_away',
        '_agree',
        '_metric',
        '_poses',
        '_places',
        '_headings',
        '_waiting',
    )

    config: DiverConfig
    _counts: Counter[str]
    origin: Origin | None = field(init=False)
    _first: Origin | None = field(init=False, default=None)
    _near: int = field(init=False, default=0)
    _away: Origin | None = field(init=False, default=None)
    _agree: int = field(init=False, default=0)
    _metric: bool = field(init=False, default=False)
    _poses: Samples = field(init=False)
    _places: Samples = field(init=False)
    _headings: Samples = field(init=False)
    _waiting: list[RelativeFix] = field(init=False, factory=list)

    def __attrs_post_init__(self) -> None:
        self._first = self.origin = self.config.stated_origin()
        self._poses, self._places, self._headings = (Samples(self._kept_ns) for _ in range(3))

    @property
    def _kept_ns(self) -> int:
        return max(KEPT_NS, nanoseconds(self.config.history))

    def __len__(self) -> int:
        """How many relative fixes wait for the vessel's pose."""
        return len(self._waiting)

    def warnings(self) -> list[str]:
        """What the user has to do, in sentences."""
        sentences = []
        if self._counts['no_origin']:
            sentences.append(
                f'{self._counts["no_origin"]} positions cannot be used: those in metres and those '
                'in latitude and longitude need the parameter origin to stand beside each other'
            )
        if self._counts['origin_moved']:
            sentences.append(
                f'the first positions lie more than {FARTHEST / 1e3:g} km from those after them: '
                'they are taken for wrong, and the origin is that of the others'
            )
        elif count := self._counts['far_from_origin']:
            sentences.append(
                f'{count} positions lie more than {FARTHEST / 1e3:g} km from the origin and are '
                'not used. If they are right, the parameter origin has to be near them'
            )
        if len(self._waiting) > 1 and not self._vessel_known():
            sentences.append(
                f'{len(self._waiting)} relative fixes wait for the pose of the vessel: nav, or '
                'nav_fix and heading, or the parameter vessel: fixed'
            )
        if count := self._counts['heading_unmeasured']:
            sentences.append(
                f'{count} relative fixes cannot be used: the vessel states that its heading is '
                f'not measured (a variance above {UNMEASURED_ANGLE} rad^2). Give another heading, '
                'or correct the covariance'
            )
        if count := self._counts['position_unmeasured']:
            sentences.append(
                f'{count} relative fixes cannot be used: the vessel states that its place is not '
                f'measured (variances from {UNKNOWN_VARIANCE:g} m^2 on). Correct the covariance'
            )
        if self._counts['attitude_unmeasured']:
            sentences.append(
                'the vessel states that roll or pitch is not measured (a variance above '
                f'{UNMEASURED_ANGLE} rad^2): {self.config.vessel_attitude_std_deg:g} degrees are '
                'assumed'
            )
        return sentences

    def georeference(self, measurement: Measurement) -> list[Measurement]:
        """What of `measurement`, and of what waited for it, is ready now, oldest stamp first."""
        ready = self._placed(measurement)
        return [self._gathered(item) for item in ready] if self.config.scan_period > 0.0 else ready

    def _gathered(self, item: Measurement) -> Measurement:
        """A fix without a name at the stamp of its scan, in the middle of its period: that is the
        same in whatever order the fixes come."""
        if not isinstance(item, Fix) or item.target_id != NOBODY:
            return item
        period_ns = nanoseconds(self.config.scan_period)
        scan_ns = item.stamp_ns // period_ns * period_ns + period_ns // 2
        return evolve(item, stamp_ns=scan_ns)

    def _placed(self, measurement: Measurement) -> list[Measurement]:
        """`georeference`, each at its own stamp."""
        if isinstance(measurement, (Fix, Fixes, Arrivals)):
            return [measurement] if self._in_metres() else []
        if isinstance(measurement, VesselPose):
            return self._after(self._poses, measurement)
        if isinstance(measurement, VesselHeading):
            return self._after(self._headings, _turned(measurement))
        if isinstance(measurement, GeodeticFix):
            if not self._in_reach(measurement):
                return []
            if isinstance(measurement, VesselFix):
                return self._after(self._places, self._moved(measurement))
            return [self._fix_of(measurement)] if self._on_earth() else []
        if isinstance(measurement, RelativeFix):
            if len(self._waiting) == MOST_WAITING:
                self._waiting.pop(0)
                self._counts['vessel_pose_missing'] += 1
            self._waiting.append(measurement)
            return self._ready()
        return [measurement]

    # -- where the origin is ---------------------------------------------------------------------

    def _in_reach(self, fix: GeodeticFix) -> bool:
        """Whether a position is near enough to the origin, which the first one is where none is
        stated; counts a refusal. `_AGREE` others in succession move an origin that fewer
        confirm; all that was placed by it is forgotten then (``origin_moved``)."""
        place = Origin(fix.latitude, fix.longitude, self.config.origin[2])
        if self._first is None:
            self._first = place
        if _apart(self._first, place) <= FARTHEST:
            self._near, self._away = self._near + 1, None
            return True
        agrees = self._away is not None and _apart(self._away, place) <= FARTHEST
        self._away, self._agree = place, self._agree + 1 if agrees else 1
        unsure = self.config.stated_origin() is None and self._near < _AGREE
        if not unsure or self._agree < _AGREE:
            self._counts['far_from_origin'] += 1
            return False
        self._counts['origin_moved'] += 1
        self._first, self._near, self._away = place, 1, None
        self.origin = None if self.origin is None else place
        self._places, self._waiting = Samples(self._kept_ns), []
        return True

    def _in_metres(self) -> bool:
        """Whether metres can be used; counts a refusal."""
        if self.origin is not None and self.config.stated_origin() is None:
            self._counts['no_origin'] += 1
            return False
        self._metric = True
        return True

    def _on_earth(self) -> bool:
        """Whether latitude and longitude can be used; the first of them may be the origin."""
        if self.origin is None:
            if self._metric:
                self._counts['no_origin'] += 1
                return False
            self.origin = self._first
        return True

    def _local(self, fix: GeodeticFix) -> tuple[FloatArray, FloatArray | None]:
        """The place (3,) in metres of the origin, and its covariance (3, 3)."""
        origin = self.origin or self._first
        assert origin is not None
        height = origin.height if np.isnan(fix.height) else fix.height
        position = origin.local(fix.latitude, fix.longitude, height)
        if fix.covariance is None:
            return position, None
        turn = origin.turn(fix.latitude, fix.longitude)
        return position, turn @ fix.covariance @ turn.T

    def _fix_of(self, fix: GeodeticFix) -> Fix:
        position, covariance = self._local(fix)
        if covariance is not None and np.isnan(fix.height):
            covariance[2, 2] = np.nan
        return Fix(
            stamp_ns=fix.stamp_ns,
            position=position,
            covariance=covariance,
            target_id=fix.target_id,
            sensor=fix.sensor,
            frame_id=self.config.map_frame,
        )

    def _moved(self, fix: VesselFix) -> VesselPose:
        """A position of the vessel as a pose whose attitude is not meant."""
        position, covariance = self._local(fix)
        whole = np.full((6, 6), np.nan)
        if covariance is not None:
            whole[:3, :3] = covariance
        return VesselPose(
            stamp_ns=fix.stamp_ns,
            position=position,
            orientation=_LEVEL,
            pose_covariance=whole,
            frame_id=self.config.map_frame,
        )

    # -- relative to the vessel ------------------------------------------------------------------

    def _vessel_known(self) -> bool:
        places, headings = self._places.buffer.stamps, self._headings.buffer.stamps
        return bool(self._poses.buffer.stamps or (places and headings))

    def _by_places(self) -> bool:
        """Whether the vessel is known by latitude and longitude, because there is no nav."""
        return self.config.vessel == 'moving' and not self._poses.buffer.stamps

    def _after(self, samples: Samples, pose: Navigation) -> list[Measurement]:
        """Take what an instrument says of the vessel; gives what is ready after it."""
        if samples.add(pose, self._counts):
            self._counts['vessel_pose_gap'] += len(self._waiting)
            self._waiting = []
        return self._ready()

    def _ready(self) -> list[Measurement]:
        done: list[Measurement] = []
        waiting = []
        for fix in self._waiting:
            known = self._readiness(fix.stamp_ns)
            if known == 'wait':
                waiting.append(fix)
            elif known == 'gap':
                self._counts['vessel_pose_gap'] += 1
            elif self._on_earth() if self._by_places() else self._in_metres():
                try:
                    done.append(self._composed(fix, self._vessel(fix.stamp_ns)))
                except Rejection as error:
                    # Poses that leap within nanoseconds lead beyond the Earth.
                    unmeasured = error.reason.endswith('_unmeasured')
                    self._counts[error.reason if unmeasured else 'vessel_pose_gap'] += 1
        self._waiting = waiting
        return sorted(done, key=attrgetter('stamp_ns'))

    def _readiness(self, stamp_ns: int) -> Readiness:
        """Whether the pose of the vessel at a stamp is known, will be, or never will be."""
        if self.config.vessel == 'fixed':
            return 'ready'
        limits = (
            nanoseconds(self.config.vessel_max_gap),
            nanoseconds(self.config.vessel_max_extrapolation),
        )
        parts = (self._places, self._headings) if self._by_places() else (self._poses,)
        known = [part.buffer.readiness(stamp_ns, stamp_ns, *limits) for part in parts]
        return 'wait' if 'wait' in known else 'gap' if 'gap' in known else 'ready'

    def _vessel(self, stamp_ns: int) -> _Vessel:
        config = self.config
        if config.vessel == 'fixed':
            level, nothing = Pose(np.zeros(3), np.eye(3)), np.zeros((3, 3))
            return _Vessel(level, Uncertainty(nothing, nothing), config.map_frame, np.eye(3))
        attitude, heading = np.radians(
            [config.vessel_attitude_std_deg, config.vessel_heading_std_deg]
        )
        assumed = Uncertainty(
            np.eye(3) * config.vessel_position_std**2,
            np.diag([attitude**2, attitude**2, heading**2]),
        )
        places = self._by_places()
        where = self._places if places else self._poses
        lies = self._headings if places else self._poses
        position, R = where.buffer.pose(stamp_ns).position, lies.buffer.pose(stamp_ns).R
        near = where.nearest(stamp_ns)
        stated = Uncertainty(
            _stated(near, slice(0, 3), assumed.position),
            self._stated_attitude(lies.nearest(stamp_ns), assumed.attitude),
        )
        if not places:
            return _Vessel(Pose(position, R), stated, near.frame_id, np.eye(3))
        assert self.origin is not None
        axes = self.origin.axes(*self.origin.geodetic(position)[:2])
        turn = axes @ self._true_north()
        stated = stated._replace(attitude=turn @ stated.attitude @ turn.T)
        return _Vessel(Pose(position, turn @ R), stated, near.frame_id, axes)

    def _stated_attitude(self, sample: Navigation, assumed: FloatArray) -> FloatArray:
        """Return the covariance (3, 3) of the attitude, with the assumed variance of roll or pitch
        where it is not measured. An unmeasured heading keeps its variance."""
        stated = _stated(sample, slice(3, 6), assumed)
        level = np.diag(stated)[:2] > UNMEASURED_ANGLE
        if level.any():
            self._counts['attitude_unmeasured'] += 1
            stated, axes = stated.copy(), np.flatnonzero(level)
            stated[axes] = stated[:, axes] = 0.0
            stated[axes, axes] = np.diag(assumed)[axes]
        return stated

    def _true_north(self) -> FloatArray:
        """(3, 3) that turns vectors in magnetic axes into true east, north, up."""
        return geometry.rotation(0.0, 0.0, -np.radians(self.config.magnetic_declination_deg))

    def _composed(self, fix: RelativeFix, vessel: _Vessel) -> Fix:
        config = self.config
        mounting = Mounting(
            np.array(config.transceiver_lever),
            geometry.rotation(*np.radians(config.transceiver_mount_rpy_deg)),
            config.transceiver_lever_std,
        )
        offset, covariance = fix.offset, fix.covariance
        needs_heading = not fix.levelled or mounting.lever.any()
        if needs_heading and vessel.uncertainty.attitude[2, 2] > UNMEASURED_ANGLE:
            raise Rejection('heading_unmeasured', 'the heading of the vessel is not measured')
        if (np.diag(vessel.uncertainty.position)[:2] >= UNKNOWN_VARIANCE).all():
            raise Rejection('position_unmeasured', 'the place of the vessel is not measured')
        if fix.levelled:
            turn = vessel.axes @ self._true_north()
            offset = turn @ offset
            covariance = None if covariance is None else turn @ covariance @ turn.T
        placed = place(
            vessel.pose,
            vessel.uncertainty,
            mounting,
            offset,
            covariance,
            range_std=config.relative_range_std,
            angle_std=float(np.radians(config.relative_angle_std_deg)),
            levelled=fix.levelled,
        )
        return Fix(
            stamp_ns=fix.stamp_ns,
            position=placed.position,
            covariance=placed.covariance,
            target_id=fix.target_id,
            sensor=fix.sensor,
            frame_id=vessel.frame_id,
            seen_from=(vessel.pose.position + vessel.pose.R @ mounting.lever)[:2],
        )


def _apart(one: Origin, other: Origin) -> float:
    """The distance of two places, m, along a straight line."""
    return float(np.linalg.norm(one.local(other.latitude, other.longitude, other.height)))


def _turned(heading: VesselHeading) -> VesselPose:
    """An attitude of the vessel as a pose whose position is not meant."""
    whole = np.full((6, 6), np.nan)
    if heading.covariance is not None:
        whole[3:, 3:] = heading.covariance
    return VesselPose(
        stamp_ns=heading.stamp_ns,
        position=np.zeros(3),
        orientation=heading.orientation,
        pose_covariance=whole,
    )


def _stated(sample: Navigation, part: slice, assumed: FloatArray) -> FloatArray:
    """The part (3, 3) of a pose's covariance, where it is filled in, else what is assumed."""
    whole = sample.pose_covariance
    return filled(None if whole is None else whole[part, part], assumed)
