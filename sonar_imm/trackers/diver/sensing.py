"""From measurements to numbers a filter can use: fixes as one group of detections, a ping located
by itself, variances where the sender states none."""

from __future__ import annotations

from collections.abc import Sequence

from attrs import frozen
import numpy as np

from ...acoustics.localisation import Localisation, localise
from ...estimation.arrays import FloatArray, IndexArray
from ...measurements import Arrivals, Fix
from .config import DiverConfig
from .model_set import heights_of


@frozen(eq=False)
class Positions:
    """D fixes of one stamp, of which each target causes at most one: z (D, 2), R (D, 2, 2);
    clutter: density of false ones; factor: what the stated covariances were multiplied by to give
    R."""

    z: FloatArray
    R: FloatArray
    clutter: float
    factor: float = 1.0


def positions(fixes: Sequence[Fix], config: DiverConfig, factor: float) -> Positions:
    """All fixes of one stamp; factor: on their covariances."""
    unknown = np.eye(2) * config.fix_std**2
    R = np.stack([unknown if fix.covariance is None else fix.covariance for fix in fixes])
    return Positions(
        np.stack([fix.position[:2] for fix in fixes]),
        R * factor,
        config.clutter_density,
        factor,
    )


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
    """Variance (n,) of the arrival times, s^2: the sender's where given."""
    known = np.isfinite(ping.var_toa) & (ping.var_toa > 0.0)
    return np.asarray(np.where(known, ping.var_toa, config.toa_std**2) * factor)


def bearing_variance(ping: Arrivals, config: DiverConfig) -> FloatArray:
    """Variance (n,) of the bearings, rad^2: the sender's where given."""
    known = np.isfinite(ping.var_bearing) & (ping.var_bearing > 0.0)
    return np.asarray(np.where(known, ping.var_bearing, np.deg2rad(config.bearing_std_deg) ** 2))
