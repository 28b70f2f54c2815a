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

"""The vertical offset found afterwards, as the paper does: the one that explains the whole track.

From the first echo and an assumed d_st follows where the obstacle is, hence, with the navigation,
every later echo. The deferred estimate is the d_st whose echoes come nearest to the measured ones,

    argmin over d_st of  RMSD = sqrt(mean((dd / step_d)^2 + (ddelta / step_delta)^2)),     eq. (8)

with the pixels of the sonar image as units. (1), which turns an echo and an offset into a point,
and (8) are lost in the copies of the paper that we know; both are reconstructed from what the text
says of them. The paper looks for offsets below the sonar, which is the default; `both_sides` looks
above it too. The estimate hangs on the error of the first echo; `refit` frees
range and azimuth of the first echo and the scale of the navigation for each d_st, which brings it
close to what the tracker does online.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sonar_imm.acoustics import geometry
from sonar_imm.acoustics.geometry import Pose
from sonar_imm.estimation.angles import wrap_angle
from sonar_imm.estimation.arrays import FloatArray
from sonar_imm.measurements import Navigation
from sonar_imm.trackers.navigation import NavigationBuffer
from sonar_imm.trackers.obstacle.config import ObstacleConfig
from sonar_imm.trackers.obstacle.navigation import Mount

_STEPS = (1e-3, 1e-6, 1e-6)
"""Differences for the slopes: range m, azimuth rad, scale."""


class Deferred(NamedTuple):
    """offset (G,) of the curve and rmsd (G,), NaN where no such obstacle exists; best: the offset
    at its minimum, m below the sonar at the first ping; least: the RMSD there."""

    offset: FloatArray
    rmsd: FloatArray
    best: float
    least: float


def sonar_poses(
    navigation: Sequence[Navigation], stamps_ns: np.ndarray, config: ObstacleConfig
) -> tuple[Pose, np.ndarray]:
    """The sonar's poses in NED and FRD at each of the stamps (N,), and where they are known (N,):
    not outside the navigation or in its gaps."""
    samples = {sample.stamp_ns: sample for sample in navigation}
    stamps = tuple(sorted(samples))
    buffer = NavigationBuffer(stamps, tuple(samples[stamp] for stamp in stamps))
    mount = Mount(config)
    longest = round(config.max_navigation_gap * 1e9)
    known = np.array(
        [buffer.readiness(int(t), int(t), longest, 0) == 'ready' for t in stamps_ns], bool
    )
    position, R = np.full((len(known), 3), np.nan), np.full((len(known), 3, 3), np.nan)
    for k in np.flatnonzero(known):
        position[k], R[k] = mount.sonar(buffer.pose(int(stamps_ns[k])))
    return Pose(position, R), known


def deferred(
    z: FloatArray,
    poses: Pose,
    config: ObstacleConfig,
    *,
    offsets: FloatArray | None = None,
    both_sides: bool = False,
    refit: bool = False,
) -> Deferred:
    """The deferred estimate from one obstacle's echoes.

    z (N, 2): range and azimuth (to starboard), N >= 2; poses: of the sonar, (N,); offsets (G,):
    where to draw the curve, by default every 0.25 m over what a beam can hold, below the sonar or
    on both sides. The minimum is found to a micrometre between them.
    """
    if len(z) < 2:
        raise ValueError('a deferred estimate needs two echoes at least')
    if offsets is None:
        reach = 0.25 * np.ceil(4.0 * z[0, 0] * np.sin(np.radians(0.8 * config.vertical_fov_deg)))
        offsets = np.arange(-reach if both_sides else 0.0, reach + 0.125, 0.25)
    curve = _rmsd(offsets, z, poses, config, refit)
    if not np.isfinite(curve).any():
        return Deferred(offsets, curve, np.nan, np.nan)
    from scipy.optimize import minimize_scalar

    def at(offset: float) -> float:
        value = _rmsd(np.array([offset]), z, poses, config, refit)[0]
        return float(value) if np.isfinite(value) else np.inf

    lowest = int(np.nanargmin(curve))
    between = offsets[max(lowest - 1, 0)], offsets[min(lowest + 1, len(offsets) - 1)]
    found = minimize_scalar(at, bounds=between, method='bounded', options={'xatol': 1e-9})
    return Deferred(offsets, curve, float(found.x), float(found.fun))


def _rmsd(
    offsets: FloatArray, z: FloatArray, poses: Pose, config: ObstacleConfig, refit: bool
) -> FloatArray:
    """(G,)"""
    first = np.zeros((len(offsets), 3)) + [*z[0], 0.0]
    if refit:
        first = _refit(first, offsets, z, poses, config)
    residual = _residuals(first, offsets, z, poses, config)
    return np.asarray(np.sqrt(np.mean(residual[:, : 2 * len(z)] ** 2, axis=1) * 2.0))


def _residuals(
    first: FloatArray, offsets: FloatArray, z: FloatArray, poses: Pose, config: ObstacleConfig
) -> FloatArray:
    """(G, 2N + 1) in pixels, of obstacles whose first echo and navigation scale are `first` (G,
    3); the last column is the scale in its standard deviations."""
    start = Pose(poses.position[0], poses.R[0])
    m = geometry.reconstruct(first[:, 0], first[:, 1], offsets, start.R, config.azimuth_model)
    travelled = poses.position - start.position
    scale = np.ones((len(first), 1, 3))
    scale[:, 0, :2] += first[:, 2:]
    seen = geometry.to_body(
        Pose(start.position + travelled * scale, poses.R), geometry.to_world(start, m)[:, None]
    )
    d, delta = geometry.project(seen, config.azimuth_model)
    pixel = (
        (config.range_step or config.range_std),
        np.radians(config.bearing_step_deg or config.bearing_std_deg),
    )
    parts = (d - z[:, 0]) / pixel[0], wrap_angle(delta - z[:, 1]) / pixel[1]
    prior = first[:, 2:] / max(config.scale_std, 1e-9)
    return np.concatenate([*parts, prior], axis=1)


def _refit(
    first: FloatArray, offsets: FloatArray, z: FloatArray, poses: Pose, config: ObstacleConfig
) -> FloatArray:
    """Gauss-Newton for range and azimuth of the first echo and the scale, offset by offset."""
    for _ in range(6):
        residual = _residuals(first, offsets, z, poses, config)
        slope = np.stack(
            [
                (_residuals(first + step * e, offsets, z, poses, config) - residual) / step
                for step, e in zip(_STEPS, np.eye(3))
            ],
            axis=-1,
        )
        good = np.isfinite(residual).all(axis=1) & np.isfinite(slope).all(axis=(1, 2))
        A, r = slope[good], residual[good]
        normal = np.einsum('gni,gnj->gij', A, A)
        right = np.einsum('gni,gn->gi', A, r)
        first = first.copy()
        first[good] -= np.linalg.solve(normal, right[..., None])[..., 0]
        first[~good] = np.nan
    return first
