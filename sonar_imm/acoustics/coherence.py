# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Detection of an echo in a range bin by coherence across the array.

In a shadow the staves hear independent noise; an echo is one plane wave. The **coherence**

    gamma = max_u |a(u)^H y|^2 / (P |y|^2)

is 1 for a wave without noise. It does not depend on the level, so the heavy tails of the echo,
which ruin energy detectors, cancel, and its distribution under noise is known: y / |y| is then
uniform on the complex unit sphere. For one direction gamma would be Beta(1, P - 1). The maximum
over all directions exceeds t when the path u -> gamma(u) starts above t or crosses it upwards, and
the mean number of upcrossings follows from Rice's formula on the sphere::

    Pr(gamma > t) <= (1 - t)^(P-1) [1 - s]+ + min(1, s) E(t)
    E(t) = 2 sqrt(pi) sqrt((P^2 - 1) / 12) Gamma(P) / Gamma(P - 1/2) sqrt(t) (1 - t)^(P - 3/2)

where s = 2 spacing is the share of the circle of phases that directions reach. At levels that
only one excursion can pass, which all useful thresholds are, this is an equality (for P = 2 at all
levels). Thresholds for the mean of several bins come from convolving this distribution.
"""

from __future__ import annotations

from functools import lru_cache
import math

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import brentq

from ..estimation.arrays import BoolArray, FloatArray
from .array import direction_grid, phase_step
from .laplace import weighted_form
from .variances import moving_mean
from .wave_kernels import beam_peaks

GATE_BINS = 5
FALSE_ALARM = 1e-3
"""Probability that the gate takes a bin of noise for an echo, for one bin and for the mean."""
FEWEST_STAVES_ALONE = 4
STRETCHES, FEWEST_IN_STRETCH, FEWEST_STRETCHES = 8, 10, 6
SAME_PHASE = 0.1
"""Radians from stave to stave that are none."""
_LEVELS = 4096


def coherence(
    iq: NDArray,
    spacing: float,
    *,
    conjugate: bool = False,
    weights: FloatArray | None = None,
) -> tuple[FloatArray, FloatArray]:
    """Coherence (n,) of snapshots iq (n, P) and the direction sine (n,) where it is reached; NaN
    for bins that are not finite or silent. weights (P,): what the staves count, see
    `laplace.form_coefficients`."""
    staves = iq.shape[1]
    grid = direction_grid(staves, spacing)
    phase = phase_step(spacing, conjugate=conjugate) * grid
    with np.errstate(invalid='ignore', over='ignore'):
        form, power = weighted_form(iq, weights)
        form[:, 1:] *= 2.0
    if weights is not None:
        staves = int(np.count_nonzero(weights))
    peak, place = np.empty(len(iq)), np.empty(len(iq))
    row = np.empty(len(grid))
    beam_peaks(form, np.cos(phase), np.sin(phase), row, row.copy(), peak, place)
    usable = np.isfinite(power) & (power > 0.0)
    peak = np.minimum(peak / (staves * np.where(usable, power, 1.0)), 1.0)
    sine = grid[0] + place * (grid[1] - grid[0])
    return np.where(usable, peak, np.nan), np.where(usable, sine, np.nan)


def refined_peak(spectrum: FloatArray, grid: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Largest value (n,) of spectra (n, m) over an even `grid` (m,) and where it is, by a parabola
    through the highest point and its neighbours."""
    rows = np.arange(len(spectrum))
    best = np.clip(spectrum.argmax(axis=1), 1, len(grid) - 2)
    below, top, above = (spectrum[rows, best + k] for k in (-1, 0, 1))
    bend = below - 2.0 * top + above
    shift = np.where(bend < 0.0, 0.5 * (below - above) / np.where(bend < 0.0, bend, -1.0), 0.0)
    shift = np.clip(shift, -1.0, 1.0)
    peak = top + shift * (0.5 * (above - below) + 0.5 * shift * bend)
    return peak, grid[best] + shift * (grid[1] - grid[0])


def false_alarm_probability(threshold: ArrayLike, staves: int, spacing: float = 0.5) -> FloatArray:
    """Probability that noise alone has a coherence above `threshold`, at most 1."""
    t = np.asarray(threshold, np.float64)
    share = 2.0 * spacing
    scale = 2.0 * math.sqrt(math.pi * (staves**2 - 1) / 12.0)
    scale *= math.exp(math.lgamma(staves) - math.lgamma(staves - 0.5))
    crossings = scale * np.sqrt(t) * (1.0 - t) ** (staves - 1.5)
    begins = max(1.0 - share, 0.0) * (1.0 - t) ** (staves - 1)
    # The number of crossings falls with t only above its maximum; below, it says nothing.
    certain = t < 1.0 / (2.0 * staves - 2.0)
    return np.where(certain, 1.0, np.minimum(1.0, begins + min(1.0, share) * crossings))


