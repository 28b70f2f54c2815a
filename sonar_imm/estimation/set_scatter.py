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

"""Volume scatter below the first member of a set: a background that begins where the set does.

What scatters everywhere below a surface is no sum of a few things. Its mean in the record is a
level v times a decaying profile D that begins at the first member, in cell k, and its own
fluctuation is a share of that mean:

    mean of the background:  v D(z - k),    its deviation:  spread v D(z - k)

D is ``exp(-lag / decay)`` from lag 0 on, smoothed by the pulse. What remains of the record when
all that stands out is cut off (`without_peaks`) has this background alone, and noise. An envelope
of scatter is never near zero where its mean is not: it has a gamma distribution, of shape 1 /
spread^2. With x = that record plus one, the noise, and mu = v D + 1, against noise alone,

    F(k, v, decay) = share / spread^2 * sum_z [x (1 - 1 / mu) - log mu]

where `share` is how many independent samples a cell is worth. F is a correlation of x, for all k
at once. Levels and decays are tried on a grid, also the level 0:

    evidence(k)    log of the mean of exp F over the grid; a set whose first member is at k has it;
    level, decay   the best of the grid for that k: members are seen against this background, as
                   ``(b - v D) / s`` in place of b, ``s^2 = 1 + (spread v D)^2``.

A set without members has no background. What is faint may lie before what scatters, such as a soft
floor above a hard layer: where the second member is louder than the first and `window` cells or
more below it, the scatter begins at either with the same probability, and a set has the mean of
both. As s changes little within a pulse, the pulses of members
keep their form.

The idea is that of the sonar equation: reverberation is a noise whose level is known once its
beginning is (R. J. Urick, *Principles of Underwater Sound*, chapter 8).
"""

from __future__ import annotations

import math
from typing import NamedTuple

from attrs import field, frozen
import numpy as np
from scipy.ndimage import median_filter

from .arrays import FloatArray, IntArray

LEVEL_RATIO = 1.5
"""From one level of the grid to the next; the least is one standard deviation of the noise."""
_CERTAIN = 5.0


@frozen(eq=False, kw_only=True)
class Scatter:
    """profile (D, 2 n - 1) by lag -(n - 1) .. n - 1 in cells, a row for each decay; spread:
    standard deviation over mean; share: independent samples for each cell, at most 1; window:
    cells of which `without_peaks` takes the median."""

    profile: FloatArray = field(repr=False)
    spread: float
    share: float
    window: int

    def __attrs_post_init__(self) -> None:
        if self.profile.ndim != 2 or not self.profile.shape[1] % 2:
            raise ValueError(
                'the profile of scatter needs a row for each decay, lag 0 in the middle'
            )
        if not (np.isfinite(self.profile).all() and (self.profile >= 0.0).all()):
            raise ValueError('the profile of scatter must be finite and not negative')
        if not (self.spread > 0.0 and 0.0 < self.share <= 1.0):
            raise ValueError('scatter needs a positive spread and a share in (0, 1]')


class ScatterFit(NamedTuple):
    """The background of one record for each cell k that the first member may have: evidence (n,);
    level (n,) in units of the noise; row (n,) of `profile` (D, 2 n - 1); spread; apart: cells from
    which on a second member can be told from the breadth of the first. Without scatter all are
    empty."""

    evidence: FloatArray
    level: FloatArray
    row: IntArray
    profile: FloatArray
    spread: float
    apart: int


def decaying_profile(pulse: FloatArray, decays: FloatArray) -> FloatArray:
    """D (D, 2 n - 1) for `decays` (D,) in cells and the pulse (n,) by lag, of which nothing below
    zero is used. Its area is that of the exponential."""
    n = len(pulse)
    kernel = np.maximum(np.concatenate([pulse[:0:-1], pulse]), 0.0)
    kernel /= kernel.sum()
    lag = np.arange(-(n - 1), n, dtype=np.float64)
    edge = np.where(lag == 0.0, 0.5, (lag > 0.0).astype(np.float64))
    rows = []
    for decay in decays:
        sharp = edge * np.exp(-np.maximum(lag, 0.0) / decay)
        size = 1 << math.ceil(math.log2(4 * n))
        smooth = np.fft.irfft(np.fft.rfft(sharp, size) * np.fft.rfft(kernel, size), size)
        rows.append(np.maximum(smooth[n - 1 : 3 * n - 2], 0.0))
    return np.array(rows)


