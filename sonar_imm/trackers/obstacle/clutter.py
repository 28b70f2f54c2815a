# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How dense false detections are, from the detections of the last pings.

Each remembered detection counts with the probability u that it was no track's. The density at z,
per metre and radian, is that of the `NEAREST` detections,

    (sum u + SHRINK) / (pings pi rho^2 / METRIC + SHRINK / lambda),

with rho, at least `CLOSEST`, the distance to the farthest of them, where a radian counts as
`METRIC` metres. lambda is the mean over the whole sector A, of a prior worth `PRIOR_PINGS` pings,

    lambda = (FIRST A PRIOR_PINGS + sum u) / ((PRIOR_PINGS + pings) A).

So rings, as of the onset of the sea floor, and noisy sectors are as dense as they are, and the
water beside them is not. A `clutter_density` that is stated is believed.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np

from ...estimation.arrays import FloatArray, IntArray
from .config import ObstacleConfig

PINGS, NEAREST = 60, 20
FEWEST, SPREAD = 3, 6
"""At first the nearest are one in `SPREAD`, `FEWEST` at least: of a ring that was seen once or
twice, twenty would reach far out of it."""
METRIC, CLOSEST = 50.0, 0.5
SHRINK = 0.3
FIRST, PRIOR_PINGS = 0.02, 5.0
MANY = 5.0
"""False detections a ping of which users are told."""
OUTSIDE, MARGIN = 5, 0.1
"""Number of detections farther out than the sonar is said to look, by that share, of which users
are told."""
TOGETHER = 0.15
"""Share of range or sector that holds most false detections where they are in one place."""


class Clutter(NamedTuple):
    """Detections of the last pings, and how many pings there were."""

    z: Annotated[FloatArray, 'n2']
    """(n, 2) range, m, and azimuth, rad."""
    false: Annotated[FloatArray, 'n']
    """(n,) probability that each was no track's."""
    ping: Annotated[IntArray, 'n']
    """(n,) number of the ping."""
    pings: int
    interval: float
    """Mean time between pings, s; 0 before the second one."""

    @staticmethod
    def none() -> Clutter:
        """Return what is known before the first ping."""
        return Clutter(np.empty((0, 2)), np.empty(0), np.empty(0, np.int64), 0, 0.0)

    def after(self, z: FloatArray, false: FloatArray, dt: float) -> Clutter:
        """Return the same after a ping of detections z (D, 2), `dt` seconds after the last."""
        kept = self.ping > self.pings + 1 - PINGS
        number = np.full(len(z), self.pings + 1)
        share = 1.0 / min(self.pings, PINGS) if self.pings else 0.0
        return Clutter(
            np.concatenate([self.z[kept], z]),
            np.concatenate([self.false[kept], np.clip(false, 0.0, 1.0)]),
            np.concatenate([self.ping[kept], number]),
            self.pings + 1,
            self.interval + share * (dt - self.interval),
        )

    def a_ping(self) -> float:
        """Return the mean number of false detections in a ping."""
        return float(self.false.sum()) / max(min(self.pings, PINGS), 1)

    def mean(self, config: ObstacleConfig) -> float:
        """Return the density over the whole sector, per metre and radian."""
        if config.clutter_density > 0.0:
            return config.clutter_density
        area, pings = sector_area(config), min(self.pings, PINGS)
        found = FIRST * area * PRIOR_PINGS + float(self.false.sum())
        return found / ((PRIOR_PINGS + pings) * area)

    def density(self, z: FloatArray, config: ObstacleConfig) -> FloatArray:
        """Return the density (D,) at detections z (D, 2), per metre and radian."""
        everywhere = self.mean(config)
        if config.clutter_density > 0.0 or len(self.z) < FEWEST or not len(z):
            return np.full(len(z), everywhere)
        from scipy.spatial import cKDTree  # here: it takes a while to import

        metres = np.array([1.0, METRIC])
        k = min(NEAREST, max(FEWEST, len(self.z) // SPREAD))
        distance, which = cKDTree(self.z * metres).query(z * metres, k=k)
        radius = np.maximum(distance[:, -1], CLOSEST)
        area = min(self.pings, PINGS) * math.pi * np.square(radius) / METRIC
        number = self.false[which].sum(axis=1)
        return np.asarray((number + SHRINK) / (area + SHRINK / everywhere))

    def widest(self, z: FloatArray) -> tuple[float, float]:
        """Return the largest azimuth, rad to either side, and the largest range, m, of these
        detections z (D, 2) and the last ones: the sonar looks there, whatever it is said to."""
        every = np.abs(np.concatenate([self.z, z]))
        return float(every[:, 1].max(initial=0.0)), float(every[:, 0].max(initial=0.0))

    def warnings(self, config: ObstacleConfig) -> list[str]:
        """Return sentences for the user: of many false detections, and of detections from where
        the sonar is said not to look."""
        found = []
        if config.clutter_density == 0.0 and self.pings >= PINGS and self.a_ping() > MANY:
            found.append(
                f'{self.a_ping():.0f} false detections a ping, most of them '
                f'{self._where(config)}: learnt'
            )
        for parameter, unit, told, column in (
            (
                'horizontal_fov_deg',
                'deg',
                config.horizontal_fov_deg,
                2.0 * np.degrees(self.z[:, 1]),
            ),
            ('max_range', 'm', config.max_range, self.z[:, 0]),
        ):
            beyond = np.sort(np.abs(column))[-OUTSIDE:]
            if len(beyond) == OUTSIDE and beyond[0] > told * (1.0 + MARGIN):
                found.append(
                    f'detections come from beyond {parameter} ({told:g} {unit}): set it to '
                    f'{beyond[-1]:.0f} {unit} or more'
                )
        return found

    def _where(self, config: ObstacleConfig) -> str:
        low, middle, high = (self._quantile(p) for p in (0.2, 0.5, 0.8))
        size = config.max_range, math.radians(config.horizontal_fov_deg)
        if high[0] - low[0] < TOGETHER * size[0]:
            return f'at {middle[0]:.0f} m'
        if high[1] - low[1] < TOGETHER * size[1]:
            side = 'starboard' if middle[1] > 0.0 else 'port'
            return f'to {side} {abs(math.degrees(middle[1])):.0f} deg'
        return 'all over'

    def _quantile(self, p: float) -> list[float]:
        """Return the quantiles of range and azimuth of the false detections."""
        found = []
        for column in self.z.T:
            order = np.argsort(column, kind='stable')
            sums = np.cumsum(self.false[order])
            found.append(float(column[order[np.searchsorted(sums, p * sums[-1])]]))
        return found


def sector_area(config: ObstacleConfig) -> float:
    """Return range times width of the sector, m rad."""
    return config.max_range * math.radians(config.horizontal_fov_deg)
