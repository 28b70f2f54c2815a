# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Estimation of the clutter density from unassociated fixes (`clutter_density: 0`).

The density is the number of false fixes per scan and area. Each fix counts with its probability of
belonging to no track. There are two estimates, and the larger one is used:

- One density of the sensor. The first fix of a target also counts as false until its track is
  confirmed. The area is a rectangle, ``12 sqrt(det C)`` of the covariance C of the false fixes (a
  disc has ``4 pi sqrt(det C)``). It needs no parameter and follows a moving sensor. The prior is
  `PRIOR_SCANS` scans over `PRIOR_AREA` with density `CLUTTER`. The lower limit is a tenth of
  `CLUTTER`.
- The density at a fix, from the remembered false fixes in the narrowest disc around it that has
  `IN_DISC` of them and is not narrower than the fix is uncertain. False fixes are rarely uniform:
  a pier, a reef or a wreck returns them in clumps.

A scan is compared with the false fixes of earlier scans only.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np

from ...estimation.arrays import FloatArray
from ...estimation.association import TENTATIVE
from ...measurements import NOBODY
from .config import CLUTTER, DiverConfig
from .known import Known
from .scan import FIRST_LOOK, Group, Scan

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

RADII = 3.0 * 2.0 ** np.arange(7)
"""Radii of the discs, m."""

IN_DISC = 5.0
"""Minimum weight of the false fixes in a disc."""

MOST_REMEMBERED, LEAST_WEIGHT = 3000, 0.01
"""Maximum number of remembered false fixes, and their minimum weight."""

MOST_COMPARED = 128
"""Maximum number of fixes whose distances are computed at once."""

