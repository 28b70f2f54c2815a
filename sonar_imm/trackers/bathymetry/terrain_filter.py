# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""The models of `terrain` along a ping: outward, inward and fused, by `terrain_kernels`."""

from __future__ import annotations

from itertools import chain
from typing import Any

import numpy as np

from ...estimation.arrays import FloatArray
from .bins import PingLikelihood, Track
from .models import TerrainModels
from .terrain import SLOPE0
from .terrain_kernels import filter_terrain, NODES, ROWS

UNAMBIGUOUS = 0.6
"""Spacing in wavelengths up to which no floor but at the end of the circle has a second lobe."""
GAP = 3.0
"""m, of the widest gap in which the chain of the models goes on; in a wider one, a shadow, a slope
would be forgotten."""
PARTS, PART_STD = np.linspace(-3.0, 3.0, 9), 0.4
"""Of the start, in its standard deviations: where its parts are, and how wide."""


def bridged(ping: PingLikelihood) -> PingLikelihood:
    """Return the same with bins that say nothing in the gaps between echoes, up to `GAP` wide.

    How far a kind of floor goes on is counted in metres. Far off, half of the echoes are too weak
    to be used: where the chain rests there, kinds go on twice as far."""
    held, heard = np.flatnonzero(ping.echo), ping.echo[:, None]
    if not len(held):
        return ping
    echo = ping.echo.copy()
    near = np.diff(ping.ranges[held]) <= GAP
    echo[held[0] : held[-1]] |= np.repeat(near, np.diff(held))
    form, spread = np.where(heard, ping.form, 0.0), np.where(heard, ping.spread, 0.0)
    return ping._replace(echo=echo, form=form, spread=spread)


def run_terrain(
    models: TerrainModels,
    ping: PingLikelihood,
    peak: FloatArray,
    *,
    smooth: bool,
    temper: float = 1.0,
) -> Track:
    """The filter along a ping, given the bins before each one, or with `smooth` the whole ping.
    peak (T,): the height from which the beam of a bin is strongest, NaN where none is known.
    temper: the log likelihood of a bin counts so much.

    Staves far apart hear a floor in several directions, and where slopes are possible each of
    them is a floor. One Gaussian follows one: the start is then cut into parts, of which the one
    that explains the whole ping best is taken."""
    starts = [(float(models.mean[0]), float(models.std[0]))]
    if abs(ping.geometry.spacing) > UNAMBIGUOUS:
        starts = _parts_of(*starts[0])
        logs = [_filtered(1, models, ping, peak, start, temper).log_likelihood for start in starts]
        # A bin that nothing explains counts as one that says nothing.
        sums = [float(each[np.isfinite(each)].sum()) for each in logs]
        best = int(np.argmax(np.array(sums) - 0.5 * np.square(PARTS)))
        starts = starts[best : best + 1]
    return _filtered(3 if smooth else 1, models, ping, peak, starts[0], temper)


def _parts_of(mean: float, std: float) -> list[tuple[float, float]]:
    """Narrower normal laws whose mixture is about the one given."""
    return [(mean + part * std, PART_STD * std) for part in PARTS]


def _filtered(
    turns: int,
    models: TerrainModels,
    ping: PingLikelihood,
    peak: FloatArray,
    start: tuple[float, float],
    temper: float,
) -> Track:
    """`filter_terrain` with arrays of its own for scratch."""
    terrain, g = models.terrain, ping.geometry
    assert terrain is not None
    T, M = len(ping.ranges), len(models.names)
    work = np.empty((ROWS, NODES * M))
    mean, variance, probability = np.empty(T), np.empty(T), np.empty((T, M))
    log_likelihood = np.empty(T)
    groups: tuple[tuple[Any, ...], ...] = (
        (terrain.walk, terrain.phi, terrain.follow, terrain.scatter, terrain.coast),
        (terrain.transition, terrain.stationary, SLOPE0, terrain.width),
        (*start, models.favour, temper),
        (ping.echo, ping.form, ping.base, ping.spread, ping.signal, ping.table),
        (peak, np.empty(T), g.height, g.reach, g.cos_tilt, g.sin_tilt, g.spacing),
        (g.launch, g.row, g.first_depth, g.depth_step),
        (np.empty((2, T, M, 6)), np.empty((M, 5)), np.empty((M, 6)), np.empty(M)),
        (np.empty(M, np.int64), work, work.view(np.int64)),
        (mean, variance, probability, log_likelihood),
    )
    filter_terrain(turns, *chain.from_iterable(groups))
    nothing = np.full(T, np.nan)
    return Track(mean[:, None], variance[:, None, None], probability, log_likelihood, nothing)
