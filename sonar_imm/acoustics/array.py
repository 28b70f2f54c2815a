# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Where an echo comes from, and what a tilted line array makes of it.

The sonar is the origin of the vertical plane of one ping. The floor lies `D` metres below it (the
height of the sonar less the elevation of the floor) and answers at the slant range r, so it is
seen asin(D / r) below the horizon. The array looks outward and `tilt` below the horizon. The
staves p = 0 .. P-1, the uppermost first, stand `spacing` wavelengths apart along the axis
e = (-sin tilt, cos tilt), in components outward and down. The **angle** theta = asin(D / r) - tilt
is counted from the plane orthogonal to the axis, positive towards nadir.

An echo reaches stave p with the phase 2 pi spacing p u, where u = sin theta, the component of its
direction along the axis, is the **direction sine**; u follows from D and r with one square root
and no trigonometry::

    u = (D / r) cos tilt - sqrt(1 - (D / r)^2) sin tilt

A floor further away than the range, abs(D) > r, cannot answer: u is NaN. Whether the phase grows
or falls with p is a matter of wiring and of mixing down to baseband; `conjugate` turns it round
(getting it wrong costs about a hundred standard deviations).

Conventions
    Ranges and heights in metres, angles in radians, spacing in wavelengths. Arguments broadcast.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from ..estimation.arrays import ComplexArray, FloatArray

FEWEST_POINTS = 64
"""Cells of a grid of directions: the beams of two or three staves are wide, but sharp on top."""


def direction_sine(depth: ArrayLike, slant_range: ArrayLike, tilt: float) -> FloatArray:
    """u = sin theta of a point `depth` below the sonar at `slant_range`; NaN where it cannot
    be."""
    ratio = _ratio(depth, slant_range)
    possible = np.abs(ratio) <= 1.0
    ratio = np.where(possible, ratio, 0.0)
    sine = ratio * math.cos(tilt) - np.sqrt(1.0 - ratio * ratio) * math.sin(tilt)
    return np.where(possible, sine, np.nan)


def angle_of_depth(depth: ArrayLike, slant_range: ArrayLike, tilt: float) -> FloatArray:
    """Angle theta = asin(D / r) - tilt; NaN where abs(D) > r."""
    ratio = _ratio(depth, slant_range)
    possible = np.abs(ratio) <= 1.0
    return np.where(possible, np.arcsin(np.where(possible, ratio, 0.0)) - tilt, np.nan)


def depth_of_angle(angle: ArrayLike, slant_range: ArrayLike, tilt: float) -> FloatArray:
    """Depth D = r sin(theta + tilt) below the sonar of an echo at the angle theta."""
    return np.asarray(slant_range, np.float64) * np.sin(np.asarray(angle, np.float64) + tilt)


def across_track(depth: ArrayLike, slant_range: ArrayLike) -> FloatArray:
    """Horizontal distance sqrt(r^2 - D^2) outward from the sonar; NaN where abs(D) > r."""
    rest = np.square(np.asarray(slant_range, np.float64)) - np.square(
        np.asarray(depth, np.float64)
    )
    return np.where(rest >= 0.0, np.sqrt(np.maximum(rest, 0.0)), np.nan)


def phase_step(spacing: float, *, conjugate: bool = False) -> float:
    """Phase in radians from one stave to the next for u = 1: 2 pi spacing, negative if
    conjugated."""
    return -2.0 * math.pi * spacing if conjugate else 2.0 * math.pi * spacing


def steering(
    sine: ArrayLike, staves: int, spacing: float, *, conjugate: bool = False
) -> ComplexArray:
    """Steering vectors a (..., staves): a_p = exp(i 2 pi spacing p u), stave 0 first."""
    step = phase_step(spacing, conjugate=conjugate)
    return np.exp(1j * step * np.asarray(sine, np.float64)[..., None] * np.arange(staves))


def largest_sine(spacing: float) -> float:
    """Largest direction sine that staves this far apart tell from its aliases, at most 1."""
    return min(1.0, 0.5 / spacing)


def direction_grid(staves: int, spacing: float, *, oversampling: int = 8) -> FloatArray:
    """Even grid (m,) of direction sines up to `largest_sine`, `oversampling` points per beam
    width."""
    largest = largest_sine(spacing)
    points = math.ceil(2.0 * largest * spacing * staves * oversampling)
    return np.linspace(-largest, largest, max(points, FEWEST_POINTS) + 1)


def multipath_sines(
    depth: ArrayLike, slant_range: ArrayLike, tilt: float, surface: float
) -> FloatArray:
    """Directions (..., 2) of the two echoes that a calm surface `surface` metres above the sonar
    adds to the bin of a floor `depth` below it: the surface itself, and the floor seen in the
    mirror of the surface, where it appears 2 surface + D above the sonar. NaN where there is none.
    """
    floor = np.asarray(depth, np.float64)
    mirrored = np.stack(np.broadcast_arrays(np.full(floor.shape, -surface), -2 * surface - floor))
    return np.moveaxis(direction_sine(mirrored, slant_range, tilt), 0, -1)


def _ratio(depth: ArrayLike, slant_range: ArrayLike) -> FloatArray:
    """D / r, NaN or infinite at r = 0."""
    with np.errstate(divide='ignore', invalid='ignore'):
        return np.asarray(depth, np.float64) / np.asarray(slant_range, np.float64)