LOOKS = 10.0
"""Scans over which the time between scans is averaged."""


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
    points: Annotated[FloatArray, 'p2'] = np.empty((0, 2))
    """Remembered false fixes, m."""
    weight: Annotated[FloatArray, 'p'] = np.empty(0)
    """Their weights: the probability of being false, times 1/e in `MEMORY` scans."""

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

    def with_scan(
        self, z: FloatArray, false: FloatArray, new: FloatArray | float = 0.0
    ) -> Clutter:
        """Add a scan of fixes z (D, 2), of no track with probability `false` (D,).

        new: (D,) probability that the fix is of a new target. Such a fix is remembered with the
        rest of its probability. In the one density it counts until its track is confirmed.
        """
        kept = math.exp(-1.0 / MEMORY)
        added, old = float(false.sum()), kept * self.placed
        total = old + added
        mean = false @ z / added if added > 0.0 else np.array([self.x, self.y])
        share = added / total if added > 0.0 else 0.0
        apart, gap = z - mean, mean - (self.x, self.y)
        own = apart.T @ (false[:, None] * apart)
        own = own + old * share * np.outer(gap, gap)
        points, weight = self._remembered(z, false - new)
        return Clutter(
            kept * self.scans + 1.0,
            kept * self.false + added,
            total,
            self.x + share * float(gap[0]),
            self.y + share * float(gap[1]),
            kept * self.xx + float(own[0, 0]),
            kept * self.xy + float(own[0, 1]),
            kept * self.yy + float(own[1, 1]),
            points,
            weight,
        )

    def _remembered(self, z: FloatArray, false: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the false fixes after a scan and their weights.

        Of more than `MOST_REMEMBERED`, evenly spaced ones are kept, with the weight of all.
        """
        weight = np.concatenate([math.exp(-1.0 / MEMORY) * self.weight, false])
        kept = np.flatnonzero(weight > LEAST_WEIGHT)
        total = float(weight[kept].sum())
        if (count := len(kept)) > MOST_REMEMBERED:
            kept = kept[np.arange(MOST_REMEMBERED) * count // MOST_REMEMBERED]
            weight = weight * (total / float(weight[kept].sum()))
        return np.concatenate([self.points, z])[kept], weight[kept]

    def density_at(self, z: FloatArray, R: FloatArray) -> FloatArray:
        """Return the false fixes (D,) per m^2 and scan at fixes z (D, 2), R (D, 2, 2)."""
        found = np.full(len(z), self.density)
        # If fixes stand for several others, as many of them have to be in a disc.
        least = IN_DISC * max(1.0, float(self.weight.max(initial=0.0)))
        if not len(z) or self.weight.sum() < least:
            return found
        size = np.sqrt(np.sqrt(np.linalg.det(R)))
        # In the order of x, a few fixes are compared with a few points.
        order, rows = np.argsort(self.points[:, 0]), np.argsort(z[:, 0])
        x, y = self.points[order].T
        weight = self.weight[order]
        for radius in RADII:
            left = []
            for start in range(0, len(rows), MOST_COMPARED):
                some = rows[start : start + MOST_COMPARED]
                low = np.searchsorted(x, z[some[0], 0] - radius)
                high = np.searchsorted(x, z[some[-1], 0] + radius, side='right')
                square = np.square(z[some, 0, None] - x[low:high])
                square += np.square(z[some, 1, None] - y[low:high])
                inside = (square <= radius**2) @ weight[low:high]
                enough = (inside >= least) & (size[some] <= radius)
                area = (PRIOR_SCANS + self.scans) * math.pi * radius**2
                local = np.maximum(found[some[enough]], inside[enough] / area)
                found[some[enough]] = np.minimum(local, MOST)
                left.append(some[~enough])
            if not len(rows := np.concatenate(left)):
                break
        return found

    @property
    def evident(self) -> bool:
        """True if there are many more false fixes than assumed by default."""
        many = self.false > EVIDENT * self.scans and self.density > 10.0 * CLUTTER
        return self.scans >= ENOUGH and many


class Clutters(NamedTuple):
    """Clutter statistics by sensor name, most recent sensor last."""

    by_sensor: tuple[tuple[str, Clutter], ...] = ()
    looks: tuple[tuple[str, int, float], ...] = ()
    """Of each sensor: name, stamp of the last scan, ns, and mean time between scans, s."""

    def get(self, sensor: str) -> Clutter | None:
        """Return the statistics of a sensor; None for none."""
        return dict(self.by_sensor).get(sensor)

    def with_sensor(self, sensor: str, clutter: Clutter) -> Clutters:
        """Replace the statistics of a sensor.

        The oldest sensor is dropped above `MOST_SENSORS`.
        """
        others = [item for item in self.by_sensor if item[0] != sensor]
        return self._replace(by_sensor=(*others, (sensor, clutter))[-MOST_SENSORS:])

    def with_look(self, sensor: str, stamp_ns: int) -> tuple[Clutters, float]:
        """Add a scan of a sensor.

        :returns: the new state, and the time in which targets have arrived since the scan before.
            If several instruments share a name, their scans come in pairs: the mean time is the
            least.
        """
        before = next((look for look in self.looks if look[0] == sensor), None)
        elapsed = mean = FIRST_LOOK
        if before is not None:
            _, last_ns, mean = before
            elapsed = min((stamp_ns - last_ns) * 1e-9, FIRST_LOOK)
            if last_ns == stamp_ns:
                return self, mean
            mean = elapsed if mean == FIRST_LOOK else mean + (elapsed - mean) / LOOKS
        others = [look for look in self.looks if look[0] != sensor]
        looks = (*others, (sensor, stamp_ns, mean))[-MOST_SENSORS:]
        return self._replace(looks=looks), max(elapsed, mean)


def estimate_densities(known: Known, group: Group) -> Known:
    """Store the clutter density at each fix, and the time since the last scan. A stage of the
    tracker."""
    if group.target_id is not None:
        return known
    clutters: Clutters = known.memory['clutter']
    own = clutters.get(group.sensor)
    if own is not None and group.config.pairing != 'gnn' and not group.config.clutter_density:
        group.learnt_clutter = own.density_at(group.z, group.R)
    clutters, group.elapsed = clutters.with_look(group.sensor, known.stamp_ns)
    return known.with_memory(clutter=clutters)


def count_clutter(known: Known, group: Group) -> Known:
    """Add the false fixes of a scan. A stage of the tracker."""
    if group.config.clutter_density or group.target_id is not None or not group.is_complete:
        return known
    clutters: Clutters = known.memory['clutter']
    before = clutters.get(group.sensor) or Clutter()
    association = group.association
    assert association is not None
    new = 0.0 if association.existence is None else association.existence
    after = before.with_scan(group.z, np.clip(1.0 - association.claimed, 0.0, 1.0), new)
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
