"""From a scan to numbers a filter can use: groups of detections of which each target causes at
most one.

All fixes of a stamp are one group; of a multistatic ping, each transmitter-receiver pair is a
group of its own, so that updates go through the receivers one after the other; a tag's ping is a
group with a single detection, its time differences. A `Group` predicts its measurement for every
model of every target and linearises it there, which is all that gating, association and the
extended Kalman update need.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from attrs import field, frozen
import numpy as np

from ...acoustics import multistatic
from ...acoustics.localisation import Localisation, localise
from ...estimation.angles import wrap_angle
from ...estimation.arrays import FloatArray
from ...measurements import Arrivals, Fix, Fixes, Measurement, NOBODY, scan_of
from .config import DiverConfig


@frozen(eq=False)
class Group:
    """D detections of m numbers each: z (D, m), R (D, m, m); `clutter` density of false ones, 0
    where each detection is known to be a target's.

    kind: index of the sensor, 0 fixes, 1 arrivals; factor: what the stated covariances were
    multiplied by to give R; ping, rows: where the detections come from, when from a ping.
    """

    z: FloatArray
    R: FloatArray
    clutter: float
    kind: int
    factor: float = 1.0
    ping: Arrivals | None = None
    rows: np.ndarray = field(factory=lambda: np.empty(0, np.intp))

    def linearise(self, x: FloatArray, E: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Expected measurement (T, M, m) of states x (T, M, n) and its Jacobian (T or 1, M, m,
        n)."""
        raise NotImplementedError

    def innovation(self, expected: FloatArray, detection: np.ndarray) -> FloatArray:
        """z - h for the chosen `detection` (T,) of each target, (T, M, m)."""
        return self.z[detection][:, None, :] - expected


@frozen(eq=False)
class Positions(Group):
    """Fixes: z is x and y.

    target_id: (D,) whose they are, None when that is not known of any; whole: whether they are all
    that there was to see, so that a diver without one was missed.
    """

    target_id: np.ndarray | None = None
    whole: bool = True

    def linearise(self, x: FloatArray, E: FloatArray) -> tuple[FloatArray, FloatArray]:
        H = E[:, :2]
        return np.einsum('jma,tja->tjm', H, x), H[None]


@frozen(eq=False, kw_only=True)
class RangeSums(Group):
    """Echoes of one transmitter at one receiver (3,) each: z is the length of the path, metres.

    bearing, var_bearing (D,): rad and rad^2, NaN where not measured.
    """

    tx: FloatArray
    rx: FloatArray
    target_z: float
    bearing: FloatArray
    var_bearing: FloatArray

    def linearise(self, x: FloatArray, E: FloatArray) -> tuple[FloatArray, FloatArray]:
        position = np.einsum('jma,tja->tjm', E[:, :2], x)
        tx, rx = self.tx[None], self.rx[None]
        slope = multistatic.range_sum_jacobian(position, tx, rx, self.target_z)
        return multistatic.range_sum(position, tx, rx, self.target_z), slope @ E[:, :2]

    def bearings(self) -> Bearings:
        """The bearings that came with these echoes, detection by detection."""
        return Bearings(
            z=self.bearing[:, None],
            R=self.var_bearing[:, None, None],
            clutter=self.clutter,
            kind=self.kind,
            factor=self.factor,
            rx=self.rx,
        )


@frozen(eq=False, kw_only=True)
class Bearings(Group):
    """Bearings at one receiver (3,), radians."""

    rx: FloatArray

    def linearise(self, x: FloatArray, E: FloatArray) -> tuple[FloatArray, FloatArray]:
        position = np.einsum('jma,tja->tjm', E[:, :2], x)
        return (
            multistatic.bearing(position, self.rx[None]),
            multistatic.bearing_jacobian(position, self.rx[None]) @ E[:, :2],
        )

    def innovation(self, expected: FloatArray, detection: np.ndarray) -> FloatArray:
        return wrap_angle(super().innovation(expected, detection))


@frozen(eq=False, kw_only=True)
class TagPing(Group):
    """One-way arrivals of a tag that emits at an unknown time: their whitened differences."""

    rx: FloatArray
    target_z: float
    difference: multistatic.DifferenceMeasurement

    def linearise(self, x: FloatArray, E: FloatArray) -> tuple[FloatArray, FloatArray]:
        position = np.einsum('jma,tja->tjm', E[:, :2], x)
        return (
            self.difference.predict(position, self.rx, self.target_z),
            self.difference.jacobian(position, self.rx, self.target_z) @ E[:, :2],
        )


def groups_of(
    items: Sequence[Measurement], config: DiverConfig, factor: FloatArray
) -> list[Sequence[Group]]:
    """The groups of one stamp, message by message (all single fixes are one), in an order that
    depends on content only.

    factor (2,): learnt factor on the covariances of fixes and of arrivals.
    """
    scale = config.covariance_scale * factor
    said: list[Sequence[Group]] = []
    fixes = [item for item in items if isinstance(item, Fix)]
    if fixes:
        said.append([_positions(fixes, config, scale[0])])
    for scan in (item for item in items if isinstance(item, Fixes)):
        said += [[group] for group in scan_groups(scan, config, scale[0])]
    for ping in (item for item in items if isinstance(item, Arrivals)):
        if ping.passive:
            usable = np.flatnonzero(np.isfinite(ping.toa))
            said += [[_tag_ping(ping, usable, config, scale[1])]] if len(usable) > 1 else []
        else:
            said.append(list(_range_sums(ping, config, scale[1])))
    return said


