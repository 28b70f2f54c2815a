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

"""A set of motion models over a common state, and how a track begins in it."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import NamedTuple

from attrs import field, frozen
import numpy as np

from ...estimation.adaptation import Chain
from ...estimation.arrays import FloatArray
from .config import DiverConfig

OUTPUTS = ('px', 'py', 'vx', 'vy')
_CACHED_STEPS = 64


class Motion(NamedTuple):
    """One step of all models: x <- F x + B + N(0, Q). F, Q (M, n, n), B (M, n)."""

    F: FloatArray
    Q: FloatArray
    B: FloatArray


@frozen(eq=False)
class ModelSet:
    """M models over a common state of n components, x and y first.

    names: of the models; E: (M, q, n) outputs; chain: the law of switching; start: state
    components after the position for a new track, mean and variance, (n - 2,) each; initial: (M,)
    model probabilities of a new track. What `augment` adds: outputs, names of the q outputs;
    height and bias, places of z and of the bias of fixes in the state, -1 for none; heights (K,):
    where K copies of the models begin in z, which do not switch between each other.
    """

    names: tuple[str, ...]
    E: FloatArray
    chain: Chain
    start_mean: FloatArray
    start_variance: FloatArray
    initial: FloatArray
    _motion: Callable[[float], Motion]
    outputs: tuple[str, ...] = OUTPUTS
    height: int = -1
    bias: int = -1
    heights: tuple[float, ...] = (0.0,)
    _cache: OrderedDict[float, Motion] = field(factory=OrderedDict, init=False)

    @property
    def n(self) -> int:
        return int(self.E.shape[2])

    @property
    def copies(self) -> int:
        return len(self.heights)

    def by_model(self, mu: FloatArray) -> FloatArray:
        """Model probabilities (T, M) of mu (T, K M), whatever the copy."""
        if self.copies == 1:
            return mu
        return np.asarray(mu.reshape(len(mu), self.copies, len(self.names)).sum(axis=1))

    @property
    def fix(self) -> FloatArray:
        """(M, 2, n): what a fix measures of the state."""
        if self.bias < 0:
            return self.E[:, :2]
        H = self.E[:, :2].copy()
        H[:, :, self.bias : self.bias + 2] += np.eye(2)
        return H

    def motion(self, dt: float) -> Motion:
        """The models over a step of dt seconds, dt >= 0."""
        found = self._cache.get(dt)
        if found is None:
            found = self._cache[dt] = Motion(*map(np.ascontiguousarray, self._motion(dt)))
            if len(self._cache) > _CACHED_STEPS:
                self._cache.popitem(last=False)
        return found

    def new_tracks(
        self, position: FloatArray, covariance: FloatArray, from_fix: bool = True
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """x (k, K M, n), P (k, K M, n, n), mu (k, K M) of tracks first seen at `position` (k, 2)
        with `covariance` (k, 2, 2)."""
        M, n, K = len(self.names), self.n, self.copies
        shape = len(position), K * M
        x, P = np.empty((*shape, n)), np.zeros((*shape, n, n))
        x[..., :2], x[..., 2:] = position[:, None], self.start_mean
        P[..., :2, :2] = covariance[:, None]
        P[..., range(2, n), range(2, n)] = self.start_variance
        if self.height >= 0:
            x[..., self.height] = np.repeat(self.heights, M)
        if self.bias >= 0 and from_fix:
            # A fix is position and bias: as much as one is larger the other is smaller.
            shared = np.diag(self.start_variance[self.bias - 2 : self.bias])
            there = slice(self.bias, self.bias + 2)
            P[..., :2, :2] += shared
            P[..., :2, there] = P[..., there, :2] = -shared
        mu = np.empty(shape)
        mu[:] = np.tile(self.initial / K, K) if K > 1 else self.initial
        return x, P, mu


DEPTH_COPIES = 3
"""Copies of the models, each of which begins in its part of the water column."""


def heights_of(config: DiverConfig) -> tuple[float, ...]:
    """z at which the copies of the models begin: the middles of equal parts of the water column,
    or where the diver is assumed to be."""
    if config.dimensions == 2:
        return (config.target_z,)
    copies = DEPTH_COPIES if config.depth_max > config.depth_min else 1
    width = (config.depth_max - config.depth_min) / copies
    return tuple(-config.depth_min - (k + 0.5) * width for k in range(copies))
