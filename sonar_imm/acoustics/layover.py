# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Whether a range bin holds echoes of two surfaces: layover, which one plane wave cannot explain.

A ledge, a box or a wall answers at the same range as the floor before or behind it. One direction
then lies between the two surfaces, where nothing is. The staves of one bin y, noise variance sn2,
say how well one and two plane waves fit, amplitudes taken out::

    R1 = (|y|^2 - max_u |a(u)^H y|^2 / P) / sn2,   R2 = (|y|^2 - max_{u1, u2} p(u1, u2)) / sn2
    p  = (|b1|^2 + |b2|^2 - 2 Re(conj(b1) g b2)) / (P (1 - |g|^2))
    b  = a(u)^H y,   g = a1^H a2 / P,   L = 2 (sqrt R1 - sqrt R2)

L is the log ratio of the likelihoods of the law of `laplace`, whose tails are those of
exp(-2 sqrt q). What L says at a local signal-to-noise ratio is in a table, log p(L | two) / p(L |
one), simulated for each number of staves (``python -m benchmarks.layover_tables``) and made
monotonic by pooling neighbours, so that its mean under one surface stays 1. There is one table for
noise that is the same in all bins and one for noise that fades with the echo, which makes large L
of one surface: each ping measures between which of them it lies, see `fading`.

`existence` is the smoothed probability of the second surface in a chain of two states along the
ping.

