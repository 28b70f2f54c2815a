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

"""Which parts of an image belong together (`image_echoes`), as a loop over pairs of cells."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..estimation.arrays import FloatArray
from ..estimation.jit import kernel


@kernel
def joined_parts(
    part: NDArray[np.intp], distance: FloatArray, bearing: FloatArray, reach: float
) -> NDArray[np.intp]:
    """Part numbers (n,) of cells in which parts with cells within `reach` of each other have the
    same one: 0, 1, ... without gaps. The cells lie at `distance` (n,) m, ascending, and `bearing`
    (n,) rad."""
    n = len(part)
    count = 0
    for i in range(n):
        count = max(count, part[i] + 1)
    root = np.arange(count)
    x, y = distance * np.cos(bearing), distance * np.sin(bearing)
    for i in range(n):
        for j in range(i + 1, n):
            if distance[j] - distance[i] > reach:
                break
            if part[i] == part[j]:
                continue
            if (x[i] - x[j]) ** 2 + (y[i] - y[j]) ** 2 > reach * reach:
                continue
            one, other = part[i], part[j]
            while root[one] != one:
                root[one] = root[root[one]]
                one = root[one]
            while root[other] != other:
                root[other] = root[root[other]]
                other = root[other]
            if one != other:
                root[max(one, other)] = min(one, other)
    number = np.full(count, -1)
    used = 0
    joined = np.empty(n, np.intp)
    for i in range(n):
        one = part[i]
        while root[one] != one:
            one = root[one]
        if number[one] < 0:
            number[one] = used
            used += 1
        joined[i] = number[one]
    return joined