@lru_cache(maxsize=128)
def coherence_threshold(
    staves: int, bins: int = 1, false_alarm: float = FALSE_ALARM, spacing: float = 0.5
) -> float:
    """Level that the mean coherence of `bins` bins of noise passes with probability
    `false_alarm`."""
    if bins == 1:

        def excess(level: float) -> float:
            return float(false_alarm_probability(level, staves, spacing)) - false_alarm

        return float(brentq(excess, 1.0 / staves, 1.0, xtol=1e-12))
    levels = np.linspace(0.0, 1.0, _LEVELS + 1)
    mass = -np.diff(false_alarm_probability(levels, staves, spacing))
    length = bins * _LEVELS
    total = np.fft.irfft(np.fft.rfft(mass, length) ** bins, length)
    tail = np.cumsum(np.maximum(total, 0.0)[::-1])[::-1]
    # The mass of each cell stands at its lower end, half a cell too low on average.
    return (int(np.argmax(tail <= false_alarm)) + 0.5 * (bins - 1)) / length


def silent_bins(
    gamma: ArrayLike, staves: int, *, spacing: float = 0.5, false_alarm: float = FALSE_ALARM
) -> BoolArray:
    """Bins (n,) without a detected echo: `gamma` (n,) below the threshold of one bin,
    or its mean over `GATE_BINS` below that of the mean. NaN counts as silent.

    Two or three staves are coherent by chance too often for one bin to say anything (an echo would
    need more than 50 dB): there the mean decides alone."""
    values = np.asarray(gamma, np.float64)
    enough = staves >= FEWEST_STAVES_ALONE
    alone = coherence_threshold(staves, 1, false_alarm, spacing) if enough else 0.0
    together = coherence_threshold(staves, GATE_BINS, false_alarm, spacing)
    mean = moving_mean(values, GATE_BINS // 2, np.isfinite(values))
    return ~((values >= alone) & (mean >= together))


def common_mode(iq: NDArray, coherent: BoolArray) -> float:
    """Share of the `coherent` bins (n,) of a ping iq (n, P) whose staves have all the same phase,
    at nearly all ranges: the third smallest share of the eighths of the ping, where an eighth with
    less than ten coherent bins has none.

    A floor lies at broadside over a short stretch of ranges at most. What does so at all ranges is
    a signal common to the staves, such as one that their electronics share.
    """
    y = np.where(coherent[:, None], iq, 0.0)
    turn = np.angle((y[:, 1:] * y[:, :-1].conj()).sum(axis=1))
    alike = coherent & (np.abs(turn) < SAME_PHASE)
    shares = [
        float(part.sum() / all_of.sum()) if all_of.sum() >= FEWEST_IN_STRETCH else 0.0
        for part, all_of in zip(
            np.array_split(alike, STRETCHES), np.array_split(coherent, STRETCHES)
        )
    ]
    return sorted(shares)[STRETCHES - FEWEST_STRETCHES]


def first_return(
    gamma: ArrayLike, staves: int, *, spacing: float = 0.5, false_alarm: float = FALSE_ALARM
) -> int:
    """The first bin of the floor: the first one with an echo of which, itself included, at least
    four in five have one; 0 when there is none.

    gamma (n,) as in `silent_bins`, which also says why two or three staves need the mean of five.
    """
    values = np.asarray(gamma, np.float64)
    if staves >= FEWEST_STAVES_ALONE:
        passed = values >= coherence_threshold(staves, 1, false_alarm, spacing)
    else:
        passed = ~silent_bins(values, staves, spacing=spacing, false_alarm=false_alarm)
    return first_of(passed)


def first_of(passed: BoolArray) -> int:
    """The first of the bins `passed` (n,) of which, itself included, at least four in five are;
    0 when there is none."""
    running = np.concatenate([[0], np.cumsum(passed)])
    together = running[GATE_BINS:] - running[:-GATE_BINS]
    begins = passed[: len(together)] & (together >= GATE_BINS - 1)
    return int(np.argmax(begins)) if begins.any() else 0
