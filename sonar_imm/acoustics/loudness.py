# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Detection of an echo in a range bin by its power, where the noise is known.

Coherence (`coherence`) separates an echo from noise of any level, but supposes that an echo is one
plane wave. A diffuse floor under a wide aperture is not: its staves differ even 78 dB above the
noise. And two staves are coherent by chance too often for a decision on one bin. A power far above
a noise that is known is an echo, whatever its coherence.

Noise fades like the echoes in the law of `laplace`, y = sqrt(z) g: the power of a bin, the mean of
P staves in powers of the noise, is t = z Gamma(P) / P, and exceeds a level with the probability

    Pr(t > x / P) = 2 / Gamma(P) x^(P/2) K_P(2 sqrt(x))

and levels for the mean of several bins come from convolving that. Thermal noise, which does not
fade, passes them less often.

Loud bins that are bursts, far above all around them, are no floor.
"""

from __future__ import annotations

from functools import lru_cache
import math

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import median_filter
from scipy.special import kve

from ..estimation.arrays import BoolArray, FloatArray
from .variances import moving_mean

VERY_LOUD = 100.0
"""Noise never has this many times its mean power: 20 dB."""
BURST = 30.0
"""A burst has this many times the median power of the bins before it, and of those after it, as
one echo in a hundred does whose power fades exponentially."""
_BURST_BINS = 20
_CELLS, _HIGHEST = 1 << 14, 64.0


def noise_exceeds(level: ArrayLike, staves: int) -> FloatArray:
    """Probability that noise has more than `level` times its mean power in a bin."""
    x = staves * np.asarray(level, np.float64)
    root = np.sqrt(x)
    with np.errstate(divide='ignore', invalid='ignore'):
        log = 0.5 * staves * np.log(x) + np.log(kve(staves, 2.0 * root)) - 2.0 * root
        value = 2.0 * np.exp(log - math.lgamma(staves))
    return np.where(x > 0.0, np.minimum(value, 1.0), 1.0)


@lru_cache(maxsize=128)
def loud_level(staves: int, bins: int, false_alarm: float) -> float:
    """Mean power of `bins` bins, in noise powers, that noise passes with probability
    `false_alarm`."""
    levels = _HIGHEST * np.arange(_CELLS + 1) / _CELLS
    mass = -np.diff(noise_exceeds(levels, staves))
    length = bins * _CELLS
    total = np.fft.irfft(np.fft.rfft(mass, length) ** bins, length)
    tail = np.cumsum(np.maximum(total, 0.0)[::-1])[::-1]
    # The mass of each cell stands at its lower end, half a cell too low on average.
    cells = int(np.argmax(tail <= false_alarm)) + 0.5 * bins
    return _HIGHEST * cells / (bins * _CELLS)


def loud_bins(ratio: FloatArray, level: float, *, bins: int, usable: BoolArray) -> BoolArray:
    """Bins (n,) whose mean power over `bins` bins, of `ratio` (n,) in noise powers, is above
    `level`, without bursts."""
    mean = moving_mean(ratio, bins // 2, usable)
    return (mean > level) & usable & ~bursts(ratio)


def diffuse_bins(ratio: FloatArray, silent: BoolArray, usable: BoolArray) -> BoolArray:
    """Bins (n,) of `ratio` (n,) noise powers in a stretch that is very loud and mostly not
    coherent, `silent` (n,): echoes of a diffuse floor. A burst of noise is incoherent too, but
    alone among echoes that are coherent."""
    above = usable & (ratio > VERY_LOUD)
    if np.count_nonzero(above & silent) < _BURST_BINS // 4:
        return np.zeros(len(ratio), bool)  # what holds for most pings, so it had better be quick
    loud = above & ~bursts(ratio)
    share = moving_mean(silent, _BURST_BINS // 2, loud)
    stretch = moving_mean(loud, _BURST_BINS // 2) >= 0.5
    return loud & stretch & (share > 0.5)


def bursts(power: FloatArray) -> BoolArray:
    """Bins (n,) that stand far above both sides of their neighbourhood."""
    n = min(_BURST_BINS, len(power))
    half = n // 2
    shift = n - half
    centred = median_filter(np.where(np.isfinite(power), power, 0.0), size=n, mode='nearest')
    place = np.arange(len(power))
    before = centred[np.clip(place - shift, 0, len(power) - 1)]
    after = centred[np.clip(place + shift, 0, len(power) - 1)]
    return power > BURST * np.maximum(before, after)
