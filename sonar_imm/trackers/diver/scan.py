# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Measurements of one stamp as arrays.

A `Scan` holds the measurements of a stamp in processing order: groups of fixes with at most one
per target, pings, and starts.

A ping is a table of measurements (`Ping`), in the order of their content (`Arrivals.in_order`).
The message order of arrivals does not change the result.
"""

from __future__ import annotations

from collections.abc import Sequence
import math
from typing import NamedTuple

from attrs import define, evolve, field
import numpy as np

from ...acoustics.arrivals_3d import BEARING, ELEVATION, HEIGHT, ONE_WAY, PATH
from ...estimation.arrays import BoolArray, FloatArray, IndexArray, IntArray
from ...measurements import Arrivals, Fix, Fixes, Measurement, NOBODY, scan_of, Start
from .config import DiverConfig
from .coverage_map import DetectionProbability
from .explanations import PingMeasurements
from .instruments import Layout
from .known import Known, Prediction
from .models import ModelSet
from .pairs import Association, Pairs
from .sensors import Sensors

LEAST_VAR_TOA = 1e-13
"""Minimum variance of an arrival time, s^2: 0.5 mm of path. Below it, the joint covariance with a
tag emission is singular."""

MOST_MEASUREMENTS = 128
"""Maximum number of measurements of one ping. Computation grows up to their third power."""

OUTLIER_DENSITY = 1.0 / 50.0
"""Density of an outlier path length, 1/m: up to 50 m late."""


class Height(NamedTuple):
    """The z of a fix."""

    value: float
    """z, m."""
    gain: FloatArray
    """(2,) regression of the z error on the errors of x and y."""
    rest: float
    """Residual variance, m^2."""

    def variance(self, covariance: FloatArray) -> float:
        """Return the variance of z, for x and y with `covariance` (2, 2)."""
        return self.rest + float(self.gain @ covariance @ self.gain)


class Heights(NamedTuple):
    """The z of D fixes, see `Height`."""

    value: FloatArray
    """(D,) z, m; NaN for none."""
    gain: FloatArray
    """(D, 2)."""
    rest: FloatArray
    """(D,) m^2."""

    @classmethod
    def from_fixes(
        cls, position: FloatArray, covariance: FloatArray, factor: float
    ) -> Heights | None:
        """Return the heights of fixes at `position` (D, 3), `covariance` (D, 3, 3) times `factor`;
        None if no fix has a z."""
        variance = covariance[:, 2, 2]
        stated = np.isfinite(variance)
        if not stated.any():
            return None
        flat, across = covariance[:, :2, :2], covariance[:, :2, 2]
        both = stated & np.isfinite(across).all(axis=1)
        gain = np.zeros((len(position), 2))
        gain[both] = np.linalg.solve(flat[both], across[both][..., None])[..., 0]
        rest = variance - np.where(
            both, (gain * np.where(both[:, None], across, 0.0)).sum(axis=1), 0.0
        )
        return cls(np.where(stated, position[:, 2], np.nan), gain, rest * factor)

    def row(self, d: int) -> Height | None:
        """Return the height of one fix; None if it has no z."""
        if not math.isfinite(self.value[d]):
            return None
        return Height(float(self.value[d]), self.gain[d], float(self.rest[d]))


class Fit(NamedTuple):
    """Minima of single ranges (`ranges`): K states (x, y, vx, vy) at the last range."""

    x: FloatArray
    """(K, 4)."""
    P: FloatArray
    """(K, 4, 4)."""
    weight: FloatArray
    """(K,) probabilities."""


class Birth(NamedTuple):
    """Position of a possible new track."""

    position: FloatArray
    """(2,) m."""
    covariance: FloatArray
    """(2, 2) m^2."""
    ping: Arrivals | None = None
    """The ping of the position; None for a fix."""
    rows: IndexArray | None = None
    """Rows of the ping that give the position."""
    existence: float = math.nan
    """Probability that the target exists; NaN if hits are counted."""
    target_id: int = NOBODY
    """ID of the target, or `NOBODY`."""
    measured: bool = True
    """False for a `Start` message."""
    height: Height | None = None
    """The z of the fix; None if the fix has no z."""
    seen_by: tuple[str, FloatArray] | None = None
    """Name and position (2,) of a sensor with a bearing error; None for others."""
    number: int = 0
    """Number of the sensor (`sensors`)."""
    mark: int = 0
    """Number of the fix of the birth, for links to its track (`bursts`); 0 for none."""
    fit: Fit | None = None
    """Minima of single ranges; None for other births."""


MOST_BIRTHS = 1.5
"""Maximum ratio of birth density and estimated clutter density."""

FIRST_LOOK = 10.0
"""Time, s, over which targets have arrived before the first scan of a sensor, and the longest
before a later one."""


@define(eq=False)
class Group:
    """D fixes of one stamp and sensor, with at most one per target.

    The tracker sets `number`. Later stages use the slots `learnt_clutter` and `elapsed`
    (`clutter`), `detection` (`coverage`), `pairs` and `association` (`fixes`), and `births`. One
    stage writes each slot.
    """

    z: FloatArray
    """(D, 2) positions, m."""
    R: FloatArray
    """(D, 2, 2) covariances, m^2."""
    config: DiverConfig
    """Parameters of the sensor."""
    target_id: IntArray | None
    """(D,) IDs of the targets; None if no fix has an ID."""
    is_complete: bool
    """True if the group is a whole scan, so that a target without a fix was missed."""
    heights: Heights | None = None
    """The z of the fixes; None without z, or in 2D."""
    sensor: str = ''
    """Name of the sensor."""
    seen_from: FloatArray | None = None
    """(2,) sensor position; None if unknown."""
    is_stated: bool = True
    """True if a fix states its covariance."""
    learnt_clutter: FloatArray | None = field(default=None, init=False)
    """(D,) estimated clutter density at each fix, 1/m^2; None if none is estimated."""
    elapsed: float = field(default=FIRST_LOOK, init=False)
    """Time since the scan before of this sensor, s."""
    number: int = field(default=0, init=False)
    """Number of the sensor (`sensors`)."""
    detection: DetectionProbability | None = field(default=None, init=False)
    pairs: Pairs | None = field(default=None, init=False)
    association: Association | None = field(default=None, init=False)
    births: list[Birth] = field(factory=list, init=False)

    @property
    def rotation_sensor(self) -> tuple[str, FloatArray] | None:
        """Name and position (2,) of a sensor with a bearing error; None without error or
        position."""
        if not self.config.bearing_bias_std_deg or self.seen_from is None:
            return None
        return self.sensor, self.seen_from

    @property
    def clutter(self) -> FloatArray:
        """(D,) clutter density at each fix, 1/m^2."""
        if self.learnt_clutter is None:
            return np.full(len(self.z), self.config.usual_clutter)
        return self.learnt_clutter

    @property
    def new_targets(self) -> float:
        """Density of the targets that arrived since the scan before, 1/m^2."""
        return self.config.birth_density * self.elapsed

    @property
    def birth_density(self) -> FloatArray:
        """(D,) density of new targets at each fix, 1/m^2.

        If the clutter density is estimated, the ratio to it is limited. With almost no false
        fixes, an unlimited birth density would attribute the fixes of known targets to new ones.
        """
        if self.config.clutter_density:
            return np.full(len(self.z), self.new_targets)
        return np.minimum(self.new_targets, MOST_BIRTHS * self.clutter)


@define(eq=False)
class Scan:
    """The measurements of one stamp.

    Later stages use the slots `previous`, `prediction` and `births`.
    """

    fixes: list[Group]
    """Groups of fixes."""
    pings: list[Arrivals]
    """Pings with rows in order, one per tag."""
    starts: list[Start]
    """Start messages."""
    names: list[int]
    """Target IDs of fixes and pings."""
    complete: bool
    """True if a track without a measurement was missed."""
    numbers: set[int] = field(factory=set, init=False)
    """Numbers of the sensors."""
    previous: Known = field(init=False)
    """State before the scan."""
    prediction: Prediction = field(init=False)
    """Prediction to the scan."""
    births: list[Birth] = field(factory=list, init=False)
    """Births from pings."""

    @property
    def are_tags(self) -> bool:
        """True for pings of tags alone: each is of one of the targets."""
        return not self.fixes and all(ping.passive for ping in self.pings)

    def number_sensors(self, known: Sensors) -> Sensors:
        """Number the sensors of the scan; arrivals are of the sensor without a name.

        Return all sensors.
        """
        for name in [group.sensor for group in self.fixes] + [''] * bool(self.pings):
            known = known.with_sensor(name)
            self.numbers.add(known.number(name))
        for group in self.fixes:
            group.number = known.number(group.sensor)
        return known

    @classmethod
    def from_items(cls, items: Sequence[Measurement], config: DiverConfig) -> Scan:
        """Build the scan of `items`."""
        fixes, names = position_groups(items, config), []
        for group in fixes:
            if group.target_id is not None:
                names += group.target_id.tolist()
        pings: list[Arrivals] = []
        starts: list[Start] = []
        complete = any(group.is_complete and group.target_id is None for group in fixes)
        for item in items:
            if isinstance(item, Arrivals):
                pings += _split_by_tag(item.in_order())
            elif isinstance(item, Start):
                starts.append(item)
        for ping in pings:
            name = tag_id(ping)
            complete |= config.fixes_are_scans and name == NOBODY
            if name != NOBODY:
                names.append(name)
        return cls(fixes, pings, starts, names, complete)


def tag_id(ping: Arrivals) -> int:
    """Return the ID of the tag; `NOBODY` for echoes and for tags without an ID."""
    return int(ping.tx_id[0]) if ping.passive and int(ping.tx_id[0]) != 0 else NOBODY


def _split_by_tag(ping: Arrivals) -> list[Arrivals]:
    """Split a ping of several tags."""
    tags = np.unique(ping.tx_id) if ping.passive else ping.tx_id[:1]
    return [ping.only(ping.tx_id == tag) for tag in tags] if len(tags) > 1 else [ping]


# -- fixes ---------------------------------------------------------------------------------------


def position_groups(items: Sequence[Measurement], config: DiverConfig) -> list[Group]:
    """Group the fixes of one stamp: single fixes by sensor, then each scan with and without
    IDs."""
    groups: list[Group] = []
    single: dict[str, list[Fix]] = {}
    for item in items:
        if isinstance(item, Fix):
            single.setdefault(item.sensor, []).append(item)
    for sensor in sorted(single):
        own = config.of_sensor(sensor)
        nameless = []
        for fix in single[sensor]:
            if fix.target_id == NOBODY:
                nameless.append(fix)
            else:
                group = _make_group(scan_of(fix), np.arange(1), own, named=True)
                groups.append(_with_sensor_position(fix, group))
        if nameless:
            groups.append(_group_single_fixes(nameless, own))
    for item in items:
        if isinstance(item, Fixes):
            groups += _split_by_id(item, config.of_sensor(item.sensor))
    return groups


def _split_by_id(scan: Fixes, config: DiverConfig) -> list[Group]:
    """Split a scan into fixes with IDs, the first of each ID, and fixes without."""
    if scan.target_id is None:
        return [_make_group(scan, np.arange(len(scan)), config, named=False)]
    known = np.flatnonzero(scan.target_id != NOBODY)
    _, first = np.unique(scan.target_id[known], return_index=True)
    groups = [_make_group(scan, known[first], config, named=True)] if len(known) else []
    if len(known) < len(scan) or not len(scan):
        nameless = np.flatnonzero(scan.target_id == NOBODY)
        groups.append(_make_group(scan, nameless, config, named=False))
    return groups


def _make_group(scan: Fixes, rows: IndexArray, config: DiverConfig, *, named: bool) -> Group:
    """Return a group of rows of a scan, with IDs or as a complete scan."""
    position, covariance = scan.position[rows], np.full((len(rows), 3, 3), np.nan)
    if scan.covariance is not None:
        covariance = scan.covariance[rows]
    R = np.ascontiguousarray(covariance[:, :2, :2])
    stated = np.isfinite(R).all(axis=(1, 2))
    R[~stated] = np.eye(2) * config.fix_std**2
    heights = (
        Heights.from_fixes(position, covariance, config.covariance_scale)
        if config.dimensions == 3
        else None
    )
    target_id = np.asarray(scan.target_id)[rows] if named else None
    z = np.ascontiguousarray(position[:, :2])
    named_rows = target_id, not named, heights, scan.sensor, _sensor_position(config)
    is_stated = bool(stated.any())
    return Group(z, R * config.covariance_scale, config, *named_rows, is_stated=is_stated)


def _group_single_fixes(fixes: Sequence[Fix], config: DiverConfig) -> Group:
    """Return single fixes of one sensor as one group."""
    unknown = np.eye(2) * config.fix_std**2
    z = np.empty((len(fixes), 2))
    R = np.empty((len(fixes), 2, 2))
    is_stated = False
    for row, fix in enumerate(fixes):
        z[row] = fix.position[:2]
        stated = None if fix.covariance is None else fix.covariance[:2, :2]
        if stated is None or math.isnan(stated[0, 0]):
            R[row] = unknown
        else:
            R[row], is_stated = stated, True
    heights, factor = None, config.covariance_scale
    if config.dimensions == 3:
        nothing = np.full((3, 3), np.nan)
        whole = [nothing if fix.covariance is None else fix.covariance for fix in fixes]
        heights = Heights.from_fixes(
            np.array([fix.position for fix in fixes]), np.array(whole), factor
        )
    more = None, config.fixes_are_scans, heights, fixes[0].sensor, _sensor_position(config)
    return _with_sensor_position(
        fixes[0], Group(z, R * factor, config, *more, is_stated=is_stated)
    )


def _with_sensor_position(fix: Fix, group: Group) -> Group:
    """Return the group with the sensor position of `fix`."""
    return group if fix.seen_from is None else evolve(group, seen_from=fix.seen_from)


def _sensor_position(config: DiverConfig) -> FloatArray | None:
    """Return the sensor position (2,) of the coverage sector; None without a sector."""
    return np.array(config.coverage_sector[:2]) if config.coverage_sector else None


# -- pings ---------------------------------------------------------------------------------------


class Ping(NamedTuple):
    """Measurements of a ping, in the order of their content."""

    measured: PingMeasurements
    """Table of C measurements."""
    row: IntArray
    """(C,) row of the ping of each measurement."""
    passive: bool
    """True for a tag."""
    pairs: int
    """Number of received transmitter-receiver pairs."""

    def select(self, keep: BoolArray) -> Ping:
        """Return the measurements `keep` (C,), without orphans."""
        keep = self.without_orphans(keep)
        place = np.cumsum(keep) - 1
        left = PingMeasurements._make(
            np.ascontiguousarray(column[keep]) for column in self.measured
        )
        left = left._replace(parent=np.where(left.parent >= 0, place[left.parent], -1))
        pairs = len(np.unique(left.node[left.kind <= ONE_WAY]))
        return Ping(left, self.row[keep], self.passive, pairs)

    def without_orphans(self, keep: BoolArray) -> BoolArray:
        """Return `keep` (C,) without measurements whose parent is not kept."""
        parent = self.measured.parent
        orphaned = (parent >= 0) & ~keep[parent]
        return np.asarray(keep & ~orphaned)

    def subsample(self, keep: BoolArray) -> Ping:
        """Return the measurements `keep` (C,), at most `MOST_MEASUREMENTS`, evenly spaced."""
        if np.count_nonzero(keep) > MOST_MEASUREMENTS:
            keep = np.isin(np.arange(len(keep)), subsample(np.flatnonzero(keep)))
        return self.select(keep)

    @property
    def nodes(self) -> IntArray:
        """Numbers of the received pairs."""
        return np.unique(self.measured.node[self.echo])

    @property
    def echo(self) -> BoolArray:
        """(C,) True for path lengths, which indicate a target."""
        return np.asarray(self.measured.kind <= ONE_WAY)


def ping_measurements(
    ping: Arrivals,
    rows: IndexArray,
    config: DiverConfig,
    models: ModelSet,
    layout: Layout,
) -> Ping:
    """Return the usable `rows` of a ping as measurements."""
    usable = rows[np.isfinite(ping.toa[rows])]
    if not ping.passive:
        usable = usable[np.isfinite(ping.tx[usable]).all(axis=1)]
    if ping.passive:
        usable = subsample(usable[np.argsort(ping.rx_id[usable], kind='stable')])
    speed = config.sound_speed
    first = ping.toa[usable].min(initial=np.inf) if ping.passive else 0.0
    variance = toa_variance(ping, config)[usable] * speed**2
    deep = models.height >= 0
    table: list[tuple[int, int, int, float, float, float, int]] = []
    if deep:
        span = max(config.depth_max - config.depth_min, 1.0)
        for value, noise, row in _depth_reports(ping, usable):
            table.append((0, -1, HEIGHT, -value, noise, 1.0 / span, row))
    pair = np.column_stack([ping.tx_id, ping.rx_id])[usable].astype(np.int64)
    if ping.passive:
        pair[:, 0] = 0
    new = np.ones(len(usable), bool)
    new[1:] = (pair[1:] != pair[:-1]).any(axis=1)
    node = np.cumsum(new)
    var_bearing = bearing_variance(ping, config)
    kind = ONE_WAY if ping.passive else PATH
    for at in range(1, int(node[-1]) + 1 if len(node) else 1):
        members = np.flatnonzero(node == at)
        parents = []
        for k in members.tolist():
            parents.append(len(table))
            path = speed * (ping.toa[usable[k]] - first)
            table.append((4 * at, -1, kind, path, variance[k], OUTLIER_DENSITY, int(usable[k])))
        for parent, row in zip(parents, usable[members].tolist()):
            if np.isfinite(ping.bearing[row]):
                bearing = (BEARING, ping.bearing[row], var_bearing[row], 0.5 / np.pi)
                table.append((len(table) + 10**6, parent, *bearing, row))
            if deep and np.isfinite(ping.elevation[row]) and ping.var_elevation[row] > 0.0:
                elevation = (ELEVATION, ping.elevation[row], ping.var_elevation[row], 1.0 / np.pi)
                table.append((len(table) + 10**6, parent, *elevation, row))
    columns = [np.array(column) for column in zip(*table)] if table else [np.empty(0)] * 7
    row_of = columns[6].astype(np.intp)
    measured = PingMeasurements(
        node=columns[0].astype(np.int64),
        parent=columns[1].astype(np.int64),
        kind=columns[2].astype(np.int64),
        value=columns[3].astype(np.float64),
        variance=columns[4].astype(np.float64),
        density=columns[5].astype(np.float64),
        tx=np.ascontiguousarray(ping.tx[row_of]),
        rx=np.ascontiguousarray(ping.rx[row_of]),
        columns=layout.measurement_columns(
            models, ping.rx_id[row_of], ping.passive, columns[2] == BEARING
        ),
    )
    return Ping(measured, row_of, ping.passive, int(new.sum()))


def _depth_reports(ping: Arrivals, rows: IndexArray) -> list[tuple[float, float, int]]:
    """Return depth, variance and first row of each distinct depth report of a ping.

    Each arrival repeats the report, which is one measurement.
    """
    reports: dict[tuple[float, float], int] = {}
    for row in rows.tolist():
        depth, variance = float(ping.depth[row]), float(ping.var_depth[row])
        if np.isfinite(depth) and variance > 0.0:
            reports.setdefault((depth, variance), row)
    return [(*report, reports[report]) for report in sorted(reports)]


def subsample(rows: IndexArray) -> IndexArray:
    """Return at most `MOST_MEASUREMENTS` of the rows (n,), evenly spaced, in order."""
    if len(rows) <= MOST_MEASUREMENTS:
        return rows
    return rows[np.linspace(0.0, len(rows) - 1.0, MOST_MEASUREMENTS).round().astype(np.intp)]


def systematic_variance(ping: Arrivals, config: DiverConfig) -> FloatArray:
    """Return the variance (n,), s^2, of arrival times due to instrument errors, which one ping
    cannot separate from noise."""
    relative = config.sound_speed_std / config.sound_speed
    late = np.where(np.isfinite(ping.toa), ping.toa - (ping.passive and np.nanmin(ping.toa)), 0.0)
    return np.asarray(
        (config.receiver_position_std / config.sound_speed) ** 2
        + config.receiver_clock_std**2
        + (relative * late) ** 2
    )


def toa_variance(ping: Arrivals, config: DiverConfig) -> FloatArray:
    """Return the variance (n,) of arrival times, s^2: the reported variance, at least
    `LEAST_VAR_TOA`."""
    known = np.isfinite(ping.var_toa) & (ping.var_toa > 0.0)
    stated = np.where(known, np.maximum(ping.var_toa, LEAST_VAR_TOA), config.toa_std**2)
    return np.asarray(stated * config.covariance_scale)


def bearing_variance(ping: Arrivals, config: DiverConfig) -> FloatArray:
    """Return the variance (n,) of bearings, rad^2: the reported variance, if any."""
    known = np.isfinite(ping.var_bearing) & (ping.var_bearing > 0.0)
    return np.asarray(np.where(known, ping.var_bearing, np.deg2rad(config.bearing_std_deg) ** 2))
