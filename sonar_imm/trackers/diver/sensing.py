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

"""From measurements to numbers a filter can use: fixes as one group of detections, a ping located
by itself, variances where the sender states none."""

from __future__ import annotations

from collections.abc import Sequence

from attrs import frozen
import numpy as np

from ...acoustics.localisation import Localisation, localise
from ...estimation.arrays import FloatArray, IndexArray, IntArray
from ...measurements import Arrivals, Fix, Fixes, Measurement, NOBODY, scan_of
from .config import DiverConfig
from .state_space import heights_of

LEAST_VAR_TOA = 1e-13
"""Least variance of an arrival time, s^2: half a millimetre of path. Below it a joint covariance
with the unknown emission of a tag has no inverse."""

_ALL = slice(None)

MOST_NUMBERS = 128
"""Numbers of one ping that are used at once: time and memory grow with them, by the third power
where their joint covariance is needed."""


def spread(rows: IndexArray) -> IndexArray:
    """At most `MOST_NUMBERS` of the rows (n,), evenly chosen, in their order."""
    if len(rows) <= MOST_NUMBERS:
        return rows
    return rows[np.linspace(0.0, len(rows) - 1.0, MOST_NUMBERS).round().astype(np.intp)]


@frozen(eq=False)
class Positions:
    """D fixes of one stamp, of which each target causes at most one: z (D, 2), R (D, 2, 2);
    clutter: density of false ones; factor: what the stated covariances were multiplied by to give
    R. target_id: (D,) whose they are, None when that is not known of any; whole: whether they are
    all that there was to see, so that a diver without one was missed; sensor: which has seen
    them."""

    z: FloatArray
    R: FloatArray
    clutter: float
    factor: float = 1.0
    target_id: IntArray | None = None
    whole: bool = True
    sensor: str = ''


def position_groups(
    items: Sequence[Measurement], config: DiverConfig, factor: float
) -> list[Positions]:
    """The fixes of one stamp: all single ones of a sensor together, then scan by scan those that
    say whose they are, of each diver the first, and those that do not. factor: on their
    covariances."""
    groups = []
    fixes = [item for item in items if isinstance(item, Fix)]
    for sensor in sorted({fix.sensor for fix in fixes}):
        own = [fix for fix in fixes if fix.sensor == sensor]
        for fix in own:
            if fix.target_id != NOBODY:
                groups.append(_group(scan_of(fix), _ALL, config, factor, whole=False))
        nameless = [fix for fix in own if fix.target_id == NOBODY]
        if nameless:
            groups.append(_together(nameless, config, factor))
    for scan in (item for item in items if isinstance(item, Fixes)):
        if scan.target_id is None:
            groups.append(_group(scan, _ALL, config, factor, named=False))
            continue
        said = np.flatnonzero(scan.target_id != NOBODY)
        _, first = np.unique(scan.target_id[said], return_index=True)
        if len(said):
            groups.append(_group(scan, said[first], config, factor, whole=False))
        if len(said) < len(scan) or not len(scan):
            rows = np.flatnonzero(scan.target_id == NOBODY)
            groups.append(_group(scan, rows, config, factor, named=False))
    return groups


def _group(
    scan: Fixes,
    rows: slice | IndexArray,
    config: DiverConfig,
    factor: float,
    *,
    whole: bool = True,
    named: bool = True,
) -> Positions:
    """The rows of a scan, with their names unless they have none."""
    config = config.of_sensor(scan.sensor)
    return Positions(
        np.ascontiguousarray(scan.position[rows, :2]),
        _covariances(scan, config)[rows] * factor,
        config.clutter_density,
        factor,
        scan.target_id[rows] if named and scan.target_id is not None else None,
        whole,
        scan.sensor,
    )


def _together(fixes: Sequence[Fix], config: DiverConfig, factor: float) -> Positions:
    """Single fixes of one sensor as one group."""
    config = config.of_sensor(fixes[0].sensor)
    unknown = np.eye(2) * config.fix_std**2
    R = np.array([unknown if fix.covariance is None else fix.covariance for fix in fixes])
    return Positions(
        np.array([fix.position[:2] for fix in fixes]),
        R * factor,
        config.clutter_density,
        factor,
        None,
        config.fixes_are_scans,
        fixes[0].sensor,
    )


def _covariances(scan: Fixes, config: DiverConfig) -> FloatArray:
    """Covariances (n, 2, 2) as stated, else by `fix_std`."""
    unknown = np.eye(2) * config.fix_std**2
    if scan.covariance is None:
        return np.tile(unknown, (len(scan), 1, 1))
    known = np.isfinite(scan.covariance).all(axis=(1, 2))
    return np.where(known[:, None, None], scan.covariance, unknown)


def locate(
    ping: Arrivals, rows: IndexArray, config: DiverConfig, factor: float
) -> Localisation | None:
    """The fix that `rows` of the ping give by themselves, None when they give none to believe.

    With depth as a state it is the best of those at the heights where the models begin.
    """
    variance = toa_variance(ping, config, factor)[rows] + systematic_variance(ping, config)[rows]
    best: Localisation | None = None
    for height in heights_of(config):
        fix = localise(
            ping.rx[rows],
            ping.toa[rows],
            variance,
            tx=ping.tx[rows],
            bearing=ping.bearing[rows],
            var_bearing=bearing_variance(ping, config)[rows],
            target_z=height,
            sound_speed=config.sound_speed,
        )
        if isinstance(fix, Localisation) and (best is None or fix.cost < best.cost):
            best = fix
    return best


def systematic_variance(ping: Arrivals, config: DiverConfig) -> FloatArray:
    """Variance (n,) in s^2 that the errors of the instruments add to an arrival time: what a ping
    by itself cannot tell from noise."""
    relative = config.sound_speed_std / config.sound_speed
    late = np.where(np.isfinite(ping.toa), ping.toa - (ping.passive and np.nanmin(ping.toa)), 0.0)
    return np.asarray(
        (config.receiver_position_std / config.sound_speed) ** 2
        + config.receiver_clock_std**2
        + (relative * late) ** 2
    )


def toa_variance(ping: Arrivals, config: DiverConfig, factor: float) -> FloatArray:
    """Variance (n,) of the arrival times, s^2: the sender's, not below `LEAST_VAR_TOA`."""
    known = np.isfinite(ping.var_toa) & (ping.var_toa > 0.0)
    stated = np.where(known, np.maximum(ping.var_toa, LEAST_VAR_TOA), config.toa_std**2)
    return np.asarray(stated * factor)


def bearing_variance(ping: Arrivals, config: DiverConfig) -> FloatArray:
    """Variance (n,) of the bearings, rad^2: the sender's where given."""
    known = np.isfinite(ping.var_bearing) & (ping.var_bearing > 0.0)
    return np.asarray(np.where(known, ping.var_bearing, np.deg2rad(config.bearing_std_deg) ** 2))
