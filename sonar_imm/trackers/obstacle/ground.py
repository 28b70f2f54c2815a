# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""The sea floor ahead, from soundings: as of a bathymetry tracker, of another vehicle, of a chart.

Soundings are kept as means over cells of the world. Where an obstacle is seen first, a plane is
laid through the cells around it, the nearer the heavier; its slopes are believed to be small
beforehand, so that it does not shoot up beyond the edge of what was sounded. The floor there is as
uncertain as the plane, the cells about it and the soundings themselves, whose errors are mostly
common and do not average out.

Where no cell is near, the floor is flat and as deep as below the vehicle, as without soundings.

Source: docs/obstacle.md, section Ground.
"""

from __future__ import annotations

from typing import Annotated, NamedTuple

import numpy as np

from ...acoustics import geometry
from ...estimation.arrays import FloatArray, IntArray
from ...measurements import Ground
from .config import ObstacleConfig
from .filters import Sonar

CELL = 1.0
"""Side of a cell, m."""
MOST_CELLS = 100_000
"""Those sounded last; at ten metres of swath on either side, some five kilometres of a line."""
_FEW = 2048
"""New cells that are kept apart until they are worth sorting in among all."""
SLOPE_STD = 0.2
"""What is believed of the slope of the floor beforehand."""
_ROUNDS = 3
"""Where an echo meets the floor depends on how deep that is there."""
_ROW = np.int64(1) << 32


class Cells(NamedTuple):
    """n cells: key (n,) rising; number (n,) of soundings; sums (n,) of their heights, m, and of
    their variances, m^2; stamp_ns (n,) of the newest."""

    key: Annotated[IntArray, 'c']
    number: Annotated[FloatArray, 'c']
    height: Annotated[FloatArray, 'c']
    variance: Annotated[FloatArray, 'c']
    stamp_ns: Annotated[IntArray, 'c']

    @staticmethod
    def none() -> Cells:
        whole = np.empty(0, np.int64)
        return Cells(whole, np.empty(0), np.empty(0), np.empty(0), whole)

    def joined(self, other: Cells) -> Cells:
        """Return both, added up where they have the same cell."""
        key, place = np.unique(np.concatenate([self.key, other.key]), return_inverse=True)

        def summed(first: FloatArray, second: FloatArray) -> FloatArray:
            return np.bincount(place, np.concatenate([first, second]), len(key)).astype(np.float64)

        newest = np.zeros(len(key), np.int64)
        np.maximum.at(newest, place, np.concatenate([self.stamp_ns, other.stamp_ns]))
        return Cells(
            key,
            summed(self.number, other.number),
            summed(self.height, other.height),
            summed(self.variance, other.variance),
            newest,
        )

    def newest(self, count: int) -> Cells:
        """Return at most `count` cells, those sounded last."""
        if len(self.key) <= count:
            return self
        kept = np.sort(np.argsort(self.stamp_ns, kind='stable')[len(self.key) - count :])
        return Cells._make(part[kept] for part in self)

    def near(self, x: float, y: float, radius: float) -> FloatArray:
        """Return, of the cells whose middle is within `radius` of x, y: (k, 4) how far east and
        north it lies, height, variance."""
        i, j = self.key >> 32, (self.key & (_ROW - 1)) - (_ROW >> 1)
        east, north = CELL * (i + 0.5) - x, CELL * (j + 0.5) - y
        inside = np.flatnonzero(east * east + north * north <= radius * radius)
        number = self.number[inside]
        return np.column_stack(
            [
                east[inside],
                north[inside],
                self.height[inside] / number,
                self.variance[inside] / number,
            ]
        )


class GroundMap(NamedTuple):
    """Soundings so far, as a value: those of a while ago, and the latest ones."""

    old: Cells = Cells.none()
    recent: Cells = Cells.none()

    def added(self, ground: Ground) -> GroundMap:
        """Return the map with more soundings."""
        x, y, z = ground.position.T
        i, j = np.floor(x / CELL).astype(np.int64), np.floor(y / CELL).astype(np.int64)
        one_each = Cells(
            (i << 32) + (j + (_ROW >> 1)),
            np.ones(len(z)),
            z,
            ground.variance,
            np.full(len(z), ground.stamp_ns),
        )
        recent = self.recent.joined(one_each)
        if len(recent.key) <= _FEW:
            return self._replace(recent=recent)
        return GroundMap(self.old.joined(recent).newest(MOST_CELLS))

    def __bool__(self) -> bool:
        return bool(len(self.old.key) or len(self.recent.key))

    def floor(self, x: float, y: float, radius: float) -> tuple[float, float]:
        """Return the height of the floor at x, y and its standard deviation, m; NaN where nothing
        was sounded within `radius`."""
        cells = np.concatenate([part.near(x, y, radius) for part in self])
        if not len(cells):
            return np.nan, np.nan
        A = np.column_stack([np.ones(len(cells)), cells[:, :2]])
        square = np.square(cells[:, 0]) + np.square(cells[:, 1])
        weight = np.exp(-2.0 * square / radius**2)
        middle = float(np.average(cells[:, 2], weights=weight))
        z = cells[:, 2] - middle
        prior = np.diag([0.0, SLOPE_STD**-2, SLOPE_STD**-2])
        rough = 0.1**2  # m^2, of one cell, until the cells say themselves
        for _ in range(2):
            information = (A.T * weight) @ A / rough + prior
            plane = np.linalg.solve(information, (A.T * weight) @ z / rough)
            left = z - A @ plane
            rough = float((weight @ np.square(left) + 0.1**2) / (weight.sum() + 1.0))
        variance = np.linalg.inv(information)[0, 0] + rough
        variance += np.average(cells[:, 3], weights=weight)
        return middle + float(plane[0]), float(np.sqrt(variance))

    def below(
        self, z: FloatArray, sonar: Sonar, config: ObstacleConfig
    ) -> tuple[FloatArray, FloatArray]:
        """Return how far below the sonar the floor is where detections z (B, 2) meet it, and its
        standard deviation, (B,) m; NaN where nothing was sounded."""
        depth, std = np.full(len(z), np.nan), np.full(len(z), np.nan)
        flat = sonar.seabed_below()
        for k, (d, azimuth) in enumerate(z.tolist()):
            guess = min(flat, 0.95 * d) if np.isfinite(flat) else 0.0
            for _ in range(_ROUNDS):
                m = geometry.reconstruct(d, azimuth, guess, sonar.pose.R, config.azimuth_model)
                if not np.isfinite(m).all():
                    break
                east, north, _ = geometry.flip_world(geometry.to_world(sonar.pose, m))
                height, spread = self.floor(float(east), float(north), config.ground_radius)
                if not np.isfinite(height):
                    break
                depth[k], std[k] = -height - sonar.pose.position[2], spread
                guess = min(max(depth[k], -0.95 * d), 0.95 * d)
        return depth, std