NO_SCATTER = ScatterFit(np.empty(0), np.empty(0), np.empty(0, np.int64), np.empty((0, 1)), 0.0, 0)


def fit_scatter(scatter: Scatter, b: FloatArray) -> ScatterFit:
    """The background of the record b (n,), in units of its noise."""
    n, profile = len(b), scatter.profile
    middle = profile.shape[1] // 2
    D = np.ascontiguousarray(profile[:, middle - (n - 1) : middle + n])
    size = 1 << math.ceil(math.log2(3 * n))
    dull = np.maximum(without_peaks(b, scatter.window), 0.0) + 1.0
    spectrum = np.fft.rfft(dull, size)
    total, best = np.zeros(n), np.zeros(n)
    level, row = np.zeros(n), np.zeros(n, np.int64)
    looks = scatter.spread**-2
    steps = math.log(max(1.0, float(np.max(dull)))) / math.log(LEVEL_RATIO)
    levels = LEVEL_RATIO ** np.arange(int(steps) + 1)
    for which, lags in enumerate(D):
        for v in levels:
            mean = 1.0 + v * lags
            slope, constant = 1.0 - 1.0 / mean, -np.log(mean)
            # Reversed by lag, the correlation is a convolution.
            F = np.fft.irfft(spectrum * np.fft.rfft(slope[::-1], size), size)[n - 1 : 2 * n - 1]
            running = np.append(0.0, np.cumsum(constant))
            k = np.arange(n)
            F = looks * scatter.share * (F + running[2 * n - 1 - k] - running[n - 1 - k])
            above = F > best
            greatest = np.where(above, F, best)
            # total is the sum of exp(F - best) over all that was tried besides `best` itself.
            total = (total + 1.0) * np.exp(best - greatest) + np.exp(F - greatest) - 1.0
            best = greatest
            level[above], row[above] = v, which
    tried = 1 + len(levels) * len(D)
    evidence = best + np.log1p(np.maximum(total, 0.0)) - math.log(tried)
    return ScatterFit(evidence, level, row, D, scatter.spread, scatter.window)


def without_peaks(b: FloatArray, window: int) -> FloatArray:
    """b (n,) where nothing stands out: no cell above the median of the `window` cells around it.
    Echoes narrower than half of that are gone, edges of what is wide are where they were."""
    return np.minimum(b, median_filter(b, size=min(window, len(b)), mode='nearest'))


def seen_against(fit: ScatterFit, b: FloatArray, k: int) -> FloatArray:
    """(b - v D) / s (n,) for a first member in the cell k."""
    n = len(b)
    mean = fit.level[k] * fit.profile[fit.row[k], n - 1 - k : 2 * n - 1 - k]
    return np.asarray((b - mean) / np.sqrt(1.0 + np.square(fit.spread * mean)))


def guide(fit: ScatterFit, b: FloatArray) -> FloatArray:
    """What members look for in place of b (n,), for proposals only: what stands out of the most
    probable background, and, above all else, where that may begin."""
    n = len(b)
    at = fit.level * fit.profile[fit.row, n - 1]
    own = np.maximum(b - at, 0.0) / np.sqrt(1.0 + np.square(fit.spread * at))
    first = fit.evidence + 0.5 * np.square(own)
    k = int(np.argmax(first))
    rest = np.maximum(seen_against(fit, b, k), 0.0)
    rest[:k] = np.maximum(b[:k], 0.0)
    top = 0.5 * float(np.max(rest)) ** 2 + _CERTAIN
    begin = np.sqrt(2.0 * np.maximum(first - first[k] + top, 0.0))
    return np.asarray(np.maximum(rest, begin))
