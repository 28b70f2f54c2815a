# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Smooth floor with slopes, rough floor whose bins scatter about a base: the bank of models.

Stones on a flat floor do not make its height a random walk: each bin lies beside a base, and the
next one beside the same base. And a smooth floor that rises is no fast walk either. Model j has a
walk of the base b, a lean, and a scatter s_j of the bins,

    b_t = b_{t-1} + lean_j + sigma_j e,      h_t | b_t ~ N(b_t, s_j^2),

and what the staves say of the height, L_t(h), says of the base the same, blurred by the scatter:

    l_j(b) = sum_h N(h - b; s_j) L_t(h).

The state on the grid is the base, so scatter costs a convolution per bin and lean a shift. The
height that is given out is that of the bin, base and deviation together:

    p_j(h) = L_t(h) sum_b N(h - b; s_j) pred_j(b) beta_j(b)

with the predicted density of the base and, smoothed, beta of the bins after this one.

`bank_of` is the default set. Smooth floor keeps one of nine slopes (`steady`) or goes up and down
(`undulating`): without these a fast walk has to count as smooth, or slopes count as rough, and
roughness that is correlated looks like a fast walk. What is rough lasts a shorter while. The
answers are those of kinds of models, not of each slope.

`grid_kernels` has the filter and the smoother. Shapes: K models of M kinds.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray, IntArray

STEADY = tuple(0.05 * k for k in range(-4, 5))
UNDULATING = tuple(0.1 * k for k in range(-2, 3))
"""Slopes of smooth floor, in metres per metre of slant range."""
STEADY_WALK, UNDULATING_WALK = 0.003, 0.008
"""Walk beside the slope over a range bin, m."""
STEADY_TURN, UNDULATING_TURN = 0.002, 0.03
"""Probability per bin of the next slope, up and down."""
UNDULATING_SHARE, ROUGH_SHARE = 0.3, 0.3
"""Before the first bin: undulating, of smooth floor; rough, of all."""
BECOMES_ROUGH, ROUGH_ENDS = 0.5, 5.0
"""In units of 1 - stay: how often smooth floor becomes rough (as often it takes another slope),
and rough floor ends."""
ENDS_SMOOTH = 0.95
"""Rough floor becomes smooth in so many cases, else it becomes rough in another way."""


class Scatter(NamedTuple):
    """What models (K,) of scatter have beside those of a plain walk: the kind (K,) under which
    each is counted; spread (K,) of the bins about the base, and lean (K,) from bin to bin, m."""

    kind: IntArray
    spread: FloatArray
    lean: FloatArray


class Bank(NamedTuple):
    """K models of M kinds: names and rough (M,); kind (K,) of each model, its walk sigma (K,) and
    spread (K,), m, and lean (K,), m per m; transition (K, K), initial (K,) probabilities; coast:
    the level model."""

    names: tuple[str, ...]
    rough: BoolArray
    kind: IntArray
    sigma: FloatArray
    spread: FloatArray
    lean: FloatArray
    transition: FloatArray
    initial: FloatArray
    coast: int


@lru_cache(maxsize=16)
def bank_of(sigmas: Sequence[float], scatters: Sequence[float], stay: float) -> Bank:
    """The bank with rough models of these walks and scatters (R,), m; stay: probability that
    smooth floor keeps its kind over a bin, changes of the slope apart."""
    steady, undulating, rough = len(STEADY), len(UNDULATING), len(sigmas)
    smooth, leave = steady + undulating, 1.0 - stay
    K = smooth + rough
    share = np.array(
        [(1.0 - UNDULATING_SHARE) / steady] * steady + [UNDULATING_SHARE / undulating] * undulating
    )
    back = ENDS_SMOOTH if rough > 1 else 1.0
    transition = np.zeros((K, K))
    transition[:smooth, :smooth] = leave * (1.0 - BECOMES_ROUGH) * share
    transition[:smooth, smooth:] = leave * BECOMES_ROUGH / rough
    transition[smooth:, :smooth] = min(ROUGH_ENDS * leave, 0.5) * back * share
    transition[smooth:, smooth:] = min(ROUGH_ENDS * leave, 0.5) * (1.0 - back) / max(rough - 1, 1)
    for i in range(smooth):
        turn = STEADY_TURN if i < steady else UNDULATING_TURN
        for j in (i - 1, i + 1):
            if 0 <= j < smooth and (i < steady) == (j < steady):
                transition[i, j] += turn
    np.fill_diagonal(transition, 0.0)
    np.fill_diagonal(transition, np.maximum(1.0 - transition.sum(axis=1), 0.0))
    transition /= transition.sum(axis=1, keepdims=True)
    kinds = [f'{"scatter" if scatter > 0.0 else "rw"}' for scatter in scatters]
    numbered = [f'{name}_{kinds[: k + 1].count(name)}' for k, name in enumerate(kinds)]
    return Bank(
        names=('steady', 'undulating', *numbered),
        rough=np.arange(2 + rough) >= 2,
        kind=np.array([0] * steady + [1] * undulating + list(range(2, 2 + rough))),
        sigma=np.array([STEADY_WALK] * steady + [UNDULATING_WALK] * undulating + list(sigmas)),
        spread=np.array([0.0] * smooth + list(scatters)),
        lean=np.array([*STEADY, *UNDULATING, *[0.0] * rough]),
        transition=transition,
        initial=np.concatenate([(1.0 - ROUGH_SHARE) * share, [ROUGH_SHARE / rough] * rough]),
        coast=STEADY.index(0.0),
    )
