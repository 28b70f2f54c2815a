# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Smooth floor with slopes, rough floor whose bins scatter: the models of `terrain`.

The state of a model is the height b of the base and its slope s, in metres per metre of slant
range; over a bin of width dS ::

    s' = phi s + sqrt(1 - phi^2) slope0 e,   b' = b + dS (s + s') / 2 + walk e'

or, where a model does not follow the slope, s' ~ N(0, slope0^2) and b' = b + walk e'. The height
of a bin lies about the base with a standard deviation `scatter`. All slopes have one stationary
law, N(0, slope0^2), and the chain of the models is reversible, so that a ping backwards obeys the
same models: `terrain_filter` filters it both ways and fuses.

The chain follows from how far each kind of floor goes on (`STAY`) and how much of all floor it is
(`SHARE`): the flow from i to j is ``B_ij x_i x_j``, B = 1 but for level and steady floor, which
are hard to tell apart, and x such that each model is left as often as its stay says.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray, IntArray

SLOPE0 = 0.35
"""Standard deviation of all slopes."""
BIN = 0.05
"""m, for which `walk` and `turn` are stated."""
FEWER_FLOWS = 0.1
"""Of those between level and steady floor."""
_ROUNDS = 2000
"""At most, for the fixed point of the flows, which takes about 100 to 250."""
LEAST_CHANGE = 1e-12
MOST_LEFT = 0.5
"""A model is left over a bin with at most this probability, however wide the bin."""


class Kind(NamedTuple):
    """A model: rough floor or not; walk of the base and turn of the slope over a bin of `BIN`,
    NaN for a slope that is drawn anew; scatter of single bins, m; stay, m; share of all floor."""

    name: str
    rough: bool
    walk: float
    turn: float
    scatter: float
    stay: float
    share: float


ANEW = float('nan')
KINDS = (
    Kind('level', False, 0.002, ANEW, 0.0, 20.0, 0.20),
    Kind('steady', False, 0.001, 0.0005, 0.0, 20.0, 0.40),
    Kind('undulating', False, 0.002, 0.012, 0.0, 20.0, 0.10),
    Kind('winding', False, 0.004, 0.06, 0.0, 6.0, 0.08),
    Kind('scatter_1', True, 0.01, 0.003, 0.15, 6.0, 0.05),
    Kind('scatter_2', True, 0.01, 0.003, 0.4, 6.0, 0.05),
    Kind('scatter_3', True, 0.01, 0.003, 1.0, 6.0, 0.04),
    Kind('walk', True, 0.08, ANEW, 0.0, 4.0, 0.05),
    Kind('break', False, 1.0, ANEW, 0.0, 0.1, 0.001),
)

EITHER = 'winding'
"""The kind of smooth floor that roughness correlated over metres is, too: a wave of 1 m over 13 m
has the slopes and bends of roughness of .5 m over 1.5 m."""


class Terrain(NamedTuple):
    """The models for bins of one width, m: names and rough (M,); walk (M,) m; phi (M,) of the
    slope kept; follow (M,): the base follows the slope; scatter (M,) m; coast (M,): the model
    whose motion crosses bins without an echo; transition (M, M) and its law stationary (M,)."""

    names: tuple[str, ...]
    rough: BoolArray
    walk: FloatArray
    phi: FloatArray
    follow: BoolArray
    scatter: FloatArray
    coast: IntArray
    transition: FloatArray
    stationary: FloatArray
    width: float


def walks_of(
    names: tuple[str, ...],
    walk: FloatArray,
    transition: FloatArray,
    initial: FloatArray,
    width: float,
) -> Terrain:
    """Return smooth and rough random walks, noises walk (2,) m a bin, for the outward filter:
    `initial` (2,) is before the first bin, and the chain need not be reversible. No transition is
    less probable than `LEAST_CHANGE`: what mixes has a source."""
    nothing = np.zeros(2)
    return Terrain(
        names=names,
        rough=np.array([False, True]),
        walk=walk,
        phi=nothing,
        follow=np.zeros(2, bool),
        scatter=nothing,
        coast=np.full(2, np.argmin(walk)),
        transition=np.maximum(transition, LEAST_CHANGE),
        stationary=initial,
        width=width,
    )


@lru_cache(maxsize=16)
def terrain_of(width: float, kinds: tuple[Kind, ...] = KINDS) -> Terrain:
    """Return the models for bins `width` m wide."""
    names = tuple(kind.name for kind in kinds)
    rough, walk, turn, scatter, stay, share = (
        np.array(column) for column in list(zip(*kinds))[1:]
    )
    growth = np.sqrt(width / BIN)
    follow = np.isfinite(turn)
    turned = np.minimum(growth * np.where(follow, turn, SLOPE0) / SLOPE0, 1.0)
    phi = np.where(follow, np.sqrt(1.0 - turned**2), 0.0)
    level, steady = names.index('level'), names.index('steady')
    stationary = share / share.sum()
    left = stationary * np.minimum(width / stay, MOST_LEFT)
    flows = 1.0 - np.eye(len(kinds))
    flows[level, steady] = flows[steady, level] = FEWER_FLOWS
    x = np.sqrt(left)
    for _ in range(_ROUNDS):
        before, x = x, 0.5 * (x + left / (flows @ x))
        if np.array_equal(x, before):
            break
    transition = flows * x[:, None] * x / stationary[:, None]
    np.fill_diagonal(transition, 1.0 - transition.sum(axis=1))
    return Terrain(
        names=names,
        rough=rough,
        walk=growth * walk,
        phi=phi,
        follow=follow,
        scatter=scatter,
        coast=np.where(follow, steady, level),
        transition=transition,
        stationary=stationary,
        width=width,
    )
