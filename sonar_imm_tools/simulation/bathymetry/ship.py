# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""A ship under way with a side-scan array: how it moves, what its navigation says of that, and
what floor each echo of a ping comes from.

The world is east-north-up with the water line at z = `water_level`. The ship goes straight on
while it rolls, pitches, yaws and heaves, each a sum of three sines about the swell's period. What
the navigation states differs from the truth by errors that last seconds, as those of real attitude
sensors do: within a ping they are nearly constant.

The floor is a function of the place. Its course coordinates are the distance along the track and
that from the track. An echo is placed with the geometry of `acoustics.sounding`: attitude at its
reception, mean position of transmission and reception, and, under a sound-speed profile, the ray
that `acoustics.rays` finds by bisection, not by the table the tracker uses.
"""

from __future__ import annotations

from collections.abc import Callable
import math
from typing import NamedTuple

from attrs import frozen
import numpy as np
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from sonar_imm.acoustics import geometry, rays, sounding
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.estimation.arrays import BoolArray, FloatArray
from sonar_imm.measurements import Navigation
from sonar_imm.parameters import parameter

from ..scenario import Scenario, smoothed

SWELL_PERIOD = 6.0
"""Seconds of roll and heave."""
_ERROR_SECONDS = 1.5
"""Standard deviation of the kernel that smooths the errors of the navigation."""
_BEFORE, _AFTER = 1.0, 1.0
"""Seconds of navigation before the first and after the last ping."""
PASSES, BISECTIONS = 4, 45


@frozen(kw_only=True)
class ShipScenario(Scenario):
    """What a scene says of the ship. Nothing here has a meaning unless `moving`."""

    # fmt: off
    moving: bool = parameter(False, '',
        'whether the ship moves and has navigation; heights are then those in the world, and the '
        'floor depends on the place: ranges of the patch are distances from the track')
    speed: float = parameter(2.0, 'm/s', 'speed of the ship', range=(0.0, 20.0))
    course_deg: float = parameter(30.0, 'deg',
        'direction the ship goes, from east to north', range=(-360.0, 360.0))
    roll_deg: float = parameter(2.0, 'deg', 'rms roll of the ship', range=(0.0, 20.0))
    pitch_deg: float = parameter(1.0, 'deg', 'rms pitch of the ship', range=(0.0, 20.0))
    yaw_deg: float = parameter(0.8, 'deg', 'rms yaw of the ship', range=(0.0, 20.0))
    heave: float = parameter(0.2, 'm', 'rms heave of the ship', range=(0.0, 10.0))
    sonar_lever: tuple[float, ...] = parameter((1.5, -0.4, -0.8), 'm',
        'vector from the navigation reference to the array: x forward, y port, z up',
        range=(-100.0, 100.0), kind='float[]')
    sonar_mount_rpy_deg: tuple[float, ...] = parameter((1.5, -1.0, 2.0), 'deg',
        'roll, pitch, yaw of the array in the ship', range=(-180.0, 180.0), kind='float[]')
    water_level: float = parameter(0.0, 'm',
        'z of the water line in the world', range=(-12000.0, 12000.0))
    sound_speed_profile: tuple[float, ...] = parameter((), '',
        'depth in m and sound speed in m/s in turn; empty: straight rays', range=(-100.0, 12000.0),
        kind='float[]')
    nav_rate: float = parameter(50.0, 'Hz',
        'poses of the navigation per second', range=(1.0, 1000.0))
    nav_attitude_error_deg: float = parameter(0.0, 'deg',
        'rms error of roll and pitch in the navigation', range=(0.0, 20.0))
    nav_heading_error_deg: float = parameter(0.0, 'deg',
        'rms error of the heading in the navigation', range=(0.0, 20.0))
    nav_heave_error: float = parameter(0.0, 'm',
        'rms error of z in the navigation', range=(0.0, 10.0))
    nav_position_error: float = parameter(0.0, 'm',
        'rms error of each horizontal coordinate in the navigation', range=(0.0, 100.0))
    patch_along: tuple[float, ...] = parameter((), 'm',
        'where the rough patch begins and ends along the track; empty: everywhere', kind='float[]')
    patch_outline: float = parameter(0.0, 'm',
        'amplitude of the waves in the outline of the rough patch', range=(0.0, 100.0))
    patch_outline_length: float = parameter(12.0, 'm',
        'length along the track of the waves in the outline of the rough patch',
        range=(0.1, 10000.0))
    # fmt: on

    def check(self) -> list[str]:
        problems = []
        if self.sound_speed_profile:
            if problem := rays.profile_problem(self.sound_speed_profile):
                problems.append(f'sound_speed_profile {problem}')
            elif not self.moving:
                problems.append('sound_speed_profile needs moving: true')
        for name, wanted in (('sonar_lever', 3), ('sonar_mount_rpy_deg', 3)):
            if len(getattr(self, name)) != wanted:
                problems.append(f'{name} needs {wanted} values, got {len(getattr(self, name))}')
        if len(self.patch_along) not in (0, 2) or any(np.diff(self.patch_along) <= 0.0):
            problems.append('patch_along needs two increasing values, or none')
        return problems


class Waves(NamedTuple):
    """A sum of sines: amplitude, angular frequency (rad/s), phase, each (K,)."""

    amplitude: FloatArray
    rate: FloatArray
    phase: FloatArray

    def at(self, t: FloatArray) -> FloatArray:
        """Values (...,) at times t (...,) s."""
        t = np.asarray(t, np.float64)[..., None]
        return np.asarray((self.amplitude * np.sin(self.rate * t + self.phase)).sum(axis=-1))


class Ship(NamedTuple):
    """A ship under way, its reference at `start` (3,) at time zero."""

    start: FloatArray
    velocity: FloatArray
    course: float
    roll: Waves
    pitch: Waves
    yaw: Waves
    heave: Waves

    def pose(self, t: FloatArray) -> Pose:
        """Poses at times t (...,) s: world ENU from body FLU."""
        t = np.asarray(t, np.float64)
        position = self.start + t[..., None] * self.velocity
        position[..., 2] += self.heave.at(t)
        angles = self.roll.at(t), self.pitch.at(t), self.course + self.yaw.at(t)
        return Pose(position, geometry.rotation(*angles))


def ship_of(config: ShipScenario, sonar_depth: float, rng: Generator) -> Ship:
    """A ship whose array is `sonar_depth` below the water line on average."""
    course = math.radians(config.course_deg)

    def waves(rms: float, period: float) -> Waves:
        share = np.array([1.0, 0.6, 0.4])
        share *= rms * math.sqrt(2.0) / np.linalg.norm(share)
        periods = period * np.array([1.0, 0.73, 1.31]) * rng.uniform(0.95, 1.05, 3)
        return Waves(share, 2.0 * np.pi / periods, rng.uniform(0.0, 2.0 * np.pi, 3))

    return Ship(
        start=np.array([0.0, 0.0, config.water_level - sonar_depth - config.sonar_lever[2]]),
        velocity=config.speed * np.array([math.cos(course), math.sin(course), 0.0]),
        course=course,
        roll=waves(math.radians(config.roll_deg), SWELL_PERIOD),
        pitch=waves(math.radians(config.pitch_deg), 0.8 * SWELL_PERIOD),
        yaw=waves(math.radians(config.yaw_deg), 1.7 * SWELL_PERIOD),
        heave=waves(config.heave, SWELL_PERIOD),
    )


def navigation_of(
    config: ShipScenario, ship: Ship, first_ns: int, seconds: float, rng: Generator, frame_id: str
) -> list[Navigation]:
    """The navigation from a second before time zero, at `first_ns`, to one after `seconds`."""
    count = math.ceil((seconds + _BEFORE + _AFTER) * config.nav_rate) + 1
    t = np.arange(count) / config.nav_rate - _BEFORE
    scale = np.array(
        [
            *np.radians([config.nav_attitude_error_deg] * 2 + [config.nav_heading_error_deg]),
            *[config.nav_position_error] * 2,
            config.nav_heave_error,
        ]
    )
    # Smooth noise (count, 6) of unit variance.
    width = _ERROR_SECONDS * config.nav_rate
    white = rng.normal(size=(count + 8 * math.ceil(width), 6))
    error = scale * smoothed(white, width)[:count]
    true = ship.pose(t)
    angles = geometry.euler_angles(true.R) + error[:, :3]
    q = Rotation.from_matrix(geometry.rotation(*angles.T)).as_quat()
    return [
        Navigation(
            stamp_ns=first_ns + round(1e9 * when),
            frame_id=frame_id,
            child_frame_id='base_link',
            position=place,
            orientation=turn,
        )
        for when, place, turn in zip(t, true.position + error[:, 3:], q)
    ]


class Terrain(NamedTuple):
    """The floor by its place: `rise` gives metres above `level` (z), and `rough` says where the
    patch is, both from distances (...,) along the track and off it."""

    level: float
    course: float
    rise: Callable[[FloatArray, FloatArray], FloatArray]
    rough: Callable[[FloatArray, FloatArray], BoolArray]

    def at(self, place: FloatArray, roughness: FloatArray) -> tuple[FloatArray, BoolArray]:
        """z (...,) and whether it is in the patch, at places (..., 3)."""
        c, s = math.cos(self.course), math.sin(self.course)
        along = c * place[..., 0] + s * place[..., 1]
        off = np.abs(-s * place[..., 0] + c * place[..., 1])
        patch = self.rough(along, off)
        return self.level + self.rise(along, off) + patch * roughness, patch


class Seen(NamedTuple):
    """What one ping sees: direction sine (T,), place (T, 3) in the world, patch (T,), and reached
    (T,): False where the sound is still in the water, or never gets to the floor."""

    sine: FloatArray
    place: FloatArray
    patch: BoolArray
    reached: BoolArray


def see(
    config: ShipScenario,
    look: sounding.Looks,
    terrain: Terrain,
    roughness: FloatArray,
    ranges: FloatArray,
    sound_speed: float,
) -> Seen:
    """What a ping sees at `ranges` (T,); roughness (T,) is the height of each echo above the
    smooth floor, if it comes from the patch."""
    p = place = look.position
    z, patch = np.full(len(ranges), terrain.level), np.zeros(len(ranges), bool)
    for k in range(PASSES):
        if k:
            z, patch = terrain.at(place, roughness)
        rise, distance, found = _launch(config, p[:, 2], z, ranges, ranges / sound_speed)
        s = rise / look.C
        reached = found & (np.abs(s) <= 1.0)
        sine = sine_from(look, np.where(reached, s, 0.0))
        n = sounding.direction(look, sine)[:, :2]
        outward = n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), 1e-12)
        place = np.column_stack([p[:, :2] + distance[:, None] * outward, z])
    return Seen(sine, place, patch & reached, reached)


def sine_from(look: sounding.Looks, s: FloatArray) -> FloatArray:
    """Direction sines (T,) along the array of rays that leave at sines `s` (T,) in its fan."""
    return np.asarray(s * np.cos(look.psi) - np.sqrt(1.0 - s * s) * np.sin(look.psi))


def _launch(
    config: ShipScenario, array_z: FloatArray, z: FloatArray, ranges: FloatArray, tau: FloatArray
) -> tuple[FloatArray, FloatArray, BoolArray]:
    """Sines (T,) of elevation of rays to floors at `z`, how far they get, whether they do."""
    if not config.sound_speed_profile:
        s = (array_z - z) / ranges
        distance = np.sqrt(np.maximum(ranges**2 - (array_z - z) ** 2, 0.0))
        return s, distance, np.abs(s) <= 1.0
    profile = rays.profile_of(config.sound_speed_profile)
    depth, wanted = config.water_level - array_z, config.water_level - z
    low, high = np.full(len(z), -0.5 * math.pi), np.full(len(z), 0.5 * math.pi)
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        below = rays.trace(profile, depth, middle, tau).depth > wanted
        low, high = np.where(below, low, middle), np.where(below, middle, high)
    there = rays.trace(profile, depth, low, tau)
    return np.sin(low), there.distance, np.abs(there.depth - wanted) < 1e-3


def in_outline(
    config: ShipScenario, along: FloatArray, off: FloatArray, start: float, end: float
) -> BoolArray:
    """Whether places lie in the rough patch: between `start` and `end` off the track and within
    `patch_along`, all its edges waving by `patch_outline`."""
    turn = 2.0 * np.pi / config.patch_outline_length
    inner = start + config.patch_outline * np.sin(turn * along)
    outer = end + config.patch_outline * np.sin(turn * along + 1.9)
    inside = (off >= inner) & (off < outer)
    if config.patch_along:
        begin, stop = config.patch_along
        wave = config.patch_outline * np.sin(turn * off)
        inside &= (along >= begin + wave) & (along < stop + wave)
    return np.asarray(inside)
