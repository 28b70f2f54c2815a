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

"""Soundings in a regular grid, and the grid as GeoTIFF.

Each cell holds the mean of its soundings, weighted by one over their variance, and

- the uncertainty of that mean: what the filter's noise and the scatter of the soundings leave. The
  errors of pose and sound speed are common to a ping and to its neighbours, so they do not average
  out: the variance of a cell never falls below the least variance of its soundings divided by the
  number of *pings* that reached it, nor below the scatter divided by the number of soundings;
- the label that most of its soundings have, the smaller one of equals;
- how many soundings there are.

This is no CUBE: it keeps one depth a cell and removes no outlier.
"""

from __future__ import annotations

import math
from pathlib import Path

from attrs import frozen
import numpy as np

from sonar_imm.estimation.arrays import FloatArray

from ..sources import BagError
from .points import Points, wkt_of

MOST_CELLS = 25_000_000
EMPTY_LABEL = 255


@frozen(eq=False)
class Grid:
    """Cells by row, the first the northernmost, and column, the first the westernmost.

    west, north: outer corner, m; cell: m. height (R, C) m, up, NaN where empty; uncertainty (R, C)
    standard deviation m, NaN; label (R, C) u1, 255 where empty; count (R, C).
    """

    west: float
    north: float
    cell: float
    height: FloatArray
    uncertainty: FloatArray
    label: np.ndarray
    count: np.ndarray


def grid_of(points: Points, cell: float) -> Grid:
    """The grid of all soundings, its lines on whole multiples of `cell`.

    Raises `BagError` for no soundings or for too many cells.
    """
    if not len(points):
        raise BagError('there are no soundings to make a grid of')
    x, y = points['x'], points['y']
    west, south = math.floor(x.min() / cell), math.floor(y.min() / cell)
    columns, rows = math.floor(x.max() / cell) - west + 1, math.floor(y.max() / cell) - south + 1
    if rows * columns > MOST_CELLS:
        raise BagError(f'a grid of {rows} by {columns} cells is too large; choose larger cells')
    row = rows - 1 - (np.floor(y / cell).astype(np.int64) - south)
    column = np.floor(x / cell).astype(np.int64) - west
    index, size = row * columns + column, rows * columns

    def total(values: FloatArray | None = None) -> FloatArray:
        return np.asarray(np.bincount(index, values, size), np.float64)

    variance = np.maximum(points['vertical_uncertainty'], 1e-12)
    count = total().astype(np.int64)
    weights = total(1.0 / variance)
    with np.errstate(invalid='ignore', divide='ignore'):
        # Heights far from zero would lose digits in the squares: count from their mean.
        middle = float(points['z'].mean())
        height = total((points['z'] - middle) / variance) / weights
        scatter = total(np.square(points['z'] - middle - height[index])) / np.maximum(count - 1, 1)
        pings = _different(index, points.stamp_ns, size)
        least = np.full(size, np.inf)
        np.minimum.at(least, index, variance)
        spread = np.maximum(least / np.maximum(pings, 1), scatter / np.maximum(count, 1))
        uncertainty = np.sqrt(np.where(count > 0, spread, np.nan))
    shape = rows, columns
    return Grid(
        west=west * cell,
        north=(south + rows) * cell,
        cell=cell,
        height=(height + middle).reshape(shape),
        uncertainty=uncertainty.reshape(shape),
        label=_commonest(index, points['label'].astype(np.int64), size).reshape(shape),
        count=count.reshape(shape),
    )


def write_geotiff(path: Path, grid: Grid, epsg: int | None) -> None:
    """Four bands of float32: depth (positive down), uncertainty, label and count; nodata NaN.

    Needs rasterio. Raises `BagError` for an unknown EPSG number.
    """
    import rasterio
    from rasterio.transform import from_origin

    empty = grid.count == 0
    label = np.where(empty, np.nan, grid.label)
    bands = {
        'depth': -grid.height,
        'uncertainty': grid.uncertainty,
        'label': label,
        'count': grid.count,
    }
    rows, columns = grid.height.shape
    with rasterio.open(
        path,
        'w',
        driver='GTiff',
        height=rows,
        width=columns,
        count=len(bands),
        dtype='float32',
        nodata=float('nan'),
        crs=None if epsg is None else wkt_of(epsg),
        transform=from_origin(grid.west, grid.north, grid.cell, grid.cell),
        compress='deflate',
    ) as file:
        for number, (name, values) in enumerate(bands.items(), start=1):
            file.write(values.astype(np.float32), number)
            file.set_band_description(number, name)


def _different(index: np.ndarray, stamp_ns: np.ndarray, size: int) -> np.ndarray:
    """How many different stamps (size,) each cell has."""
    order = np.lexsort((stamp_ns, index))
    cells, stamps = index[order], stamp_ns[order]
    fresh = np.ones(len(cells), bool)
    fresh[1:] = (cells[1:] != cells[:-1]) | (stamps[1:] != stamps[:-1])
    return np.bincount(cells[fresh], minlength=size)


def _commonest(index: np.ndarray, label: np.ndarray, size: int) -> np.ndarray:
    """The commonest label (size,) of each cell, `EMPTY_LABEL` for none."""
    kinds = int(label.max()) + 1
    votes = np.bincount(index * kinds + label, minlength=size * kinds).reshape(size, kinds)
    return np.where(votes.any(axis=1), votes.argmax(axis=1), EMPTY_LABEL).astype(np.uint8)
