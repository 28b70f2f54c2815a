# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Resolution of arrival times.

Receivers and exports round their stamps. Rounding errors are no noise that averages out: arrivals
that are stated better than their resolution give positions that are wrong and seem certain. The
resolution is the coarsest step of which all arrival times are multiples. What counts is the time
of an arrival, never the stamp of a message, which may well be on whole seconds.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from attrs import evolve
import numpy as np

from ...estimation.arrays import IntArray
from ...measurements import Arrivals
from .config import DiverConfig
from .known import Known

RESOLUTIONS_NS = 10 ** np.arange(9, 2, -1)
"""Steps to which times are rounded, ns: 1 s to 1 us, coarsest first."""

LEAST_STAMPS, LEAST_DELAYS = 20, 3
"""Minimum number of arrivals at different times, and of different delays, for a resolution."""

TOLERANCE = 1e-3
"""Rounding errors of a time, in its resolution: seconds since 1970 as a float have 0.2 us."""

COARSEST = 0.25
"""Maximum standard deviation of rounded arrivals, as part of the span of the array, of which
positions are computed."""


class Resolution(NamedTuple):
    """Resolution of the times of one kind."""

    number: int = 0
    """Number of different times."""
    level: int = 0
    """Index of the coarsest of `RESOLUTIONS_NS` of which all are multiples; its length for
    none."""
    values: tuple[int, ...] = ()
    """The first different values, ns."""

    def after(self, times_ns: IntArray) -> Resolution:
        """Add times (n,), ns."""
        different = np.unique(times_ns)
        level = self.level
        while level < len(RESOLUTIONS_NS) and not _are_multiples(different, level):
            level += 1
        values = tuple(dict.fromkeys((*self.values, *different.tolist())))
        return Resolution(self.number + len(different), level, values[:LEAST_DELAYS])

    @property
    def seconds(self) -> float:
        """The resolution, s; 0 if there is none, or too few times."""
        few = self.number < LEAST_STAMPS or len(self.values) < LEAST_DELAYS
        return 0.0 if few or self.level == len(RESOLUTIONS_NS) else 10.0**-self.level


def _are_multiples(times_ns: IntArray, level: int) -> bool:
    """Return whether times (n,) are multiples of a resolution."""
    step = RESOLUTIONS_NS[level]
    rest = times_ns % step
    return bool((np.minimum(rest, step - rest) <= TOLERANCE * step).all())


class ArrivalStamps(NamedTuple):
    """Resolutions of all arrivals so far, and the size of the array."""

    delays: Resolution = Resolution()
    """Of times after the transmission; of a tag, after the first receiver."""
    stamps: Resolution = Resolution()
    """Of times of reception, for tags."""
    span: float = 0.0
    """Longest distance from the first instrument of the array, m."""
    centre: tuple[float, float] = (math.nan, math.nan)
    """Position of that instrument, m."""
    raised: bool = False
    """True if the resolution exceeds the stated error of an arrival."""
    refused: bool = False
    """True if no position is computed."""

    @property
    def resolution(self) -> float:
        """Resolution of the arrivals, s; 0 for none."""
        return max(self.delays.seconds, self.stamps.seconds)

    def after(self, ping: Arrivals) -> ArrivalStamps:
        """Add the arrivals of a ping."""
        heard = np.isfinite(ping.toa)
        delays_ns = np.round(ping.toa[heard] * 1e9).astype(np.int64)
        stamps = self.stamps.after(ping.stamp_ns + delays_ns) if ping.passive else self.stamps
        place = ping.rx[heard, :2] if ping.passive else np.vstack([ping.rx, ping.tx])[:, :2]
        place = place[np.isfinite(place).all(axis=1)]
        centre, span = self.centre, self.span
        if len(place):
            centre = (
                centre if math.isfinite(centre[0]) else (place[0, 0].item(), place[0, 1].item())
            )
            span = max(span, float(np.hypot(*(place - centre).T).max()))
        return self._replace(
            delays=self.delays.after(delays_ns[delays_ns != 0]),
            stamps=stamps,
            centre=centre,
            span=span,
        )


def with_resolution(
    known: Known, ping: Arrivals, config: DiverConfig
) -> tuple[Known, Arrivals | None]:
    """Return the state and the ping with variances not below those of rounded arrivals.

    Return None for a ping whose rounded arrivals give no position.
    """
    found: ArrivalStamps = known.memory['stamps'].after(ping)
    least = found.resolution**2 / 12.0
    stated = np.where(ping.var_toa > 0.0, ping.var_toa, config.toa_std**2)
    # Messages state variances in single precision.
    if not (stated < 0.999 * least).any():
        return known.with_memory(stamps=found), ping
    refused = config.sound_speed * math.sqrt(least) > COARSEST * found.span
    known = known.with_memory(stamps=found._replace(raised=True, refused=refused))
    return known, None if refused else evolve(ping, var_toa=np.maximum(stated, least))


def warnings(known: ArrivalStamps, config: DiverConfig) -> list[str]:
    """Return a warning about arrival times that are rounded."""
    step = known.resolution
    if not known.raised or not step:
        return []
    count = max(each.number for each in (known.delays, known.stamps) if each.seconds == step)
    text = f'all {count} stamps of arrivals are multiples of {step:g} s: a resolution of '
    text += f'{step * config.sound_speed:.3g} m; '
    if known.refused:
        return [text + 'no position can be had of them; is the fraction in another column?']
    return [text + f'toa_std raised to {step / math.sqrt(12.0):.2g} s']
