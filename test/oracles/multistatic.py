# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The Cramer-Rao bound of a fix from arrival times and bearings."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from sonar_imm.acoustics.multistatic import bearing_jacobian, slant_range
from sonar_imm.estimation.arrays import FloatArray


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
