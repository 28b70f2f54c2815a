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

"""How the array looked at each bin of a ping, and where on the floor each echo came from.

A level sonar is `level_swath`: the array at `sonar_height` above its reference floor, its tilt the
same in every bin. A ship that moves is `ship_swath`: heights are those of the world, and tilt and
depth scale change from bin to bin with the attitude (`acoustics.sounding`); with a sound-speed
profile directions come from a table of rays (`acoustics.rays`), one per ping.
"""

from __future__ import annotations

from functools import lru_cache
import math
from typing import NamedTuple

from attrs import frozen
import numpy as np

from ...acoustics import geometry as frames
from ...acoustics import rays, sounding
from ...acoustics.array import across_track, angle_of_depth, depth_of_angle, multipath_sines
from ...acoustics.geometry import Pose
from ...acoustics.sounding import ErrorBudget, Looks
from ...estimation.arrays import FloatArray
from .config import BathymetryConfig
from .kernels import Geometry

_TABLE_DEPTH = 0.02
"""Metres to which the depth of the array is rounded for a table of rays, so that pings share
tables. The ray of an array 1 cm higher ends less than a centimetre elsewhere."""
_NO_TABLE = np.zeros((0, 0))


class Floor(NamedTuple):
    """What is known of the floor at each of T bins, from the state and its variance.

    height and its variance (T,); angle (T,), NaN where no echo can come from; xyz (T, 3) in the
    axes of the estimate.
    """

    height: FloatArray
    variance: FloatArray
    angle: FloatArray
    xyz: FloatArray


@frozen(eq=False)
class Swath:
    """The bins of one ping: ranges (T,) m, sound_speed that made them, side, and `geometry`.

    looks: None for a level sonar; profile: None where rays are straight.
    """

    ranges: FloatArray
    sound_speed: float
    side: str
    geometry: Geometry
    looks: Looks | None = None
    profile: rays.Profile | None = None
    water_level: float = 0.0

    def floor(self, state: FloatArray, variance: FloatArray) -> Floor:
        """The floor at states (T,): heights or angles, as the geometry says."""
        if self.looks is None:
            return self._level_floor(state, variance)
        g, looks = self.geometry, self.looks
        if g.of_heights:
            rise = self._launch(looks.position[:, 2] - state)
            s = rise / g.reach
            possible = np.abs(s) <= 1.0
            s = np.where(possible, s, 0.0)
            sine = s * g.cos_tilt - np.sqrt(1.0 - s * s) * g.sin_tilt
            angle = np.where(possible, np.arcsin(np.clip(sine, -1.0, 1.0)), np.nan)
        else:
            angle, sine = state, np.sin(state)
            possible = np.abs(state) <= 0.5 * math.pi
        n = sounding.direction(looks, np.clip(sine, -1.0, 1.0))
        depth, distance = self._reached(n)
        aside = np.linalg.norm(n[:, :2], axis=1)
        outward = n[:, :2] / np.maximum(aside, 1e-12)[:, None]
        height = state if g.of_heights else looks.position[:, 2] - depth
        if not g.of_heights:
            lever = g.reach * np.cos(state + g.tilt)
            variance = variance * np.square(lever)
        place = looks.position[:, :2] + np.where(possible, distance, 0.0)[:, None] * outward
        return Floor(height, variance, angle, np.column_stack([place, height]))

    def surface_sines(self, floor_below: float, sonar_depth: float) -> FloatArray:
        """Direction sines (T, 2) of the echoes by way of a calm surface, see
        `array.multipath_sines`; sonar_depth counts for a level sonar, whose z nobody knows."""
        g = self.geometry
        if self.looks is None:
            depth = np.full(len(self.ranges), floor_below)
            return multipath_sines(depth, self.ranges, float(g.tilt[0]), sonar_depth)
        surface = self.water_level - self.looks.position[:, 2]
        s = np.column_stack([-surface, -2.0 * surface - floor_below]) / g.reach[:, None]
        possible = np.abs(s) <= 1.0
        s = np.where(possible, s, 0.0)
        sine = s * g.cos_tilt[:, None] - np.sqrt(1.0 - s * s) * g.sin_tilt[:, None]
        return np.where(possible, sine, np.nan)

    def beam_angle(self, angle: FloatArray) -> FloatArray:
        """From straight down, port positive (T,), of angles (T,) of echoes; NaN stays."""
        assert self.looks is not None
        return sounding.beam_angle(sounding.direction(self.looks, np.sin(angle)), self.side)

    def distance(self, floor: Floor) -> FloatArray:
        """Horizontal distance (T,) of the floor from the array, m; NaN where it is not known."""
        if self.looks is None:
            aside = np.abs(floor.xyz[:, 1])
        else:
            aside = np.linalg.norm(floor.xyz[:, :2] - self.looks.position[:, :2], axis=1)
        return np.where(np.isfinite(floor.angle), aside, np.nan)

    def uncertainties(self, floor: Floor, budget: ErrorBudget) -> tuple[FloatArray, FloatArray]:
        """Vertical and horizontal variance (T,) of the soundings, m^2."""
        assert self.looks is not None
        offset = floor.xyz - self.looks.position
        distance = np.linalg.norm(offset[:, :2], axis=1)
        return sounding.uncertainties(
            floor.variance, -offset[:, 2], distance, budget, self.sound_speed
        )

    def _launch(self, depth: FloatArray) -> FloatArray:
        """r sin(phi) (T,) of floors `depth` (T,) below the array."""
        g = self.geometry
        if not len(g.launch):
            return depth
        return rays.look_up_each(g.launch, g.row, g.first_depth, g.depth_step, depth)

    def _reached(self, n: FloatArray) -> tuple[FloatArray, FloatArray]:
        """How far below the array and outward echoes from directions n (T, 3) were made."""
        assert self.looks is not None
        if self.profile is None:
            return -n[:, 2] * self.ranges, np.linalg.norm(n[:, :2], axis=1) * self.ranges
        start = self.water_level - self.looks.position[:, 2]
        elevation = np.arcsin(np.clip(-n[:, 2], -1.0, 1.0))
        there = rays.trace(self.profile, start, elevation, self.ranges / self.sound_speed)
        return there.depth - start, there.distance

    def _level_floor(self, state: FloatArray, variance: FloatArray) -> Floor:
        height, tilt = float(self.geometry.height[0]), float(self.geometry.tilt[0])
        if self.geometry.of_heights:
            floor, angle = state, angle_of_depth(height - state, self.ranges, tilt)
        else:
            floor, angle = height - depth_of_angle(state, self.ranges, tilt), state
        depth = height - floor
        outward = np.nan_to_num(across_track(depth, self.ranges))
        left = outward if self.side == 'port' else -outward
        return Floor(floor, variance, angle, np.column_stack([np.zeros_like(left), left, -depth]))


