# Copyright 2026 The sonar_imm developers
# Licensed under the Apache License, Version 2.0 (the "License"); you may not use this file except
# in compliance with the License. You may obtain a copy of the License at
# http://www.apache.org/licenses/LICENSE-2.0 Unless required by applicable law or agreed to in
# writing, software distributed under the License is distributed on an "AS IS" BASIS, WITHOUT
# WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied. See the License for the specific
# language governing permissions and limitations under the License.

"""Charts as files: cloud-optimized GeoTIFF."""

from __future__ import annotations

from collections.abc import Mapping
import math
from pathlib import Path
from typing import Any
import warnings

from attrs import frozen
import numpy as np

from sonar_imm.acoustics.sounding import ErrorBudget
from sonar_imm.estimation.arrays import FloatArray

from ..recordings.export.points import Points, wkt_of
from ..recordings.sources import BagError
from .grid import Box, grid_of_looks, Nodes, Soundings, tiles_of
from .line import line_of

MOST_CELLS = 25_000_000
BANDS = (
    'depth', 'uncertainty', 'count', 'lines', 'hypotheses', 'odds', 'competing_depth',
    'competing_uncertainty', 'competing_count', 'label',
)  # fmt: skip
OF_ONE_RUN = ('depth', 'uncertainty', 'label', 'count', *BANDS[4:9])
"""What `export` writes of a single run, whose `lines` would be 1 throughout."""


@frozen(eq=False)
class Chart:
    """Bands (R, C) by name, the first row the northernmost, NaN where nothing is known.

    west, north: outer corner, m; cell: m.
    """

    west: float
    north: float
    cell: float
    bands: Mapping[str, np.ndarray]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        rows, columns = self.bands['depth'].shape
        return rows, columns

    def axes(self, every: int = 1) -> tuple[FloatArray, FloatArray]:
        """East of the middle of every so many columns, and north of that of rows."""
        rows, columns = (np.arange(0.5, count)[::every] for count in self.shape)
        return self.west + self.cell * columns, self.north - self.cell * rows


def values_of(nodes: Nodes) -> dict[str, FloatArray]:
    """The bands (k,) of nodes: depths positive down, standard deviations in m."""
    return {
        'depth': -nodes.z,
        'uncertainty': nodes.sd,
        'count': nodes.count.astype(np.float64),
        'lines': nodes.lines.astype(np.float64),
        'hypotheses': nodes.hypotheses.astype(np.float64),
        'odds': nodes.odds,
        'competing_depth': -nodes.competing_z,
        'competing_uncertainty': nodes.competing_sd,
        'competing_count': nodes.competing_count,
        'label': nodes.label.astype(np.float64),
    }


def extent_of(xy: FloatArray, cell: float) -> Box:
    """First column and row, columns and rows of the cells that hold soundings.

    Raises `BagError` for no soundings or for too many cells.
    """
    if not len(xy):
        raise BagError('there are no soundings to make a grid of')
    low, high = np.floor(xy.min(axis=0) / cell), np.floor(xy.max(axis=0) / cell)
    columns, rows = (high - low + 1).astype(int).tolist()
    if rows * columns > MOST_CELLS:
        raise BagError(f'a grid of {rows} by {columns} cells is too large; choose larger cells')
    return int(low[0]), int(low[1]), columns, rows


def chart_of(points: Points, cell: float, budget: ErrorBudget, sound_speed: float) -> Chart:
    """The chart of one run: a grid of looks, its lines on whole multiples of `cell`.

    Raises `BagError` for no soundings or for too many cells.
    """
    line = line_of(points, budget, sound_speed)
    x0, y0, columns, rows = extent_of(line.xy, cell)
    bands = {name: np.full((rows, columns), np.nan) for name in BANDS}
    soundings = Soundings(line, np.zeros(len(line), np.int64))
    for box, near in tiles_of(soundings, cell):
        nodes = grid_of_looks(near, cell, box, budget)
        # Nodes beside the outermost cells with soundings are in reach, too; the chart ends before.
        inside = (nodes.ix >= x0) & (nodes.ix < x0 + columns)
        inside &= (nodes.iy >= y0) & (nodes.iy < y0 + rows)
        place = rows - 1 - (nodes.iy[inside] - y0), nodes.ix[inside] - x0
        for name, values in values_of(nodes).items():
            bands[name][place] = values[inside]
    return Chart(x0 * cell, (y0 + rows) * cell, cell, bands)


def write_geotiff(
    path: Path, chart: Chart, epsg: int | None, names: tuple[str, ...] = BANDS
) -> None:
    """Bands of float32 with nodata NaN, in the order of `names`.

    Needs rasterio. Raises `BagError` for an unknown EPSG number.
    """
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning
    from rasterio.transform import from_origin

    rows, columns = chart.shape
    options: dict[str, Any] = {
        'driver': 'COG',
        'height': rows,
        'width': columns,
        'count': len(names),
        'dtype': 'float32',
        'nodata': math.nan,
        'crs': None if epsg is None else wkt_of(epsg),
        'transform': from_origin(chart.west, chart.north, chart.cell, chart.cell),
        'compress': 'deflate',
        'overview_resampling': 'nearest',
    }

    def fill(file: Any) -> None:
        for number, name in enumerate(names, start=1):
            file.write(chart.bands[name].astype(np.float32), number)
            file.set_band_description(number, name)

    with warnings.catch_warnings():
        # Cells of 1 m from the origin are kept, whatever this warning says.
        warnings.simplefilter('ignore', NotGeoreferencedWarning)
        if str(path).isprintable():
            with rasterio.open(path, 'w', **options) as file:
                fill(file)
            return
        # The library names only files whose names are UTF-8.
        with rasterio.MemoryFile() as memory:
            with memory.open(**options) as file:
                fill(file)
            path.write_bytes(memory.read())
