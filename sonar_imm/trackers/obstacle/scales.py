# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""How wide detections scatter, in units of the variances that they state.

From hits that are surely the obstacle's, for range and bearing apart: an inverse gamma on the
squared innovation e^2 over its predicted variance V, times the scale s then in use, older hits
forgotten over `MEMORY`,

    a = PRIOR + hits / 2,    b = PRIOR + sum s e^2 / V / 2,
    s <- b / a (1 + rho) / (1 - rho).

rho is the correlation of a track's innovations from one ping to the next, less `USUAL`. Echoes
that all err alike look too steady for what they state, and are not: rho is large then, and what
they state is not narrowed.
"""

from __future__ import annotations

import math
from typing import Annotated, NamedTuple

import numpy as np

from ...estimation.arrays import BoolArray, FloatArray
from .config import ObstacleConfig
from .navigation_errors import UNSAFE

PRIOR, MEMORY = 10.0, 200.0
SURE, FARTHEST = 0.9, 16.0
"""Probability that a detection is the obstacle's, from which it counts, and the largest squared
innovation, in units of its variance."""
USUAL, MOST = 0.1, 0.85
"""Of the correlation of innovations: what a filter leaves, and the largest that is believed."""
ENOUGH = 12.0
"""Hits from which the correlation counts."""
MATTERS, HITS = 1.6, 30.0
"""Of a standard deviation: the factor from which, and the number of hits after which, users are
told."""
NAMES = ('ranges', 'bearings')


class Scales(NamedTuple):
    """Sums over hits, for range and bearing."""

    number: Annotated[FloatArray, '2']
    square: Annotated[FloatArray, '2']
    """Of s e^2 / V."""
    pairs: Annotated[FloatArray, '2']
    """Number of hits after another one of the same track."""
    product: Annotated[FloatArray, '2']
    """Of the two normalised innovations of each such pair."""
    power: Annotated[FloatArray, '2']
    """Mean of the squares of both, summed."""
    own: Annotated[FloatArray, '2']
    """Number of hits without a stated variance."""

    @staticmethod
    def none() -> Scales:
        """Return what is known before the first hit."""
        return Scales(*np.zeros((6, 2)))

    @property
    def are_learnt(self) -> bool:
        """Whether there were hits enough to tell."""
        return bool((self.number >= HITS).all())

    def factor(self, config: ObstacleConfig) -> FloatArray:
        """Return the scales (2,) of the variances of range and bearing."""
        scale = (PRIOR + 0.5 * self.square) / (PRIOR + 0.5 * self.number)
        rho = self.product / np.maximum(self.power, 1e-12) - USUAL
        rho = np.where(self.pairs >= ENOUGH, np.clip(rho, 0.0, MOST), 0.0)
        scale = scale * (1.0 + rho) / (1.0 - rho)
        return np.clip(scale, config.variance_scale_min, config.variance_scale_max)

    def after(
        self, error: FloatArray, last: FloatArray, stated: BoolArray, config: ObstacleConfig
    ) -> Scales:
        """Return the same after hits with normalised innovations (H, 2).

        :param last: (H, 2) those of the hit before of the same track, NaN for none.
        :param stated: (H, 2) whether the variance was stated.
        """
        if not len(error):
            return self
        scale = self.factor(config)
        used = (np.square(error) < FARTHEST) & np.isfinite(error)
        paired = used & np.isfinite(last)
        e, before = np.where(used, error, 0.0), np.where(paired, last, 0.0)
        new = (
            used,
            scale * e * e,
            paired,
            e * before,
            np.where(paired, 0.5 * (e * e + before * before), 0.0),
            used & ~stated,
        )
        keep = math.exp(-len(error) / MEMORY)
        return Scales(*(keep * old + each.sum(axis=0) for old, each in zip(self, new)))

    def noticed(self, config: ObstacleConfig) -> FloatArray:
        """Return the factors (2,) of the standard deviations of range and bearing, 1 where they
        are not sure or do not matter."""
        factor = np.sqrt(self.factor(config))
        off = np.abs(np.log(factor))
        sure = 2.0 * off * np.sqrt(PRIOR + 0.5 * self.number) >= 3.0
        return np.where(sure & (off >= math.log(MATTERS)) & self.are_learnt, factor, 1.0)

    def warnings(self, config: ObstacleConfig, late: bool = False) -> list[str]:
        """Return a sentence where detections scatter more or less than stated; late: whether it is
        rather poses that come too late, of a vehicle that yaws, which lets bearings scatter."""
        found = []
        parameters = 'range_std', 'bearing_std_deg'
        for i, factor in enumerate(self.noticed(config).tolist()):
            if factor == 1.0:
                continue
            times, word = (factor, 'more') if factor > 1.0 else (1.0 / factor, 'less')
            verdict = 'allowed for'
            if i == 1 and factor > 1.0 and late:
                verdict = (
                    'as if poses came later than navigation_delay_std holds, so '
                    f'{UNSAFE}; check the stamps of nav'
                )
            elif self.own[i] > 0.5 * self.number[i]:
                verdict += f'; check {parameters[i]}'
            found.append(f'{NAMES[i]} scatter {times:.0f} times {word} than stated: {verdict}')
        return found
