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

Sources: Hansen & Sawyers 1980, 'Detectability loss due to greatest-of selection in a
cell-averaging CFAR'; Finn & Johnson 1968 for a single side.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ..estimation.arrays import FloatArray
from .cfar_kernels import greatest_of_level

_LARGEST_FACTOR = 1e6


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
