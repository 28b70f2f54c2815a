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

"""The level of the noise around every cell of an image (`cfar.noise_level`), as loops that the
processor runs several beams at a time.

Sums are taken afresh for each cell and not carried along: one huge value would spoil all that come
after it.
"""

from __future__ import annotations

import numpy as np

from ..estimation.arrays import FloatArray
from ..estimation.jit import kernel


@kernel
def across_beams(power: FloatArray, half: int) -> FloatArray:
    """Mean (R, B) over the beams within `half` of each, fewer at the edges."""
    R, B = power.shape
    mean = np.empty((R, B))
    row = np.zeros(B + 2 * half)
    inverse = np.empty(B)
    for b in range(B):
        inverse[b] = 1.0 / (min(b + half, B - 1) - max(b - half, 0) + 1)
    for r in range(R):
        row[half : half + B] = power[r]
        total = mean[r]
        total[:] = 0.0
        for k in range(2 * half + 1):
            for b in range(B):
                total[b] += row[b + k]
        for b in range(B):
            total[b] *= inverse[b]
    return mean


@kernel
def greatest_of_level(
    power: FloatArray, half: int, training: int, guard: int
) -> tuple[FloatArray, FloatArray]:
    """See `cfar.noise_level`; `half` beams on either side are averaged."""
    R, B = power.shape
    smooth = across_beams(power, half)
    window = np.empty((R, B))  # mean of the rows r to r + training - 1 that there are
    for r in range(R):
        last = min(r + training, R)
        total = window[r]
        total[:] = 0.0
        for k in range(r, last):
            for b in range(B):
                total[b] += smooth[k, b]
        for b in range(B):
            total[b] /= last - r
    least = (training + 1) // 2
    level = np.full((R, B), np.inf)
    sides = np.zeros(R)
    for r in range(R):
        end = r - guard  # the side before ends here, exclusive
        if end < least:
            continue
        sides[r] = 1.0
        if end >= training:
            level[r] = window[end - training]
        else:
            total = level[r]
            total[:] = 0.0
            for k in range(end):
                for b in range(B):
                    total[b] += smooth[k, b]
            for b in range(B):
                total[b] /= end
        behind = r + guard + 1
        if R - behind >= least:
            sides[r] = 2.0
            for b in range(B):
                level[r, b] = max(level[r, b], window[behind, b])
    return level, sides
