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

"""Multistatic ranging: what sound that passes a target tells about where the target is.

A ping leaves a transmitter at a known time, meets the target and arrives at several receivers.
Arrival time times sound speed is a **range sum**, transmitter - target - receiver: the target lies
on an ellipse with the two as foci (in three dimensions an ellipsoid; here cut at the known height
`target_z` of the target). Between the foci the two unit vectors cancel, the gradient vanishes and
the range sum says nothing to first order: the singular baseline. A receiver with an array also
hears the **bearing**.

An acoustic tag emits by itself at an unknown time. Its one-way arrivals are **pseudo-ranges**:
slant ranges plus an offset common to all receivers. `difference_measurement` takes the offset out
without choosing a reference receiver; `emission_time` estimates it once the position is known.

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

from attrs import frozen
import numpy as np
from numpy.typing import ArrayLike, NDArray

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


def pseudo_range(
    position: ArrayLike, rx: ArrayLike, target_z: float, offset: ArrayLike = 0.0
) -> FloatArray:
    """One-way range (..., n) plus the common `offset` (...) in metres: sound speed times time of
    emission."""
    return slant_range(position, rx, target_z)[0] + np.asarray(offset, np.float64)[..., None]


def pseudo_range_jacobian(position: ArrayLike, rx: ArrayLike, target_z: float) -> FloatArray:
    """Derivative (..., n, 2) of `pseudo_range` by x, y (by the offset it is 1)."""
    return slant_range(position, rx, target_z)[1]


@frozen(eq=False)
class DifferenceMeasurement:
    """n pseudo-ranges without their common offset: n - 1 whitened numbers, ready for an EKF
    update.

    z: (n - 1,); R: (n - 1, n - 1), the identity, since z is in standard deviations; projection: (n
    - 1, n), which turns ranges in metres into what z measures. Densities of z differ from those of
    differences in metres by a factor that does not depend on the target.
    """

    z: FloatArray
    R: FloatArray
    projection: FloatArray

    def predict(self, position: ArrayLike, rx: ArrayLike, target_z: float) -> FloatArray:
        """Expected z (..., n - 1) of a target at `position`; `rx` (n, 3) in the order of the
        arrivals."""
        return pseudo_range(position, rx, target_z) @ self.projection.T

    def jacobian(self, position: ArrayLike, rx: ArrayLike, target_z: float) -> FloatArray:
        """Derivative (..., n - 1, 2) of `predict`."""
        return self.projection @ pseudo_range_jacobian(position, rx, target_z)


def difference_measurement(
    toa: ArrayLike, var_toa: ArrayLike, sound_speed: float
) -> DifferenceMeasurement:
    """Take the unknown time of emission out of the arrival times `toa` (n,) s with variances
    `var_toa` (n,) s^2.

    With m = c toa = r(p) + b 1 + e and e ~ N(0, D), every projection T with T 1 = 0 and T D T' = I
    keeps exactly what a flat prior on b leaves: the information D^-1 - D^-1 1 1' D^-1 / (1' D^-1
    1). T is built from the Householder reflection that sends D^-1/2 1 to the first axis, so no
    receiver is the reference. Raises ValueError for fewer than two arrivals, times that are not
    finite and variances that are not positive.
    """
    times, variances = np.asarray(toa, np.float64), np.asarray(var_toa, np.float64)
    if times.ndim != 1 or times.shape != variances.shape or len(times) < 2:
        raise ValueError('time differences need two or more arrival times and as many variances')
    if not (np.isfinite(times).all() and np.isfinite(variances).all() and (variances > 0.0).all()):
        raise ValueError('arrival times must be finite and their variances positive')
    projection = difference_projection(np.square(sound_speed) * variances)
    # The projection ignores a constant: taking one off keeps the digits of times since 1970.
    return DifferenceMeasurement(
        z=projection @ (sound_speed * (times - times[0])),
        R=np.eye(len(times) - 1),
        projection=projection,
    )


def difference_projection(variances: FloatArray) -> FloatArray:
    """(n - 1, n): turns ranges in metres with `variances` (n,) m^2 and a common offset into n - 1
    numbers without it, uncorrelated and in standard deviations."""
    weight = 1.0 / np.sqrt(variances)
    axis = weight / np.linalg.norm(weight)
    axis[0] += 1.0
    reflection = np.eye(len(weight)) - np.outer(axis, axis) * (2.0 / (axis @ axis))
    return np.asarray(reflection[1:] * weight)


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


def crlb(
    position: ArrayLike,
    tx: ArrayLike | None,
    rx: ArrayLike,
    var_toa: ArrayLike,
    *,
    target_z: float,
    sound_speed: float,
    sound_speed_std: float = 0.0,
    var_bearing: ArrayLike | None = None,
) -> FloatArray:
    """Cramer-Rao bound (..., 2, 2) in m^2 on any unbiased fix at `position` (..., 2).

    tx (n, 3), a row NaN or the whole of it None where the target itself emits at an unknown time;
    rx (n, 3); var_toa (n,) s^2 and var_bearing (n,) rad^2, NaN or infinite where not measured;
    sound_speed_std in m/s is the error of the sound speed common to all arrivals. Emission time
    (flat prior) and sound speed (Gaussian prior) are nuisance parameters, taken out by the Schur
    complement. Where the geometry does not fix the position the bound is infinite: inf on the
    diagonal, 0 beside it.
    """
    rx_ = np.asarray(rx, np.float64)
    tx_ = np.full_like(rx_, np.nan) if tx is None else np.asarray(tx, np.float64)
    active: NDArray[np.bool_] = np.asarray(np.isfinite(tx_).all(axis=-1))
    to_tx, to_tx_jacobian = slant_range(position, np.where(active[:, None], tx_, rx_), target_z)
    to_rx, to_rx_jacobian = slant_range(position, rx_, target_z)
    path = to_rx + active * to_tx
    jacobian = to_rx_jacobian + active[:, None] * to_tx_jacobian
    # In metres, m = c t: a wrong sound speed stretches the path, and an emission time, in metres
    # too, shifts the passive rows.
    emission = np.broadcast_to(~active, path.shape)
    rows = np.concatenate([jacobian, emission[..., None], -path[..., None] / sound_speed], axis=-1)
    weight = _inverse_variance(var_toa, len(rx_)) / sound_speed**2
    information = np.swapaxes(rows, -1, -2) @ (weight[:, None] * rows)
    if var_bearing is not None:
        across = bearing_jacobian(position, rx_)
        weight = _inverse_variance(var_bearing, len(rx_))
        information[..., :2, :2] += np.swapaxes(across, -1, -2) @ (weight[:, None] * across)
    information = (
        information[..., :3, :3]
        if sound_speed_std <= 0.0
        else _without_last(information + np.diag([0.0, 0.0, 0.0, sound_speed_std**-2]))
    )
    return _inverse_or_infinite(_without_last(information))


def _offset(
    position: ArrayLike, points: ArrayLike, target_z: float
) -> tuple[FloatArray, FloatArray]:
    """Horizontal vectors (..., n, 2) from points to position, and heights (n,) of the target above
    the points."""
    place, points_ = np.asarray(position, np.float64), np.asarray(points, np.float64)
    return place[..., None, :] - points_[:, :2], target_z - points_[:, 2]


def _inverse_variance(variance: ArrayLike, n: int) -> FloatArray:
    """1 / variance (n,), zero where it is NaN, infinite or not positive: not measured."""
    values = np.broadcast_to(np.asarray(variance, np.float64), (n,))
    usable = np.isfinite(values) & (values > 0.0)
    return np.where(usable, 1.0 / np.where(usable, values, 1.0), 0.0)


def _without_last(information: FloatArray) -> FloatArray:
    """Information (..., n - 1, n - 1) on the other parameters once the last one is estimated
    too."""
    last = information[..., -1, -1][..., None, None]
    column = information[..., :-1, -1:]
    loss = column @ np.swapaxes(column, -1, -2) / np.where(last > 0.0, last, 1.0)
    return information[..., :-1, :-1] - loss


def _inverse_or_infinite(information: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(information)
    regular = values[..., 0] > 1e-12 * values[..., -1]
    divisor = np.where(regular[..., None], values, 1.0)[..., None, :]
    inverse = (vectors / divisor) @ np.swapaxes(vectors, -1, -2)
    return np.where(regular[..., None, None], inverse, np.diag([np.inf, np.inf]))
