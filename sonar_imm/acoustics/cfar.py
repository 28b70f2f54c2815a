# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How loud a cell of a sonar image has to be to be an echo: a constant rate of false alarms.

A cell holds an echo when its power exceeds the level of the noise around it by a factor. The level
is the *greater of* two means, over the cells nearer and over those farther in range, each averaged
over several beams as well: at the onset of the sea floor, where the level climbs, the mean of both
sides would be too low and the whole edge an echo (GO-CFAR). Cells next to the one under test are
left out (guard), because an echo is wider than a cell.

For noise of exponentially distributed power, N independent cells on either side and the factor T
the probability of a false alarm is, with t = T / N,

    P = 2 (1 + t)^-N - 2 sum_{k=0}^{N-1} C(N+k-1, k) (2 + t)^-(N+k)

Cells of an image are not independent: speckle is as wide as the beam and as long as the pulse.
`effective_cells` says how many independent ones a window holds. Taking all for independent makes
ten times as many false alarms.

Two things spoil the mean of the noise. An obstacle that reaches into the training cells hides
itself, as a chain along the line of sight does; so cells far above the mean logarithm of their
neighbourhood are left out, and then those far above that of the rest (`quiet_level`). And a rough
sea floor has longer tails than a Rayleigh law: power of patches that differ is K distributed. How
rough it is shows in the variance of the logarithm of the power in the rows around (`roughness`),
and the factor grows by what that shape needs (`tail_factor`).

Sources: Hansen & Sawyers 1980, 'Detectability loss due to greatest-of selection in a
cell-averaging CFAR'; Finn & Johnson 1968 for a single side; Ward, Tough & Watts 2013, 'Sea
clutter: scattering, the K distribution and radar performance'.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..estimation.arrays import BoolArray, FloatArray

_LARGEST_FACTOR = 1e6
CENSORED = 5.0
"""Times the mean above which a training cell is left out; of Rayleigh noise one in 150 is, and the
mean 3 % lower for it."""
_TINY = 1e-300
_SILENT = 0.02
"""Share of the level below which a cell counts as that quiet: coarse samples have zeros."""
_SHAPES = np.geomspace(0.2, 50.0, 60)
_ROWS = 20
"""Rows to either side that tell how rough the sea floor is."""


def effective_cells(cells: int, width: float) -> float:
    """How many independent values of power a row of `cells` holds, when an echo of a point is
    `width` cells wide (-3 dB); a Gaussian pattern is assumed."""
    lag = np.arange(1, cells)
    correlation = np.exp(-2.0 * np.log(2.0) * np.square(lag / max(width, 1e-6)))
    return float(cells / (1.0 + 2.0 * np.sum((1.0 - lag / cells) * correlation)))


def false_alarm_probability(factor: float, cells: int, sides: int = 2) -> float:
    """That a cell of noise exceeds `factor` times the greater of `sides` (1 or 2) means, each of
    `cells` independent values."""
    from scipy.special import gammaln

    t = factor / cells
    alone = (1.0 + t) ** -cells
    if sides == 1:
        return float(alone)
    k = np.arange(cells)
    log_terms = gammaln(cells + k) - gammaln(cells) - gammaln(k + 1.0)
    both = np.exp(log_terms - (cells + k) * np.log(2.0 + t)).sum()
    return float(2.0 * (alone - both))


@lru_cache(maxsize=256)
def threshold_factor(false_alarm: float, cells: int, sides: int = 2) -> float:
    """The factor that gives this probability of a false alarm; infinite when so few cells cannot
    give it. Raises ValueError for a probability outside 0 to 1."""
    if not 0.0 < false_alarm < 1.0:
        raise ValueError(f'a false alarm probability lies between 0 and 1, got {false_alarm}')
    if sides == 1:
        return float(cells * np.expm1(-np.log(false_alarm) / cells))

    from scipy.optimize import brentq

    def excess(factor: float) -> float:
        return false_alarm_probability(factor, cells) - false_alarm

    if excess(_LARGEST_FACTOR) > 0.0:
        return float('inf')
    return float(brentq(excess, 0.0, _LARGEST_FACTOR, xtol=1e-9, rtol=1e-12))


