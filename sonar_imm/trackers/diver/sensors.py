# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.


"""Sensors heard so far. Rows of a track name sensors by number (`Rows.key`)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ...estimation.arrays import FloatArray, IndexArray

MOST_SENSORS = 20
"""Maximum number of numbered sensors; all later ones share the last number."""


class Sensors(NamedTuple):
    """Names of the sensors of fixes, in order of appearance."""

    names: tuple[str, ...] = ()

    def with_sensor(self, name: str) -> Sensors:
        """Return the sensors with `name` among them."""
        if name in self.names or len(self.names) >= MOST_SENSORS:
            return self
        return Sensors((*self.names, name))

    def number(self, name: str) -> int:
        """Return the number of a sensor that was heard."""
        return self.names.index(name) if name in self.names else MOST_SENSORS - 1


def of_sensor(values: FloatArray, number: int) -> FloatArray:
    """Return a table (k, MOST_SENSORS) with `values` (k,) of one sensor, and 0 for the others."""
    table = np.zeros((len(values), MOST_SENSORS))
    table[:, number] = values
    return table


def scale_of(key: dict[str, np.ndarray], number: int) -> FloatArray:
    """Return the covariance scale (k,) of a sensor in a `Rows.key`; 1 if the track did not hear
    it."""
    scale = key['scale'][:, number]
    return np.where(scale > 0.0, scale, 1.0)


def lent_moves(
    rows: dict[str, np.ndarray], lender: IndexArray, borrowed: dict[str, np.ndarray]
) -> FloatArray:
    """Return the time (B,), s, over which the state of each lender (B,) moves along its velocity
    under a borrowed assumption about delays.

    A lender that relies on a sensor is where that sensor shows the target: if the sensor is late,
    the target has moved on. A lender that relies on another sensor does not move. It relies on the
    sensor with the least scale and without an offset.

    :param rows: `Rows.key`.
    :param borrowed: `Borrowed.key`.
    """
    moved = np.zeros(len(lender))
    later = borrowed['delay'] - rows['delay'][lender]
    several = np.flatnonzero(later.any(axis=1))
    if not len(several):
        return moved
    scale = rows['scale'][lender[several]]
    scale = np.where(scale > 0.0, scale, np.inf)
    every, off = np.arange(len(several)), rows['offset'][lender[several]]
    scale[every[off >= 0], off[off >= 0]] = np.inf
    best = scale.argmin(axis=1)
    alone = (scale <= scale[every, best, None]).sum(axis=1) == 1
    moved[several] = np.where(alone, later[several, best], 0.0)
    return moved
