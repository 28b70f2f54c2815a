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

"""How deep an obstacle lies, from how loud it is.

A beam is louder on its axis than at its edge: an obstacle whose echo fades while the sonar tilts
down lies above. How strong the obstacle is, is not known, and it fades from ping to ping; but the
strength that each depth slice has to assume changes with the tilt, and only for the right one it
stays the same. So every component estimates a strength of its own, S in dB, from

    level = S + G(elevation) + fading,   G = -24.1 dB (elevation / width)^2, out and back,

a Kalman filter with one state, and is weighed by the likelihood of the level. Fading of successive
pings is not independent and a pattern is never known well: the likelihood is raised to the power
`intensity_weight`.

This is worth something when the sonar tilts by degrees, and harmful when the width is wrong.

Source: docs/obstacle.md, section Elevation by intensity.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...acoustics.geometry import Pose
from ...estimation.arrays import FloatArray
from . import kernels
from .config import ObstacleConfig

EDGE_DB = 80.0 * np.log(2.0) / np.log(10.0)
"""dB by which a Gaussian beam is fainter, out and back, where the elevation is its -3 dB width."""
FAINTEST_DB = 30.0
"""Beyond the main lobe a beam is not Gaussian, but has sidelobes about this far down."""
DRIFT_DB = 1.0
"""dB/sqrt(s): random walk of the strength, with aspect and range."""
_UNKNOWN = 1e4
"""dB^2 of a strength of which nothing is known."""


class Strengths(NamedTuple):
    """mean dB and variance dB^2, both (T, K), of the strength each component assumes."""

    mean: FloatArray
    variance: FloatArray

    @staticmethod
    def unknown(T: int, K: int) -> Strengths:
        return Strengths(np.zeros((T, K)), np.full((T, K), _UNKNOWN))

    def rows(self, which: np.ndarray) -> Strengths:
        return Strengths(self.mean[which], self.variance[which])

    def joined(self, other: Strengths) -> Strengths:
        return Strengths(*(np.concatenate(both) for both in zip(self, other)))


def pattern_db(elevation: FloatArray, width: float) -> FloatArray:
    """G, dB, at `elevation` rad of a beam `width` rad high."""
    return -np.minimum(EDGE_DB * np.square(elevation / width), FAINTEST_DB)


def level_db(amplitude: FloatArray) -> FloatArray:
    """dB of amplitudes (n,); NaN where there is none."""
    with np.errstate(divide='ignore', invalid='ignore'):
        level = 20.0 * np.log10(amplitude)
    return np.where(np.isfinite(level), level, np.nan)


def by_intensity(
    x: FloatArray,
    P: FloatArray,
    mu: FloatArray,
    strengths: Strengths,
    pose: Pose,
    level: FloatArray,
    dt: float,
    config: ObstacleConfig,
) -> tuple[FloatArray, Strengths]:
    """`weighed`, for the components x (T, K, n) of a mixture seen from `pose`."""
    m = kernels.points(x, *pose, config.azimuth_model == 'cone')
    elevation = np.arcsin(np.clip(m[..., 2] / np.linalg.norm(m, axis=-1), -1.0, 1.0))
    return weighed(
        mu,
        strengths,
        elevation,
        level,
        dt=dt,
        width=np.radians(config.vertical_beam_width_deg),
        fading_db=config.fading_db,
        weight=config.intensity_weight,
    )


def weighed(
    mu: FloatArray,
    strengths: Strengths,
    elevation: FloatArray,
    level: FloatArray,
    *,
    dt: float,
    width: float,
    fading_db: float,
    weight: float,
) -> tuple[FloatArray, Strengths]:
    """Weights mu (T, K) and strengths after `level` (T,) dB, NaN for a target without one.

    elevation: (T, K) rad of each component below the axis of the sonar; dt: seconds since the
    strengths were valid; width rad; weight: power to which the likelihood is raised.
    """
    variance = strengths.variance + DRIFT_DB**2 * dt
    has_level = np.isfinite(level)[:, None] & np.isfinite(elevation)
    innovation = level[:, None] - strengths.mean - pattern_db(elevation, width)
    innovation = np.where(has_level, innovation, 0.0)
    S = variance + fading_db**2
    gain = np.where(has_level, variance / S, 0.0)
    log_likelihood = np.where(has_level, -0.5 * (np.square(innovation) / S + np.log(S)), 0.0)
    log_likelihood -= np.max(np.where(mu > 0.0, log_likelihood, -np.inf), axis=1, keepdims=True)
    new = mu * np.exp(weight * np.minimum(log_likelihood, 0.0))
    new /= new.sum(axis=1, keepdims=True)
    after = Strengths(strengths.mean + gain * innovation, (1.0 - gain) * variance)
    return new, after