**No array is exact.** What of an echo is no plane wave acts as noise that grows with it, so that
echoes of 30 dB would all seem to be two. Each ping measures that itself: `array_error`.
"""

from __future__ import annotations

from functools import lru_cache
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaincinv

from ..estimation.arrays import BoolArray, ComplexArray, FloatArray
from .loudness import VERY_LOUD
from .wave_kernels import fit_waves

BIRTH, END = 0.0005, 0.05
"""Probabilities that a second surface begins, and ends, from one bin to the next."""
GATE = 0.3
"""Bins with a more probable second surface are no soundings."""
EVIDENCE = -4.0, 8.0
"""Bounds of what one bin may say, as a log ratio."""
LEFT = 0.999
"""What two waves leave of a bin is no more than noise leaves in so many bins."""
LEAST_ERROR, ERROR_MARGIN, FEWEST_BINS = 2e-4, 2.0, 50
ALL_FADES = 0.5
"""From so much of the way to noise that fades on the table is that of such noise: it is the more
cautious one, and part of the noise suffices for large L."""
QUARTERS = 0.25, 0.75
TABLES = Path(__file__).with_name('layover_tables.npz')
_POINTS = 32
"""Fewest directions of the grid from which the search for two begins: four for each stave, and of
few staves more, whose beams are wide, but have many local maxima."""


class Layover(NamedTuple):
    """The probability (n,) of a second surface in each bin, the `array_error`, and which bins (n,)
    were usable."""

    existence: FloatArray
    array_error: float
    usable: BoolArray


def layover(
    iq: ComplexArray,
    signal: FloatArray,
    noise: FloatArray,
    usable: BoolArray,
    spacing: float,
    loud: BoolArray | None = None,
) -> Layover:
    """The second surface along a ping: iq (n, P), local variance of signal and noise (n,) at a
    stave, spacing of the staves in wavelengths; bins that are not usable (n,) say nothing.

    loud (n,): bins that are called usable, too, if two waves leave no more of them than noise. The
    staves of such bins do not agree, which one wave would demand; the chain leaves them out.
    """
    staves = iq.shape[1]
    _, rest_1, rest_2 = residuals(iq, spacing)
    snr = signal / noise
    error = array_error(rest_1 / noise, snr, staves, usable)
    larger = 1.0 + error * snr
    fades = fading(rest_1 / (noise * larger), staves, usable)
    level = 2.0 * (np.sqrt(rest_1) - np.sqrt(rest_2)) / np.sqrt(noise * larger)
    evidence = np.where(usable, log_ratio(level, snr / larger, staves, fades), 0.0)
    if loud is not None and staves > 2:
        most = float(gammaincinv(staves - 2.0, LEFT))
        usable = usable | loud & (rest_2 < most * noise * larger)
    return Layover(existence(evidence), error, usable)


def residuals(iq: ArrayLike, spacing: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """|y|^2 of snapshots iq (n, P), and what the best plane wave leaves of it, and the best two:
    sn2 R1 and sn2 R2, each (n,), in the squared units of iq. Two staves are fitted by any two
    waves. spacing in wavelengths."""
    y = np.ascontiguousarray(iq, np.complex128)
    n, staves = y.shape
    circle = abs(spacing) >= 0.5
    widest = math.pi if circle else 2.0 * math.pi * abs(spacing)
    points = max(4 * staves, _POINTS) + (not circle)
    step = 2.0 * widest / (points - (not circle))
    phase = step * np.arange(points) - widest
    half = 0.5 * (staves - 1)
    multiples = 1.0, half, 0.5, 0.5 * staves
    found, (real, imaginary) = np.zeros((n, 2)), np.empty((2, points))
    fit_waves(
        y,
        phase,
        np.concatenate([[np.cos(k * phase), np.sin(k * phase)] for k in multiples]),
        math.inf if circle else widest,
        real,
        imaginary,
        found,
    )
    power = np.square(np.abs(y)).sum(axis=1)
    rest_1 = np.maximum(power - found[:, 0], 0.0)
    rest_2 = np.minimum(np.maximum(power - found[:, 1], 0.0), rest_1)
    return power, rest_1, rest_2 if staves > 2 else np.zeros(n)


def array_error(rest_1: FloatArray, snr: FloatArray, staves: int, usable: BoolArray) -> float:
    """Power that is no plane wave as a share eps of the echo: noise is (1 + eps SNR) as large.

    Twice the median over bins above 20 dB of (R1 / m - 1) / SNR, m the median of R1 without
    any error, the gamma distribution of P - 3/2 degrees; at least `LEAST_ERROR`, also where there
    are too few bins to measure it. rest_1 (n,): R1.
    """
    chosen = usable & (snr > VERY_LOUD)
    if np.count_nonzero(chosen) < FEWEST_BINS:
        return LEAST_ERROR
    usual = float(gammaincinv(staves - 1.5, 0.5))
    excess = float(np.median((rest_1[chosen] / usual - 1.0) / snr[chosen]))
    return max(LEAST_ERROR, ERROR_MARGIN * excess)


def fading(rest_1: FloatArray, staves: int, usable: BoolArray) -> float:
    """How much of the noise fades with the echo, 0 to 1, by the spread of R1, rest_1 (n,), over
    the ping: noise that fades spreads it more, whatever its power. 1 where there are too few
    bins."""
    if np.count_nonzero(usable) < FEWEST_BINS:
        return 1.0
    steady, fades = _spreads(staves)
    rest = np.maximum(rest_1[usable], np.finfo(float).tiny)
    low, high = np.quantile(np.log(rest), QUARTERS)
    return float(np.clip((high - low - steady) / (fades - steady) / ALL_FADES, 0.0, 1.0))


@lru_cache(maxsize=16)
def _spreads(staves: int) -> tuple[float, float]:
    """Distance between the quartiles of log R1 in noise that is steady, gamma-distributed R1, and
    in noise that fades, a product with an exponential number."""
    p = (np.arange(200) + 0.5) / 200
    steady = np.log(gammaincinv(staves - 1.5, p))
    fades = np.add.outer(steady, np.log(-np.log1p(-p)))
    (a, b), (c, d) = np.quantile(steady, QUARTERS), np.quantile(fades, QUARTERS)
    return float(b - a), float(d - c)


class Table(NamedTuple):
    """value (2, S, K): log ratio of two surfaces to one in the classes of L between edges
    (K + 1,), at signal-to-noise ratios of decibels (S,), evenly spaced; for noise that is steady,
    and for noise that fades with the echo."""

    edges: FloatArray
    decibels: FloatArray
    value: FloatArray


@lru_cache(maxsize=16)
def table_of(staves: int) -> Table:
    """The table of a number of staves, or of the next smaller number that has one: fewer staves
    say less."""
    with np.load(TABLES, allow_pickle=False) as tables:
        of = max(P for P in map(int, tables['staves']) if P <= staves)
        return Table(tables['edges'], tables['decibels'], tables[f'value_{of}'].astype(float))


def log_ratio(level: FloatArray, snr: FloatArray, staves: int, fades: float) -> FloatArray:
    """What L (n,) says at local signal-to-noise ratios (n,): log p(L | two) / p(L | one), where so
    much of the noise, 0 to 1, fades with the echo."""
    edges, decibels, of_noise = table_of(staves)
    value = (1.0 - fades) * of_noise[0] + fades * of_noise[1]
    with np.errstate(divide='ignore'):
        place = (10.0 * np.log10(snr) - decibels[0]) / (decibels[1] - decibels[0])
    place = np.clip(place, 0.0, len(decibels) - 1.0)
    row = np.minimum(place.astype(int), len(decibels) - 2)
    share = place - row
    kind = np.clip(np.searchsorted(edges, level, side='right') - 1, 0, value.shape[1] - 1)
    between = (1.0 - share) * value[row, kind] + share * value[row + 1, kind]
    return np.asarray(np.clip(between, *EVIDENCE))


def existence(evidence: FloatArray) -> FloatArray:
    """Probability (n,) of a second surface in each bin, given the whole ping and what each bin
    says by itself (n,), log ratios; forward-backward over a chain of two states."""
    ratios = np.exp(evidence).tolist()
    p, filtered = BIRTH / (BIRTH + END), []
    for t, ratio in enumerate(ratios):
        if t > 0:
            p = p * (1.0 - END) + (1.0 - p) * BIRTH
        p = p * ratio / (p * ratio + 1.0 - p)
        filtered.append(p)
    later, out = 1.0, filtered[-1:]
    for p, ratio in zip(filtered[-2::-1], ratios[:0:-1]):
        r = later * ratio
        later = (END + (1.0 - END) * r) / (1.0 - BIRTH + BIRTH * r)
        out.append(p * later / (p * later + 1.0 - p))
    return np.array(out[::-1])
