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

"""Which model held, once the future is known: Kim's backward pass over model probabilities.

A filter's model probabilities use the past only. If the next step's model told everything that the
future says of the present one,

    Pr(i at k | all) = mu_i sum_j P_ij Pr(j at k+1 | all) / c_j,     c_j = sum_i P_ij mu_i

with mu_i filtered at k and c_j predicted for k+1. For states that are drawn anew at each step this
is exact; otherwise it neglects what the future state says of the present model, and is cheap: it
needs the filtered probabilities and nothing else.

Reference: Kim, *Dynamic linear models with Markov-switching*, J. Econometrics 60, 1994.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .arrays import FloatArray


def smooth_modes(
    mu: FloatArray, transition: FloatArray, moved: NDArray[np.bool_] | None = None
) -> FloatArray:
    """Smoothed probabilities (T, M) from filtered ones mu (T, M).

    moved (T,): False where the chain rested on the step into k, True everywhere if not given.

    >>> import numpy as np
    >>> mu = np.array([[0.5, 0.5], [0.99, 0.01]])  # undecided, then sure
    >>> smooth_modes(mu, np.array([[0.9, 0.1], [0.1, 0.9]])).round(3).tolist()
    [[0.892, 0.108], [0.99, 0.01]]
    """
    smoothed = mu.copy()
    predicted = mu[:-1] @ transition
    for k in range(len(mu) - 2, -1, -1):
        if moved is not None and not moved[k + 1]:
            smoothed[k] = smoothed[k + 1]
            continue
        c = predicted[k]
        ratio = np.divide(smoothed[k + 1], c, out=np.zeros_like(c), where=c > 0.0)
        weight = mu[k] * (transition @ ratio)
        total = weight.sum()
        if total > 0.0:
            smoothed[k] = weight / total
    return smoothed
