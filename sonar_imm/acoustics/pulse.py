# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The pulse that one reflector leaves on a depth response, and the Gram matrix of several.

A response that has been correlated with its pulse shows the pulse's own autocorrelation, one at
its peak and even in the distance from it; its noise has the same correlation. Three ways to know
it: flat spectrum in a band, a Gaussian hump, or as measured.

A flat band f1 .. f2 gives, with the two-way time tau = 2 delta / c,

    G(delta) = (sin 2 pi f2 tau - sin 2 pi f1 tau) / (2 pi (f2 - f1) tau)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

from attrs import frozen
import numpy as np
from numpy.typing import ArrayLike

from ..estimation.arrays import FloatArray

Pulse = Callable[[FloatArray], FloatArray]
"""Distances in m to values, one at 0, even."""


@frozen(eq=False)
class SampledPulse:
    """A pulse of `value` (k,) at `distance` (k,) m, rising from 0; interpolated, zero beyond."""

    distance: Annotated[FloatArray, 'd']
    value: Annotated[FloatArray, 'd']

    def __call__(self, delta: FloatArray) -> FloatArray:
        away = np.abs(np.asarray(delta, np.float64))
        return np.interp(away, self.distance, self.value, right=0.0)


def band_pulse(frequency_min: float, frequency_max: float, sound_speed: float) -> Pulse:
    """Pulse of a flat spectrum from `frequency_min` to `frequency_max`, Hz."""
    if not 0.0 <= frequency_min < frequency_max:
        raise ValueError('a band needs 0 <= frequency_min < frequency_max')

    def pulse(delta: FloatArray) -> FloatArray:
        tau = 2.0 * np.asarray(delta, np.float64) / sound_speed
        upper = frequency_max * np.sinc(2.0 * frequency_max * tau)
        lower = frequency_min * np.sinc(2.0 * frequency_min * tau)
        return np.asarray((upper - lower) / (frequency_max - frequency_min))

    return pulse


def envelope_pulse(frequency_min: float, frequency_max: float, sound_speed: float) -> Pulse:
    """Pulse of the envelope of a response of a flat spectrum: |sinc(B tau)|, B the bandwidth."""
    if not 0.0 <= frequency_min < frequency_max:
        raise ValueError('a band needs 0 <= frequency_min < frequency_max')
    width = 2.0 * (frequency_max - frequency_min) / sound_speed
    return lambda delta: np.abs(np.sinc(width * np.asarray(delta, np.float64)))


def gaussian_pulse(width: float) -> Pulse:
    """A hump of standard deviation `width`, m."""
    if not width > 0.0:
        raise ValueError('the width of a pulse must be positive')
    return lambda delta: np.exp(-0.5 * np.square(np.asarray(delta, np.float64) / width))


def measured_pulse(distance: ArrayLike, value: ArrayLike) -> Pulse:
    """A pulse sampled at `distance` (k,) m, interpolated, zero further out; scaled to one at its
    distance zero. ValueError when that cannot be."""
    x, y = np.asarray(distance, np.float64), np.asarray(value, np.float64)
    if x.ndim != 1 or x.shape != y.shape or len(x) < 2:
        raise ValueError('a measured pulse needs two columns of equal length, distance and value')
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise ValueError('a measured pulse must be finite')
    order = np.argsort(np.abs(x), kind='stable')
    x, y = np.abs(x[order]), y[order]
    # Both flanks may have been measured: the pulse is even, so they are averaged.
    x, group = np.unique(x, return_inverse=True)
    y = np.bincount(group, weights=y) / np.bincount(group)
    if x[0] > 1e-9 or not y[0] > 0.0:
        raise ValueError('a measured pulse needs a positive value at distance 0')
    return SampledPulse(x, y / y[0])


def gram(pulse: Pulse, places: ArrayLike) -> FloatArray:
    """G (m, m) between reflectors at `places` (m,), m."""
    z = np.asarray(places, np.float64)
    return pulse(z[:, None] - z[None, :])


def independent_samples(pulse: Pulse, window: float, step: float) -> float:
    """How many independent samples a response over `window` metres has: window / int G^2.

    For a band this is 2 B T, T the two-way time of the window. The integral is a sum over a
    lattice of `step` metres.
    """
    lags = step * np.arange(1, max(2, round(window / step)), dtype=np.float64)
    return window / float(step * (1.0 + 2.0 * np.sum(np.square(pulse(lags)))))
