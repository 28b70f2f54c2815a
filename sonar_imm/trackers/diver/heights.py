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

"""What fixes say of z, where depth is a state (`dimensions: 3`).

Association and the update by x and y are the same with it and without. Then z is one number more
for the track that took the fix: z less what the errors of x and y, which are known by now, have
to do with its own. With ``R`` the covariance of the fix, split into that of x and y, of z, and
between them,

    z - g (x, y) = z_track - g (x, y)_track + e,    g = R_z,xy R_xy^-1,    var e = R_zz - g R_xy,z

where e has nothing to do with the errors of x and y. So the two updates in turn are the one by all
three coordinates. It weighs the models too, and with them the copies of the depth bank.

z has a gate of its own, one coordinate under the whole mixture: an echo from the surface is off in
z alone. What is refused is remembered; the next fix that agrees with it says that the depth was
wrong, and z begins there.
"""

from __future__ import annotations

import math

import numpy as np

from ...estimation.arrays import FloatArray, IndexArray, IntArray
from ...estimation.association import gate_threshold
from ...estimation.small_matrices import add_jitter_all
from .config import DiverConfig
from .fix_kernels import update_heights
from .scan import Height, Positions
from .state import DiverState, HeightCounts
from .state_space import Layout

BEYOND = 3.0
"""Standard deviations by which a fix lies above or below the water column, so that it was stated
wrong."""


def begin(
    x: FloatArray,
    P: FloatArray,
    height: Height,
    covariance: FloatArray,
    place: int,
    config: DiverConfig,
) -> None:
    """Let a new track, x (M, n), P (M, n, n) in place, begin at the z that its fix states; its x
    and y have `covariance` (2, 2). Not where the water column, of `depth_min` to `depth_max`, says
    more than the fix, and does not contradict it: then z begins as without a fix."""
    variance = height.variance(covariance)
    width = config.depth_max - config.depth_min
    if variance <= width**2 / 12.0 or _outside(height.value, variance, config):
        _set(x, P, place, height.value, variance, config)
        P[:, :2, place] = P[:, place, :2] = covariance @ height.gain


def _outside(value: float, variance: float, config: DiverConfig) -> bool:
    room = BEYOND * math.sqrt(variance)
    return not -config.depth_max - room <= value <= -config.depth_min + room


def _set(
    x: FloatArray, P: FloatArray, place: int, value: float, variance: float, config: DiverConfig
) -> None:
    """Forget what x (M, n), P (M, n, n) know of z and its rate, which follows it."""
    own = slice(place, place + 2)
    P[:, own, :] = P[:, :, own] = 0.0
    x[:, place], x[:, place + 1] = value, 0.0
    P[:, place, place], P[:, place + 1, place + 1] = variance, config.vertical_speed_std**2


def update(
    now: DiverState,
    fixes: Positions,
    tracks: IndexArray,
    detection: IntArray,
    weight: FloatArray,
    layout: Layout,
    place: int,
    config: DiverConfig,
) -> DiverState:
    """The `tracks` (t,) after the heights of the `fixes` that they took, `detection` (t,), each
    with the probability `weight` (t,) that it is the track's; place: of z in the state."""
    heights = fixes.heights
    assert heights is not None
    stated = np.isfinite(heights.value[detection])
    tracks, detection, weight = tracks[stated], detection[stated], weight[stated]
    if not len(tracks):
        return now
    value = heights.value[detection] - (heights.gain[detection] * fixes.z[detection]).sum(axis=1)
    threshold = gate_threshold(config.gate_probability, 1)
    x, P, mu, nis = update_heights(
        now.x,
        now.P,
        now.mu,
        layout.H,
        place,
        value,
        heights.gain[detection],
        heights.rest[detection],
        tracks,
        weight,
        layout.mask,
        threshold,
    )
    good = nis <= threshold
    hit = tracks[good]
    repairs = 0
    for track in hit.tolist():
        repairs += add_jitter_all(P[track])
    all_nis, nis_dof, refused = now.nis.copy(), now.nis_dof.copy(), now.refused_z.copy()
    all_nis[hit] += nis[good]
    nis_dof[hit] += np.uint16(1)
    refused[hit] = np.nan
    seen, doubted, outside = now.heights
    for track, row in zip(tracks[~good].tolist(), detection[~good].tolist()):
        own = heights.row(row)
        assert own is not None
        variance = own.variance(fixes.R[row])
        stamp, before, its = refused[track].tolist()
        moved = config.vertical_speed_std * (now.stamp_ns - stamp) * 1e-9
        if (own.value - before) ** 2 <= threshold * (variance + its + moved**2):
            _set(x[track], P[track], place, own.value, variance, config)
            refused[track] = np.nan
        else:
            refused[track] = now.stamp_ns, own.value, variance
            doubted += 1
    for row in detection.tolist():
        own = heights.row(row)
        assert own is not None
        outside += _outside(own.value, own.variance(fixes.R[row]), config)
    return now._replace(
        x=x,
        P=P,
        mu=mu,
        nis=all_nis,
        nis_dof=nis_dof,
        refused_z=refused,
        heights=HeightCounts(seen + len(tracks), doubted, outside),
        repairs=now.repairs + repairs,
    )
