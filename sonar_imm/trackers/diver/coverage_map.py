# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Sensor coverage: the probability of detection as a function of the position.

A `Coverage` is a sector with constant probability, or a table over x and y or over range, read
from a file. `DetectionProbability` is the coverage evaluated for tracks and fixes.
"""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import NamedTuple

from attrs import frozen
import numpy as np

from ...estimation.arrays import BoolArray, FloatArray
from ...parameters import ConfigError
from .config import DiverConfig

MOST = 0.9999
"""Maximum detection probability."""

COLUMNS = (('x', 'y', 'probability'), ('range', 'probability'))
"""Headers of a table file."""


class Table(NamedTuple):
    """Bilinear table of probabilities, 0 outside."""

    x: FloatArray
    """(rows,) x, m, or range, m."""
    y: FloatArray
    """(columns,) y, m; empty for a table over range."""
    probability: FloatArray
    """(rows, columns)."""

    def interpolate(self, place: FloatArray, distance: FloatArray) -> FloatArray:
        """Return the probability (...,) at positions (..., 2), at `distance` (...,) from the
        sensor."""
        if not len(self.y):
            return np.interp(distance, self.x, self.probability[:, 0], right=0.0)
        found = np.zeros(place.shape[:-1])
        row, u, inside_x = _find_cell(self.x, place[..., 0])
        column, v, inside_y = _find_cell(self.y, place[..., 1])
        for a, weight_a in ((0, 1.0 - u), (1, u)):
            for b, weight_b in ((0, 1.0 - v), (1, v)):
                found += weight_a * weight_b * self.probability[row + a, column + b]
        return np.where(inside_x & inside_y, found, 0.0)


def _find_cell(axis: FloatArray, value: FloatArray) -> tuple[np.ndarray, FloatArray, BoolArray]:
    """Return the cell of each value on a rising axis, the fraction in the cell, and whether the
    value is on the axis."""
    cell = np.clip(np.searchsorted(axis, value, side='right') - 1, 0, len(axis) - 2)
    along = np.clip((value - axis[cell]) / (axis[cell + 1] - axis[cell]), 0.0, 1.0)
    return cell, along, (value >= axis[0]) & (value <= axis[-1])


@frozen(eq=False)
class Coverage:
    """Coverage of one sensor."""

    place: FloatArray
    """(2,) sensor position, m."""
    direction: float
    """Centre of the sector, rad."""
    half_width: float
    """Half width of the sector, rad."""
    least: float
    """Minimum range, m."""
    greatest: float
    """Maximum range, m."""
    table: Table | None
    """Table of probabilities; None for a constant probability."""

    def probability(self, place: FloatArray, detection_probability: float) -> FloatArray:
        """Return the detection probability (...,) of a target at `place` (..., 2)."""
        apart = place - self.place
        distance = np.hypot(apart[..., 0], apart[..., 1])
        inside = (distance >= self.least) & (distance <= self.greatest)
        if self.half_width < math.pi:
            turned = np.arctan2(apart[..., 1], apart[..., 0]) - self.direction
            off = np.abs((turned + math.pi) % (2.0 * math.pi) - math.pi)
            inside &= off <= self.half_width
        if self.table is None:
            return np.where(inside, detection_probability, 0.0)
        return np.where(inside, self.table.interpolate(place, distance), 0.0)


def configured_coverage(config: DiverConfig) -> dict[str, Coverage]:
    """Return the coverage by sensor name, with '' for all other sensors.

    Sensors without limits are absent.

    :raises ConfigError: a coverage file cannot be read.
    """
    found = {}
    for sensor in ('', *config.sensors):
        own = config.of_sensor(sensor)
        if own.coverage_sector or own.coverage_file:
            found[sensor] = _build_coverage(own.coverage_sector, own.coverage_file)
    return found


def _build_coverage(sector: tuple[float, ...], file: str) -> Coverage:
    """Build the coverage from a sector and a file."""
    x, y, direction, width, least, greatest = sector or (0.0, 0.0, 0.0, 360.0, 0.0, math.inf)
    turn, half = math.radians(direction), 0.5 * math.radians(width)
    table = _read_table(file) if file else None
    return Coverage(np.array([x, y]), turn, half, least, greatest, table)


def _read_table(file: str) -> Table:
    """Read the table in a CSV file.

    :raises ConfigError: the file is invalid.
    """
    try:
        with Path(file).expanduser().open(newline='', encoding='utf-8') as stream:
            rows = [[cell.strip() for cell in row] for row in csv.reader(stream) if row]
        if not rows or tuple(rows[0]) not in COLUMNS:
            headers = ' or '.join(','.join(names) for names in COLUMNS)
            raise ValueError(f'its first line has to be {headers}')
        table = np.array([[float(cell) for cell in row] for row in rows[1:]])
        if table.ndim != 2 or table.shape[1] != len(rows[0]) or not np.isfinite(table).all():
            raise ValueError('a line has not as many numbers as the first names')
        if ((table[:, -1] < 0.0) | (table[:, -1] > MOST)).any():
            raise ValueError(f'a probability is not between 0 and {MOST:g}')
        return _arrange_table(table)
    except (OSError, ValueError) as error:
        raise ConfigError(f"coverage_file '{file}' cannot be used: {error}") from None


def _arrange_table(table: FloatArray) -> Table:
    """Build a table from the rows (n, 2 or 3) of a file, in any order."""
    axes = [np.unique(column) for column in table[:, :-1].T]
    shape = [len(axis) for axis in axes]
    if math.prod(shape) != len(table) or min(shape) < 2:
        raise ValueError('it is no grid of at least two values on each axis, each place once')
    places = tuple(np.searchsorted(axis, column) for axis, column in zip(axes, table.T))
    grid = np.full(shape, np.nan)
    grid[places] = table[:, -1]
    if np.isnan(grid).any():
        raise ValueError('it has a place twice')
    if len(axes) == 1:
        return Table(axes[0], np.empty(0), grid[:, None])
    return Table(axes[0], axes[1], grid)


class DetectionProbability(NamedTuple):
    """Detection probabilities of one sensor at one scan."""

    coverage: Coverage
    nominal: float
    """Configured detection probability."""
    tracks: FloatArray
    """(T,) detection probability of each track."""
    fixes: FloatArray
    """(D,) detection probability at the position of each fix."""

    @property
    def log_ratio(self) -> FloatArray:
        """(T, D) correction of the log density of fixes, for gates based on the nominal
        probability."""
        usual = math.log(self.nominal) - math.log1p(-self.nominal)
        return np.log(self.fixes)[None] - np.log1p(-self.tracks)[:, None] - usual

    @property
    def is_outside(self) -> BoolArray:
        """(T,) True for tracks outside the coverage."""
        return np.asarray(2.0 * self.tracks < self.nominal)

    @property
    def miss_weight(self) -> FloatArray:
        """(T,) weight of a miss, relative to a miss at the nominal probability; at most 1."""
        return np.minimum(np.log1p(-self.tracks) / math.log1p(-self.nominal), 1.0)
