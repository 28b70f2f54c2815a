# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Where an echo of a side-scan array on a moving ship comes from, and how sure that is.

The array looks to one side (`s` = +1 port, -1 starboard), `tilt` below the deck's horizon. In the
body of the ship (FLU), with the rotation M of the mount, it has three axes::

    e = M (0, -s sin tilt, -cos tilt)      along the staves, downward
    b = M (0,  s cos tilt, -sin tilt)      broadside
    a = M (1, 0, 0)                        fore

Measured are the slant range r and the direction sine u = n.e, a cone about e. The beam of a long
aperture is a flat fan, n.a = 0, so that with the attitude R (world ENU from body)

    n = u R e + sqrt(1 - u^2) R b,    point = p_s + r n

The height z of a floor in the world then gives u with the formula of a level array
(`array.direction_sine`) and two numbers for each echo, because n_z is all that z knows of n::

    C = hypot((R e)_z, (R b)_z),    psi = atan2(-(R b)_z, -(R e)_z)
    s = (p_z - z) / (r C),          u = s cos psi - sqrt(1 - s^2) sin psi

A level ship has C = 1, psi = tilt. Under `rays` the slope ``(p_z - z) / r`` becomes the sine of
the elevation at which the ray leaves the array.

The attitude is that at the reception of the echo, p_s the mean of transmission and reception.

Conventions
    Metres and radians. World east-north-up, body forward-port-up.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from attrs import frozen
import numpy as np

from ..estimation.arrays import FloatArray
from .geometry import apply, Pose

STEEPEST = 20.0
"""Slope D / Y from which on a vertical error no longer counts as a horizontal one: straight below
the array the place is not in doubt."""


class ArrayAxes(NamedTuple):
    """Axes (3,) of an array in the body of the ship: along the staves, broadside."""

    stave: FloatArray
    broadside: FloatArray


class Looks(NamedTuple):
    """How an array looked at the reception of each of T echoes.

    position: (T, 3) of the array, m; stave, broadside: (T, 3) its axes in the world; psi (T,) rad
    and C (T,): see the module.
    """

    position: FloatArray
    stave: FloatArray
    broadside: FloatArray
    psi: FloatArray
    C: FloatArray


@frozen(kw_only=True)
class ErrorBudget:
    """Standard deviations of what a ping's pose and sound speed are known to: attitude (roll and
    pitch), heading rad; heave, position (of one horizontal axis) m; sound_speed m/s."""

    attitude: float
    heading: float
    heave: float
    position: float
    sound_speed: float


@frozen
class GeometryDoubt:
    """Standard deviations of what an array and the water are known to: tilt, rad; the spacing of
    the staves and the sound speed, as shares; sine: of all direction sines together, which phases
    of staves leave."""

    tilt: float
    spacing: float
    sound_speed: float
    sine: float = 0.0


def geometry_variance(
    depth: FloatArray, distance: FloatArray, angle: FloatArray, doubt: GeometryDoubt
) -> tuple[FloatArray, FloatArray]:
    """Variances (...,) m^2, vertical and horizontal, that all bins and pings have in common.

    D depth below and Y distance from the array, theta the angle from broadside. The tilt turns the
    swath; the spacing bends it, since u = sin theta is that share wrong; the sound speed does the
    same, and scales the ranges::

        (Y s_tilt)^2 + (s_spacing Y tan theta)^2 + s_c^2 (D + Y tan theta)^2
        + (s_sine Y / cos theta)^2

    Consider parameters (Schmidt): nothing is estimated of them, since tilt is a slope of the floor
    and the others a bend.
    """
    D, Y = np.abs(depth), np.asarray(distance, np.float64)
    t = np.clip(np.tan(angle), -STEEPEST, STEEPEST)
    turned = doubt.tilt**2 + np.square(doubt.spacing * t)
    turned += np.square(doubt.sine) * (1.0 + np.square(t))
    vertical = np.square(Y) * turned + np.square(doubt.sound_speed * (D + Y * t))
    horizontal = np.square(D) * turned + np.square(doubt.sound_speed * (Y - D * t))
    return vertical, horizontal


def array_axes(side: str, tilt: float, mount: FloatArray) -> ArrayAxes:
    """The axes of an array that looks to `side`, ``'port'`` or ``'starboard'``; mount (3, 3)."""
    s = 1.0 if side == 'port' else -1.0
    return ArrayAxes(
        mount @ np.array([0.0, -s * math.sin(tilt), -math.cos(tilt)]),
        mount @ np.array([0.0, s * math.cos(tilt), -math.sin(tilt)]),
    )


def looks(axes: ArrayAxes, lever: FloatArray, sent: Pose, received: Pose) -> Looks:
    """How the array looked at T echoes, from the poses of the ship: `sent` (3,), (3, 3) when the
    ping was sent, `received` (T, 3), (T, 3, 3) when each echo arrived; lever (3,) from the
    navigation reference to the array, in the body."""
    there = received.position + apply(received.R, lever)
    stave, broadside = apply(received.R, axes.stave), apply(received.R, axes.broadside)
    return Looks(
        position=0.5 * (sent.position + sent.R @ lever + there),
        stave=stave,
        broadside=broadside,
        psi=np.arctan2(-broadside[..., 2], -stave[..., 2]),
        C=np.hypot(stave[..., 2], broadside[..., 2]),
    )


def direction(look: Looks, u: FloatArray) -> FloatArray:
    """Unit vectors (T, 3) in the world towards echoes of direction sine u (T,)."""
    u = u[..., None]
    return np.asarray(u * look.stave + np.sqrt(1.0 - u * u) * look.broadside)


def beam_angle(n: FloatArray, side: str) -> FloatArray:
    """Angle (...,) of directions n (..., 3) from straight down, positive on the port side."""
    angle = np.arccos(np.clip(-n[..., 2], -1.0, 1.0))
    return angle if side == 'port' else -angle


def uncertainties(
    variance: FloatArray,
    depth: FloatArray,
    distance: FloatArray,
    budget: ErrorBudget,
    sound_speed: float,
) -> tuple[FloatArray, FloatArray]:
    """Variances (...,) m^2 of soundings: vertical, and horizontal (of both axes together).

    variance: of the filter, of z; depth D below and horizontal distance Y from the array. To first
    order: attitude and heading turn the place about the array, heave and position shift it. An
    error of the sound speed over the depth bends the ray; it dominates beyond Y = 2 D.
    """
    D, Y = np.abs(depth), np.asarray(distance, np.float64)
    share = budget.sound_speed / sound_speed
    with np.errstate(divide='ignore', invalid='ignore'):
        over = np.where(D > 0.0, Y / D, np.inf)
        steepness = np.fmin(D / Y, STEEPEST)
    bent = np.where(Y > 0.0, 0.5 * share * Y * over, 0.0)
    bent_aside = np.where(Y > 0.0, 0.5 * share * Y * np.minimum(1.0, STEEPEST * over), 0.0)
    vertical = variance + np.square(budget.attitude * Y) + budget.heave**2
    vertical += np.square(bent) + np.square(share * D)
    horizontal = np.square(steepness) * variance + np.square(bent_aside)
    horizontal += 2.0 * np.square(budget.attitude * D) + np.square(budget.heading * Y)
    horizontal += 2.0 * budget.position**2 + np.square(share * Y)
    return vertical, horizontal
