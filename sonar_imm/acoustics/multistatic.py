# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Multistatic ranging: the position of a target from sound that passes by it.

A ping leaves a transmitter at a known time, meets the target and arrives at several receivers.
Arrival time times sound speed is a **range sum**, transmitter - target - receiver: the target lies
on an ellipse with the two as foci (in three dimensions an ellipsoid; here cut at the known height
`target_z` of the target). Between the foci the two unit vectors cancel, the gradient vanishes and
the range sum says nothing to first order: the singular baseline. A receiver with an array also
measures the **bearing**.

An acoustic tag emits by itself at an unknown time. Its one-way arrivals are **pseudo-ranges**:
slant ranges plus an offset common to all receivers; `emission_time` estimates it once the position
is known.

Conventions
    position (..., 2): x, y in metres, any leading axes (models, particles, starts of a search);
    target_z in metres; tx, rx (n, 3): metres in the same frame; bearings in radians at the
    receiver, counter-clockwise from +x. Jacobians are derivatives by x, y. A direction is
    undefined where two points coincide: it is the mean over all directions of approach there, that
    is zero, so that such a row carries no information and never a NaN.

Source: Y. Bar-Shalom, X. R. Li, T. Kirubarajan, *Estimation with Applications to Tracking and
Navigation*, 2001, chapters 2 (Fisher information, nuisance parameters) and 10 (range and bearing
models).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ..estimation.arrays import FloatArray

COINCIDENT = 1e-6
"""Horizontal distance in metres below which target and receiver count as one point for a
bearing."""


def slant_range(
    position: ArrayLike, points: ArrayLike, target_z: float
) -> tuple[FloatArray, FloatArray]:
    """Distance (..., n) from points (n, 3) to the target, and its Jacobian (..., n, 2)."""
    offset, height = _offset(position, points, target_z)
    distance = np.sqrt(np.square(offset).sum(axis=-1) + np.square(height))
    return distance, offset / np.where(distance > 0.0, distance, 1.0)[..., None]


def range_sum(position: ArrayLike, tx: ArrayLike, rx: ArrayLike, target_z: float) -> FloatArray:
    """Length (..., n) of the path transmitter - target - receiver in metres.

    >>> range_sum([3.0, 4.0], [[0.0, 0.0, 0.0]], [[3.0, 0.0, 0.0]], target_z=0.0).tolist()
    [9.0]
    """
    return slant_range(position, tx, target_z)[0] + slant_range(position, rx, target_z)[0]


def range_sum_jacobian(
    position: ArrayLike, tx: ArrayLike, rx: ArrayLike, target_z: float
) -> FloatArray:
    """Derivative (..., n, 2) of `range_sum`: the sum of two unit vectors, zero on the baseline."""
    return slant_range(position, tx, target_z)[1] + slant_range(position, rx, target_z)[1]


def bearing(position: ArrayLike, rx: ArrayLike) -> FloatArray:
    """Direction (..., n) of the target seen from each receiver, in [-pi, pi]; 0 where they
    coincide.

    >>> bearing([0.0, 5.0], [[0.0, 0.0, 0.0]]).round(4).tolist()  # due north
    [1.5708]
    """
    offset, _ = _offset(position, rx, 0.0)
    return np.arctan2(offset[..., 1], offset[..., 0])


def bearing_jacobian(position: ArrayLike, rx: ArrayLike) -> FloatArray:
    """Derivative (..., n, 2) of `bearing`; zero within `COINCIDENT` of the receiver."""
    offset, _ = _offset(position, rx, 0.0)
    squared = np.square(offset).sum(axis=-1)
    inverse = np.where(squared > COINCIDENT**2, 1.0 / np.maximum(squared, COINCIDENT**2), 0.0)
    return np.stack([-offset[..., 1] * inverse, offset[..., 0] * inverse], axis=-1)


def emission_time(
    toa: ArrayLike,
    var_toa: ArrayLike,
    rx: ArrayLike,
    position: ArrayLike,
    *,
    target_z: float,
    sound_speed: float,
    covariance: ArrayLike | None = None,
) -> tuple[float, float]:
    """When a target at `position` (2,) emitted what arrived at `toa` (n,): the time in s and its
    variance in s^2.

    The time maximises the likelihood for that position (the profile estimate): the weighted mean
    of arrival time less travel time. With the `covariance` (2, 2) of the position the variance is
    that of the joint estimate.
    """
    times, weight = np.asarray(toa, np.float64), 1.0 / np.asarray(var_toa, np.float64)
    distance, direction = slant_range(position, rx, target_z)
    total = weight.sum()
    time = times[0] + weight @ (times - times[0] - distance / sound_speed) / total
    variance = 1.0 / total
    if covariance is not None:
        slope = weight @ direction / (sound_speed * total)
        variance += slope @ np.asarray(covariance, np.float64) @ slope
    return float(time), float(variance)


def _offset(
    position: ArrayLike, points: ArrayLike, target_z: float
) -> tuple[FloatArray, FloatArray]:
    """Horizontal vectors (..., n, 2) from points to position, and heights (n,) of the target above
    the points."""
    place, points_ = np.asarray(position, np.float64), np.asarray(points, np.float64)
    return place[..., None, :] - points_[:, :2], target_z - points_[:, 2]