def as_fix(group: TagPing, config: DiverConfig) -> Positions | None:
    """The same ping as one fix, without the arrivals that do not fit the others; None where the
    arrivals do not give one, or more than one."""
    fix = locate(group.ping, group.rows, config, group.factor)
    if fix is None or fix.ambiguous:
        return None
    return Positions(
        z=fix.position[None],
        R=fix.covariance[None],
        clutter=0.0,
        kind=group.kind,
        factor=group.factor,
        ping=group.ping,
        rows=group.rows,
    )


def locate(
    ping: Arrivals, rows: np.ndarray, config: DiverConfig, factor: float
) -> Localisation | None:
    """The fix that `rows` of the ping give by themselves, None when they give none to believe."""
    fix = localise(
        ping.rx[rows],
        ping.toa[rows],
        toa_variance(ping, config, factor)[rows],
        tx=ping.tx[rows],
        bearing=ping.bearing[rows],
        var_bearing=bearing_variance(ping, config)[rows],
        target_z=config.target_z,
        sound_speed=config.sound_speed,
    )
    return fix if isinstance(fix, Localisation) else None


def toa_variance(ping: Arrivals, config: DiverConfig, factor: float) -> FloatArray:
    """Variance (n,) of the arrival times, s^2: the sender's where given."""
    known = np.isfinite(ping.var_toa) & (ping.var_toa > 0.0)
    return np.asarray(np.where(known, ping.var_toa, config.toa_std**2) * factor)


def bearing_variance(ping: Arrivals, config: DiverConfig) -> FloatArray:
    """Variance (n,) of the bearings, rad^2: the sender's where given."""
    known = np.isfinite(ping.var_bearing) & (ping.var_bearing > 0.0)
    return np.asarray(np.where(known, ping.var_bearing, np.deg2rad(config.bearing_std_deg) ** 2))


def scan_groups(scan: Fixes, config: DiverConfig, factor: float) -> list[Positions]:
    """The fixes that say whose they are, of each diver the first, and those that do not."""
    R = _covariances(scan, config) * factor
    if scan.target_id is None or not len(scan):
        return [_group(scan.position, R, config, factor)]
    groups = []
    said = np.flatnonzero(scan.target_id != NOBODY)
    if len(said):
        names, first = np.unique(scan.target_id[said], return_index=True)
        rows = said[first]
        groups.append(_group(scan.position[rows], R[rows], config, factor, names, False))
    if len(said) < len(scan):
        rows = np.flatnonzero(scan.target_id == NOBODY)
        groups.append(_group(scan.position[rows], R[rows], config, factor))
    return groups


def _positions(fixes: Sequence[Fix], config: DiverConfig, factor: float) -> Positions:
    scans = [scan_of(fix) for fix in fixes]
    return _group(
        np.concatenate([scan.position for scan in scans]),
        np.concatenate([_covariances(scan, config) for scan in scans]) * factor,
        config,
        factor,
        whole=config.fixes_are_scans,
    )


def _group(
    position: FloatArray,
    R: FloatArray,
    config: DiverConfig,
    factor: float,
    target_id: np.ndarray | None = None,
    whole: bool = True,
) -> Positions:
    return Positions(
        z=np.ascontiguousarray(position[:, :2]),
        R=R,
        clutter=config.clutter_density,
        kind=0,
        factor=factor,
        target_id=target_id,
        whole=whole,
    )


def _covariances(scan: Fixes, config: DiverConfig) -> FloatArray:
    """Covariances (n, 2, 2) as stated, else by `fix_std`."""
    unknown = np.eye(2) * config.fix_std**2
    if scan.covariance is None:
        return np.tile(unknown, (len(scan), 1, 1))
    known = np.isfinite(scan.covariance).all(axis=(1, 2))
    return np.where(known[:, None, None], scan.covariance, unknown)


def _range_sums(ping: Arrivals, config: DiverConfig, factor: float) -> Iterator[RangeSums]:
    variance = toa_variance(ping, config, factor) * config.sound_speed**2
    pair = np.column_stack([ping.tx_id, ping.rx_id])
    usable = np.isfinite(ping.toa) & np.isfinite(ping.tx).all(axis=1)
    for one in np.unique(pair[usable], axis=0):
        rows = np.flatnonzero(usable & (pair == one).all(axis=1))
        yield RangeSums(
            z=config.sound_speed * ping.toa[rows, None],
            R=variance[rows, None, None],
            clutter=np.sqrt(config.clutter_density),
            kind=1,
            factor=factor,
            ping=ping,
            rows=rows,
            tx=ping.tx[rows[0]],
            rx=ping.rx[rows[0]],
            target_z=config.target_z,
            bearing=ping.bearing[rows],
            var_bearing=bearing_variance(ping, config)[rows],
        )


def _tag_ping(ping: Arrivals, rows: np.ndarray, config: DiverConfig, factor: float) -> TagPing:
    difference = multistatic.difference_measurement(
        ping.toa[rows], toa_variance(ping, config, factor)[rows], config.sound_speed
    )
    return TagPing(
        z=difference.z[None],
        R=difference.R[None],
        clutter=0.0,  # a tag says who it is
        kind=1,
        factor=factor,
        ping=ping,
        rows=rows,
        rx=ping.rx[rows],
        target_z=config.target_z,
        difference=difference,
    )
