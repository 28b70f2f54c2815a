# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Objects on a flat floor, that answer at the same range as the floor: ledge, box, wall, boulder.

The vertical plane of a ping is cut into facets of a centimetre. A facet is seen if it lies above
everything nearer, seen from the sonar, and faces it. Its power goes with the sine of its grazing
angle, so that the flat floor has the signal-to-noise ratio of the scene. All facets of a bin have
speckle of their own; those of one surface in a bin share one texture.

Objects go on for ever along the track of a ship, so that it matters only how far from the track a
ping meets them. Of each facet that piece answers which lies in the fan of the array when the echo
is received (`acoustics.sounding`).
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from sonar_imm.acoustics import array
from sonar_imm.acoustics.sounding import Looks
from sonar_imm.estimation.arrays import FloatArray, IntArray

OBJECTS = ('none', 'ledge', 'box', 'wall', 'boulder')
FLOOR, FACE, TOP, BEHIND = range(4)
"""The surfaces; a boulder is all face."""
FACET = 0.01
THICKNESS = {'box': 2.0, 'wall': 0.2}
PASSES = 3
"""Which bin a facet is in says how the ship lay, which says which bin it is in."""
SECOND_DB, APART = 15.0, 0.5
"""A second surface counts from so many decibels below the first on, at a stave at least as strong
as the noise, and so many metres above or below it."""


class Facets(NamedTuple):
    """What a ping sees, each (n,): number of the bin, height above the floor m, direction sine,
    power at a stave in noises, and which surface."""

    bin: IntArray
    height: FloatArray
    sine: FloatArray
    power: FloatArray
    surface: IntArray


class Above(NamedTuple):
    """How an array on a ship looks at the floor in each of T bins, in the axes along the track, to
    its side and up: outward (T,) from the track and height (T,) above the floor, m; stave and fore
    (T, 3), axes of the array."""

    outward: FloatArray
    height: FloatArray
    stave: FloatArray
    fore: FloatArray


def above(looks: Looks, course: float, side: str, level: float) -> Above:
    """The looks of a ship on a course (rad, from east to north) along a track through the origin,
    over a floor at z = level."""
    sign, c, s = 1.0 if side == 'port' else -1.0, math.cos(course), math.sin(course)
    axes = np.array([[c, s, 0.0], [-sign * s, sign * c, 0.0], [0.0, 0.0, 1.0]])
    parts = looks.position, looks.stave, looks.broadside
    place, stave, broadside = (part @ axes.T for part in parts)
    return Above(place[:, 1], place[:, 2] - level, stave, np.cross(stave, broadside))


def facets_of(
    config: Any, ranges: FloatArray, snr: FloatArray, ship: Above | None = None
) -> Facets:
    """The facets that a level sonar sees, or that of a ship. ranges and snr (T,) of the bins, the
    latter those of a flat floor."""
    H, width = config.sonar_height, config.bin_width
    if ship is not None:
        H = float(ship.height.mean())
    nodes, kinds = _outline(config, float(ranges[-1]) + width)
    parts = [_cut(a, b, kind) for a, b, kind in zip(nodes[:-1], nodes[1:], kinds)]
    x, z, dx, dz, surface = (np.concatenate(column) for column in zip(*parts))
    if ship is not None:
        x, off = x - float(ship.outward.mean()), x
    r = np.hypot(x, H - z)
    elevation = np.arctan2(z - H, x)
    highest = np.maximum.accumulate(elevation)
    seen = elevation > np.concatenate([[-math.inf], highest[:-1]])
    projected = (dz * x + dx * (H - z)) / r
    number = np.rint((r - ranges[0]) / width).astype(np.int64)
    if ship is not None:
        for _ in range(PASSES):
            there = np.clip(number, 0, len(ranges) - 1)
            r, sine = _in_fan(off, z, Above(*(part[there] for part in ship)))
            number = np.rint((r - ranges[0]) / width).astype(np.int64)
    seen &= (projected > 0.0) & (number >= 0) & (number < len(ranges))
    number = np.where(seen, number, 0)
    # What the flat floor has in a bin, so that it gets the ratio of the scene.
    flat = H * width / np.sqrt(np.maximum(r * r - H * H, width * H))
    power = np.where(seen, snr[number] * projected / flat, 0.0)
    if ship is None:
        sine = array.direction_sine(H - z, ranges[number], math.radians(config.tilt_deg))
    return Facets(*(part[seen] for part in (number, z, sine, power, surface)))


