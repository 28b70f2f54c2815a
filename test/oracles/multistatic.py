# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The Cramer-Rao bound of a fix, by differences of the distances to each place."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from sonar_imm.estimation.arrays import FloatArray


def crlb(
    position: FloatArray,
    tx: FloatArray | None,
    rx: FloatArray,
    var_toa: FloatArray,
    *,
    target_z: float,
    sound_speed: float,
    var_bearing: float | None = None,
) -> FloatArray:
    """The bound (2, 2) in m^2 on any unbiased fix at `position` (2,), of n receivers rx (n, 3).

    tx (n, 3): None for a tag, whose time of emission is unknown; var_toa (n,) in s^2.
    """

    def distance(x: FloatArray, points: FloatArray) -> FloatArray:
        return np.linalg.norm(np.append(x, target_z) - points, axis=1)

    def times(x: FloatArray) -> FloatArray:
        path = distance(x, rx) + (0.0 if tx is None else distance(x, tx))
        return np.asarray(path / sound_speed)

    def bearings(x: FloatArray) -> FloatArray:
        return np.asarray(np.arctan2(x[1] - rx[:, 1], x[0] - rx[:, 0]))

    def slopes(function: Callable[[FloatArray], FloatArray]) -> FloatArray:
        ahead, behind = (
            [function(position + h) for h in sign * 1e-3 * np.eye(2)] for sign in (1.0, -1.0)
        )
        return (np.array(ahead) - np.array(behind)).T / 2e-3

    rows = slopes(times)
    if tx is None:
        rows = np.column_stack([rows, np.ones(len(rx))])
    information = rows.T @ (rows / np.asarray(var_toa)[:, None])
    if var_bearing is not None:
        across = slopes(bearings)
        information[:2, :2] += across.T @ across / var_bearing
    return np.linalg.inv(information)[:2, :2]