def level_swath(
    config: BathymetryConfig, ranges: FloatArray, sound_speed: float, side: str, spacing: float
) -> Swath:
    """The swath of a sonar at rest, `sonar_height` above its reference floor."""
    geometry = level_geometry(
        ranges,
        config.sonar_height,
        math.radians(config.tilt_deg),
        spacing,
        of_heights=config.model_set != 'angle_two_rw',
    )
    return Swath(ranges, sound_speed, side, geometry)


def level_geometry(
    ranges: FloatArray, height: float, tilt: float, spacing: float, *, of_heights: bool = True
) -> Geometry:
    """The geometry of an array that does not move, `height` metres above its reference floor."""
    T = len(ranges)
    return Geometry(
        of_heights=of_heights,
        height=np.full(T, height),
        reach=ranges.copy(),
        tilt=np.full(T, tilt),
        cos_tilt=np.full(T, math.cos(tilt)),
        sin_tilt=np.full(T, math.sin(tilt)),
        spacing=spacing,
        launch=_NO_TABLE,
        row=np.zeros(T),
        first_depth=0.0,
        depth_step=1.0,
        drift_from=T,
    )


def ship_swath(
    config: BathymetryConfig,
    ranges: FloatArray,
    sound_speed: float,
    side: str,
    spacing: float,
    poses: Pose,
) -> Swath:
    """The swath of a moving ship. poses (T + 1,): of the ship, ENU from FLU, when the ping was
    sent and when each of the T bins was received."""
    T = len(ranges)
    mount = frames.rotation(*np.radians(config.sonar_mount_rpy_deg))
    axes = sounding.array_axes(side, math.radians(config.tilt_deg), mount)
    sent, received = (Pose(poses.position[k], poses.R[k]) for k in (0, slice(1, None)))
    looks = sounding.looks(axes, np.array(config.sonar_lever), sent, received)
    profile, table = None, None
    if config.sound_speed_profile:
        profile = rays.profile_of(config.sound_speed_profile)
        depth = config.water_level - float(np.mean(looks.position[:, 2]))
        steps = round(depth / _TABLE_DEPTH)
        table = _table(config.sound_speed_profile, steps, float(ranges[-1]), sound_speed)
    geometry = Geometry(
        of_heights=config.model_set != 'angle_two_rw',
        height=np.ascontiguousarray(looks.position[:, 2]),
        reach=ranges * looks.C,
        tilt=looks.psi,
        cos_tilt=np.cos(looks.psi),
        sin_tilt=np.sin(looks.psi),
        spacing=spacing,
        launch=_NO_TABLE if table is None else table.value,
        row=np.zeros(T) if table is None else ranges / table.range_step,
        first_depth=0.0 if table is None else table.first_depth,
        depth_step=1.0 if table is None else table.depth_step,
        drift_from=T,
    )
    return Swath(ranges, sound_speed, side, geometry, looks, profile, config.water_level)


@lru_cache(maxsize=256)
def _table(
    pairs: tuple[float, ...], steps: int, last_range: float, sound_speed: float
) -> rays.LaunchTable:
    profile = rays.profile_of(pairs)
    return rays.launch_table(profile, steps * _TABLE_DEPTH, last_range, sound_speed)