def _in_fan(off: FloatArray, z: FloatArray, ship: Above) -> tuple[FloatArray, FloatArray]:
    """Slant range (n,) and direction sine (n,) of what of facets, `off` (n,) from the track and z
    (n,) above the floor, lies in the fan."""
    x, up = off - ship.outward, z - ship.height
    along = -(x * ship.fore[:, 1] + up * ship.fore[:, 2]) / ship.fore[:, 0]
    r = np.sqrt(along * along + x * x + up * up)
    return r, (along * ship.stave[:, 0] + x * ship.stave[:, 1] + up * ship.stave[:, 2]) / r


def surfaces_of(facets: Facets, bins: int) -> tuple[FloatArray, FloatArray]:
    """Power (bins, 4) of each surface and its mean height, NaN where it is not seen."""
    place = 4 * facets.bin + facets.surface
    power = np.bincount(place, facets.power, 4 * bins).astype(np.float64)
    with np.errstate(invalid='ignore'):
        height = np.bincount(place, facets.power * facets.height, 4 * bins) / power
    return power.reshape(-1, 4), height.reshape(-1, 4)


def second_of(power: FloatArray, height: FloatArray) -> tuple[IntArray, FloatArray, FloatArray]:
    """How many surfaces (T,) count, and the heights (T,) of the strongest and of the next of them,
    NaN where there is none."""
    rows = np.arange(len(power))
    first = power.argmax(axis=1)
    highest, main = power[rows, first], height[rows, first]
    least = np.maximum(highest * 10.0 ** (-0.1 * SECOND_DB), 1.0)
    with np.errstate(invalid='ignore'):
        counts = (power >= least[:, None]) & (np.abs(height - main[:, None]) >= APART)
    other = np.where(counts, power, -1.0).argmax(axis=1)
    number = (highest > 0.0) * (1 + counts.sum(axis=1))
    return number, main, np.where(counts.any(axis=1), height[rows, other], np.nan)


def _outline(config: Any, last: float) -> tuple[FloatArray, list[int]]:
    """Corners (n, 2) of the plane, outward and up, and what lies between them."""
    at, up = config.object_distance, config.object_size
    end = [max(last, at + 10.0), up if config.object == 'ledge' else 0.0]
    if config.object == 'ledge':
        return np.array([[0.0, 0.0], [at, 0.0], [at, up], end]), [FLOOR, FACE, TOP]
    if config.object == 'boulder':
        turn = np.linspace(math.pi, 0.0, 1 + math.ceil(math.pi * up / FACET))
        around = np.column_stack([at + up * (1.0 + np.cos(turn)), up * np.sin(turn)])
        kinds = [FLOOR, *[FACE] * (len(turn) - 1), BEHIND]
        return np.concatenate([[[0.0, 0.0]], around, [end]]), kinds
    back = at + THICKNESS[config.object]
    corners = [[0.0, 0.0], [at, 0.0], [at, up], [back, up], [back, 0.0], end]
    return np.array(corners), [FLOOR, FACE, TOP, BEHIND, BEHIND]


def _cut(a: FloatArray, b: FloatArray, kind: int) -> tuple[Any, ...]:
    """Middle (n,) of the facets of a straight piece, outward and up, their extent in both, and
    which surface they are."""
    n = max(round(float(np.hypot(*(b - a))) / FACET), 1)
    x, z = a[:, None] + (b - a)[:, None] * (np.arange(n) + 0.5) / n
    dx, dz = ((b - a) / n)[:, None] * np.ones(n)
    return x, z, dx, dz, np.full(n, kind)
