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

"""What the state of any model set may be given besides: depth, and the lasting error of fixes.

Depth is z up and its rate, which fades like that of a diver who goes up and down. One filter with
the whole water column as its prior locks onto a wrong depth, because the path of an echo bends
with z squared and the error is common to all pings. So there are copies of the models, each of
which begins in its part of the column; they do not switch, and what they say of the arrivals
weighs them. Where the arrivals say nothing about z the copies stay as likely as they were, and
their spread is in the published covariance.
"""

from __future__ import annotations

from attrs import evolve
import numpy as np

from ...estimation.arrays import FloatArray
from ...estimation.gauss_markov import gauss_markov
from .config import DiverConfig
from .model_set import heights_of, ModelSet, Motion

COPY_SPREAD = 1.3
"""Variance in z with which a copy begins, in variances of its part: the parts overlap."""


def with_depth(base: ModelSet, config: DiverConfig) -> ModelSet:
    """`base` with the height z and its rate w, z' = z + tau (1 - a) w, w' = a w + q, in copies
    over the water column."""
    M, n, heights = len(base.names), base.n, heights_of(config)
    copies = len(heights)
    width = (config.depth_max - config.depth_min) / copies
    E = np.zeros((M, 6, n + 2))
    E[:, :2, :n], E[:, 3:5, :n] = base.E[:, :2], base.E[:, 2:]
    E[:, 2, n] = E[:, 5, n + 1] = 1.0
    rate = config.vertical_speed_std**2

    def motion(dt: float) -> Motion:
        fade, added = gauss_markov(config.vertical_speed_std, config.vertical_speed_time, dt)
        way = config.vertical_speed_time * (1.0 - fade)
        return _joined(base.motion(dt), np.array([[1.0, way], [0.0, fade]]), np.diag([0.0, added]))

    return evolve(
        base,
        E=np.tile(E, (copies, 1, 1)),
        start_mean=np.append(base.start_mean, [heights[0], 0.0]),
        start_variance=np.append(
            base.start_variance, [max(COPY_SPREAD * width**2 / 12.0, 1e-4), rate]
        ),
        motion=motion,
        outputs=('px', 'py', 'pz', 'vx', 'vy', 'vz'),
        height=n,
        heights=heights,
    )


def with_fix_bias(base: ModelSet, config: DiverConfig) -> ModelSet:
    """`base` with an error of the fixes that lasts, one Gauss-Markov process an axis."""
    n, std = base.n, config.fix_bias_std
    E = np.concatenate([base.E, np.zeros((*base.E.shape[:2], 2))], axis=2)

    def motion(dt: float) -> Motion:
        fade, added = gauss_markov(std, config.fix_bias_time, dt)
        return _joined(base.motion(dt), fade * np.eye(2), added * np.eye(2))

    return evolve(
        base,
        E=E,
        start_mean=np.append(base.start_mean, [0.0, 0.0]),
        start_variance=np.append(base.start_variance, [std**2, std**2]),
        motion=motion,
        bias=n,
    )


def _joined(base: Motion, F: FloatArray, Q: FloatArray) -> Motion:
    """The motion of more states beside those of `base`, on which nothing of it depends."""
    M, n = base.B.shape
    m = len(F)
    both = Motion(np.zeros((M, n + m, n + m)), np.zeros((M, n + m, n + m)), np.zeros((M, n + m)))
    both.F[:, :n, :n], both.Q[:, :n, :n], both.B[:, :n] = base
    both.F[:, n:, n:], both.Q[:, n:, n:] = F, Q
    return both