def noise_level(
    power: FloatArray, *, beams: int, training: int, guard: int
) -> tuple[FloatArray, FloatArray]:
    """Level (R, B) around each cell of `power` (R, B), and how many sides (R,) it comes from.

    The greater of the means over `training` cells nearer and farther in range, beyond `guard`
    cells, and over `beams` beams around. A side with less than half of its cells inside the image
    does not count. Without the nearer side the level is infinite and the number of sides 0: water
    scatters back more the nearer it is, and the farther side alone would be too quiet.

    Raises ValueError for an image that is not two-dimensional.
    """
    if power.ndim != 2:
        raise ValueError(f'an image (R, B) is needed, got the shape {power.shape}')
    return greatest_of_level(
        np.ascontiguousarray(power, np.float64), max(beams // 2, 0), training, guard
    )


def quiet_level(
    power: FloatArray, *, beams: int, training: int, guard: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """`noise_level` of the cells that are no echoes, the sides (R,) it comes from, and how rough
    (R,) the noise is.

    Raises ValueError for an image that is not two-dimensional.
    """
    window = {'beams': beams, 'training': training, 'guard': guard}
    level, sides = noise_level(power, **window)
    if not power.size:
        return level, sides, np.zeros(len(power))
    known = np.isfinite(level) & (level > 0.0)
    floor = np.where(known, level, np.inf)
    # Of the first rows no level is known; theirs is about that of the first for which one is.
    first = level[np.argmax(known.any(axis=1))]
    about = np.where(known, level, np.where(np.isfinite(first) & (first > 0.0), first, 1.0))
    logarithm_of_power = np.log(power + _TINY)
    logarithm = np.maximum(logarithm_of_power, np.log(_SILENT * about))
    around, _ = noise_level(logarithm, **window)
    off = np.where(known, logarithm - around, np.nan)
    half = max(beams // 2, 0)
    # The mean of a Rayleigh law lies above its mean logarithm.
    above = np.log(CENSORED) + np.euler_gamma
    quiet = ~known | (logarithm_of_power <= around + above)
    # Again, by the mean logarithm of what was kept: something long has raised the first.
    kept, few = _kept(quiet, logarithm, half)
    kept[few] = around[few]
    around, _ = greatest_of_level(kept, 0, training, guard)
    quiet = ~known | (logarithm_of_power <= around + above)
    kept, few = _kept(quiet, power, half)
    kept[few] = np.exp(np.where(known, around, 0.0)[few] + np.euler_gamma)
    censored, _ = greatest_of_level(kept, 0, training, guard)
    return np.minimum(censored, floor), sides, roughness(off)


def _kept(quiet: BoolArray, value: FloatArray, half: int) -> tuple[FloatArray, BoolArray]:
    """Mean (R, B) of the quiet cells of the beams within `half` of each, and where these are fewer
    than one in ten and are unknown."""
    share = across_beams(quiet.astype(np.float64), half)
    kept = across_beams(np.where(quiet, value, 0.0), half) / np.maximum(share, 0.1)
    return kept, share < 0.1


def roughness(logarithm: FloatArray) -> FloatArray:
    """Variance (R,) of the logarithm of power (R, B) over its local mean, in the rows around each;
    NaN counts as unknown."""
    known = np.isfinite(logarithm)
    value = np.where(known, logarithm, 0.0)
    sums = [
        np.concatenate([[0.0], np.cumsum(part.sum(axis=1))])
        for part in (known.astype(float), value, np.square(value))
    ]
    row = np.arange(len(value))
    first, last = np.maximum(row - _ROWS, 0), np.minimum(row + _ROWS + 1, len(value))
    count, total, square = (part[last] - part[first] for part in sums)
    count = np.maximum(count, 1.0)
    return square / count - np.square(total / count)


def tail_factor(rough: FloatArray, false_alarm: float) -> FloatArray:
    """How much higher (R,) than for a Rayleigh law a threshold has to be where the logarithm of
    power has the variance `rough` (R,)."""
    variances, factors = _tails(false_alarm)
    return np.interp(rough, variances, factors)


def _area(y: FloatArray, x: FloatArray) -> float:
    return float(np.sum(0.5 * (y[1:] + y[:-1]) * np.diff(x)))


@lru_cache(maxsize=16)
def _tails(false_alarm: float) -> tuple[FloatArray, FloatArray]:
    """Variance of the logarithm of K distributed power, rising, and the threshold that each needs
    over that of a Rayleigh law."""
    from scipy.optimize import brentq
    from scipy.special import gammaln, kve

    def tail(log_factor: FloatArray, shape: float) -> FloatArray:
        """Logarithm of the probability above a multiple of the mean."""
        z = np.sqrt(shape * np.exp(log_factor))
        power = np.log(2.0 * kve(shape, 2.0 * z)) - 2.0 * z + shape * np.log(z)
        return np.asarray(power - gammaln(shape))

    grid = np.linspace(np.log(_SILENT), np.log(1e4), 4000)
    variances, factors, wanted = [], [], np.log(false_alarm)
    for shape in _SHAPES:
        # Moments of a value that is never below the first of the grid, from its tail alone.
        above = np.exp(tail(grid, shape))
        first = _area(above, grid)
        second = 2.0 * _area((grid - grid[0]) * above, grid)
        variances.append(second - first**2)
        factor = brentq(lambda x, k=shape: float(tail(x, k)) - wanted, -5.0, 15.0)
        factors.append(np.exp(factor) / -np.log(false_alarm))
    return np.array(variances)[::-1], np.maximum(np.array(factors)[::-1], 1.0)


def across_beams(power: FloatArray, half: int) -> FloatArray:
    """Mean (R, B) over the beams within `half` of each, fewer at the edges."""
    beam = np.arange(power.shape[1])
    count = np.minimum(beam + half, len(beam) - 1) - np.maximum(beam - half, 0) + 1
    padded = np.pad(power, ((0, 0), (half, half)))
    return _sums(padded.T, 2 * half + 1).T / count


def _sums(value: FloatArray, width: int) -> FloatArray:
    """Sums (n - width + 1, ...) over `width` neighbours along the first axis of `value` (n, ...).

    No running sum: one huge value would spoil the rest of it. Sums over 1, 2, 4, ... neighbours
    are made of one another, and the sum over `width` of those.
    """
    length, size, done = len(value) - width + 1, 1, 0
    total, block = np.zeros((length, *value.shape[1:])), value
    while True:
        if width & size:
            total += block[done : done + length]
            done += size
        if done == width:
            return total
        block = block[:-size] + block[size:]
        size *= 2


def greatest_of_level(
    power: FloatArray, half: int, training: int, guard: int
) -> tuple[FloatArray, FloatArray]:
    """See `noise_level`; `half` beams on either side are averaged."""
    R, least = len(power), (training + 1) // 2
    smooth = across_beams(power, half)
    row = np.arange(R)
    near, far = row - guard, row + guard + 1  # the near side ends and the far side begins here
    # Means over `training` rows that end or begin at each row, over fewer at the edges.
    padded = np.pad(smooth, ((training, training), (0, 0)))
    window = _sums(padded, training)[: R + training]
    ends = np.arange(R + training)
    window /= np.maximum(np.minimum(ends, R) - np.maximum(ends - training, 0), 1)[:, None]
    level = np.full(power.shape, np.inf)
    known = near >= least
    level[known] = window[near[known]]
    both = known & (R - far >= least)
    level[both] = np.maximum(level[both], window[far[both] + training])
    return level, known.astype(np.float64) + both
