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

"""Objects on a flat floor, that answer at the same range as the floor: ledge, box, wall, boulder.

The vertical plane of a ping is cut into facets of a centimetre. A facet is seen if it lies above
everything nearer, seen from the sonar, and faces it. Its power goes with the sine of its grazing
angle, so that the flat floor has the signal-to-noise ratio of the scene. All facets of a bin have
speckle of their own; those of one surface in a bin share one texture.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from sonar_imm.estimation.arrays import FloatArray, IntArray

OBJECTS = ('none', 'ledge', 'box', 'wall', 'boulder')
FLOOR, FACE, TOP, BEHIND = range(4)
"""The surfaces; a boulder is all face."""
FACET = 0.01
THICKNESS = {'box': 2.0, 'wall': 0.2}
SECOND_DB, APART = 15.0, 0.5
"""A second surface counts from so many decibels below the first on, at a stave at least as strong
as the noise, and so many metres above or below it."""


class Facets(NamedTuple):
    """What a ping sees, each (n,): number of the bin, height m, power at a stave in noises, and
    which surface."""

    bin: IntArray
    height: FloatArray
    power: FloatArray
    surface: IntArray


def facets_of(config: Any, ranges: FloatArray, snr: FloatArray) -> Facets:
    """The facets that a level sonar sees. ranges and snr (T,) of the bins, the latter those of a
    flat floor."""
    H, width = config.sonar_height, config.bin_width
    nodes, kinds = _outline(config, float(ranges[-1]) + width)
    parts = [_cut(a, b, kind) for a, b, kind in zip(nodes[:-1], nodes[1:], kinds)]
    x, z, dx, dz, surface = (np.concatenate(column) for column in zip(*parts))
    r = np.hypot(x, H - z)
    elevation = np.arctan2(z - H, x)
    highest = np.maximum.accumulate(elevation)
    seen = elevation > np.concatenate([[-math.inf], highest[:-1]])
    projected = (dz * x + dx * (H - z)) / r
    number = np.rint((r - ranges[0]) / width).astype(np.int64)
    seen &= (projected > 0.0) & (number >= 0) & (number < len(ranges))
    number = np.where(seen, number, 0)
    # What the flat floor has in a bin, so that it gets the ratio of the scene.
    flat = H * width / np.sqrt(np.maximum(r * r - H * H, width * H))
    power = np.where(seen, snr[number] * projected / flat, 0.0)
    return Facets(*(part[seen] for part in (number, z, power, surface)))


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
