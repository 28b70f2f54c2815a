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

"""Where obstacles are at any time: they stay, sway about their place, or move."""

from __future__ import annotations

from attrs import frozen
import numpy as np

from sonar_imm.estimation.arrays import FloatArray

from .scenario import ObstacleScenario

_SWAY_STEP = 0.1
WAVES = 3
"""Sinusoids that make up a swing, with periods of 0.75 to 1.3 times the stated one: narrow-band,
as swell is. The study that docs/obstacle.md compares with has such swings."""
FOR_EVER = 1e9
_AHEAD = np.radians(12.0)
"""A mover comes from within this of the course on either side, so that a sonar can see it."""


class Swing:
    """A random narrow-band oscillation: `value` at any time (n,)."""

    def __init__(self, rms: float, period: float, rng: np.random.Generator):
        self.rate = 2.0 * np.pi / (period * rng.uniform(0.75, 1.3, WAVES))
        self.phase = rng.uniform(0.0, 2.0 * np.pi, WAVES)
        share = rng.uniform(0.6, 1.0, WAVES)
        self.amplitude = rms * np.sqrt(2.0 / np.sum(share**2)) * share

    def __call__(self, t: FloatArray) -> FloatArray:
        return np.sin(np.multiply.outer(t, self.rate) + self.phase) @ self.amplitude


@frozen(eq=False)
class Path:
    """place: (3,) NED at time `meets`; speed: (2,) m/s north and east, from the time `starts` to
    `stops`; sway: (n, 2) displacements every 0.1 s from the time 0; swing: of north and east."""

    place: FloatArray
    meets: float = 0.0
    speed: FloatArray | None = None
    sway: FloatArray | None = None
    swing: tuple[Swing, Swing] | None = None
    starts: float = -FOR_EVER
    stops: float = FOR_EVER

    def moves(self, t: FloatArray) -> np.ndarray:
        """Whether it moves at the times t (n,)."""
        return (self.speed is not None) & (t >= self.starts) & (t < self.stops)

    def at(self, t: FloatArray) -> FloatArray:
        """(n, 3) NED at the times t (n,), s."""
        where = np.tile(self.place, (len(t), 1))
        if self.speed is not None:
            active = np.clip(t, self.starts, self.stops)
            active = active - np.clip(self.meets, self.starts, self.stops)
            where[:, :2] += active[:, None] * self.speed
        if self.sway is not None:
            clock = _SWAY_STEP * np.arange(len(self.sway))
            for axis in range(2):
                where[:, axis] += np.interp(t, clock, self.sway[:, axis])
        if self.swing is not None:
            where[:, :2] += np.column_stack([one(t) for one in self.swing])
        return where

    def velocity(self, t: FloatArray) -> FloatArray:
        """(n, 3) m/s, NED, of what moves; 0 of what stays where it is on average."""
        steady = np.zeros((len(t), 3))
        if self.speed is not None:
            steady[self.moves(t), :2] = self.speed
        return steady


def paths(
    config: ObstacleScenario, places: list[FloatArray], course: float, seed: int
) -> list[Path]:
    """The way of each obstacle; `places` (3,) is where one would be that stays. A mover is there
    when the vehicle would come abeam of one that stays, so that it is passed as closely."""
    rng = np.random.default_rng([seed, 1])  # scenes whose obstacles stay keep their numbers
    return [_path(config, place, course, rng) for place in places]


def _path(
    config: ObstacleScenario, place: FloatArray, course: float, rng: np.random.Generator
) -> Path:
    if config.obstacle_motion == 'swaying':
        return Path(place, sway=_sway(config, rng))
    if config.obstacle_motion == 'swinging':
        swing = (config.obstacle_sway, config.obstacle_swing_period)
        return Path(place, swing=(Swing(*swing, rng), Swing(*swing, rng)))
    if config.obstacle_motion == 'moving':
        ahead = np.array([np.cos(course), np.sin(course)])
        meets = float(place[:2] @ ahead) / config.speed
        times = {'starts': config.obstacle_starts, 'stops': config.obstacle_stops}
        return Path(place, meets=meets, speed=_speed(config, course, rng), **times)
    return Path(place)


def _sway(config: ObstacleScenario, rng: np.random.Generator) -> FloatArray:
    """An Ornstein-Uhlenbeck process (n, 2) of the given deviation and memory."""
    duration = (config.first_range - config.last_range) / config.speed + 2.0
    keep = np.exp(-_SWAY_STEP / config.obstacle_sway_time)
    n = int(duration / _SWAY_STEP) + 2
    u = np.empty((n, 2))
    u[0] = rng.normal(size=2)
    for k in range(1, n):
        u[k] = keep * u[k - 1] + np.sqrt(1.0 - keep**2) * rng.normal(size=2)
    return config.obstacle_sway * u


def _speed(config: ObstacleScenario, course: float, rng: np.random.Generator) -> FloatArray:
    """North and east velocity: any heading that keeps the obstacle before the sonar."""
    low, high = config.obstacle_speed
    size = rng.uniform(low, high)
    own = config.speed * np.array([np.cos(course), np.sin(course)])
    across = np.array([-np.sin(course), np.cos(course)])
    for _ in range(1000):
        heading = rng.uniform(-np.pi, np.pi)
        v = size * np.array([np.cos(heading), np.sin(heading)])
        closing = own - v
        forward, sideways = closing @ own / config.speed, closing @ across
        if forward > 0.3 * config.speed and abs(np.arctan2(sideways, forward)) < _AHEAD:
            return v
    return -size * own / config.speed
