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

"""Estimation of the clutter density from unassociated fixes (`clutter_density: 0`).

The density is the number of false fixes per scan and area. Each fix counts with its probability of
belonging to no track. The first fix of a target also counts as false until its track is confirmed.
The area is a rectangle, ``12 sqrt(det C)`` of the covariance C of the false fixes (a disc has ``4
pi sqrt(det C)``). It needs no parameter and follows a moving sensor.

The prior is `PRIOR_SCANS` scans over `PRIOR_AREA` with density `CLUTTER`. The lower limit is a
tenth of `CLUTTER`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ...estimation.arrays import FloatArray
from ...estimation.association import TENTATIVE
from ...measurements import NOBODY
from .config import CLUTTER, DiverConfig
from .known import Known
from .scan import Group, Scan

MOST = 1e-2
"""Upper limit of the density, 1/m^2: one false fix in every second scan inside a typical gate of a
fix with 1 m error. For more clutter, set `clutter_density`."""

LEAST = 0.1 * CLUTTER
"""Lower limit of the density, 1/m^2."""

PRIOR_SCANS, PRIOR_AREA = 5.0, 4e4
"""Weight of the prior: scans, and area in m^2."""

ENOUGH, EVIDENT = 20.0, 0.5
"""Minimum number of scans, and of false fixes per scan, for a warning with `gnn`."""

ALL = 0.9
"""False fixes per scan above which no fix is associated."""

MOST_SENSORS = 20
"""Maximum number of sensors; the most recent ones are kept."""

MEMORY = 100.0
"""Scans after which the weight of a scan is 1/e."""


class Clutter(NamedTuple):
    """Exponentially weighted clutter statistics of one sensor."""

    scans: float = 0.0
    """Number of scans."""
    false: float = 0.0
    """Expected number of false fixes."""
    placed: float = 0.0
    """Number of fixes in the mean and scatter."""
    x: float = 0.0
    """Mean x, m."""
    y: float = 0.0
    """Mean y, m."""
    xx: float = 0.0
    """Scatter, m^2."""
    xy: float = 0.0
    yy: float = 0.0

    @property
    def area(self) -> float:
        """Area of the false fixes, m^2."""
        prior, number = PRIOR_AREA / 12.0, 1.0 + self.placed
        a, b = (prior + self.xx) / number, (prior + self.yy) / number
        return 12.0 * math.sqrt(max(a * b - (self.xy / number) ** 2, 0.0)) + 1.0

    @property
    def density(self) -> float:
        """Number of false fixes per m^2 and scan."""
        number = CLUTTER * PRIOR_SCANS * PRIOR_AREA + max(self.false, 0.0)
        found = number / ((PRIOR_SCANS + self.scans) * self.area)
        return min(max(found, LEAST), MOST)

    def with_scan(self, z: FloatArray, false: FloatArray) -> Clutter:
        """Add a scan of fixes z (D, 2), false with probability `false` (D,)."""
        kept = math.exp(-1.0 / MEMORY)
        added, old = float(false.sum()), kept * self.placed
        total = old + added
        mean = false @ z / added if added > 0.0 else np.array([self.x, self.y])
        share = added / total if added > 0.0 else 0.0
        apart, gap = z - mean, mean - (self.x, self.y)
        own = apart.T @ (false[:, None] * apart)
        own = own + old * share * np.outer(gap, gap)
        return Clutter(
            kept * self.scans + 1.0,
            kept * self.false + added,
            total,
            self.x + share * float(gap[0]),
            self.y + share * float(gap[1]),
            kept * self.xx + float(own[0, 0]),
            kept * self.xy + float(own[0, 1]),
            kept * self.yy + float(own[1, 1]),
        )

    @property
    def evident(self) -> bool:
        """True if there are many more false fixes than assumed by default."""
        many = self.false > EVIDENT * self.scans and self.density > 10.0 * CLUTTER
        return self.scans >= ENOUGH and many


class Clutters(NamedTuple):
    """Clutter statistics by sensor name, most recent sensor last."""

    by_sensor: tuple[tuple[str, Clutter], ...] = ()

    def get(self, sensor: str) -> Clutter | None:
        """Return the statistics of a sensor; None for none."""
        return dict(self.by_sensor).get(sensor)

    def densities(self) -> dict[str, float]:
        """Return the estimated clutter density of each sensor, 1/m^2."""
        return {sensor: clutter.density for sensor, clutter in self.by_sensor}

    def with_sensor(self, sensor: str, clutter: Clutter) -> Clutters:
        """Replace the statistics of a sensor.

        The oldest sensor is dropped above `MOST_SENSORS`.
        """
        others = [item for item in self.by_sensor if item[0] != sensor]
        return Clutters((*others, (sensor, clutter))[-MOST_SENSORS:])


def count_clutter(known: Known, group: Group) -> Known:
    """Add the false fixes of a scan. A stage of the tracker."""
    if group.config.clutter_density or group.target_id is not None or not group.is_complete:
        return known
    clutters: Clutters = known.memory['clutter']
    before = clutters.get(group.sensor) or Clutter()
    assert group.association is not None
    after = before.with_scan(group.z, np.clip(1.0 - group.association.claimed, 0.0, 1.0))
    return known.with_memory(clutter=clutters.with_sensor(group.sensor, after))


def remove_first_fixes(known: Known, scan: Scan) -> Known:
    """Subtract the first fixes of tracks that this scan confirmed. A stage of the tracker."""
    clutters: Clutters = known.memory['clutter']
    sensor = next((group.sensor for group in scan.fixes if clutters.get(group.sensor)), None)
    own = None if sensor is None else clutters.get(sensor)
    if sensor is None or own is None:
        return known
    life, before = known.life, scan.previous.life
    firm = life.track_id[(life.status != TENTATIVE) & (known['target_id'] == NOBODY)]
    new = len(set(firm.tolist()) - set(before.track_id[before.status != TENTATIVE].tolist()))
    if not new:
        return known
    after = own._replace(false=max(own.false - new, 0.0))
    return known.with_memory(clutter=clutters.with_sensor(sensor, after))


def warnings(known: Clutters, config: DiverConfig, tracked: bool) -> list[str]:
    """Return warnings about unassociated fixes and about clutter that `gnn` does not expect."""
    if not tracked and any(
        clutter.scans >= ENOUGH and clutter.false > ALL * clutter.scans
        for _, clutter in known.by_sensor
    ):
        return [
            'no track takes the fixes: there is no target, or the fixes are too far apart for a '
            'diver. Check units and covariances, or set target (boat, ship)'
        ]
    if config.pairing != 'gnn':
        return []
    found = [clutter for _, clutter in known.by_sensor if clutter.evident]
    return [
        f'{clutter.false / clutter.scans:.2g} false fixes per scan ({clutter.density:.1g} per '
        f'm^2), but association gnn expects {CLUTTER:g} per m^2. Use association jipda, or set '
        'clutter_density'
        for clutter in found[:1]
    ]
