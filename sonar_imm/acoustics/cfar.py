"""Echoes in an image of a forward-looking sonar: cell-averaging CFAR.

A cell holds an echo when its power exceeds the mean of the cells before and behind it in range by
a factor that keeps the rate of false alarms constant, whatever the level of the noise. For noise
of exponentially distributed power, what is left after a beamformer of many elements, N averaged
cells and a false alarm probability p ask for the factor ``N (p^(-1/N) - 1)``. Cells next to the
one under test are left out (guard), because an echo is wider than a cell. Of the cells of one echo
only the strongest counts.

Source: Finn & Johnson 1968, 'Adaptive detection mode with threshold control'.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..estimation.arrays import FloatArray


def noise_level(power: FloatArray, guard: int, training: int) -> tuple[FloatArray, FloatArray]:
    """Mean power (R, B) of the `training` cells on either side in range beyond `guard` cells, and
    how many cells (R,) were averaged: fewer at the ends."""
    rows = len(power)
    total = np.vstack([np.zeros((1, power.shape[1])), np.cumsum(power, axis=0)])
    cell = np.arange(rows)
    before = np.clip(cell - guard - training, 0, rows), np.clip(cell - guard, 0, rows)
    behind = np.clip(cell + guard + 1, 0, rows), np.clip(cell + guard + 1 + training, 0, rows)
    count = (before[1] - before[0] + behind[1] - behind[0]).astype(float)
    summed = total[before[1]] - total[before[0]] + total[behind[1]] - total[behind[0]]
    return summed / np.maximum(count, 1.0)[:, None], count


def cfar_peaks(
    amplitude: FloatArray, *, guard: int = 2, training: int = 12, false_alarm: float = 1e-6
) -> NDArray[np.intp]:
    """Range bin and beam (n, 2) of the echoes in `amplitude` (R, B), strongest first.

    Raises ValueError for an image that is not two-dimensional. Cells that are not finite count as
    silence.
    """
    if amplitude.ndim != 2:
        raise ValueError(f'an image (R, B) is needed, got the shape {amplitude.shape}')
    if not amplitude.size:
        return np.empty((0, 2), np.intp)
    from scipy.ndimage import maximum_filter

    # Squares of the largest float32 still fit into a float64.
    power = np.square(np.where(np.isfinite(amplitude), amplitude, 0.0).clip(-1e38, 1e38))
    noise, count = noise_level(power, guard, training)
    N = np.maximum(count, 1.0)
    factor = N * np.expm1(-np.log(false_alarm) / N)
    loud = (power > factor[:, None] * noise) & (count >= training)[:, None]
    loud &= power == maximum_filter(power, size=(2 * guard + 1, 3), mode='constant')
    found = np.argwhere(loud)
    order = np.argsort(-power[loud], kind='stable')
    return found[order]
