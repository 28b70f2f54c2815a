# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Members of a set out of weighted particles: hills of the intensity, taken one after the other.

The **intensity** of the particles, how
many members are expected on each cell, has a hill for each member. No set has two members closer
than the separation, so the intensity summed over a window narrower than that is a probability:
that there is a member in it. Members are taken one after the other, the window that holds most
first; what lies within the separation of one is its own. Where the sets are of two minds about a
member, its hill has two humps, and the mean lies where nothing is. With `modes` the moments are
then those of the greater hump alone, a mode with its own spread; the existence is that of the
member, in whichever hump.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from .arrays import FloatArray

_VALLEY, _ASIDE = 0.05, 0.1
"""Share of the top of a hump below which it ends, and share of a hill that may lie elsewhere."""


class Members(NamedTuple):
    """K members by place: place (K,) in cells, mean over the hill or its greatest hump; amplitude
    (K,) mean in units of the noise; covariance (K, 2, 2) of both, the spread of the particles;
    prior_variance (K,) of the amplitude before the record, given the place; foremost (K,), the
    probability that it is the first of its set; existence (K,), the probability that it is there,
    at most 1."""

    place: FloatArray
    amplitude: FloatArray
    covariance: FloatArray
    prior_variance: FloatArray
    foremost: FloatArray
    existence: FloatArray


def find_members(
    sums: FloatArray, separation: int, most: int, least_existence: float, *, modes: bool = False
) -> Members:
    """At most `most` members whose existence is at least `least_existence`.

    sums (5, n): intensity, first and second moment of the amplitude, its prior variance, and the
    share of first members on each cell, and with a shift three more (see `SetFilter.summarise`).
    """
    n, half = sums.shape[1], max(0, (separation - 1) // 2)
    left = sums.copy()
    found = []
    for _ in range(most):
        mass = _windowed(left[0], half)
        peak = int(np.argmax(mass))
        low, high = max(0, peak - separation + 1), min(n, peak + separation)
        weight = left[0, low:high]
        existence = float(weight.sum())
        if not existence > 0.0 or existence < least_existence:
            break
        hill = left[:, low:high]
        foremost = min(1.0, float(hill[4].sum()))
        first, last = 0, len(weight)
        if modes:
            first, last = _greatest_hump(weight, max(1, separation // 4))
        hump = _moments(hill[:, first:last], low + first)
        found.append((*hump, foremost, min(1.0, existence)))
        left[:, low:high] = 0.0
    found.sort(key=lambda member: member[0])
    if not found:
        nothing = np.empty(0)
        return Members(nothing, nothing, np.empty((0, 2, 2)), nothing, nothing, nothing)
    return Members(*(np.array(column) for column in zip(*found)))


def _greatest_hump(weight: FloatArray, width: int) -> tuple[int, int]:
    """First cell and the one after the last of the greatest hump of a hill (n,), seen through a
    window of `width` cells: from its top as far as it stays above `_VALLEY` of that; the whole
    hill when less than `_ASIDE` of it lies elsewhere."""
    seen = np.convolve(weight, np.ones(width), 'same')
    top = int(np.argmax(seen))
    low = np.flatnonzero(seen <= _VALLEY * seen[top])
    first = int(low[low < top].max(initial=-1)) + 1
    last = int(low[low > top].min(initial=len(weight)))
    inside = float(weight[first:last].sum())
    if inside >= (1.0 - _ASIDE) * float(weight.sum()):
        return 0, len(weight)
    return first, last


def _moments(sums: FloatArray, first: int) -> tuple[float, float, FloatArray, float]:
    cells = first + np.arange(sums.shape[1])
    total = sums[0].sum()
    place, amplitude = float(sums[0] @ cells) / total, float(sums[1].sum()) / total
    prior = float(sums[3].sum()) / total
    if len(sums) > 5:
        place, second = float(sums[5].sum()) / total, float(sums[6].sum()) / total
        cross = float(sums[7].sum()) / total - place * amplitude
        spread_of = max(0.0, second - place**2), cross
        left = float(sums[2].sum()) / total - amplitude**2
        left = max(left, cross**2 / spread_of[0] if spread_of[0] else 0.0)
        return place, amplitude, np.array([spread_of, (cross, left)]), prior
    spread = cells - place
    cross = float(sums[1] @ spread) / total
    covariance = np.array(
        [
            [float(sums[0] @ np.square(spread)) / total, cross],
            [cross, max(0.0, float(sums[2].sum()) / total - amplitude**2)],
        ]
    )
    return place, amplitude, covariance, prior


def _windowed(intensity: FloatArray, half: int) -> FloatArray:
    """Sums (n,) over cells no further than `half`."""
    running = np.append(0.0, np.cumsum(np.pad(intensity, half)))
    return np.asarray(running[2 * half + 1 :] - running[: -2 * half - 1])
